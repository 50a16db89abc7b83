//! The stage `bounded`: Liu, Fu, Ye, Chai and Liu 2019, *Atlas Refinement with Bounded Packing Efficiency*.
//!
//! Charts become disks ([`prepare`]) and then axis-aligned ([`construct`]: target angles in [`angles`], deformation in [`deform`]); straight trails
//! divide them ([`arrangement`]), of which those are cut ([`decomposition`], [`cut`]) that let the boxes about the parts pack as tightly as is
//! asked for; then the parts take back what shape the bound allows ([`reduce`]).

mod angles;
mod arrangement;
mod chart_map;
mod construct;
mod cut;
mod decomposition;
mod deform;
mod layer;
pub mod params;
mod prepare;
mod reduce;
mod sheet;
mod subdivide;
#[cfg(test)]
mod tests;

use std::collections::BTreeSet;

use glam::DVec2;
use rayon::prelude::*;
use serde_json::{Map, Value, json};

use self::construct::{Constructed, Construction, construct};
use self::decomposition::{Goal, search};
use self::params::{Bounded, Cuts, Energy, Search};
use self::prepare::{NO_DISK, Prepared, Target, divide_fans, prepare};
use self::reduce::{Reduction, reduce};
use self::sheet::assemble;
use super::box_cutter::box_cutter;
use super::box_cutter::params::BoxCutter;
use super::optcuts::seam_length;
use super::pack::{finished, lay_out};
use super::stage::{StageInput, Staged};
use crate::atlas::bvh::Bounds;
use crate::atlas::overlap::overlaps_where;
use crate::atlas::rounding;
use crate::atlas::{
    Atlas, Charts, FaceId, HalfEdge, OverlapMode, Topology, clusters, coverage, overlaps, penetration, seams,
};
use crate::context::Context;
use crate::error::{Failure, Result, Warning};
use crate::packing::{Random, RectangleRequest};

/// What corners cost in the constructions that are tried, in parts of the square root of a chart's area: few corners first; and, last, next to none
/// but those of a rectangle.
const CORNERS: [f64; 5] = [0.02, 0.004, 0.0008, 0.08, 0.4];
/// Packing efficiency of squares beyond the bound below which gutters leave no room for cuts.
const ROOMY: f64 = 0.1;
/// Constructions, and packing efficiency beyond the bound, that are tried where gutters cost so much that the bound is missed: with fewer corners.
const WITH_GUTTERS: [(usize, f64); 4] = [(3, 0.0), (3, 0.03), (4, 0.0), (4, 0.03)];
/// What is tried: a construction, and packing efficiency of the boxes beyond the bound, which reduction may use up. In the first eight seams get longer, distortion
/// less; the others are tried at last where nothing is large. On 24 layouts, most of one chart, at a bound of .8, they take the mean growth of the seams from 45 to
/// 38 % and that of the distortion, where it grows, from .76 to .54 %.
const LADDER: [(usize, f64); 18] = [
    (0, 0.04),
    (0, 0.09),
    (1, 0.09),
    (1, 0.13),
    (2, 0.13),
    (1, 0.16),
    (2, 0.165),
    (2, 0.185),
    (0, 0.02),
    (0, 0.06),
    (0, 0.15),
    (1, 0.02),
    (1, 0.11),
    (2, 0.04),
    (2, 0.09),
    (3, 0.06),
    (3, 0.16),
    (4, 0.09),
];
/// The first of those that are tried at last.
const LAST: usize = 8;
/// Parts of sides between which trails may start where corners do not suffice for the bound, in parts of the square root of the area of all charts.
const PARTS: [f64; 3] = [0.25, 0.12, 0.06];
/// By how much, of the bound, reduction stays above it: rounding to what a file stores takes up to a twentieth of that.
const ROUNDED: f64 = 1e-4;
/// Highest packing efficiency that boxes are searched for.
const TIGHTEST: f64 = 0.985;
/// How much more distortion than in the input is no more, relative to it.
const AS_GOOD: f64 = 5e-4;
/// What more distortion than in the input counts, relative to it, in parts of the seams before; and where short seams are what is asked for.
const WORSE: f64 = 40.0;
const WORSE_FOR_SHORT: f64 = 10.0;
/// Faces above which few attempts must do: constructions with many corners, which distort least.
const LARGE: usize = 15_000;
/// Vertices that steps may have moved before something more is tried.
const WORK: u64 = 3_000_000;
/// How often charts that cannot be made axis-aligned are halved.
const HALVINGS: usize = 10;
/// How often the gutter is made wider or narrower because the sheet makes the charts smaller or larger, and how much wider than asked for it may end.
const SCALINGS: usize = 3;
const TOO_WIDE: f64 = 1.04;
/// How often an attempt is made again without the disks that could not be written.
const WRITINGS: usize = 4;
/// Overlaps that are looked for at most in the result of an attempt.
const MOST_OVERLAPS: usize = 10_000;
/// Rounds of reduction.
const ROUNDS: usize = 30;
/// With 2 steps in a round the box grows faster than limbs can spread in it (at .80 a gargoyle rises by 5.4 %, with 6 by 1.5 %).
const QUICK: Effort = Effort { steps: 6, most: 60 };
/// For the best of the attempts (of 6,000 faces in limbs .80 makes 4.1 % more distortion then, 8.1 without), where there are not very many faces.
const THOROUGH: Effort = Effort { steps: 30, most: 300 };
/// Most that is left free about rectangles, in parts of the mean side of charts: of thousands of small charts the diagonal says nothing.
const PADDED: f64 = 0.02;
/// What parts are apart in any case, in steps of texture coordinates.
const APART: f64 = 3.0;
/// Widths of the box that are tried for each division, and for the final packing.
const WIDTHS: usize = 5;
const FINAL_WIDTHS: usize = 48;

