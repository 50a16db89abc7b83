//! UV tiles: charts in other tiles of a repeated texture are normalised to the first.

use glam::DVec2;

use crate::asset::Tiling;
use crate::atlas::{Atlas, Charts, FaceId, Topology, UvId};
use crate::error::Warning;
use crate::texture::Slot;
use crate::texture::Wrap;

/// Bounding boxes of the charts of a set may sum up to this many reference sheets once a chart is larger
/// than a tile; what is more is not baked out, but for small textures.
const MOST_SHEETS: f64 = 4.0;
/// Bounding boxes with this many reference texels in all are baked out whatever they repeat.
const MOST_TEXELS: f64 = 1_048_576.0;
/// A texture that is repeated over more than so many times its own area is taken for a mistake.
const MOST_MEANT: f64 = 1e4;
/// Sets whose charts cover less than this many square texels in all read single colours.
const LEAST_AREA: f64 = 1.0;
/// A chart may stick out of a tile by this many texels before it counts as repeating it.
const SLACK: f64 = 1.0;
/// Stands for several charts.
const SHARED: u32 = u32::MAX - 1;
/// A layout without images, whose UVs may be in any unit, keeps its scale up to this many of its virtual sheets.
const MOST_VIRTUAL_SHEETS: f64 = 64.0;

/// Moves charts by whole tiles into the first, where every slot repeats on that axis. `constant` says that the images are of
/// one colour each, so that UVs without area read them well. A layout without images has no tiles, and any unit: one that is
/// far larger or smaller than its virtual sheet is scaled to it.
///
/// # Errors
/// The warning with which the set passes through: a palette, or a chart that repeats its texture and may or can
/// not be baked out.
pub(crate) fn normalise_tiles(
    atlas: &mut Atlas,
    slots: &[Slot],
    sheet: [u32; 2],
    tiling: Tiling,
    constant: bool,
) -> Result<(), Warning> {
    let area = || -> f64 { atlas.faces().map(|f| atlas.uv_area(f).abs()).sum() };
    let no_area = || {
        let text = "the texture set is left as it is: its UVs have no area, so that it reads single texels, as of a palette: no other layout would be smaller";
        Warning::new("palette_texture", text)
    };
    if area() < LEAST_AREA && !constant && !slots.is_empty() {
        return Err(no_area());
    }
    if !atlas.uv.iter().all(|p| p.is_finite()) {
        let text = "the texture set is left as it is: its texture transform throws UVs beyond all measure (its scale, offset and rotation should be ordinary numbers)";
        return Err(Warning::new("uv_out_of_range", text));
    }
    let size = DVec2::new(f64::from(sheet[0]), f64::from(sheet[1]));
    let charts = Charts::new(&Topology::new(atlas));
    let boxes: Vec<(DVec2, DVec2)> = charts.ids().map(|c| bounds(atlas, &charts.faces[c.index()])).collect();
    if slots.is_empty() {
        let scale = virtual_scale(&boxes, area(), size).ok_or_else(no_area)?;
        if scale != 1.0 {
            atlas.uv.iter_mut().for_each(|uv| *uv *= scale);
        }
        return Ok(());
    }
    let wraps = chart_wraps(atlas, &charts, slots);
    check_tiling(&boxes, &wraps, size, tiling)?;
    // By UV vertex: the chart that it belongs to, and its copy for the chart that is being moved.
    let mut owner = vec![u32::MAX; atlas.uv.len()];
    let mut copy = vec![(u32::MAX, UvId(0)); atlas.uv.len()];
    for (corners, chart) in atlas.corners.iter().zip(&charts.of_face) {
        for corner in corners {
            let owner = &mut owner[corner.index()];
            *owner = if *owner == u32::MAX || *owner == chart.0 { chart.0 } else { SHARED };
        }
    }
    let mut shifts = vec![DVec2::ZERO; charts.len()];
    for axis in 0..2 {
        // Two tiles where an odd one is mirrored.
        for (wrap, tile) in [(Wrap::Repeat, size[axis]), (Wrap::MirroredRepeat, 2.0 * size[axis])] {
            let own: Vec<usize> = (0..charts.len()).filter(|&c| wraps[c][axis] == WrapUse::All(wrap)).collect();
            let middles: Vec<f64> = own.iter().map(|&c| 0.5 * (boxes[c].0[axis] + boxes[c].1[axis])).collect();
            for (&chart, tiles) in own.iter().zip(tile_offsets(&middles, tile)) {
                shifts[chart][axis] = -tiles * tile;
            }
        }
    }
    for (chart, (faces, &shift)) in charts.faces.iter().zip(&shifts).enumerate() {
        if shift == DVec2::ZERO {
            continue;
        }
        let chart = chart as u32;
        for face in faces {
            for corner in &mut atlas.corners[face.index()] {
                let known = &mut copy[corner.index()];
                if known.0 != chart {
                    let uv = atlas.uv[corner.index()] + shift;
                    *known = (chart, *corner);
                    if owner[corner.index()] == SHARED {
                        known.1 = UvId::new(atlas.uv.len());
                        atlas.uv.push(uv);
                    } else {
                        atlas.uv[corner.index()] = uv;
                    }
                }
                *corner = known.1;
            }
        }
    }
    Ok(())
}

