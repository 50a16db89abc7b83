//! What every layout must keep, of the thorough search and of the fast one where pieces are many.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use glam::{DMat2, DVec2};

use crate::context::{Context, Silent};
use crate::packing::random::Random;
use crate::packing::{PackSearch, Rotation};
use crate::packing::{Packing, Piece, Request, Rounding, Spacing, pack, pack_into};

/// Stars: concave, so that they interlock.
fn stars(seed: u64, n: usize) -> Vec<Piece> {
    let mut random = Random::new(seed);
    let star = |_| {
        let (points, size) = (5 + random.below(8), 15.0 + 40.0 * random.unit());
        let boundary: Vec<DVec2> = (0..points)
            .map(|k| {
                let radius = size * (0.3 + 0.7 * random.unit());
                DVec2::from_angle(std::f64::consts::TAU * k as f64 / points as f64) * radius
            })
            .collect();
        let next = |k: usize| boundary[(k + 1) % points];
        let triangles: Vec<[DVec2; 3]> = (0..points).map(|k| [DVec2::ZERO, boundary[k], next(k)]).collect();
        let area = triangles.iter().map(|t| 0.5 * (t[1] - t[0]).perp_dot(t[2] - t[0]).abs()).sum();
        Piece { border: (0..points).map(|k| next(k) - boundary[k]).collect(), triangles, area, ..Piece::default() }
    };
    (0..n).map(star).collect()
}

fn request(pieces: &[Piece]) -> Request<'_> {
    Request {
        starts: &[],
        pieces,
        rotation: Rotation::Any,
        mirror: false,
        spacing: Spacing { gutter: 0.0, margin: 0.0, lattice: None, unit: 1.0 },
        aspect: None,
        max: [4096.0; 2],
        round: Rounding::Free,
        search: PackSearch::Thorough,
        work_budget: Some(30_000_000),
        effort: 1.0,
        scale: 1.0,
    }
}

fn packed(request: &Request<'_>) -> Packing {
    seeded(request, 7)
}

fn seeded(request: &Request<'_>, seed: u64) -> Packing {
    let context = Context::new(Arc::new(Silent), Arc::new(AtomicBool::new(false)), seed);
    pack(request, &context).unwrap_or_else(|e| panic!("{e:?}"))
}

/// The distance of two triangles in the maximum norm, or less: over the axes that can separate them once one has grown by a square.
fn gap(a: &[DVec2; 3], b: &[DVec2; 3]) -> f64 {
    let normals = [a, b].into_iter().flat_map(|t| (0..3).map(|k| (t[(k + 1) % 3] - t[k]).perp()));
    let axes = normals.chain([DVec2::X, DVec2::Y]).filter(|n| n.length() > 1e-12);
    let range = |t: &[DVec2; 3], n: DVec2| {
        t.iter().map(|p| p.dot(n)).fold((f64::INFINITY, f64::NEG_INFINITY), |r, x| (r.0.min(x), r.1.max(x)))
    };
    axes.map(|n| {
        let (p, q) = (range(a, n), range(b, n));
        (q.0 - p.1).max(p.0 - q.1) / (n.x.abs() + n.y.abs())
    })
    .fold(f64::NEG_INFINITY, f64::max)
}

/// Pieces keep the gutter between them and the margin to the sheet's sides.
fn check(request: &Request<'_>, packing: &Packing) {
    let Spacing { gutter, margin, .. } = request.spacing;
    assert_eq!(packing.placements.len(), request.pieces.len());
    let placed: Vec<Vec<[DVec2; 3]>> = request
        .pieces
        .iter()
        .zip(&packing.placements)
        .map(|(piece, at)| piece.triangles.iter().map(|t| t.map(|p| at.linear * p + at.translate)).collect())
        .collect();
    let [w, h] = packing.sheets[0];
    for (i, a) in placed.iter().enumerate() {
        for p in a.iter().flatten() {
            let inside = p.min_element() >= margin - 1e-6 && p.x <= w - margin + 1e-6 && p.y <= h - margin + 1e-6;
            assert!(inside, "piece {i} at {p} on {w} x {h}");
        }
        for (j, b) in placed.iter().enumerate().skip(i + 1) {
            let least = a.iter().flat_map(|s| b.iter().map(|t| gap(s, t))).fold(f64::INFINITY, f64::min);
            assert!(least >= gutter - 1e-6, "pieces {i} and {j} are {least} apart");
        }
    }
}

fn area(packing: &Packing) -> f64 {
    packing.sheets[0][0] * packing.sheets[0][1]
}

#[test]
fn layouts_do_not_overlap_and_are_not_worse_than_the_fast_ones() {
    for seed in 0..4 {
        let pieces = stars(seed, 4 + 5 * seed as usize);
        let thorough = request(&pieces);
        let best = packed(&thorough);
        check(&thorough, &best);
        let greedy = Request { search: PackSearch::Fast, work_budget: Some(2_400_000), ..thorough.clone() };
        let fast = packed(&greedy);
        check(&greedy, &fast);
        assert!(area(&best) <= area(&fast) * (1.0 + 1e-9), "{} {}", area(&best), area(&fast));
    }
}

