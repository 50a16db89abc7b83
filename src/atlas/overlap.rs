//! Exact overlap of UV triangles: which faces, and which charts, share texels.
//!
//! Two triangles overlap when their interiors have a point in common; touching is not overlapping. The
//! decision is made with adaptive exact predicates (Shewchuk 1997), so a shared edge never counts, however
//! its ends were rounded, and an overlap of one part in 1e15 does.

use glam::DVec2;
use rayon::prelude::*;
use robust::{Coord, orient2d};

use super::bvh::{Bounds, Bvh, TriangleTree};
use super::{Atlas, ChartId, Charts, FaceId};
use crate::error::Result;

/// Overlapping pairs of faces, each pair ascending, the pairs sorted.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Overlaps {
    /// Pairs within one chart.
    pub intra: Vec<(FaceId, FaceId)>,
    /// Pairs of different charts.
    pub inter: Vec<(FaceId, FaceId)>,
    /// Whether a limit cut the search short, so that there may be more pairs.
    pub truncated: bool,
}

/// Sign of the area of (a, b, c), exact: 1 counter-clockwise with y up, -1 clockwise, 0 degenerate.
pub fn orientation(a: DVec2, b: DVec2, c: DVec2) -> i8 {
    let coord = |p: DVec2| Coord { x: p.x, y: p.y };
    let det = orient2d(coord(a), coord(b), coord(c));
    i8::from(det > 0.0) - i8::from(det < 0.0)
}

/// Whether the interiors of two triangles, of either orientation, have a point in common. Exact.
///
/// The interiors of two convex polygons are disjoint if and only if the line of some edge of one separates
/// them, weakly. Degenerate triangles have no interior.
pub fn triangles_overlap(a: &[DVec2; 3], b: &[DVec2; 3]) -> bool {
    if !Bounds::of(a).meets(&Bounds::of(b)) {
        return false;
    }
    let (Some(a), Some(b)) = (counter_clockwise(a), counter_clockwise(b)) else { return false };
    turned_overlap(&a, &b)
}

/// [`triangles_overlap`] for two that are counter-clockwise and whose boxes meet.
pub(crate) fn turned_overlap(a: &[DVec2; 3], b: &[DVec2; 3]) -> bool {
    !separates(a, b) && !separates(b, a)
}

/// The triangles of faces that have an area, each counter-clockwise.
pub(crate) fn turned(atlas: &Atlas, faces: &[FaceId]) -> Vec<[DVec2; 3]> {
    let turned = |f: &FaceId| {
        let triangle = atlas.uv_triangle(*f);
        counter_clockwise(&triangle).unwrap_or(triangle)
    };
    faces.iter().map(turned).collect()
}

fn counter_clockwise(t: &[DVec2; 3]) -> Option<[DVec2; 3]> {
    match orientation(t[0], t[1], t[2]) {
        1 => Some(*t),
        -1 => Some([t[0], t[2], t[1]]),
        _ => None,
    }
}

/// Whether an edge of `a` has all of `b` on its outer side or on its line.
fn separates(a: &[DVec2; 3], b: &[DVec2; 3]) -> bool {
    (0..3).any(|k| {
        let (p, q) = (a[k], a[(k + 1) % 3]);
        b.iter().all(|&v| v == p || v == q || orientation(p, q, v) <= 0)
    })
}

/// How far one of two triangles must move until they no longer overlap, in the units of the UVs; 0 where they do not.
pub fn penetration(a: &[DVec2; 3], b: &[DVec2; 3]) -> f64 {
    if !triangles_overlap(a, b) {
        return 0.0;
    }
    let (Some(a), Some(b)) = (counter_clockwise(a), counter_clockwise(b)) else { return 0.0 };
    let one = |a: &[DVec2; 3], b: &[DVec2; 3]| {
        (0..3)
            .map(|k| {
                let (p, q) = (a[k], a[(k + 1) % 3]);
                let inner = (q - p).perp().normalize_or_zero();
                b.iter().map(|&v| inner.dot(v - p)).fold(0.0, f64::max)
            })
            .fold(f64::INFINITY, f64::min)
    };
    one(&a, &b).min(one(&b, &a))
}

