//! Places charts on sheets. Knows polygons and texels; neither glTF nor images.
//!
//! Pieces are rasterised conservatively in each allowed orientation; a greedy construction puts them, large to
//! small, at the best of *all* free positions of a strip (Box Cutter, section 3.3), which bit-parallel occupancy makes
//! cheap enough to search over orders, widths and rules at a coarse resolution; the best plans are built again at a fine one and
//! compacted there. The thorough search goes on from the best plans by guided local search over overlaps (`guided`).

mod bits;
mod fit;
mod greedy;
mod guided;
mod mask;
mod occupancy;
mod options;
mod orientation;
mod outline;
mod random;
mod rectangles;
mod search;
mod shape;
mod sheet;
#[cfg(test)]
mod tests;
mod tuning;

use glam::DVec2;

use crate::atlas::Move;
use crate::atlas::bvh::Bounds;
pub use fit::{Fitted, pack_into};
pub(crate) use greedy::{Plan, StripLayout, greedy};
pub use guided::InitialLayout;
pub(crate) use mask::Mask;
pub(crate) use occupancy::{Pitch, Probe};
pub use options::{Grid, Gutter, Pack, PackSearch, Rotation};
pub use orientation::Orientation;
pub(crate) use orientation::{l1_norm, quarter_turns};
pub(crate) use outline::fill;
pub(crate) use random::Random;
pub(crate) use rectangles::{RectanglePacker, RectangleRequest};
pub(crate) use search::RULES;
pub use search::pack;
pub(crate) use shape::{Shape, Shapes};

/// What is placed as one: a chart, or a cluster of charts. Coordinates in reference texels.
#[derive(Debug, Clone, Default)]
pub struct Piece {
    /// UV triangles.
    pub triangles: Vec<[DVec2; 3]>,
    /// Border edges as vectors, for the choice of axes.
    pub border: Vec<DVec2>,
    /// Area covered, in square texels.
    pub area: f64,
    /// Whether its texels are resampled anyway, so that it may be turned by any angle even where the request allows quarter turns only;
    /// where no rotation is allowed it is not turned either.
    pub free: bool,
    /// Whether it may be turned by a half only, and not at all where no rotation is allowed.
    pub half_turns: bool,
}

impl Piece {
    /// Diagonal of the bounding box, in texels.
    fn diagonal(&self) -> f64 {
        Bounds::of(self.triangles.iter().flatten()).or_zero().size().length()
    }
}

/// Distances that placement keeps, in reference texels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spacing {
    /// Free texels between two pieces.
    pub gutter: f64,
    /// Free texels at the sheet's edge.
    pub margin: f64,
    /// Pieces move by multiples of this (`unit` times a power of two up to 64), or anyhow.
    pub lattice: Option<f64>,
    /// The smallest cell, usually a texel of the smallest slot: gutters are counted in whole cells. Ignored where nothing must keep
    /// whole texels (`lattice` is null and `gutter` is 0).
    pub unit: f64,
}

impl Spacing {
    /// The gutter in cells.
    fn gutter_cells(&self, cell: f64) -> usize {
        (self.gutter / cell - 1e-9).ceil().max(0.0) as usize
    }

    /// Positions are multiples of this many cells. On whole texels the lattice is the user's; finer cells than the lattice keep
    /// positions on it.
    fn stride(&self, cell: f64) -> usize {
        self.lattice.map_or(1, |l| ((l / cell).round() as usize).max(1))
    }
}

/// What is asked of a packing.
#[derive(Debug, Clone)]
pub struct Request<'a> {
    /// The pieces.
    pub pieces: &'a [Piece],
    /// Rotations that are allowed.
    pub rotation: Rotation,
    /// Whether pieces may be mirrored.
    pub mirror: bool,
    /// Distances.
    pub spacing: Spacing,
    /// Width / height, or free.
    pub aspect: Option<f64>,
    /// Longest sides of a sheet in texels (width, height).
    pub max: [f64; 2],
    /// Rounds the sides that a sheet must have (texels) to those that it may have.
    pub round: Rounding,
    /// Factor on all pieces.
    pub scale: f64,
    /// How hard to search.
    pub search: PackSearch,
    /// Words of occupancy that the search may look at; `None` is the search's own default.
    pub work_budget: Option<u64>,
    /// Layouts to start from; where there are any, the thorough search begins there and nowhere else.
    pub starts: &'a [InitialLayout],
    /// Multiplies the budget; 1 is the default.
    pub effort: f64,
}

/// Which sheet sides are allowed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Rounding {
    /// Any: only the bounding box counts.
    Free,
    /// Multiples of this many texels.
    MultipleOf(f64),
    /// Powers of two that are multiples of this many texels.
    PowerOfTwo(f64),
}

impl Rounding {
    /// The smallest allowed side that holds `side` texels.
    pub fn up(self, side: f64) -> f64 {
        let multiple = |m: f64| (side / m - 1e-9).ceil().max(1.0) * m;
        match self {
            Rounding::Free => side,
            Rounding::MultipleOf(m) => multiple(m),
            Rounding::PowerOfTwo(m) => {
                let mut power = 1.0;
                while power < multiple(m) {
                    power *= 2.0;
                }
                power
            }
        }
    }
}

/// A packing of all pieces.
#[derive(Debug, Clone, PartialEq)]
pub struct Packing {
    /// By piece.
    pub placements: Vec<Move>,
    /// Sides of each sheet in texels, margins included, rounded as asked.
    pub sheets: Vec<[f64; 2]>,
    /// Words of occupancy looked at: the unit of work.
    pub work: u64,
}
