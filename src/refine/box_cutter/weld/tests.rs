use glam::{DMat2, DVec2};

use super::*;
use crate::atlas::overlap::overlaps_where;
use crate::atlas::testing::{cut_open, half_edges_where, sheet};
use crate::atlas::{Move, VertexId};

/// A strip of `parts` sheets of 2 x 3 squares, cut apart, each turned and set aside: a jigsaw that fits.
fn jigsaw(parts: usize) -> Atlas {
    let whole = sheet(2 * parts, 3, DVec2::ZERO);
    let cut = cut_open(&whole, &half_edges_where(&whole, |a, b| a.x == b.x && a.x % 2.0 == 0.0));
    let charts = Charts::new(&Topology::new(&cut));
    assert_eq!(charts.len(), parts);
    let moves: Vec<Move> = (0..parts)
        .map(|c| Move {
            page: 0,
            linear: DMat2::from_angle(0.7 * c as f64),
            translate: DVec2::new(0.3, 20.0 * c as f64),
        })
        .collect();
    cut.moved(&charts, &moves, vec![[100, 100]])
}

fn chart_count(atlas: &Atlas) -> usize {
    Charts::new(&Topology::new(atlas)).len()
}

fn overlap_free(atlas: &Atlas) -> bool {
    overlaps_where(atlas, 10, |_, _| true).0.is_empty()
}

fn free(_: &Atlas) -> Result<f64> {
    Ok(1.0)
}

#[test]
fn a_jigsaw_is_put_together() {
    let apart = jigsaw(5);
    let welded = weld(&apart, &|_| true, 0.1, &free, &Context::silent()).unwrap();
    assert_eq!((chart_count(&welded.atlas), welded.welds, welded.undone), (1, 4, 0));
    assert!((welded.boundary_saved - 24.0).abs() < 1e-6, "{}", welded.boundary_saved);
    assert_eq!(welded.atlas.uv.len(), 11 * 4, "vertices are one again");
    assert!(overlap_free(&welded.atlas));
    let again = weld(&welded.atlas, &|_| true, 0.1, &free, &Context::silent()).unwrap();
    assert_eq!((again.welds, again.atlas), (0, welded.atlas));
}

#[test]
fn rounding_to_float32_is_forgiven() {
    let mut apart = jigsaw(3);
    apart.uv.iter_mut().for_each(|p| *p = (*p / 100.0).as_vec2().as_dvec2() * 100.0);
    let welded = weld(&apart, &|_| true, 0.1, &free, &Context::silent()).unwrap();
    assert_eq!(chart_count(&welded.atlas), 1);
    assert!(overlap_free(&welded.atlas));
}

#[test]
fn mirrored_and_stretched_charts_and_untouchable_ones_are_left_alone() {
    for linear in [DMat2::from_diagonal(DVec2::new(-1.0, 1.0)), DMat2::from_diagonal(DVec2::new(1.0, 1.01))] {
        let apart = jigsaw(2);
        let charts = Charts::new(&Topology::new(&apart));
        let stay = Move { page: 0, linear: DMat2::IDENTITY, translate: DVec2::ZERO };
        let odd = apart.moved(&charts, &[stay, Move { linear, ..stay }], vec![[100, 100]]);
        let welded = weld(&odd, &|_| true, 0.1, &free, &Context::silent()).unwrap();
        assert_eq!((welded.welds, welded.atlas), (0, odd));
    }
    let apart = jigsaw(3);
    let welded = weld(&apart, &|c| c.0 != 1, 0.1, &free, &Context::silent()).unwrap();
    assert_eq!((welded.welds, welded.atlas), (0, apart), "both seams are with the chart in the middle");
}

#[test]
fn a_cylinder_cut_open_twice_is_closed_once() {
    // Columns 0 and 8 are one line on the surface: the second seam of the unrolled cylinder cannot close in the plane.
    let mut tube = jigsaw(4);
    let at = |p: glam::DVec3| (p.x == 8.0).then_some(p.y);
    let first = |y: f64| tube.surface.positions.iter().position(|p| p.x == 0.0 && p.y == y);
    let home: Vec<Option<usize>> = tube.surface.positions.iter().map(|&p| at(p).and_then(first)).collect();
    for v in tube.surface.triangles.iter_mut().flatten() {
        if let Some(home) = home[v.index()] {
            *v = VertexId::new(home);
        }
    }
    let topology = Topology::new(&tube);
    assert_eq!(topology.half_edges().filter(|h| topology.surface_twin(*h).is_none()).count(), 16);
    let welded = weld(&tube, &|_| true, 0.1, &free, &Context::silent()).unwrap();
    assert_eq!((chart_count(&welded.atlas), welded.welds), (1, 3));
    assert!((welded.boundary_saved - 18.0).abs() < 1e-6 && overlap_free(&welded.atlas));
}

#[test]
fn charts_that_would_overlap_stay_apart() {
    // A corner of the second piece is drawn out so far that it would lie over the first.
    let mut apart = jigsaw(2);
    let turn = DMat2::from_angle(0.7);
    let shift = DVec2::new(0.3, 20.0);
    let corner = apart.uv.iter().position(|p| (*p - shift - turn * DVec2::new(4.0, 3.0)).length() < 1e-9);
    apart.uv[corner.unwrap()] = turn * DVec2::new(1.2, 1.5) + shift;
    let welded = weld(&apart, &|_| true, 0.1, &free, &Context::silent()).unwrap();
    assert_eq!((welded.welds, welded.atlas), (0, apart));
}

#[test]
fn packing_that_suffers_takes_welds_back() {
    let apart = jigsaw(6);
    // Worse by 0.15 as soon as fewer than three charts are left.
    let efficiency = |a: &Atlas| Ok(if chart_count(a) < 3 { 0.5 } else { 0.65 });
    let welded = weld(&apart, &|_| true, 0.1, &efficiency, &Context::silent()).unwrap();
    assert_eq!(chart_count(&welded.atlas), 3);
    assert_eq!(welded.welds, 3);
    assert!(welded.undone >= 1);
    let none = weld(&apart, &|_| true, 0.1, &|a| Ok(chart_count(a) as f64), &Context::silent()).unwrap();
    assert_eq!((none.welds, none.atlas), (0, apart));
}

#[test]
fn slits_that_are_shut_become_whole() {
    let whole = sheet(3, 3, DVec2::ZERO);
    let topology = Topology::new(&whole);
    let inner = topology.half_edges().find(|h| !topology.is_border(*h)).unwrap();
    let more: Vec<_> = topology.half_edges().filter(|h| h.face() == inner.face() || h.face().0 == 9).collect();
    let slit = cut_open(&whole, &more);
    let welded = weld(&slit, &|_| true, f64::INFINITY, &free, &Context::silent()).unwrap();
    assert_eq!(chart_count(&welded.atlas), 1);
    assert_eq!(welded.atlas.uv.len(), whole.uv.len());
}

#[test]
fn threads_do_not_matter() {
    let apart = jigsaw(9);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| weld(&apart, &|_| true, 0.1, &free, &Context::silent()).unwrap().atlas)
    };
    assert_eq!(with(1), with(4));
}
