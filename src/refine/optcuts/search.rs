//! The search for short seams within a bound on the distortion.
//!
//! [`Search::run_as_published`], in a file of its own, is Algorithm 1. [`Search::run`] uses the same operations in another order: cut where that pays most until the bound holds
//! ([`Search::descend`]), close what the bound does not need ([`Search::trim`]), and then again and again open a part of the seams and let both find
//! a better way ([`Search::improve`]).

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec2;
use rayon::prelude::*;

use super::cut_map::CutMap;
use super::operations::{Candidate, Operation};
use super::params::Quality;
use super::start::{extremum, path_to_border};
use crate::atlas::groups::{Cost, sorted_unique};
use crate::atlas::{HalfEdge, Mark, UvId};
use crate::error::Result;
use crate::numeric::newton::Step;
use crate::packing::Random;

/// How far below the bound the dual aims.
pub(super) const SLACK: f64 = 1e-3;
/// The dual at first, in parts of what the first map misses the bound by, where eq. 7 would have it at 1. On 22 surfaces 1, 5, 10 and 40 give seams of .945, .912,
/// .922 and .947 of the published program's.
const FIRST_DUAL: f64 = 5.0;
/// Vertices within so many edges of an operation move in its local steps.
const RINGS: usize = 6;
/// Part of the border vertices that are asked for splits, as an exponent (section 5.3).
pub(super) const BORDER_PART: f64 = 0.8;
/// The same for the vertices inside, at first.
const INTERIOR_PART: f64 = 0.6;
/// Work of opening seams again, in parts of the work before: `balanced` takes so much for one face, and less the more there are.
const BALANCED: f64 = 3000.0;
/// The same for `best`, whatever the size.
const BEST: f64 = 4.0;
/// What a map that is polished is taken to have cost, in vertices that were moved, for each that there is. A search from scratch takes some 600;
/// polishing has nothing else to do.
const FOUND: u64 = 2400;
/// The same as `BALANCED` for `fast`, which opens seams only where all that there is to do is to polish.
const FAST_POLISH: f64 = 0.05;
/// How much estimates are shaken while seams are cut again.
const NOISE: f64 = 0.5;
/// Seams that get longer than this while they are cut again are given up.
const LONGER: f64 = 1.03;
/// Faces for which all vertices are moved after each operation; with more, after every other, and so on.
const LARGE: u64 = 8000;
/// Faces for which one more operation is carried out in a round, and most of these.
const SHARE: usize = 2000;
const MOST_AT_ONCE: usize = 16;
/// Rounds without progress, which is so much of what is missing, until a cut to the extremum is made; and how many such cuts in a row may not help.
const PATIENCE: u64 = 25;
const PROGRESS: f64 = 1e-3;
const STALLS: u32 = 8;
/// Vertices that a search moves at most, in parts of those that there are: what has not ended by then ends with its best. Small surfaces may take more.
const MOST_WORK: u64 = 2000;
const FREE_WORK: u64 = 5_000_000;
/// Most cuts to extrema, and how near the bound they lead: beyond, local operations are better.
const EXTREMA: usize = 500;
const NEARLY: f64 = 0.1;

/// A map that was visited.
#[derive(Debug, Clone)]
pub(super) struct Visited {
    pub map: CutMap,
    pub seam: f64,
    pub distortion: f64,
}

/// A state that can be gone back to.
struct Saved {
    mark: Mark,
    x: Vec<DVec2>,
    borders: Vec<HalfEdge>,
    distortion: f64,
}

/// What is known of the operations at a vertex, as long as its star keeps its shape.
#[derive(Debug, Clone)]
struct Known {
    star: Vec<(HalfEdge, f32, f32)>,
    /// (operation, change of E_s, change of E_d).
    found: Vec<(Operation, f64, f64)>,
}

