//! The search for cuts: candidates from void boxes, each executed and repacked, the best kept (Box Cutter, section 3.2).

use std::sync::Arc;

use rayon::prelude::*;

use super::arrange::{Arrangement, Sheet};
use super::candidates::{Candidate, Choice};
use super::edges::Mesh;
use super::field::Field;
use super::lines::chords;
use super::outline::{Chord, Line};
use super::panel::Panel;
use crate::atlas::HalfEdge;
use crate::context::Context;
use crate::error::Result;
use crate::packing::Random;

/// A cut that was made.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Cut {
    /// Chords of one line in a chart.
    Straight {
        /// Number of the chart.
        chart: u32,
        /// In chart coordinates.
        line: Line,
        /// The parts of the line that were cut.
        chords: Vec<(f64, f64)>,
    },
    /// Mesh edges, one half edge of each.
    Edges(Vec<HalfEdge>),
}

/// Panels, their layout, and how they came about.
#[derive(Debug, Clone)]
pub(crate) struct State {
    /// The panels.
    pub panels: Vec<Arc<Panel>>,
    /// Their layout.
    pub arrangement: Arrangement,
    /// Total border length in texels.
    pub length: f64,
    /// The same, new cuts times their importance.
    pub weighted: f64,
    /// All cuts, in the order in which they were made.
    pub cuts: Vec<Arc<Cut>>,
}

/// What stays the same during a search.
pub(crate) struct Ground<'a> {
    /// How panels are arranged.
    pub sheet: Sheet,
    /// How candidates are chosen.
    pub choice: Choice,
    /// Importance, where cuts are straight.
    pub field: Option<Field>,
    /// The mesh, where cuts follow its edges.
    pub mesh: Option<Mesh<'a>>,
    /// Longest side of the input's bounding box, in texels: the unit of boundary length.
    pub unit: f64,
    /// Whether there is any importance.
    pub weighted: bool,
}

/// When a search ends, and what it prefers.
#[derive(Debug, Clone)]
pub(crate) struct Limits {
    /// Longest border in texels.
    pub length: f64,
    /// Packing efficiency that is enough.
    pub target: f64,
    /// Most panels.
    pub charts: usize,
    /// Most work.
    pub work: u64,
    /// Exponent of the score.
    pub alpha: f64,
    /// Gain that counts as an improvement.
    pub gain: f64,
    /// Steps without improvement before the search ends.
    pub patience: u32,
    /// States carried on at each step.
    pub beam: usize,
    /// Whether to go on after the first round.
    pub rounds: bool,
}

/// What a search found.
#[derive(Debug)]
pub(crate) struct Found {
    /// The best states within the limits, best first; the start among them when nothing is better.
    pub states: Vec<State>,
    /// Why the search ended.
    pub stopped_by: &'static str,
    /// Words of occupancy looked at.
    pub work: u64,
    /// Candidates executed and repacked.
    pub tried: usize,
}

/// States that a search gives back at most.
const FINALISTS: usize = 6;
/// Candidates that are tried together, and of how many of the states carried on.
const JOINED: [usize; 4] = [2, 4, 8, 16];
/// See [`JOINED`].
const JOINED_PARENTS: usize = 2;
/// States carried on at each step of a further round.
const ROUND_BEAM: usize = 2;
/// Rounds without improvement after which the search ends, whatever work is left.
const IDLE_ROUNDS: usize = 60;

impl State {
    /// Cuts the panels; `None` when nothing is cut. The arrangement is still the old one's.
    pub fn execute(&self, candidate: &Candidate, ground: &Ground<'_>) -> Option<State> {
        let mut next = self.clone();
        let mut gone = vec![false; self.panels.len()];
        let mut added = Vec::new();
        for (i, lines) in &candidate.lines {
            let mut parts = vec![self.panels[*i].clone()];
            for line in lines {
                let mut after = Vec::new();
                for part in parts {
                    match next.cut(&part, line, ground) {
                        Some(cut) => {
                            gone[*i] = true;
                            after.extend(cut.into_iter().map(Arc::new));
                        }
                        None => after.push(part),
                    }
                }
                parts = after;
            }
            if gone[*i] {
                added.extend(parts);
            }
        }
        if added.is_empty() {
            return None;
        }
        let mut keep = gone.iter().map(|g| !g);
        next.panels.retain(|_| keep.next().unwrap_or(true));
        next.panels.extend(added);
        Some(next)
    }

