//! Changes to a feasible layout from which overlap minimisation goes on.

use super::item::PlacedItem;
use super::overlap::OverlapMinimizer;

/// A side that shrinks by less than one part in so many is cut at a line.
const NEAR: i32 = 50;
/// The second piece of an exchange is one of so many that are next in size.
const SIMILAR: usize = 3;

/// Brings the pieces of one container into another: where it is a little smaller, what lies beyond a random line moves over it, so that
/// overlaps arise in one place (Gardeyn and Wauters 2025, section 5.2); else all centres move in proportion.
pub(super) fn resize(minimizer: &mut OverlapMinimizer<'_>, from: (i32, i32), to: (i32, i32)) {
    for axis in 0..2 {
        let (old, new) = if axis == 0 { (from.0, to.0) } else { (from.1, to.1) };
        let line = minimizer.random.below(2 * old as usize) as i32;
        let near = (old - new).abs() * NEAR < old;
        for p in &mut minimizer.placed {
            let centre = p.centre()[axis];
            let by = if !near {
                (f64::from(centre) * (f64::from(new) / f64::from(old) - 1.0) / 2.0) as i32
            } else if centre > line {
                new - old
            } else {
                0
            };
            if axis == 0 { p.x += by } else { p.y += by }
        }
    }
}

/// Exchanges two large pieces of similar size, or turns one where it is, each to any of its candidate orientations.
pub(super) fn exchange(minimizer: &mut OverlapMinimizer<'_>) {
    let n = minimizer.placed.len();
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by_key(|&i| (std::cmp::Reverse(minimizer.placed[i].item.cells()), i));
    let large = n.div_ceil(2);
    let a = minimizer.random.below(large);
    let b = (a + 1 + minimizer.random.below(SIMILAR)).min(n - 1);
    let (i, j) = (order[a], order[b]);
    let (at, other) = (minimizer.placed[i].centre(), minimizer.placed[j].centre());
    let moves = if i == j || minimizer.random.below(3) == 0 { vec![(i, at)] } else { vec![(i, other), (j, at)] };
    for (piece, centre) in moves {
        let candidates = &minimizer.instances.candidates[piece];
        if !candidates.is_empty() {
            let item = candidates[minimizer.random.below(candidates.len())].clone();
            minimizer.placed[piece] = PlacedItem::centred(item, centre, &minimizer.instances.grid);
        }
    }
}
