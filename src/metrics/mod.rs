//! What an atlas is worth: figures, pictures, and the report's schema.
//!
//! [`measure`] gives the [`Measures`] of one atlas, one file a family; [`roll_up`] those of a model. [`Report`] is
//! what a job says about its work, [`unmet`] what a user's requirements make of it, [`picture`] shows the charts.

mod boundary;
mod charts;
mod coverage;
mod density;
mod distortion;
mod gutter;
mod measures;
mod raster;

pub use density::TexelDensity;
pub use measures::{Frame, Measures, SlotSize, measure, roll_up};
