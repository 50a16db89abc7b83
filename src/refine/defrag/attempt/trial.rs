//! One way to perform a merge operation, step by step (section 4.2).

use glam::DVec2;

use super::fuse::Node;
use super::workspace::Workspace;
use super::{Merge, Reason, STILL, Target, TrialVariant};
use crate::atlas::bvh::Bounds;
use crate::atlas::rigid::Rigid;
use crate::refine::defrag::mesh::MergeMesh;
use crate::refine::defrag::operation::Operation;
use crate::refine::defrag::params::Defrag;
use crate::refine::defrag::retry;
use crate::refine::defrag::speculation::{Superseded, Task};

/// The outcome of a trial.
pub(super) struct TrialResult {
    /// The merge, or why there is none.
    pub outcome: Result<Merge, Reason>,
    /// What it depends on, in the coordinates of the kept chart.
    pub region: Bounds,
    /// Faces looked at.
    pub work: u64,
}

impl TrialResult {
    /// Whether no other way is to be tried: what collides without any deformation does so whoever gives way.
    pub(super) fn decides(&self) -> bool {
        matches!(self.outcome, Ok(_) | Err(Reason::Collision))
    }
}

/// Why a trial ends without a merge; none where nobody waits for it any more.
pub(super) type Stop = Option<Reason>;

/// An operation being tried in one way.
pub(super) struct MergeTrial<'a> {
    pub mesh: &'a MergeMesh,
    pub op: &'a Operation,
    pub params: &'a Defrag,
    pub variant: TrialVariant,
    pub workspace: &'a mut Workspace,
    pub task: &'a Task<'a>,
    pub region: Bounds,
    pub work: u64,
    /// UV vertices that may move, and those of the seam.
    pub nodes: Vec<Node>,
    /// Faces with a corner that moves.
    pub deformable: Vec<u32>,
}

impl<'a> MergeTrial<'a> {
    pub(super) fn new(
        mesh: &'a MergeMesh,
        op: &'a Operation,
        params: &'a Defrag,
        variant: TrialVariant,
        workspace: &'a mut Workspace,
        task: &'a Task<'a>,
    ) -> Self {
        workspace.begin(mesh);
        let (nodes, deformable) = (Vec::new(), Vec::new());
        MergeTrial { mesh, op, params, variant, workspace, task, region: Bounds::EMPTY, work: 0, nodes, deformable }
    }

    /// Tries it.
    pub(super) fn run(mut self) -> Result<TrialResult, Superseded> {
        let outcome = match self.perform() {
            Ok(merge) => Ok(merge),
            Err(Some(reason)) => Err(reason),
            Err(None) => return Err(Superseded),
        };
        Ok(TrialResult { outcome, region: self.region, work: self.work })
    }

    /// Section 4.2: align, fuse, optimise near the seam, check.
    fn perform(&mut self) -> Result<Merge, Stop> {
        let zip = self.op.pairs(self.mesh);
        let displaced = self.fuse(&zip);
        if self.collapses() {
            self.depend_on_stars();
            return Err(Reason::Fold.into());
        }
        self.spread();
        self.depend_on_stars();
        self.find_deformable()?;
        self.checkpoint()?;
        self.work += self.deformable.len() as u64;
        self.depend_on_deformable();
        if !self.op.is_within() && self.border_collides() {
            return Err(Reason::Collision.into());
        }
        self.optimise_without_overlap(displaced)?;
        if !self.op.is_within() && self.interior_collides() {
            return Err(Reason::Overlap.into());
        }
        Ok(self.merge(zip))
    }

    /// Sections 4.2.2 and 4.2.3: optimises what is deformable and checks it. Where it then overlaps, what does so is held where it was
    /// before, and the rest is fitted to it.
    fn optimise_without_overlap(&mut self, displaced: f64) -> Result<(), Stop> {
        let start: Vec<DVec2> = self.nodes.iter().map(|n| n.at).collect();
        for held in 0.. {
            if displaced > STILL {
                self.optimise(displaced)?;
            }
            self.depend_on_deformable();
            self.check_folds()?;
            self.check_local_energy()?;
            self.checkpoint()?;
            let crossing = self.overlapping();
            if crossing.is_empty() {
                break;
            }
            if !self.hold(&crossing) || !retry::may_hold(held, self.deformable.len()) {
                return Err(Reason::Overlap.into());
            }
            self.nodes.iter_mut().zip(&start).for_each(|(n, at)| n.at = *at);
        }
        Ok(())
    }

