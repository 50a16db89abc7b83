//! The construction piece by piece, and the stage as a whole.

use std::f64::consts::{FRAC_PI_2, TAU};

use glam::DVec3;

use super::angles::{global_rotation, smoothed, targets, turns};
use super::arrangement::arrange;
use super::construct::AlignedDisk;
use super::*;
use crate::atlas::testing::{Rng, atlas as made, cut_open, join, sheet, soup};
use crate::atlas::{Exactness, UvId, check, orientation};
use crate::context::Context;
use crate::metrics::{MeasureInputs, measure};
use crate::packing::Gutter;
use crate::refine::options::{IfLarger, Options};
use crate::refine::stage::SheetInfo;
use crate::texture::Size;

fn options(gutter: u32, overlaps: OverlapMode) -> Options {
    let mut options = Options::default();
    options.atlas.if_larger = IfLarger::Accept;
    options.atlas.overlaps = overlaps;
    options.pack.gutter = Gutter::Texels(gutter);
    options
}

fn run(atlas: &Atlas, params: &Bounded, options: &Options) -> (Staged, Vec<String>) {
    let context = Context::silent();
    let info = SheetInfo::plain();
    let input = StageInput { atlas, sheet_info: &info, importance: None, options, context: &context };
    let staged = bounded(&input, params).unwrap();
    assert_eq!(check(atlas, &staged.atlas, Exactness::Exact), Ok(()));
    (staged, context.warnings().into_iter().map(|w| w.code).collect())
}

/// No two faces overlap, no face is turned over, and the bound holds, all told by others.
fn is_packed(staged: &Staged, bound: f64) {
    let after = &staged.atlas;
    let charts = Charts::new(&Topology::new(after));
    let found = overlaps(after, &charts, 10);
    assert!(found.intra.is_empty() && found.inter.is_empty(), "{found:?}");
    let own = efficiency(after);
    assert!(own >= bound - 1e-6, "{own} {:?}", staged.figures);
    assert_eq!(staged.figures["bound_met"], true);
}

/// A sheet of squares without those for which `is_out` says so, bent a little.
fn shape(nx: usize, ny: usize, is_out: impl Fn(usize, usize) -> bool, bend: f64) -> Atlas {
    let whole = sheet(nx, ny, DVec2::ZERO);
    let kept: Vec<FaceId> = whole.faces().filter(|f| !is_out(f.index() / 2 % nx, f.index() / 2 / nx)).collect();
    let mut out = whole.subset(&kept);
    for (i, p) in &mut out.provenance.iter_mut().enumerate() {
        p.source = FaceId::new(i);
    }
    for p in &mut out.uv {
        *p = DVec2::new(p.x + bend * (0.7 * p.y).sin(), p.y + bend * (0.5 * p.x).cos()) + 10.0;
    }
    out
}

#[test]
fn smoothing_keeps_the_whole_turn_and_the_rotation_is_the_best_of_many() {
    let mut rng = Rng(1);
    for _ in 0..50 {
        let n = 40;
        let lengths: Vec<f64> = (0..n).map(|_| 0.5 + rng.unit()).collect();
        let angles: Vec<f64> = (0..n).map(|i| TAU * i as f64 / n as f64 + rng.unit()).collect();
        let total: f64 = lengths.iter().sum();
        let own = smoothed(&angles, &lengths, 0.03 * total);
        // Each edge turns by less than half a turn, so that none has lost its count.
        assert!(own.iter().zip(&angles).all(|(a, b)| (a - b).abs() < std::f64::consts::PI));
        let energy = |by: f64| -> f64 {
            let of = |(a, l): (&f64, &f64)| l * ((a + by).cos() * (a + by).sin()).powi(2);
            own.iter().zip(&lengths).map(of).sum()
        };
        let best = energy(global_rotation(&own, &lengths));
        assert!((0..360).all(|k| best <= energy(f64::from(k) * TAU / 360.0) + 1e-9));
    }
}

