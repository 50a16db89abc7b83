//! Symmetric Dirichlet energy, of the surface's map to UV and of the input UVs' map to these.

use glam::{DVec2, DVec3};

use super::charts::is_degenerate;
use crate::atlas::{Atlas, FaceId, orientation};

/// Sums of the symmetric Dirichlet energy over triangles of area A with singular values s1, s2.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Strain {
    /// Sum of A (s1^2 + s2^2).
    stretch: f64,
    /// Sum of A (s1^-2 + s2^-2).
    shrink: f64,
    /// Sum of A.
    area: f64,
}

impl Strain {
    pub(crate) fn add(&mut self, other: &Strain) {
        self.stretch += other.stretch;
        self.shrink += other.shrink;
        self.area += other.area;
    }

    /// Adds a triangle with edge products `ee`, `ef`, `ff` of its two edges e and f, which are mapped to `u` and `v`.
    fn triangle(&mut self, ee: f64, ef: f64, ff: f64, u: DVec2, v: DVec2) {
        let gram = ee * ff - ef * ef;
        let determinant = u.perp_dot(v);
        let norm = (ff * u.length_squared() - 2.0 * ef * u.dot(v) + ee * v.length_squared()) / gram;
        let inverse = norm * gram / (determinant * determinant);
        if norm.is_finite() && inverse.is_finite() && gram > 0.0 {
            let area = 0.5 * gram.sqrt();
            self.stretch += area * norm;
            self.shrink += area * inverse;
            self.area += area;
        }
    }

    /// Adds the map of a face from the surface to the UVs.
    fn face(&mut self, atlas: &Atlas, face: FaceId) {
        if is_degenerate(atlas, face) {
            return;
        }
        let [a, b, c] = atlas.uv_triangle(face);
        let [p, q, r] = atlas.triangle(face);
        let (e, g): (DVec3, DVec3) = (q - p, r - p);
        self.triangle(e.length_squared(), e.dot(g), g.length_squared(), b - a, c - a);
    }

    /// The square of the global scale at which the energy is least.
    fn best_scale(&self) -> f64 {
        (self.shrink / self.stretch).sqrt()
    }

    /// The mean energy at the best global scale. Scaling by t gives t^2 stretch + t^-2 shrink, least at
    /// t^4 = shrink / stretch, where both terms are sqrt(stretch * shrink). `None` without triangles.
    pub(crate) fn energy(&self) -> Option<f64> {
        let energy = 2.0 * (self.stretch.sqrt() * self.shrink.sqrt()) / self.area;
        (self.area > 0.0 && energy.is_finite()).then_some(energy)
    }
}

/// From the surface to the UVs.
pub(super) fn from_surface(atlas: &Atlas) -> Strain {
    let mut strain = Strain::default();
    atlas.faces().for_each(|f| strain.face(atlas, f));
    strain
}

/// Symmetric Dirichlet energy by face, at the scale that is best for the whole: the area-weighted mean is that of [`from_surface`]. None
/// for degenerate faces.
pub(crate) fn by_face(atlas: &Atlas) -> Vec<Option<f64>> {
    let scale = from_surface(atlas).best_scale();
    let energy = |f: FaceId| {
        let mut own = Strain::default();
        own.face(atlas, f);
        let energy = (own.stretch * scale + own.shrink / scale) / own.area;
        (own.area > 0.0 && energy.is_finite()).then_some(energy)
    };
    atlas.faces().map(energy).collect()
}

/// From the UVs of `input` (the atlas as uploaded, whose faces provenance names) to those of `atlas`.
pub(super) fn from_input(atlas: &Atlas, input: &Atlas) -> Strain {
    let mut strain = Strain::default();
    for (f, provenance) in atlas.faces().zip(&atlas.provenance) {
        if provenance.source.index() >= input.face_count() || is_degenerate(atlas, f) {
            continue;
        }
        let source = input.uv_triangle(provenance.source);
        let at = |b: DVec3| source[0] * b.x + source[1] * b.y + source[2] * b.z;
        let [p, q, r] = if std::ptr::eq(atlas, input) { source } else { provenance.barycentric.map(at) };
        if orientation(p, q, r) == 0 {
            continue;
        }
        let [a, b, c] = atlas.uv_triangle(f);
        let (e, g) = (q - p, r - p);
        strain.triangle(e.length_squared(), e.dot(g), g.length_squared(), b - a, c - a);
    }
    strain
}
