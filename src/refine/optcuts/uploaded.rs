//! What the uploaded layout offers to start from: which faces stay as they are, and charts that neither fold nor overlap themselves.

use rayon::prelude::*;

use super::params::{OptCuts, Start};
use super::pieces::{is_degenerate, laid_flat};
use crate::atlas::overlap::overlaps_in_blocks;
use crate::atlas::{Atlas, Charts, FaceId, Topology, UvId, clusters, orientation};
use crate::error::Result;
use crate::refine::box_cutter::overlap::remove_overlaps;
use crate::refine::stage::StageInput;

/// Pair tests per face in the search for an overlap.
const TESTS_PER_FACE: usize = 20_000;

/// The uploaded layout, as it can be started from.
#[derive(Debug)]
pub(super) struct StartLayout {
    /// All faces, with UVs that may be others than uploaded.
    pub atlas: Atlas,
    /// By face: whether its chart cannot be started from.
    pub unfit: Vec<bool>,
    /// Charts that were cut because they folded or overlapped themselves.
    pub repaired: usize,
}

/// By face: whether its chart stays as it is.
pub(super) fn held_back(input: &StageInput<'_>, params: &OptCuts) -> Vec<bool> {
    let atlas = input.atlas;
    if !atlas.has_layout() || params.start == Start::Fresh {
        return vec![false; atlas.face_count()];
    }
    let charts = Charts::new(&Topology::new(atlas));
    let together = clusters(atlas, &charts, input.options.atlas.overlaps);
    let held = input.held_back(&charts, &together);
    charts.of_face.iter().map(|c| held[c.index()]).collect()
}

/// The layout to start from; none where there is none, or where it is not wanted. Faces that are not `wanted` do not count.
///
/// # Errors
/// `canceled`.
pub(super) fn layout(input: &StageInput<'_>, params: &OptCuts, wanted: &[bool]) -> Result<Option<StartLayout>> {
    if !input.atlas.has_layout() || params.start == Start::Fresh {
        return Ok(None);
    }
    let mut atlas = input.atlas.clone();
    let flattened = give_area(&mut atlas, wanted);
    let charts = Charts::new(&Topology::new(&atlas));
    let fit = |faces: &Vec<FaceId>| -> Result<bool> {
        input.context.check()?;
        Ok(!(folds(&atlas, faces, wanted) || params.bijective && overlaps_itself(&atlas, faces)?))
    };
    let fit = charts.faces.par_iter().map(fit).collect::<Result<Vec<bool>>>()?;
    let repaired = fit.iter().filter(|fit| !**fit).count();
    let mut unfit: Vec<bool> = charts.of_face.iter().map(|c| !fit[c.index()]).collect();
    if params.start == Start::Auto {
        unfit.iter_mut().zip(flattened).for_each(|(unfit, flattened)| *unfit |= flattened);
        return Ok(Some(StartLayout { atlas, unfit, repaired: 0 }));
    }
    if repaired > 0 {
        atlas = remove_overlaps(&atlas, &|c| !fit[c.index()], None, input.context)?.atlas;
        // Where faces without area hide a fold it may still be there: such a chart falls apart.
        let charts = Charts::new(&Topology::new(&atlas));
        for faces in &charts.faces {
            if folds(&atlas, faces, wanted) {
                faces.iter().for_each(|f| isolate(&mut atlas, *f));
            }
        }
    }
    Ok(Some(StartLayout { unfit: vec![false; atlas.face_count()], atlas, repaired }))
}

/// Gives those faces that have no area in UV and one on the surface a chart of their own; says which.
fn give_area(atlas: &mut Atlas, wanted: &[bool]) -> Vec<bool> {
    let (mut uv, mut area) = (0.0, 0.0);
    for f in atlas.faces().filter(|f| wanted[f.index()]) {
        uv += atlas.uv_area(f).abs();
        area += atlas.area(f);
    }
    let density = if uv > 0.0 && area > 0.0 { (uv / area).sqrt() } else { 1.0 };
    let is_flat = |f: FaceId| {
        let [a, b, c] = atlas.uv_triangle(f);
        wanted[f.index()] && (orientation(a, b, c) == 0 || is_degenerate([a, b, c].map(|p| p.extend(0.0))))
    };
    let flat: Vec<bool> = atlas.faces().map(is_flat).collect();
    for f in atlas.faces().filter(|f| flat[f.index()]) {
        // Texels run down: what is face up on the surface has a negative area.
        let laid = laid_flat(atlas.triangle(f)).map(|p| p * glam::DVec2::new(1.0, -1.0) * density);
        atlas.corners[f.index()] = [0, 1, 2].map(|k| UvId::new(atlas.uv.len() + k));
        atlas.uv.extend(laid);
    }
    flat
}

/// Makes a face a chart of its own, at its place.
fn isolate(atlas: &mut Atlas, face: FaceId) {
    let own = atlas.uv_triangle(face);
    atlas.corners[face.index()] = [0, 1, 2].map(|k| UvId::new(atlas.uv.len() + k));
    atlas.uv.extend(own);
}

/// Whether faces of both orientations are in a chart.
fn folds(atlas: &Atlas, faces: &[FaceId], wanted: &[bool]) -> bool {
    let sign = |f: &FaceId| {
        let [a, b, c] = atlas.uv_triangle(*f);
        orientation(a, b, c)
    };
    let mut signs = faces.iter().filter(|f| wanted[f.index()]).map(sign);
    signs.next().is_some_and(|first| signs.any(|sign| sign != first))
}

/// Whether two faces of a chart overlap.
fn overlaps_itself(atlas: &Atlas, faces: &[FaceId]) -> Result<bool> {
    let mut found = false;
    overlaps_in_blocks(
        atlas,
        faces,
        (TESTS_PER_FACE, 1),
        |_| true,
        |pairs, cut_short| {
            found |= cut_short || !pairs.is_empty();
            Ok(!found)
        },
    )?;
    Ok(found)
}
