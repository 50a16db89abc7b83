//! What is wrong with the layout of a piece, recomputed from scratch, and what can be done about it.

use glam::DVec2;

use super::pieces::{Strain, laid_flat, seam_length, shelves};
use super::solver::Solution;
use crate::atlas::groups::sorted_unique;
use crate::atlas::overlap::overlaps_where;
use crate::atlas::{Atlas, FaceId, HalfEdge, Mesh, orientation, penetration};

/// How deep faces may overlap, in units of the extent of their layout: what rounding makes of faces that touch.
const ROUNDING: f64 = 1e-11;
/// What texture coordinates in 32 bits can tell apart, in units of the extent of their layout.
const WRITTEN: f64 = 1.0 / (1 << 23) as f64;
/// Part of the faces that may be detached.
const FEW: f64 = 0.02;
/// Rounds of detaching: what is done about some faces may leave others too small to be written.
const ROUNDS: usize = 3;

/// What is wrong, and with which faces; with none where it is not a matter of faces.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Fault {
    pub what: &'static str,
    pub faces: Vec<FaceId>,
}

/// What is wrong with the layout `solved` of a piece, if anything is.
pub(super) fn fault(piece: &Atlas, solved: &Atlas, bijective: bool) -> Option<Fault> {
    let whole = |what| Some(Fault { what, faces: Vec::new() });
    if solved.surface.triangles != piece.surface.triangles || solved.corners.len() != piece.corners.len() {
        return whole("its faces are others");
    }
    if solved.corners.iter().flatten().any(|u| u.index() >= solved.uv.len()) {
        return whole("a face has no UVs");
    }
    let mut owner = vec![None; solved.uv.len()];
    let mut corners = solved.corners.iter().flatten().zip(solved.surface.triangles.iter().flatten());
    if corners.any(|(u, v)| *owner[u.index()].get_or_insert(*v) != *v) {
        return whole("a UV vertex belongs to two vertices");
    }
    let some = |what, is_wrong: &dyn Fn(FaceId) -> bool| {
        let faces: Vec<FaceId> = solved.faces().filter(|f| is_wrong(*f)).collect();
        (!faces.is_empty()).then_some(Fault { what, faces })
    };
    let down = |f: FaceId| {
        let [a, b, c] = solved.uv_triangle(f);
        !(a.is_finite() && b.is_finite() && c.is_finite()) || orientation(a, b, c) <= 0
    };
    if let Some(fault) = some("a face is turned over or has lost its area", &down) {
        return Some(fault);
    }
    // Moving charts rounds the last digits.
    let extent = extent(solved);
    let lost = |f: FaceId| {
        let [a, b, c] = solved.uv_triangle(f).map(|p| (p / extent / WRITTEN).round());
        orientation(a, b, c) <= 0
    };
    if let Some(fault) = some("a face is too small to be written in 32 bits", &lost) {
        return Some(fault);
    }
    if !bijective {
        return None;
    }
    let deep = |f, g| penetration(&solved.uv_triangle(f), &solved.uv_triangle(g)) > ROUNDING * extent;
    let area = |f: FaceId| solved.uv_area(f).abs();
    let smaller = |(f, g): &(FaceId, FaceId)| if area(*f) < area(*g) { *f } else { *g };
    let faces: Vec<FaceId> = sorted_unique(overlaps_where(solved, 1, deep).0.iter().map(smaller));
    (!faces.is_empty()).then_some(Fault { what: "two faces overlap", faces })
}

/// The largest coordinate.
fn extent(atlas: &Atlas) -> f64 {
    atlas.uv.iter().fold(0.0, |most: f64, p| most.max(p.abs().max_element()))
}

/// A solution without fault where it is a matter of few faces: these become charts of their own, without distortion. The error says what is wrong.
pub(super) fn mended(piece: &Atlas, mut solution: Solution, bijective: bool) -> std::result::Result<Solution, String> {
    let bound = solution.bound_met.then_some(solution.distortion);
    let mut detached = 0;
    for _ in 0..=ROUNDS {
        let Some(Fault { what, faces }) = fault(piece, &solution.atlas, bijective) else {
            return Ok(solution);
        };
        detached += faces.len();
        if faces.is_empty() || detached as f64 > (FEW * piece.face_count() as f64).max(1.0) {
            return Err(what.to_owned());
        }
        let atlas = detach(solution.atlas, &faces);
        let distortion = Strain::of(&atlas).energy();
        solution = Solution {
            distortion,
            seam_length: seam_length(&atlas),
            // Without their distortion it is less, if not by what is rounded.
            bound_met: bound.is_some_and(|most| distortion <= most * (1.0 + 1e-9)),
            detached,
            atlas,
            ..solution
        };
    }
    Err("faces are too small to be written in 32 bits".to_owned())
}

