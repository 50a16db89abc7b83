//! Intarsia refines the texture atlases of 3D models.
//!
//! The map of the house:
//!
//! ```text
//! upload -> asset::read -> Atlas -> stage -> ... -> Atlas -> texture::bake -> asset::write -> result
//!                            |                        |
//!                            +-- metrics (before)     +-- metrics (after) -> report
//! ```
//!
//! * [`atlas`]: the value that everything works on: surface, UVs in texels, provenance.
//! * `numeric`: energies of maps of triangles, and the solvers that make them small.
//! * [`packing`]: places charts on sheets; knows neither glTF nor images.
//! * [`refine`]: the stages from Atlas to Atlas, the options, and the recipe that runs them.
//! * [`asset`]: glTF and OBJ in and out.
//! * [`texture`]: decode, resample through provenance, fill, encode.
//! * [`metrics`]: what an atlas is worth: figures, fidelity, pictures, the report's schema.
//! * [`jobs`]: the durable queue and the worker.
//! * [`http`]: the service.
//! * [`config`]: every flag, environment variable and limit.

pub mod asset;
pub mod atlas;
pub mod config;
pub mod context;
pub mod error;
pub mod http;
pub mod jobs;
pub mod metrics;
mod numeric;
pub mod packing;
pub mod refine;
pub mod telemetry;
pub mod texture;
