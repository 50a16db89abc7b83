//! Every parameter of Texture Defragmentation, with unit, range, default and source.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::error::Result;
use crate::params::params;
use crate::refine::stage::{Stage, StageInput, Staged};

params! {
    /// Parameters of the stage `defrag`. Sections are those of Maggiordomo, Cignoni and Tarini 2021.
    pub struct Defrag {
        /// How far around a seam triangles may be deformed, in displacements of the seam's vertices; null is 5 with `search: "paper"`
        /// (alpha of section 4.2.2), else 3: with partial merges that leaves fewer seams and more texels whole.
        pub alpha: Option<f64> = None, in 0..=100;
        /// Largest mean of (s1 - 1)^2 + (s2 - 1)^2 over the triangles that one merge deforms; null is 0.5 with `search: "paper"`
        /// (section 5), else 1.
        pub max_local_energy: Option<f64> = None, in 0..=10;
        /// The same over the whole atlas; null is 0.025 with `search: "paper"` (section 5), else 0.05.
        pub max_global_energy: Option<f64> = None, in 0..=10;
        /// Largest mean distance of the two sides of a seam after alignment, in lengths of the seam (section 5: 2).
        pub max_misalignment: f64 = 2.0, in 0..=100;
        /// Two charts are merged only if that removes this part of the border of one of them (section 5: 0.2).
        pub min_benefit: f64 = 0.2, in 0..=1;
        /// How much of the surface may be resampled, as a fraction of its area: 0 merges only what needs no resampling, 1 leaves the
        /// fewest seams.
        pub max_resampled: f64 = 1.0, in 0..=1;
        /// The most of the surface that a merge may cause to be resampled, per part of all seams that it removes: merges that
        /// turn much to remove little are not made. Not with `search: "paper"`.
        pub resampling_rate: f64 = 9.0, in 0..=1000000;
        /// How merges are chosen.
        pub search: Search = Search::Partial;
        /// What ranks the operations (section 4.3; the others are those of Table 1).
        pub appeal: Appeal = Appeal::Full;
        /// Whether operations that failed are tried again when their charts have changed (section 4.4).
        pub retry: bool = true;
        /// Texels, squared: islands smaller than this are joined to a neighbour whatever becomes of their shape. Not with `search: "paper"`.
        pub island_area: f64 = 256.0, in 0..=1000000;
        /// Part of a chart's 3D area that must keep its texels for the chart to be placed so that it does (section 4.5; there 0.05).
        pub min_preserved: f64 = 0.15, in 0..=1;
    }
}

impl Stage for Defrag {
    const NAME: &'static str = "defrag";
    const DESCRIPTION: &'static str =
        "Merges charts along their seams without resampling more than it must, then packs them.";
    const WEIGHT: f64 = 8.0;

    fn run(&self, input: &StageInput<'_>) -> Result<Staged> {
        super::defrag(input, self)
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
