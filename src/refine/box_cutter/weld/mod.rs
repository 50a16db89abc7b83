//! Welding (Box Cutter, section 4.2): charts are joined again along globally continuous boundaries, the longest first, while
//! they do not overlap and packing stays good.
//!
//! A seam whose two sides are one rigid motion of each other lets the smaller chart be moved to the larger one. All parts of
//! their common seam that meet then are closed together, and their UV vertices become one, exactly; so no hairline overlap is
//! left along a weld. The larger chart keeps its place bit for bit. Where the smaller one comes to lie, other charts may
//! lie already: charts are packed afterwards.

mod state;
#[cfg(test)]
mod tests;

use self::state::WeldState;
use crate::atlas::seams::{RigidSeam, border_length, rigid_seams, seam_runs, weld_tolerance};
use crate::atlas::{Atlas, ChartId, Charts, Topology};
use crate::context::Context;
use crate::error::Result;

/// Packings that may be computed to keep the efficiency.
const PACKINGS: usize = 24;

/// What welding did.
#[derive(Debug, Clone)]
pub struct Welded {
    /// The atlas; pack it before use.
    pub atlas: Atlas,
    /// Pairs of charts joined.
    pub welds: usize,
    /// Joins taken back, because packing suffered.
    pub undone: usize,
    /// UV boundary length saved, both sides counted.
    pub boundary_saved: f64,
    /// Triangles tested.
    pub work: u64,
}

/// Welds the charts for which `touchable` holds. `efficiency` packs an atlas and gives its packing efficiency in 0..=1; it may fall
/// by `loss` (0.10 in the paper: percentage points, not parts) below what it was. With an infinite `loss` nothing is packed.
pub fn weld(
    atlas: &Atlas,
    touchable: &(dyn Fn(ChartId) -> bool + Sync),
    loss: f64,
    efficiency: &(dyn Fn(&Atlas) -> Result<f64> + Sync),
    context: &Context,
) -> Result<Welded> {
    let mut state = WeldState::new(atlas, touchable, weld_tolerance(atlas));
    let mut guard = Guard { floor: None, loss, packings: 0, start: atlas, efficiency };
    let mut undone = 0;
    loop {
        context.check()?;
        state.close_slits();
        let candidates = candidates(&state);
        let snapshot = loss.is_finite().then(|| state.snapshot());
        let applied = apply(&mut state, &candidates, context)?;
        if applied.is_empty() {
            break;
        }
        let Some(snapshot) = snapshot else { continue };
        if guard.holds(state.mesh.atlas())? {
            continue;
        }
        // As many of the welds, in order, as packing bears; the next one is never tried again.
        let work = state.work;
        let (mut good, mut bad) = (0, applied.len());
        while bad - good > 1 && guard.packings < PACKINGS && !context.out_of_time() {
            context.check()?;
            let middle = good.midpoint(bad);
            state.restore(&snapshot);
            apply(&mut state, &applied[..middle], context)?;
            if guard.holds(state.mesh.atlas())? {
                good = middle;
            } else {
                bad = middle;
            }
        }
        state.restore(&snapshot);
        apply(&mut state, &applied[..good], context)?;
        state.work = work;
        state.ban(&applied[bad - 1]);
        undone += 1;
        if guard.packings >= PACKINGS || context.out_of_time() {
            break;
        }
    }
    state.close_slits();
    let (welds, work) = (state.welds(), state.work);
    let welded = state.into_atlas(atlas);
    let length = |a: &Atlas| border_length(a, &Topology::new(a));
    let boundary_saved = length(atlas) - length(&welded);
    Ok(Welded { atlas: welded, welds, undone, boundary_saved, work })
}

/// Watches over the packing efficiency.
struct Guard<'a> {
    floor: Option<f64>,
    loss: f64,
    packings: usize,
    start: &'a Atlas,
    efficiency: &'a (dyn Fn(&Atlas) -> Result<f64> + Sync),
}

impl Guard<'_> {
    fn holds(&mut self, atlas: &Atlas) -> Result<bool> {
        let floor = match self.floor {
            Some(floor) => floor,
            None => (self.efficiency)(self.start)? - self.loss,
        };
        self.floor = Some(floor);
        self.packings += 1;
        Ok((self.efficiency)(atlas)? >= floor)
    }
}

/// Rigid seams between different charts, the longest first.
fn candidates(state: &WeldState) -> Vec<RigidSeam> {
    let (atlas, topology) = (state.mesh.atlas(), state.mesh.topology());
    let charts = Charts::new(topology);
    let mut found = Vec::new();
    for run in seam_runs(atlas, topology, &charts) {
        let faces = run.charts.map(|c| charts.faces[c.index()][0]);
        if run.charts[0] == run.charts[1] || !faces.iter().all(|&f| state.may_touch(f)) {
            continue;
        }
        found.extend(rigid_seams(atlas, topology, &run, state.tolerance));
    }
    found.retain(|seam| !state.is_banned(seam));
    found.sort_by(|a, b| b.length.total_cmp(&a.length).then(a.edges[0].cmp(&b.edges[0])));
    found
}

/// Tries the seams in order; those that were welded. Seams of charts that moved meanwhile wait for the next round.
fn apply(state: &mut WeldState, candidates: &[RigidSeam], context: &Context) -> Result<Vec<RigidSeam>> {
    state.start_round();
    let mut applied = Vec::new();
    for seam in candidates {
        context.check()?;
        if state.weld(seam) {
            applied.push(seam.clone());
        }
    }
    Ok(applied)
}
