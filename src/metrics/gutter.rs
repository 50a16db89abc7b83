//! The gutter: free texels between the texels of two clusters.

use std::ops::Range;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use rayon::prelude::*;

use super::measures::SlotSize;
use super::raster::{Band, Bands, TOUCH, touched_spans};
use crate::atlas::{Atlas, Charts, Clusters, FaceId};

/// Widest gutter that is looked for: the widest that can be asked for.
const WIDEST: u32 = 64;

/// Free texels between the closest touched texels of two clusters on one page (Chebyshev distance less one; 0 where they
/// meet or share a texel; at most 64), in the smallest slot that is not exempt; else at the size `otherwise`, or on the
/// sheet. `None` where no page holds two clusters.
///
/// A texel is touched when a triangle enters it by more than 1/1000 of its side.
pub(super) fn of(
    atlas: &Atlas,
    charts: &Charts,
    clusters: &Clusters,
    slots: &[SlotSize],
    otherwise: Option<[u32; 2]>,
) -> Option<u32> {
    (0..atlas.sheets.len()).filter_map(|page| of_page(atlas, charts, clusters, slots, otherwise, page)).min()
}

fn of_page(
    atlas: &Atlas,
    charts: &Charts,
    clusters: &Clusters,
    slots: &[SlotSize],
    otherwise: Option<[u32; 2]>,
    page: usize,
) -> Option<u32> {
    let cluster = |f: FaceId| clusters.of_chart[charts.of_face[f.index()].index()];
    let mut on_page = atlas.faces().filter(|f| usize::from(atlas.page[f.index()]) == page).map(cluster);
    let first = on_page.next()?;
    if on_page.all(|c| c == first) {
        return None;
    }
    let smallest = slots
        .iter()
        .filter(|s| usize::from(s.page) == page && !s.exempt)
        .map(|s| [s.width, s.height])
        .min_by_key(|s| u64::from(s[0]) * u64::from(s[1]));
    let size = smallest.or(otherwise).unwrap_or(atlas.sheets[page]);
    // Texels four times as large tell about how far to look at a fraction of the cost, and settle it where all are far apart.
    if size.iter().all(|s| s % COARSE == 0) {
        let size = size.map(|s| s / COARSE);
        let gap = smallest_gap(atlas, page, size, 0..WIDEST / COARSE, TOUCH / f64::from(COARSE), cluster)? * COARSE;
        if gap >= WIDEST {
            return Some(WIDEST);
        }
        // Between large texels that are so far apart small ones are no nearer, and at most two large ones farther.
        let widest = WIDEST.min(gap + 2 * COARSE);
        let found = smallest_gap(atlas, page, size.map(|s| s * COARSE), gap..widest, TOUCH, cluster)?;
        // What touches a large texel may fall between small ones: then nothing is found so near.
        if found < widest || widest == WIDEST {
            return Some(found);
        }
    }
    smallest_gap(atlas, page, size, 0..WIDEST, TOUCH, cluster)
}

const COARSE: u32 = 4;

/// The smallest gap at a given size, which is known to be no less than the start of `within`; at most its end.
fn smallest_gap(
    atlas: &Atlas,
    page: usize,
    size: [u32; 2],
    within: Range<u32>,
    touch: f64,
    cluster: impl Fn(FaceId) -> u32 + Copy + Sync,
) -> Option<u32> {
    let bands = Bands::new(atlas, page, size, i64::from(within.end))?;
    let best = AtomicU32::new(within.end);
    let grow = |labels: &mut Labels, band| grow(&band, size[0], touch, cluster, within.start, &best, labels);
    bands.par_iter().for_each_init(Labels::default, grow);
    Some(best.into_inner())
}

/// No cluster has it yet.
const FREE: u32 = u32::MAX;
/// Texels that are looked at together.
const RUN: usize = 64;
/// The frame about a band, so that every texel has eight neighbours.
const WALL: u32 = u32::MAX - 1;

/// Which cluster has a texel, and how many rings it grew for that: of one band after the other.
#[derive(Default)]
struct Labels {
    label: Vec<u32>,
    distance: Vec<u8>,
}