/// Pair tests per face before a search gives up: far above what any real atlas needs, and low enough to end.
const TESTS_PER_FACE: usize = 20_000;
/// Positions per parallel task; fixed, so that what a limit keeps does not depend on the number of threads.
const BLOCK: usize = 512;
/// Tasks between two looks at the limit.
const ROUND: usize = 32;

/// All overlapping pairs of faces that lie on the same page, at most `limit` of them (see [`Overlaps::truncated`]).
/// Faces with UVs that are not finite are left out.
pub fn overlaps(atlas: &Atlas, charts: &Charts, limit: usize) -> Overlaps {
    let (pairs, truncated) = overlaps_where(atlas, limit, |_, _| true);
    let (intra, inter) = pairs.into_iter().partition(|p| charts.of_face[p.0.index()] == charts.of_face[p.1.index()]);
    Overlaps { intra, inter, truncated }
}

/// The overlapping pairs that `keep` wants, sorted, at most `limit` of them; and whether the search was cut short.
pub(crate) fn overlaps_where(
    atlas: &Atlas,
    limit: usize,
    keep: impl Fn(FaceId, FaceId) -> bool + Sync,
) -> (Vec<(FaceId, FaceId)>, bool) {
    let mut found = Vec::new();
    let mut truncated = false;
    for page in 0..page_count(atlas) {
        let faces: Vec<FaceId> = atlas.faces().filter(|f| usize::from(atlas.page[f.index()]) == page).collect();
        let named = |(a, b): (u32, u32)| (faces[a as usize], faces[b as usize]);
        let wanted = |pair| keep(named(pair).0, named(pair).1);
        let blocks = overlaps_in_blocks(atlas, &faces, (TESTS_PER_FACE, limit), wanted, |pairs, cut| {
            let room = limit - found.len();
            truncated |= cut || pairs.len() > room;
            found.extend(pairs.into_iter().take(room).map(named));
            Ok(true)
        });
        // Nothing fails where `visit` does not.
        truncated |= blocks.is_err();
    }
    found.par_sort_unstable();
    (found, truncated)
}

/// Calls `visit` for block after block of the pairs of faces of one page that overlap and that `keep` wants, each pair ascending, as
/// positions in `faces`, in a fixed order; also with whether a limit on pair tests per face, or on the pairs of a block, cut the block short.
/// Ends when `visit` says `false`, or fails.
pub(crate) fn overlaps_in_blocks(
    atlas: &Atlas,
    faces: &[FaceId],
    (tests_per_face, pairs_per_block): (usize, usize),
    keep: impl Fn((u32, u32)) -> bool + Sync,
    mut visit: impl FnMut(Vec<(u32, u32)>, bool) -> Result<bool>,
) -> Result<()> {
    let solid: Vec<u32> = (0..faces.len() as u32).filter(|&i| has_area(atlas, faces[i as usize])).collect();
    let own: Vec<FaceId> = solid.iter().map(|&i| faces[i as usize]).collect();
    let TriangleTree { tree, triangles } = TriangleTree::new(&turned(atlas, &own));
    let block_pairs = |&start: &usize| {
        let mut pairs = Vec::new();
        let mut tests = tests_per_face * BLOCK;
        for p in start..(start + BLOCK).min(triangles.len()) {
            tree.query(&tree.bounds_at(p), p + 1, |q| {
                tests = tests.saturating_sub(1);
                let [a, b] = [p, q].map(|p| solid[tree.order[p] as usize]);
                let pair = (a.min(b), a.max(b));
                if turned_overlap(&triangles[p], &triangles[q]) && keep(pair) {
                    pairs.push(pair);
                }
                tests > 0 && pairs.len() <= pairs_per_block
            });
            if tests == 0 || pairs.len() > pairs_per_block {
                return (pairs, true);
            }
        }
        (pairs, false)
    };
    let blocks: Vec<usize> = (0..triangles.len()).step_by(BLOCK).collect();
    for round in blocks.chunks(ROUND) {
        let found: Vec<(Vec<(u32, u32)>, bool)> = round.par_iter().map(block_pairs).collect();
        for (pairs, cut) in found {
            if !visit(pairs, cut)? {
                return Ok(());
            }
        }
    }
    Ok(())
}

