use glam::DVec3;

use super::*;
use crate::atlas::{Charts, FaceId, Provenance, Topology, VertexId, overlaps};
use crate::error::Code;
use crate::refine::optcuts::operations::{Candidate, Operation};
use crate::refine::optcuts::pieces;

/// A surface of triangles without a layout.
fn surface(positions: Vec<DVec3>, triangles: Vec<[u32; 3]>) -> Atlas {
    let n = triangles.len();
    Atlas {
        surface: crate::atlas::Surface { positions, triangles: triangles.iter().map(|t| t.map(VertexId)).collect() },
        corners: vec![[Atlas::NO_UV; 3]; n],
        provenance: (0..n).map(|f| Provenance::whole(FaceId::new(f), 0)).collect(),
        page: vec![0; n],
        sheets: vec![[1024, 1024]],
        ..Atlas::default()
    }
}

/// Some faces of a surface without a layout.
fn part(whole: &Atlas, kept: &[FaceId]) -> Atlas {
    let faces = kept.iter().map(|f| whole.surface.triangles[f.index()].map(|v| v.0)).collect();
    surface(whole.surface.positions.clone(), faces)
}

/// An octahedron, each face divided `rounds` times into four, drawn out into something with two horns.
fn horned(rounds: usize) -> Atlas {
    let mut points = vec![DVec3::X, DVec3::Y, DVec3::Z, -DVec3::X, -DVec3::Y, -DVec3::Z];
    let mut faces: Vec<[u32; 3]> =
        vec![[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]];
    for _ in 0..rounds {
        let mut middle = std::collections::BTreeMap::new();
        let mut next = Vec::new();
        for [a, b, c] in faces {
            let [x, y, z] = [(a, b), (b, c), (c, a)].map(|(p, q)| {
                *middle.entry((p.min(q), p.max(q))).or_insert_with(|| {
                    points.push((points[p as usize] + points[q as usize]).normalize());
                    points.len() as u32 - 1
                })
            });
            next.extend([[a, x, z], [x, b, y], [z, y, c], [x, y, z]]);
        }
        faces = next;
    }
    let drawn = |p: DVec3| {
        let horn = |at: DVec3| 1.5 * (-(p - at.normalize()).length_squared() * 8.0).exp();
        p * (1.0 + horn(DVec3::new(1.0, 1.0, 0.2)) + horn(DVec3::new(-1.0, 0.5, 1.0)))
    };
    surface(points.into_iter().map(drawn).collect(), faces)
}

fn torus(n: u32) -> Atlas {
    let at = |i: u32, j: u32| (i % n) * n + j % n;
    let (mut points, mut faces) = (Vec::new(), Vec::new());
    for i in 0..n {
        for j in 0..n {
            let [a, b] = [i, j].map(|k| std::f64::consts::TAU * f64::from(k) / f64::from(n));
            let r = 1.0 + 0.4 * b.cos();
            points.push(DVec3::new(r * a.cos(), r * a.sin(), 0.4 * b.sin()));
            faces.push([at(i, j), at(i + 1, j), at(i, j + 1)]);
            faces.push([at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)]);
        }
    }
    surface(points, faces)
}

const NEVER: &(dyn Fn() -> Result<bool> + Sync) = &|| Ok(false);

fn settings(bound: f64, quality: Quality) -> Settings {
    Settings { bound, bijective: true, quality, search: Order::Default, polish: false, seed: 0, budget: None }
}

/// What a solution says of itself, and what the search promises, from scratch.
fn assert_holds(solution: &Solution, piece: &Atlas, settings: &Settings) {
    let atlas = &solution.atlas;
    assert_eq!(atlas.surface.triangles, piece.surface.triangles);
    assert!(solution.bound_met && solution.distortion <= settings.bound, "{}", solution.distortion);
    let energy = pieces::Strain::of(atlas).energy();
    assert!((energy - solution.distortion).abs() < 1e-9, "{energy} {}", solution.distortion);
    assert!((pieces::seam_length(atlas) - solution.seam_length).abs() < 1e-9 * solution.seam_length);
    assert!(atlas.faces().all(|f| atlas.uv_area(f) > 0.0));
    if settings.bijective {
        let found = overlaps(atlas, &Charts::new(&Topology::new(atlas)), 10);
        assert!(found.intra.is_empty() && found.inter.is_empty(), "{found:?}");
    }
}

