//! Energies of maps of triangles and the solvers that make them small.
//!
//! Nothing here knows an Atlas: vertices are indices, triangles are triples of them, positions are points of the plane.

pub(crate) mod alignment;
pub(crate) mod arap;
pub(crate) mod cholesky;
pub(crate) mod dirichlet;
pub(crate) mod energy;
pub(crate) mod lbfgs;
pub(crate) mod multifrontal;
pub(crate) mod newton;
pub(crate) mod repair;
pub(crate) mod scaffold;
pub(crate) mod tutte;
