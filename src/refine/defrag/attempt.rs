//! Performing a merge operation (section 4.2) without changing anything: what would become of the mesh, or why not. So there is
//! nothing to roll back.

mod checks;
mod deformable;
mod fuse;
mod optimise;
mod overlaps;
mod trial;
mod workspace;

use glam::DVec2;

pub(super) use self::overlaps::new_overlap;
pub(super) use self::workspace::Workspace;
use super::mesh::MergeMesh;
use super::operation::{Operation, SeamPart};
use super::params::{Defrag, Search};
use super::retry;
use super::speculation::{Superseded, Task};
use crate::atlas::bvh::Bounds;
use trial::{MergeTrial, TrialResult};

/// Vertices that move by less, in texels, leave their texels as they are: uploads hold float32.
const STILL: f64 = 4e-4;

/// Why an operation failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Reason {
    /// The rest of the borders collide after alignment.
    Collision,
    /// Triangles overlap after the shapes were optimised.
    Overlap,
    /// A triangle turned over or lost its area.
    Fold,
    /// The deformable triangles are deformed too much.
    Local,
    /// The whole atlas would be.
    Global,
    /// The chart would not be planar: a handle, or no border left.
    Topology,
    /// Too much of the surface would be resampled.
    Resampled,
    /// The chart would be larger than a sheet.
    Size,
    /// Nothing that can be solved.
    Singular,
}

impl Reason {
    /// The name in reports.
    pub(super) fn name(self) -> &'static str {
        match self {
            Reason::Collision => "collision",
            Reason::Overlap => "overlap",
            Reason::Fold => "fold",
            Reason::Local => "local_energy",
            Reason::Global => "global_energy",
            Reason::Topology => "topology",
            Reason::Resampled => "resampled",
            Reason::Size => "sheet_size",
            Reason::Singular => "singular",
        }
    }
}

/// What a successful operation does.
#[derive(Debug, Clone)]
pub(super) struct Merge {
    /// Pairs of half edges that become one: of the kept chart, and of the other.
    pub zip: Vec<(u32, u32)>,
    /// UV vertices that become another: (gone, stays).
    pub fuse: Vec<(u32, u32)>,
    /// New places, in the coordinates of the kept chart.
    pub places: Vec<(u32, DVec2)>,
    /// Faces whose corners move (by more than the chart does), with their energy.
    pub deformable: Vec<(u32, f64)>,
    /// Those of them that are deformed.
    pub deformed: Vec<u32>,
    /// What the energy grows by.
    pub energy: f64,
}

/// What an outcome depends on. As long as nothing changes there it stands; only whether the chart stays planar and fits on a sheet is a
/// matter of all of it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Footprint {
    /// Part of the kept chart, in its coordinates.
    pub region: Bounds,
    /// The number of changes of the kept and the moved chart by then.
    seen: [usize; 2],
    /// Whether it was an island that moved, which may be deformed more.
    island: bool,
}

impl Footprint {
    fn new(mesh: &MergeMesh, op: &Operation, params: &Defrag) -> Self {
        let seen = [op.kept, op.moved].map(|c| mesh.chart(c).changes.len());
        Footprint { region: Bounds::EMPTY, seen, island: op.is_island(mesh, params) }
    }

    /// Whether nothing that the outcome depends on has changed since.
    pub(super) fn stands(&self, mesh: &MergeMesh, op: &Operation, params: &Defrag) -> bool {
        let [kept, moved] = [op.kept, op.moved].map(|c| &mesh.chart(c).changes);
        let changed = |kept: &[Bounds]| kept.iter().any(|change| change.meets(&self.region));
        kept.get(self.seen[0]..).is_some_and(|new| !changed(new))
            && (op.is_within() || moved.len() == self.seen[1])
            && self.island == op.is_island(mesh, params)
    }
}

/// An operation that was tried.
#[derive(Debug, Clone)]
pub(super) struct Attempt {
    /// The merge, or why there is none.
    pub outcome: Result<Merge, Reason>,
    /// What that depends on.
    pub footprint: Footprint,
    /// Faces looked at.
    pub work: u64,
}

/// Which chart gives way where a seam does not fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Target {
    /// Both: vertices meet at their mean (section 4.2.1).
    Mean,
    /// The moved chart: the other stays as it is.
    Kept,
}

/// One way to try an operation: the published one is both charts, and not wide.
#[derive(Debug, Clone, Copy)]
struct TrialVariant {
    target: Target,
    /// Deformation spreads further than published.
    wide: bool,
}

/// Tries an operation that leaves a planar chart: in one way after the other, until one succeeds. Fails only where `task` says that
/// nobody waits for it.
pub(super) fn attempt(
    mesh: &MergeMesh,
    op: &Operation,
    params: &Defrag,
    task: &Task<'_>,
) -> Result<Attempt, Superseded> {
    let partial = params.search == Search::Partial;
    // A chart that keeps its texels is left alone where the other, which is resampled anyway, can do the fitting.
    let gentle = partial && op.part != SeamPart::Within && !op.whole_texels;
    let targets: &[Target] = if gentle { &[Target::Kept, Target::Mean] } else { &[Target::Mean] };
    let mut attempt = Attempt::failed(mesh, op, params, Reason::Singular);
    for wide in [false, true] {
        if wide && !retry::may_widen(params, attempt.work) {
            break;
        }
        let try_way = |target: &Target, task: &Task<'_>| {
            let variant = TrialVariant { target: *target, wide };
            task.with_workspace(|workspace| MergeTrial::new(mesh, op, params, variant, workspace, task).run())
        };
        for result in task.until_decided(targets, &try_way, TrialResult::decides)? {
            if attempt.add(result, wide) {
                return Ok(attempt);
            }
        }
    }
    Ok(attempt)
}

impl Attempt {
    /// One that failed before it looked at anything.
    pub(super) fn failed(mesh: &MergeMesh, op: &Operation, params: &Defrag, reason: Reason) -> Self {
        Attempt { outcome: Err(reason), footprint: Footprint::new(mesh, op, params), work: 0 }
    }

    /// That of an operation that would not leave a planar chart (section 4.1).
    pub(super) fn not_planar(mesh: &MergeMesh, op: &Operation, params: &Defrag) -> Self {
        Attempt { work: op.edges.len() as u64, ..Self::failed(mesh, op, params, Reason::Topology) }
    }

    /// Adds the next way that was tried; says whether it is the last one. Why the published ways failed says more than why others did.
    fn add(&mut self, result: TrialResult, wide: bool) -> bool {
        let decides = result.decides();
        self.footprint.region = self.footprint.region.union(result.region);
        self.work += result.work;
        if decides || !wide {
            self.outcome = result.outcome;
        }
        decides
    }
}
