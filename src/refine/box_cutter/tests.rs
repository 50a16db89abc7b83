//! The stage as a whole, on small atlases.

use glam::DVec2;

use super::params::{BoxCutter, Cuts, Search};
use super::*;
use crate::atlas::testing::{join, sheet};
use crate::atlas::{Exactness, FaceId, check, overlaps};
use crate::context::Context;
use crate::packing::Gutter;
use crate::refine::options::IfLarger;

/// A chart in the shape of an L: unit squares of a sheet whose corner is missing.
fn corner(n: usize, thick: usize) -> Atlas {
    let whole = sheet(n, n, DVec2::ZERO);
    keep(&whole, |p| p.x < thick as f64 || p.y < thick as f64)
}

fn keep(atlas: &Atlas, wanted: impl Fn(DVec2) -> bool) -> Atlas {
    let faces: Vec<FaceId> = atlas
        .faces()
        .filter(|f| {
            let t = atlas.uv_triangle(*f);
            wanted((t[0] + t[1] + t[2]) / 3.0)
        })
        .collect();
    let mut next = atlas.clone();
    next.corners = faces.iter().map(|f| atlas.corners[f.index()]).collect();
    next.surface.triangles = faces.iter().map(|f| atlas.surface.triangles[f.index()]).collect();
    next.provenance = (0..faces.len()).map(|f| crate::atlas::Provenance::whole(FaceId::new(f), 0)).collect();
    next.page = vec![0; faces.len()];
    next
}

fn options(gutter: u32) -> Options {
    let mut options = Options::default();
    options.pack.gutter = Gutter::Texels(gutter);
    options.pack.rotation = Rotation::Any;
    options.atlas.overlaps = OverlapMode::Separate;
    options.atlas.if_larger = IfLarger::Accept;
    options.work_budget = Some(4_000_000);
    options
}

fn run(atlas: &Atlas, params: &BoxCutter, weights: Option<&[[f64; 3]]>) -> Staged {
    run_with(atlas, params, weights, &options(0))
}

fn cut(
    atlas: &Atlas,
    sheet_info: &SheetInfo,
    weights: Option<&[[f64; 3]]>,
    params: &BoxCutter,
    options: &Options,
    context: &Context,
) -> Result<Staged> {
    box_cutter(&StageInput { atlas, sheet_info, importance: None, options, context }, weights, params)
}

fn run_with(atlas: &Atlas, params: &BoxCutter, weights: Option<&[[f64; 3]]>, options: &Options) -> Staged {
    let staged = cut(atlas, &SheetInfo::plain(), weights, params, options, &Context::silent()).unwrap();
    check(atlas, &staged.atlas, Exactness::Exact).unwrap();
    let charts = Charts::new(&Topology::new(&staged.atlas));
    let left = overlaps(&staged.atlas, &charts, 10);
    assert!(left.intra.is_empty() && left.inter.is_empty());
    staged
}

fn figure(staged: &Staged, name: &str) -> f64 {
    staged.figures[name].as_f64().unwrap()
}

fn charts(staged: &Staged) -> usize {
    Charts::new(&Topology::new(&staged.atlas)).len()
}

#[test]
fn an_l_is_cut_once_and_packs_well() {
    let atlas = corner(24, 6);
    let params = BoxCutter { max_boundary_length: Some(1.3), ..BoxCutter::default() };
    let staged = run(&atlas, &params, None);
    assert!(charts(&staged) >= 2);
    assert!(efficiency(&staged.atlas) > 0.8, "{}", efficiency(&staged.atlas));
    assert!(figure(&staged, "boundary_length_ratio") <= 1.3);
    let grown = border(&staged.atlas) / border(&atlas);
    assert!((grown - figure(&staged, "boundary_length_ratio")).abs() < 1e-6, "the mesh is cut as the search said");
}

#[test]
fn every_limit_is_kept_and_named() {
    let atlas = join(&corner(24, 6), &corner(20, 4));
    let base = BoxCutter { max_boundary_length: None, ..BoxCutter::default() };
    let first = run(&atlas, &BoxCutter { max_charts: Some(3), ..base.clone() }, None);
    assert!(charts(&first) <= 3);
    let second = run(&atlas, &BoxCutter { target_packing_efficiency: Some(0.6), ..base.clone() }, None);
    assert_eq!(second.stopped_by, "packing_efficiency");
    let third = run(&atlas, &BoxCutter { max_boundary_length: Some(1.0), ..base.clone() }, None);
    assert_eq!((third.stopped_by, charts(&third)), ("boundary_length", 2));
    let fourth = run(&atlas, &base, None);
    assert!(["work_budget", "no_improvement"].contains(&fourth.stopped_by), "{}", fourth.stopped_by);
    assert!(efficiency(&fourth.atlas) >= efficiency(&third.atlas));
    let context = Context::silent().with_time_limit(Some(std::time::Duration::ZERO));
    let fifth = cut(&atlas, &SheetInfo::plain(), None, &BoxCutter::default(), &options(0), &context).unwrap();
    assert_eq!((fifth.stopped_by, figure(&fifth, "cuts")), ("time_limit", 0.0));
}