    /// Cuts one panel along a line and books the cut; `None` when there is nothing to cut.
    fn cut(&mut self, panel: &Panel, line: &Line, ground: &Ground<'_>) -> Option<Vec<Panel>> {
        let own = chords(&panel.outline, line, ground.choice.least);
        if own.is_empty() {
            return None;
        }
        let rotation = ground.sheet.raster.rotation;
        if let (Some(mesh), Some(patch)) = (&ground.mesh, &panel.patch) {
            let cut = mesh.cut(&panel.outline, patch, line, &own, ground.choice.least)?;
            self.length += 2.0 * cut.length;
            self.weighted += 2.0 * cut.weighted;
            self.cuts.push(Arc::new(Cut::Edges(cut.cuts)));
            let panel = |(outline, patch)| Panel::new(panel.chart, outline, Some(patch), rotation);
            return Some(cut.parts.into_iter().map(panel).collect());
        }
        Some(self.along(panel, line, &own, ground))
    }

    /// Cuts one panel straight along chords of a line and books the cut.
    fn along(&mut self, panel: &Panel, line: &Line, own: &[Chord], ground: &Ground<'_>) -> Vec<Panel> {
        for c in own {
            self.length += 2.0 * c.length();
            let weighted = ground.field.as_ref().map_or(c.length(), |f| f.length(panel.chart, line, c.from, c.to));
            self.weighted += 2.0 * weighted;
        }
        let parts = panel.outline.split(line, own);
        let chords = own.iter().map(|c| (c.from, c.to)).collect();
        self.cuts.push(Arc::new(Cut::Straight { chart: panel.chart, line: *line, chords }));
        let rotation = ground.sheet.raster.rotation;
        parts.into_iter().map(|o| Panel::new(panel.chart, o, None, rotation)).collect()
    }

    /// The state with one to three of its cuts taken back, or a stretch of them. Cuts that ended at one of those run on to
    /// the next border.
    fn without_some(&self, start: &State, ground: &Ground<'_>, random: &mut Random, work: &mut u64) -> Option<State> {
        let n = self.cuts.len();
        let count = 1 + random.below(n.div_ceil(2).min(4));
        let mut gone = vec![false; n];
        for _ in 0..count {
            gone[random.below(n)] = true;
        }
        let mut next = start.clone();
        for (cut, _) in self.cuts.iter().zip(&gone).filter(|(_, gone)| !**gone) {
            next.again(cut, ground);
        }
        let (arrangement, own) = ground.sheet.arrange(&next.panels, Some(self.arrangement.layout.width));
        *work += own;
        next.arrangement = arrangement?;
        Some(next)
    }

    /// Makes a straight cut again, in whatever panels its chords lie now.
    fn again(&mut self, cut: &Cut, ground: &Ground<'_>) {
        let Cut::Straight { chart, line, chords: wanted } = cut else { return };
        let mut panels = Vec::with_capacity(self.panels.len() + 1);
        for panel in std::mem::take(&mut self.panels) {
            let meant = |c: &Chord| wanted.iter().any(|(a, b)| (c.from..c.to).contains(&((a + b) * 0.5)));
            let cut = (panel.chart == *chart && panel.cuttable())
                .then(|| {
                    chords(&panel.outline, line, ground.choice.least).into_iter().filter(meant).collect::<Vec<_>>()
                })
                .filter(|own| !own.is_empty());
            match cut {
                Some(own) => panels.extend(self.along(&panel, line, &own, ground).into_iter().map(Arc::new)),
                None => panels.push(panel),
            }
        }
        self.panels = panels;
    }

    /// What the search is after: packing efficiency; where parts of the surface matter more, the score, in which cuts through them
    /// weigh.
    pub fn worth(&self, ground: &Ground<'_>, limits: &Limits) -> f64 {
        if ground.weighted { self.score(ground.unit, limits.alpha) } else { self.arrangement.efficiency }
    }

    /// The score s = p / b^alpha, b relative to the input's box (section 3.2).
    fn score(&self, unit: f64, alpha: f64) -> f64 {
        self.arrangement.efficiency / (self.weighted / unit).powf(alpha)
    }
}