/// Faces of which a corner lies further away than this many images are no repeated texture but a fault, as long as they are few.
const WILD_TILES: f64 = 10_000.0;
/// Most of them: this many, or that part of all faces.
const MOST_WILD: usize = 8;
const MOST_WILD_PART: f64 = 0.01;

/// Takes the corners of a few faces with wild UVs into the image, each by itself, so that they do not keep all others from being refined; gives those
/// faces. Where there are many they are left.
pub(crate) fn tame(atlas: &mut Atlas, sheet: [u32; 2]) -> Vec<FaceId> {
    let size = DVec2::new(f64::from(sheet[0]), f64::from(sheet[1]));
    let is_wild = |p: DVec2| !p.is_finite() || (p / size).abs().max_element() > WILD_TILES;
    let wild: Vec<FaceId> = atlas.faces().filter(|f| atlas.uv_triangle(*f).into_iter().any(is_wild)).collect();
    let most = MOST_WILD.max((MOST_WILD_PART * atlas.face_count() as f64) as usize);
    if wild.len() > most || wild.len() == atlas.face_count() {
        return Vec::new();
    }
    for f in &wild {
        for k in 0..3 {
            let at = atlas.uv[atlas.corners[f.index()][k].index()];
            let inside = DVec2::new(at.x.rem_euclid(size.x), at.y.rem_euclid(size.y));
            atlas.corners[f.index()][k] = UvId::new(atlas.uv.len());
            atlas.uv.push(if inside.is_finite() { inside } else { 0.5 * size });
        }
    }
    if !wild.is_empty() {
        atlas.drop_unused_uvs();
    }
    wild
}

/// Whether UVs leave the image by more than a texel, where wrap modes differ.
pub(crate) fn leaves_tile(mut uvs: impl Iterator<Item = DVec2>, sheet: [u32; 2]) -> bool {
    let inside = |x: f64, size: u32| (-SLACK..=f64::from(size) + SLACK).contains(&x);
    uvs.any(|p| !inside(p.x, sheet[0]) || !inside(p.y, sheet[1]))
}

/// How many tiles each chart is away, told by its middle: one that lies across a border by a little stays with those
/// that it shares texels with. Charts whose middles span less than a tile have no copies in other tiles, and move
/// together or not at all.
fn tile_offsets(middles: &[f64], tile: f64) -> Vec<f64> {
    let (low, high) = middles.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| (l.min(*x), h.max(*x)));
    if high - low < tile - SLACK {
        return vec![(0.5 * (low + high) / tile).floor(); middles.len()];
    }
    // Copies in two tiles differ by rounding: the border is put where no chart's middle should be.
    middles.iter().map(|x| ((x + 0.25 * SLACK) / tile).floor()).collect()
}

/// How the images of a chart are read beyond their edges, on one axis.
#[derive(Debug, Clone, Copy, PartialEq)]
enum WrapUse {
    /// No image is read.
    Nothing,
    /// All in the same way.
    All(Wrap),
    /// In several ways, one of which repeats.
    Mixed,
}

