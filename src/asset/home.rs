//! Charts come home: from other tiles of a repeated texture into the first.

use glam::DVec2;

use super::Slot;
use crate::atlas::{Atlas, Charts, Topology};
use crate::error::Warning;
use crate::refine::options::Tiling;
use crate::texture::Wrap;

/// Bounding boxes of the charts of a set may sum up to this many reference sheets once a chart is larger
/// than a tile; what is more is not baked out.
const MOST_SHEETS: f64 = 4.0;
/// Sets whose charts cover less than this many square texels in all read single colours.
const LEAST_AREA: f64 = 1.0;
/// A chart may stick out of a tile by this many texels before it counts as repeating it.
const SLACK: f64 = 1.0;

/// Moves charts by whole tiles into the first, where every slot repeats on that axis.
///
/// # Errors
/// The warning with which the set passes through: a palette, or a chart that repeats its texture and may or can
/// not be baked out.
pub(crate) fn bring_home(atlas: &mut Atlas, slots: &[Slot], sheet: [u32; 2], tiling: Tiling) -> Result<(), Warning> {
    let area: f64 = atlas.faces().map(|f| atlas.uv_area(f).abs()).sum();
    if area < LEAST_AREA {
        let text = "the texture set is left as it is: its UVs have no area, so that it reads single texels";
        return Err(Warning::new("palette_texture", text));
    }
    let size = DVec2::new(f64::from(sheet[0]), f64::from(sheet[1]));
    let wraps = [0, 1].map(|axis| common_wrap(slots, axis));
    let charts = Charts::new(&Topology::new(atlas));
    let boxes: Vec<(DVec2, DVec2)> = charts.ids().map(|c| bounds(atlas, &charts.faces[c.index()])).collect();
    check_tiling(&boxes, slots, size, tiling)?;
    let mut moved = vec![false; atlas.uv.len()];
    for (faces, (low, high)) in charts.faces.iter().zip(&boxes) {
        let mut shift = DVec2::ZERO;
        for axis in 0..2 {
            let tile = match wraps[axis] {
                Some(Wrap::Repeat) => size[axis],
                // Two tiles: an odd one is mirrored.
                Some(Wrap::MirroredRepeat) => 2.0 * size[axis],
                _ => continue,
            };
            shift[axis] = -(home(low[axis], high[axis], size[axis]) / tile).floor() * tile;
        }
        if shift == DVec2::ZERO {
            continue;
        }
        for corner in faces.iter().flat_map(|f| atlas.corners[f.index()]) {
            // A UV vertex belongs to one chart.
            if !std::mem::replace(&mut moved[corner.index()], true) {
                atlas.uv[corner.index()] += shift;
            }
        }
    }
    Ok(())
}

/// The coordinate whose tile is a chart's own: its middle, or its low end when it is larger than a tile. A
/// chart that lies across a tile's border by a little thus stays with those that it shares texels with.
fn home(low: f64, high: f64, tile: f64) -> f64 {
    if high - low > tile + SLACK { low + SLACK } else { 0.5 * (low + high) }
}

/// The wrap mode of an axis, where all slots agree.
fn common_wrap(slots: &[Slot], axis: usize) -> Option<Wrap> {
    let first = slots.first()?.wrap[axis];
    slots.iter().all(|s| s.wrap[axis] == first).then_some(first)
}

fn bounds(atlas: &Atlas, faces: &[crate::atlas::FaceId]) -> (DVec2, DVec2) {
    let start = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    faces.iter().flat_map(|f| atlas.uv_triangle(*f)).fold(start, |(low, high), p| (low.min(p), high.max(p)))
}

fn check_tiling(boxes: &[(DVec2, DVec2)], slots: &[Slot], size: DVec2, tiling: Tiling) -> Result<(), Warning> {
    let larger = |axis: usize| boxes.iter().any(|(low, high)| high[axis] - low[axis] > size[axis] + SLACK);
    let repeats = |axis: usize| slots.iter().any(|s| s.wrap[axis] != Wrap::ClampToEdge);
    if tiling == Tiling::Leave && (0..2).any(|axis| larger(axis) && repeats(axis)) {
        let text = "the texture set is left as it is: a chart repeats its texture";
        return Err(Warning::new("tiling_left", text));
    }
    let sum: f64 = boxes.iter().map(|(low, high)| (*high - *low).element_product()).sum();
    let most = MOST_SHEETS * size.element_product();
    if (larger(0) || larger(1)) && !(sum <= most) {
        let text = format!(
            "the texture set is left as it is: its charts repeat their texture over {:.1} sheets, and at most {MOST_SHEETS} are baked out",
            sum / size.element_product()
        );
        return Err(Warning::new("tiling_too_large", text));
    }
    Ok(())
}