/// How long charts are relaxed: steps in a round, and in all.
#[derive(Debug, Clone, Copy)]
struct Effort {
    steps: usize,
    most: usize,
}

/// An attempt.
struct Attempt {
    /// Its place among the prices of corners, and packing efficiency of its boxes beyond the bound; none where it has more parts than corners ask for.
    rung: Option<(usize, f64)>,
    atlas: Atlas,
    /// How far its parts were apart before all was scaled.
    gap: f64,
    efficiency: f64,
    distortion: f64,
    cut: f64,
    pieces: usize,
    fallbacks: usize,
    steps: usize,
    /// Disks that stay as they were uploaded, because 32 bits cannot hold their faces where they would lie; after one run of an attempt, those that should.
    kept: BTreeSet<usize>,
}

impl Attempt {
    /// Vertices that its steps moved.
    fn work(&self) -> u64 {
        self.steps as u64 * self.atlas.uv.len() as u64
    }
}

/// What is said inside this stage when the user's limit on time ends before there is any result.
const TIME_IS_UP: &str = "the limit on time has passed";

/// Deforms, cuts, packs and relaxes. Where the limit on time ends before that has any result, charts are packed as they are.
///
/// # Errors
/// `too_large` when a chart fits on no sheet, `canceled`.
pub(crate) fn bounded(input: &StageInput<'_>, params: &Bounded) -> Result<Staged> {
    let failure = match deform_and_cut(input, params) {
        Err(failure) if failure.message == TIME_IS_UP => failure,
        done => return done,
    };
    let (packed, work) = lay_out(input, &[], &[], 1.0)?;
    let reached = efficiency(&packed);
    let bound_met = reached >= params.packing_efficiency;
    if !bound_met {
        let text = format!(
            "{} before any chart of atlas {} was cut: charts are packed as they are, at {reached:.4} ({} was asked for; a longer time_limit_s gives more)",
            failure.message, input.sheet_info.id, params.packing_efficiency
        );
        input.context.warn(Warning::new("bound_not_met", text));
    }
    let figures = Map::from_iter([
        ("work".to_owned(), Value::from(work)),
        ("packing_efficiency".to_owned(), json!(reached)),
        ("bound_met".to_owned(), json!(bound_met)),
    ]);
    Ok(finished(input, packed, "time_limit", figures))
}

