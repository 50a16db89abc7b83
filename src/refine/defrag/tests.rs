use glam::{DMat2, DVec2};

use super::params::{Appeal, Search};
use super::*;
use crate::atlas::testing::{Rng, sheet};
use crate::atlas::{Atlas, Exactness, FaceId, UvId, check};
use crate::context::Context;
use crate::packing::{Gutter, Pack};
use crate::refine::options::{AtlasOptions, IfLarger, Options};
use crate::refine::stage::SheetInfo;

/// A rectangle of faces, torn into squares of `side` x `side` faces that are turned, shifted and bent a little; texels of a
/// sheet of 2048.
fn torn(n: usize, side: usize, turn: f64, bend: f64, seed: u64) -> Atlas {
    let mut atlas = sheet(n, n, DVec2::ZERO);
    let mut rng = Rng(seed);
    let across = n.div_ceil(side);
    let motion: Vec<(DMat2, DVec2)> = (0..across * across)
        .map(|c| {
            let place = DVec2::new((c % across) as f64, (c / across) as f64) * 1.6 * side as f64 * 8.0;
            (DMat2::from_angle(turn * (rng.unit() - 0.5)), place.round() + 300.0)
        })
        .collect();
    let mut uv = Vec::new();
    let mut known = std::collections::BTreeMap::new();
    for (f, corners) in atlas.corners.iter_mut().enumerate() {
        let (x, y) = ((f / 2) % n / side, (f / 2) / n / side);
        let chart = y * across + x;
        for corner in corners.iter_mut() {
            *corner = *known.entry((chart, corner.0)).or_insert_with(|| {
                let p = atlas.uv[corner.index()] * 8.0;
                let middle = DVec2::new(x as f64 + 0.5, y as f64 + 0.5) * side as f64 * 8.0;
                let bent = p + DVec2::new((p.y * 0.11).sin(), (p.x * 0.13).cos()) * bend * (1.0 + chart as f64 % 3.0);
                let (linear, place) = motion[chart];
                uv.push(linear * (bent - middle) + place);
                UvId::new(uv.len() - 1)
            });
        }
    }
    atlas.uv = uv;
    atlas.sheets = vec![[2048, 2048]];
    atlas
}

fn sheet_info() -> SheetInfo {
    SheetInfo {
        id: 0,
        reference: [2048, 2048],
        unit: 1,
        block: 1,
        basis: false,
        mipmaps: false,
        is_virtual: false,
        along_edges: false,
        directions: false,
        joined: false,
        half_turns: Vec::new(),
    }
}

fn options() -> Options {
    Options {
        pack: Pack { gutter: Gutter::Texels(2), ..Pack::default() },
        atlas: AtlasOptions { if_larger: IfLarger::Accept, ..AtlasOptions::default() },
        ..Options::default()
    }
}

fn merged(atlas: &Atlas, params: &Defrag, options: &Options, context: &Context) -> Result<Staged> {
    defrag(&StageInput { atlas, sheet_info: &sheet_info(), importance: None, options, context }, params)
}

fn run(atlas: &Atlas, params: &Defrag) -> Staged {
    let staged = merged(atlas, params, &options(), &Context::silent()).expect("it packs");
    assert_eq!(check(atlas, &staged.atlas, Exactness::Exact), Ok(()));
    staged
}

fn charts(atlas: &Atlas) -> usize {
    Charts::new(&Topology::new(atlas)).len()
}

#[test]
fn what_only_was_torn_and_moved_by_whole_texels_is_healed_without_resampling() {
    let atlas = torn(12, 4, 0.0, 0.0, 1);
    assert_eq!(charts(&atlas), 9);
    let staged = run(&atlas, &Defrag { max_resampled: 0.0, ..Defrag::default() });
    assert_eq!(charts(&staged.atlas), 1);
    assert_eq!(staged.figures["preserved_area"], json!(1.0));
    // Every face was moved by whole texels and quarter turns.
    for f in (0..atlas.face_count()).map(FaceId::new) {
        let (p, q) = (atlas.uv_triangle(f), staged.atlas.uv_triangle(f));
        for k in 0..3 {
            let moved = (q[k] - q[0]).abs();
            let edge = (p[k] - p[0]).abs();
            assert!((moved - edge).length() < 1e-9 || (moved - edge.perp().abs()).length() < 1e-9);
        }
        let shift = q[0] - p[0];
        let lattice = (shift - shift.round()).abs().max_element();
        assert!(lattice < 1e-9, "{shift}");
    }
}

#[test]
fn turned_and_bent_pieces_are_merged_and_nothing_folds() {
    for search in [Search::Partial, Search::Paper] {
        let atlas = torn(16, 4, 3.0, 0.15, 5);
        let staged = run(&atlas, &Defrag { search, ..Defrag::default() });
        assert!(charts(&staged.atlas) <= 4, "{search:?}: {} of 16", charts(&staged.atlas));
        assert!(staged.figures["energy"].as_f64().expect("a number") < 0.05);
    }
}

