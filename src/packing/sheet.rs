//! The sheet that holds a box of cells, and what it costs.

use super::{Request, Rounding};

/// The objective of every search: the area of the sheet.
#[derive(Debug, Clone, Copy)]
pub(super) struct SheetObjective {
    /// Texels per cell.
    pub cell: f64,
    /// Texels that both margins of a side take.
    pub margins: f64,
    /// Width / height, or free.
    pub aspect: Option<f64>,
    /// Which sides are allowed.
    pub round: Rounding,
}

impl SheetObjective {
    pub fn new(request: &Request<'_>, cell: f64) -> Self {
        let margins = 2.0 * request.spacing.margin;
        SheetObjective { cell, margins, aspect: request.aspect, round: request.round }
    }

    /// Sides in texels of the sheet that holds a box of `width` x `height` cells.
    pub fn sides(&self, width: f64, height: f64) -> [f64; 2] {
        let (mut w, mut h) = (width * self.cell + self.margins, height * self.cell + self.margins);
        if let Some(aspect) = self.aspect {
            (w, h) = (w.max(h * aspect), h.max(w / aspect));
        }
        [self.round.up(w), self.round.up(h)]
    }

    /// Area of that sheet; among sheets of equal size the emptier one is better.
    pub fn cost(&self, width: f64, height: f64) -> f64 {
        let [w, h] = self.sides(width, height);
        w * h + 1e-6 * (width * height) * self.cell * self.cell
    }

    /// The height in cells at which a box so wide costs `cost`.
    pub fn height_at(&self, cost: f64, width: f64) -> usize {
        let height = match self.aspect {
            Some(aspect) => (cost / aspect).sqrt(),
            None => cost / self.round.up(width * self.cell + self.margins),
        };
        ((height - self.margins) / self.cell).ceil().max(1.0) as usize
    }

    /// Whole cells along a side of so many texels, margins included.
    pub fn cells(&self, side: f64) -> f64 {
        ((side - self.margins) / self.cell + 1e-9).floor().max(0.0)
    }
}