/// Lowers `best` to the smallest gap in a band. (The bands share it only to stop early: the least of all does not depend
/// on which of them comes first.)
///
/// All clusters grow at once, a ring of texels at a time, until two meet: then the sum of their distances is the
/// smallest gap, which is not less than `least`. (On the shortest way between the closest two texels some neighbours have different nearest clusters.)
fn grow(
    band: &Band<'_>,
    width: u32,
    touch: f64,
    cluster: impl Fn(FaceId) -> u32,
    least: u32,
    best: &AtomicU32,
    labels: &mut Labels,
) {
    if best.load(Relaxed) <= least {
        return;
    }
    let (w, h) = (width as usize + 2, band.height() + 2);
    let Labels { label, distance } = labels;
    label.clear();
    label.resize(w * h, FREE);
    label[..w].fill(WALL);
    label[(h - 1) * w..].fill(WALL);
    for row in label.chunks_exact_mut(w) {
        (row[0], row[w - 1]) = (WALL, WALL);
    }
    let mut shared = false;
    for &f in band.faces {
        let own = cluster(f);
        touched_spans(&band.triangle(f), touch, &band.rows, width, |y, x0, x1| {
            let row = ((y - band.rows.start) as usize + 1) * w + 1;
            let span = &mut label[row + x0 as usize..row + x1 as usize];
            // Without a branch for each texel: spans are long where sheets are large.
            shared |= span.iter().fold(false, |shared, texel| shared | ((*texel != FREE) & (*texel != own)));
            span.fill(own);
        });
        if shared {
            best.store(0, Relaxed);
        }
        if best.load(Relaxed) <= least {
            return;
        }
    }
    let neighbours = |i: usize| [i - w - 1, i - w, i - w + 1, i - 1, i + 1, i + w - 1, i + w, i + w + 1];
    // Four neighbours do for the first ring: what a texel only meets across a corner, one beside it meets across an edge.
    let mut ring = Vec::new();
    for y in 1..h.saturating_sub(1) {
        let [above, row, below] = [y - 1, y, y + 1].map(|y| &label[y * w..(y + 1) * w]);
        let mut x = 1;
        while x + 1 < w {
            let run = x..(x + RUN).min(w - 1);
            x = run.end;
            // Nearly everywhere all texels of a run are like all beside them.
            let own = &row[run.clone()];
            if own == &row[run.start - 1..run.end - 1]
                && own == &row[run.start + 1..run.end + 1]
                && own == &above[run.clone()]
                && own == &below[run.clone()]
            {
                continue;
            }
            for x in run {
                let own = row[x];
                let differs = (row[x - 1] != own) | (row[x + 1] != own) | (above[x] != own) | (below[x] != own);
                if own < WALL && differs {
                    ring.push(y * w + x);
                }
            }
        }
    }
    distance.clear();
    distance.resize(label.len(), 0);
    for grown in 0u32.. {
        let mut next = Vec::new();
        for &i in &ring {
            let own = label[i];
            for j in neighbours(i) {
                let other = label[j];
                if other == FREE {
                    label[j] = own;
                    distance[j] = grown as u8 + 1;
                    next.push(j);
                } else if other != own && other != WALL {
                    best.fetch_min(grown + u32::from(distance[j]), Relaxed);
                }
            }
        }
        // In the rings to come two distances add up to no less than this.
        if next.is_empty() || best.load(Relaxed) <= 2 * (grown + 1) {
            return;
        }
        ring = next;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::OverlapMode;
    use crate::atlas::testing::{Rng, join, sheet};
    use crate::atlas::{Topology, clusters};
    use glam::DVec2;

    fn gutter(atlas: &Atlas, slots: &[SlotSize]) -> Option<u32> {
        let charts = Charts::new(&Topology::new(atlas));
        of(atlas, &charts, &clusters(atlas, &charts, OverlapMode::Stack), slots, None)
    }

    #[test]
    fn it_is_the_closest_pair_of_texels() {
        let mut rng = Rng(9);
        for round in 0..40 {
            let corner = |r: &mut Rng| (r.point(700.0) * DVec2::new(0.08, 1.0)).floor();
            let (mut places, mut atlas) = (vec![corner(&mut rng)], Atlas::default());
            atlas.sheets = vec![[64, 712]]; // the coarse look applies
            for _ in 0..1 + round % 6 {
                let p = corner(&mut rng);
                if places.iter().all(|q| (p - *q).abs().max_element() >= 3.0) {
                    places.push(p);
                }
            }
            for p in &places {
                atlas = join(&atlas, &sheet(3, 3, *p));
            }
            if places.len() < 2 {
                continue;
            }
            let mut expected = WIDEST;
            for (i, p) in places.iter().enumerate() {
                for q in &places[..i] {
                    expected = expected.min((*p - *q).abs().max_element() as u32 - 3);
                }
            }
            assert_eq!(gutter(&atlas, &[]), Some(expected), "{places:?}");
        }
    }

    #[test]
    fn the_smallest_slot_decides_and_stacks_do_not_count() {
        let slot = |side: u32, exempt: bool| SlotSize { page: 0, width: side, height: side, bytes: 0, exempt };
        let pair = join(&sheet(8, 8, DVec2::ZERO), &sheet(8, 8, DVec2::new(16.0, 0.0)));
        assert_eq!(gutter(&pair, &[slot(100, false)]), Some(8));
        assert_eq!(gutter(&pair, &[slot(100, false), slot(50, false), slot(25, true)]), Some(4));
        let stack = join(&sheet(8, 8, DVec2::ZERO), &sheet(8, 8, DVec2::ONE));
        assert_eq!(gutter(&stack, &[]), None);
        assert_eq!(gutter(&join(&stack, &sheet(2, 2, DVec2::new(9.5, 0.0))), &[]), Some(0), "a texel is shared");
    }
}
