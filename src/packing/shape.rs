//! Pieces at one resolution: each allowed orientation as a mask and a probe.

use std::sync::Arc;

use glam::{DMat2, DVec2};
use rayon::prelude::*;

use super::greedy::Spot;
use super::mask::Mask;
use super::occupancy::{Pitch, Probe};
use super::orientation::Orientation;
use super::outline::Outline;
use super::tuning::Tuning;
use super::{Piece, Spacing};
use crate::atlas::bvh::Bounds;

/// One piece in one orientation at one resolution.
#[derive(Debug, Clone)]
pub(crate) struct Shape {
    /// Cells that the piece owns.
    pub mask: Mask,
    /// The owned cells and the gutter around them.
    pub probe: Probe,
    /// What is subtracted from turned coordinates (texels) so that the mask's corner is the origin.
    pub anchor: DVec2,
    /// Rotation, mirror and scale.
    pub linear: DMat2,
    /// Cells owned.
    pub cells: usize,
}

/// All shapes of all pieces at one cell size.
#[derive(Debug)]
pub(crate) struct Shapes {
    /// Texels per cell.
    pub cell: f64,
    /// Gutter in cells.
    pub gutter: usize,
    /// By piece, by orientation. Shared, so that a search that changes few pieces keeps the others.
    pub of_piece: Vec<Arc<Vec<Shape>>>,
    /// How sheets of this resolution lie in memory.
    pub pitch: Pitch,
}

impl Shapes {
    /// Rasterises every piece in every orientation, scaled by `scale`, for strips up to `widest` texels wide.
    pub fn new(
        pieces: &[Piece],
        outlines: &[Outline],
        orientations: &[Vec<Orientation>],
        cell: f64,
        scale: f64,
        spacing: &Spacing,
        widest: f64,
    ) -> Self {
        let (gutter, stride) = (spacing.gutter_cells(cell), spacing.stride(cell));
        let spread = stride > 1 || Tuning::of(pieces.len()).spreads_probes;
        let masks: Vec<Vec<(Mask, DVec2, DMat2)>> = pieces
            .par_iter()
            .zip(outlines)
            .zip(orientations)
            .map(|((piece, outline), own)| {
                // What is resampled need not keep whole texels.
                let lattice = (spacing.lattice.is_some() && !piece.free).then_some(stride);
                let raster = |o: &Orientation| {
                    let linear = o.matrix() * scale;
                    let (mask, anchor) = outline.raster(linear, cell, lattice);
                    (mask, anchor, linear)
                };
                own.par_iter().map(raster).collect()
            })
            .collect();
        let longest_run = masks.iter().flatten().map(|(mask, ..)| mask.width + 2 * gutter).max().unwrap_or(1);
        let pitch = Pitch::new((widest / cell).ceil() as usize + 2 * gutter + 1, longest_run, stride);
        let of_piece = masks
            .into_par_iter()
            .map(|own| {
                let shape = |(mask, anchor, linear): (Mask, DVec2, DMat2)| {
                    let probe = Probe::new(&mask.dilated(gutter), pitch, spread);
                    Shape { cells: mask.count(), mask, probe, anchor, linear }
                };
                Arc::new(own.into_par_iter().map(shape).collect())
            })
            .collect();
        Shapes { cell, gutter, of_piece, pitch }
    }

    /// A piece as it lies at a spot.
    pub fn at(&self, piece: usize, spot: Spot) -> &Shape {
        &self.of_piece[piece][spot.orientation as usize]
    }

    /// One past the highest row of a piece at a spot.
    pub fn top(&self, piece: usize, spot: Spot) -> usize {
        spot.y as usize + self.at(piece, spot).mask.height
    }
}

/// Where the mask of a piece with these bounds starts (texels), and its sides in cells.
pub(super) fn frame(bounds: Bounds, cell: f64, stride: Option<usize>) -> (DVec2, [usize; 2]) {
    let Bounds { min: low, max: high } = bounds;
    // On the lattice the mask starts at a multiple of it, so that whole steps stay whole; elsewhere a hair before
    // the piece, so that no cell is wasted.
    let anchor = match stride {
        Some(stride) => {
            let step = cell * stride as f64;
            (low / step).floor() * step
        }
        None => low - DVec2::splat(2e-3 * cell),
    };
    let extent = (high - anchor) / cell + DVec2::splat(if stride.is_some() { 0.0 } else { 2e-3 });
    let size = |x: f64| if (x - x.round()).abs() < 1e-9 { x.round().max(1.0) } else { (x + 1e-3).floor() + 1.0 };
    (anchor, [size(extent.x) as usize, size(extent.y) as usize])
}