#[test]
fn target_angles_are_those_that_trying_all_finds() {
    let mut rng = Rng(2);
    for round in 0..60 {
        let n = 6;
        let lengths: Vec<f64> = (0..n).map(|_| 0.2 + rng.unit()).collect();
        let angles: Vec<f64> = (0..n).map(|i| TAU * (i as f64 + 0.8 * rng.unit()) / n as f64).collect();
        let corner = 0.1 * f64::from(round % 5);
        let own = targets(&angles, &lengths, corner).unwrap();
        let cost = |labels: &[i32]| -> f64 {
            let fit = |i: usize| lengths[i] * (angles[i] - f64::from(labels[i]) * FRAC_PI_2).powi(2);
            let turn = |k: &i32| if (-1..=1).contains(k) { corner * f64::from(k.abs()) } else { f64::INFINITY };
            (0..n).map(fit).sum::<f64>() + turns(labels).iter().map(turn).sum::<f64>()
        };
        assert_eq!(turns(&own).iter().sum::<i32>(), 4);
        // The edge that the search starts from keeps the label next to it.
        let nearest = |i: usize| (angles[i] / FRAC_PI_2).round() as i32;
        let longest = lengths.iter().copied().fold(0.0, f64::max);
        let off = |i: usize| (angles[i] - f64::from(nearest(i)) * FRAC_PI_2).abs();
        let long = (0..n).filter(|&i| lengths[i] >= 0.5 * longest);
        let start = long.min_by(|&a, &b| off(a).total_cmp(&off(b))).unwrap();
        let mut least = f64::INFINITY;
        for code in 0..5usize.pow(n as u32) {
            let labels: Vec<i32> = (0..n).map(|i| nearest(i) + (code / 5usize.pow(i as u32) % 5) as i32 - 2).collect();
            if labels[start] == nearest(start) {
                least = least.min(cost(&labels));
            }
        }
        assert!((cost(&own) - least).abs() < 1e-9, "{} {least}", cost(&own));
    }
    assert_eq!(targets(&[0.0, 2.0, 4.0], &[1.0; 3], 0.1), None, "three edges have no four corners");
}

/// The only disk of an Atlas, axis-aligned.
fn aligned(atlas: &Atlas) -> (Constructed, AlignedDisk) {
    let interrupt = || Ok(());
    let prepared = prepare(atlas, &vec![false; atlas.face_count()], &interrupt).unwrap();
    let how = Construction { sigma: 0.004, corner: 0.05, target: Target::Surface, part: f64::INFINITY };
    let made = construct(&prepared, &how, None, &interrupt).unwrap();
    assert_eq!(made.disks.len(), 1);
    let disk = made.disks[0].clone();
    (made, disk)
}

#[test]
fn a_bent_l_becomes_an_l_of_three_cells() {
    let start = shape(8, 8, |x, y| x >= 4 && y >= 4, 0.4);
    let (made, disk) = aligned(&start);
    assert!(!disk.is_fallback && disk.map.is_valid());
    let targets: Vec<i32> = disk.map.polar_angles().iter().map(|a| (a / FRAC_PI_2).round() as i32).collect();
    let k = turns(&targets);
    assert_eq!((k.iter().filter(|k| **k == 1).count(), k.iter().filter(|k| **k == -1).count()), (5, 1));
    for (run, axis) in deform::runs(&targets) {
        let line = disk.map.x[disk.map.boundary[run[0]] as usize][axis];
        assert!(run.iter().all(|i| disk.map.x[disk.map.boundary[*i] as usize][axis] == line), "sides are straight");
    }
    assert_eq!((disk.arrangement.cells.len(), disk.arrangement.motorcycles.len()), (3, 2));
    let cells: f64 = disk.arrangement.cells.iter().map(|c| c.size().element_product()).sum();
    assert!((cells - disk.map.area()).abs() < 1e-9 * cells, "cells cover the chart");
    // The same trails with places on the sides too.
    let more: Vec<usize> = (0..disk.map.boundary.len()).step_by(3).collect();
    let more = arrange(&made.mesh, &disk.map, &targets, &more, &|_| 1.0).unwrap();
    let again: f64 = more.cells.iter().map(|c| c.size().element_product()).sum();
    assert!(more.cells.len() > 3 && (again - cells).abs() < 1e-9 * cells);
}