    /// Holds the vertices of these faces; says whether one of them was free.
    fn hold(&mut self, faces: &[u32]) -> bool {
        let mut held = false;
        for u in faces.iter().flat_map(|&f| self.mesh.corners(f)) {
            if let Some(n) = self.workspace.node(u) {
                held |= std::mem::replace(&mut self.nodes[n as usize].free, false);
            }
        }
        held
    }

    /// Others may run beside it, or have made it needless.
    pub(super) fn checkpoint(&self) -> Result<(), Stop> {
        self.task.checkpoint(self.nodes.len()).map_err(|Superseded| None)
    }

    /// It depends on what lies around every vertex that it names, whether that moves or not.
    fn depend_on_stars(&mut self) {
        for f in self.nodes.iter().flat_map(|n| &n.vertices).flat_map(|&u| self.mesh.star(u)) {
            self.region = self.region.union(Bounds::of(&self.aligned_triangle(f)));
        }
    }

    /// It depends on what lies where its faces come to lie.
    fn depend_on_deformable(&mut self) {
        for &f in &self.deformable {
            self.region = self.region.union(Bounds::of(&self.placed_triangle(f)));
        }
    }

    /// Whether a face is of the chart that moves.
    pub(super) fn is_moved(&self, face: u32) -> bool {
        !self.op.is_within() && self.mesh.chart_of(face) == self.op.moved
    }

    /// Whether a vertex must stay where it is.
    pub(super) fn must_stay(&self, vertex: u32) -> bool {
        self.variant.target == Target::Kept && self.mesh.star(vertex).next().is_some_and(|f| !self.is_moved(f))
    }

    /// Where a vertex is once the charts are aligned.
    pub(super) fn aligned(&self, vertex: u32) -> DVec2 {
        let at = self.mesh.uv(vertex);
        match self.mesh.star(vertex).next() {
            Some(f) if self.is_moved(f) => self.op.motion.transform_point2(at),
            _ => at,
        }
    }

    /// Where a face is then.
    pub(super) fn aligned_triangle(&self, face: u32) -> [DVec2; 3] {
        let motion = if self.is_moved(face) { self.op.motion } else { Rigid::IDENTITY };
        self.mesh.triangle(face).map(|p| if motion == Rigid::IDENTITY { p } else { motion.transform_point2(p) })
    }

    /// Where a deformable face comes to lie.
    pub(super) fn placed_triangle(&self, face: u32) -> [DVec2; 3] {
        self.mesh.corners(face).map(|u| match self.workspace.node(u) {
            Some(node) => self.nodes[node as usize].at,
            None => self.aligned(u),
        })
    }

    /// What the trial came to.
    fn merge(&self, zip: Vec<(u32, u32)>) -> Merge {
        let mut merge = Merge {
            zip,
            fuse: Vec::new(),
            places: Vec::new(),
            deformable: Vec::with_capacity(self.deformable.len()),
            deformed: Vec::new(),
            energy: 0.0,
        };
        for node in &self.nodes {
            let [first, rest @ ..] = node.vertices.as_slice() else { continue };
            merge.fuse.extend(rest.iter().map(|&u| (u, *first)));
            if self.aligned(*first) != node.at {
                merge.places.push((*first, node.at));
            }
        }
        for &f in &self.deformable {
            let (now, aligned) = (self.placed_triangle(f), self.aligned_triangle(f));
            let energy = self.mesh.energy_at(f, &now);
            merge.deformable.push((f, energy));
            merge.energy += energy - self.mesh.energy[f as usize];
            if now.iter().zip(&aligned).any(|(p, q)| p.distance(*q) > STILL) {
                merge.deformed.push(f);
            }
        }
        merge
    }
}