/// Searches from `start`. The first round is the paper's loop: of all candidates, each executed and repacked, the one with the
/// highest score is kept, until a limit is met. A beam then carries on the best few states, with equal sets of cuts once. Further rounds begin where some cuts of a good state are taken back, until the work is spent.
///
/// # Errors
/// `canceled`.
pub(crate) fn search(start: State, ground: &Ground<'_>, limits: &Limits, context: &Context) -> Result<Found> {
    let mut found = Found { states: vec![start.clone()], stopped_by: "no_improvement", work: 0, tried: 0 };
    let mut random = Random::new(context.seed);
    let mut stopped_by = run(&start, 1, ground, limits, &mut random, &mut found, context)?;
    if limits.beam > 1 && over(&found, limits, context).is_none() {
        // The wide beam leaves work for what follows: it need not see the end.
        let half = Limits { work: found.work + (limits.work - found.work) / 2, ..limits.clone() };
        stopped_by = run(&start, limits.beam, ground, &half, &mut random, &mut found, context)?;
    }
    let mut idle = 0;
    while limits.rounds && ground.mesh.is_none() && idle < IDLE_ROUNDS {
        if let Some(limit) = over(&found, limits, context) {
            stopped_by = limit;
            break;
        }
        let cut: Vec<&State> = found.states.iter().filter(|s| !s.cuts.is_empty()).take(3).collect();
        let Some(from) = cut.get(random.below(cut.len())).map(|s| (*s).clone()) else { break };
        let Some(next) = from.without_some(&start, ground, &mut random, &mut found.work) else {
            idle += 1;
            continue;
        };
        let before = found.states[0].worth(ground, limits);
        run(&next, ROUND_BEAM, ground, limits, &mut random, &mut found, context)?;
        idle = if found.states[0].worth(ground, limits) > before + limits.gain { 0 } else { idle + 1 };
    }
    found.stopped_by = stopped_by;
    Ok(found)
}

/// The limit that was met, of those that end all rounds.
fn over(found: &Found, limits: &Limits, context: &Context) -> Option<&'static str> {
    if found.states[0].arrangement.efficiency >= limits.target {
        return Some("packing_efficiency");
    }
    if found.work >= limits.work {
        return Some("work_budget");
    }
    context.out_of_time().then_some("time_limit")
}

/// One round; why it ended.
fn run(
    start: &State,
    beam: usize,
    ground: &Ground<'_>,
    limits: &Limits,
    random: &mut Random,
    found: &mut Found,
    context: &Context,
) -> Result<&'static str> {
    let mut front = vec![start.clone()];
    keep(&mut found.states, start, ground, limits);
    let mut failures = 0;
    loop {
        context.check()?;
        if let Some(limit) = over(found, limits, context) {
            return Ok(limit);
        }
        context.step(0.1 + 0.6 * (found.work as f64 / limits.work.max(1) as f64).min(1.0), "cutting")?;
        let next = match step(&front, ground, limits, random, found, context)? {
            Ok(next) => next,
            Err(limit) => return Ok(limit),
        };
        let before = found.states[0].worth(ground, limits);
        for state in &next {
            keep(&mut found.states, state, ground, limits);
        }
        failures = if found.states[0].worth(ground, limits) > before + limits.gain { 0 } else { failures + 1 };
        // Of many panels each cut helps little.
        let patience =
            if limits.rounds { limits.patience.max(front[0].panels.len() as u32 / 8) } else { limits.patience };
        if failures >= patience {
            return Ok("no_improvement");
        }
        front = next;
        front.sort_by(|a, b| b.score(ground.unit, limits.alpha).total_cmp(&a.score(ground.unit, limits.alpha)));
        front.truncate(beam);
    }
}