/// Goes on while the job is wanted and its time is not up.
fn in_time(context: &Context) -> Result<()> {
    context.check()?;
    if context.out_of_time() { Err(Failure::internal(TIME_IS_UP)) } else { Ok(()) }
}

fn deform_and_cut(input: &StageInput<'_>, params: &Bounded) -> Result<Staged> {
    let StageInput { atlas, sheet_info, options, context, .. } = *input;
    let charts = Charts::new(&Topology::new(atlas));
    let together = clusters(atlas, &charts, options.atlas.overlaps);
    let held_charts = input.held_back(&charts, &together);
    let held: Vec<bool> = charts.of_face.iter().map(|c| held_charts[c.index()]).collect();
    let cluster: Vec<u32> = atlas
        .faces()
        .map(|f| if held[f.index()] { together.of_chart[charts.of_face[f.index()].index()] } else { NO_DISK })
        .collect();
    let bound = params.packing_efficiency;

    // What can be packed well enough as it is stays as it is.
    context.step(0.02, "packing the charts as they are")?;
    if charts.len() > 1 {
        let (packed, work) = lay_out(input, &[], &[], 1.0)?;
        let efficiency = efficiency(&packed);
        // What folds or lies on itself is not left so.
        if efficiency >= bound && overlaps(&packed, &Charts::new(&Topology::new(&packed)), 1).intra.is_empty() {
            let figures = Map::from_iter([
                ("work".to_owned(), Value::from(work)),
                ("packing_efficiency".to_owned(), json!(efficiency)),
                ("bound_met".to_owned(), json!(true)),
            ]);
            return Ok(finished(input, packed, "bound_met_as_it_is", figures));
        }
    }
    context.step(0.1, "opening charts into disks")?;
    let interrupt = || in_time(context);
    let mut prepared = prepare(atlas, &held, &interrupt)?;
    let target = match params.energy {
        Energy::Surface => Target::Surface,
        Energy::Uploaded => Target::Uploaded,
    };
    let weights = face_weights(input);
    let seams = seam_length(atlas);
    let border = border_length(atlas).max(1e-3 * bounds(atlas).length());
    let job = Job { input, params, cluster: &cluster, weights: weights.as_deref(), seams, border, target };
    let mut work = 0;
    let before = distortion_of(&prepared, target);
    // What cannot be made axis-aligned without being bent out of shape is halved until it can.
    let corner = job.first_corner();
    let construct = |prepared: &Prepared| {
        job.construct(prepared, corner, f64::INFINITY)?.ok_or_else(|| Failure::internal(TIME_IS_UP))
    };
    let mut first = construct(&prepared)?;
    let bent: Vec<usize> = first.bent().collect();
    let still_bent = |own: &Prepared| {
        let made = if context.out_of_time() { None } else { job.construct(own, corner, f64::INFINITY)? };
        Ok(made.map_or_else(Vec::new, |made| made.bent().collect()))
    };
    if !bent.is_empty() && prepared.halve_apart(&bent, HALVINGS, &still_bent)? {
        first = construct(&prepared)?;
    }
    let best = job.best(&prepared, first, before, &mut work)?;
    let kept_as_they_are = best.as_ref().map_or(0, |b| b.kept.len());
    if kept_as_they_are > 0 {
        let text = format!(
            "{kept_as_they_are} charts of atlas {} have faces so thin that deforming them would lose some: they keep their shape",
            sheet_info.id
        );
        context.warn(Warning::new("charts_kept", text));
    }
    if params.straight_cuts_alone
        && let Some(staged) = straight(input, params, best.as_ref(), seams)?
    {
        return Ok(staged);
    }
    let Some(best) = best else {
        return Ok(Staged { atlas: atlas.clone(), stopped_by: "nothing_to_pack", figures: Map::new(), kept: true });
    };
    let bound_met = best.efficiency >= bound;
    if !bound_met {
        let most = squares(&prepared, sheet::gap(input));
        let id = sheet_info.id;
        let what = match most < 1.0 {
            true => format!(
                "; squares of its charts' areas with these gutters would reach {most:.4} (a larger texture.size or a smaller pack.gutter raises that)"
            ),
            false => String::new(),
        };
        let text = format!(
            "the packing efficiency of atlas {id} is {:.4}; {bound} was asked for, and no layout that was tried reaches that{what}",
            best.efficiency
        );
        context.warn(Warning::new("bound_not_met", text));
    }
    let growth = (seams > 0.0).then(|| (seams + best.cut) / seams);
    if let (Some(most), Some(growth)) = (params.max_boundary_length, growth)
        && growth > most * (1.0 + 1e-9)
    {
        let text = format!(
            "the seams of atlas {} are {growth:.3} times as long as before; at most {most} was asked for, and the bound on packing efficiency comes first (a smaller bounded.packing_efficiency leaves shorter seams)",
            sheet_info.id
        );
        context.warn(Warning::new("boundary_limit_missed", text));
    }
    let figures = Map::from_iter([
        ("work".to_owned(), json!(work)),
        ("boundary_growth".to_owned(), json!(growth)),
        ("packing_efficiency".to_owned(), json!(best.efficiency)),
        ("bound_met".to_owned(), json!(bound_met)),
        ("packing_efficiency_of_squares".to_owned(), json!(squares(&prepared, sheet::gap(input)))),
        ("distortion_before".to_owned(), json!(before)),
        ("distortion".to_owned(), json!(best.distortion)),
        ("pieces".to_owned(), json!(best.pieces)),
        ("opened_charts".to_owned(), json!(prepared.opened)),
        ("flattened_charts".to_owned(), json!(prepared.flattened)),
        ("rectangle_fallbacks".to_owned(), json!(best.fallbacks)),
        ("charts_kept".to_owned(), json!(kept_as_they_are)),
    ]);
    let stopped_by = if bound_met { "done" } else { "bound_not_met" };
    Ok(finished(input, best.atlas, stopped_by, figures))
}