/// Number of pages that faces lie on.
pub(crate) fn page_count(atlas: &Atlas) -> usize {
    atlas.page.iter().map(|&p| usize::from(p) + 1).max().unwrap_or(0)
}

/// Those faces whose UVs are finite and whose exact area is not zero.
pub(crate) fn faces_with_area(atlas: &Atlas, faces: impl Iterator<Item = FaceId>) -> Vec<FaceId> {
    faces.filter(|&f| has_area(atlas, f)).collect()
}

fn has_area(atlas: &Atlas, face: FaceId) -> bool {
    let [a, b, c] = atlas.uv_triangle(face);
    a.is_finite() && b.is_finite() && c.is_finite() && orientation(a, b, c) != 0
}

/// The charts of an Atlas as bodies that can be tested against each other.
pub(crate) struct ChartBvhs {
    /// By chart: page and bounding box of the faces with an area; empty charts lie on no page.
    pub place: Vec<(u16, Bounds)>,
    trees: Vec<TriangleTree>,
}

impl ChartBvhs {
    pub(crate) fn new(atlas: &Atlas, charts: &Charts) -> Self {
        let tree =
            |faces: &Vec<FaceId>| TriangleTree::new(&turned(atlas, &faces_with_area(atlas, faces.iter().copied())));
        let trees: Vec<TriangleTree> = charts.faces.par_iter().map(tree).collect();
        let page = |faces: &Vec<FaceId>| faces.first().map_or(0, |f| atlas.page[f.index()]);
        let place = charts.faces.iter().zip(&trees).map(|(faces, own)| (page(faces), own.tree.bounds())).collect();
        ChartBvhs { place, trees }
    }

    /// Whether two charts overlap; stops at the first pair of faces.
    pub(crate) fn overlap(&self, a: usize, b: usize) -> bool {
        if self.place[a].0 != self.place[b].0 || !self.place[a].1.meets(&self.place[b].1) {
            return false;
        }
        let (a, b) = (&self.trees[a], &self.trees[b]);
        let (small, large) = if a.triangles.len() <= b.triangles.len() { (a, b) } else { (b, a) };
        let mut hit = false;
        small.tree.query(&large.tree.bounds(), 0, |p| {
            large.tree.query(&small.tree.bounds_at(p), 0, |q| {
                hit = turned_overlap(&small.triangles[p], &large.triangles[q]);
                !hit
            });
            !hit
        });
        hit
    }
}

