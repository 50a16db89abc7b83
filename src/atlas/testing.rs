//! Small Atlases for unit tests, made by code.

use glam::{DVec2, DVec3};

use super::{Atlas, FaceId, HalfEdge, Mesh, Provenance, Surface, UvId, VertexId};

/// A small random generator (splitmix64), so that tests need no crate and repeat.
pub(crate) struct Rng(pub u64);

impl Rng {
    pub(crate) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }
    /// In 0..1.
    pub(crate) fn unit(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }
    /// In the square (0..size)^2.
    pub(crate) fn point(&mut self, size: f64) -> DVec2 {
        DVec2::new(self.unit(), self.unit()) * size
    }
}

/// Separate triangles, each its own chart, on one sheet of 100 x 100; positions equal UVs.
pub(crate) fn soup(triangles: &[[DVec2; 3]]) -> Atlas {
    let uv: Vec<DVec2> = triangles.iter().flatten().copied().collect();
    let corners = (0..triangles.len()).map(|f| [0, 1, 2].map(|k| UvId::new(3 * f + k))).collect();
    atlas(uv, corners)
}

/// A rectangle of `nx` x `ny` unit squares with its corner at `origin`, each cut in two; one chart.
pub(crate) fn sheet(nx: usize, ny: usize, origin: DVec2) -> Atlas {
    let mut uv = Vec::new();
    for y in 0..=ny {
        for x in 0..=nx {
            uv.push(origin + DVec2::new(x as f64, y as f64));
        }
    }
    let mut corners = Vec::new();
    for y in 0..ny {
        for x in 0..nx {
            let at = |dx: usize, dy: usize| UvId::new((y + dy) * (nx + 1) + x + dx);
            corners.push([at(0, 0), at(1, 0), at(1, 1)]);
            corners.push([at(0, 0), at(1, 1), at(0, 1)]);
        }
    }
    atlas(uv, corners)
}

/// An Atlas in which every UV vertex has its own surface vertex, at the same place with z = 0.
pub(crate) fn atlas(uv: Vec<DVec2>, corners: Vec<[UvId; 3]>) -> Atlas {
    let positions = uv.iter().map(|p| DVec3::new(p.x, p.y, 0.0)).collect();
    let triangles = corners.iter().map(|c| c.map(|u| VertexId(u.0))).collect();
    Atlas {
        surface: Surface { positions, triangles },
        provenance: (0..corners.len()).map(|f| Provenance::whole(FaceId::new(f), 0)).collect(),
        page: vec![0; corners.len()],
        sheets: vec![[100, 100]],
        uv,
        corners,
    }
}

/// Both Atlases side by side in one; the second keeps its own vertices.
pub(crate) fn join(a: &Atlas, b: &Atlas) -> Atlas {
    let mut both = a.clone();
    both.append(b, DVec2::ZERO, a.face_count(), 0);
    both
}

/// The Atlas cut open along UV edges.
pub(crate) fn cut_open(atlas: &Atlas, edges: &[HalfEdge]) -> Atlas {
    let mut mesh = Mesh::new(atlas.clone());
    mesh.cut(edges);
    mesh.into_atlas()
}

/// The half edges of an Atlas for whose two UV points `holds` says so.
pub(crate) fn half_edges_where(atlas: &Atlas, holds: impl Fn(DVec2, DVec2) -> bool) -> Vec<HalfEdge> {
    let ends = |h: HalfEdge| [h.corner(), h.end_corner()].map(|k| atlas.uv_triangle(h.face())[k]);
    let all = (0..3 * atlas.face_count()).map(HalfEdge::new);
    all.filter(|h| holds(ends(*h)[0], ends(*h)[1])).collect()
}

/// Number of surface edges with more than two faces.
pub(crate) fn non_manifold_edges(atlas: &Atlas) -> usize {
    let edge = |t: &[VertexId; 3], k: usize| (t[k].min(t[(k + 1) % 3]), t[k].max(t[(k + 1) % 3]));
    let mut edges: Vec<_> = atlas.surface.triangles.iter().flat_map(|t| [0, 1, 2].map(|k| edge(t, k))).collect();
    edges.sort_unstable();
    edges.chunk_by(|a, b| a == b).filter(|same| same.len() > 2).count()
}