/// What straight cuts alone reach (Box Cutter), where that is the bound, with shorter seams than the best attempt.
fn straight(input: &StageInput<'_>, params: &Bounded, best: Option<&Attempt>, seams: f64) -> Result<Option<Staged>> {
    let bound = params.packing_efficiency;
    input.context.step(0.96, "trying straight cuts alone")?;
    let cuts = BoxCutter {
        max_boundary_length: params.max_boundary_length.or(Some(2.0)),
        target_packing_efficiency: Some(bound),
        ..input.options.stages.get()
    };
    let weights = input.corner_weights();
    let staged = box_cutter(input, weights.as_deref(), &cuts)?;
    let reached = efficiency(&staged.atlas);
    let own = (seam_length(&staged.atlas) - seams).max(0.0);
    let is_better = best.is_none_or(|b| b.efficiency < bound || own < b.cut);
    if reached < bound || !is_better {
        return Ok(None);
    }
    let mut figures = staged.figures;
    figures.insert("packing_efficiency".to_owned(), json!(reached));
    figures.insert("bound_met".to_owned(), json!(true));
    figures.insert("boundary_growth".to_owned(), json!((seams > 0.0).then(|| (seams + own) / seams)));
    Ok(Some(Staged { stopped_by: "straight_cuts", figures, ..staged }))
}

/// What all attempts have in common.
struct Job<'a> {
    input: &'a StageInput<'a>,
    params: &'a Bounded,
    cluster: &'a [u32],
    weights: Option<&'a [f64]>,
    /// Length of the seams before.
    seams: f64,
    /// The same with the boundary of the surface: what cuts are measured in.
    border: f64,
    target: Target,
}

