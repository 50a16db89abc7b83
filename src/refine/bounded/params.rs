//! Every parameter of bounded packing efficiency, with unit, range, default and source.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::error::Result;
use crate::params::params;
use crate::refine::stage::{Stage, StageInput, Staged};

params! {
    /// Parameters of the stage `bounded`. Sections are those of Liu, Fu, Ye, Chai and Liu 2019.
    pub struct Bounded {
        /// Least packing efficiency of the result: area of the charts over area of the box about them (section 3.2: 0.8; the paper reports 0.8, 0.85 and 0.9).
        pub packing_efficiency: f64 = 0.8, in 0.01..=0.97;
        /// Longest 3D seams after cutting, relative to those before; null is no limit. The packing efficiency comes first: where both
        /// cannot be had, seams are as short as the search finds them, and the report says so.
        pub max_boundary_length: Option<f64> = None, in 1..=1000;
        /// Whether Box Cutter's straight cuts, which deform nothing, are tried too and taken where they reach the bound with shorter seams.
        pub straight_cuts_alone: bool = false;
        /// What distortion is measured against while it is reduced (section 3.4).
        pub energy: Energy = Energy::Surface;
        /// How charts are cut: straight, which divides faces, or along the edges of the mesh (section 4.1), so that cuts make no new vertices on the surface.
        pub cuts: Cuts = Cuts::Straight;
        /// Whether the maps stay as they were cut, continuous across the new seams: nothing is reduced then (section 5, *Mapping continuity*).
        pub keep_mapping: bool = false;
        /// Whether reduction ends as soon as the distortion is that of the input (section 3.3), or goes on to the least that the bound allows.
        pub stop_at_input: bool = true;
        /// Standard deviation of boundary smoothing, relative to the length of a chart's boundary (eq. 3: 0.004).
        pub sigma: f64 = 0.004, in 0.0001..=0.1;
        /// Free distance about each rectangle, relative to the diagonal of the input's bounding box (section 3.2: 0.0025); at most a fiftieth of the mean side of its charts.
        pub padding: f64 = 0.0005, in 0..=0.05;
        /// Divisions that are tried for each construction (section 3.2: 500).
        pub candidates: u32 = 5000, in 1..=100000;
        /// How divisions are searched for.
        pub search: Search = Search::Default;
    }
}

impl Stage for Bounded {
    const NAME: &'static str = "bounded";
    const DESCRIPTION: &'static str = "Deforms charts until rectangles cut from them pack as tightly as is asked for, and gives them back what shape the bound allows.";
    const WEIGHT: f64 = 6.0;

    fn run(&self, input: &StageInput<'_>) -> Result<Staged> {
        super::bounded(input, self)
    }
}

/// What distortion is measured against.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(as = BoundedEnergy)]
pub enum Energy {
    /// The surface, each chart at the density that it has.
    Surface,
    /// The uploaded layout, so that its texture is disturbed least.
    Uploaded,
}

/// How charts are cut.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(as = BoundedCuts)]
pub enum Cuts {
    /// Straight through faces: boxes about the parts are as full as can be.
    Straight,
    /// Along edges.
    Edges,
}

/// How divisions are searched for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(as = BoundedSearch)]
pub enum Search {
    /// The shortest cuts with which the bound can be met; corners may stay uncut.
    Default,
    /// Random motorcycle graphs by the published score (section 3.2, eq. 11): all parts are rectangles.
    Paper,
}