/// The search of one piece.
pub(super) struct Search<'a> {
    pub(super) map: CutMap,
    pub(super) bound: f64,
    /// The dual variable.
    pub(super) lambda: f64,
    /// E_d of the map.
    pub(super) distortion: f64,
    /// The feasible map of the shortest seams, or the one of least distortion.
    pub best: Option<Visited>,
    interrupt: &'a (dyn Fn() -> Result<bool> + Sync),
    /// Whether only operations of the paper are used.
    pub(super) published: bool,
    pub interrupted: bool,
    /// Vertices that were moved, over all steps.
    pub work: u64,
    /// How many may be.
    budget: u64,
    /// Until which round an operation is not to be tried.
    tabu: BTreeMap<Operation, u64>,
    pub(super) round: u64,
    known: [Vec<Option<Known>>; 2],
    /// What estimates are shaken by, where they are.
    noise: Option<u64>,
    random: Random,
}

impl<'a> Search<'a> {
    /// Of a valid map, with a bound on E_d, a seed and a budget of work.
    pub fn new(
        map: CutMap,
        bound: f64,
        random: Random,
        budget: Option<u64>,
        interrupt: &'a (dyn Fn() -> Result<bool> + Sync),
    ) -> Self {
        let distortion = map.distortion();
        Search {
            map,
            bound,
            lambda: 0.0,
            distortion,
            best: None,
            interrupt,
            published: false,
            interrupted: false,
            work: 0,
            budget: budget.unwrap_or(u64::MAX),
            tabu: BTreeMap::new(),
            round: 0,
            known: [Vec::new(), Vec::new()],
            noise: None,
            random,
        }
    }

    /// Whether to end with what there is.
    pub(super) fn stop(&mut self) -> Result<bool> {
        self.interrupted = self.interrupted || (self.interrupt)()?;
        let most = (MOST_WORK * self.map.x.len() as u64).max(FREE_WORK);
        Ok(self.interrupted || self.work >= self.budget.min(most))
    }

