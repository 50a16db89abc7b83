//! The search for cuts: candidates from void boxes, each executed and repacked, the best kept (Box Cutter, section 3.2).

use std::sync::Arc;

use rayon::prelude::*;

use super::arrange::{Arrangement, Sheet};
use super::candidates::Candidate;
use super::edges::EdgeCutter;
use super::field::Field;
use super::lines::chords;
use super::outline::{Chord, Line};
use super::panel::Panel;
use super::params::{BoxCutter, Search};
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
    /// How candidates are chosen, and what is preferred.
    pub params: &'a BoxCutter,
    /// Smallest extent of a panel, in texels.
    pub least: f64,
    /// Importance, where cuts are straight.
    pub field: Option<Field>,
    /// Where cuts follow the edges of the mesh.
    pub edges: Option<EdgeCutter<'a>>,
    /// Longest side of the input's bounding box, in texels: the unit of boundary length.
    pub unit: f64,
    /// Whether there is any importance.
    pub weighted: bool,
    /// When the search ends.
    pub limits: Limits,
    /// Progress, cancellation, seed and clock.
    pub context: &'a Context,
}

impl SearchContext<'_> {
    /// Whether more is done than is published.
    pub fn is_beam(&self) -> bool {
        self.params.search == Search::Beam
    }
}

