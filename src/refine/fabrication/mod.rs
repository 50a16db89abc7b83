//! Panels to cut from sheets of cloth, paper or wood: the charts in real units, with what sewing or gluing needs.
//!
//! The outside of the surface is seen, as the texture shows it. Charts that the upload has mirrored are drawn as they lie and
//! say so (`data-side="inside"`): cut out, they are turned over. Lengths are those of the meshes, before nodes scale them.

mod allowance;
mod flaps;
mod outline;
pub mod params;
mod seams;
mod svg;

use outline::{Outlines, folds};
pub use params::{FabricationParams, Seams};
use seams::seams;
use svg::Sheet;

use crate::atlas::{Atlas, Charts, FaceId, Loops, Topology};

/// Charts of less than this part of the surface say nothing of scale.
const NEGLIGIBLE: f64 = 1e-6;

/// Millimetres by texel: equal areas on the surface and on the sheet. None where either has none.
pub(crate) fn mm_per_texel(atlas: &Atlas, params: &FabricationParams) -> Option<f64> {
    let (surface, sheet) = atlas.faces().fold((0.0, 0.0), |(s, t), f| (s + atlas.area(f), t + atlas.uv_area(f).abs()));
    let scale = (surface / sheet).sqrt() * params.model_unit_mm;
    (scale.is_finite() && scale > 0.0).then_some(scale)
}

/// Reference texels that packing must leave free between two charts, so that what is drawn about them does not meet.
pub fn gutter_texels(atlas: &Atlas, params: &FabricationParams) -> u32 {
    let width = if params.seams == Seams::None { 0.0 } else { params.width_mm };
    mm_per_texel(atlas, params).map_or(0, |scale| (2.0 * width / scale).ceil().min(f64::from(u32::MAX)) as u32)
}

/// By how much the size of the worst chart is off, as a factor of at least 1: all panels are drawn at one scale, and charts whose
/// texels are finer or coarser than the others' come out too large or too small. 1 where nothing has an area.
pub(crate) fn worst_scale(atlas: &Atlas) -> f64 {
    let charts = Charts::new(&Topology::new(atlas));
    let sums =
        |faces: &[FaceId]| faces.iter().fold((0.0, 0.0), |(s, t), f| (s + atlas.area(*f), t + atlas.uv_area(*f).abs()));
    let all: Vec<(f64, f64)> = charts.faces.iter().map(|faces| sums(faces)).collect();
    let (surface, sheet) = all.iter().fold((0.0, 0.0), |(s, t), c| (s + c.0, t + c.1));
    // Charts that are next to nothing are no panels.
    let large = all.iter().filter(|c| c.0 > NEGLIGIBLE * surface && c.1 > 0.0);
    let off = large.map(|c| ((c.0 / c.1) / (surface / sheet)).sqrt()).map(|ratio| ratio.max(ratio.recip()));
    off.filter(|o| o.is_finite()).fold(1.0, f64::max)
}

/// One SVG for each sheet of `atlas`, in millimetres; none where the surface or its charts have no area.
pub(crate) fn panels(atlas: &Atlas, params: &FabricationParams) -> Vec<String> {
    let Some(scale) = mm_per_texel(atlas, params) else { return Vec::new() };
    let topology = Topology::new(atlas);
    let charts = Charts::new(&topology);
    let loops = Loops::new(&topology, &charts);
    let outlines = Outlines::new(atlas, &charts, &loops, scale);
    let seams = seams(&topology, &outlines);
    let folds = params.fold_angle.map(|angle| folds(atlas, &topology, scale, angle)).unwrap_or_default();
    let mut sheets: Vec<Sheet> =
        atlas.sheets.iter().map(|size| Sheet::new(size.map(|n| f64::from(n) * scale), params.width_mm)).collect();
    for chart in charts.ids() {
        let faces = &charts.faces[chart.index()];
        let Some(sheet) = faces.first().and_then(|f| sheets.get_mut(usize::from(atlas.page[f.index()]))) else {
            continue;
        };
        sheet.open(chart, outlines.area[chart.index()]);
        let own: Vec<usize> = (0..loops.chart.len()).filter(|l| loops.chart[*l] == chart).collect();
        let rings: Vec<_> = own.iter().map(|l| outlines.points(&loops.half_edges[*l])).collect();
        sheet.closed("outline", &rings);
        if params.seams == Seams::Allowance && params.width_mm > 0.0 {
            let side = outlines.outward(chart);
            let moved: Vec<_> = rings.iter().map(|r| allowance::offset(r, side, params.width_mm)).collect();
            sheet.closed("allowance", &moved);
        }
        for face in faces {
            folds.iter().filter(|f| f.0 == *face).for_each(|f| sheet.fold(f.1));
        }
        sheet.close();
    }
    for (number, seam) in seams.iter().enumerate() {
        for (side, run) in [&seam.first, &seam.second].into_iter().enumerate() {
            let Some(&start) = run.first() else { continue };
            let face = start.face();
            let Some(sheet) = sheets.get_mut(usize::from(atlas.page[face.index()])) else { continue };
            let chart = charts.of_face[face.index()];
            let (line, outward) = (outlines.line(run), outlines.outward(chart));
            if side == 0 && params.seams == Seams::Flaps && params.width_mm > 0.0 {
                sheet.flap(number + 1, &flaps::flap(&line, outward, params.width_mm));
            }
            if params.numbers {
                sheet.number(number + 1, &line, outward);
            }
        }
    }
    sheets.into_iter().map(Sheet::finish).collect()
}

#[cfg(test)]
mod tests;
