//! Every parameter of Texture Defragmentation, with unit, range, default and source.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Parameters of the stage `defrag`. Sections are those of Maggiordomo, Cignoni and Tarini 2021.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Defrag {
    /// How far around a seam triangles may be deformed, in displacements of the seam's vertices, 0..=100; null is 5 with `search: "paper"`
    /// (alpha of section 4.2.2), else 3: with partial merges that leaves fewer seams and more texels whole.
    #[schema(minimum = 0, maximum = 100)]
    pub alpha: Option<f64>,
    /// Largest mean of (s1 - 1)^2 + (s2 - 1)^2 over the triangles that one merge deforms, 0..=10; null is 0.5 with `search: "paper"`
    /// (section 5), else 1.
    #[schema(minimum = 0, maximum = 10)]
    pub max_local_energy: Option<f64>,
    /// The same over the whole atlas, 0..=10; null is 0.025 with `search: "paper"` (section 5), else 0.05.
    #[schema(minimum = 0, maximum = 10)]
    pub max_global_energy: Option<f64>,
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
    /// The most of the surface that a merge may cause to be resampled, per part of all seams that it removes, 0..=1000000: merges that
    /// turn much to remove little are not made. Not with `search: "paper"`.
    #[schema(minimum = 0, maximum = 1000000)]
    pub resampling_rate: f64,
    /// How merges are chosen.
    pub search: Search,
    /// What ranks the operations (section 4.3; the others are those of Table 1).
    pub appeal: Appeal,
    /// Whether operations that failed are tried again when their charts have changed (section 4.4).
    pub retry: bool,
    /// Texels, squared: islands smaller than this are joined to a neighbour whatever becomes of their shape, 0..=1000000. Not with `search: "paper"`.
    #[schema(minimum = 0, maximum = 1000000)]
    pub island_area: f64,
    /// Part of a chart's 3D area that must keep its texels for the chart to be placed so that it does, 0..=1 (section 4.5; there 0.05).
    #[schema(minimum = 0, maximum = 1)]
    pub min_preserved: f64,
}

impl Default for Defrag {
    fn default() -> Self {
        Defrag {
            alpha: None,
            max_local_energy: None,
            max_global_energy: None,
            max_misalignment: 2.0,
            min_benefit: 0.2,
            max_resampled: 1.0,
            resampling_rate: 9.0,
            search: Search::Partial,
            appeal: Appeal::Full,
            retry: true,
            island_area: 256.0,
            min_preserved: 0.15,
        }
    }
}

impl Defrag {
    /// See `alpha`.
    pub(super) fn alpha(&self) -> f64 {
        self.alpha.unwrap_or(self.published(5.0, 3.0))
    }

    /// See `max_local_energy`.
    pub(super) fn local_energy(&self) -> f64 {
        self.max_local_energy.unwrap_or(self.published(0.5, 1.0))
    }

    /// See `max_global_energy`.
    pub(super) fn global_energy(&self) -> f64 {
        self.max_global_energy.unwrap_or(self.published(0.025, 0.05))
    }

    fn published(&self, paper: f64, own: f64) -> f64 {
        if self.search == Search::Paper { paper } else { own }
    }
}

/// How merges are chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(as = MergeSearch)]
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
