//! What a piece would pay for its overlaps at each position of a window, all positions of a row at once.
//!
//! The other pieces are added up, each times its weight, into a grid of costs; with running sums by row, a run of the piece costs
//! two look-ups whatever its length, and neighbouring positions are independent lanes of the same arithmetic.

use super::grid::Run;

/// Costs of a rectangle of cells as running sums by row.
#[derive(Debug, Default)]
pub(super) struct CostGrid {
    /// The first cell.
    x: i32,
    y: i32,
    width: usize,
    height: usize,
    /// `height` rows of `width + 1` sums; before `sum_up`, the costs themselves, one place to the right.
    sums: Vec<i32>,
    row: Vec<f32>,
}

/// A position and what it costs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct CheapestPlace {
    pub cost: f32,
    pub x: i32,
    pub y: i32,
}

impl CostGrid {
    /// Clears the grid and sets it over the cells `x..x + width`, `y..y + height`.
    pub fn reset(&mut self, x: i32, y: i32, width: usize, height: usize) {
        (self.x, self.y, self.width, self.height) = (x, y, width, height);
        self.sums.clear();
        self.sums.resize((width + 1) * height, 0);
    }

    /// Adds a rectangle of costs with its corner at `(x, y)`, times `weight`, as far as it lies in the grid; gives the work.
    pub fn add<T: Copy + Into<i32>>(&mut self, costs: &[T], width: usize, x: i32, y: i32, weight: i32) -> u64 {
        let height = costs.len().checked_div(width).unwrap_or(0);
        let left = (self.x - x).max(0);
        let right = (self.x + self.width as i32 - x).min(width as i32);
        let top = (self.y - y).max(0);
        let bottom = (self.y + self.height as i32 - y).min(height as i32);
        if left >= right || top >= bottom {
            return 0;
        }
        let n = (right - left) as usize;
        for row in top..bottom {
            let from = &costs[row as usize * width + left as usize..][..n];
            let at = (y + row - self.y) as usize * (self.width + 1) + 1 + (x + left - self.x) as usize;
            for (sum, cost) in self.sums[at..at + n].iter_mut().zip(from) {
                *sum += weight * (*cost).into();
            }
        }
        n as u64 * (bottom - top) as u64
    }

    /// Ends the adding.
    pub fn sum_up(&mut self) {
        for line in self.sums.chunks_exact_mut(self.width + 1) {
            let mut sum = 0i32;
            for s in line {
                sum = sum.wrapping_add(*s);
                *s = sum;
            }
        }
    }

    /// The cheapest position of the runs' corner in `x.0..=x.1`, `y.0..=y.1`, `steps` apart, the first by rows among equals, if it
    /// costs less than `bound`; and the work done. The grid must hold the runs at all of these positions.
    pub fn cheapest(
        &mut self,
        runs: &[Run],
        x: (i32, i32),
        y: (i32, i32),
        steps: (usize, usize),
        bound: f32,
    ) -> (Option<CheapestPlace>, u64) {
        let mut best: Option<CheapestPlace> = None;
        let mut least = bound;
        let mut work = 0;
        if x.0 > x.1 || y.0 > y.1 {
            return (None, work);
        }
        let n = (x.1 - x.0 + 1) as usize;
        self.row.resize(n.max(self.row.len()), 0.0);
        let pitch = self.width + 1;
        for at in (y.0..=y.1).step_by(steps.1) {
            let row = &mut self.row[..n];
            row.fill(0.0);
            let mut done = 0;
            for chunk in runs.chunks(16) {
                for run in chunk {
                    let base = (at + run.row - self.y) as usize * pitch;
                    let first = base + (x.0 + run.first - self.x) as usize;
                    let end = base + (x.0 + run.end - self.x) as usize;
                    let (a, b) = (&self.sums[first..first + n], &self.sums[end..end + n]);
                    for ((sum, a), b) in row.iter_mut().zip(a).zip(b) {
                        *sum += b.wrapping_sub(*a) as f32;
                    }
                }
                done += chunk.len();
                if done < runs.len() && row.iter().step_by(steps.0).all(|c| *c >= least) {
                    break;
                }
            }
            work += (done * n) as u64;
            for (i, &cost) in row.iter().enumerate().step_by(steps.0) {
                if cost < least {
                    least = cost;
                    best = Some(CheapestPlace { cost, x: x.0 + i as i32, y: at });
                }
            }
            if least == 0.0 {
                break;
            }
        }
        (best, work)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::packing::random::Random;

    #[test]
    fn the_cheapest_position_is_the_one_that_adding_up_each_cell_finds() {
        let mut random = Random::new(4);
        let mut grid = CostGrid::default();
        for _ in 0..200 {
            let (w, h) = (10 + random.below(30), 10 + random.below(20));
            let (x0, y0) = (random.below(9) as i32 - 4, random.below(9) as i32 - 4);
            let mut plain = vec![0i32; w * h];
            grid.reset(x0, y0, w, h);
            for _ in 0..4 {
                let (pw, ph) = (1 + random.below(20), 1 + random.below(20));
                let costs: Vec<u8> = (0..pw * ph).map(|_| random.below(9) as u8).collect();
                let (px, py) = (random.below(40) as i32 - 15, random.below(40) as i32 - 15);
                let weight = 1 + random.below(5) as i32;
                grid.add(&costs, pw, px, py, weight);
                for (i, p) in costs.iter().enumerate() {
                    let (x, y) = (px + (i % pw) as i32 - x0, py + (i / pw) as i32 - y0);
                    if x >= 0 && y >= 0 && (x as usize) < w && (y as usize) < h {
                        plain[y as usize * w + x as usize] += weight * i32::from(*p);
                    }
                }
            }
            grid.sum_up();
            let runs: Vec<Run> = (0..3)
                .map(|row| {
                    let first = random.below(4) as i32;
                    Run { row, first, end: first + 1 + random.below(3) as i32 }
                })
                .collect();
            let stride = 1 + random.below(2);
            let (xs, ys) = ((x0, x0 + w as i32 - 8), (y0, y0 + h as i32 - 4));
            let found = grid.cheapest(&runs, xs, ys, (stride, stride), f32::INFINITY).0;
            let mut best: Option<CheapestPlace> = None;
            for y in (ys.0..=ys.1).step_by(stride) {
                for x in (xs.0..=xs.1).step_by(stride) {
                    let cells = runs.iter().flat_map(|r| (r.first..r.end).map(move |c| (c, r.row)));
                    let cost: i32 = cells.map(|(i, j)| plain[(y + j - y0) as usize * w + (x + i - x0) as usize]).sum();
                    if best.is_none_or(|b| (cost as f32) < b.cost) {
                        best = Some(CheapestPlace { cost: cost as f32, x, y });
                    }
                }
            }
            assert_eq!(found, best);
        }
    }
}
