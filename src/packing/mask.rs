//! Conservative bitmaps of pieces: a cell is set when the piece touches its interior.

use glam::DVec2;

use super::bits::{next_bit, set_run};

/// Coordinates this close to a cell border count as lying on it.
const ON_BORDER: f64 = 1e-9;
/// Everything else is kept this far (in cells) from the cells that it does not own, so that rounding UVs to
/// 32 bits cannot make neighbours overlap.
const CLEARANCE: f64 = 1e-3;

/// A bitmap of `width` x `height` cells; bit `x % 64` of word `x / 64` of a row is cell x.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Mask {
    pub width: usize,
    pub height: usize,
    words: usize,
    bits: Vec<u64>,
}

impl Mask {
    pub fn new(width: usize, height: usize) -> Self {
        let words = width.div_ceil(64).max(1);
        Mask { width, height, words, bits: vec![0; words * height] }
    }

    /// The cells that triangles touch, in cell units with the origin at cell (0, 0). Everything must lie
    /// inside `width` x `height`; what does not is clipped.
    #[cfg(test)]
    pub fn of_triangles(triangles: &[[DVec2; 3]], width: usize, height: usize) -> Self {
        let mut mask = Mask::new(width, height);
        for triangle in triangles {
            mask.add_triangle(triangle);
        }
        mask
    }

    /// Sets the cells that a triangle touches; of a degenerate one, those that its longest edge touches.
    pub fn add_triangle(&mut self, t: &[DVec2; 3]) {
        let low = t[0].min(t[1]).min(t[2]);
        let high = t[0].max(t[1]).max(t[2]);
        let (first, last) = cells(low.y, high.y, self.height);
        for row in first..=last {
            // The part of the triangle in the band of this row, a hair wider than the row itself.
            let (top, bottom) = (row as f64 - CLEARANCE, row as f64 + 1.0 + CLEARANCE);
            let mut left = f64::INFINITY;
            let mut right = f64::NEG_INFINITY;
            for k in 0..3 {
                let (a, b) = (t[k], t[(k + 1) % 3]);
                if a.y >= top && a.y <= bottom {
                    left = left.min(a.x);
                    right = right.max(a.x);
                }
                for cut in [top, bottom] {
                    if (a.y < cut) != (b.y < cut) {
                        let x = a.x + (b.x - a.x) * ((cut - a.y) / (b.y - a.y));
                        left = left.min(x);
                        right = right.max(x);
                    }
                }
            }
            if left <= right {
                let (a, b) = cells(left, right, self.width);
                self.set_run(row, a, b);
            }
        }
    }

    /// Sets the cells `first..=last` of a row.
    pub fn set_run(&mut self, row: usize, first: usize, last: usize) {
        set_run(self.row_mut(row), first, last, true);
    }

    /// Sets the cells of another mask placed at `(x, y)`, which must lie inside.
    pub fn stamp(&mut self, other: &Mask, x: usize, y: usize) {
        for (row, first, last) in other.runs() {
            self.set_run(y + row as usize, x + first as usize, x + last as usize);
        }
    }

    /// Words of a row.
    pub fn row(&self, row: usize) -> &[u64] {
        &self.bits[row * self.words..(row + 1) * self.words]
    }

    /// Words of a row, to change.
    pub fn row_mut(&mut self, row: usize) -> &mut [u64] {
        &mut self.bits[row * self.words..(row + 1) * self.words]
    }

    /// Whether a cell is set.
    pub fn get(&self, x: usize, y: usize) -> bool {
        self.row(y)[x / 64] >> (x % 64) & 1 == 1
    }

    /// Number of cells set.
    pub fn count(&self) -> usize {
        self.bits.iter().map(|w| w.count_ones() as usize).sum()
    }

    /// The maximal runs `(row, first, last)`, rows ascending.
    pub fn runs(&self) -> Vec<(u32, u32, u32)> {
        let mut runs = Vec::new();
        for row in 0..self.height {
            let line = self.row(row);
            let mut x = 0;
            while let Some(first) = next_bit(line, x, true) {
                if first >= self.width {
                    break;
                }
                let end = next_bit(line, first, false).unwrap_or(self.words * 64).min(self.width);
                runs.push((row as u32, first as u32, end as u32 - 1));
                x = end;
            }
        }
        runs
    }

    /// Each `size` rows as one row, with the cells that are set in all of them.
    pub fn bands(&self, size: usize) -> Mask {
        let mut bands = Mask::new(self.width, self.height / size);
        for (band, line) in bands.bits.chunks_exact_mut(self.words).enumerate() {
            for (i, word) in line.iter_mut().enumerate() {
                *word = (band * size..(band + 1) * size).fold(!0, |bits, row| bits & self.row(row)[i]);
            }
        }
        bands
    }

