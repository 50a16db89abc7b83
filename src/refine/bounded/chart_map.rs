//! One chart as the construction works on it: a disk whose triangles all have a positive area, and its boundary.

use std::collections::BTreeMap;

use glam::DVec2;

use crate::atlas::groups::sorted_unique;
use crate::atlas::{FaceId, HalfEdge, Mesh, UvId};
use crate::numeric::dirichlet::RestTriangle;
use crate::numeric::newton::Element;

/// What all faces of a chart weigh together, so that an isometry has the energy 1 (eq. 9).
pub(super) const WEIGHT: f64 = 0.25;
/// Least weight of a face, in parts of the mean: faces without area count a little, so that they keep some shape.
const LEAST_WEIGHT: f64 = 1e-4;
/// Least length of a boundary edge at rest, in parts of the mean.
const LEAST_LENGTH: f64 = 1e-2;

/// A chart, its vertices numbered by themselves.
#[derive(Debug, Clone)]
pub(super) struct ChartMap {
    /// Its faces in the mesh.
    pub faces: Vec<FaceId>,
    /// UV vertices in the mesh, by vertex.
    pub uvs: Vec<UvId>,
    /// By face: its vertices, in an order in which its area is positive.
    pub triangles: Vec<[u32; 3]>,
    /// Where each vertex lies.
    pub x: Vec<DVec2>,
    /// By face: its shape on the surface, at the chart's own density.
    pub rest: Vec<RestTriangle>,
    /// The boundary, counter-clockwise; edge i leads from vertex i to the next.
    pub boundary: Vec<u32>,
    /// Area of all faces at rest, in square texels.
    pub rest_area: f64,
    /// Lengths of the boundary edges at rest, all above zero.
    pub rest_lengths: Vec<f64>,
    /// By how much it has been turned.
    pub turned: f64,
    /// Where each vertex is on the surface, seen from one side: vertices that are near each other are near each other here too.
    pub guide: Vec<DVec2>,
}

impl ChartMap {
    /// Of faces of a mesh that are a disk; `boundary` is its loop. Faces whose order is turned over where `reversed` says so.
    ///
    /// `shape` gives the corners of a face at rest, with a positive area, in texels; none where it has none.
    pub fn new(
        mesh: &Mesh,
        faces: &[FaceId],
        boundary: &[HalfEdge],
        reversed: bool,
        shape: &dyn Fn(FaceId) -> Option<[DVec2; 3]>,
    ) -> Option<ChartMap> {
        let uvs = sorted_unique(faces.iter().flat_map(|f| mesh.atlas().corners[f.index()]));
        let local = |u: UvId| uvs.partition_point(|x| *x < u) as u32;
        let order = |t: [u32; 3]| if reversed { [t[0], t[2], t[1]] } else { t };
        let triangles: Vec<[u32; 3]> =
            faces.iter().map(|f| order(mesh.atlas().corners[f.index()].map(local))).collect();
        let n = boundary.len();
        let scale = shape_scale(mesh, faces, shape);
        let lengths: Vec<f64> = boundary
            .iter()
            .map(|h| {
                let [a, b] = mesh.surface_ends(*h).map(|v| mesh.atlas().surface.positions[v.index()]);
                scale * a.distance(b)
            })
            .collect();
        // Edges without a length get a little, so that their ends can be told apart wherever lengths are laid out.
        let least = LEAST_LENGTH * lengths.iter().sum::<f64>() / n.max(1) as f64;
        let lengths: Vec<f64> = lengths.into_iter().map(|l| l.max(least)).collect();
        let mut boundary: Vec<u32> = boundary.iter().map(|h| local(mesh.uv_at(*h))).collect();
        if reversed {
            boundary.reverse();
        }
        let shapes: Vec<Option<[DVec2; 3]>> = faces.iter().map(|f| shape(*f)).collect();
        let total: f64 = shapes.iter().flatten().map(|t| area(*t)).sum();
        let mean = total / faces.len().max(1) as f64;
        if !(total > 0.0 && total.is_finite()) {
            return None;
        }
        let rest = shapes.iter().map(|shape| rest_triangle(*shape, reversed, mean, total));
        let rest = rest.collect::<Option<Vec<_>>>()?;
        let x = uvs.iter().map(|u| mesh.position(*u)).collect();
        let positions = &mesh.atlas().surface.positions;
        let seen = |u: &UvId| {
            let p = mesh.corners_of(*u).next().map_or(glam::DVec3::ZERO, |c| positions[mesh.vertex_at(c).index()]);
            DVec2::new(p.x + 0.31 * p.z, p.y + 0.53 * p.z)
        };
        let guide = uvs.iter().map(seen).collect();
        // Edge i of a reversed boundary leads from vertex i to the one before it in the loop.
        let rest_lengths = match reversed {
            false => lengths,
            true => (0..n).map(|i| lengths[(2 * n - 2 - i) % n]).collect(),
        };
        Some(ChartMap {
            faces: faces.to_vec(),
            uvs,
            triangles,
            x,
            rest,
            boundary,
            rest_area: total,
            rest_lengths,
            turned: 0.0,
            guide,
        })
    }