    /// The limit of the user's that has ended the search, if one has.
    pub(super) fn stopped_by(&self) -> Option<&'static str> {
        if self.interrupted { Some("time_limit") } else { (self.work >= self.budget).then_some("work_budget") }
    }

    /// Steps of the whole map until they gain less than a part of the energy: at most so many of Newton's, each followed by so many of L-BFGS.
    pub fn relax(&mut self, enough: f64, most: usize, more: usize) -> Result<()> {
        for _ in 0..most {
            if self.stop()? {
                break;
            }
            self.work += self.map.x.len() as u64;
            let Some(step) = self.map.global_steps(1 + more) else { break };
            let now = self.map.distortion();
            let gained = self.distortion - now;
            self.distortion = now;
            if step.alpha == 0.0 || gained.abs() < enough * now * step.alpha {
                break;
            }
        }
        Ok(())
    }

    /// Relaxes lightly, and well where it decides whether the bound holds.
    fn settle(&mut self) -> Result<()> {
        self.relax(1e-4, 1, 1)?;
        if self.distortion > self.bound && self.distortion < self.bound + SLACK {
            self.relax(1e-6, 6, 0)?;
        }
        Ok(())
    }

    /// Notes the map if it is the best so far.
    pub fn visit(&mut self) -> bool {
        let (seam, distortion) = (self.map.seam_length(), self.distortion);
        let better = match &self.best {
            None => true,
            Some(best) if best.distortion > self.bound => distortion < best.distortion,
            Some(best) => distortion <= self.bound && seam < best.seam - 1e-9,
        };
        if better {
            let mut map = self.map.clone();
            map.mesh.forget();
            self.best = Some(Visited { map, seam, distortion });
        }
        better
    }

    fn save(&mut self) -> Saved {
        let mark = self.map.mesh.mark();
        Saved { mark, x: self.map.x.clone(), borders: self.map.borders.clone(), distortion: self.distortion }
    }

    fn restore(&mut self, saved: &Saved) {
        self.map.mesh.undo(saved.mark);
        self.map.x.clone_from(&saved.x);
        self.map.borders.clone_from(&saved.borders);
        self.distortion = saved.distortion;
    }

    fn is_free(&self, operation: &Operation) -> bool {
        self.tabu.get(operation).is_none_or(|until| *until < self.round)
    }

    /// Border splits, merges and ears, or interior splits: the operations with what each changes.
    pub(super) fn operations(&mut self, interior: bool, part: f64) -> Vec<(Operation, f64, f64)> {
        let map = &self.map;
        let mut is_border = vec![false; map.x.len()];
        map.borders.iter().flat_map(|h| map.mesh.uv_ends(*h)).for_each(|u| is_border[u.index()] = true);
        let all = (0..map.x.len()).filter(|&u| is_border[u] != interior).map(UvId::new);
        let vertices: Vec<UvId> = all.filter(|u| map.mesh.corners_of(*u).next().is_some()).collect();
        let mut ranked: Vec<(Cost, UvId)> = vertices.iter().map(|u| (Cost(-map.deviation(*u)), *u)).collect();
        ranked.sort_unstable();
        ranked.truncate((vertices.len() as f64).powf(part).ceil() as usize);
        let known = &mut self.known[usize::from(interior)];
        known.resize(map.x.len().max(known.len()), None);
        let fresh: Vec<(UvId, Option<Known>)> = ranked
            .par_iter()
            .map(|&(_, u)| {
                let star: Vec<(HalfEdge, f32, f32)> = map
                    .fan(u)
                    .corners
                    .iter()
                    .map(|c| {
                        let [a, b, c3] = [*c, c.next(), c.previous()].map(|h| map.x[map.mesh.uv_at(h).index()]);
                        (*c, a.distance(b) as f32, b.distance(c3) as f32)
                    })
                    .collect();
                let same = |k: &Known| {
                    k.star.len() == star.len()
                        && k.star.iter().zip(&star).all(|(p, q)| {
                            p.0 == q.0 && (p.1 - q.1).abs() < 0.02 * q.1 && (p.2 - q.2).abs() < 0.02 * q.2
                        })
                };
                if known[u.index()].as_ref().is_some_and(same) {
                    return (u, None);
                }
                let mut out = Vec::new();
                if interior {
                    map.interior_splits(u, &mut out)
                } else {
                    map.boundary_splits(u, &mut out)
                }
                let found = out.iter().map(|c| (c.operation, c.seam, c.energy)).collect();
                (u, Some(Known { star, found }))
            })
            .collect();
        let mut out = Vec::new();
        for (u, new) in fresh {
            if let Some(new) = new {
                known[u.index()] = Some(new);
            }
            out.extend(known[u.index()].iter().flat_map(|k| k.found.iter().copied()));
        }
        if !interior {
            out.extend(self.closings().iter().map(|c| (c.operation, c.seam, c.energy)));
        }
        out.retain(|(operation, ..)| self.is_free(operation));
        if let Some(salt) = self.noise {
            for (operation, _, energy) in &mut out {
                *energy *= 1.0 + NOISE * (Random::stream(salt, key(*operation)).unit() - 0.5);
            }
        }
        out
    }

    /// The border's vertices, ascending.
    fn border_vertices(&self) -> Vec<UvId> {
        sorted_unique(self.map.borders.iter().map(|h| self.map.mesh.uv_at(*h)))
    }

    /// What makes seams shorter: merges, and ears, which the paper does not have.
    fn closings(&self) -> Vec<Candidate> {
        let map = &self.map;
        let mut all: Vec<Candidate> = self.border_vertices().par_iter().filter_map(|u| map.merge(*u)).collect();
        if !self.published {
            all.extend(map.borders.par_iter().filter_map(|h| map.ear(*h)).collect::<Vec<_>>());
        }
        all
    }

    /// The operation that lowers the Lagrangian most, as things are now.
    pub(super) fn seed(&mut self, operations: &[(Operation, f64, f64)]) -> Option<Candidate> {
        let gain = |o: &(Operation, f64, f64)| Cost(o.1 + self.lambda * o.2);
        let mut best: Vec<_> = operations.iter().filter(|o| gain(o).0 < 0.0).collect();
        best.sort_by_key(|o| (gain(o), o.0));
        let found = best.iter().take(4).filter_map(|o| self.map.query(o.0));
        found.filter(|c| c.gain(self.lambda) < 0.0).min_by_key(|c| (Cost(c.gain(self.lambda)), c.operation))
    }

    /// Cuts, and closes what costs more than it is worth, until the bound holds.
    fn descend(&mut self, most: usize, longest: f64) -> Result<()> {
        let mut tight = false;
        let mut part = INTERIOR_PART;
        // The least E_d so far, when it was reached, and how often nothing but a cut to the extremum helped.
        let (mut lowest, mut since, mut stalls) = (self.distortion, self.round, 0);
        // The least value of the Lagrangian with this dual.
        let (mut lambda, mut least) = (self.lambda, f64::INFINITY);
        for _ in 0..most {
            self.round += 1;
            if self.distortion <= self.bound || self.map.seam_length() > longest || self.stop()? {
                return Ok(());
            }
            let value = self.map.seam_length() + self.lambda * self.distortion;
            if self.distortion < lowest - PROGRESS * (lowest - self.bound) {
                (lowest, since, stalls) = (self.distortion, self.round, 0);
            } else if lambda == self.lambda && value < least - PROGRESS * self.bound {
                (least, since) = (value, self.round);
            } else if lambda != self.lambda {
                (lambda, least) = (self.lambda, value);
            } else if self.round > since + PATIENCE {
                stalls += 1;
                since = self.round;
                if stalls > STALLS || !self.cut_to_extremum()? {
                    return Ok(());
                }
            }
            let mut border = self.operations(false, BORDER_PART);
            let mut seed = self.seed(&border);
            if seed.is_none() {
                let interior = self.operations(true, part);
                seed = self.seed(&interior);
                if seed.is_none() && !tight {
                    self.relax(1e-5, 5, 1)?;
                    tight = true;
                    continue;
                }
                if seed.is_none() {
                    // Nothing pays: the dual rises until something does.
                    let all: Vec<_> = border.iter().copied().chain(interior).collect();
                    match cheapest(&all) {
                        Some(worth) => self.lambda = self.lambda.max(worth) * 1.05,
                        None if part < 1.0 => part += 0.1,
                        None => return Ok(()),
                    }
                    seed = self.seed(&all);
                }
            }
            tight = false;
            let Some(seed) = seed else { continue };
            let first = seed.operation;
            self.propagate(seed, None)?;
            // On a large map others are far enough away to be carried out at once, if they still pay.
            let others = (self.map.rest.len() / SHARE).min(MOST_AT_ONCE);
            let gain = |o: &(Operation, f64, f64)| Cost(o.1 + self.lambda * o.2);
            border.retain(|o| gain(o).0 < 0.0 && o.0 != first);
            border.sort_unstable_by_key(|o| (gain(o), o.0));
            for (operation, ..) in border.into_iter().take(others) {
                if self.distortion <= self.bound {
                    break;
                }
                if let Some(next) = self.map.query(operation).filter(|c| c.gain(self.lambda) < 0.0) {
                    self.propagate(next, None)?;
                }
            }
            // Of a large map a step of all costs much, and one operation moves little of it.
            let every = 1 + self.map.rest.len() as u64 / LARGE;
            if self.round.is_multiple_of(every) || self.distortion < self.bound + SLACK {
                self.settle()?;
            }
        }
        Ok(())
    }

    /// Closes tips of seams and shortens them as long as the bound holds.
    fn trim(&mut self) -> Result<()> {
        if self.distortion > self.bound {
            return Ok(());
        }
        self.relax(1e-5, 2, 1)?;
        let mut failed = 0;
        let mut refused: BTreeSet<Operation> = BTreeSet::new();
        while failed < 4 && !self.stop()? {
            self.round += 1;
            let mut all = self.closings();
            all.retain(|c| c.seam < 0.0 && !refused.contains(&c.operation));
            let next = all
                .into_iter()
                .min_by_key(|c| (Cost(if c.energy <= 0.0 { c.seam - 1e9 } else { c.energy / -c.seam }), c.operation));
            let Some(next) = next else { break };
            let operation = next.operation;
            let saved = self.save();
            let seam = self.map.seam_length();
            self.propagate(next, Some(0))?;
            if self.distortion > self.bound {
                self.settle()?;
            }
            if self.distortion > self.bound || self.map.seam_length() >= seam {
                self.restore(&saved);
                refused.insert(operation);
                failed += 1;
            } else {
                failed = 0;
            }
        }
        Ok(())
    }

    /// Opens a part of the seams: closes a random tip for some edges.
    fn ruin(&mut self) -> Result<()> {
        let mut merges: Vec<Candidate> = self.border_vertices().iter().filter_map(|u| self.map.merge(*u)).collect();
        if merges.is_empty() {
            return Ok(());
        }
        let merge = merges.swap_remove(self.random.below(merges.len()));
        let most = 2 + (self.random.unit().powi(2) * (self.map.borders.len() as f64 / 4.0)) as usize;
        self.propagate(merge, Some(most))
    }

    /// The search; the map must be valid. With `polish` the seams that it has are worth as much as those of a search from scratch.
    ///
    /// # Errors
    /// `canceled`.
    pub fn run(&mut self, quality: Quality, polish: bool) -> Result<&'static str> {
        self.relax(1e-4, 100, 1)?;
        self.visit();
        let trials = match quality {
            Quality::Fast => {
                self.cut_to_extrema()?;
                if polish { FAST_POLISH } else { 0.0 }
            }
            Quality::Balanced => (BALANCED / self.map.rest.len() as f64).clamp(0.1, 1.5),
            Quality::Best => BEST,
        };
        self.lambda = FIRST_DUAL * (self.distortion - self.bound).max(0.0);
        self.descend(usize::MAX, f64::INFINITY)?;
        self.trim()?;
        self.visit();
        if self.distortion > self.bound {
            return Ok(self.stopped_by().unwrap_or("no_improvement"));
        }
        if self.lambda == 0.0 {
            // The bound held from the start, and nothing has told what a cut is worth.
            let all = [self.operations(false, BORDER_PART), self.operations(true, INTERIOR_PART)].concat();
            self.lambda = cheapest(&all).unwrap_or(0.0);
        }
        let found = if polish { FOUND * self.map.x.len() as u64 } else { 0 };
        let most = self.work + (trials * self.work.max(found) as f64) as u64;
        self.improve(most)?;
        Ok(self.stopped_by().unwrap_or("done"))
    }

    /// Opens parts of the seams again and keeps what gets no longer by it, until so much work is done.
    fn improve(&mut self, most: u64) -> Result<()> {
        let lambda = self.lambda;
        let mut current = self.map.seam_length();
        while self.work < most && !self.stop()? {
            let (saved, before) = (self.save(), self.work);
            self.ruin()?;
            self.noise = Some(self.random.next());
            self.lambda = lambda * (0.2 + 0.8 * self.random.unit());
            self.descend(40, LONGER * current)?;
            self.noise = None;
            self.trim()?;
            let seam = self.map.seam_length();
            if self.distortion <= self.bound && seam <= current {
                current = seam;
                self.visit();
            } else {
                self.restore(&saved);
            }
            self.map.mesh.forget();
            // Where nothing is left to be opened, nothing is done.
            if self.work == before {
                break;
            }
        }
        Ok(())
    }

    /// The fast variant (section 7.3, after Gu et al. 2002): shortest cuts from the worst vertex to the border until the bound nearly holds.
    fn cut_to_extrema(&mut self) -> Result<()> {
        for _ in 0..EXTREMA {
            if self.distortion <= self.bound + NEARLY || self.stop()? || !self.cut_to_extremum()? {
                return Ok(());
            }
            self.visit();
        }
        Ok(())
    }

    /// One such cut; false where there is none.
    fn cut_to_extremum(&mut self) -> Result<bool> {
        let Some(path) = extremum(&self.map).and_then(|worst| path_to_border(&self.map, worst)) else {
            return Ok(false);
        };
        let (mut active, mut tails) = (Vec::new(), Vec::new());
        for edge in path {
            let Some(split) = self.map.query(Operation::BoundarySplit(edge)) else { break };
            if self.carry_out(&split, &mut active, &mut tails).is_none() {
                break;
            }
        }
        self.distortion = self.map.distortion();
        self.relax(1e-3, 2, 1)?;
        Ok(!active.is_empty())
    }

    /// Rounds of choosing an operation.
    pub fn rounds(&self) -> u64 {
        self.round
    }

    /// Carries an operation on as long as that pays, in turn with steps of the positions about it (section 5.4). With `most`, whether it pays
    /// or not for so many times more.
    pub(super) fn propagate(&mut self, seed: Candidate, most: Option<usize>) -> Result<()> {
        let mut next = Some(seed);
        let mut active: Vec<UvId> = Vec::new();
        let mut tails = Vec::new();
        let mut operation = Operation::Merge(HalfEdge(0));
        let mut forced = most.unwrap_or(0);
        for _ in 0..200 {
            if self.stop()? {
                break;
            }
            let applied = next.is_some();
            let step = match next.take() {
                Some(candidate) => {
                    operation = candidate.operation;
                    self.carry_out(&candidate, &mut active, &mut tails)
                }
                None => self.local_step(&active),
            };
            let Some(step) = step else { break };
            let gained = step.before - step.after;
            let ways = self.map.continued(operation, &tails);
            if most.is_some() {
                if forced > 0 {
                    next = ways.into_iter().min_by_key(|c| (Cost(c.energy), c.operation));
                    forced -= 1;
                }
            } else {
                let delta = -self.lambda * gained;
                let best = ways
                    .into_iter()
                    .filter(|c| self.is_free(&c.operation))
                    .min_by_key(|c| (Cost(c.gain(self.lambda)), c.operation));
                next = best.filter(|c| c.gain(self.lambda) < delta.min(0.0));
            }
            if next.is_none()
                && (step.alpha == 0.0 || (!applied && gained < 1e-4 * step.alpha.max(1e-3) * step.before.max(1e-3)))
            {
                break;
            }
        }
        self.distortion = self.map.distortion();
        Ok(())
    }

    /// Applies an operation and takes a step about it. Where something would lie on something else, the new vertices are put closer to where they were; where that
    /// does not help, nothing is changed.
    fn carry_out(&mut self, candidate: &Candidate, active: &mut Vec<UvId>, tails: &mut Vec<UvId>) -> Option<Step> {
        let parts: &[f64] = if matches!(candidate.operation, Operation::Merge(_) | Operation::Ear(_)) {
            &[1.0]
        } else {
            &[1.0, 0.2, 0.03]
        };
        for part in parts {
            let saved = self.save();
            let mut placed = candidate.clone();
            for (corner, at) in &mut placed.places {
                *at = saved.x[self.map.mesh.uv_at(*corner).index()].lerp(*at, *part);
            }
            let ends = self.map.apply(&placed);
            let n = active.len();
            active.extend(candidate.places.iter().map(|(c, _)| self.map.mesh.uv_at(*c)));
            if candidate.places.is_empty() {
                active.extend(&ends);
            }
            if let Some(step) = self.local_step(active) {
                *tails = ends;
                return Some(step);
            }
            active.truncate(n);
            self.restore(&saved);
        }
        self.tabu.insert(candidate.operation, self.round + 40);
        None
    }

    fn local_step(&mut self, active: &[UvId]) -> Option<Step> {
        let step = self.map.local_step(active, RINGS);
        self.work += self.map.moved() as u64;
        step
    }
}

/// The least length of seam that an operation takes for what it removes of the distortion.
fn cheapest(operations: &[(Operation, f64, f64)]) -> Option<f64> {
    let worth = operations.iter().filter(|o| o.2 < 0.0 && o.1 > 0.0).map(|o| o.1 / -o.2);
    worth.min_by_key(|r| Cost(*r))
}

/// A number for an operation.
fn key(operation: Operation) -> u64 {
    let (kind, a, b) = match operation {
        Operation::BoundarySplit(h) => (1, h.0, 0),
        Operation::InteriorSplit(a, b) => (2, a.0, b.0),
        Operation::Merge(h) => (3, h.0, 0),
        Operation::Ear(h) => (4, h.0, 0),
    };
    (kind << 60) ^ (u64::from(a) << 30) ^ u64::from(b)
}
