//! Panels read back from their SVG.

use std::collections::BTreeMap;

use glam::DVec2;

use super::*;
use crate::atlas::Move;
use crate::atlas::testing::{cut_open, half_edges_where, sheet};

/// A sheet of 4 x 2 squares, a unit each, as two charts of 2 x 2 that lie apart and were one; 8 texels a unit.
fn halves() -> Atlas {
    let whole = sheet(4, 2, DVec2::ZERO);
    let cuts = half_edges_where(&whole, |a, b| a.x == 2.0 && b.x == 2.0);
    assert_eq!(cuts.len(), 4);
    let cut = cut_open(&whole, &cuts);
    let charts = Charts::new(&Topology::new(&cut));
    let there = |i: usize| Move {
        page: i as u16,
        linear: glam::DMat2::from_diagonal(DVec2::new(8.0, 8.0)),
        translate: DVec2::new(10.0 - 16.0 * i as f64, 10.0),
    };
    cut.moved(&charts, &[there(0), there(1)], vec![[40, 40], [48, 40]])
}

/// The closed subpaths of all paths of a class.
fn rings(svg: &str, class: &str) -> Vec<Vec<DVec2>> {
    let mut rings = Vec::new();
    for path in svg.split(&format!("<path class=\"{class}\"")).skip(1) {
        let d = path.split(" d=\"").nth(1).unwrap().split('"').next().unwrap();
        for ring in d.split(['M', 'Z']).filter(|r| !r.is_empty()) {
            let point = |p: &str| {
                let (x, y) = p.split_once(' ').unwrap();
                DVec2::new(x.parse().unwrap(), y.parse().unwrap())
            };
            rings.push(ring.split('L').map(point).collect());
        }
    }
    rings
}

fn area(ring: &[DVec2]) -> f64 {
    let n = ring.len();
    (0..n).map(|i| 0.5 * ring[i].perp_dot(ring[(i + 1) % n])).sum::<f64>().abs()
}

fn numbers(svg: &str) -> Vec<u32> {
    svg.split("<text class=\"number\" data-seam=\"")
        .skip(1)
        .map(|t| t.split('"').next().unwrap().parse().unwrap())
        .collect()
}

fn params(seams: Seams) -> FabricationParams {
    FabricationParams { model_unit_mm: 100.0, seams, width_mm: 20.0, ..FabricationParams::default() }
}

#[test]
fn outlines_have_the_size_of_the_surface() {
    let atlas = halves();
    let sheets = panels(&atlas, &params(Seams::Allowance));
    assert_eq!(sheets.len(), 2);
    for svg in &sheets {
        let outlines = rings(svg, "outline");
        assert_eq!(outlines.len(), 1);
        // 2 x 2 units of 100 mm.
        assert!((area(&outlines[0]) - 40_000.0).abs() < 1.0, "{}", area(&outlines[0]));
        let allowance = rings(svg, "allowance");
        assert!((area(&allowance[0]) - 240.0 * 240.0).abs() < 1.0, "{}", area(&allowance[0]));
        assert!(svg.starts_with("<svg ") && svg.ends_with("</svg>\n"));
        assert_eq!(svg.matches("<g ").count(), svg.matches("</g>").count());
    }
    assert!(sheets[0].contains("width=\"540mm\" height=\"540mm\" viewBox=\"-20 -20 540 540\""), "{}", sheets[0]);
    // Twice 20 mm, at 12.5 mm a texel.
    assert_eq!(gutter_texels(&atlas, &params(Seams::Allowance)), 4);
    assert_eq!(gutter_texels(&atlas, &params(Seams::None)), 0);
    assert_eq!(sheets, panels(&atlas, &params(Seams::Allowance)));
    assert!((worst_scale(&atlas) - 1.0).abs() < 1e-9);
    let mut uneven = atlas.clone();
    let second: Vec<usize> = uneven.faces().filter(|f| uneven.page[f.index()] == 1).map(|f| f.index()).collect();
    let mut corners: Vec<_> = second.iter().flat_map(|f| uneven.corners[*f]).collect();
    corners.sort_unstable();
    corners.dedup();
    corners.iter().for_each(|c| uneven.uv[c.index()] *= 2.0);
    // Areas of 4 by 1 and 4 by 4 instead of 8 by 5: the first is drawn too small by sqrt(2.5).
    assert!((worst_scale(&uneven) - 2.5f64.sqrt()).abs() < 1e-9, "{}", worst_scale(&uneven));
}

#[test]
fn flaps_stand_on_one_side_and_numbers_on_both() {
    let sheets = panels(&halves(), &params(Seams::Flaps));
    let flaps: Vec<Vec<DVec2>> = sheets.iter().flat_map(|s| rings(s, "flap")).collect();
    // The seam is straight: one flap, a trapezoid.
    assert_eq!(flaps.len(), 1);
    let (long, short) = (200.0, 160.0);
    assert!((area(&flaps[0]) - 20.0 * 0.5 * (long + short)).abs() < 0.1, "{flaps:?}");
    // Outwards: the flap does not lie on its panel.
    let panel = &rings(&sheets[0], "outline")[0];
    let right = panel.iter().map(|p| p.x).fold(0.0, f64::max);
    assert!(flaps[0].iter().all(|p| p.x >= right - 1e-6));
    let mut count: BTreeMap<u32, u32> = BTreeMap::new();
    sheets.iter().flat_map(|s| numbers(s)).for_each(|n| *count.entry(n).or_default() += 1);
    assert_eq!(count, BTreeMap::from([(1, 2)]));
}

#[test]
fn every_inner_edge_of_loose_triangles_is_a_seam() {
    let mut atlas = sheet(3, 3, DVec2::ZERO);
    let before = Topology::new(&atlas);
    let inner: Vec<_> = before.half_edges().filter(|h| before.uv_twin(*h).is_some_and(|twin| twin > *h)).collect();
    let count = inner.len();
    atlas = cut_open(&atlas, &inner);
    let sheets = panels(&atlas, &params(Seams::Flaps));
    let mut seen: BTreeMap<u32, u32> = BTreeMap::new();
    numbers(&sheets[0]).into_iter().for_each(|n| *seen.entry(n).or_default() += 1);
    assert_eq!(seen.len(), count);
    assert!(seen.values().all(|n| *n == 2), "{seen:?}");
    assert_eq!(sheets[0].matches("class=\"flap\"").count(), count);
    let total: f64 = rings(&sheets[0], "outline").iter().map(|r| area(r)).sum();
    assert!((total - 9.0 * 1e4).abs() < 1.0);
}

#[test]
fn folds_are_where_the_surface_turns() {
    let mut atlas = sheet(2, 1, DVec2::ZERO);
    // The right half goes up by a right angle.
    for p in &mut atlas.surface.positions {
        if p.x > 1.0 {
            (p.x, p.z) = (1.0, p.x - 1.0);
        }
    }
    let fold = FabricationParams { fold_angle: Some(1.5), ..params(Seams::None) };
    let svg = panels(&atlas, &fold).remove(0);
    assert_eq!(svg.matches("class=\"fold\"").count(), 1);
    assert!(!svg.contains("class=\"allowance\"") && !svg.contains("class=\"flap\""));
    assert_eq!(
        panels(&atlas, &FabricationParams { fold_angle: Some(1.6), ..fold })[0].matches("class=\"fold\"").count(),
        0
    );
    assert!(panels(&Atlas::default(), &params(Seams::None)).is_empty());
}
