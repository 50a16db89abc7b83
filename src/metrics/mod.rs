//! What an atlas is worth: figures, pictures, and the report's schema.
//!
//! [`measure`] gives the [`Measures`] of one atlas, one file a family; [`roll_up`] those of a model. [`Report`] is
//! what a job says about its work, [`judge`] what a user's requirements make of it, [`picture`] shows the charts.

mod boundary;
mod canvas;
mod charts;
mod coverage;
mod density;
mod distortion;
mod gate;
mod gutter;
mod measures;
mod outcome;
mod picture;
mod raster;
mod report;
mod requirement;

pub(crate) use charts::chart_orientations;
pub use density::TexelDensity;
pub(crate) use density::of_face as texel_density;
pub(crate) use distortion::by_face as distortion_by_face;
pub use gate::{Unmet, Verdict, check_path, judge, paths};
pub(crate) use measures::gpu_bytes;
pub use measures::{MeasureInputs, Measures, SlotSize, measure, roll_up, without_layout};
pub use outcome::RefinementOutcome;
pub use picture::picture;
pub use report::{
    AtlasReport, ImageReport, InputReport, ModelInput, ModelReport, Report, StageReport, TextureReport, TextureSource,
};
pub use requirement::Requirement;
