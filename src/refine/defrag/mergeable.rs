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
        let StageInput { atlas, sheet_info, options, context, .. } = *input;
        let together = clusters(atlas, charts, options.atlas.overlaps);
        let held_charts = input.held_back(charts, &together);
        let (mut held, mut all) = (0.0, 0.0);
        for face in atlas.faces() {
            let area = atlas.uv_area(face).abs();
            all += area;
            if held_charts[charts.of_face[face.index()].index()] {
                held += area;
            }
        }
        let held_back = held / f64::max(all, 1e-300);
        let asked_for = options.atlas.overlaps == OverlapMode::Separate && sheet_info.half_turns.is_empty();
        if held_back > 0.0 && !asked_for {
            context.warn(stage::held_back_warning(input, held_back, "layout", "merged"));
        }
        Mergeable { charts: held_charts.into_iter().map(|held| !held).collect(), held_back }
    }
}
