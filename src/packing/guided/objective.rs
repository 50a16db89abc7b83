//! Which container the local search tries next, and what one costs.

use crate::packing::random::Random;
use crate::packing::sheet::SheetObjective;
use crate::packing::{Request, Rounding};

/// The cost of containers of cells.
#[derive(Debug, Clone, Copy)]
pub(super) struct Objective {
    sheet: SheetObjective,
    /// Longest sides in cells.
    max: [i32; 2],
    /// Cells that the pieces own between them: no container is smaller.
    least: f64,
}

impl Objective {
    pub fn new(request: &Request<'_>, cell: f64, least: f64) -> Self {
        let sheet = SheetObjective::new(request, cell);
        Objective { sheet, max: request.max.map(|side| sheet.cells(side).min(1e9) as i32), least }
    }

    /// Sides in texels of the sheet that holds a container.
    pub fn sheet(&self, width: i32, height: i32) -> [f64; 2] {
        self.sheet.sides(f64::from(width), f64::from(height))
    }

    /// What that sheet costs; infinite where it is too long.
    pub fn cost(&self, width: i32, height: i32) -> f64 {
        if width > self.max[0] || height > self.max[1] {
            return f64::INFINITY;
        }
        self.sheet.cost(f64::from(width), f64::from(height))
    }

    /// The largest allowed side at or below `side` texels.
    fn down(&self, side: f64) -> f64 {
        match self.sheet.round {
            Rounding::Free => side,
            Rounding::MultipleOf(m) => (side / m + 1e-9).floor() * m,
            Rounding::PowerOfTwo(_) => {
                let up = self.sheet.round.up(side.max(1.0));
                if up > side * (1.0 + 1e-9) { up / 2.0 } else { up }
            }
        }
    }

    fn cells(&self, side: f64, axis: usize) -> i32 {
        (self.sheet.cells(side).min(1e9) as i32).min(self.max[axis])
    }

    /// A container whose sheet is smaller than this one's by the fraction `step`, or by the least that the rounding of sides allows:
    /// narrower, lower, both, or of another aspect (by up to `drift`, natural logarithm). `None` where the pieces cannot fit.
    pub fn shrink(&self, width: i32, height: i32, step: f64, drift: f64, random: &mut Random) -> Option<(i32, i32)> {
        let [w, h] = self.sheet(width, height);
        let SheetObjective { aspect, round, .. } = self.sheet;
        let area = w * h * (1.0 - step);
        let (w, h) = if let Some(aspect) = aspect {
            let high = self.down((area / aspect).sqrt());
            (self.down(high * aspect), high)
        } else {
            let wide = match random.below(4) {
                0 => w,
                1 => w * (1.0 - step),
                2 => w * (1.0 - step).sqrt(),
                _ => w * ((random.unit() + random.unit() - 1.0) * drift).exp(),
            };
            if random.below(2) == 0 || round == Rounding::Free {
                let wide = round.up(wide);
                (wide, self.down(area / wide))
            } else {
                let high = round.up(area / wide);
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
    fn a_shrunk_container_costs_less() {
        let mut random = Random::new(1);
        for round in [Rounding::Free, Rounding::MultipleOf(4.0), Rounding::PowerOfTwo(4.0)] {
            for aspect in [None, Some(1.0), Some(2.0)] {
                let sheet = SheetObjective { cell: 1.0, margins: 2.0, aspect, round };
                let objective = Objective { sheet, max: [4000; 2], least: 1.0 };
                let mut shrunk = 0;
                for _ in 0..300 {
                    let (w, h) = (20 + random.below(500) as i32, 20 + random.below(500) as i32);
                    if let Some((a, b)) = objective.shrink(w, h, 0.01, 0.2, &mut random) {
                        let smaller = objective.cost(a, b) < objective.cost(w, h);
                        assert!(smaller, "{round:?} {aspect:?} {w}x{h} -> {a}x{b}");
                        shrunk += 1;
                    }
                }
                assert!(shrunk > 0, "{round:?} {aspect:?}: no box was made smaller");
            }
        }
    }
}