impl Job<'_> {
    fn is_large(&self) -> bool {
        self.input.atlas.face_count() > LARGE && self.params.search != Search::Paper
    }

    /// The price of corners that is tried first.
    fn first_corner(&self) -> usize {
        if self.is_large() { 2 } else { 1 }
    }

    /// All disks axis-aligned, corners at the price `CORNERS[corner]`; none where time is up before they are.
    fn construct(&self, prepared: &Prepared, corner: usize, part: f64) -> Result<Option<Constructed>> {
        let how = Construction { sigma: self.params.sigma, corner: CORNERS[corner], target: self.target, part };
        match construct(prepared, &how, self.weights, &|| in_time(self.input.context)) {
            Err(failure) if failure.message == TIME_IS_UP => Ok(None),
            made => made.map(Some),
        }
    }

    /// The best of some attempts; none where there is nothing to place.
    fn best(&self, prepared: &Prepared, first: Constructed, before: f64, work: &mut u64) -> Result<Option<Attempt>> {
        let Job { params, seams, border, .. } = *self;
        let context = self.input.context;
        let bound = params.packing_efficiency;
        let area: f64 = prepared.disks.iter().map(|d| d.area).sum();
        let goal = |slack: f64| (bound + slack).min(TIGHTEST.max(bound));
        let mut constructed: [Option<Constructed>; CORNERS.len()] = [const { None }; CORNERS.len()];
        constructed[self.first_corner()] = Some(first);
        let mut attempts: Vec<Attempt> = Vec::new();
        let is_good = |a: &Attempt| a.efficiency >= bound && a.distortion <= before * (1.0 + AS_GOOD);
        // What one attempt could not write is left as it is in the next.
        let mut kept = BTreeSet::new();
        let is_paper = params.search == Search::Paper;
        // In waves, so that what is tried does not depend on the number of threads.
        let is_large = self.is_large();
        let mut wave: Vec<usize> = match (is_paper, is_large) {
            (true, _) => vec![3],
            (_, true) => vec![4, 6],
            _ => vec![1, 3],
        };
        // How far parts are apart before all is scaled: what served the attempts before is near what serves the next.
        let mut gap = sheet::gap(self.input);
        let has_gutters = gap > 0.0;
        // Where gutters leave no room for cuts, charts with few corners are what may reach the bound.
        let rounds = if has_gutters && !is_paper && squares(prepared, gap) < bound + ROOMY { 0 } else { 4 };
        for round in 0..rounds {
            for k in wave.iter().map(|k| LADDER[*k].0) {
                if constructed[k].is_none() {
                    context.step(0.15 + 0.18 * f64::from(round), "making charts axis-aligned")?;
                    constructed[k] = self.construct(prepared, k, f64::INFINITY)?;
                }
            }
            context.step(0.3 + 0.18 * f64::from(round), "dividing, packing and relaxing")?;
            let one = |k: &usize| {
                let (corner, slack) = LADDER[*k];
                let made =
                    constructed[corner].as_ref().map(|c| self.attempt(c, goal(slack), before, gap, &kept, QUICK));
                Ok(made.transpose()?.map(|made| Attempt { rung: Some(LADDER[*k]), ..made }))
            };
            let made: Vec<Attempt> =
                wave.par_iter().map(one).collect::<Result<Vec<_>>>()?.into_iter().flatten().collect();
            let good: Vec<bool> = made.iter().map(is_good).collect();
            gap = made.first().map_or(gap, |a| a.gap);
            made.iter().for_each(|a| kept.extend(&a.kept));
            for (k, a) in wave.iter().zip(&made) {
                tracing::debug!(
                    rung = k,
                    efficiency = a.efficiency,
                    distortion = a.distortion / before,
                    cut = a.cut / border,
                    "attempt"
                );
            }
            attempts.extend(made);
            // What is large gets fewer tries.
            let spent: u64 = attempts.iter().map(Attempt::work).sum();
            if is_paper || is_large || context.out_of_time() || spent >= self.input.options.work_budget.unwrap_or(WORK)
            {
                break;
            }
            // With gutters each attempt takes several times as long, and more of them gain less.
            let is_last = has_gutters && round == 2 || wave.contains(&LAST);
            if is_last {
                break;
            }
            wave = match (round, good.as_slice()) {
                (0, [true, ..]) => vec![0],
                (0, [false, true]) => vec![2],
                (0, _) => vec![4, 5],
                (1, [false, false]) => vec![6, 7],
                _ => (LAST..LADDER.len()).collect(),
            };
        }
        for (corner, slack) in WITH_GUTTERS.into_iter().filter(|_| has_gutters && !is_paper) {
            if attempts.iter().any(|a| a.efficiency >= bound) || context.out_of_time() || prepared.disks.is_empty() {
                break;
            }
            context.step(0.85, "making charts rectangles")?;
            if constructed[corner].is_none() {
                constructed[corner] = self.construct(prepared, corner, f64::INFINITY)?;
            }
            if let Some(constructed) = &constructed[corner] {
                let made = self.attempt(constructed, goal(slack), before, gap, &kept, QUICK)?;
                gap = made.gap;
                attempts.push(Attempt { rung: Some((corner, slack)), ..made });
            }
        }
        // More parts than corners ask for, where the bound is missed. With gutters these would cost more than they gain.
        for part in PARTS.into_iter().filter(|_| !has_gutters) {
            if attempts.iter().any(|a| a.efficiency >= bound) || context.out_of_time() || prepared.disks.is_empty() {
                break;
            }
            context.step(0.9, "dividing further")?;
            let Some(constructed) = self.construct(prepared, self.first_corner(), part * area.sqrt())? else { break };
            for slack in [0.01, 0.05] {
                attempts.push(self.attempt(&constructed, goal(slack), before, gap, &kept, QUICK)?);
            }
        }
        *work += attempts.iter().map(Attempt::work).sum::<u64>();
        let allowed =
            params.max_boundary_length.filter(|_| seams > 0.0).map_or(f64::INFINITY, |most| (most - 1.0) * seams);
        // The bound first, then the limit on seams, then distortion and seams together.
        let price = if params.straight_cuts_alone { WORSE_FOR_SHORT } else { WORSE };
        let value = |a: &Attempt| {
            let missing = (bound - a.efficiency).max(0.0);
            let over = (a.cut - allowed).max(0.0) / border;
            let worse = (a.distortion / before - 1.0 - AS_GOOD).max(0.0);
            (missing, over, price * worse + a.cut / border)
        };
        let better = |a: &Attempt, b: &Attempt| {
            let (a, b) = (value(a), value(b));
            a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.2.total_cmp(&b.2))
        };
        let Some(best) = attempts.into_iter().min_by(better) else { return Ok(None) };
        if is_paper || is_large || is_good(&best) || best.steps == 0 || context.out_of_time() {
            return Ok(Some(best));
        }
        let from = best.rung.and_then(|(corner, slack)| Some((constructed[corner].as_ref()?, slack)));
        let Some((constructed, slack)) = from else { return Ok(Some(best)) };
        context.step(0.95, "relaxing the best")?;
        let longer = self.attempt(constructed, goal(slack), before, best.gap, &best.kept, THOROUGH)?;
        *work += longer.work();
        Ok(Some(if better(&longer, &best).is_lt() { longer } else { best }))
    }

    /// Divides the charts of a construction, packs the parts, and relaxes them. Where all is scaled to a sheet the gutter is not scaled with it.
    /// `gap` is how far parts are apart at first.
    fn attempt(
        &self,
        constructed: &Constructed,
        goal: f64,
        before: f64,
        mut gap: f64,
        known: &BTreeSet<usize>,
        effort: Effort,
    ) -> Result<Attempt> {
        let wanted = sheet::gap(self.input);
        let mut out = known.clone();
        let mut without = (!out.is_empty()).then(|| constructed.without(&out));
        let mut kept = None;
        let (mut scalings, mut writings) = (0, 0);
        loop {
            let constructed = without.as_ref().unwrap_or(constructed);
            let (attempt, scale) = self.attempt_with_gap(constructed, goal, before, gap, effort)?;
            let is_late = self.input.context.out_of_time();
            // What is left after some tries is given back by whoever checks the result.
            if !attempt.kept.is_empty() && writings < WRITINGS && !is_late {
                out.extend(&attempt.kept);
                without = Some(constructed.without(&out));
                writings += 1;
                continue;
            }
            let is_wide = gap * scale >= wanted * (1.0 - 1e-9);
            let is_done = is_wide && gap * scale <= wanted * TOO_WIDE;
            if is_wide || kept.is_none() {
                kept = Some(Attempt { kept: out.clone(), ..attempt });
            }
            if is_done || is_late || scalings == SCALINGS {
                break;
            }
            gap = (1.01 + 0.02 * scalings as f64) * wanted / scale;
            scalings += 1;
        }
        kept.ok_or_else(|| Failure::internal("no attempt was made"))
    }

    /// An attempt with parts that are so far apart, and by what it had to be scaled for its sheet.
    fn attempt_with_gap(
        &self,
        constructed: &Constructed,
        goal: f64,
        before: f64,
        gap: f64,
        effort: Effort,
    ) -> Result<(Attempt, f64)> {
        let Job { input, params, cluster, weights, seams, border, .. } = *self;
        let context = input.context;
        let charts: Vec<_> = constructed.disks.iter().map(|d| &d.arrangement).collect();
        let diagonal = bounds(input.atlas).length();
        let sides: f64 = constructed.info.iter().map(|d| d.area.sqrt()).sum();
        let free = (params.padding * diagonal).min(PADDED * sides / constructed.info.len().max(1) as f64);
        // Layers about charts must not touch each other before anything has moved.
        let padding = (gap * sheet::WIDER * 1.01).max(free);
        let aspect = sheet::aspect(input);
        let wanted = Goal {
            efficiency: goal,
            padding,
            seams: border,
            request: RectangleRequest { turns: sheet::turns(input), aspect, widths: WIDTHS },
            tries: params.candidates as usize,
            is_published: params.search == Search::Paper,
        };
        let mut mesh = constructed.mesh.clone();
        let mut labels = constructed.labels.clone();
        if let Some(chosen) = search(&charts, &wanted, &mut Random::stream(context.seed, 0)) {
            for ((own, division), d) in constructed.disks.iter().zip(&chosen.divisions).zip(0..) {
                context.check()?;
                match params.cuts {
                    Cuts::Straight => {
                        cut::cut_chart(&mut mesh, &own.map, &own.arrangement, division, &mut labels, d);
                    }
                    Cuts::Edges => {
                        let faces = &constructed.info[d as usize].faces;
                        cut::cut_along_edges(&mut mesh, &own.map, &own.arrangement, division, faces);
                    }
                }
            }
        }
        // What lies in two parts must not hang together.
        divide_fans(&mut mesh, &[]);
        let final_request = RectangleRequest { widths: FINAL_WIDTHS, ..wanted.request };
        let mut packed = sheet::pack(&mesh, &labels, constructed, cluster, weights, [padding, gap], &final_request);
        let mut steps = 0;
        let mut distortion = packed.charts.energy();
        if !params.keep_mapping {
            let goal = Reduction {
                efficiency: (params.packing_efficiency * (1.0 + ROUNDED)).min(1.0),
                // Weighted, the distortion is another measure than that of the input.
                enough: if params.stop_at_input && weights.is_none() { before } else { 0.0 },
                // Rounding must not bring together what is apart.
                gap: gap.max(APART / rounding::STEPS * packed.charts.bounds().size().max_element()),
                rounds: ROUNDS,
                steps: effort.steps,
                most: effort.most,
            };
            let reduced = reduce(&mut packed.charts, &goal, &|| context.check(), &|| context.out_of_time())?;
            (steps, distortion) = (reduced.steps, reduced.energy);
        }
        let efficiency = packed.charts.efficiency();
        let pieces = packed.pieces.len();
        let fallbacks = constructed.disks.iter().filter(|d| d.is_fallback).count();
        let cut = (seam_length(mesh.atlas()) - seams).max(0.0);
        let (mut atlas, mut scale) = assemble(input, &mesh, &packed);
        let mut is_out = sheet::round(&mut atlas, &mesh, &labels, constructed, &packed);
        if is_out.contains(&true) && sheet::widen(&mut packed) {
            (atlas, scale) = assemble(input, &mesh, &packed);
            is_out = sheet::round(&mut atlas, &mesh, &labels, constructed, &packed);
        }
        // Nor may any lie on another, or on itself.
        for (f, g) in overlapping(&atlas) {
            for d in [f, g].map(|f| labels.disk[f.index()]) {
                if let Some(own) = is_out.get_mut(d as usize) {
                    *own = true;
                }
            }
        }
        let kept = constructed.number.iter().zip(is_out).filter(|(_, is_out)| *is_out).map(|(k, _)| *k).collect();
        Ok((Attempt { rung: None, atlas, gap, efficiency, distortion, cut, pieces, fallbacks, steps, kept }, scale))
    }
}

