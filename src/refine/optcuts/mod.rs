//! The stage `optcuts`: Li, Kaufman, Kim, Solomon and Sheffer 2018, *OptCuts: Joint Optimization of Surface Cuts and Parameterization*.
//!
//! A surface of any kind is divided into pieces that can be flattened ([`pieces`]); each is cut and flattened by itself
//! ([`solver`]), from the uploaded charts where these are to be polished ([`uploaded`]); the charts of all are packed ([`assemble`]).

mod assemble;
mod cut_map;
mod judge;
mod operations;
pub mod params;
mod pieces;
mod published;
mod search;
mod solver;
mod start;
mod stencil;
#[cfg(test)]
mod tests;
mod uploaded;

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;
use serde_json::{Map, Value, json};

use self::assemble::{Solved, assemble};
use self::judge::mended;
use self::params::{ISOMETRIC, MOST, MaxDistortion, OptCuts, Start};
pub(super) use self::pieces::seam_length;
use self::pieces::{Piece, Strain, all_apart, divide, is_degenerate, surface_area};
use self::solver::{Settings, Solution, solve};
use super::pack::finished;
use super::stage::{self, StageInput, Staged};
use crate::atlas::{Atlas, Charts, FaceId, Topology};
use crate::error::{Code, Result, Warning};

/// Bound where that of the input is asked for and there is no layout.
const USUAL_BOUND: f64 = 4.1;
/// The least distance of a bound from [`ISOMETRIC`]: what is computed is never quite isometric.
const LEAST_DISTORTION: f64 = 1e-4;
/// Least importance that is told from none at all.
const LEAST_IMPORTANCE: f64 = 0.01;
/// Importance from which on nothing is cut where it can be helped.
const FORBIDDEN: f64 = 1e6;
/// Reasons to end that are limits of the user's.
const LIMITS: [&str; 2] = ["time_limit", "work_budget"];
/// Part of the stage's progress that the pieces are.
const SOLVING: f64 = 0.85;

/// Cuts, flattens and packs.
///
/// # Errors
/// `too_large` when a chart fits on no sheet, `canceled`.
pub(crate) fn optcuts(input: &StageInput<'_>, params: &OptCuts) -> Result<Staged> {
    let StageInput { atlas, sheet_info, context, .. } = *input;
    // A texel cannot show two places.
    let params = &OptCuts { bijective: params.bijective || !sheet_info.is_virtual, ..params.clone() };
    let kept = |stopped_by| Staged { atlas: atlas.clone(), stopped_by, figures: Map::new(), kept: true };
    if !atlas.has_layout() && params.start == Start::Uploaded {
        let text = format!(
            "atlas {} has no texture coordinates to start from: it stays as it is (set optcuts.start to \"auto\", or take the recipe unwrap, to make some)",
            sheet_info.id
        );
        context.warn(Warning::new("no_layout", text));
        return Ok(kept("no_layout"));
    }
    context.step(0.0, "dividing the surface")?;
    let held = uploaded::held_back(input, params);
    let degenerate: Vec<bool> = atlas.faces().map(|f| is_degenerate(atlas.triangle(f))).collect();
    let wanted: Vec<bool> = held.iter().zip(&degenerate).map(|(held, flat)| !held && !flat).collect();
    let division = divide(atlas, &wanted);
    let layout = uploaded::layout(input, params, &wanted)?;
    let source = layout.as_ref().map_or(atlas, |l| &l.atlas);
    let fits = |faces: &[FaceId]| layout.as_ref().is_some_and(|l| !faces.iter().any(|f| l.unfit[f.index()]));
    let pieces = division.build(source, &fits);
    if pieces.is_empty() {
        let text = format!(
            "no face of atlas {} can be cut or flattened: it stays as it is (its faces have no area, or share texels, which atlas.overlaps \"separate\" takes apart)",
            sheet_info.id
        );
        context.warn(Warning::new("nothing_to_cut", text));
        return Ok(kept("nothing_to_cut"));
    }

    let count = pieces.len();
    let outcomes = solve_all(input, params, pieces)?;
    let (mut figures, stopped_by) = sum(&outcomes, params);
    let left = outcomes.iter().fold(0.0, |sum, o| sum + o.solution.seam_length);
    let solved: Vec<Solved> =
        outcomes.into_iter().map(|o| Solved { piece: o.piece, atlas: o.solution.atlas }).collect();
    let (next, packing) = assemble(input, &solved, &held, params.quality)?;

    let share = |of: &[bool]| {
        let own = atlas.faces().filter(|f| of[f.index()]).fold(0.0, |sum, f| sum + atlas.area(f));
        own / surface_area(atlas).max(1e-300)
    };
    let held_back = share(&held);
    let unit = (surface_area(atlas) / std::f64::consts::PI).sqrt();
    let before = atlas.has_layout().then(|| seam_length(atlas) / unit);
    let work = figures.get("work").and_then(Value::as_u64).unwrap_or(0);
    let count_of = |of: &[bool]| of.iter().filter(|x| **x).count();
    figures.extend([
        ("work".to_owned(), json!(work + packing)),
        ("pieces".to_owned(), json!(count)),
        ("charts".to_owned(), json!(Charts::new(&Topology::new(&next)).len())),
        ("seam_length_before".to_owned(), json!(before)),
        ("seam_length".to_owned(), json!(seam_length(&next) / unit)),
        ("seam_length_in_pieces".to_owned(), json!(left / unit)),
        ("non_manifold_edges".to_owned(), json!(division.faults.non_manifold_edges)),
        ("winding_edges".to_owned(), json!(division.faults.winding_edges)),
        ("doubled_vertices".to_owned(), json!(division.faults.doubled_vertices)),
        ("segmented".to_owned(), json!(division.faults.segmented)),
        ("degenerate_faces".to_owned(), json!(count_of(&degenerate))),
        ("repaired_charts".to_owned(), json!(layout.as_ref().map_or(0, |l| l.repaired))),
        ("held_back".to_owned(), json!(held_back)),
    ]);
    if held_back > 0.0 {
        context.warn(stage::held_back_warning(input, held_back, "surface", "cut"));
    }
    if figures["bound_met"] == false {
        let text = format!(
            "the distortion of atlas {} is {:.4}, in some part above what was asked for (more is tried with optcuts.quality \"best\"; a larger optcuts.max_distortion allows it)",
            sheet_info.id,
            figures["symmetric_dirichlet"].as_f64().unwrap_or(f64::NAN)
        );
        context.warn(Warning::new("bound_not_met", text));
    }
    Ok(finished(input, next, stopped_by, figures))
}