#[test]
fn closed_surfaces_and_those_with_handles_are_flattened_within_the_bound_without_an_overlap() {
    for (piece, bound) in [(horned(3), 4.2), (torus(16), 4.3)] {
        for quality in [Quality::Fast, Quality::Balanced] {
            let settings = settings(bound, quality);
            let solution = solve(piece.clone(), None, &settings, NEVER).expect("it is never cancelled");
            assert_holds(&solution, &piece, &settings);
        }
    }
}

#[test]
fn the_published_loop_and_maps_that_may_overlap_hold_the_bound_too() {
    let piece = horned(2);
    for other in [
        Settings { search: Order::Paper, ..settings(4.4, Quality::Balanced) },
        Settings { bijective: false, ..settings(4.4, Quality::Balanced) },
    ] {
        let solution = solve(piece.clone(), None, &other, NEVER).expect("it is never cancelled");
        assert_holds(&solution, &piece, &other);
    }
}

#[test]
fn more_distortion_needs_shorter_seams_and_more_trials_find_no_longer_ones() {
    let piece = horned(2);
    let length = |bound, quality| {
        solve(piece.clone(), None, &settings(bound, quality), NEVER).expect("it is never cancelled").seam_length
    };
    assert!(length(4.8, Quality::Balanced) < length(4.2, Quality::Balanced));
    assert!(length(4.4, Quality::Best) <= length(4.4, Quality::Balanced));
}

#[test]
fn a_map_is_polished_from_where_it_is_and_keeps_its_bound() {
    let piece = horned(2);
    let first = solve(piece.clone(), None, &settings(4.2, Quality::Fast), NEVER).expect("it is never cancelled");
    let polish = Settings { polish: true, ..settings(first.distortion, Quality::Balanced) };
    let second = solve(first.atlas.clone(), None, &polish, NEVER).expect("it is never cancelled");
    assert_holds(&second, &piece, &polish);
    assert!(second.seam_length < first.seam_length, "{} of {}", second.seam_length, first.seam_length);
}

#[test]
fn the_same_comes_out_for_any_number_of_threads() {
    let one = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads are there");
        pool.install(|| solve(horned(2), None, &settings(4.3, Quality::Balanced), NEVER))
            .expect("it is never cancelled")
    };
    let (a, b) = (one(1), one(3));
    assert_eq!(a.atlas, b.atlas);
    assert_eq!(a.work, b.work);
}

#[test]
fn seams_stay_out_of_what_is_painted() {
    let piece = horned(3);
    let painted: Vec<f64> = piece.surface.positions.iter().map(|p| if p.y > 0.0 { 100.0 } else { 1.0 }).collect();
    let inside = |atlas: &Atlas| {
        let map = CutMap::new(atlas.clone(), None, false).expect("it has areas");
        let painted = map.seams().filter(|h| map.mesh.surface_ends(*h).iter().all(|v| painted[v.index()] > 1.0));
        painted.map(|h| map.edge_length(h)).sum::<f64>()
    };
    let of = |weights: Option<&[f64]>| {
        solve(piece.clone(), weights, &settings(4.3, Quality::Balanced), NEVER).expect("it is never cancelled")
    };
    let (free, bound) = (of(None), of(Some(&painted)));
    assert!(bound.bound_met);
    assert!(inside(&bound.atlas) < 0.6 * inside(&free.atlas), "{} {}", inside(&bound.atlas), inside(&free.atlas));
}

#[test]
fn what_is_interrupted_gives_the_best_so_far_and_what_is_cancelled_nothing() {
    let asked = std::sync::atomic::AtomicU64::new(0);
    let soon = || Ok(asked.fetch_add(1, std::sync::atomic::Ordering::Relaxed) > 5);
    let piece = horned(3);
    let solution =
        solve(piece.clone(), None, &settings(4.01, Quality::Balanced), &soon).expect("it is never cancelled");
    assert!(!solution.bound_met && solution.distortion > 4.01);
    assert_eq!(solution.stopped_by, "time_limit");
    assert!(solution.atlas.faces().all(|f| solution.atlas.uv_area(f) > 0.0));
    let cancelled = || Err(Failure::new(Code::Canceled, "the job was cancelled"));
    assert!(solve(piece, None, &settings(4.1, Quality::Fast), &cancelled).is_err_and(|e| e.code == Code::Canceled));
}

