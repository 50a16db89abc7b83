//! Fewer faces for the eye: interior vertices of charts are collapsed into a neighbour until as many faces are left as a preview holds.
//!
//! Borders of charts stay as they are, and no face is turned over in the layout or by much on the surface, so that charts, seams and
//! textures look as they do; every face that stays keeps its chart and its figures. Where charts are so small that nothing can be collapsed, the
//! smallest faces go.

use glam::{DVec2, DVec3};

use crate::atlas::{Atlas, FaceId, HalfEdge, Topology, UvId, VertexId, orientation};

/// Passes over all vertices, at most: each takes about a fifth of them.
const PASSES: usize = 24;
/// Cosine of the angle by which the normal of a face may turn.
const LEAST_COSINE: f64 = 0.7;

/// A face that is shown: the one that it was, its corners as they are now, and which of its edges are borders and seams.
#[derive(Debug, Clone, Copy)]
pub(super) struct ShownFace {
    pub face: FaceId,
    pub vertices: [VertexId; 3],
    pub uvs: [UvId; 3],
    /// Bits 0 to 2: edges on the border of the chart; 3 to 5: those of them that are seams.
    pub edges: u8,
}

/// At most `most` faces of an Atlas.
pub(super) fn simplified(atlas: &Atlas, topology: &Topology, most: usize) -> Vec<ShownFace> {
    let edges = |f: FaceId| {
        let bit = |k: usize| {
            let h = HalfEdge::of(f, k);
            u8::from(atlas.has_layout() && topology.is_border(h)) << k | u8::from(topology.is_seam(h)) << (3 + k)
        };
        bit(0) | bit(1) | bit(2)
    };
    let shown = |f: FaceId| ShownFace {
        face: f,
        vertices: atlas.surface.triangles[f.index()],
        uvs: atlas.corners[f.index()],
        edges: edges(f),
    };
    let mut faces: Vec<ShownFace> = atlas.faces().map(shown).collect();
    if atlas.has_layout() {
        for _ in 0..PASSES {
            let before = faces.len();
            if before <= most || !pass(atlas, &mut faces, before - most) || faces.len() * 100 > before * 99 {
                break;
            }
        }
    }
    if faces.len() > most {
        let area = |f: &ShownFace| {
            let [a, b, c] = f.vertices.map(|v| atlas.surface.positions[v.index()]);
            (b - a).cross(c - a).length_squared()
        };
        faces.sort_by(|a, b| area(b).total_cmp(&area(a)).then(a.face.cmp(&b.face)));
        faces.truncate(most);
    }
    faces.sort_by_key(|f| (atlas.provenance[f.face.index()].primitive, f.face));
    faces
}

/// Collapses vertices whose rings have not been touched, until `excess` faces are gone. Whether any was.
fn pass(atlas: &Atlas, faces: &mut Vec<ShownFace>, excess: usize) -> bool {
    let count = atlas.uv.len();
    // Faces by UV vertex.
    let mut first = vec![0u32; count + 1];
    faces.iter().flat_map(|f| f.uvs).for_each(|c| first[c.index() + 1] += 1);
    (0..count).for_each(|c| first[c + 1] += first[c]);
    let (mut next, mut around) = (first.clone(), vec![0u32; 3 * faces.len()]);
    let mut fixed = vec![false; count];
    for (f, face) in faces.iter().enumerate() {
        for k in 0..3 {
            let c = face.uvs[k].index();
            around[next[c] as usize] = f as u32;
            next[c] += 1;
            if face.edges & (1 << k) != 0 {
                fixed[c] = true;
                fixed[face.uvs[(k + 1) % 3].index()] = true;
            }
        }
    }
    let (mut touched, mut gone, mut removed) = (vec![false; count], vec![false; faces.len()], 0);
    for v in 0..count {
        let ring = &around[first[v] as usize..first[v + 1] as usize];
        if removed >= excess {
            break;
        }
        // A fan that is not closed, or met twice by one face, has another shape than is assumed here.
        if fixed[v] || touched[v] || !(3..=12).contains(&ring.len()) {
            continue;
        }
        let Some(target) = neighbour(atlas, faces, ring, v, &touched) else { continue };
        for &f in ring {
            faces[f as usize].uvs.iter().for_each(|c| touched[c.index()] = true);
        }
        collapse(faces, ring, v, target, &mut gone);
        removed += 2;
    }
    if removed == 0 {
        return false;
    }
    let mut f = 0;
    faces.retain(|_| {
        f += 1;
        !gone[f - 1]
    });
    true
}

fn corner(face: &ShownFace, uv: usize) -> Option<usize> {
    face.uvs.iter().position(|c| c.index() == uv)
}

