//! One winding for all that is merged.

use crate::atlas::seams::length;
use crate::atlas::{Atlas, Charts, FaceId, HalfEdge, Topology};

/// How faces are wound so that neighbours agree.
pub(super) struct Winding {
    /// The atlas, wound so.
    pub atlas: Atlas,
    /// By face: its winding was reversed.
    pub reversed: Vec<bool>,
    /// By chart: mirrored (x to -x), because its neighbours on the surface are.
    pub mirrored: Vec<bool>,
}

/// Faces reversed so that neighbours in a chart agree and the chart's area is positive. Where charts then still disagree with larger
/// neighbours along their seams, one of them is the mirror image of what the surface shows: it is mirrored too, if `may_mirror`.
pub(super) fn consistent_winding(atlas: &Atlas, charts: &Charts, may_mirror: bool) -> Winding {
    let topology = Topology::new(atlas);
    let (mut reversed, areas) = orient(atlas, charts, &topology);
    let mut mirrored = vec![false; charts.len()];
    if may_mirror {
        mirror(atlas, charts, &topology, &areas, (&mut reversed, &mut mirrored));
    }
    let mut own = atlas.clone();
    for (f, _) in reversed.iter().enumerate().filter(|(_, reversed)| **reversed) {
        own.corners[f].swap(1, 2);
        own.surface.triangles[f].swap(1, 2);
    }
    Winding { atlas: own, reversed, mirrored }
}

/// By face whether it is reversed, so that neighbours in a chart agree and areas are positive; by chart its area, each part positive, where its
/// faces hang together by edges of two faces.
fn orient(atlas: &Atlas, charts: &Charts, topology: &Topology) -> (Vec<bool>, Vec<Option<f64>>) {
    let n = atlas.face_count();
    let corner = |h: HalfEdge| atlas.corners[h.face().index()][h.corner()];
    let mut reversed = vec![false; n];
    let mut seen = vec![false; n];
    let mut areas = vec![Some(0.0); charts.len()];
    for (c, faces) in charts.faces.iter().enumerate() {
        // Parts that only hang together by non-manifold edges are wound one by one.
        for (i, seed) in faces.iter().enumerate() {
            if std::mem::replace(&mut seen[seed.index()], true) {
                continue;
            }
            let mut part = vec![*seed];
            let mut next = 0;
            while next < part.len() {
                let f = part[next];
                for h in (0..3).map(|k| HalfEdge::of(f, k)) {
                    let Some(twin) = topology.uv_twin(h) else { continue };
                    let other = twin.face();
                    if !std::mem::replace(&mut seen[other.index()], true) {
                        reversed[other.index()] = reversed[f.index()] ^ (corner(h) == corner(twin));
                        part.push(other);
                    }
                }
                next += 1;
            }
            let area: f64 = part.iter().map(|&f| if reversed[f.index()] { -1.0 } else { 1.0 } * atlas.uv_area(f)).sum();
            areas[c] = areas[c].filter(|_| i == 0).map(|sum| sum + area.abs());
            if area < 0.0 {
                part.iter().for_each(|f| reversed[f.index()] ^= true);
            }
        }
    }
    (reversed, areas)
}

/// Finds the charts to be mirrored, from the largest to the smallest, and reverses their faces.
fn mirror(
    atlas: &Atlas,
    charts: &Charts,
    topology: &Topology,
    areas: &[Option<f64>],
    (reversed, mirrored): (&mut [bool], &mut [bool]),
) {
    let vertex = |h: HalfEdge| atlas.surface.triangles[h.face().index()][h.corner()];
    let is_decided = |decided: &[bool], f: FaceId| decided[charts.of_face[f.index()].index()];
    let mut order: Vec<(f64, usize)> = areas.iter().enumerate().filter_map(|(c, area)| Some(((*area)?, c))).collect();
    order.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    let mut decided = vec![false; charts.len()];
    for (_, c) in order {
        // Length of seams to larger charts along which windings agree, less that along which they do not.
        let mut agree = 0.0;
        for f in &charts.faces[c] {
            for h in (0..3).map(|k| HalfEdge::of(*f, k)) {
                let Some(twin) = topology.across_seam(h).filter(|t| is_decided(&decided, t.face())) else { continue };
                let opposite = vertex(h) != vertex(twin);
                let wound = reversed[f.index()] == reversed[twin.face().index()];
                agree += if opposite == wound { length(atlas, h) } else { -length(atlas, h) };
            }
        }
        decided[c] = true;
        if agree < 0.0 {
            mirrored[c] = true;
            charts.faces[c].iter().for_each(|f| reversed[f.index()] ^= true);
        }
    }
}