/// A piece and what became of it.
struct Outcome {
    piece: Piece,
    bound: f64,
    area: f64,
    solution: Solution,
}

/// Solves the pieces, the largest first, and gives them in their order.
fn solve_all(input: &StageInput<'_>, params: &OptCuts, pieces: Vec<Piece>) -> Result<Vec<Outcome>> {
    let context = input.context;
    let corner_weights = input.corner_weights();
    let least =
        corner_weights.iter().flatten().flatten().map(|w| w.max(LEAST_IMPORTANCE)).fold(f64::INFINITY, f64::min);
    let area = |p: &Piece| surface_area(&p.atlas);
    let total: f64 = pieces.iter().map(area).sum();
    let done = Mutex::new(0.0);
    let message = if pieces.len() == 1 { "cutting" } else { "cutting the pieces" };
    let mut queue: Vec<(usize, Piece)> = pieces.into_iter().enumerate().collect();
    queue.sort_by_key(|(i, p)| (std::cmp::Reverse(p.faces.len()), *i));
    let one = |(i, piece): (usize, Piece)| {
        context.check()?;
        let weights = corner_weights.as_ref().map(|own| vertex_weights(&piece, own, least));
        let own = area(&piece);
        let (bound, solution) = solve_one(input, params, &piece, weights.as_deref())?;
        let mut done = done.lock().unwrap_or_else(PoisonError::into_inner);
        *done += own;
        // Faces that are pieces by themselves may be many, and take no time.
        if piece.faces.len() > 1 {
            context.step(SOLVING * *done / total, message)?;
        }
        Ok((i, Outcome { piece, bound, area: own, solution }))
    };
    let mut solved = queue.into_par_iter().with_max_len(1).map(one).collect::<Result<Vec<_>>>()?;
    solved.sort_by_key(|(i, _)| *i);
    Ok(solved.into_iter().map(|(_, outcome)| outcome).collect())
}

/// The weights of a piece's vertices, of those of corners: 1 is the least of all, infinity forbids.
fn vertex_weights(piece: &Piece, corners: &[[f64; 3]], least: f64) -> Vec<f64> {
    let mut sums = vec![(0.0, 0u32); piece.vertices.len()];
    for (f, triangle) in piece.faces.iter().zip(&piece.atlas.surface.triangles) {
        for (v, w) in triangle.iter().zip(corners[f.index()]) {
            let own = &mut sums[v.index()];
            *own = (own.0 + w, own.1 + 1);
        }
    }
    let weight = |(sum, count): (f64, u32)| {
        let mean = sum / f64::from(count.max(1));
        if mean >= FORBIDDEN { f64::INFINITY } else { (mean.max(LEAST_IMPORTANCE) / least).max(1.0) }
    };
    sums.into_iter().map(weight).collect()
}