#[test]
fn a_surface_with_a_long_jagged_border_is_embedded_though_cuts_make_its_first_map_worse() {
    // Every other face of a band is gone, on the way around a ball.
    let whole = horned(3);
    let kept: Vec<FaceId> =
        whole.faces().filter(|f| f.index() % 5 != 0 || whole.triangle(*f)[0].z.abs() > 0.5).collect();
    let torn = part(&whole, &kept);
    let largest = pieces::divide(&torn, &vec![true; kept.len()]).build(&torn, &|_| false);
    let largest = largest.into_iter().max_by_key(|p| p.faces.len()).expect("it has faces").atlas;
    assert!(largest.face_count() > 100);
    let settings = settings(4.2, Quality::Fast);
    assert_holds(&solve(largest.clone(), None, &settings, NEVER).expect("it is never cancelled"), &largest, &settings);
}

#[test]
fn a_budget_of_work_is_kept_but_for_the_last_step() {
    let piece = horned(3);
    let limited = Settings { budget: Some(20_000), ..settings(4.02, Quality::Balanced) };
    let solution = solve(piece.clone(), None, &limited, NEVER).expect("it is never cancelled");
    assert_eq!(solution.stopped_by, "work_budget");
    assert!(solution.work < 20_000 + 2 * piece.surface.positions.len() as u64, "{}", solution.work);
    assert!(solution.atlas.faces().all(|f| solution.atlas.uv_area(f) > 0.0));
}

#[test]
fn an_operation_changes_what_its_query_says_and_can_be_undone() {
    let mut piece = horned(2);
    let area: f64 = piece.faces().map(|f| piece.area(f)).sum();
    piece.surface.positions.iter_mut().for_each(|p| *p *= (PI / area).sqrt());
    let mut map = CutMap::new(piece, None, true).expect("it has areas");
    start::embed(&mut map, 30.0, &|| Ok(false)).expect("it is never cancelled").expect("it can be embedded");
    let mut seen = [0; 4];
    for round in 0..30 {
        let mut all: Vec<Candidate> = Vec::new();
        for u in (0..map.x.len()).map(crate::atlas::UvId::new) {
            map.boundary_splits(u, &mut all);
            if round % 4 == 0 {
                map.interior_splits(u, &mut all);
            }
            all.extend(map.merge(u));
        }
        all.extend(map.borders.clone().iter().filter_map(|h| map.ear(*h)));
        for candidate in all.iter().step_by(7) {
            let (seam, energy) = (map.seam_length(), map.distortion());
            let (mark, x, borders) = (map.mesh.mark(), map.x.clone(), map.borders.clone());
            let again = map.query(candidate.operation).expect("it was there");
            assert_eq!((again.seam, again.energy), (candidate.seam, candidate.energy));
            map.apply(candidate);
            assert!((map.seam_length() - seam - candidate.seam).abs() < 1e-9, "{:?}", candidate.operation);
            let change = map.distortion() - energy;
            assert!((change - candidate.energy).abs() < 1e-9 * energy.max(1.0), "{:?}", candidate.operation);
            let mut listed = map.borders.clone();
            map.find_borders();
            listed.sort_unstable();
            assert_eq!(listed, map.borders, "{:?}", candidate.operation);
            seen[match candidate.operation {
                Operation::BoundarySplit(_) => 0,
                Operation::InteriorSplit(..) => 1,
                Operation::Merge(_) => 2,
                Operation::Ear(_) => 3,
            }] += 1;
            map.mesh.undo(mark);
            (map.x, map.borders) = (x, borders);
            assert_eq!((map.seam_length(), map.distortion()), (seam, energy));
        }
        // On to another state.
        let Some(next) = all.into_iter().filter(|c| c.energy.is_finite()).min_by(|a, b| a.energy.total_cmp(&b.energy))
        else {
            break;
        };
        map.apply(&next);
    }
    assert!(seen.iter().all(|n| *n > 0), "{seen:?}");
}
