//! Identifying operations (section 4.1): whole seams, and parts of those that cannot be dissolved whole.

use std::collections::{BTreeMap, BTreeSet};

use super::{Candidate, OperationQueue, OperationStatus};
use crate::refine::defrag::mesh::MergeMesh;
use crate::refine::defrag::operation::{Operation, OperationContext, SeamPart};
use crate::refine::defrag::params::Search;
use crate::refine::defrag::retry;
use crate::refine::defrag::seam::{halves, runs};

/// Mean misalignment, in lengths of the seam, beyond which merges all but never succeed: of a stretch, and of a seam within a chart.
const CROOKED: [f64; 2] = [0.6, 1.6];

/// Texels of misalignment that are not too many whatever the length.
const NEAR: f64 = 4.0;

/// The least benefit of a part of a seam, relative to that of a whole one.
const PART: f64 = 0.5;

/// What an operation takes over from the one on the same edges before it.
#[derive(Debug, Default)]
struct Failures {
    fails: u32,
    /// Work on the last.
    spent: u64,
}

impl OperationQueue<'_> {
    /// Makes the operations of a link anew.
    pub(super) fn enumerate(&mut self, mesh: &MergeMesh, link: u32) {
        let own = self.links.link_mut(link);
        let (edges, fails) = (own.edges.clone(), own.fails);
        let old = std::mem::take(&mut own.operations);
        let within =
            edges.first().is_some_and(|&h| mesh.linked(h).is_some_and(|t| mesh.chart_at(h) == mesh.chart_at(t)));
        let groups = if within { runs(mesh, &edges) } else { Vec::new() };
        let (kept, mut former) = self.retire(mesh, link, old, &groups);
        if within {
            for group in groups.into_iter().filter(|g| !kept.contains(g)) {
                let new = || Failures { fails, spent: 0 };
                let former = former.remove(&group).unwrap_or_else(new);
                self.add(mesh, link, SeamPart::Within, group, former);
            }
        } else if !edges.is_empty() {
            self.add(mesh, link, SeamPart::Whole, edges, Failures { fails, spent: 0 });
        }
    }

    /// Ends the operations of a link that are now others. Of groups within a chart that are as they were, those that failed stay where
    /// nothing changed (their edges are the first result), and others hand their failures on (the second).
    fn retire(
        &mut self,
        mesh: &MergeMesh,
        link: u32,
        old: Vec<u32>,
        groups: &[Vec<u32>],
    ) -> (BTreeSet<Vec<u32>>, BTreeMap<Vec<u32>, Failures>) {
        let same: BTreeSet<&Vec<u32>> = groups.iter().collect();
        let (mut kept, mut former) = (BTreeSet::new(), BTreeMap::new());
        for id in old {
            let own = &mut self.candidates[id as usize];
            // What was within a chart that is part of another now is an operation of that one.
            let goes_on = own.op.part == SeamPart::Within
                && own.status != OperationStatus::Gone
                && same.contains(&own.op.edges)
                && own.op.edges.first().is_some_and(|&h| mesh.chart_at(h) == own.op.kept);
            let fails = || retry::still_fails(mesh, &own.op, self.params, own.failure.as_ref());
            if goes_on && own.status == OperationStatus::Failed && fails() {
                kept.insert(own.op.edges.clone());
                self.links.link_mut(link).operations.push(id);
                continue;
            }
            own.status = OperationStatus::Gone;
            if goes_on {
                former.insert(own.op.edges.clone(), Failures { fails: own.op.fails, spent: own.spent });
            }
        }
        (kept, former)
    }

    /// Makes an operation, unless it is none or is split at once.
    fn add(&mut self, mesh: &MergeMesh, link: u32, part: SeamPart, edges: Vec<u32>, former: Failures) {
        let chance = self.random.unit();
        let context = OperationContext { mesh, params: self.params, unit: self.unit };
        let Some(op) = Operation::new(context, part, edges, former.fails, chance) else { return };
        if self.params.search == Search::Partial && is_crooked(&op) {
            // Hopeless as it is: its parts may do.
            self.split(mesh, link, part, &op.edges);
            return;
        }
        let id = self.candidates.len() as u32;
        let small = self.is_small(mesh, &op);
        let worthwhile = retry::is_worthwhile(self.params, op.fails, former.spent);
        self.candidates.push(Candidate {
            op,
            status: OperationStatus::Small,
            link,
            stamp: 0,
            split: false,
            failure: None,
            spent: former.spent,
        });
        self.links.link_mut(link).operations.push(id);
        if !worthwhile {
            // Not it again, but its parts.
            let own = &mut self.candidates[id as usize];
            (own.status, own.split) = (OperationStatus::Failed, true);
            self.split_candidate(mesh, id);
        } else if !small {
            self.push(id);
        }
    }

    /// Makes operations of the parts of one that cannot be done as a whole. The published search has none.
    pub(super) fn split_candidate(&mut self, mesh: &MergeMesh, id: u32) {
        if self.params.search == Search::Partial {
            let Candidate { link, op: Operation { part, edges, .. }, .. } = &self.candidates[id as usize];
            let (link, part, edges) = (*link, *part, edges.clone());
            self.split(mesh, link, part, &edges);
        }
    }

    fn split(&mut self, mesh: &MergeMesh, link: u32, part: SeamPart, edges: &[u32]) {
        let runs = if part == SeamPart::Whole { runs(mesh, edges) } else { Vec::new() };
        let (part, parts) =
            if runs.len() > 1 { (SeamPart::Run, runs) } else { (SeamPart::Stretch, halves(mesh, edges)) };
        for edges in parts {
            self.add(mesh, link, part, edges, Failures::default());
        }
    }

    /// Whether an operation removes too little of either border (section 5).
    pub(super) fn is_small(&self, mesh: &MergeMesh, op: &Operation) -> bool {
        let least = self.params.min_benefit * if op.part == SeamPart::Whole { 1.0 } else { PART };
        !op.is_within() && op.benefit(mesh) < least
    }
}

/// Whether the sides of a seam fit so badly that it is hopeless to try.
fn is_crooked(op: &Operation) -> bool {
    let most = match op.part {
        SeamPart::Stretch => CROOKED[0],
        SeamPart::Within => CROOKED[1],
        SeamPart::Whole | SeamPart::Run => return false,
    };
    op.cost > most * 0.5 * (op.lengths[0] + op.lengths[1]) && op.cost > NEAR
}