/// By face of the input: how much it matters, 1 on average; none where the options say nothing.
fn face_weights(input: &StageInput<'_>) -> Option<Vec<f64>> {
    let own: Vec<f64> = input.corner_weights()?.iter().map(|w| w.iter().sum::<f64>().max(3e-3) / 3.0).collect();
    let area = |f: FaceId| input.atlas.area(f);
    let (sum, total) = input.atlas.faces().fold((0.0, 0.0), |(s, t), f| (s + own[f.index()] * area(f), t + area(f)));
    let mean = sum / total;
    (mean.is_finite() && mean > 0.0).then(|| own.iter().map(|w| w / mean).collect())
}

/// Packing efficiency of squares with the charts' areas, that far apart and without a loss beside: what is above it needs fewer charts, or more texels.
fn squares(prepared: &Prepared, gap: f64) -> f64 {
    let (area, boxes) = prepared
        .disks
        .iter()
        .fold((0.0, 0.0), |(area, boxes), d| (area + d.area, boxes + (d.area.sqrt() + gap).powi(2)));
    if boxes > 0.0 { area / boxes } else { 1.0 }
}

/// The distortion of all disks as they are, by their area.
fn distortion_of(prepared: &Prepared, target: Target) -> f64 {
    let own: Vec<(f64, f64)> = prepared
        .disks
        .par_iter()
        .filter_map(|d| {
            let map = prepared.map(d, target)?;
            let energy = map.distortion();
            energy.is_finite().then_some((energy * d.area, d.area))
        })
        .collect();
    let (sum, area) = own.iter().fold((0.0, 0.0), |(s, a), (x, y)| (s + x, a + y));
    if area > 0.0 { sum / area } else { 1.0 }
}

