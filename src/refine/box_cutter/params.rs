//! Every parameter of Box Cutter, with unit, range, default and source.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Parameters of the stage `box_cutter`. Sections are those of Limper, Vining and Sheffer 2018.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct BoxCutter {
    /// Longest UV border after cutting, relative to the border of the atlas once it is free of overlaps, 1..=100; null is no limit (section 3.2.2;
    /// the paper reports 1.3, 1.5 and 2).
    #[schema(minimum = 1, maximum = 100)]
    pub max_boundary_length: Option<f64>,
    /// Stops as soon as the packing efficiency is at least this, 0..=1; null is never (section 3).
    #[schema(minimum = 0, maximum = 1)]
    pub target_packing_efficiency: Option<f64>,
    /// Most charts, 1..=1000000; null is no limit (section 3).
    #[schema(minimum = 1, maximum = 1000000)]
    pub max_charts: Option<u32>,
    /// How cuts run: straight through triangles, along edges, or straight where that loses nothing (section 3.2).
    pub cuts: Cuts,
    /// Smallest extent of a new chart across the cut, relative to the longest side of the input's bounding box, 0..=1 (section 3.2.2: 0.01).
    #[schema(minimum = 0, maximum = 1)]
    pub min_extent: f64,
    /// How cuts are searched for.
    pub search: Search,
    /// Void boxes that offer candidates, globally and again locally, 1..=64 (n of section 3.2: 4).
    #[schema(minimum = 1, maximum = 64)]
    pub void_boxes: u32,
    /// Fraction of a void box that a larger one may share, 0..=1 (section 3.2: 0.1).
    #[schema(minimum = 0, maximum = 1)]
    pub void_overlap: f64,
    /// How far a cut line may shift to become shorter, relative to the box that it crosses, 0..=0.5 (section 3.2: 0.05).
    #[schema(minimum = 0, maximum = 0.5)]
    pub line_shift: f64,
    /// Exponent of the boundary length in the score p / b^alpha, 0..=4 (section 3.2: 0.2).
    #[schema(minimum = 0, maximum = 4)]
    pub alpha: f64,
    /// Gain in packing efficiency that counts as an improvement, 0..=1 (section 3; not published).
    #[schema(minimum = 0, maximum = 1)]
    pub min_improvement: f64,
    /// Attempts without improvement after which the search ends, 1..=1000 (section 3; not published).
    #[schema(minimum = 1, maximum = 1000)]
    pub patience: u32,
    /// States that `search: "beam"` goes on from at each step, 1..=64.
    #[schema(minimum = 1, maximum = 64)]
    pub beam: u32,
    /// Whether charts that overlap themselves are cut until they do not (section 4.1).
    pub remove_overlaps: bool,
    /// Whether charts are welded along seams across which the layout is continuous (section 4.2).
    pub weld: bool,
    /// Packing efficiency that welding may cost, 0..=1 (section 4.2: 0.1).
    #[schema(minimum = 0, maximum = 1)]
    pub weld_loss: f64,
}

impl Default for BoxCutter {
    fn default() -> Self {
        BoxCutter {
            max_boundary_length: Some(1.5),
            target_packing_efficiency: None,
            max_charts: None,
            cuts: Cuts::Auto,
            min_extent: 0.01,
            search: Search::Beam,
            void_boxes: 4,
            void_overlap: 0.1,
            line_shift: 0.05,
            alpha: 0.2,
            min_improvement: 0.001,
            patience: 4,
            beam: 6,
            remove_overlaps: true,
            weld: true,
            weld_loss: 0.1,
        }
    }
}

/// How cuts run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Cuts {
    /// Straight; along edges where the model is skinned or morphed.
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
