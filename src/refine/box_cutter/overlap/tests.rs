use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use glam::DVec2;

use super::*;
use crate::atlas::overlap::overlaps_where;
use crate::atlas::testing::{Rng, atlas, join, sheet};
use crate::context::Silent;

/// A strip of quads along a curve, `across` quads wide: `at(t, s)` with both in 0..=1.
fn strip(along: usize, across: usize, at: impl Fn(f64, f64) -> DVec2) -> Atlas {
    let grid = sheet(across, along, DVec2::ZERO);
    let uv = grid.uv.iter().map(|p| at(p.y / along as f64, p.x / across as f64)).collect();
    atlas(uv, grid.corners)
}

/// A ring road 10 wide that runs `turns` times over itself: overlaps between sheets far from each other in the chart.
fn ring(turns: f64, along: usize, across: usize) -> Atlas {
    strip(along, across, |t, s| DVec2::from_angle(t * turns * std::f64::consts::TAU) * (20.0 + 10.0 * s))
}

fn self_overlaps(atlas: &Atlas) -> usize {
    let charts = Charts::new(&Topology::new(atlas));
    overlaps_where(atlas, usize::MAX, |a, b| charts.of_face[a.index()] == charts.of_face[b.index()]).0.len()
}

fn removed(atlas: &Atlas) -> Removed {
    let removed = remove_overlaps(atlas, &|_| true, None, &Context::silent()).unwrap();
    assert_eq!(self_overlaps(&removed.atlas), 0);
    assert_eq!(removed.atlas.surface, atlas.surface);
    for f in atlas.faces() {
        assert_eq!(removed.atlas.uv_triangle(f), atlas.uv_triangle(f), "cutting moves nothing");
    }
    let length = |a: &Atlas| border_length(a, &Topology::new(a));
    assert!((length(&removed.atlas) - length(atlas) - removed.cut_length).abs() < 1e-9);
    removed
}

/// Whether no two overlapping nodes share a label.
fn is_feasible(graph: &Graph, label: &[u32]) -> bool {
    (0..graph.len() as u32).all(|v| graph.conflicts(v).iter().all(|&u| label[u as usize] != label[v as usize]))
}

fn charts(atlas: &Atlas) -> usize {
    Charts::new(&Topology::new(atlas)).len()
}

#[test]
fn a_ring_road_is_cut_once_a_turn_straight_across() {
    for (turns, parts) in [(0.9, 1), (1.5, 2), (2.5, 3)] {
        let removed = removed(&ring(turns, 90, 3));
        assert_eq!(charts(&removed.atlas), parts, "{turns} turns");
        assert!((removed.cut_length - 20.0 * (parts - 1) as f64).abs() < 1e-6, "{}", removed.cut_length);
        assert_eq!(removed.charts_touched, usize::from(parts > 1));
        assert!(!removed.cut_short);
    }
}

#[test]
fn a_strip_that_laps_over_itself_at_two_bends_is_cut_straight_across_at_each() {
    // It is thin only in a place away from the bends.
    let strip = strip(80, 4, |t, s| {
        let angle = (t - 0.5) * 4.4;
        let curve = DVec2::new(angle.sin(), (2.0 * angle).sin() * 0.7) * 60.0;
        let half = if (0.48..0.52).contains(&t) { 1.0 } else { 6.0 };
        curve + DVec2::new(0.3, 1.0) * half * (s - 0.5)
    });
    assert!(self_overlaps(&strip) > 0);
    let removed = removed(&strip);
    let across = 6.0 * DVec2::new(0.3, 1.0).length();
    assert!((removed.cut_length - 4.0 * across).abs() < 1e-6, "{}", removed.cut_length);
}

#[test]
fn a_folded_sheet_is_cut_along_its_fold() {
    let mut folded = sheet(4, 4, DVec2::ZERO);
    folded.uv.iter_mut().filter(|p| p.x > 2.0).for_each(|p| p.x = 4.0 - p.x);
    let removed = removed(&folded);
    assert_eq!(charts(&removed.atlas), 2);
    assert_eq!(removed.cut_length, 8.0);
}

#[test]
fn flipped_triangles_inside_a_sheet_are_cut_out() {
    let mut sheet = sheet(6, 6, DVec2::ZERO);
    // Across the opposite edge of one triangle: no border takes part.
    sheet.uv[3 * 7 + 3] += DVec2::new(1.2, 0.4);
    assert!(self_overlaps(&sheet) > 0);
    let removed = removed(&sheet);
    assert!(charts(&removed.atlas) >= 2);
}