/// Cuts faces off and lays them flat beside everything else, as wide as can be written.
fn detach(atlas: Atlas, faces: &[FaceId]) -> Atlas {
    let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    for p in atlas.uv.iter().filter(|p| p.is_finite()) {
        (low, high) = (low.min(*p), high.max(*p));
    }
    let extent = (high - low).max_element().max(high.abs().max_element());
    let shapes: Vec<[DVec2; 3]> =
        faces.iter().map(|f| widened(laid_flat(atlas.triangle(*f)), 16.0 * WRITTEN * extent)).collect();
    let boxes = shapes.iter().map(|t| (t[0].min(t[1]).min(t[2]), t[0].max(t[1]).max(t[2])));
    let boxes: Vec<(DVec2, DVec2)> = boxes.collect();
    let gap = 64.0 * WRITTEN * extent;
    let places = shelves(boxes.iter().map(|(low, high)| *high - *low), gap);
    let mut mesh = Mesh::new(atlas);
    mesh.cut(&faces.iter().flat_map(|f| [0, 1, 2].map(|k| HalfEdge::of(*f, k))).collect::<Vec<_>>());
    for (((f, shape), place), (own, _)) in faces.iter().zip(shapes).zip(places).zip(boxes) {
        for (k, p) in shape.into_iter().enumerate() {
            let corner = mesh.uv_at(HalfEdge::of(*f, k));
            mesh.move_uv(corner, DVec2::new(low.x, high.y + gap) + place + (p - own));
        }
    }
    mesh.into_atlas()
}

/// A triangle that was laid flat, as it is or larger: its longest edge and its height over that are not below `least`.
fn widened(mut triangle: [DVec2; 3], least: f64) -> [DVec2; 3] {
    let width = triangle.iter().fold(0.0, |most: f64, p| most.max(p.x));
    let scale = (least / width).max(1.0);
    triangle.iter_mut().for_each(|p| *p *= scale);
    let apex = (0..3).fold(0, |best, k| if triangle[k].y > triangle[best].y { k } else { best });
    triangle[apex].y = triangle[apex].y.max(least);
    triangle
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::testing::{join, sheet};
    use crate::atlas::{Charts, Topology, UvId};

    fn solution(atlas: Atlas) -> Solution {
        let (distortion, seam_length) = (Strain::of(&atlas).energy(), seam_length(&atlas));
        Solution {
            atlas,
            distortion,
            seam_length,
            bound_met: true,
            stopped_by: "done",
            iterations: 0,
            work: 0,
            detached: 0,
        }
    }

    #[test]
    fn what_is_wrong_with_a_solution_is_seen() {
        let piece = sheet(2, 2, DVec2::ZERO);
        let what = |solved: &Atlas, bijective| fault(&piece, solved, bijective).map(|f| f.what);
        assert_eq!(what(&piece, true), None);
        let change = |edit: &dyn Fn(&mut Atlas)| {
            let mut solved = piece.clone();
            edit(&mut solved);
            what(&solved, true)
        };
        assert!(change(&|a| a.uv[4].x = f64::NAN).is_some());
        assert!(change(&|a| a.uv[4] = DVec2::new(3.0, 3.0)).is_some(), "a fold");
        assert!(change(&|a| a.corners[0][0] = UvId(99)).is_some());
        assert!(change(&|a| a.corners[0][0] = a.corners[0][1]).is_some());
        assert!(change(&|a| a.corners.truncate(3)).is_some());
        let squeezed = |height: f64| change(&|a| a.uv.iter_mut().for_each(|p| p.y *= height));
        assert_eq!(squeezed(1e-5), None);
        assert_eq!(squeezed(1e-9), Some("a face is too small to be written in 32 bits"));
        let lap = join(&piece, &piece);
        let what = |bijective| fault(&lap, &lap, bijective).map(|f| f.what);
        assert_eq!((what(true), what(false)), (Some("two faces overlap"), None));
    }

    #[test]
    fn a_face_without_room_becomes_a_chart_and_the_rest_stays() {
        let piece = sheet(8, 8, DVec2::ZERO);
        let mut solved = piece.clone();
        // It loses its area; its neighbours grow.
        let [a, b, c] = solved.corners[0];
        let middle = 0.5 * (solved.uv[a.index()] + solved.uv[c.index()]);
        solved.uv[b.index()] = middle + DVec2::new(1.0, -1.0) * 1e-9;
        let bad = |solved: &Atlas| fault(&piece, solved, true);
        assert!(bad(&solved).is_some_and(|f| f.faces == [FaceId(0)]));
        let mended = mended(&piece, solution(solved.clone()), true).unwrap();
        assert_eq!((bad(&mended.atlas), mended.detached), (None, 1));
        let charts = Charts::new(&Topology::new(&mended.atlas));
        assert_eq!(charts.len(), 2);
        let untouched = piece.faces().filter(|f| mended.atlas.uv_triangle(*f) == solved.uv_triangle(*f)).count();
        assert_eq!(untouched, piece.face_count() - 1);
        assert!(mended.seam_length > 0.0 && mended.distortion < solution(solved).distortion);
        assert!((mended.atlas.uv_area(FaceId(0)) - 0.5).abs() < 1e-12, "without distortion");
    }

    #[test]
    fn many_faces_without_room_are_a_fault_of_the_whole() {
        let piece = sheet(8, 8, DVec2::ZERO);
        let mut solved = piece.clone();
        solved.uv.iter_mut().for_each(|p| p.y *= 1e-9);
        assert_eq!(mended(&piece, solution(solved), true).unwrap_err(), "a face is too small to be written in 32 bits");
        let lap = join(&piece, &piece);
        assert!(mended(&lap, solution(lap.clone()), true).is_err());
    }
}