/// Length of the borders of all charts on the surface, each edge once.
fn border_length(atlas: &Atlas) -> f64 {
    let topology = Topology::new(atlas);
    let is_counted = |h: &HalfEdge| topology.is_border(*h) && topology.across_seam(*h).is_none_or(|twin| *h < twin);
    topology.half_edges().filter(is_counted).fold(0.0, |sum, h| sum + seams::length(atlas, h))
}

/// Area covered over area of the box about all charts, over all pages.
fn efficiency(atlas: &Atlas) -> f64 {
    let mut boxes = 0.0;
    for page in 0..atlas.sheets.len() {
        let points =
            atlas.faces().filter(|f| usize::from(atlas.page[f.index()]) == page).flat_map(|f| atlas.uv_triangle(f));
        boxes += Bounds::around(points).size().element_product();
    }
    let charts = Charts::new(&Topology::new(atlas));
    let apart = clusters(atlas, &charts, OverlapMode::Separate);
    coverage(atlas, &charts, &apart).covered / boxes
}

/// Pairs of faces that overlap by more than rounding makes of faces that touch.
fn overlapping(atlas: &Atlas) -> Vec<(FaceId, FaceId)> {
    let longest = atlas.sheets.iter().flatten().copied().max().unwrap_or(1);
    let rounding = APART / rounding::STEPS * f64::from(longest);
    let deep = |f, g| penetration(&atlas.uv_triangle(f), &atlas.uv_triangle(g)) > rounding;
    overlaps_where(atlas, MOST_OVERLAPS, deep).0
}

/// Sides of the box about the layout.
fn bounds(atlas: &Atlas) -> DVec2 {
    let points = atlas.corners.iter().flatten().map(|u| atlas.uv[u.index()]);
    Bounds::around(points).size()
}