#[test]
fn charts_without_overlap_and_untouchable_ones_stay_bit_for_bit() {
    let clean = sheet(3, 3, DVec2::splat(50.0));
    let both = join(&clean, &ring(1.5, 60, 2));
    let removed = removed(&both);
    let n = clean.face_count();
    assert_eq!(removed.atlas.corners[..n], both.corners[..n]);
    assert_eq!(removed.atlas.uv[..both.uv.len()], both.uv[..]);
    let kept = remove_overlaps(&both, &|c| c.0 == 0, None, &Context::silent()).unwrap();
    assert_eq!((kept.atlas, kept.charts_touched, kept.cut_length), (both, 0, 0.0));
}

#[test]
fn faces_that_crowd_on_one_edge_are_parted() {
    // Three fins on the edge 0-1, two of them over each other: adjacency alone knows only one pair.
    let uv = [[0.0, 0.0], [4.0, 0.0], [0.0, 4.0], [1.0, 4.0], [2.0, -4.0]].map(DVec2::from).to_vec();
    let fins = [[0, 1, 2], [0, 1, 3], [0, 1, 4]].map(|c| c.map(UvId));
    let fins = atlas(uv, fins.to_vec());
    assert!(self_overlaps(&fins) > 0);
    assert!(charts(&removed(&fins).atlas) >= 2);
}

#[test]
fn importance_moves_the_cut() {
    let ring = ring(1.5, 60, 2);
    let topology = Topology::new(&ring);
    // Free to cut only within the quads 28 to 30 along the strip (four faces each).
    let dear = |h: HalfEdge| if (28..30).contains(&(h.face().0 / 4)) { 1.0 } else { 50.0 };
    let removed = remove_overlaps(&ring, &|_| true, Some(&dear), &Context::silent()).unwrap();
    let after = Topology::new(&removed.atlas);
    let cuts: Vec<HalfEdge> = after.half_edges().filter(|h| after.is_border(*h) && !topology.is_border(*h)).collect();
    assert!(!cuts.is_empty() && cuts.iter().all(|h| (27..31).contains(&(h.face().0 / 4))), "{cuts:?}");
}

#[test]
fn whatever_comes_in_nothing_overlaps_and_threads_do_not_matter() {
    let mut rng = Rng(11);
    for round in 0..25 {
        let mut sheet = sheet(9, 9, DVec2::ZERO);
        let amount = [0.5, 1.0, 3.0, 12.0][round % 4];
        sheet.uv.iter_mut().for_each(|p| *p += rng.point(amount));
        if round == 24 {
            sheet.uv[30] = DVec2::NAN;
        }
        let with = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| remove_overlaps(&sheet, &|_| true, None, &Context::silent()).unwrap().atlas)
        };
        let (one, four) = (with(1), with(4));
        // Debug text: NaN is not equal to itself.
        assert_eq!(format!("{one:?}"), format!("{four:?}"));
        assert_eq!(self_overlaps(&one), 0);
    }
}

#[test]
fn growing_apart_needs_no_pairs_and_leaves_no_overlap() {
    let ring = ring(4.5, 200, 3);
    let topology = Topology::new(&ring);
    let scale = Scale::new(&ring, &topology, None);
    let faces: Vec<FaceId> = ring.faces().collect();
    let bare = graph::build(&scale, &faces, &[]);
    let label = grow::grow(&ring, &bare, &mut 0, &Context::silent()).unwrap();
    let full = graph::build(&scale, &faces, &graph::list_pairs(&ring, &faces, &Context::silent()).unwrap());
    assert!(is_feasible(&full, &label));
    assert!(label.iter().max().is_some_and(|m| *m <= 12), "a sheet is as large as it can be");
    assert_eq!(graph::count_pairs(&ring, &faces, 10, &Context::silent()).unwrap(), None);
}

/// A band, closed on the surface, unrolled to a straight, 1.2 turns of a ring and a straight: it overlaps itself, but cut open in
/// the middle of the ring instead of where it was, it would not.
fn unrolled_band() -> Atlas {
    let (straight, turn) = (50.0, 1.2 * std::f64::consts::TAU);
    let along = 144;
    let mut band = strip(along, 3, |t, s| {
        let d = t * (2.0 * straight + 25.0 * turn);
        let angle = ((d - straight) / 25.0).clamp(0.0, turn);
        let before = (d - straight).min(0.0);
        let after = (d - straight - 25.0 * turn).max(0.0);
        let heading = DVec2::from_angle(angle);
        heading * (before + after) + heading.perp() * (10.0 * s - 30.0)
    });
    let last = along as u32 * 4;
    band.surface.triangles.iter_mut().flatten().filter(|v| v.0 >= last).for_each(|v| v.0 -= last);
    band
}

