//! Every parameter of Box Cutter, with unit, range, default and source.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::error::Result;
use crate::params::params;
use crate::refine::stage::{Stage, StageInput, Staged};

params! {
    /// Parameters of the stage `box_cutter`. Sections are those of Limper, Vining and Sheffer 2018.
    pub struct BoxCutter {
        /// Longest UV border after cutting, relative to the border of the atlas once it is free of overlaps; null is no limit (section 3.2.2;
        /// the paper reports 1.3, 1.5 and 2).
        pub max_boundary_length: Option<f64> = Some(1.5), in 1..=100;
        /// Stops as soon as the packing efficiency is at least this; null is never (section 3).
        pub target_packing_efficiency: Option<f64> = None, in 0..=1;
        /// Most charts; null is no limit (section 3).
        pub max_charts: Option<u32> = None, in 1..=1000000;
        /// How cuts run: straight through triangles, along edges, or straight where that loses nothing (section 3.2).
        pub cuts: Cuts = Cuts::Auto;
        /// Smallest extent of a new chart across the cut, relative to the longest side of the input's bounding box (section 3.2.2: 0.01).
        pub min_extent: f64 = 0.01, in 0..=1;
        /// How cuts are searched for.
        pub search: Search = Search::Beam;
        /// Void boxes that offer candidates, globally and again locally (n of section 3.2: 4).
        pub void_boxes: u32 = 4, in 1..=64;
        /// Fraction of a void box that a larger one may share (section 3.2: 0.1).
        pub void_overlap: f64 = 0.1, in 0..=1;
        /// How far a cut line may shift to become shorter, relative to the box that it crosses (section 3.2: 0.05).
        pub line_shift: f64 = 0.05, in 0..=0.5;
        /// Exponent of the boundary length in the score p / b^alpha (section 3.2: 0.2).
        pub alpha: f64 = 0.2, in 0..=4;
        /// Gain in packing efficiency that counts as an improvement (section 3; not published).
        pub min_improvement: f64 = 0.001, in 0..=1;
        /// Attempts without improvement after which the search ends (section 3; not published).
        pub patience: u32 = 4, in 1..=1000;
        /// States that `search: "beam"` goes on from at each step.
        pub beam: u32 = 6, in 1..=64;
        /// Whether charts that overlap themselves are cut until they do not (section 4.1).
        pub remove_overlaps: bool = true;
        /// Whether charts are welded along seams across which the layout is continuous (section 4.2).
        pub weld: bool = true;
        /// Packing efficiency that welding may cost (section 4.2: 0.1).
        pub weld_loss: f64 = 0.1, in 0..=1;
    }
}

impl Stage for BoxCutter {
    const NAME: &'static str = "box_cutter";
    const DESCRIPTION: &'static str =
        "Removes overlaps, then cuts charts where that lets them pack better, within a budget of boundary length.";
    const WEIGHT: f64 = 8.0;

    fn run(&self, input: &StageInput<'_>) -> Result<Staged> {
        let weights = input.corner_weights();
        super::box_cutter(input, weights.as_deref(), self)
    }
}

/// How cuts run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Cuts {
    /// Straight; along edges where the model is skinned or morphed, or lies so far from the origin that 32 bits hold no points between its vertices.
    Auto,
    /// Straight lines through triangles, which are split.
    Straight,
    /// Shortest paths along edges: no triangle is split.
    Edges,
}

/// How cuts are searched for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(as = CutSearch)]
pub enum Search {
    /// Several of the best states are carried on at each step.
    Beam,
    /// The published loop: the best candidate of each step is kept (section 3.2).
    Paper,
    /// The published loop with random lines instead of void boxes: the experiment of section 5.
    Random,
}
