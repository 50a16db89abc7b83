//! The stage as a whole: what comes in, and what is left as it is.

use glam::DVec2;

use super::params::{Quality, Search};
use super::*;
use crate::asset::{self, File, Limits, MaterialIndex, ReadOptions, sample};
use crate::atlas::testing::{cut_open, half_edges_where, join, sheet};
use crate::atlas::{Exactness, OverlapMode, check_with, overlaps};
use crate::context::Context;
use crate::refine::options::{IfLarger, Options};
use crate::refine::stage::SheetInfo;

fn run(atlas: &Atlas, params: &OptCuts, is_virtual: bool) -> (Staged, Vec<String>) {
    let mut options = Options::default();
    options.atlas.if_larger = IfLarger::Accept;
    options.work_budget = Some(100_000);
    let context = Context::silent();
    let info = SheetInfo { is_virtual, ..SheetInfo::plain() };
    let input = StageInput { atlas, sheet_info: &info, importance: None, options: &options, context: &context };
    let staged = optcuts(&input, params).unwrap();
    assert_eq!(check_with(atlas, &staged.atlas, Exactness::Exact, is_virtual && !params.bijective), Ok(()));
    (staged, context.warnings().into_iter().map(|w| w.code).collect())
}

/// The Atlas of a sample.
fn read(name: &str) -> Atlas {
    let file = File { path: format!("{name}.glb"), bytes: sample::made(name).to_vec() };
    let (doc, _) = asset::load(&[file], None, &Limits::default()).unwrap();
    let index = MaterialIndex::new(&doc).unwrap();
    asset::read(&doc, &index, ReadOptions::default(), &Context::silent()).unwrap().remove(0).atlas
}

fn without_layout(atlas: &Atlas) -> Atlas {
    Atlas { uv: Vec::new(), corners: vec![[Atlas::NO_UV; 3]; atlas.face_count()], ..atlas.clone() }
}

fn started(start: Start) -> OptCuts {
    OptCuts { start, ..OptCuts::default() }
}

#[test]
fn a_surface_with_every_fault_gets_a_layout_whatever_the_number_of_threads() {
    let atlas = read("defects");
    let params = OptCuts { quality: Quality::Fast, ..OptCuts::default() };
    let (staged, codes) = run(&atlas, &params, true);
    assert_eq!(codes, Vec::<String>::new());
    let figures = &staged.figures;
    assert_eq!((&figures["degenerate_faces"], &figures["bound_met"]), (&json!(3), &json!(true)), "{figures:?}");
    assert!(figures["pieces"].as_u64().unwrap() >= 10 && figures["non_manifold_edges"].as_u64().unwrap() > 0);
    assert!(figures["symmetric_dirichlet"].as_f64().unwrap() <= 4.1 && figures["seam_length_before"].is_null());
    assert_eq!(staged.atlas.sheets, [[1024, 1024]]);
    let charts = Charts::new(&Topology::new(&staged.atlas));
    let found = overlaps(&staged.atlas, &charts, 10);
    assert!(found.intra.is_empty() && found.inter.is_empty(), "{found:?}");
    let alone = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    assert!(alone.install(|| run(&atlas, &params, true)).0.atlas == staged.atlas);
}

#[test]
fn what_has_no_layout_is_not_polished() {
    let (staged, codes) = run(&without_layout(&sheet(2, 2, DVec2::ZERO)), &started(Start::Uploaded), true);
    assert!(staged.kept && staged.stopped_by == "no_layout" && !staged.atlas.has_layout());
    assert_eq!(codes, ["no_layout"]);
}

#[test]
fn faces_without_area_alone_stay_as_they_are() {
    let mut atlas = without_layout(&sheet(1, 1, DVec2::ZERO));
    atlas.surface.triangles.iter_mut().for_each(|t| t[1] = t[0]);
    let (staged, codes) = run(&atlas, &OptCuts::default(), true);
    assert!(staged.kept && codes == ["nothing_to_cut"]);
}

/// Texels by unit of length of the layout's charts.
fn density(atlas: &Atlas) -> f64 {
    (atlas.faces().map(|f| atlas.uv_area(f).abs()).sum::<f64>() / surface_area(atlas)).sqrt()
}

#[test]
fn textures_keep_their_density_and_parts_that_are_polished_their_own() {
    let mut atlas = sheet(4, 2, DVec2::ZERO);
    atlas.uv.iter_mut().for_each(|uv| *uv *= 7.0);
    for start in [Start::Auto, Start::Uploaded, Start::Fresh] {
        let (staged, _) = run(&atlas, &started(start), false);
        assert!((density(&staged.atlas) - 7.0).abs() < 0.05, "{start:?}: {}", density(&staged.atlas));
        let polished = if start == Start::Fresh { 0 } else { 1 };
        assert_eq!(staged.figures["polished_pieces"], polished, "{start:?}");
    }
    // A second component at twice the density.
    let mut fine = sheet(3, 3, DVec2::new(0.0, 20.0));
    fine.uv.iter_mut().for_each(|uv| *uv *= 14.0);
    let both = join(&atlas, &fine);
    let (staged, _) = run(&both, &started(Start::Uploaded), false);
    let of = |first: usize, count: usize| {
        let faces: Vec<FaceId> = (first..first + count).map(FaceId::new).collect();
        density(&staged.atlas.subset(&faces))
    };
    assert!((of(0, 16) - 7.0).abs() < 0.05 && (of(16, 18) - 14.0).abs() < 0.1, "{} {}", of(0, 16), of(16, 18));
}