/// When a search ends.
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
    pub fn execute(&self, candidate: &Candidate, search: &SearchContext<'_>) -> Option<SearchState> {
        let mut next = self.clone();
        let mut gone = vec![false; self.panels.len()];
        let mut added = Vec::new();
        for (i, lines) in &candidate.lines {
            let mut parts = vec![self.panels[*i].clone()];
            for line in lines {
                let mut after = Vec::new();
                for part in parts {
                    match next.cut(&part, line, search) {
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
    fn cut(&mut self, panel: &Panel, line: &Line, search: &SearchContext<'_>) -> Option<Vec<Panel>> {
        let own = chords(&panel.outline, line, search.least);
        if own.is_empty() {
            return None;
        }
        let rotation = search.sheet.raster.rotation;
        if let (Some(edges), Some(patch)) = (&search.edges, &panel.patch) {
            let cut = edges.cut(&panel.outline, patch, line, &own, search.least)?;
            self.length += 2.0 * cut.length;
            self.weighted += 2.0 * cut.weighted;
            self.cuts.push(Arc::new(Cut::Edges(cut.cuts)));
            let part = |(outline, patch)| panel.part(outline, Some(patch), rotation);
            return Some(cut.parts.into_iter().map(part).collect());
        }
        Some(self.along(panel, line, &own, search))
    }

    /// Cuts one panel straight along chords of a line and books the cut.
    fn along(&mut self, panel: &Panel, line: &Line, own: &[Chord], search: &SearchContext<'_>) -> Vec<Panel> {
        for c in own {
            self.length += 2.0 * c.length();
            let weighted = search.field.as_ref().map_or(c.length(), |f| f.length(panel.chart, line, c.from, c.to));
            self.weighted += 2.0 * weighted;
        }
        let parts = panel.outline.split(line, own);
        let chords = own.iter().map(|c| (c.from, c.to)).collect();
        self.cuts.push(Arc::new(Cut::Straight { chart: panel.chart, line: *line, chords }));
        let rotation = search.sheet.raster.rotation;
        parts.into_iter().map(|o| panel.part(o, None, rotation)).collect()
    }

    /// The state with one to three of its cuts taken back, or a stretch of them. Cuts that ended at one of those run on to
    /// the next border.
    fn without_some(&self, start: &SearchState, own: &mut CutSearch<'_>) -> Option<SearchState> {
        let CutSearch { context: search, random, found } = own;
        let n = self.cuts.len();
        let count = 1 + random.below(n.div_ceil(2).min(4));
        let mut gone = vec![false; n];
        for _ in 0..count {
            gone[random.below(n)] = true;
        }
        let mut next = start.clone();
        for (cut, _) in self.cuts.iter().zip(&gone).filter(|(_, gone)| !**gone) {
            next.again(cut, search);
        }
        let (arrangement, work) =
            search.sheet.arrange(&next.panels, Some(self.arrangement.layout.width), search.context);
        found.work += work;
        next.arrangement = arrangement?;
        Some(next)
    }

    /// Makes a straight cut again, in whatever panels its chords lie now.
    fn again(&mut self, cut: &Cut, search: &SearchContext<'_>) {
        let Cut::Straight { chart, line, chords: wanted } = cut else { return };
        let mut panels = Vec::with_capacity(self.panels.len() + 1);
        for panel in std::mem::take(&mut self.panels) {
            let meant = |c: &Chord| wanted.iter().any(|(a, b)| (c.from..c.to).contains(&((a + b) * 0.5)));
            let own = if panel.chart == *chart && panel.cuttable() {
                chords(&panel.outline, line, search.least).into_iter().filter(meant).collect()
            } else {
                Vec::new()
            };
            if own.is_empty() {
                panels.push(panel);
            } else {
                panels.extend(self.along(&panel, line, &own, search).into_iter().map(Arc::new));
            }
        }
        self.panels = panels;
    }

    /// What the search is after: packing efficiency; where parts of the surface matter more, the score, in which cuts through them
    /// weigh.
    pub fn worth(&self, search: &SearchContext<'_>) -> f64 {
        if search.weighted { self.score(search) } else { self.arrangement.efficiency }
    }

    /// The score s = p / b^alpha, b relative to the input's box (section 3.2).
    fn score(&self, search: &SearchContext<'_>) -> f64 {
        self.arrangement.efficiency / (self.weighted / search.unit).powf(search.params.alpha)
    }

    /// Whether the cuts may be the same: in another order they have the same length.
    fn is_like(&self, other: &SearchState) -> bool {
        (self.length - other.length).abs() <= 1e-9 * self.length && self.panels.len() == other.panels.len()
    }
}

/// Searches from `start`. The first round is the paper's loop: of all candidates, each executed and repacked, the one with the
/// highest score is kept, until a limit is met. A beam then carries on the best few states, with equal sets of cuts once. Further rounds begin where some cuts of a good state are taken back, until the work is spent.
///
/// # Errors
/// `canceled`.
pub(crate) fn search(start: SearchState, context: &SearchContext<'_>) -> Result<SearchResult> {
    let found = SearchResult { states: vec![start.clone()], stopped_by: "no_improvement", work: 0, tried: 0 };
    let mut own = CutSearch { context, random: Random::new(context.context.seed), found };
    let most = context.limits.work;
    let mut stopped_by = own.run(&start, 1, most)?;
    let beam = if context.is_beam() { context.params.beam as usize } else { 1 };
    if beam > 1 && own.over(most).is_none() {
        // The wide beam leaves work for what follows: it need not see the end.
        stopped_by = own.run(&start, beam, own.found.work + (most - own.found.work) / 2)?;
    }
    let mut idle = 0;
    while context.is_beam() && context.edges.is_none() && idle < IDLE_ROUNDS {
        if let Some(limit) = own.over(most) {
            stopped_by = limit;
            break;
        }
        let cut: Vec<&SearchState> = own.found.states.iter().filter(|s| !s.cuts.is_empty()).take(3).collect();
        let Some(from) = cut.get(own.random.below(cut.len())).map(|s| (*s).clone()) else { break };
        let Some(next) = from.without_some(&start, &mut own) else {
            idle += 1;
            continue;
        };
        let before = own.best();
        own.run(&next, ROUND_BEAM, most)?;
        idle = if own.best() > before + context.params.min_improvement { 0 } else { idle + 1 };
    }
    Ok(SearchResult { stopped_by, ..own.found })
}

/// A search under way.
struct CutSearch<'a> {
    context: &'a SearchContext<'a>,
    random: Random,
    found: SearchResult,
}

impl CutSearch<'_> {
    /// Worth of the best state.
    fn best(&self) -> f64 {
        self.found.states[0].worth(self.context)
    }

    /// The limit that was met, of those that end all rounds; `most` is that on work.
    fn over(&self, most: u64) -> Option<&'static str> {
        if self.found.states[0].arrangement.efficiency >= self.context.limits.target {
            return Some("packing_efficiency");
        }
        if self.found.work >= most {
            return Some("work_budget");
        }
        self.context.context.out_of_time().then_some("time_limit")
    }

    /// One round, within so much work; why it ended.
    fn run(&mut self, start: &SearchState, beam: usize, most: u64) -> Result<&'static str> {
        let SearchContext { params, context, .. } = *self.context;
        let mut front = vec![start.clone()];
        self.keep(start);
        let mut failures = 0;
        loop {
            context.check()?;
            if let Some(limit) = self.over(most) {
                return Ok(limit);
            }
            context.step(0.1 + 0.6 * (self.found.work as f64 / most.max(1) as f64).min(1.0), "cutting")?;
            let next = match self.step(&front)? {
                Ok(next) => next,
                Err(limit) => return Ok(limit),
            };
            let before = self.best();
            next.iter().for_each(|state| self.keep(state));
            failures = if self.best() > before + params.min_improvement { 0 } else { failures + 1 };
            // Of many panels each cut helps little.
            let least = if self.context.is_beam() { front[0].panels.len() as u32 / 8 } else { 0 };
            if failures >= params.patience.max(least) {
                return Ok("no_improvement");
            }
            front = next;
            front.sort_by(|a, b| b.score(self.context).total_cmp(&a.score(self.context)));
            front.truncate(beam);
        }
    }

    /// All candidates of all states, executed and arranged; or the limit that leaves none.
    fn step(&mut self, front: &[SearchState]) -> Result<std::result::Result<Vec<SearchState>, &'static str>> {
        let search = self.context;
        let mut jobs: Vec<(usize, Candidate)> = Vec::new();
        // When time is up, what was not looked at yet counts as of no use.
        let is_late = || search.context.out_of_time();
        for (i, state) in front.iter().enumerate() {
            search.context.check()?;
            if is_late() {
                break;
            }
            jobs.extend(state.candidates(search, &mut self.random).into_iter().map(|c| (i, c)));
        }
        let execute = |(i, c): &(usize, Candidate)| {
            search.context.check()?;
            Ok(if is_late() { None } else { front[*i].execute(c, search) })
        };
        let executed: Vec<Option<SearchState>> = jobs.par_iter().map(execute).collect::<Result<_>>()?;
        let mut cut: Vec<(usize, SearchState)> =
            executed.into_iter().enumerate().filter_map(|(j, s)| Some((j, s?))).collect();
        if cut.is_empty() && is_late() {
            return Ok(Err("time_limit"));
        }
        let any = !cut.is_empty();
        let within = cut.len();
        cut.retain(|(_, s)| s.length <= search.limits.length);
        let too_long = within > cut.len();
        cut.retain(|(_, s)| s.panels.len() <= search.limits.charts);
        if cut.is_empty() {
            return Ok(Err(match (any, too_long) {
                (false, _) => "no_improvement",
                (true, true) => "boundary_length",
                (true, false) => "charts",
            }));
        }
        cut.sort_by(|(_, a), (_, b)| a.length.total_cmp(&b.length).then(a.panels.len().cmp(&b.panels.len())));
        cut.dedup_by(|(_, a), (_, b)| b.is_like(a));
        let mut next = self.arranged(cut)?;
        if is_late() {
            return Ok(if next.is_empty() { Err("time_limit") } else { Ok(next.into_iter().map(|n| n.1).collect()) });
        }
        if search.is_beam() {
            let more = together(&next, &jobs, front, search);
            next.extend(self.arranged(more)?);
        }
        Ok(if next.is_empty() { Err("no_improvement") } else { Ok(next.into_iter().map(|n| n.1).collect()) })
    }

    /// The states, arranged anew.
    fn arranged(&mut self, cut: Vec<(usize, SearchState)>) -> Result<Vec<(usize, SearchState)>> {
        let search = self.context;
        let arranged: Vec<_> = cut
            .par_iter()
            .map(|(_, s)| {
                search.context.check()?;
                Ok(search.sheet.arrange(&s.panels, Some(s.arrangement.layout.width), search.context))
            })
            .collect::<Result<_>>()?;
        self.found.tried += cut.len();
        let mut next = Vec::with_capacity(cut.len());
        for ((job, mut state), (arrangement, work)) in cut.into_iter().zip(arranged) {
            self.found.work += work;
            if let Some(arrangement) = arrangement {
                state.arrangement = arrangement;
                next.push((job, state));
            }
        }
        Ok(next)
    }

    /// Keeps the best states by their worth, then by length.
    fn keep(&mut self, state: &SearchState) {
        let worth = |s: &SearchState| s.worth(self.context);
        let best = &mut self.found.states;
        if best.iter().any(|b| b.is_like(state) && worth(b) >= worth(state)) {
            return;
        }
        best.retain(|b| !b.is_like(state));
        let order =
            |a: &SearchState, b: &SearchState| worth(b).total_cmp(&worth(a)).then(a.length.total_cmp(&b.length));
        let place = best.partition_point(|b| order(b, state).is_le());
        if place < FINALISTS {
            best.insert(place, state.clone());
            best.truncate(FINALISTS);
        }
    }
}

/// Several good candidates of one state at once, each in panels of its own: where charts are many, one cut at a time takes long.
fn together(
    next: &[(usize, SearchState)],
    jobs: &[(usize, Candidate)],
    front: &[SearchState],
    search: &SearchContext<'_>,
) -> Vec<(usize, SearchState)> {
    let mut lots: Vec<(usize, Candidate)> = Vec::new();
    for parent in 0..front.len().min(JOINED_PARENTS) {
        let mut own: Vec<&(usize, SearchState)> = next.iter().filter(|(j, _)| jobs[*j].0 == parent).collect();
        own.sort_by(|a, b| b.1.score(search).total_cmp(&a.1.score(search)).then(a.0.cmp(&b.0)));
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
        .filter_map(|(parent, c)| Some((usize::MAX, front[parent].execute(&c, search)?)))
        .filter(|(_, s)| s.length <= search.limits.length && s.panels.len() <= search.limits.charts)
        .collect()
}
