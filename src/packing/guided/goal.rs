//! What makes a box of cells good, and which box to try next.

use crate::packing::random::Random;
use crate::packing::{Request, Rounding};

/// The cost of boxes of cells.
#[derive(Debug, Clone, Copy)]
pub(super) struct Goal {
    cell: f64,
    margin: f64,
    aspect: Option<f64>,
    round: Rounding,
    /// Longest sides in cells.
    max: [i32; 2],
    /// Cells that the pieces own between them: no box is smaller.
    least: f64,
}

impl Goal {
    pub fn new(request: &Request<'_>, cell: f64, least: f64) -> Self {
        let margin = 2.0 * request.spacing.margin;
        let max = request.max.map(|m| ((m - margin) / cell + 1e-9).floor().clamp(0.0, 1e9) as i32);
        Goal { cell, margin, aspect: request.aspect, round: request.round, max, least }
    }

    fn side(&self, cells: i32) -> f64 {
        f64::from(cells) * self.cell + self.margin
    }

    /// Sides in texels of the sheet that holds a box of cells.
    pub fn sheet(&self, width: i32, height: i32) -> [f64; 2] {
        let (mut w, mut h) = (self.side(width), self.side(height));
        if let Some(aspect) = self.aspect {
            (w, h) = (w.max(h * aspect), h.max(w / aspect));
        }
        [self.round.up(w), self.round.up(h)]
    }

    /// Area of the sheet; among sheets of equal size the emptier one is better.
    pub fn cost(&self, width: i32, height: i32) -> f64 {
        if width > self.max[0] || height > self.max[1] {
            return f64::INFINITY;
        }
        let [w, h] = self.sheet(width, height);
        w * h + 1e-6 * f64::from(width) * f64::from(height) * self.cell * self.cell
    }

    /// The largest allowed side at or below `side` texels.
    fn down(&self, side: f64) -> f64 {
        match self.round {
            Rounding::Free => side,
            Rounding::MultipleOf(m) => (side / m + 1e-9).floor() * m,
            Rounding::PowerOfTwo(_) => {
                let up = self.round.up(side.max(1.0));
                if up > side * (1.0 + 1e-9) { up / 2.0 } else { up }
            }
        }
    }

    fn cells(&self, side: f64, axis: usize) -> i32 {
        (((side - self.margin) / self.cell + 1e-9).floor().clamp(0.0, 1e9) as i32).min(self.max[axis])
    }

    /// A box whose sheet is smaller than this one's by the fraction `step`, or by the least that the rounding of sides allows: narrower, lower,
    /// both, or of another aspect. `None` where the pieces cannot fit.
    pub fn shrink(&self, width: i32, height: i32, step: f64, drift: f64, random: &mut Random) -> Option<(i32, i32)> {
        let [w, h] = self.sheet(width, height);
        let area = w * h * (1.0 - step);
        let (w, h) = if let Some(aspect) = self.aspect {
            let high = self.down((area / aspect).sqrt());
            (self.down(high * aspect), high)
        } else {
            let wide = match random.below(4) {
                0 => w,
                1 => w * (1.0 - step),
                2 => w * (1.0 - step).sqrt(),
                _ => w * ((random.unit() + random.unit() - 1.0) * drift).exp(),
            };
            if random.below(2) == 0 || self.round == Rounding::Free {
                let wide = self.round.up(wide);
                (wide, self.down(area / wide))
            } else {
                let high = self.round.up(area / wide);
                (self.down(area / high), high)
            }
        };
        let mut next = (self.cells(w, 0), self.cells(h, 1));
        if next.0 >= width && next.1 >= height {
            next = if random.below(2) == 0 { (width - 1, height) } else { (width, height - 1) };
        }
        let room = f64::from(next.0) * f64::from(next.1);
        (next.0 > 0 && next.1 > 0 && room > self.least).then_some(next)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shrunk_box_costs_less() {
        let mut random = Random::new(1);
        for round in [Rounding::Free, Rounding::MultipleOf(4.0), Rounding::PowerOfTwo(4.0)] {
            for aspect in [None, Some(1.0), Some(2.0)] {
                let goal = Goal { cell: 1.0, margin: 2.0, aspect, round, max: [4000; 2], least: 1.0 };
                let mut shrunk = 0;
                for _ in 0..300 {
                    let (w, h) = (20 + random.below(500) as i32, 20 + random.below(500) as i32);
                    if let Some((a, b)) = goal.shrink(w, h, 0.01, 0.2, &mut random) {
                        assert!(goal.cost(a, b) < goal.cost(w, h), "{round:?} {aspect:?} {w}x{h} -> {a}x{b}");
                        shrunk += 1;
                    }
                }
                assert!(shrunk > 0, "{round:?} {aspect:?}: no box was made smaller");
            }
        }
    }
}
