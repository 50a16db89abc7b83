//! When what failed is tried again: every rule, and what it gains.
//!
//! The paper tries every failed operation of a chart again after each merge of that chart (section 4.4), ever later in the queue
//! (eq. 4, in [`Operation::ranked`](super::operation::Operation::ranked)). Here it is tried where that may help and is not dear. What each
//! rule is worth was measured on five scans by leaving it out (agi, esp32cam, copyroom, can, mug: 3280, 711, 1380, 321 and 121 charts, of
//! which 1393, 112, 339, 110 and 13 are left). Work is that of the report:
//!
//! | rule | work without it | charts without it |
//! |---|---|---|
//! | [`is_concerned`] | +10, +10, +2, +12, +3 % | +14, 0, 0, 0, 0 |
//! | [`is_worthwhile`] | +6, +25, +13, +22, +19 % | none |
//! | [`still_fails`] | 0, +1, 0, +8, +1 % | none |
//! | failures of a seam count for the operations that follow on it | +6, +8, +2, +79, 0 % | +17, -1, -1, -7, 0 |
//! | deformation that spreads further, where the published does not do | -20, -10, -25, -30, -5 % | +21, +12, +37, +4, +1 |
//! | [`may_widen`]: not where that is dear | +5, +10, +42, +43, +12 % | 0, -1, -2, 0, -1 |
//! | [`may_hold`] at all | -39, -26, -14, -16, -27 % | +34, +8, +11, +4, +3 |
//! | fewer holds of many faces | +2, 0, 0, 0, +13 % | none |

use super::attempt::{Footprint, Reason};
use super::mesh::MergeMesh;
use super::operation::Operation;
use super::params::{Defrag, Search};
use crate::atlas::bvh::Bounds;

/// Work on an operation that failed, times how often it did, beyond which it is not tried again.
const MOST_WORK: u64 = 10_000;

/// Work beyond which an attempt that failed is not made again with deformation that spreads further.
const MOST_WORK_TO_WIDEN: u64 = 3_000;

/// Times that faces are held where they overlap, and the rest is tried again.
const HOLDS: usize = 3;
/// The same for more than `MANY` faces.
const HOLDS_OF_MANY: usize = 1;
/// See [`HOLDS_OF_MANY`].
const MANY: usize = 2_000;

/// Whether parts of a seam may do better: not where charts are too large together.
pub(super) fn may_split(reason: Reason) -> bool {
    reason != Reason::Size
}

/// Whether a failed operation is tried again where `chart` changed in `region`: only where the failure depends on that.
pub(super) fn is_concerned(op: &Operation, failure: Option<&Footprint>, chart: u32, region: &Bounds) -> bool {
    failure.is_none_or(|failure| failure.region.meets(region) || op.moved == chart && op.kept != chart)
}

/// Whether an operation that failed would do so again, as the mesh is now.
pub(super) fn still_fails(mesh: &MergeMesh, op: &Operation, params: &Defrag, failure: Option<&Footprint>) -> bool {
    failure.is_some_and(|failure| failure.stands(mesh, op, params))
}

/// Whether an operation that failed so often, last after so much work, is worth another try: the dearer it is, the fewer.
pub(super) fn is_worthwhile(params: &Defrag, fails: u32, work: u64) -> bool {
    params.search == Search::Paper || u64::from(fails) * work <= MOST_WORK
}

/// Whether an operation is tried with deformation that spreads further than published, after so much work.
pub(super) fn may_widen(params: &Defrag, work: u64) -> bool {
    params.search == Search::Partial && work <= MOST_WORK_TO_WIDEN
}

/// Whether faces that overlap may be held and the rest tried again, after so many times.
pub(super) fn may_hold(times: usize, faces: usize) -> bool {
    times < if faces > MANY { HOLDS_OF_MANY } else { HOLDS }
}
