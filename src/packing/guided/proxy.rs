//! The overlap proxy: what pieces that overlap are charged for it.
//!
//! The bare area of an overlap does not tell which way out of it is the shortest. As the proxies of the nesting literature do, cells
//! count the more the deeper they lie in the piece that is moved onto.

use crate::packing::mask::Mask;

/// A cell at the boundary of a piece counts this much, the deepest one `BOUNDARY + INTERIOR`. Set by hand.
const BOUNDARY: usize = 4;
const INTERIOR: usize = 12;

/// By cell, what an overlap there costs: the distance to the outside (in steps along the axes), scaled to the piece's deepest.
pub(super) fn depth_costs(mask: &Mask) -> Vec<u8> {
    let (w, h) = (mask.width, mask.height);
    let mut depth = vec![0u16; w * h];
    for (row, first, last) in mask.runs() {
        depth[row as usize * w + first as usize..=row as usize * w + last as usize].fill(u16::MAX);
    }
    let mut deepest = 1;
    for y in 0..h {
        for x in 0..w {
            let i = y * w + x;
            if depth[i] > 0 {
                let left = if x > 0 { depth[i - 1] } else { 0 };
                let above = if y > 0 { depth[i - w] } else { 0 };
                depth[i] = left.min(above).saturating_add(1);
            }
        }
    }
    for y in (0..h).rev() {
        for x in (0..w).rev() {
            let i = y * w + x;
            if depth[i] > 0 {
                let right = if x + 1 < w { depth[i + 1] } else { 0 };
                let below = if y + 1 < h { depth[i + w] } else { 0 };
                depth[i] = depth[i].min(right.min(below).saturating_add(1));
                deepest = deepest.max(depth[i]);
            }
        }
    }
    let cost: Vec<u8> = (0..=usize::from(deepest))
        .map(|d| if d == 0 { 0 } else { (BOUNDARY + INTERIOR * (d - 1) / usize::from(deepest).max(2)) as u8 })
        .collect();
    depth.into_iter().map(|d| cost[usize::from(d)]).collect()
}

/// Cells that `a` and `b` share, when `b`'s corner is `(dx, dy)` cells from `a`'s.
pub(super) fn shared_cells(a: &Mask, b: &Mask, dx: i32, dy: i32) -> u32 {
    if dx < 0 {
        return shared_cells(b, a, -dx, -dy);
    }
    let (rows, skip) = (dy.max(0) as usize, (-dy).max(0) as usize);
    let (offset, shift) = (dx as usize / 64, dx as usize % 64);
    if dx as usize >= a.width || rows >= a.height || skip >= b.height {
        return 0;
    }
    let mut count = 0;
    for row in 0..(a.height - rows).min(b.height - skip) {
        let mine = &a.row(rows + row)[offset..];
        let theirs = b.row(skip + row);
        let mut carried = 0;
        for (i, &word) in mine.iter().enumerate() {
            let next = theirs.get(i).copied().unwrap_or(0);
            // The bits of b that fall on this word of a.
            let here = if shift == 0 { next } else { next << shift | carried };
            carried = if shift == 0 { 0 } else { next >> (64 - shift) };
            count += (word & here).count_ones();
        }
    }
    count
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::packing::random::Random;

    fn blob(random: &mut Random) -> Mask {
        let mut mask = Mask::new(1 + random.below(150), 1 + random.below(20));
        for row in 0..mask.height {
            let a = random.below(mask.width);
            mask.set_run(row, a, a + random.below(mask.width - a));
        }
        mask
    }

    #[test]
    fn shared_cells_are_those_that_testing_each_cell_finds() {
        let mut random = Random::new(11);
        for _ in 0..500 {
            let (a, b) = (blob(&mut random), blob(&mut random));
            let (dx, dy) = (random.below(320) as i32 - 160, random.below(44) as i32 - 22);
            let mut count = 0;
            for y in 0..b.height {
                for x in 0..b.width {
                    let (i, j) = (x as i32 + dx, y as i32 + dy);
                    let inside = i >= 0 && j >= 0 && (i as usize) < a.width && (j as usize) < a.height;
                    count += u32::from(inside && b.get(x, y) && a.get(i as usize, j as usize));
                }
            }
            assert_eq!(shared_cells(&a, &b, dx, dy), count, "{dx} {dy}");
        }
    }

    #[test]
    fn deeper_cells_cost_more() {
        let mut mask = Mask::new(9, 9);
        (0..9).for_each(|row| mask.set_run(row, 0, 8));
        let cost = depth_costs(&mask);
        assert_eq!(usize::from(cost[0]), BOUNDARY);
        assert!(cost[0] < cost[2 * 9 + 4] && cost[2 * 9 + 4] < cost[4 * 9 + 4]);
    }
}