impl WrapUse {
    fn and(self, other: WrapUse) -> WrapUse {
        match (self, other) {
            (WrapUse::Nothing, other) | (other, WrapUse::Nothing) => other,
            (a, b) if a == b => a,
            _ => WrapUse::Mixed,
        }
    }
}

/// The wrap modes (S, T) of every chart, over all slots and primitives.
fn chart_wraps(atlas: &Atlas, charts: &Charts, slots: &[Slot]) -> Vec<[WrapUse; 2]> {
    let both = |a: [WrapUse; 2], b: [WrapUse; 2]| [a[0].and(b[0]), a[1].and(b[1])];
    let mut by_primitive: Vec<[WrapUse; 2]> = Vec::new();
    for reading in slots.iter().flat_map(|s| &s.readings) {
        for &p in &reading.primitives {
            if by_primitive.len() <= p as usize {
                by_primitive.resize(p as usize + 1, [WrapUse::Nothing; 2]);
            }
            let known = &mut by_primitive[p as usize];
            *known = both(*known, reading.wrap.map(WrapUse::All));
        }
    }
    let of_face = |f: &FaceId| {
        let primitive = atlas.provenance.get(f.index()).map_or(0, |p| p.primitive as usize);
        by_primitive.get(primitive).copied().unwrap_or([WrapUse::Nothing; 2])
    };
    charts.faces.iter().map(|faces| faces.iter().map(of_face).fold([WrapUse::Nothing; 2], both)).collect()
}

fn bounds(atlas: &Atlas, faces: &[FaceId]) -> (DVec2, DVec2) {
    let start = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    faces.iter().flat_map(|f| atlas.uv_triangle(*f)).fold(start, |(low, high), p| (low.min(p), high.max(p)))
}

/// What a layout without images is scaled by; none where it has no area in any unit. `area` is that of its triangles.
fn virtual_scale(boxes: &[(DVec2, DVec2)], area: f64, size: DVec2) -> Option<f64> {
    let sum: f64 = boxes.iter().map(|(low, high)| (*high - *low).element_product()).sum();
    let sheets = sum / size.element_product();
    let larger = boxes.iter().any(|(low, high)| (*high - *low - size).max_element() > SLACK);
    if area >= LEAST_AREA && (!larger || sheets <= MOST_VIRTUAL_SHEETS) {
        return Some(1.0);
    }
    // A power of two, so that coordinates keep their digits.
    let scale = sheets.sqrt().recip().log2().floor().exp2();
    (scale.is_finite() && area * scale * scale >= LEAST_AREA).then_some(scale)
}

