//! Charts that share texels on purpose are left alone.

use crate::atlas::{Charts, OverlapMode, clusters};
use crate::refine::stage::{self, StageInput};

/// Which charts may be merged.
pub(super) struct Mergeable {
    pub charts: Vec<bool>,
    /// Part of the UV area that is not.
    pub held_back: f64,
}

impl Mergeable {
    /// Those that share no texels with others; a warning tells of the rest, where that is not what the user asked for.
    pub(super) fn new(input: &StageInput<'_>, charts: &Charts) -> Self {
        let StageInput { atlas, options, context, .. } = *input;
        let together = clusters(atlas, charts, options.atlas.overlaps);
        let alone: Vec<bool> =
            charts.ids().map(|c| together.charts[together.of_chart[c.index()] as usize].len() == 1).collect();
        let (mut held, mut all) = (0.0, 0.0);
        for face in atlas.faces() {
            let area = atlas.uv_area(face).abs();
            all += area;
            if !alone[charts.of_face[face.index()].index()] {
                held += area;
            }
        }
        let held_back = held / f64::max(all, 1e-300);
        if held_back > 0.0 && options.atlas.overlaps == OverlapMode::Stack {
            context.warn(stage::held_back(input, held_back, "layout", "merged"));
        }
        Mergeable { charts: alone, held_back }
    }
}
