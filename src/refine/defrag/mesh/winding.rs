//! One winding for all that is merged.

use super::build::after;
use crate::atlas::{Atlas, Charts, FaceId, NONE, Topology};

/// How faces are wound so that neighbours agree.
pub(super) struct Winding {
    /// The atlas, wound so.
    pub atlas: Atlas,
    /// By face: its winding was reversed.
    pub reversed: Vec<bool>,
    /// By chart: mirrored (x to -x), because its neighbours on the surface are.
    pub mirrored: Vec<bool>,
}

/// What is wound alike.
struct Oriented {
    reversed: Vec<bool>,
    /// By chart: whether its faces hang together by edges of two faces.
    connected: Vec<bool>,
    /// By chart: its area, each part positive.
    areas: Vec<f64>,
}

/// Faces reversed so that neighbours in a chart agree and the chart's area is positive. Where charts then still disagree with larger
/// neighbours along their seams, one of them is the mirror image of what the surface shows: it is mirrored too, if `may_mirror`.
pub(super) fn consistent_winding(atlas: &Atlas, charts: &Charts, may_mirror: bool) -> Winding {
    let topology = Topology::new(atlas);
    let mut oriented = orient(atlas, charts, &topology);
    let mirrored = if may_mirror { mirror(atlas, charts, &topology, &mut oriented) } else { vec![false; charts.len()] };
    let reversed = oriented.reversed;
    let mut own = atlas.clone();
    for (f, _) in reversed.iter().enumerate().filter(|(_, reversed)| **reversed) {
        own.corners[f].swap(1, 2);
        own.surface.triangles[f].swap(1, 2);
    }
    Winding { atlas: own, reversed, mirrored }
}

/// Neighbours in a chart agree, and areas are positive.
fn orient(atlas: &Atlas, charts: &Charts, topology: &Topology) -> Oriented {
    let n = atlas.face_count();
    let corner = |h: u32| atlas.corners[h as usize / 3][h as usize % 3];
    let mut reversed = vec![false; n];
    let mut seen = vec![false; n];
    let mut connected = vec![true; charts.len()];
    let mut areas = vec![0.0; charts.len()];
    for (c, faces) in charts.faces.iter().enumerate() {
        // Parts that only hang together by non-manifold edges are wound one by one.
        for (i, seed) in faces.iter().enumerate() {
            if std::mem::replace(&mut seen[seed.index()], true) {
                continue;
            }
            connected[c] &= i == 0;
            let mut part = vec![seed.0];
            let mut next = 0;
            while next < part.len() {
                let f = part[next];
                for h in 3 * f..3 * f + 3 {
                    let t = topology.uv_twin[h as usize];
                    if t == NONE || std::mem::replace(&mut seen[t as usize / 3], true) {
                        continue;
                    }
                    let alike = corner(h) == corner(t);
                    reversed[t as usize / 3] = reversed[f as usize] ^ alike;
                    part.push(t / 3);
                }
                next += 1;
            }
            let area: f64 =
                part.iter().map(|&f| if reversed[f as usize] { -1.0 } else { 1.0 } * atlas.uv_area(FaceId(f))).sum();
            areas[c] += area.abs();
            if area < 0.0 {
                part.iter().for_each(|&f| reversed[f as usize] ^= true);
            }
        }
    }
    Oriented { reversed, connected, areas }
}

/// Charts to be mirrored, from the largest to the smallest; their faces are reversed.
fn mirror(atlas: &Atlas, charts: &Charts, topology: &Topology, oriented: &mut Oriented) -> Vec<bool> {
    let Oriented { reversed, connected, areas } = oriented;
    let vertex = |h: u32| atlas.surface.triangles[h as usize / 3][h as usize % 3];
    let mut order: Vec<usize> = (0..charts.len()).filter(|&c| connected[c]).collect();
    order.sort_by(|&a, &b| areas[b].total_cmp(&areas[a]).then(a.cmp(&b)));
    let mut mirrored = vec![false; charts.len()];
    let mut decided = vec![false; charts.len()];
    for c in order {
        // Length of seams to larger charts along which windings agree, less that along which they do not.
        let mut agree = 0.0;
        for f in &charts.faces[c] {
            for h in 3 * f.0..3 * f.0 + 3 {
                let t = topology.surface_twin[h as usize];
                if !topology.is_seam(h) || !decided[charts.of_face[t as usize / 3].index()] {
                    continue;
                }
                let opposite = vertex(h) != vertex(t);
                let wound = reversed[h as usize / 3] == reversed[t as usize / 3];
                let [p, q] = [vertex(h), vertex(after(h))].map(|v| atlas.surface.positions[v.index()]);
                agree += if opposite == wound { p.distance(q) } else { -p.distance(q) };
            }
        }
        decided[c] = true;
        if agree < 0.0 {
            mirrored[c] = true;
            charts.faces[c].iter().for_each(|f| reversed[f.index()] ^= true);
        }
    }
    mirrored
}
