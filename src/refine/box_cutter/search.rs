//! The search for cuts: candidates from void boxes, each executed and repacked, the best kept (Box Cutter, section 3.2).

use std::sync::Arc;

use rayon::prelude::*;

use super::arrange::{Arrangement, Sheet};
use super::candidates::{Candidate, CandidateParams};
use super::edges::EdgeCutter;
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
pub(crate) struct SearchState {
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
pub(crate) struct SearchContext<'a> {
    /// How panels are arranged.
    pub sheet: Sheet,
    /// How candidates are chosen.
    pub candidates: CandidateParams,
    /// Importance, where cuts are straight.
    pub field: Option<Field>,
    /// Where cuts follow the edges of the mesh.
    pub edges: Option<EdgeCutter<'a>>,
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
pub(crate) struct SearchResult {
    /// The best states within the limits, best first; the start among them when nothing is better.
    pub states: Vec<SearchState>,
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

impl SearchState {
    /// Cuts the panels; `None` when nothing is cut. The arrangement is still the old one's.
    pub fn execute(&self, candidate: &Candidate, search_context: &SearchContext<'_>) -> Option<SearchState> {
        let mut next = self.clone();
        let mut gone = vec![false; self.panels.len()];
        let mut added = Vec::new();
        for (i, lines) in &candidate.lines {
            let mut parts = vec![self.panels[*i].clone()];
            for line in lines {
                let mut after = Vec::new();
                for part in parts {
                    match next.cut(&part, line, search_context) {
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
    fn cut(&mut self, panel: &Panel, line: &Line, search_context: &SearchContext<'_>) -> Option<Vec<Panel>> {
        let own = chords(&panel.outline, line, search_context.candidates.least);
        if own.is_empty() {
            return None;
        }
        let rotation = search_context.sheet.raster.rotation;
        if let (Some(edges), Some(patch)) = (&search_context.edges, &panel.patch) {
            let cut = edges.cut(&panel.outline, patch, line, &own, search_context.candidates.least)?;
            self.length += 2.0 * cut.length;
            self.weighted += 2.0 * cut.weighted;
            self.cuts.push(Arc::new(Cut::Edges(cut.cuts)));
            let panel = |(outline, patch)| Panel::new(panel.chart, outline, Some(patch), rotation);
            return Some(cut.parts.into_iter().map(panel).collect());
        }
        Some(self.along(panel, line, &own, search_context))
    }

    /// Cuts one panel straight along chords of a line and books the cut.
    fn along(&mut self, panel: &Panel, line: &Line, own: &[Chord], search_context: &SearchContext<'_>) -> Vec<Panel> {
        for c in own {
            self.length += 2.0 * c.length();
            let weighted =
                search_context.field.as_ref().map_or(c.length(), |f| f.length(panel.chart, line, c.from, c.to));
            self.weighted += 2.0 * weighted;
        }
        let parts = panel.outline.split(line, own);
        let chords = own.iter().map(|c| (c.from, c.to)).collect();
        self.cuts.push(Arc::new(Cut::Straight { chart: panel.chart, line: *line, chords }));
        let rotation = search_context.sheet.raster.rotation;
        parts.into_iter().map(|o| Panel::new(panel.chart, o, None, rotation)).collect()
    }

    /// The state with one to three of its cuts taken back, or a stretch of them. Cuts that ended at one of those run on to
    /// the next border.
    fn without_some(
        &self,
        start: &SearchState,
        search_context: &SearchContext<'_>,
        random: &mut Random,
        work: &mut u64,
    ) -> Option<SearchState> {
        let n = self.cuts.len();
        let count = 1 + random.below(n.div_ceil(2).min(4));
        let mut gone = vec![false; n];
        for _ in 0..count {
            gone[random.below(n)] = true;
        }
        let mut next = start.clone();
        for (cut, _) in self.cuts.iter().zip(&gone).filter(|(_, gone)| !**gone) {
            next.again(cut, search_context);
        }
        let (arrangement, own) = search_context.sheet.arrange(&next.panels, Some(self.arrangement.layout.width));
        *work += own;
        next.arrangement = arrangement?;
        Some(next)
    }

    /// Makes a straight cut again, in whatever panels its chords lie now.
    fn again(&mut self, cut: &Cut, search_context: &SearchContext<'_>) {
        let Cut::Straight { chart, line, chords: wanted } = cut else { return };
        let mut panels = Vec::with_capacity(self.panels.len() + 1);
        for panel in std::mem::take(&mut self.panels) {
            let meant = |c: &Chord| wanted.iter().any(|(a, b)| (c.from..c.to).contains(&((a + b) * 0.5)));
            let cut = (panel.chart == *chart && panel.cuttable())
                .then(|| {
                    chords(&panel.outline, line, search_context.candidates.least)
                        .into_iter()
                        .filter(meant)
                        .collect::<Vec<_>>()
                })
                .filter(|own| !own.is_empty());
            match cut {
                Some(own) => panels.extend(self.along(&panel, line, &own, search_context).into_iter().map(Arc::new)),
                None => panels.push(panel),
            }
        }
        self.panels = panels;
    }

    /// What the search is after: packing efficiency; where parts of the surface matter more, the score, in which cuts through them
    /// weigh.
    pub fn worth(&self, search_context: &SearchContext<'_>, limits: &Limits) -> f64 {
        if search_context.weighted {
            self.score(search_context.unit, limits.alpha)
        } else {
            self.arrangement.efficiency
        }
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
pub(crate) fn search(
    start: SearchState,
    search_context: &SearchContext<'_>,
    limits: &Limits,
    context: &Context,
) -> Result<SearchResult> {
    let mut found = SearchResult { states: vec![start.clone()], stopped_by: "no_improvement", work: 0, tried: 0 };
    let mut random = Random::new(context.seed);
    let mut stopped_by = run(&start, 1, search_context, limits, &mut random, &mut found, context)?;
    if limits.beam > 1 && over(&found, limits, context).is_none() {
        // The wide beam leaves work for what follows: it need not see the end.
        let half = Limits { work: found.work + (limits.work - found.work) / 2, ..limits.clone() };
        stopped_by = run(&start, limits.beam, search_context, &half, &mut random, &mut found, context)?;
    }
    let mut idle = 0;
    while limits.rounds && search_context.edges.is_none() && idle < IDLE_ROUNDS {
        if let Some(limit) = over(&found, limits, context) {
            stopped_by = limit;
            break;
        }
        let cut: Vec<&SearchState> = found.states.iter().filter(|s| !s.cuts.is_empty()).take(3).collect();
        let Some(from) = cut.get(random.below(cut.len())).map(|s| (*s).clone()) else { break };
        let Some(next) = from.without_some(&start, search_context, &mut random, &mut found.work) else {
            idle += 1;
            continue;
        };
        let before = found.states[0].worth(search_context, limits);
        run(&next, ROUND_BEAM, search_context, limits, &mut random, &mut found, context)?;
        idle = if found.states[0].worth(search_context, limits) > before + limits.gain { 0 } else { idle + 1 };
    }
    found.stopped_by = stopped_by;
    Ok(found)
}

/// The limit that was met, of those that end all rounds.
fn over(found: &SearchResult, limits: &Limits, context: &Context) -> Option<&'static str> {
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
    start: &SearchState,
    beam: usize,
    search_context: &SearchContext<'_>,
    limits: &Limits,
    random: &mut Random,
    found: &mut SearchResult,
    context: &Context,
) -> Result<&'static str> {
    let mut front = vec![start.clone()];
    keep(&mut found.states, start, search_context, limits);
    let mut failures = 0;
    loop {
        context.check()?;
        if let Some(limit) = over(found, limits, context) {
            return Ok(limit);
        }
        context.step(0.1 + 0.6 * (found.work as f64 / limits.work.max(1) as f64).min(1.0), "cutting")?;
        let next = match step(&front, search_context, limits, random, found, context)? {
            Ok(next) => next,
            Err(limit) => return Ok(limit),
        };
        let before = found.states[0].worth(search_context, limits);
        for state in &next {
            keep(&mut found.states, state, search_context, limits);
        }
        failures = if found.states[0].worth(search_context, limits) > before + limits.gain { 0 } else { failures + 1 };
        // Of many panels each cut helps little.
        let patience =
            if limits.rounds { limits.patience.max(front[0].panels.len() as u32 / 8) } else { limits.patience };
        if failures >= patience {
            return Ok("no_improvement");
        }
        front = next;
        front.sort_by(|a, b| {
            b.score(search_context.unit, limits.alpha).total_cmp(&a.score(search_context.unit, limits.alpha))
        });
        front.truncate(beam);
    }
}

/// All candidates of all states, executed and arranged; or the limit that leaves none.
fn step(
    front: &[SearchState],
    search_context: &SearchContext<'_>,
    limits: &Limits,
    random: &mut Random,
    found: &mut SearchResult,
    context: &Context,
) -> Result<std::result::Result<Vec<SearchState>, &'static str>> {
    let mut jobs: Vec<(usize, Candidate)> = Vec::new();
    for (i, state) in front.iter().enumerate() {
        jobs.extend(state.candidates(search_context, random).into_iter().map(|c| (i, c)));
    }
    context.check()?;
    let executed: Vec<Option<SearchState>> =
        jobs.par_iter().map(|(i, c)| front[*i].execute(c, search_context)).collect();
    let mut cut: Vec<(usize, SearchState)> =
        executed.into_iter().enumerate().filter_map(|(j, s)| Some((j, s?))).collect();
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
    let mut next = arranged(cut, search_context, found, context)?;
    if limits.rounds {
        let more = together(&next, &jobs, front, search_context, limits);
        next.extend(arranged(more, search_context, found, context)?);
    }
    Ok(if next.is_empty() { Err("no_improvement") } else { Ok(next.into_iter().map(|n| n.1).collect()) })
}

/// The states, arranged anew.
fn arranged(
    cut: Vec<(usize, SearchState)>,
    search_context: &SearchContext<'_>,
    found: &mut SearchResult,
    context: &Context,
) -> Result<Vec<(usize, SearchState)>> {
    let arranged: Vec<_> = cut
        .par_iter()
        .map(|(_, s)| {
            context.check()?;
            Ok(search_context.sheet.arrange(&s.panels, Some(s.arrangement.layout.width)))
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
    next: &[(usize, SearchState)],
    jobs: &[(usize, Candidate)],
    front: &[SearchState],
    search_context: &SearchContext<'_>,
    limits: &Limits,
) -> Vec<(usize, SearchState)> {
    let mut lots: Vec<(usize, Candidate)> = Vec::new();
    for parent in 0..front.len().min(JOINED_PARENTS) {
        let mut own: Vec<&(usize, SearchState)> = next.iter().filter(|(j, _)| jobs[*j].0 == parent).collect();
        let score = |s: &SearchState| s.score(search_context.unit, limits.alpha);
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
        .filter_map(|(parent, c)| Some((usize::MAX, front[parent].execute(&c, search_context)?)))
        .filter(|(_, s)| s.length <= limits.length && s.panels.len() <= limits.charts)
        .collect()
}

/// Keeps the best states by their worth, then by length.
fn keep(best: &mut Vec<SearchState>, state: &SearchState, search_context: &SearchContext<'_>, limits: &Limits) {
    let worth = |s: &SearchState| s.worth(search_context, limits);
    let same =
        |b: &SearchState| (b.length - state.length).abs() <= 1e-9 * b.length && b.panels.len() == state.panels.len();
    if best.iter().any(|b| same(b) && worth(b) >= worth(state)) {
        return;
    }
    best.retain(|b| !same(b));
    let order = |a: &SearchState, b: &SearchState| worth(b).total_cmp(&worth(a)).then(a.length.total_cmp(&b.length));
    let place = best.partition_point(|b| order(b, state).is_le());
    if place < FINALISTS {
        best.insert(place, state.clone());
        best.truncate(FINALISTS);
    }
}