#[test]
fn cuts_along_edges_split_no_triangle() {
    let atlas = corner(24, 6);
    let params = BoxCutter { cuts: Cuts::Edges, max_boundary_length: Some(1.5), ..BoxCutter::default() };
    let staged = run(&atlas, &params, None);
    assert_eq!(staged.atlas.face_count(), atlas.face_count());
    assert!(charts(&staged) >= 2);
    let grown = border(&staged.atlas) / border(&atlas);
    assert!((grown - figure(&staged, "boundary_length_ratio")).abs() < 1e-6);
    let skinned = SheetInfo { along_edges: true, ..SheetInfo::plain() };
    let auto = BoxCutter { cuts: Cuts::Auto, ..params };
    let staged = cut(&atlas, &skinned, None, &auto, &options(0), &Context::silent()).unwrap();
    assert_eq!(staged.atlas.face_count(), atlas.face_count(), "skinned and morphed surfaces are cut along edges");
}

#[test]
fn the_published_loop_and_random_lines_can_be_chosen() {
    let atlas = join(&corner(24, 6), &corner(20, 4));
    for search in [Search::Paper, Search::Random] {
        let staged = run(&atlas, &BoxCutter { search, max_boundary_length: Some(1.5), ..BoxCutter::default() }, None);
        assert!(figure(&staged, "boundary_length_ratio") <= 1.5);
    }
}

#[test]
fn important_regions_are_left_alone() {
    // A cross: any of its arms may be cut off. The half in which most is cut shall matter.
    let cross = keep(&sheet(30, 30, DVec2::ZERO), |p| (10.0..20.0).contains(&p.x) || (10.0..20.0).contains(&p.y));
    let inside = |staged: &Staged, important: &dyn Fn(DVec2) -> bool| {
        // Cut length where it matters: border edges whose source lies there and was none.
        let topology = Topology::new(&staged.atlas);
        let before = Topology::new(&cross);
        let open = |a: &Atlas, t: &Topology| {
            let edges = t.half_edges().filter(|h| t.is_border(*h));
            let place = |h: HalfEdge| a.surface.triangles[h.face().index()][h.corner()];
            edges
                .map(|h| [place(h), place(h.next())].map(|v| a.surface.positions[v.index()].truncate()))
                .filter(|[a, b]| important((*a + *b) * 0.5))
                .map(|[a, b]| a.distance(b))
                .sum::<f64>()
        };
        open(&staged.atlas, &topology) - open(&cross, &before)
    };
    let params = BoxCutter { max_boundary_length: Some(1.5), ..BoxCutter::default() };
    let options = Options { work_budget: Some(20_000_000), ..options(0) };
    let plain = run_with(&cross, &params, None, &options);
    let halves: [&dyn Fn(DVec2) -> bool; 4] = [&|p| p.x < 14.0, &|p| p.x > 16.0, &|p| p.y < 14.0, &|p| p.y > 16.0];
    let important = halves.into_iter().max_by(|a, b| inside(&plain, a).total_cmp(&inside(&plain, b))).unwrap();
    let weights: Vec<[f64; 3]> =
        cross.faces().map(|f| cross.uv_triangle(f).map(|p| if important(p) { 100.0 } else { 1.0 })).collect();
    let biased = run_with(&cross, &params, Some(&weights), &options);
    let (before, after) = (inside(&plain, important), inside(&biased, important));
    assert!(before > 1.0, "{before}");
    assert!(after <= 0.2 * before, "{after} of {before}");
    assert!(figure(&biased, "cuts") > 0.0, "elsewhere it is still cut");
}

#[test]
fn the_result_does_not_depend_on_threads() {
    let atlas = join(&corner(24, 6), &corner(20, 4));
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| run(&atlas, &BoxCutter::default(), None).atlas)
    };
    assert_eq!(with(1), with(4));
}

#[test]
fn shared_charts_stay_together_and_are_held_back() {
    let l = corner(24, 6);
    let atlas = join(&l, &l);
    let mut options = options(0);
    options.atlas.overlaps = OverlapMode::Stack;
    let staged = cut(&atlas, &SheetInfo::plain(), None, &BoxCutter::default(), &options, &Context::silent()).unwrap();
    assert_eq!(figure(&staged, "held_back"), 1.0);
    assert_eq!(staged.atlas.face_count(), atlas.face_count());
    let half = l.face_count();
    for f in 0..half {
        let [a, b] = [f, f + half].map(|f| staged.atlas.uv_triangle(FaceId::new(f)));
        assert!((0..3).all(|k| a[k].distance(b[k]) < 1e-9));
    }
}

#[test]
fn a_gutter_stays_free_between_the_panels() {
    let atlas = corner(24, 6);
    let params = BoxCutter { max_boundary_length: Some(1.5), ..BoxCutter::default() };
    let staged = cut(&atlas, &SheetInfo::plain(), None, &params, &options(2), &Context::silent()).unwrap();
    let charts = Charts::new(&Topology::new(&staged.atlas));
    assert!(charts.len() >= 2);
    let points = |c: &[FaceId]| c.iter().flat_map(|f| staged.atlas.uv_triangle(*f)).collect::<Vec<_>>();
    for (i, a) in charts.faces.iter().enumerate() {
        for b in &charts.faces[i + 1..] {
            let least = points(a)
                .iter()
                .flat_map(|p| points(b).into_iter().map(move |q| p.distance(q)))
                .fold(f64::INFINITY, f64::min);
            assert!(least >= 2.0 - 1e-6, "{least}");
        }
    }
}