#[test]
fn neighbours_are_halved_where_the_cut_of_one_divides_an_edge_of_the_other() {
    let whole = sheet(8, 6, DVec2::ZERO);
    let y = |h: HalfEdge| whole.uv[whole.corners[h.face().index()][h.corner()].index()].y;
    let is_middle = |h: &HalfEdge| y(*h) == 3.0 && y(h.next()) == 3.0;
    let middle: Vec<HalfEdge> = Topology::new(&whole).half_edges().filter(is_middle).collect();
    let mut start = cut_open(&whole, &middle);
    for p in &mut start.uv {
        *p = DVec2::new(p.x + 0.2 * (0.7 * p.y).sin(), p.y + 0.2 * (0.5 * p.x).cos());
    }
    let mut prepared = prepare(&start, &vec![false; start.face_count()], &|| Ok(())).unwrap();
    assert_eq!(prepared.disks.len(), 2);
    let faces: usize = prepared.disks.iter().map(|d| d.faces.len()).sum();
    for round in 1..=3 {
        let all: Vec<usize> = (0..prepared.disks.len()).collect();
        assert!(prepared.halve(&all));
        assert_eq!(prepared.disks.len(), 2 << round, "each becomes two");
        assert!(prepared.disks.iter().all(|d| prepared.map(d, Target::Surface).is_some()), "all are disks");
        let least = prepared.disks.iter().map(|d| d.area).fold(f64::INFINITY, f64::min);
        assert!(least * f64::from(2 << round) > 0.2 * 48.0, "none is but a little");
    }
    assert!(prepared.mesh.atlas().face_count() > faces);
}

#[test]
fn a_ramp_that_lies_on_itself_is_divided_in_its_own_sheet() {
    let mut start = sheet(90, 3, DVec2::ZERO);
    for (i, uv) in start.uv.iter_mut().enumerate() {
        let (x, y) = ((i % 91) as f64, (i / 91) as f64);
        *uv = DVec2::from_angle(-2.2 * TAU * x / 90.0) * (7.0 + y) + 20.0;
    }
    let (staged, _) = run(&start, &Bounded::default(), &options(0, OverlapMode::Separate));
    is_packed(&staged, 0.8);
}

#[test]
fn an_l_is_cut_once_or_not_and_meets_every_bound() {
    let start = shape(12, 12, |x, y| x >= 5 && y >= 5, 0.3);
    for bound in [0.5, 0.8, 0.9, 0.95] {
        let params = Bounded { packing_efficiency: bound, ..Bounded::default() };
        let (staged, codes) = run(&start, &params, &options(0, OverlapMode::Separate));
        is_packed(&staged, bound);
        assert!(codes.is_empty(), "{codes:?}");
        let charts = Charts::new(&Topology::new(&staged.atlas)).len();
        assert!(if bound < 0.6 { charts == 1 } else { charts <= 6 }, "{bound}: {charts}");
    }
}

#[test]
fn without_time_charts_are_packed_as_they_are_and_it_is_told() {
    let start = shape(12, 12, |x, y| x >= 3 && y >= 3, 0.3);
    let context = Context::silent().with_time_limit(Some(std::time::Duration::ZERO));
    let (info, options) = (SheetInfo::plain(), options(0, OverlapMode::Separate));
    let input = StageInput { atlas: &start, sheet_info: &info, importance: None, options: &options, context: &context };
    let staged = bounded(&input, &Bounded { packing_efficiency: 0.9, ..Bounded::default() }).unwrap();
    assert_eq!((staged.stopped_by, &staged.figures["bound_met"]), ("time_limit", &json!(false)));
    assert_eq!(check(&start, &staged.atlas, Exactness::Exact), Ok(()));
    let warnings = context.warnings();
    assert!(warnings.len() == 1 && warnings[0].code == "bound_not_met", "{warnings:?}");
    assert!(warnings[0].message.contains("time_limit_s"), "{warnings:?}");
}

