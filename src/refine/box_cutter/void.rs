//! Void boxes: the largest empty rectangles of a layout or of a chart's own box (Box Cutter, section 3.1 and 3.2, "Locating Void Boxes").

use crate::packing::Mask;

/// An empty rectangle of cells, `x.0..x.1` by `y.0..y.1`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct VoidBox {
    /// Columns, the end excluded.
    pub x: (usize, usize),
    /// Rows, the end excluded.
    pub y: (usize, usize),
}

impl VoidBox {
    /// Cells inside.
    pub fn area(&self) -> usize {
        (self.x.1 - self.x.0) * (self.y.1 - self.y.0)
    }

    fn common(&self, other: &VoidBox) -> usize {
        let side = |a: (usize, usize), b: (usize, usize)| a.1.min(b.1).saturating_sub(a.0.max(b.0));
        side(self.x, other.x) * side(self.y, other.y)
    }
}

/// Boxes smaller than this fraction of the whole are not looked at.
const LEAST: f64 = 0.0005;

/// The `count` largest maximal empty rectangles of the first `width` x `height` cells, largest first, of which no two share more than
/// `shared` of the smaller one's area.
///
/// Row by row, the empty cells above each cell form a histogram; the rectangles that end in this row and
/// cannot grow to the sides or upwards are its maximal ones, found with a stack; those that the next row would continue are
/// dropped. The time is proportional to the number of cells (the paper's skip buffer takes longer).
pub(crate) fn void_boxes(taken: &Mask, width: usize, height: usize, count: usize, shared: f64) -> Vec<VoidBox> {
    let least = ((width * height) as f64 * LEAST).max(4.0) as usize;
    let free = |x: usize, y: usize| x >= taken.width || y >= taken.height || !taken.get(x, y);
    let mut depth = vec![0usize; width];
    // By column: how many free cells of the row below there are from the left, to tell whether a box can grow downwards.
    let mut below = vec![0usize; width + 1];
    let mut found: Vec<VoidBox> = Vec::new();
    let mut stack: Vec<(usize, usize)> = Vec::new();
    for y in 0..height {
        for x in 0..width {
            depth[x] = if free(x, y) { depth[x] + 1 } else { 0 };
            below[x + 1] = below[x] + usize::from(y + 1 < height && free(x, y + 1));
        }
        stack.clear();
        for x in 0..=width {
            let here = if x < width { depth[x] } else { 0 };
            let mut from = x;
            while let Some(&(start, deep)) = stack.last() {
                if deep <= here {
                    break;
                }
                stack.pop();
                let grows = below[x] - below[start] == x - start;
                if !grows && deep * (x - start) >= least {
                    found.push(VoidBox { x: (start, x), y: (y + 1 - deep, y + 1) });
                }
                from = start;
            }
            if here > 0 && stack.last().is_none_or(|&(_, deep)| deep < here) {
                stack.push((from, here));
            }
        }
    }
    found.sort_by_key(|b| (std::cmp::Reverse(b.area()), b.y, b.x));
    let mut kept: Vec<VoidBox> = Vec::new();
    for candidate in found {
        if kept.len() == count {
            break;
        }
        if kept.iter().all(|k| k.common(&candidate) as f64 <= shared * candidate.area() as f64) {
            kept.push(candidate);
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::packing::Random;

    /// All maximal empty rectangles by testing every rectangle.
    fn brute(taken: &Mask, w: usize, h: usize) -> Vec<VoidBox> {
        let empty = |b: &VoidBox| (b.y.0..b.y.1).all(|y| (b.x.0..b.x.1).all(|x| !taken.get(x, y)));
        let mut all = Vec::new();
        for x0 in 0..w {
            for x1 in x0 + 1..=w {
                for y0 in 0..h {
                    for y1 in y0 + 1..=h {
                        let b = VoidBox { x: (x0, x1), y: (y0, y1) };
                        if !empty(&b) {
                            continue;
                        }
                        let grown = [
                            VoidBox { x: (x0.wrapping_sub(1), x1), ..b },
                            VoidBox { x: (x0, x1 + 1), ..b },
                            VoidBox { y: (y0.wrapping_sub(1), y1), ..b },
                            VoidBox { y: (y0, y1 + 1), ..b },
                        ];
                        let fits = |g: &VoidBox| g.x.0 <= g.x.1 && g.y.0 <= g.y.1 && g.x.1 <= w && g.y.1 <= h;
                        if !grown.iter().any(|g| fits(g) && empty(g)) {
                            all.push(b);
                        }
                    }
                }
            }
        }
        all
    }

    #[test]
    fn the_largest_boxes_are_those_that_brute_force_finds() {
        let mut random = Random::new(4);
        for _ in 0..60 {
            let (w, h) = (5 + random.below(9), 5 + random.below(9));
            let mut taken = Mask::new(w, h);
            for _ in 0..random.below(6) {
                let (y, a) = (random.below(h), random.below(w));
                let b = (a + random.below(4)).min(w - 1);
                taken.set_run(y, a, b);
            }
            let mut expected = brute(&taken, w, h);
            expected.retain(|b| b.area() >= 4);
            expected.sort_by_key(|b| (std::cmp::Reverse(b.area()), b.y, b.x));
            assert_eq!(void_boxes(&taken, w, h, usize::MAX, 1.0), expected);
            let few = void_boxes(&taken, w, h, 3, 0.1);
            assert_eq!(few.first(), expected.first());
            for (i, a) in few.iter().enumerate() {
                for b in &few[i + 1..] {
                    assert!(a.common(b) as f64 <= 0.1 * b.area() as f64);
                }
            }
        }
    }
}