#[test]
fn charts_that_share_texels_on_purpose_are_held_back() {
    let stacked = join(&sheet(2, 2, DVec2::ZERO), &sheet(2, 2, DVec2::ZERO));
    let atlas = join(&stacked, &sheet(4, 2, DVec2::new(20.0, 0.0)));
    let (staged, codes) = run(&atlas, &OptCuts::default(), false);
    assert_eq!(codes, ["held_back"]);
    assert!((staged.figures["held_back"].as_f64().unwrap() - 0.5).abs() < 1e-9, "{:?}", staged.figures);
    let uvs = |first: usize| (first..first + 8).map(|f| staged.atlas.uv_triangle(FaceId::new(f))).collect::<Vec<_>>();
    assert_eq!(uvs(0), uvs(8), "they share their texels still");
    // From the surface alone each has texels of its own.
    let (staged, codes) = run(&atlas, &started(Start::Fresh), false);
    assert_eq!((codes.len(), &staged.figures["pieces"]), (0, &json!(3)));
    let charts = Charts::new(&Topology::new(&staged.atlas));
    assert!(overlaps(&staged.atlas, &charts, 1).inter.is_empty());
}

#[test]
fn charts_that_fold_are_cut_or_not_started_from() {
    // A vertex has been pulled over its neighbours, a face collapsed, and another chart is sound.
    let mut folded = sheet(4, 4, DVec2::ZERO);
    folded.uv[12] = DVec2::new(3.4, 3.3);
    folded.uv[1] = DVec2::new(0.5, 0.5);
    let atlas = join(&folded, &sheet(2, 2, DVec2::new(20.0, 0.0)));
    let (staged, _) = run(&atlas, &OptCuts::default(), false);
    assert_eq!((&staged.figures["polished_pieces"], &staged.figures["repaired_charts"]), (&json!(1), &json!(0)));
    let (staged, _) = run(&atlas, &started(Start::Uploaded), false);
    assert_eq!((&staged.figures["polished_pieces"], &staged.figures["repaired_charts"]), (&json!(2), &json!(1)));
    // What overlaps itself without folding may stay so where that is allowed.
    let mut lap = cut_open(
        &sheet(6, 1, DVec2::ZERO),
        &half_edges_where(&sheet(6, 1, DVec2::ZERO), |a, b| a.x == 9.0 && b.x == 9.0),
    );
    for uv in &mut lap.uv {
        *uv = DVec2::from_angle(uv.x * 1.3) * (1.0 + 0.4 * uv.y) * 3.0;
    }
    let any = OptCuts { bijective: false, ..started(Start::Uploaded) };
    assert_eq!(run(&lap, &any, true).0.figures["repaired_charts"], 0);
    assert_eq!(run(&lap, &any, false).0.figures["repaired_charts"], 1, "with images it must not");
    assert_eq!(run(&lap, &started(Start::Uploaded), false).0.figures["repaired_charts"], 1);
}

#[test]
fn the_bound_of_the_input_is_what_it_has() {
    let mut atlas = sheet(4, 4, DVec2::ZERO);
    atlas.uv.iter_mut().for_each(|uv| *uv *= DVec2::new(6.0, 3.0));
    // Singular values sqrt(2) and 1/sqrt(2) at the best scale.
    for (start, bound) in [(Start::Uploaded, 5.0), (Start::Fresh, 5.0)] {
        let params = OptCuts { max_distortion: MaxDistortion::Input, ..started(start) };
        let figures = run(&atlas, &params, false).0.figures;
        let found = figures["max_distortion"].as_f64().unwrap();
        assert!((found - bound).abs() < 1e-6, "{start:?}: {found}");
        assert_eq!(figures["bound_met"], true);
    }
    let params = OptCuts { max_distortion: MaxDistortion::Input, ..OptCuts::default() };
    assert_eq!(run(&without_layout(&atlas), &params, true).0.figures["max_distortion"], USUAL_BOUND);
}

#[test]
fn weights_are_relative_to_the_least_and_millions_forbid() {
    let atlas = without_layout(&sheet(2, 1, DVec2::ZERO));
    let piece = divide(&atlas, &[true; 4]).build(&atlas, &|_| false).remove(0);
    let at = |w: f64| vertex_weights(&piece, &[[w, 2.0, 2.0], [w, 2.0, 2.0], [2.0; 3], [2.0; 3]], 0.5);
    let corner = piece.vertices.iter().position(|v| v.index() == 0).unwrap();
    assert_eq!((at(0.5)[corner], at(50.0)[corner]), (1.0, 100.0));
    assert_eq!((at(0.0)[corner], at(1e6)[corner]), (1.0, f64::INFINITY));
    let rest = at(0.5).into_iter().enumerate().filter(|(v, _)| *v != corner);
    assert!(rest.into_iter().all(|(_, w)| w == 4.0));
}

#[test]
fn settings_reach_the_options() {
    let options = crate::refine::parse::options(&json!({"recipe": "polish", "optcuts": {"search": "paper"}})).unwrap();
    let own: OptCuts = options.stages.get();
    assert_eq!((own.start, own.max_distortion, own.search), (Start::Uploaded, MaxDistortion::Input, Search::Paper));
    assert_eq!(options.atlas.overlaps, OverlapMode::Stack);
    let problems =
        crate::refine::parse::options(&json!({"recipe": "unwrap", "optcuts": {"max_distortion": 4}})).unwrap_err();
    assert_eq!(problems[0].pointer, "/optcuts/max_distortion");
    assert!(problems[0].message.contains("more than 4"), "{problems:?}");
}