#[test]
fn cuts_along_edges_divide_no_face_and_meet_a_bound() {
    let start = shape(24, 24, |x, y| x >= 9 && y >= 9, 0.3);
    let of = |cuts: Cuts, gutter: u32| {
        let params = Bounded { packing_efficiency: 0.75, cuts, ..Bounded::default() };
        let (staged, codes) = run(&start, &params, &options(gutter, OverlapMode::Separate));
        is_packed(&staged, 0.75);
        assert!(codes.is_empty(), "{cuts:?} {gutter}: {codes:?}");
        let charts = Charts::new(&Topology::new(&staged.atlas)).len();
        (staged.atlas.face_count() - start.face_count(), charts)
    };
    let (straight, edges) = (of(Cuts::Straight, 0), of(Cuts::Edges, 0));
    assert!(edges.1 >= 2 && straight.1 >= 2, "{straight:?} {edges:?}");
    assert!(edges.0 * 4 <= straight.0, "faces more: {straight:?} {edges:?}");
    assert!(of(Cuts::Edges, 1).1 >= 2);
}

#[test]
fn what_is_no_disk_is_opened_and_what_folds_is_flattened_anew() {
    // A ring, a sheet with a face turned over, one flat triangle, two that meet in a vertex, and a closed surface.
    let ring = shape(9, 9, |x, y| (3..6).contains(&x) && (3..6).contains(&y), 0.0);
    let mut folded = sheet(5, 5, DVec2::new(40.0, 0.0));
    folded.uv[14] += DVec2::new(2.5, 0.0);
    let one = soup(&[[DVec2::new(0.0, 40.0), DVec2::new(9.0, 41.0), DVec2::new(2.0, 47.0)]]);
    let bow = made(
        [[30.0, 40.0], [35.0, 42.0], [30.0, 45.0], [40.0, 40.0], [40.0, 46.0]].map(DVec2::from).to_vec(),
        [[0, 1, 2], [1, 3, 4]].map(|c| c.map(UvId)).to_vec(),
    );
    let corner = |k: usize| DVec3::new((k % 2) as f64, (k / 2 % 2) as f64, (k / 4) as f64) * 9.0;
    let faces = [
        [0, 1, 3],
        [0, 3, 2],
        [4, 7, 5],
        [4, 6, 7],
        [0, 5, 1],
        [0, 4, 5],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
        [1, 5, 7],
        [1, 7, 3],
    ];
    let mut closed = made(vec![DVec2::new(70.0, 70.0); 8], faces.map(|c| c.map(UvId)).to_vec());
    closed.surface.positions = (0..8).map(corner).collect();
    let all = [folded, one, bow, closed].iter().fold(ring, |a, b| join(&a, b));
    for gutter in [0, 1] {
        let (staged, codes) = run(
            &all,
            &Bounded { packing_efficiency: 0.7, ..Bounded::default() },
            &options(gutter, OverlapMode::Separate),
        );
        is_packed(&staged, 0.7);
        assert!(codes.is_empty(), "{codes:?}");
        assert!(staged.figures["opened_charts"].as_u64() >= Some(2), "{:?}", staged.figures);
    }
}

#[test]
fn faces_wound_against_each_other_become_disks_of_their_own() {
    // A patch inside, and a strip whose ends meet as those of a Moebius strip do.
    let mut start = shape(8, 8, |_, _| false, 0.2);
    for f in start.faces().filter(|f| (3..5).contains(&(f.index() / 2 % 8)) && (2..6).contains(&(f.index() / 16))) {
        start.corners[f.index()].swap(1, 2);
        start.surface.triangles[f.index()].swap(1, 2);
    }
    let points: Vec<DVec2> = (0..10).map(|k| DVec2::new(40.0 + f64::from(k / 2), f64::from(k % 2))).collect();
    // What comes after the tenth is the second and the first.
    let twisted = |k: u32| UvId(if k < 10 { k } else { 11 - k });
    let order = |k: u32| if k.is_multiple_of(2) { [k, k + 2, k + 1] } else { [k, k + 1, k + 2] };
    let strip: Vec<[UvId; 3]> = (0..10).map(|k| order(k).map(twisted)).collect();
    let start = join(&start, &made(points, strip));
    let held = vec![false; start.face_count()];
    let prepared = prepare(&start, &held, &|| Ok(())).unwrap();
    assert!(prepared.disks.len() >= 4, "{}", prepared.disks.len());
    let maps: Vec<_> = prepared.disks.iter().map(|d| prepared.map(d, Target::Surface)).collect();
    assert!(maps.iter().all(|map| map.as_ref().is_some_and(|map| map.is_valid())), "all are disks without folds");
    let faces: usize = prepared.disks.iter().map(|d| d.faces.len()).sum();
    assert_eq!(faces, prepared.mesh.atlas().face_count());
}

