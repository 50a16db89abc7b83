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
//! The rooms, in their order. Each may use those below it, never one above:
//!
//! * [`http`]: the service.
//! * [`jobs`]: the durable queue and the worker.
//! * [`refine`]: the stages from Atlas to Atlas, the options, and the recipe that runs them.
//! * [`metrics`]: what an atlas is worth: figures, fidelity, pictures, the report's schema.
//! * [`asset`]: glTF and OBJ in and out.
//! * [`texture`]: decode, resample through provenance, fill, encode.
//! * [`packing`]: places charts on sheets; knows neither glTF nor images.
//! * `numeric`: energies of maps of triangles, and the solvers that make them small.
//! * [`atlas`]: the value that everything works on: surface, UVs in texels, provenance.
//! * [`config`]: every flag, environment variable and limit.
//! * [`context`]: progress, cancellation, the budget of work and the clock.
//! * [`params`]: what the sections of the options have in common: defaults, ranges, schema, and how they are read.
//! * [`error`]: what can go wrong, and whose it is.

/// The rooms from top to bottom; `rooms.rs` holds the imports against it.
#[cfg(test)]
const ROOMS: [&str; 13] = [
    "http", "jobs", "refine", "metrics", "asset", "texture", "packing", "numeric", "atlas", "config", "context",
    "params", "error",
];

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
pub mod params;
pub mod refine;
#[cfg(test)]
mod rooms;
pub mod texture;