/// Solves a piece; gives its bound too.
fn solve_one(
    input: &StageInput<'_>,
    params: &OptCuts,
    piece: &Piece,
    weights: Option<&[f64]>,
) -> Result<(f64, Solution)> {
    let context = input.context;
    let start = piece.atlas.has_layout().then(|| Strain::of(&piece.atlas).energy());
    let bound = match params.max_distortion {
        MaxDistortion::AtMost(bound) => bound,
        MaxDistortion::Input => {
            let uploaded = start.or_else(|| uploaded_energy(input.atlas, &piece.faces));
            uploaded.filter(|e| e.is_finite()).unwrap_or(USUAL_BOUND)
        }
    };
    let bound = bound.clamp(ISOMETRIC + LEAST_DISTORTION, MOST);
    if piece.faces.len() == 1 {
        // Nothing is to be searched for.
        return Ok((bound, unsearched(all_apart(&piece.atlas), bound, "done")));
    }
    let settings = Settings {
        bound,
        bijective: params.bijective,
        quality: params.quality,
        search: params.search,
        polish: start.is_some(),
        seed: context.seed,
        // Each piece its part.
        budget: input
            .options
            .work_budget
            .map(|all| (all as f64 * piece.faces.len() as f64 / input.atlas.face_count() as f64) as u64),
    };
    let interrupt = || {
        context.check()?;
        Ok(context.out_of_time())
    };
    let wrong = match solve(piece.atlas.clone(), weights, &settings, &interrupt) {
        Ok(solution) => match mended(&piece.atlas, solution, params.bijective) {
            Ok(solution) => return Ok((bound, solution)),
            Err(what) => what,
        },
        Err(failure) if failure.code == Code::Canceled => return Err(failure),
        Err(failure) => failure.message,
    };
    let (what, atlas) = match start {
        Some(_) => ("the uploaded charts", piece.atlas.clone()),
        None => ("a chart for each face", all_apart(&piece.atlas)),
    };
    let text = format!(
        "a connected part of atlas {} with {} faces could not be laid out ({wrong}): it comes as {what}, and the rest as asked for (optcuts.quality \"best\" tries more)",
        input.sheet_info.id,
        piece.faces.len()
    );
    context.warn(Warning::new("piece_reverted", text));
    Ok((bound, unsearched(atlas, bound, "reverted")))
}

/// A layout that no search was needed for.
fn unsearched(atlas: Atlas, bound: f64, stopped_by: &'static str) -> Solution {
    let distortion = Strain::of(&atlas).energy();
    let (seam_length, bound_met) = (seam_length(&atlas), distortion <= bound * (1.0 + 1e-9));
    Solution { atlas, distortion, seam_length, bound_met, stopped_by, iterations: 0, work: 0, detached: 0 }
}

/// The energy of the uploaded layout of some faces, at the scale at which it is least.
fn uploaded_energy(atlas: &Atlas, faces: &[FaceId]) -> Option<f64> {
    atlas.has_layout().then(|| Strain::of(&atlas.subset(faces)).least_energy())
}

/// What the report says of the pieces, and why they ended: the limit that cut one short, or what holds for the most of them.
fn sum(outcomes: &[Outcome], params: &OptCuts) -> (Map<String, Value>, &'static str) {
    let total: f64 = outcomes.iter().map(|o| o.area).sum();
    let mean = |of: &dyn Fn(&Outcome) -> f64| outcomes.iter().map(|o| of(o) * (o.area / total)).sum::<f64>();
    let mut reasons: BTreeMap<&'static str, f64> = BTreeMap::new();
    for o in outcomes {
        *reasons.entry(o.solution.stopped_by).or_default() += o.area;
    }
    // A limit that cut any piece short is what users want to know of.
    let limited = reasons.keys().any(|reason| LIMITS.contains(reason));
    let reasons = reasons.into_iter().filter(|(reason, _)| !limited || LIMITS.contains(reason));
    let most = reasons.reduce(|a, b| if b.1 > a.1 { b } else { a });
    let bound = match params.max_distortion {
        MaxDistortion::AtMost(bound) => bound,
        MaxDistortion::Input => mean(&|o| o.bound),
    };
    let figures = Map::from_iter([
        ("max_distortion".to_owned(), json!(bound)),
        ("symmetric_dirichlet".to_owned(), json!(mean(&|o| o.solution.distortion))),
        ("bound_met".to_owned(), json!(outcomes.iter().all(|o| o.solution.bound_met))),
        ("iterations".to_owned(), json!(outcomes.iter().map(|o| o.solution.iterations).sum::<u64>())),
        ("work".to_owned(), json!(outcomes.iter().map(|o| o.solution.work).sum::<u64>())),
        ("pieces_reverted".to_owned(), json!(outcomes.iter().filter(|o| o.solution.stopped_by == "reverted").count())),
        ("detached_faces".to_owned(), json!(outcomes.iter().map(|o| o.solution.detached).sum::<usize>())),
        ("polished_pieces".to_owned(), json!(outcomes.iter().filter(|o| o.piece.density.is_some()).count())),
    ]);
    (figures, most.map_or("done", |m| m.0))
}