#[test]
fn a_sieve_becomes_one_disk() {
    let start = shape(25, 25, |x, y| x % 2 == 1 && y % 2 == 1, 0.1);
    let prepared = prepare(&start, &vec![false; start.face_count()], &|| Ok(())).unwrap();
    assert_eq!(prepared.disks.len(), 1);
    let map = prepared.map(&prepared.disks[0], Target::Surface).unwrap();
    let borders: usize = 4 * 25 + 4 * 144;
    // From hole to hole it is one edge.
    assert_eq!(map.boundary.len(), borders + 2 * 144);
    let (staged, _) = run(&start, &Bounded::default(), &options(0, OverlapMode::Separate));
    is_packed(&staged, 0.8);
}

#[test]
fn what_lies_in_one_point_of_the_surface_keeps_its_shape() {
    // Three faces about one of their corners, larger in the layout than on the surface: there all corners are one vertex, so that any edge might be any other.
    let points = [(2.1, 2.9), (1.8, 2.8), (1.5, 2.95), (2.6, 1.3)].map(|(x, y)| DVec2::new(x, y) + 30.0);
    let mut fan = made(points.to_vec(), [[0, 1, 2], [2, 1, 3], [1, 0, 3]].map(|f| f.map(UvId)).to_vec());
    fan.surface.triangles = vec![[fan.surface.triangles[0][0]; 3]; 3];
    let start = join(&shape(8, 8, |x, y| x >= 3 && y >= 3, 0.2), &fan);
    let prepared = prepare(&start, &vec![false; start.face_count()], &|| Ok(())).unwrap();
    let after = prepared.mesh.atlas();
    assert_eq!((prepared.disks.len(), after.face_count()), (1, start.face_count()));
    let (staged, codes) = run(&start, &Bounded::default(), &options(0, OverlapMode::Separate));
    let sign = |atlas: &Atlas, f: FaceId| {
        let [a, b, c] = atlas.uv_triangle(f);
        orientation(a, b, c)
    };
    for f in start.faces().skip(start.face_count() - 3) {
        assert_eq!(sign(&staged.atlas, f), sign(&start, f), "{f:?}");
    }
    assert_eq!(staged.figures["bound_met"], true);
    assert!(codes.is_empty(), "{codes:?}");
}

#[test]
fn halving_some_disks_leaves_the_others() {
    let start = join(
        &join(&sheet(8, 6, DVec2::ZERO), &sheet(6, 6, DVec2::new(20.0, 0.0))),
        &sheet(4, 6, DVec2::new(40.0, 0.0)),
    );
    let mut prepared = prepare(&start, &vec![false; start.face_count()], &|| Ok(())).unwrap();
    let asked = std::cell::RefCell::new(Vec::new());
    let first = |own: &Prepared| {
        asked.borrow_mut().push(own.disks.len());
        Ok(vec![0])
    };
    assert!(prepared.halve_apart(&[1], 3, &first).unwrap());
    assert_eq!(*asked.borrow(), [2, 2], "it is asked about the parts alone");
    assert_eq!(prepared.disks.len(), 2 + 4);
    let faces: usize = prepared.disks.iter().map(|d| d.faces.len()).sum();
    assert_eq!(faces, prepared.mesh.atlas().face_count());
    for (d, disk) in prepared.disks.iter().enumerate() {
        assert!(disk.faces.iter().all(|f| prepared.labels.disk[f.index()] as usize == d));
        assert!(prepared.map(disk, Target::Surface).is_some());
    }
}