    /// The corners of a face.
    pub fn triangle(&self, face: usize) -> [DVec2; 3] {
        self.triangles[face].map(|v| self.x[v as usize])
    }

    /// Whether all faces have a positive area.
    pub fn is_valid(&self) -> bool {
        (0..self.triangles.len()).all(|f| {
            let [a, b, c] = self.triangle(f);
            a.is_finite() && b.is_finite() && c.is_finite() && crate::atlas::orientation(a, b, c) > 0
        })
    }

    /// E_d (eq. 9): 1 is isometric.
    pub fn distortion(&self) -> f64 {
        (0..self.triangles.len()).map(|f| self.rest[f].energy(self.triangle(f))).sum()
    }

    /// The faces as what costs energy.
    pub fn elements(&self) -> Vec<Element> {
        let pairs = self.triangles.iter().zip(&self.rest);
        pairs.map(|(corners, rest)| Element::Triangle { corners: *corners, rest: *rest }).collect()
    }

    /// Area of the chart.
    pub fn area(&self) -> f64 {
        (0..self.triangles.len()).map(|f| area(self.triangle(f))).sum()
    }

    /// Boundary edge `i`, as a vector.
    pub fn edge(&self, i: usize) -> DVec2 {
        let next = self.boundary[(i + 1) % self.boundary.len()];
        self.x[next as usize] - self.x[self.boundary[i] as usize]
    }

    /// Lengths of the boundary edges.
    pub fn lengths(&self) -> Vec<f64> {
        (0..self.boundary.len()).map(|i| self.edge(i).length()).collect()
    }

    /// The polar angle of each boundary edge, carried on from one to the next by the interior angles (eq. 1), so that after a whole turn
    /// it is 2 pi more. The first is within half a turn of zero.
    pub fn polar_angles(&self) -> Vec<f64> {
        let mut interior = vec![0.0; self.x.len()];
        for t in &self.triangles {
            for k in 0..3 {
                let [p, q, r] = [k, (k + 1) % 3, (k + 2) % 3].map(|k| self.x[t[k] as usize]);
                interior[t[k] as usize] += (q - p).angle_to(r - p).abs();
            }
        }
        let first = self.edge(0);
        let mut angle = first.y.atan2(first.x);
        let mut angles = vec![angle];
        for i in 1..self.boundary.len() {
            angle += std::f64::consts::PI - interior[self.boundary[i] as usize];
            angles.push(angle);
        }
        angles
    }

    /// The place of each UV vertex of the boundary on it.
    pub fn places(&self) -> BTreeMap<UvId, usize> {
        self.boundary.iter().enumerate().map(|(i, v)| (self.uvs[*v as usize], i)).collect()
    }

    /// How many faces meet at each vertex of the boundary.
    pub fn faces_on_boundary(&self) -> Vec<u32> {
        let mut count = vec![0; self.x.len()];
        self.triangles.iter().flatten().for_each(|v| count[*v as usize] += 1);
        self.boundary.iter().map(|v| count[*v as usize]).collect()
    }
}

/// What maps of a face need: of its shape at rest, or a small equilateral one where it has none. `mean` is the area of a face, `total` that of all, which weigh
/// [`WEIGHT`] together. A reversed face has its corners in the other order.
pub(super) fn rest_triangle(shape: Option<[DVec2; 3]>, reversed: bool, mean: f64, total: f64) -> Option<RestTriangle> {
    let side = mean.sqrt() * 1e-2;
    let none = || [DVec2::ZERO, DVec2::new(side, 0.0), DVec2::new(0.5 * side, 0.75f64.sqrt() * side)];
    let shape = shape.unwrap_or_else(none);
    let weight = WEIGHT * area(shape).max(LEAST_WEIGHT * mean) / total;
    let [a, b, c] = shape;
    let mirrored = |p: DVec2| DVec2::new(p.x, -p.y);
    let shape = if reversed { [mirrored(a), mirrored(c), mirrored(b)] } else { shape };
    RestTriangle::new(shape, weight)
}

/// Texels by unit of the surface, of the faces at rest.
fn shape_scale(mesh: &Mesh, faces: &[FaceId], shape: &dyn Fn(FaceId) -> Option<[DVec2; 3]>) -> f64 {
    let (texels, area) = faces.iter().fold((0.0, 0.0), |(t, a), f| {
        let own = shape(*f).map_or(0.0, area);
        (t + own, a + mesh.atlas().area(*f))
    });
    let scale: f64 = (texels / area).sqrt();
    if scale.is_finite() && scale > 0.0 { scale } else { 1.0 }
}

/// Area of a triangle, positive counter-clockwise.
pub(super) fn area([a, b, c]: [DVec2; 3]) -> f64 {
    0.5 * (b - a).perp_dot(c - a)
}