#[test]
fn a_cut_that_can_be_welded_costs_nothing_in_the_end() {
    let band = unrolled_band();
    let topology = Topology::new(&band);
    let scale = Scale::new(&band, &topology, None);
    assert_eq!(graph::bias_edges(&scale, &Charts::new(&topology), &[true]).len(), 3);
    let removed = removed(&band);
    assert_eq!(charts(&removed.atlas), 2);
    assert!((removed.cut_length - 20.0).abs() < 1e-6);
    let welded = weld::weld(&removed.atlas, &|_| true, f64::INFINITY, &|_| Ok(0.0), &Context::silent()).unwrap();
    assert_eq!((charts(&welded.atlas), self_overlaps(&welded.atlas)), (1, 0));
    assert!((welded.boundary_saved - 20.0).abs() < 1e-4);
}

#[test]
fn bias_is_counted_when_asked_for() {
    // A chain of six, the ends of which had better part, though nothing overlaps.
    let near: Vec<_> = (0..5).map(|v| (v, v + 1, if v == 2 { 1 } else { 5 })).collect();
    let graph = Graph::from_edges(6, &near, &[(0, 5, 4)], &[]);
    let solved = solve::solve(&graph, u64::MAX, &Context::silent()).unwrap();
    assert_eq!((graph.cost(&solved.label), optimum(&graph)), (-3, -3));
}

#[test]
fn a_cancelled_job_ends() {
    let context = Context::new(Arc::new(Silent), Arc::new(AtomicBool::new(true)), 0);
    assert!(remove_overlaps(&ring(1.5, 60, 2), &|_| true, None, &context).is_err());
}

/// The least cost of any division into connected clusters without conflict, by trying all.
fn optimum(graph: &Graph) -> i64 {
    fn all(graph: &Graph, label: &mut Vec<u32>, used: u32, best: &mut i64) {
        if label.len() == graph.len() {
            let parts = Partition::from_labels(graph, label.clone()).members.iter().filter(|m| !m.is_empty()).count();
            if parts as u32 == used && is_feasible(graph, label) {
                *best = (*best).min(graph.cost(label));
            }
            return;
        }
        for l in 0..=used {
            label.push(l);
            all(graph, label, used.max(l + 1), best);
            label.pop();
        }
    }
    let mut best = i64::MAX;
    all(graph, &mut Vec::new(), 0, &mut best);
    best
}

#[test]
fn small_graphs_are_solved_as_well_as_by_trying_everything() {
    let mut rng = Rng(21);
    let (mut equal, mut rounds) = (0, 0);
    for round in 0..60 {
        // A grid of 2 x 4 nodes, some pairs in conflict, and in every other round some bias.
        let mut near = Vec::new();
        for v in 0..8u32 {
            let mut weight = || 1 + (rng.unit() * 100.0) as i64;
            if v % 4 < 3 {
                near.push((v, v + 1, weight()));
            }
            if v < 4 {
                near.push((v, v + 4, weight()));
            }
        }
        let mut pair = || {
            let (a, b) = ((rng.unit() * 8.0) as u32, (rng.unit() * 8.0) as u32);
            (a.min(b), a.max(b))
        };
        let mut conflicts: Vec<_> = (0..3).map(|_| pair()).filter(|p| p.0 != p.1).collect();
        conflicts.sort_unstable();
        conflicts.dedup();
        let bias: Vec<_> =
            (0..2 * (round % 2)).map(|_| pair()).filter(|p| p.0 != p.1).map(|p| (p.0, p.1, 90)).collect();
        let graph = Graph::from_edges(8, &near, &bias, &conflicts);
        let best = optimum(&graph);
        let ours = solve::solve(&graph, u64::MAX, &Context::silent()).unwrap();
        assert!(is_feasible(&graph, &ours.label));
        assert!(graph.cost(&ours.label) >= best);
        rounds += 1;
        equal += usize::from(graph.cost(&ours.label) == best);
        assert!(graph.cost(&ours.label) - best <= 60, "round {round}: {} against {best}", graph.cost(&ours.label));
    }
    assert!(10 * equal >= 9 * rounds, "{equal} of {rounds} optimal");
}