/// The pairs of charts that overlap, each ascending, sorted. A pair is searched only until its first overlap.
pub fn overlapping_charts(atlas: &Atlas, charts: &Charts) -> Vec<(ChartId, ChartId)> {
    let bodies = ChartBvhs::new(atlas, charts);
    let boxes: Vec<Bounds> = bodies.place.iter().map(|p| p.1).collect();
    let tree = Bvh::new(&boxes);
    let mut pairs: Vec<(ChartId, ChartId)> = (0..charts.len())
        .into_par_iter()
        .flat_map_iter(|p| {
            let a = tree.order[p] as usize;
            let mut own = Vec::new();
            tree.query(&boxes[a], p + 1, |q| {
                let b = tree.order[q] as usize;
                if bodies.overlap(a, b) {
                    own.push((ChartId::new(a.min(b)), ChartId::new(a.max(b))));
                }
                true
            });
            own
        })
        .collect();
    pairs.par_sort_unstable();
    pairs
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::Topology;
    use crate::atlas::testing::{Rng, soup};

    fn tri(p: [[f64; 2]; 3]) -> [DVec2; 3] {
        p.map(DVec2::from)
    }

    #[test]
    fn touching_is_not_overlapping() {
        let a = tri([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]);
        let cases = [
            (tri([[1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), false), // shares an edge
            (tri([[0.25, 0.75], [2.0, 2.0], [0.75, 0.25]]), false), // lies along an edge
            (tri([[0.0, 0.0], [-1.0, 0.0], [0.0, -1.0]]), false), // shares a corner
            (a, true),                                          // the same
            ([a[0], a[2], a[1]], true),                         // mirrored
            (tri([[0.1, 0.1], [0.2, 0.1], [0.1, 0.2]]), true),  // inside
            (tri([[0.1, 0.1], [0.2, 0.2], [0.3, 0.3]]), false), // degenerate, inside
            (tri([[1.0 - 1e-13, 0.0], [2.0, 0.0], [2.0, 1.0]]), true), // by a hair
            (tri([[1.0 + 1e-13, 0.0], [2.0, 0.0], [2.0, 1.0]]), false),
        ];
        for (b, expected) in cases {
            assert_eq!(triangles_overlap(&a, &b), expected, "{b:?}");
            assert_eq!(triangles_overlap(&b, &a), expected, "{b:?} first");
        }
    }

    #[test]
    fn a_shared_edge_at_odd_coordinates_is_exact() {
        // Floating-point cross products of these get signs wrong; exact ones do not.
        let mut rng = Rng(7);
        let mut tried = 0;
        for _ in 0..2000 {
            let (p, q) = (rng.point(1.0) + DVec2::splat(1e6 / 3.0), rng.point(1.0) + DVec2::splat(1e6 / 3.0));
            let mut side = |s: f64| (p + q) * 0.5 + (q - p).perp() * s * (1e-9 + rng.unit());
            let (l, r) = (side(1.0), side(-1.0));
            if orientation(p, q, l) * orientation(p, q, r) < 0 {
                assert!(!triangles_overlap(&[p, q, l], &[q, p, r]));
                assert!(triangles_overlap(&[p, q, l], &[p, q, l]));
                tried += 1;
            }
        }
        assert!(tried > 500, "{tried} of 2000 lie on both sides of their edge");
    }

    #[test]
    fn all_pairs_are_found_and_no_other() {
        let mut rng = Rng(3);
        for size in [0.5, 3.0, 40.0] {
            let mut triangles: Vec<[DVec2; 3]> = (0..400)
                .map(|_| {
                    let p = rng.point(100.0);
                    [p, p + rng.point(size), p + rng.point(size)].map(|p| (p * 8.0).round() / 8.0)
                })
                .collect();
            triangles.push([DVec2::NAN; 3]);
            let mut atlas = soup(&triangles);
            for f in 0..triangles.len() {
                atlas.page[f] = (f % 2) as u16;
            }
            atlas.sheets.push([100, 100]);
            let charts = Charts::new(&Topology::new(&atlas));
            let found = overlaps(&atlas, &charts, usize::MAX);
            let mut expected = Vec::new();
            for i in 0..triangles.len() {
                for j in i + 1..triangles.len() {
                    if atlas.page[i] == atlas.page[j] && triangles_overlap(&triangles[i], &triangles[j]) {
                        expected.push((FaceId::new(i), FaceId::new(j)));
                    }
                }
            }
            assert!(!expected.is_empty() && !found.truncated && found.intra.is_empty());
            assert_eq!(found.inter, expected);
            let pairs: Vec<_> = expected.iter().map(|p| (ChartId(p.0.0), ChartId(p.1.0))).collect();
            assert_eq!(overlapping_charts(&atlas, &charts), pairs, "each face is a chart here");
        }
    }

    #[test]
    fn a_limit_is_kept_and_told() {
        let atlas = soup(&vec![tri([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]); 3000]);
        let charts = Charts::new(&Topology::new(&atlas));
        let found = overlaps(&atlas, &charts, 100);
        assert_eq!((found.inter.len(), found.truncated), (100, true));
        let one = rayon::ThreadPoolBuilder::new()
            .num_threads(1)
            .build()
            .map(|p| p.install(|| overlaps(&atlas, &charts, 100)));
        assert_eq!(one.ok(), Some(found), "the same for any number of threads");
    }

    #[test]
    fn penetration_is_the_shortest_way_out() {
        let a = tri([[0.0, 0.0], [4.0, 0.0], [0.0, 4.0]]);
        let b = a.map(|p| p + DVec2::new(0.0, 3.5));
        assert!((penetration(&a, &b) - 0.5 * 0.5f64.sqrt()).abs() < 1e-12, "{}", penetration(&a, &b));
        assert_eq!(penetration(&a, &a.map(|p| p + DVec2::new(4.0, 0.0))), 0.0);
    }
}