/// All candidates of all states, executed and arranged; or the limit that leaves none.
fn step(
    front: &[State],
    ground: &Ground<'_>,
    limits: &Limits,
    random: &mut Random,
    found: &mut Found,
    context: &Context,
) -> Result<std::result::Result<Vec<State>, &'static str>> {
    let mut jobs: Vec<(usize, Candidate)> = Vec::new();
    for (i, state) in front.iter().enumerate() {
        jobs.extend(state.candidates(ground, random).into_iter().map(|c| (i, c)));
    }
    context.check()?;
    let executed: Vec<Option<State>> = jobs.par_iter().map(|(i, c)| front[*i].execute(c, ground)).collect();
    let mut cut: Vec<(usize, State)> = executed.into_iter().enumerate().filter_map(|(j, s)| Some((j, s?))).collect();
    let any = !cut.is_empty();
    let within = cut.len();
    cut.retain(|(_, s)| s.length <= limits.length);
    let too_long = within > cut.len();
    cut.retain(|(_, s)| s.panels.len() <= limits.charts);
    if cut.is_empty() {
        return Ok(Err(match (any, too_long) {
            (false, _) => "no_improvement",
            (true, true) => "boundary_length",
            (true, false) => "charts",
        }));
    }
    // The same cuts in another order have the same length.
    cut.sort_by(|(_, a), (_, b)| a.length.total_cmp(&b.length).then(a.panels.len().cmp(&b.panels.len())));
    cut.dedup_by(|(_, a), (_, b)| (a.length - b.length).abs() <= 1e-9 * b.length && a.panels.len() == b.panels.len());
    let mut next = arranged(cut, ground, found, context)?;
    if limits.rounds {
        let more = together(&next, &jobs, front, ground, limits);
        next.extend(arranged(more, ground, found, context)?);
    }
    Ok(if next.is_empty() { Err("no_improvement") } else { Ok(next.into_iter().map(|n| n.1).collect()) })
}

/// The states, arranged anew.
fn arranged(
    cut: Vec<(usize, State)>,
    ground: &Ground<'_>,
    found: &mut Found,
    context: &Context,
) -> Result<Vec<(usize, State)>> {
    let arranged: Vec<_> = cut
        .par_iter()
        .map(|(_, s)| {
            context.check()?;
            Ok(ground.sheet.arrange(&s.panels, Some(s.arrangement.layout.width)))
        })
        .collect::<Result<_>>()?;
    found.tried += cut.len();
    let mut next = Vec::with_capacity(cut.len());
    for ((job, mut state), (arrangement, work)) in cut.into_iter().zip(arranged) {
        found.work += work;
        if let Some(arrangement) = arrangement {
            state.arrangement = arrangement;
            next.push((job, state));
        }
    }
    Ok(next)
}

/// Several good candidates of one state at once, each in panels of its own: where charts are many, one cut at a time takes long.
fn together(
    next: &[(usize, State)],
    jobs: &[(usize, Candidate)],
    front: &[State],
    ground: &Ground<'_>,
    limits: &Limits,
) -> Vec<(usize, State)> {
    let mut lots: Vec<(usize, Candidate)> = Vec::new();
    for parent in 0..front.len().min(JOINED_PARENTS) {
        let mut own: Vec<&(usize, State)> = next.iter().filter(|(j, _)| jobs[*j].0 == parent).collect();
        let score = |s: &State| s.score(ground.unit, limits.alpha);
        own.sort_by(|a, b| score(&b.1).total_cmp(&score(&a.1)).then(a.0.cmp(&b.0)));
        let mut lines: Vec<(usize, Vec<Line>)> = Vec::new();
        let mut count = 0;
        for (job, _) in own {
            let candidate = &jobs[*job].1;
            if candidate.lines.iter().any(|(i, _)| lines.iter().any(|(j, _)| i == j)) {
                continue;
            }
            lines.extend(candidate.lines.iter().cloned());
            count += 1;
            if JOINED.contains(&count) {
                lots.push((parent, Candidate { lines: lines.clone() }));
            }
        }
    }
    lots.into_par_iter()
        .filter_map(|(parent, c)| Some((usize::MAX, front[parent].execute(&c, ground)?)))
        .filter(|(_, s)| s.length <= limits.length && s.panels.len() <= limits.charts)
        .collect()
}

/// Keeps the best states by their worth, then by length.
fn keep(best: &mut Vec<State>, state: &State, ground: &Ground<'_>, limits: &Limits) {
    let worth = |s: &State| s.worth(ground, limits);
    let same = |b: &State| (b.length - state.length).abs() <= 1e-9 * b.length && b.panels.len() == state.panels.len();
    if best.iter().any(|b| same(b) && worth(b) >= worth(state)) {
        return;
    }
    best.retain(|b| !same(b));
    let order = |a: &State, b: &State| worth(b).total_cmp(&worth(a)).then(a.length.total_cmp(&b.length));
    let place = best.partition_point(|b| order(b, state).is_le());
    if place < FINALISTS {
        best.insert(place, state.clone());
        best.truncate(FINALISTS);
    }
}