    /// Every cell within `margin` cells (Chebyshev) of a set one; the result is larger by `margin` on each side.
    pub fn dilated(&self, margin: usize) -> Mask {
        if margin == 0 {
            return self.clone();
        }
        let mut wide = Mask::new(self.width + 2 * margin, self.height);
        for (row, first, last) in self.runs() {
            wide.set_run(row as usize, first as usize, last as usize + 2 * margin);
        }
        // Rows within the margin: a sliding OR by doubling would save little at the sizes of gutters.
        let mut result = Mask::new(wide.width, self.height + 2 * margin);
        for row in 0..result.height {
            let from = row.saturating_sub(2 * margin);
            let to = row.min(self.height - 1);
            let line = &mut result.bits[row * result.words..(row + 1) * result.words];
            for source in from..=to {
                for (word, other) in line.iter_mut().zip(wide.row(source)) {
                    *word |= other;
                }
            }
        }
        result
    }
}

/// Whether both coordinates lie on the same border between cells.
pub(super) fn on_border(a: f64, b: f64) -> bool {
    let nearest = a.round();
    (a - nearest).abs() < ON_BORDER && (b - nearest).abs() < ON_BORDER
}

/// The cells that the interval touches, clipped to `0..count`.
fn cells(low: f64, high: f64, count: usize) -> (usize, usize) {
    let nearest = low.round();
    let first = if (low - nearest).abs() < ON_BORDER { nearest } else { (low - CLEARANCE).floor() };
    let nearest = high.round();
    let last = if (high - nearest).abs() < ON_BORDER { nearest - 1.0 } else { (high + CLEARANCE).floor() };
    let top = count.saturating_sub(1) as f64;
    let first = first.clamp(0.0, top);
    (first as usize, last.clamp(first, top) as usize)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::packing::random::Random;

    fn touches(t: &[DVec2; 3], x: usize, y: usize) -> bool {
        // Brute force: clip the triangle to the cell and see whether an area is left.
        let mut polygon = t.to_vec();
        for (axis, bound, keep_above) in
            [(0, x as f64, true), (0, x as f64 + 1.0, false), (1, y as f64, true), (1, y as f64 + 1.0, false)]
        {
            let side = |p: &DVec2| if keep_above { p[axis] - bound } else { bound - p[axis] };
            let mut out = Vec::new();
            for k in 0..polygon.len() {
                let (a, b) = (polygon[k], polygon[(k + 1) % polygon.len()]);
                if side(&a) >= 0.0 {
                    out.push(a);
                }
                if (side(&a) > 0.0) != (side(&b) > 0.0) && side(&a) != side(&b) {
                    out.push(a + (b - a) * (side(&a) / (side(&a) - side(&b))));
                }
            }
            polygon = out;
            if polygon.is_empty() {
                return false;
            }
        }
        let area: f64 = (0..polygon.len()).map(|k| polygon[k].perp_dot(polygon[(k + 1) % polygon.len()])).sum();
        area.abs() > 1e-9
    }

    #[test]
    fn a_mask_holds_every_cell_that_a_triangle_touches_and_little_else() {
        let mut random = Random::new(3);
        let mut extra = 0;
        let mut total = 0;
        for _ in 0..200 {
            let t = [0, 1, 2].map(|_| DVec2::new(random.unit() * 70.0, random.unit() * 20.0));
            let mask = Mask::of_triangles(&[t], 72, 22);
            for y in 0..22 {
                for x in 0..72 {
                    if touches(&t, x, y) {
                        assert!(mask.get(x, y), "{t:?} at {x} {y}");
                        total += 1;
                    } else {
                        extra += usize::from(mask.get(x, y));
                    }
                }
            }
        }
        assert!(extra * 50 < total, "{extra} of {total} cells are set in vain");
    }

    #[test]
    fn lattice_aligned_pieces_own_no_cell_beyond_their_border() {
        let t = [DVec2::new(1.0, 1.0), DVec2::new(3.0, 1.0), DVec2::new(3.0, 4.0)];
        let u = [DVec2::new(1.0, 1.0), DVec2::new(3.0, 4.0), DVec2::new(1.0, 4.0)];
        let mask = Mask::of_triangles(&[t, u], 6, 6);
        assert_eq!(mask.runs(), vec![(1, 1, 2), (2, 1, 2), (3, 1, 2)]);
    }

    #[test]
    fn dilation_is_the_chebyshev_neighbourhood() {
        let mut random = Random::new(9);
        let mut mask = Mask::new(130, 9);
        for _ in 0..25 {
            let x = random.below(130);
            mask.set_run(random.below(9), x, x);
        }
        let wide = mask.dilated(3);
        for y in 0..wide.height {
            for x in 0..wide.width {
                let near = (0..9).any(|j: usize| {
                    (0..130).any(|i: usize| mask.get(i, j) && (i + 3).abs_diff(x) <= 3 && (j + 3).abs_diff(y) <= 3)
                });
                assert_eq!(wide.get(x, y), near);
            }
        }
    }
}
