//! Every parameter of Texture Defragmentation, with unit, range, default and source.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Parameters of the stage `defrag`. Sections are those of Maggiordomo, Cignoni and Tarini 2021.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Defrag {
    /// How far around a seam triangles may be deformed, in displacements of the seam's vertices, 0..=100 (alpha of section 4.2.2: 5).
    #[schema(minimum = 0, maximum = 100)]
    pub alpha: f64,
    /// Largest mean of (s1 - 1)^2 + (s2 - 1)^2 over the triangles that one merge deforms, 0..=10 (section 5: 0.5).
    #[schema(minimum = 0, maximum = 10)]
    pub max_local_energy: f64,
    /// The same over the whole atlas, 0..=10 (section 5: 0.025).
    #[schema(minimum = 0, maximum = 10)]
    pub max_global_energy: f64,
    /// Largest mean distance of the two sides of a seam after alignment, in lengths of the seam, 0..=100 (section 5: 2).
    #[schema(minimum = 0, maximum = 100)]
    pub max_misalignment: f64,
    /// Two charts are merged only if that removes this part of the border of one of them, 0..=1 (section 5: 0.2).
    #[schema(minimum = 0, maximum = 1)]
    pub min_benefit: f64,
    /// How much of the surface may be resampled, as a fraction of its area, 0..=1: 0 merges only what needs no resampling, 1 leaves the
    /// fewest seams.
    #[schema(minimum = 0, maximum = 1)]
    pub max_resampled: f64,
    /// How merges are chosen.
    pub search: Search,
    /// What ranks the operations (section 4.3; the others are those of Table 1).
    pub appeal: Appeal,
    /// Whether operations that failed are tried again when their charts have changed (section 4.4).
    pub retry: bool,
    /// Texels, squared: islands smaller than this are joined to a neighbour whatever becomes of their shape, 0..=1000000. Not with `search: "paper"`.
    #[schema(minimum = 0, maximum = 1000000)]
    pub island_area: f64,
    /// Part of a chart's 3D area that must keep its texels for the chart to be placed so that it does, 0..=1 (section 4.5: 0.05).
    #[schema(minimum = 0, maximum = 1)]
    pub min_preserved: f64,
}

impl Default for Defrag {
    fn default() -> Self {
        Defrag {
            alpha: 5.0,
            max_local_energy: 0.5,
            max_global_energy: 0.025,
            max_misalignment: 2.0,
            min_benefit: 0.2,
            max_resampled: 1.0,
            search: Search::Partial,
            appeal: Appeal::Full,
            retry: true,
            island_area: 256.0,
            min_preserved: 0.05,
        }
    }
}

/// How merges are chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Search {
    /// Where a whole seam cannot be dissolved, parts of it are; charts that keep their texels are not deformed where the other side
    /// can be.
    Partial,
    /// The published loop: whole seams, averaged.
    Paper,
}

/// What ranks the operations.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Appeal {
    /// Benefit / cost, small charts first, failures later (eq. 5).
    Full,
    /// Without benefit and cost.
    NoBenefitCost,
    /// Without the bonus of small charts.
    NoSizeBonus,
    /// By chance.
    Random,
}