/// The neighbour, as UV vertex and vertex, that a vertex may be moved into: the nearest for which nothing is turned over.
fn neighbour(atlas: &Atlas, faces: &[ShownFace], ring: &[u32], v: usize, touched: &[bool]) -> Option<(UvId, VertexId)> {
    let position = |v: VertexId| atlas.surface.positions[v.index()];
    let mut candidates: Vec<(f64, UvId, VertexId)> = Vec::with_capacity(ring.len());
    for &f in ring {
        let face = &faces[f as usize];
        let k = corner(face, v)?;
        let (own, to) = (face.vertices[k], (k + 1) % 3);
        candidates.push((position(own).distance_squared(position(face.vertices[to])), face.uvs[to], face.vertices[to]));
    }
    if candidates.iter().any(|c| touched[c.1.index()]) {
        return None;
    }
    candidates.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let fits = |target: &(f64, UvId, VertexId)| {
        let mut shared = 0;
        let whole = ring.iter().all(|&f| {
            let face = &faces[f as usize];
            if face.uvs.contains(&target.1) {
                shared += 1;
                return true;
            }
            let Some(k) = corner(face, v) else { return false };
            let (mut uvs, mut vertices) = (face.uvs, face.vertices);
            (uvs[k], vertices[k]) = (target.1, target.2);
            let turn = |uvs: [UvId; 3]| {
                let [a, b, c]: [DVec2; 3] = uvs.map(|c| atlas.uv[c.index()]);
                orientation(a, b, c)
            };
            let normal = |vertices: [VertexId; 3]| {
                let [a, b, c]: [DVec3; 3] = vertices.map(position);
                (b - a).cross(c - a)
            };
            let (before, after) = (normal(face.vertices), normal(vertices));
            turn(face.uvs) == turn(uvs) && before.dot(after) > LEAST_COSINE * before.length() * after.length()
        });
        whole && shared == 2
    };
    candidates.into_iter().find(fits).map(|(_, uv, vertex)| (uv, vertex))
}

/// Moves a vertex into its neighbour: the two faces between them go, and their borders pass to the faces behind.
fn collapse(faces: &mut [ShownFace], ring: &[u32], v: usize, target: (UvId, VertexId), gone: &mut [bool]) {
    // Borders of the edges that become those to the target, by the third corner of a face that goes.
    let mut borders: Vec<(UvId, u8)> = Vec::with_capacity(2);
    for &f in ring {
        let face = &faces[f as usize];
        if let (true, Some(k)) = (face.uvs.contains(&target.0), corner(face, v)) {
            gone[f as usize] = true;
            let (a, b) = (face.uvs[(k + 1) % 3], face.uvs[(k + 2) % 3]);
            let opposite = (k + 1) % 3;
            borders.push((if a == target.0 { b } else { a }, (face.edges >> opposite) & 9));
        }
    }
    for &f in ring.iter().filter(|f| !gone[**f as usize]) {
        let face = &mut faces[f as usize];
        let Some(k) = corner(face, v) else { continue };
        (face.uvs[k], face.vertices[k]) = target;
        for (other, bits) in &borders {
            if face.uvs[(k + 1) % 3] == *other {
                face.edges |= bits << k;
            }
            if face.uvs[(k + 2) % 3] == *other {
                face.edges |= bits << ((k + 2) % 3);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec2;

    use super::*;
    use crate::atlas::testing::{join, sheet};

    fn uv_area(atlas: &Atlas, faces: &[ShownFace]) -> f64 {
        let area = |f: &ShownFace| {
            let [a, b, c] = f.uvs.map(|c| atlas.uv[c.index()]);
            0.5 * (b - a).perp_dot(c - a)
        };
        faces.iter().map(area).sum()
    }

    fn borders(atlas: &Atlas, faces: &[ShownFace]) -> f64 {
        let edges = faces.iter().flat_map(|f| (0..3).filter(|k| f.edges & (1 << k) != 0).map(move |k| (f, k)));
        edges.map(|(f, k)| atlas.uv[f.uvs[k].index()].distance(atlas.uv[f.uvs[(k + 1) % 3].index()])).sum()
    }

    #[test]
    fn charts_keep_their_shape_and_lose_what_is_inside() {
        let atlas = join(&sheet(40, 30, DVec2::ZERO), &sheet(20, 25, DVec2::new(50.0, 3.0)));
        let topology = Topology::new(&atlas);
        let all = simplified(&atlas, &topology, usize::MAX);
        assert_eq!(all.len(), atlas.face_count());
        let few = simplified(&atlas, &topology, 700);
        assert!(few.len() <= 700 && few.len() > 350, "{}", few.len());
        assert!((uv_area(&atlas, &all) - uv_area(&atlas, &few)).abs() < 1e-9, "nothing opens, nothing folds");
        assert!((borders(&atlas, &all) - borders(&atlas, &few)).abs() < 1e-9, "no border is lost");
        // Less than the borders need: the smallest go.
        assert_eq!(simplified(&atlas, &topology, 50).len(), 50);
    }
}