#[test]
fn a_limit_on_resampling_is_kept() {
    let atlas = torn(16, 4, 3.0, 0.15, 7);
    let mut last = usize::MAX;
    for limit in [0.0, 0.3, 1.0] {
        let params = Defrag { max_resampled: limit, resampling_rate: 1e6, ..Defrag::default() };
        let staged = run(&atlas, &params);
        let kept = staged.figures["preserved_area"].as_f64().expect("a number");
        assert!(kept >= 1.0 - limit - 1e-6, "{kept} at {limit}");
        assert!(charts(&staged.atlas) <= last);
        last = charts(&staged.atlas);
    }
    assert!(last < 8);
}

#[test]
fn charts_grow_no_larger_than_a_sheet() {
    let atlas = torn(24, 4, 3.0, 0.1, 21);
    let alone = run(&atlas, &Defrag::default());
    assert!(charts(&alone.atlas) < 9, "{}", charts(&alone.atlas));
    let paged = |max_size: u32| {
        let mut options = options();
        options.texture.max_size = max_size;
        merged(&atlas, &Defrag::default(), &options, &Context::silent()).expect("it packs")
    };
    // 192 texels of charts of 32: on pages of 96 they stay as large as they are.
    let staged = paged(96);
    assert_eq!(check(&atlas, &staged.atlas, Exactness::Exact), Ok(()));
    assert!(staged.atlas.sheets.len() > 1 && staged.atlas.sheets.iter().all(|s| s[0] <= 96 && s[1] <= 96));
    let number = charts(&staged.atlas);
    assert!((6..30).contains(&number), "{number}");
    assert!(staged.figures["failures"]["sheet_size"].as_u64() > Some(0));
    let area = |atlas: &Atlas| atlas.faces().map(|f| atlas.uv_area(f).abs()).sum::<f64>();
    let kept = area(&staged.atlas) / area(&atlas);
    assert!((0.97..1.03).contains(&kept), "{kept}");
    // What does not fit as it is, is scaled down and merged all the same.
    let scaled = paged(24);
    assert_eq!(scaled.atlas.sheets.len(), 1);
    assert!(charts(&scaled.atlas) < 9);
    assert_eq!(scaled.figures["failures"].get("sheet_size"), None);
}

#[test]
fn threads_make_no_difference() {
    let atlas = torn(20, 4, 3.0, 0.2, 9);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| run(&atlas, &Defrag::default()))
    };
    let (one, four) = (with(1), with(4));
    assert_eq!(one.atlas, four.atlas);
    assert_eq!(one.figures, four.figures);
}

#[test]
fn every_way_of_ranking_and_not_trying_again_ends_with_a_sound_atlas() {
    let atlas = torn(12, 3, 3.0, 0.3, 11);
    for appeal in [Appeal::Full, Appeal::NoBenefitCost, Appeal::NoSizeBonus, Appeal::Random] {
        for retry in [true, false] {
            let staged = run(&atlas, &Defrag { appeal, retry, ..Defrag::default() });
            assert!(charts(&staged.atlas) < charts(&atlas));
        }
    }
}

#[test]
fn broken_input_is_met() {
    // A face without area, one that is not finite, one that is folded over, and faces wound the other way round.
    let mut atlas = torn(12, 4, 3.0, 0.1, 13);
    let corners = atlas.corners[3];
    atlas.uv[corners[0].index()] = atlas.uv[corners[1].index()];
    let far = atlas.corners[atlas.face_count() - 1][2];
    atlas.uv[far.index()] = DVec2::NAN;
    for f in 100..110 {
        atlas.corners[f].swap(0, 1);
        atlas.surface.triangles[f].swap(0, 1);
    }
    let charts_before = Charts::new(&Topology::new(&atlas));
    let mut mesh = MergeMesh::new(&atlas, &charts_before, &vec![true; charts_before.len()], true);
    let (atlas, sheet_info, options, context) = (&atlas, &sheet_info(), &options(), &Context::silent());
    let input = StageInput { atlas, sheet_info, importance: None, options, context };
    merge_charts(&mut mesh, None, &Defrag::default(), &input).expect("it ends");
    let merged = place::place(&mesh, atlas, 0.05, sheet_info, None, true).atlas;
    assert!(charts(&merged) < charts_before.len());
    assert_eq!(merged.face_count(), atlas.face_count());
}

#[test]
fn it_stops_when_cancelled() {
    let atlas = torn(12, 4, 3.0, 0.1, 17);
    let cancel = std::sync::Arc::new(std::sync::atomic::AtomicBool::new(true));
    let context = Context::new(std::sync::Arc::new(crate::context::Silent), cancel, 0);
    let failure = merged(&atlas, &Defrag::default(), &options(), &context).unwrap_err();
    assert_eq!(failure.code, crate::error::Code::Canceled);
}
