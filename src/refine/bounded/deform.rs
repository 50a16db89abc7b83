//! Deformation of a chart until its boundary is axis-aligned (section 3.1.2, Algorithm 1), and flattening.

use std::f64::consts::FRAC_PI_2;

use glam::DVec2;

use super::angles::turns;
use super::chart_map::ChartMap;
use crate::error::Result;
use crate::numeric::alignment::AlignedEdge;
use crate::numeric::newton::{self, Element, Workspace};
use crate::numeric::repair::repair_inversions;

/// Share of an edge's energy that its length has (gamma).
const GAMMA: f64 = 0.3;
/// Factor on the weight of alignment in each round (beta).
const BETA: f64 = 6.0;
/// Most rounds. The paper ends after ten at a deviation of 0.1 and flattens the rest; Newton's method goes on until flattening moves nothing to speak of.
const ROUNDS: usize = 16;
/// Weight of an edge's length in the later rounds, in units of the first: angles and lengths cannot both be had, and a weight that grew with the other would hold the angles back.
const HELD: f64 = 0.3;
/// Most steps in a round, and the relative decrease below which it ends.
const STEPS: usize = 4;
const ENOUGH: f64 = 1e-2;
/// Deviation in radians at which the boundary can be made straight.
const ALIGNED: f64 = 1e-5;

/// Why a chart could not be made axis-aligned.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Failed {
    /// The boundary does not reach its target angles.
    Stuck,
    /// A face turns over when the sides are made straight.
    Flips,
}

/// Deforms a chart so that boundary edge i has the polar angle `targets[i]` quarters of a turn, exactly, and no face is turned over.
///
/// # Errors
/// What `interrupt` gives.
pub(super) fn deform(
    map: &mut ChartMap,
    targets: &[i32],
    interrupt: &dyn Fn() -> Result<()>,
) -> Result<std::result::Result<(), Failed>> {
    let n = map.boundary.len();
    let free: Vec<u32> = (1..map.x.len() as u32).collect();
    let lengths = map.lengths();
    let total: f64 = lengths.iter().sum();
    let triangles = map.elements();
    let mut workspace = Workspace::default();
    let (mut weight, mut held) = (None, None);
    let mut last = f64::INFINITY;
    for _ in 0..ROUNDS {
        let mut before = f64::INFINITY;
        for step in 0..=STEPS {
            interrupt()?;
            let angles = map.polar_angles();
            // Whole turns are those of the boundary as it is labelled.
            let whole = ((f64::from(targets[0]) * FRAC_PI_2 - angles[0]) / std::f64::consts::TAU).round();
            let turn = |i: usize| f64::from(targets[i]) * FRAC_PI_2 - angles[i] - whole * std::f64::consts::TAU;
            let edge = |i: usize, weight: f64, held: f64| AlignedEdge {
                ends: [map.boundary[i], map.boundary[(i + 1) % n]],
                direction: map.edge(i),
                turn: turn(i),
                length: lengths[i],
                angle_weight: weight * lengths[i] / total * (1.0 - GAMMA),
                length_weight: held * lengths[i] / total * GAMMA,
            };
            last = (0..n).map(|i| turn(i).abs()).fold(0.0, f64::max);
            if last < ALIGNED {
                return Ok(flatten(map, targets));
            }
            if step == STEPS {
                break;
            }
            let weight = *weight.get_or_insert_with(|| {
                let own: f64 = (0..n).map(|i| edge(i, 1.0, 1.0).energy(map.edge(i))).sum();
                map.distortion() / own.max(1e-6)
            });
            let held = *held.get_or_insert(weight * HELD);
            let mut elements = triangles.clone();
            elements.extend((0..n).map(|i| Element::Edge(edge(i, weight, weight.min(held)))));
            let Some(done) = newton::step(&mut map.x, &elements, &free, &mut workspace) else {
                return Ok(Err(Failed::Stuck));
            };
            let gained = (before.min(done.before) - done.after) / done.after;
            before = done.after;
            if done.alpha == 0.0 || gained < ENOUGH * done.alpha {
                break;
            }
        }
        weight = weight.map(|w| w * BETA);
    }
    Ok(if last < 0.1 { flatten(map, targets) } else { Err(Failed::Stuck) })
}

/// Makes the sides straight: the vertices between two corners get one coordinate.
pub(super) fn flatten(map: &mut ChartMap, targets: &[i32]) -> std::result::Result<(), Failed> {
    for (run, axis) in runs(targets) {
        let n = map.boundary.len();
        let vertices: Vec<u32> =
            run.iter().map(|i| map.boundary[*i]).chain([map.boundary[(run[run.len() - 1] + 1) % n]]).collect();
        let mean = vertices.iter().map(|v| map.x[*v as usize][axis]).sum::<f64>() / vertices.len() as f64;
        vertices.iter().for_each(|v| map.x[*v as usize][axis] = mean);
    }
    if map.is_valid() {
        return Ok(());
    }
    let mut is_free = vec![true; map.x.len()];
    map.boundary.iter().for_each(|v| is_free[*v as usize] = false);
    let mean = map.area() / map.triangles.len() as f64;
    let areas = vec![mean; map.triangles.len()];
    let ok = repair_inversions(&map.triangles, &areas, &is_free, 1e-6, &mut map.x);
    if ok && map.is_valid() { Ok(()) } else { Err(Failed::Flips) }
}

/// The sides: boundary edges in order between two corners, each with the axis across it.
pub(super) fn runs(targets: &[i32]) -> Vec<(Vec<usize>, usize)> {
    let n = targets.len();
    let turns = turns(targets);
    let corners: Vec<usize> = (0..n).filter(|&i| turns[i] != 0).collect();
    let run = |k: usize| {
        let (from, to) = (corners[k], corners[(k + 1) % corners.len()]);
        let count = (to + n - from - 1) % n + 1;
        let edges = (0..count).map(|j| (from + j) % n).collect();
        (edges, if targets[from].rem_euclid(2) == 0 { 1 } else { 0 })
    };
    (0..corners.len()).map(run).collect()
}

/// Where the ends of a boundary edge point, as a direction along an axis.
pub(super) fn axis_direction(target: i32) -> DVec2 {
    [DVec2::X, DVec2::Y, DVec2::NEG_X, DVec2::NEG_Y][target.rem_euclid(4) as usize]
}
