//! The shapes of the triangles near a seam: optimised, turned back, and judged (sections 4.2.2 and 4.2.3).

use glam::DVec2;

use super::{Reason, Trial};
use crate::numeric::arap::{Arap, Patch};
use crate::numeric::energy::{jacobian, singular_values};
use crate::numeric::untangle::untangle;
use crate::refine::defrag::mesh::sign;
use crate::refine::defrag::params::Search;

/// Rounds of rotations and positions.
const ROUNDS: usize = 20;
/// Those after which it shows whether the rest is of use, and triangles turned over then of which no one gets rid.
const FIRST: usize = 5;
const HOPELESS: usize = 30;
/// A round is the last when nothing moves by more, relative to the largest displacement.
const SETTLED: f64 = 0.02;
/// Times that triangles which are turned over are made stiffer.
const HARDER: usize = 3;
/// By how much.
const STIFFER: f64 = 4.0;
/// Triangles that may be turned over for that to be tried, and one in twenty of the rest.
const MOST_FOLDS: usize = 12;
/// Singular values of a face that is as good as lost.
const LOST: f64 = 0.02;
/// How much more a chart may be deformed that is too small to matter.
const ISLAND: f64 = 20.0;

impl Trial<'_> {
    /// Local ARAP against the input's triangles (section 4.2.2).
    pub(super) fn optimise(&mut self, displaced: f64) -> Result<(), Reason> {
        let mesh = self.mesh;
        if !self.nodes.iter().any(|n| n.free) {
            return Ok(());
        }
        // Vertices of the band: nodes, and others, which stay.
        let mut positions: Vec<DVec2> = self.nodes.iter().map(|n| n.at).collect();
        let mut free: Vec<bool> = self.nodes.iter().map(|n| n.free).collect();
        let mut others: Vec<u32> = Vec::new();
        for &f in &self.band {
            others.extend(mesh.corners[f as usize].iter().filter(|u| self.scratch.node(**u).is_none()));
        }
        others.sort_unstable();
        others.dedup();
        let nodes = self.nodes.len() as u32;
        for &u in &others {
            positions.push(self.aligned(u));
            free.push(false);
        }
        let local = |u: u32| self.scratch.node(u).unwrap_or_else(|| nodes + others.partition_point(|v| *v < u) as u32);
        let triangles: Vec<[u32; 3]> = self.band.iter().map(|&f| mesh.corners[f as usize].map(local)).collect();
        let rest: Vec<[DVec2; 3]> = self.band.iter().map(|&f| mesh.shape(f)).collect();
        // Seam vertices that stay in no triangle of the band would have no equation.
        let mut used = vec![false; free.len()];
        triangles.iter().flatten().for_each(|v| used[*v as usize] = true);
        free.iter_mut().zip(&used).for_each(|(free, used)| *free &= used);
        let usual = vec![1.0; rest.len()];
        let patch = Patch { triangles: &triangles, rest: &rest, stiffness: &usual, free: &free };
        let system = Arap::new(&patch).ok_or(Reason::Singular)?;
        let partial = self.params.search == Search::Partial;
        let mut rounds = ROUNDS;
        if partial {
            system.relax(&mut positions, FIRST, SETTLED * displaced);
            self.work += (FIRST / 4 * self.band.len()) as u64;
            if triangles.iter().zip(&rest).filter(|(t, r)| is_folded(t, r, &positions)).count() > HOPELESS {
                return Err(Reason::Fold);
            }
            rounds -= FIRST;
            self.go_on()?;
        }
        system.relax(&mut positions, rounds, SETTLED * displaced);
        self.work += (rounds / 4 * self.band.len()) as u64;
        if partial {
            self.unfold(&triangles, &rest, &free, &mut positions)?;
        }
        if positions.iter().any(|p| !p.is_finite()) {
            return Err(Reason::Singular);
        }
        self.nodes.iter_mut().zip(positions).for_each(|(n, p)| n.at = p);
        Ok(())
    }

    /// Where triangles are turned over, they are made stiffer and what is about them is optimised again: it gives way.
    fn unfold(
        &mut self,
        triangles: &[[u32; 3]],
        rest: &[[DVec2; 3]],
        free: &[bool],
        positions: &mut [DVec2],
    ) -> Result<(), Reason> {
        let areas: Vec<f64> = rest.iter().map(|r| 0.5 * (r[1] - r[0]).perp_dot(r[2] - r[0])).collect();
        let mut stiffness = vec![1.0; rest.len()];
        for harder in 0..HARDER {
            let mut near = vec![false; free.len()];
            let mut folded = 0;
            for ((t, r), s) in triangles.iter().zip(rest).zip(&mut stiffness) {
                if is_folded(t, r, positions) {
                    *s *= STIFFER;
                    folded += 1;
                    t.iter().for_each(|v| near[*v as usize] = true);
                }
            }
            if folded == 0 {
                break;
            }
            if folded > MOST_FOLDS + triangles.len() / 20 {
                return Err(Reason::Fold);
            }
            let before = positions.to_vec();
            self.work += triangles.len() as u64;
            if untangle(triangles, &areas, free, 3.0 * LOST, positions) {
                break;
            }
            if folded > MOST_FOLDS {
                return Err(Reason::Fold);
            }
            positions.copy_from_slice(&before);
            for _ in 0..2 + harder / 2 {
                let ring: Vec<u32> =
                    triangles.iter().filter(|t| t.iter().any(|v| near[*v as usize])).flatten().copied().collect();
                ring.into_iter().for_each(|v| near[v as usize] = true);
            }
            self.go_on()?;
            let own: Vec<usize> =
                (0..triangles.len()).filter(|&i| triangles[i].iter().any(|v| near[*v as usize])).collect();
            let (own_triangles, own_rest): (Vec<_>, Vec<_>) = own.iter().map(|&i| (triangles[i], rest[i])).unzip();
            let own_stiffness: Vec<f64> = own.iter().map(|&i| stiffness[i]).collect();
            let own_free: Vec<bool> = free.iter().zip(&near).map(|(free, near)| *free && *near).collect();
            let patch =
                Patch { triangles: &own_triangles, rest: &own_rest, stiffness: &own_stiffness, free: &own_free };
            let system = Arap::new(&patch).ok_or(Reason::Singular)?;
            system.relax(positions, ROUNDS, 0.0);
            self.work += (ROUNDS / 4 * own.len()) as u64;
        }
        Ok(())
    }

    /// No face may turn over or shrink to nothing, except where it had in the input (section 4.2.3).
    pub(super) fn folds(&self) -> Result<(), Reason> {
        for &f in &self.band {
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
            let wrong = now_sign != sign(rest) && (now_sign != 1 || self.mesh.odd[f as usize]);
            let lost = jacobian(rest, &now).is_none_or(|j| singular_values(&j)[1].abs() < LOST);
            if wrong || lost {
                return Err(Reason::Fold);
            }
        }
        Ok(())
    }

    pub(super) fn local_energy(&self) -> Result<(), Reason> {
        let (mut energy, mut weight) = (0.0, 0.0);
        for &f in &self.band {
            energy += self.mesh.energy_at(f, &self.placed_triangle(f));
            weight += self.mesh.weight[f as usize];
        }
        let limit = self.params.local_energy() * if self.op.is_island(self.mesh, self.params) { ISLAND } else { 1.0 };
        if energy <= limit * weight + 1e-12 { Ok(()) } else { Err(Reason::Local) }
    }
}

/// Whether a triangle that lies the right way round in the input is turned over, or all but flat.
fn is_folded(triangle: &[u32; 3], rest: &[DVec2; 3], positions: &[DVec2]) -> bool {
    let now = triangle.map(|v| positions[v as usize]);
    sign(rest) > 0 && jacobian(rest, &now).is_some_and(|j| singular_values(&j)[1] < 2.0 * LOST)
}