fn check_tiling(boxes: &[(DVec2, DVec2)], wraps: &[[WrapUse; 2]], size: DVec2, tiling: Tiling) -> Result<(), Warning> {
    let larger = |axis: usize| boxes.iter().any(|(low, high)| high[axis] - low[axis] > size[axis] + SLACK);
    let repeats = |(bounds, wrap): (&(DVec2, DVec2), &[WrapUse; 2])| {
        let (low, high) = bounds;
        let free = |axis: usize| matches!(wrap[axis], WrapUse::Nothing | WrapUse::All(Wrap::ClampToEdge));
        (0..2).any(|axis| !free(axis) && high[axis] - low[axis] > size[axis] + SLACK)
    };
    if tiling == Tiling::Leave && boxes.iter().zip(wraps).any(repeats) {
        let text =
            "the texture set is left as it is: a chart repeats its texture (atlas.tiling \"bake\" has it baked out)";
        return Err(Warning::new("tiling_left", text));
    }
    let sum: f64 = boxes.iter().map(|(low, high)| (*high - *low).element_product()).sum();
    let sheets = sum / size.element_product();
    // Small textures may be repeated more often.
    let many = sheets > MOST_SHEETS && sum > MOST_TEXELS;
    // Not a number where coordinates are beyond all measure.
    if (larger(0) || larger(1)) && (many || sheets.is_nan()) {
        // Beyond that it is no repetition that anybody meant.
        let text = match sheets <= MOST_MEANT {
            true => format!(
                "the texture set is left as it is: its charts repeat the texture, which would have to be {sheets:.1} times as large to be baked out; at most {MOST_SHEETS} times are made. Give what repeats a material of its own, so that the rest can be refined"
            ),
            false => "the texture set is left as it is: its texture coordinates reach thousands of images away, which is most likely an error of the program that wrote them. Bring them into the image, and it can be refined".to_owned(),
        };
        return Err(Warning::new("tiling_too_large", text));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::asset::fixture::slot;
    use crate::atlas::{Provenance, Surface, VertexId};
    use glam::DVec3;

    const SHEET: [u32; 2] = [100, 50];

    #[test]
    fn a_few_wild_faces_are_taken_into_the_image_and_many_are_left() {
        let low = DVec2::new(10.0, 10.0);
        let mut triangles = vec![[low, low + DVec2::X * 20.0, low + DVec2::Y * 20.0]; 6];
        triangles[2][1] = DVec2::new(-1e7 - 30.0, 3.76e7);
        triangles[4][0] = DVec2::new(1e38, 20.0);
        let before = crate::atlas::testing::soup(&triangles);
        let mut atlas = before.clone();
        assert_eq!(tame(&mut atlas, SHEET), [FaceId(2), FaceId(4)]);
        let inside = |p: DVec2| p.cmpge(DVec2::ZERO).all() && p.cmple(DVec2::new(100.0, 50.0)).all();
        for f in atlas.faces() {
            assert!(atlas.uv_triangle(f).into_iter().all(inside), "{f:?}");
            if f.0 != 2 && f.0 != 4 {
                assert_eq!(atlas.uv_triangle(f), before.uv_triangle(f));
            }
        }
        // All of them far away is a layout somewhere else.
        let far: Vec<[DVec2; 3]> = triangles.iter().map(|t| t.map(|p| p + 1e7)).collect();
        let mut atlas = crate::atlas::testing::soup(&far);
        assert_eq!(tame(&mut atlas, SHEET), []);
    }

    /// An Atlas of loose triangles: the corner at `(x, y)` and sides of length `s`.
    fn triangles(places: &[(f64, f64, f64)]) -> Atlas {
        let mut atlas = Atlas { surface: Surface::default(), sheets: vec![SHEET], ..Atlas::default() };
        for (i, &(x, y, s)) in places.iter().enumerate() {
            let ids = [0, 1, 2].map(|k| 3 * i + k);
            atlas.surface.positions.extend([DVec3::ZERO, DVec3::X, DVec3::Y]);
            atlas.surface.triangles.push(ids.map(VertexId::new));
            atlas.uv.extend([DVec2::new(x, y), DVec2::new(x + s, y), DVec2::new(x, y + s)]);
            atlas.corners.push(ids.map(UvId::new));
            atlas.provenance.push(Provenance::whole(FaceId::new(i), 0));
            atlas.page.push(0);
        }
        atlas
    }

    fn moved(places: &[(f64, f64, f64)], wrap: [Wrap; 2], tiling: Tiling) -> Result<Vec<(f64, f64)>, String> {
        let mut atlas = triangles(places);
        let readings = vec![crate::texture::Reading { wrap, primitives: vec![0] }];
        let slots = [crate::texture::Slot { readings, ..slot(0, SHEET) }];
        normalise_tiles(&mut atlas, &slots, SHEET, tiling, false).map_err(|w| w.code)?;
        Ok(atlas.uv.chunks(3).map(|c| (c[0].x, c[0].y)).collect())
    }

    #[test]
    fn each_axis_follows_its_own_wrap_mode() {
        let places = [(10.0, 10.0, 20.0), (310.0, -140.0, 20.0)];
        let normalised = |wrap| moved(&places, wrap, Tiling::Bake).unwrap()[1];
        assert_eq!(normalised([Wrap::Repeat, Wrap::Repeat]), (10.0, 10.0));
        assert_eq!(normalised([Wrap::Repeat, Wrap::ClampToEdge]), (10.0, -140.0));
        // Three tiles to the left is two and one that is mirrored; -3 tiles is -4 and the second of a pair.
        assert_eq!(normalised([Wrap::MirroredRepeat, Wrap::MirroredRepeat]), (110.0, 60.0));
        assert_eq!(normalised([Wrap::ClampToEdge, Wrap::ClampToEdge]), (310.0, -140.0));
    }

    #[test]
    fn charts_across_a_border_stay_together() {
        let repeat = [Wrap::Repeat; 2];
        let across = [(-10.0, 5.0, 15.0), (60.0, 5.0, 30.0)];
        assert_eq!(moved(&across, repeat, Tiling::Bake).unwrap(), [(-10.0, 5.0), (60.0, 5.0)]);
        // With a copy in the next tile the two become one.
        let copied = [(-10.0, 5.0, 15.0), (60.0, 5.0, 30.0), (90.0, 5.0, 15.0)];
        assert_eq!(moved(&copied, repeat, Tiling::Bake).unwrap(), [(90.0, 5.0), (60.0, 5.0), (90.0, 5.0)]);
    }

    #[test]
    fn a_vertex_of_two_charts_is_parted_when_one_moves() {
        let mut atlas = triangles(&[(80.0, 5.0, 30.0), (110.0, 5.0, 40.0), (250.0, 5.0, 20.0)]);
        atlas.corners[1][0] = atlas.corners[0][1];
        atlas.surface.triangles[1][0] = atlas.surface.triangles[0][1];
        let before = [0, 1].map(|f| atlas.uv_area(FaceId(f)));
        normalise_tiles(&mut atlas, &[slot(0, SHEET)], SHEET, Tiling::Bake, false).unwrap();
        assert_eq!([0, 1].map(|f| atlas.uv_area(FaceId(f))), before);
        assert_eq!(atlas.uv_triangle(FaceId(1))[0], DVec2::new(10.0, 5.0));
    }

    #[test]
    fn a_layout_without_images_has_any_unit() {
        let scaled = |places: &[(f64, f64, f64)]| {
            let mut atlas = triangles(places);
            normalise_tiles(&mut atlas, &[], SHEET, Tiling::Leave, false).map_err(|w| w.code)?;
            Ok::<f64, String>(atlas.uv[1].x - atlas.uv[0].x)
        };
        assert_eq!(scaled(&[(310.0, -140.0, 20.0)]), Ok(20.0), "within reason it stays");
        assert_eq!(scaled(&[(0.0, 0.0, 400.0)]), Ok(400.0));
        assert_eq!(scaled(&[(5e6, 0.0, 3000.0), (9e6, 0.0, 4000.0)]), Ok(3000.0 / 128.0), "millimetres");
        assert_eq!(scaled(&[(0.0, 0.0, 0.01)]), Ok(0.01 * 4096.0), "kilometres");
        assert_eq!(scaled(&[(0.0, 0.0, 1e30)]).map(|side| (10.0..100.0).contains(&side)), Ok(true));
        assert_eq!(scaled(&[(3.0, 3.0, 0.0)]), Err("palette_texture".to_owned()));
    }

    #[test]
    fn tiling_and_palettes_pass_through_by_name() {
        let tiling = |side: f64, wrap, mode| moved(&[(0.0, 0.0, side)], [wrap; 2], mode).err();
        assert_eq!(tiling(120.0, Wrap::Repeat, Tiling::Bake), None);
        assert_eq!(tiling(120.0, Wrap::Repeat, Tiling::Leave).as_deref(), Some("tiling_left"));
        assert_eq!(tiling(120.0, Wrap::ClampToEdge, Tiling::Leave), None);
        assert_eq!(tiling(150.0, Wrap::Repeat, Tiling::Bake), None);
        assert_eq!(tiling(1030.0, Wrap::Repeat, Tiling::Bake).as_deref(), Some("tiling_too_large"));
        assert_eq!(tiling(1e200, Wrap::ClampToEdge, Tiling::Bake).as_deref(), Some("tiling_too_large"));
        assert_eq!(tiling(0.01, Wrap::Repeat, Tiling::Bake).as_deref(), Some("palette_texture"));
    }
}
