//! The priority queue of operations, and the set of those that failed (Algorithm 1, section 4.4).

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use super::attempt::{Footprint, Merge, Reason};
use super::links::ChartLinks;
use super::mesh::MergeMesh;
use super::operation::Operation;
use super::params::Defrag;
use super::retry;
use crate::atlas::bvh::Bounds;
use crate::atlas::groups::sorted_unique;
use crate::packing::Random;

mod candidates;
#[cfg(test)]
mod tests;

/// Where an operation stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum OperationStatus {
    /// Waits for its turn.
    Queued,
    /// Failed, until its charts change.
    Failed,
    /// Removes too little of a border, until its charts change.
    Small,
    /// Never again: its seam has changed.
    Gone,
}

/// An operation, and what has become of it.
#[derive(Debug)]
struct Candidate {
    op: Operation,
    status: OperationStatus,
    /// What it shares with others on the same seams.
    link: u32,
    /// Entries of the heap with another number are stale.
    stamp: u32,
    /// Whether its parts are candidates.
    split: bool,
    /// What its last failure depends on.
    failure: Option<Footprint>,
    /// Work on the last attempt that failed.
    spent: u64,
}

/// The queue.
pub(super) struct OperationQueue<'a> {
    params: &'a Defrag,
    unit: f64,
    candidates: Vec<Candidate>,
    links: ChartLinks,
    /// (rank, operation, its stamp by then), the least rank first, among equals the older operation.
    heap: BinaryHeap<Reverse<(u64, u32, u32)>>,
    random: Random,
}

impl<'a> OperationQueue<'a> {
    /// Identifies all operations and ranks them.
    pub(super) fn new(mesh: &MergeMesh, params: &'a Defrag, unit: f64, seed: u64) -> Self {
        let mut queue = OperationQueue {
            params,
            unit,
            candidates: Vec::new(),
            links: ChartLinks::new(mesh),
            heap: BinaryHeap::new(),
            random: Random::new(seed),
        };
        queue.links.ids().for_each(|link| queue.enumerate(mesh, link));
        queue
    }

    /// Operations that wait, and some that do no more.
    pub(super) fn len(&self) -> usize {
        self.heap.len()
    }

    /// An operation.
    pub(super) fn operation(&self, id: u32) -> &Operation {
        &self.candidates[id as usize].op
    }

    /// Whether an operation waits for its turn, or has it.
    pub(super) fn is_waiting(&self, id: u32) -> bool {
        self.candidates[id as usize].status == OperationStatus::Queued
    }

    fn is_current(&self, Reverse((_, id, stamp)): &Reverse<(u64, u32, u32)>) -> bool {
        self.is_waiting(*id) && self.candidates[*id as usize].stamp == *stamp
    }

    /// The next operation.
    pub(super) fn pop(&mut self) -> Option<u32> {
        while let Some(entry) = self.heap.pop() {
            if self.is_current(&entry) {
                return Some(entry.0.1);
            }
        }
        None
    }

    /// The next `most` operations, in order.
    pub(super) fn upcoming(&self, most: usize) -> Vec<u32> {
        let mut entries: Vec<_> = self.heap.iter().filter(|entry| self.is_current(entry)).collect();
        if entries.len() > most {
            entries.select_nth_unstable_by(most, |a, b| b.cmp(a));
            entries.truncate(most);
        }
        entries.sort_unstable_by(|a, b| b.cmp(a));
        entries.into_iter().map(|entry| entry.0.1).collect()
    }

    /// Puts an operation (back) into the queue.
    fn push(&mut self, id: u32) {
        let own = &mut self.candidates[id as usize];
        own.stamp += 1;
        own.status = OperationStatus::Queued;
        // Ranks are compared as bits: they are not negative.
        self.heap.push(Reverse((own.op.rank.to_bits(), id, own.stamp)));
    }

    /// The operation failed, after so much work: it waits until what that depends on changes. Parts of it may do better.
    pub(super) fn failed(&mut self, mesh: &MergeMesh, id: u32, reason: Reason, failure: Footprint, work: u64) {
        let own = &mut self.candidates[id as usize];
        own.op.fails += 1;
        (own.failure, own.spent) = (Some(failure), work);
        own.status = OperationStatus::Failed;
        let link = self.links.link_mut(own.link);
        link.fails = link.fails.max(own.op.fails);
        let first = !std::mem::replace(&mut own.split, true);
        if first && retry::may_split(reason) {
            self.split_candidate(mesh, id);
        }
    }

    /// Takes note of a merge that was made: `region` is where the chart changed.
    pub(super) fn merged(&mut self, mesh: &MergeMesh, id: u32, merge: &Merge, region: Bounds) {
        let Candidate { op: Operation { kept, moved, .. }, link, .. } = self.candidates[id as usize];
        self.links.dissolve(link, &merge.zip);
        let mut changed: Vec<u32> = vec![link];
        if kept != moved {
            let (links, gone) = self.links.join(kept, moved);
            gone.into_iter().for_each(|id| self.candidates[id as usize].status = OperationStatus::Gone);
            changed.extend(links);
        }
        // Seams whose sides changed shape.
        for h in merge.deformable.iter().flat_map(|&(f, _)| 3 * f..3 * f + 3) {
            let across = mesh.linked(h).and_then(|t| self.links.between(kept, mesh.chart_at(t)));
            changed.extend(across);
        }
        let changed = sorted_unique(changed);
        changed.iter().for_each(|&link| self.enumerate(mesh, link));
        self.update(mesh, kept, &changed, region);
    }

    /// Ranks the other operations of a chart that changed, and lets those that failed try again.
    fn update(&mut self, mesh: &MergeMesh, chart: u32, enumerated: &[u32], region: Bounds) {
        for (other, link) in self.links.of_chart(chart) {
            if enumerated.binary_search(&link).is_ok() {
                continue;
            }
            let operations = self.links.link(link).operations.clone();
            if other != chart {
                let roles = Operation::roles(mesh, chart, other);
                let swapped = operations
                    .iter()
                    .map(|&id| &self.candidates[id as usize])
                    .any(|own| own.status != OperationStatus::Gone && (own.op.kept, own.op.moved) != roles);
                if swapped {
                    self.enumerate(mesh, link);
                    continue;
                }
            }
            operations.into_iter().for_each(|id| self.update_candidate(mesh, id, chart, &region));
        }
    }

    fn update_candidate(&mut self, mesh: &MergeMesh, id: u32, chart: u32, region: &Bounds) {
        let own = &self.candidates[id as usize];
        let rank = own.op.ranked(mesh, self.params);
        let moves = own.op.rank.to_bits() != rank.to_bits();
        let small = self.is_small(mesh, &own.op);
        let again = self.params.retry && retry::is_concerned(&own.op, own.failure.as_ref(), chart, region);
        let worthwhile = retry::is_worthwhile(self.params, own.op.fails, own.spent);
        let status = own.status;
        self.candidates[id as usize].op.rank = rank;
        match status {
            OperationStatus::Queued if small => self.candidates[id as usize].status = OperationStatus::Small,
            OperationStatus::Queued if moves => self.push(id),
            OperationStatus::Small if !small => self.push(id),
            OperationStatus::Failed if again && !small && worthwhile => self.push(id),
            _ => {}
        }
    }
}
