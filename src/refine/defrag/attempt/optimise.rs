//! Local ARAP against the input's triangles (section 4.2.2). Where triangles turn over, inversions are repaired.

use glam::DVec2;

use super::Reason;
use super::checks::{LOST, is_inverted};
use super::trial::{MergeTrial, Stop};
use crate::atlas::groups::sorted_unique;
use crate::numeric::arap::{Arap, Patch};
use crate::numeric::repair::repair_inversions;
use crate::refine::defrag::params::Search;

/// Rounds of rotations and positions.
const ROUNDS: usize = 20;
/// Those after which it shows whether the rest is of use, and inverted triangles then of which no one gets rid.
const FIRST: usize = 5;
const HOPELESS: usize = 30;
/// A round is the last when nothing moves by more, relative to the largest displacement.
const SETTLED: f64 = 0.02;
/// Times that inverted triangles are made stiffer, and how much each time.
const REPAIRS: usize = 3;
const STIFFER: f64 = 4.0;
/// Inverted triangles that may be repaired, and one in so many of the rest.
const MOST_INVERTED: usize = 12;
const MOST_INVERTED_PART: usize = 20;

/// What is optimised: triangles over the nodes of a trial, then over the other vertices of its faces, which stay.
struct LocalProblem {
    triangles: Vec<[u32; 3]>,
    rest: Vec<[DVec2; 3]>,
    free: Vec<bool>,
}

impl LocalProblem {
    fn inverted<'a>(&'a self, positions: &'a [DVec2]) -> impl Iterator<Item = usize> + 'a {
        (0..self.triangles.len()).filter(|&i| is_inverted(&self.triangles[i], &self.rest[i], positions))
    }

    /// Relaxes the triangles with a vertex that is `near`, and those vertices only; gives how many triangles they are.
    fn relax_near(&self, near: &[bool], stiffness: &[f64], positions: &mut [DVec2]) -> Result<usize, Reason> {
        let touches = |t: &[u32; 3]| t.iter().any(|v| near[*v as usize]);
        let own: Vec<usize> = (0..self.triangles.len()).filter(|&i| touches(&self.triangles[i])).collect();
        let triangles: Vec<_> = own.iter().map(|&i| self.triangles[i]).collect();
        let rest: Vec<_> = own.iter().map(|&i| self.rest[i]).collect();
        let stiffness: Vec<f64> = own.iter().map(|&i| stiffness[i]).collect();
        let free: Vec<bool> = self.free.iter().zip(near).map(|(free, near)| *free && *near).collect();
        let patch = Patch { triangles: &triangles, rest: &rest, stiffness: &stiffness, free: &free };
        Arap::new(&patch).ok_or(Reason::Singular)?.relax(positions, ROUNDS, 0.0);
        Ok(own.len())
    }
}

impl MergeTrial<'_> {
    /// Optimises what is deformable; `displaced` is how far the seam's vertices were moved at most.
    pub(super) fn optimise(&mut self, displaced: f64) -> Result<(), Stop> {
        if !self.nodes.iter().any(|n| n.free) {
            return Ok(());
        }
        let (problem, mut positions) = self.local_problem();
        let usual = vec![1.0; problem.rest.len()];
        let patch =
            Patch { triangles: &problem.triangles, rest: &problem.rest, stiffness: &usual, free: &problem.free };
        let system = Arap::new(&patch).ok_or(Reason::Singular)?;
        let repairs = self.params.search == Search::Partial;
        let mut rounds = ROUNDS;
        if repairs {
            system.relax(&mut positions, FIRST, SETTLED * displaced);
            self.work += (FIRST / 4 * self.deformable.len()) as u64;
            if problem.inverted(&positions).count() > HOPELESS {
                return Err(Reason::Fold.into());
            }
            rounds -= FIRST;
            self.checkpoint()?;
        }
        system.relax(&mut positions, rounds, SETTLED * displaced);
        self.work += (rounds / 4 * self.deformable.len()) as u64;
        if repairs {
            self.repair(&problem, &mut positions)?;
        }
        if positions.iter().any(|p| !p.is_finite()) {
            return Err(Reason::Singular.into());
        }
        self.nodes.iter_mut().zip(positions).for_each(|(n, p)| n.at = p);
        Ok(())
    }

    /// The problem, and where its vertices are.
    fn local_problem(&self) -> (LocalProblem, Vec<DVec2>) {
        let mesh = self.mesh;
        let mut positions: Vec<DVec2> = self.nodes.iter().map(|n| n.at).collect();
        let mut free: Vec<bool> = self.nodes.iter().map(|n| n.free).collect();
        let corners = self.deformable.iter().flat_map(|&f| mesh.corners(f));
        let others: Vec<u32> = sorted_unique(corners.filter(|&u| self.workspace.node(u).is_none()));
        let nodes = self.nodes.len() as u32;
        for &u in &others {
            positions.push(self.aligned(u));
            free.push(false);
        }
        let local =
            |u: u32| self.workspace.node(u).unwrap_or_else(|| nodes + others.partition_point(|v| *v < u) as u32);
        let triangles: Vec<[u32; 3]> = self.deformable.iter().map(|&f| mesh.corners(f).map(local)).collect();
        let rest: Vec<[DVec2; 3]> = self.deformable.iter().map(|&f| mesh.target_shape(f)).collect();
        // Seam vertices that stay, in no deformable triangle, would have no equation.
        let mut used = vec![false; free.len()];
        triangles.iter().flatten().for_each(|v| used[*v as usize] = true);
        free.iter_mut().zip(&used).for_each(|(free, used)| *free &= used);
        (LocalProblem { triangles, rest, free }, positions)
    }

    /// Where triangles are inverted and cannot be repaired at once, they are made stiffer and what is around them is optimised again: it
    /// gives way.
    fn repair(&mut self, problem: &LocalProblem, positions: &mut [DVec2]) -> Result<(), Stop> {
        let areas: Vec<f64> = problem.rest.iter().map(|r| 0.5 * (r[1] - r[0]).perp_dot(r[2] - r[0])).collect();
        let all = problem.triangles.len();
        let mut stiffness = vec![1.0; all];
        for round in 0..REPAIRS {
            let mut near = vec![false; problem.free.len()];
            let mut inverted = 0;
            for i in problem.inverted(positions) {
                stiffness[i] *= STIFFER;
                inverted += 1;
                problem.triangles[i].iter().for_each(|v| near[*v as usize] = true);
            }
            if inverted == 0 {
                break;
            }
            if inverted > MOST_INVERTED + all / MOST_INVERTED_PART {
                return Err(Reason::Fold.into());
            }
            let before = positions.to_vec();
            self.work += all as u64;
            if repair_inversions(&problem.triangles, &areas, &problem.free, 3.0 * LOST, positions) {
                break;
            }
            if inverted > MOST_INVERTED {
                return Err(Reason::Fold.into());
            }
            positions.copy_from_slice(&before);
            for _ in 0..2 + round / 2 {
                let touching = problem.triangles.iter().filter(|t| t.iter().any(|v| near[*v as usize]));
                let ring: Vec<u32> = touching.flatten().copied().collect();
                ring.into_iter().for_each(|v| near[v as usize] = true);
            }
            self.checkpoint()?;
            let relaxed = problem.relax_near(&near, &stiffness, positions)?;
            self.work += (ROUNDS / 4 * relaxed) as u64;
        }
        Ok(())
    }
}
