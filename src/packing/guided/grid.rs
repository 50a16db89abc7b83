//! The grid of one level of the local search.

use crate::packing::Request;

/// The cells of one level of the search.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Grid {
    /// Texels per cell.
    pub cell: f64,
    /// Free cells between two pieces.
    pub gutter: usize,
    /// Positions are multiples of this many cells.
    pub stride: usize,
    /// Whether masks start on the lattice.
    pub on_lattice: bool,
    /// Cells along the side of a block of the coarse scan.
    pub block: usize,
    /// Factor on all pieces.
    pub scale: f64,
}

impl Grid {
    /// The grid with this cell, as the pieces of a greedy search have it.
    pub fn new(request: &Request<'_>, cell: f64, block: usize) -> Self {
        let spacing = &request.spacing;
        Grid {
            cell,
            gutter: spacing.gutter_cells(cell),
            stride: spacing.stride(cell),
            on_lattice: spacing.lattice.is_some(),
            block,
            scale: request.scale,
        }
    }

    /// The multiple of the stride at or below `x`.
    pub fn snap(&self, x: i32) -> i32 {
        x - x.rem_euclid(self.stride as i32)
    }
}

/// Consecutive cells of a row, relative to the piece's corner.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Run {
    pub row: i32,
    pub first: i32,
    /// One past the last cell.
    pub end: i32,
}
