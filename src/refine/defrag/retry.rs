//! When what failed is tried again: every rule, in one place.
//!
//! The paper tries every failed operation of a chart again after each merge of that chart (section 4.4), ever later in the queue
//! (eq. 4, in [`Operation::ranked`](super::operation::Operation::ranked)).

use super::attempt::{Footprint, Reason};
use super::operation::Operation;
use super::params::{Defrag, Search};
use crate::atlas::bvh::Bounds;

/// Work on an operation that failed, times how often it did, beyond which it is not tried again.
const MOST_WORK: u64 = 10_000;

/// Failures that a new group of seams within a chart takes over from those before it at most.
const MOST_FAILS: u32 = 8;

/// Work beyond which an attempt that failed is not made again with deformation that spreads further.
const MOST_WORK_TO_WIDEN: u64 = 3_000;

/// Times that vertices are held where the border crossed, and the rest is tried again; and for more faces than `MANY`.
const HOLDS: [usize; 2] = [3, 1];
/// See [`HOLDS`].
const MANY: usize = 2_000;

/// Times that inverted triangles are repaired.
pub(super) const REPAIRS: usize = 3;

/// What fails for these reasons is not tried again.
pub(super) fn is_final(reason: Reason) -> bool {
    matches!(reason, Reason::Global | Reason::Resampled | Reason::Size)
}

/// Whether parts of a seam may do better: not where charts are too large together.
pub(super) fn may_split(reason: Reason) -> bool {
    reason != Reason::Size
}

/// Whether a failed operation is tried again where `chart` changed in `region`: only where the failure depends on that.
pub(super) fn is_concerned(op: &Operation, failure: Option<&Footprint>, chart: u32, region: &Bounds) -> bool {
    failure.is_none_or(|failure| failure.region.meets(region) || op.moved == chart && op.kept != chart)
}

/// Whether an operation that failed is worth another try: the dearer it is, the fewer.
pub(super) fn is_worthwhile(params: &Defrag, fails: u32, work: u64) -> bool {
    params.search == Search::Paper || u64::from(fails) * work <= MOST_WORK
}

/// Failures that a group of seams within a chart begins with, after others in the same chart failed so often.
pub(super) fn inherited(fails: u32) -> u32 {
    fails.min(MOST_FAILS)
}

/// Whether an operation is tried with deformation that spreads further, after so much work.
pub(super) fn may_widen(work: u64) -> bool {
    work <= MOST_WORK_TO_WIDEN
}

/// Whether faces that overlap may be held and the rest tried again, after so many times.
pub(super) fn may_hold(times: usize, faces: usize) -> bool {
    times < HOLDS[usize::from(faces > MANY)]
}
