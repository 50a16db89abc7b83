//! Whether the shapes of deformed triangles are acceptable (sections 4.2.2 and 4.2.3).

use glam::DVec2;

use super::Reason;
use super::trial::MergeTrial;
use crate::numeric::energy::{jacobian, singular_values};
use crate::refine::defrag::mesh::sign;

/// Singular values of a face that is as good as lost.
pub(super) const LOST: f64 = 0.02;
/// How much more a chart may be deformed that is too small to matter.
const ISLAND: f64 = 20.0;

impl MergeTrial<'_> {
    /// No face may turn over or shrink to nothing, except where it had in the input (section 4.2.3).
    pub(super) fn check_folds(&self) -> Result<(), Reason> {
        for &f in &self.deformable {
            let rest = &self.mesh.rest[f as usize];
            let now = self.placed_triangle(f);
            if self.mesh.weight[f as usize] == 0.0 {
                // What had no area may stay so, or get one; not turned over.
                if sign(rest) == 0 && sign(&now) == -1 {
                    return Err(Reason::Fold);
                }
                continue;
            }
            let now_sign = sign(&now);
            let wrong = now_sign != sign(rest) && (now_sign != 1 || self.mesh.against_chart[f as usize]);
            let lost = jacobian(rest, &now).is_none_or(|j| singular_values(&j)[1].abs() < LOST);
            if wrong || lost {
                return Err(Reason::Fold);
            }
        }
        Ok(())
    }

    /// The mean energy over the deformable faces is limited (section 4.2.2).
    pub(super) fn check_local_energy(&self) -> Result<(), Reason> {
        let (mut energy, mut weight) = (0.0, 0.0);
        for &f in &self.deformable {
            energy += self.mesh.energy_at(f, &self.placed_triangle(f));
            weight += self.mesh.weight[f as usize];
        }
        let limit = self.params.local_energy() * if self.op.is_island(self.mesh, self.params) { ISLAND } else { 1.0 };
        if energy <= limit * weight + 1e-12 { Ok(()) } else { Err(Reason::Local) }
    }
}

/// Whether a triangle that lies the right way round in the input is turned over, or all but flat.
pub(super) fn is_inverted(triangle: &[u32; 3], rest: &[DVec2; 3], positions: &[DVec2]) -> bool {
    let now = triangle.map(|v| positions[v as usize]);
    sign(rest) > 0 && jacobian(rest, &now).is_some_and(|j| singular_values(&j)[1] < 2.0 * LOST)
}