#[test]
fn gutters_margins_and_lattices_are_kept() {
    let pieces = stars(9, 9);
    for (lattice, unit) in [(None, 1.0), (Some(1.0), 1.0), (Some(4.0), 1.0), (Some(6.0), 3.0)] {
        let spacing = Spacing { gutter: 4.0 * unit, margin: lattice.unwrap_or(2.0), lattice, unit };
        let rotation = if lattice.is_some() { Rotation::Quarter } else { Rotation::Any };
        for round in [Rounding::MultipleOf(4.0), Rounding::PowerOfTwo(4.0)] {
            let request = Request { spacing, rotation, round, mirror: true, ..request(&pieces) };
            let packing = packed(&request);
            check(&request, &packing);
            for at in &packing.placements {
                let Some(lattice) = lattice else { continue };
                let steps = at.translate / lattice;
                assert!((steps - steps.round()).abs().max_element() < 1e-9, "{steps}");
                assert_eq!(at.linear.to_cols_array().map(f64::abs).iter().sum::<f64>(), 2.0);
            }
        }
    }
}

#[test]
fn the_seed_chooses_the_layout() {
    let pieces = stars(6, 20);
    let thorough = request(&pieces);
    let fast = Request { search: PackSearch::Fast, work_budget: Some(4_000_000), ..thorough.clone() };
    for request in [fast, thorough] {
        let layouts = [0, 1, 2].map(|seed| seeded(&request, seed));
        for (seed, layout) in layouts.iter().enumerate() {
            check(&request, layout);
            assert_eq!(*layout, seeded(&request, seed as u64));
            let same = layouts.iter().filter(|other| other.placements == layout.placements).count();
            assert_eq!(same, 1, "the layout of seed {seed} is that of another");
        }
    }
}

#[test]
fn the_number_of_threads_does_not_matter() {
    let pieces = stars(5, 11);
    let request = request(&pieces);
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        pool.unwrap_or_else(|e| panic!("{e}")).install(|| packed(&request))
    };
    assert_eq!(with(1), with(4));
}

/// More pieces than are placed without short cuts, every other one free to turn.
#[test]
fn of_many_pieces_gutters_and_lattice_are_kept_and_free_ones_turn() {
    let mut pieces = stars(2, 340);
    for (n, piece) in pieces.iter_mut().enumerate() {
        piece.free = n % 2 == 0;
    }
    let spacing = Spacing { gutter: 4.0, margin: 4.0, lattice: Some(4.0), unit: 1.0 };
    let fast = Request {
        spacing,
        rotation: Rotation::Quarter,
        search: PackSearch::Fast,
        work_budget: Some(2_000_000),
        ..request(&pieces)
    };
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        pool.unwrap_or_else(|e| panic!("{e}")).install(|| packed(&fast))
    };
    let packing = with(1);
    assert_eq!(packing, with(4));
    check(&fast, &packing);
    let (mut free, mut turned) = (0, 0);
    for (piece, at) in pieces.iter().zip(&packing.placements) {
        let quarters = (at.linear.to_cols_array().map(f64::abs).iter().sum::<f64>() - 2.0).abs() < 1e-9;
        if piece.free {
            free += 1;
            turned += usize::from(!quarters);
            continue;
        }
        let steps = at.translate / 4.0;
        assert!(quarters && (steps - steps.round()).abs().max_element() < 1e-9, "{at:?}");
    }
    assert!(turned * 2 > free, "{turned} of {free}");
}

#[test]
fn a_sheet_of_fixed_size_is_filled_better() {
    let pieces = stars(3, 10);
    let thorough = Request { work_budget: Some(60_000_000), ..request(&pieces) };
    let fast = Request { search: PackSearch::Fast, work_budget: Some(6_000_000), ..thorough.clone() };
    let fit = |r: &Request<'_>| match pack_into(r, [512.0, 256.0], f64::INFINITY, &Context::silent()) {
        Ok(Some(fitted)) => fitted,
        other => panic!("{other:?}"),
    };
    let best = fit(&thorough);
    check(&thorough, &best.packing);
    assert!(best.scale >= fit(&fast).scale * 0.99);
    let scale = |m: DMat2| m.determinant().sqrt();
    assert!(best.packing.placements.iter().all(|p| (scale(p.linear) - best.scale).abs() < 1e-9 * best.scale));
}

#[test]
fn a_cancelled_job_stops() {
    let cancelled = Context::new(Arc::new(Silent), Arc::new(AtomicBool::new(true)), 0);
    assert!(pack(&request(&stars(1, 6)), &cancelled).is_err());
}