#[test]
fn stacks_stay_together_and_gutters_stay_free() {
    let one = shape(6, 6, |x, y| x >= 3 && y >= 3, 0.2);
    let mut start = join(&join(&one, &one), &sheet(5, 3, DVec2::new(40.0, 0.0)));
    start.append(&shape(9, 4, |x, y| x >= 3 && y >= 2, 0.1), DVec2::new(0.0, 40.0), start.face_count(), 0);
    let (staged, _) = run(&start, &Bounded::default(), &options(2, OverlapMode::Stack));
    let charts = Charts::new(&Topology::new(&staged.atlas));
    let before = clusters(&start, &Charts::new(&Topology::new(&start)), OverlapMode::Stack);
    let after = clusters(&staged.atlas, &charts, OverlapMode::Stack);
    let stacks = |c: &crate::atlas::Clusters| c.charts.iter().filter(|c| c.len() > 1).count();
    assert!(stacks(&before) > 0 && stacks(&after) == stacks(&before));
}

#[test]
fn a_gutter_is_as_wide_as_was_asked_for_on_a_sheet_of_a_given_size() {
    let mut start = shape(14, 10, |x, y| x >= 6 && (3..7).contains(&y), 0.5);
    start.uv.iter_mut().for_each(|p| *p *= 40.0);
    let mut options = options(3, OverlapMode::Separate);
    options.texture.size = Size::Fixed([256, 256]);
    let after = run(&start, &Bounded::default(), &options).0.atlas;
    assert_eq!(after.sheets, [[256, 256]]);
    let charts = Charts::new(&Topology::new(&after));
    assert!(charts.len() > 1);
    let apart = clusters(&after, &charts, OverlapMode::Separate);
    let inputs = MeasureInputs {
        input: Some(&start),
        clusters: &apart,
        slots: &[],
        smallest_slot: None,
        resampled_area: None,
        signal_error: None,
    };
    let gutter = measure(&after, &Topology::new(&after), &charts, &inputs).gutter_texels;
    assert!(gutter >= Some(3.0), "{gutter:?}");
}

#[test]
fn the_map_is_kept_where_that_is_asked_for_and_threads_do_not_matter() {
    let start = shape(14, 10, |x, y| x >= 6 && (3..7).contains(&y), 0.5);
    let kept = Bounded { keep_mapping: true, ..Bounded::default() };
    let (staged, _) = run(&start, &kept, &options(0, OverlapMode::Separate));
    is_packed(&staged, 0.8);
    let mut large = start.clone();
    large.uv.iter_mut().for_each(|p| *p *= 20.0);
    let own = run(&large, &Bounded::default(), &options(2, OverlapMode::Separate)).0;
    assert!(own.figures["work"].as_u64() > Some(0), "a gutter keeps nothing from being relaxed: {:?}", own.figures);
    let alone = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    assert!(
        alone.install(|| run(&large, &Bounded::default(), &options(2, OverlapMode::Separate))).0.atlas == own.atlas
    );
    let paper = Bounded { search: Search::Paper, candidates: 100, ..Bounded::default() };
    is_packed(&run(&start, &paper, &options(0, OverlapMode::Separate)).0, 0.8);
}

#[test]
fn gutters_do_not_keep_charts_from_being_relaxed() {
    let mut start = shape(24, 18, |x, y| x >= 9 && (5..13).contains(&y), 0.5);
    start.uv.iter_mut().for_each(|p| *p *= 12.0);
    let distortion = |keep_mapping: bool| {
        let staged = run(&start, &Bounded { keep_mapping, ..Bounded::default() }, &options(4, OverlapMode::Separate)).0;
        staged.figures["distortion"].as_f64().unwrap()
    };
    let (kept, relaxed) = (distortion(true), distortion(false));
    assert!(relaxed - 1.0 < 0.7 * (kept - 1.0), "{kept} {relaxed}");
}
