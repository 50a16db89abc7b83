//! The target polar angles of a chart's boundary edges (section 3.1.1).

use std::f64::consts::{FRAC_PI_2, TAU};

use glam::DVec2;

/// Most rounds of smoothing.
const ROUNDS: usize = 5;
/// Change of angle, in radians, below which smoothing ends.
const STILL: f64 = 1e-4;
/// Beyond so many standard deviations an edge has no weight.
const REACH: f64 = 4.0;
/// Labels on either side of the nearest that an edge may take.
const WINDOW: i32 = 2;
/// Least K: corners between straight sides, and no slits.
const LEAST_K: i32 = -1;

/// Polar angles of smoothed directions (eq. 3, 4): `angles` are carried along a boundary of edges of these `lengths`; `sigma` is the standard deviation
/// in units of length.
pub(super) fn smoothed(angles: &[f64], lengths: &[f64], sigma: f64) -> Vec<f64> {
    let n = angles.len();
    let mut own = angles.to_vec();
    for _ in 0..ROUNDS {
        let directions: Vec<DVec2> = own.iter().map(|a| DVec2::from_angle(*a)).collect();
        let mut most = 0.0f64;
        for i in 0..n {
            let mut sum = directions[i] * lengths[i];
            for forwards in [true, false] {
                let (mut distance, mut k) = (0.5 * lengths[i], i);
                for _ in 0..(n - 1) / 2 {
                    k = if forwards { (k + 1) % n } else { (k + n - 1) % n };
                    distance += 0.5 * lengths[k];
                    if distance > REACH * sigma {
                        break;
                    }
                    sum += directions[k] * (lengths[k] * (-0.5 * (distance / sigma).powi(2)).exp());
                    distance += 0.5 * lengths[k];
                }
            }
            // A turn by more than a right angle is not known from one the other way.
            if sum.dot(directions[i]) > 0.0 {
                let turn = directions[i].angle_to(sum);
                own[i] += turn;
                most = most.max(turn.abs());
            }
        }
        if most < STILL {
            break;
        }
    }
    own
}

/// The turn that brings edges of these polar angles as near to the axes as one turn can: the closed form of eq. 5, because x^2 y^2 = (1 - cos 4 theta) / 8.
pub(super) fn global_rotation(angles: &[f64], lengths: &[f64]) -> f64 {
    let sum: DVec2 = angles.iter().zip(lengths).map(|(a, l)| DVec2::from_angle(4.0 * a) * *l).sum();
    if sum == DVec2::ZERO { 0.0 } else { -sum.y.atan2(sum.x) / 4.0 }
}

/// The target polar angles in quarters of a turn: those that fit the angles best (squared deviations by length) where each corner costs `corner` units
/// of length, and no vertex turns by more than a quarter to the left or to the right (K <= 1: nothing folds over; a boundary vertex lies between edge i - 1 and
/// edge i). After a whole turn they are 4 more. `None` where the boundary has too few edges for four corners.
///
/// The optimum over all sequences, by dynamic programming along the boundary from its best edge.
pub(super) fn targets(angles: &[f64], lengths: &[f64], corner: f64) -> Option<Vec<i32>> {
    let n = angles.len();
    let quarter = |a: f64| (a / FRAC_PI_2).round();
    let deviation = |a: f64| (a - quarter(a) * FRAC_PI_2).abs();
    let longest = lengths.iter().copied().fold(0.0, f64::max);
    // Of the edges that count, the one that is nearest to an axis.
    let start = (0..n)
        .filter(|&i| lengths[i] >= 0.5 * longest)
        .min_by(|&a, &b| deviation(angles[a]).total_cmp(&deviation(angles[b])).then(a.cmp(&b)))?;
    let at = |k: usize| {
        let i = (start + k) % n;
        (angles[i] + if start + k >= n { TAU } else { 0.0 }, lengths[i])
    };
    let labels = (2 * WINDOW + 1) as usize;
    let base: Vec<i32> = (0..n).map(|k| quarter(at(k).0) as i32).collect();
    let mut best = vec![vec![(f64::INFINITY, 0usize); labels]; n];
    best[0][WINDOW as usize].0 = 0.0;
    let turn_cost = |k: i32| if (LEAST_K..=1).contains(&k) { corner * f64::from(k.abs()) } else { f64::INFINITY };
    for k in 1..n {
        let (angle, length) = at(k);
        for l in 0..labels {
            let label = base[k] + l as i32 - WINDOW;
            let fit = length * (angle - f64::from(label) * FRAC_PI_2).powi(2);
            let from = (0..labels)
                .map(|m| (best[k - 1][m].0 + turn_cost(label - (base[k - 1] + m as i32 - WINDOW)), m))
                .min_by(|a, b| a.0.total_cmp(&b.0))?;
            best[k][l] = (from.0 + fit, from.1);
        }
    }
    let goal = base[0] + 4;
    let (cost, mut l) = (0..labels)
        .map(|m| (best[n - 1][m].0 + turn_cost(goal - (base[n - 1] + m as i32 - WINDOW)), m))
        .min_by(|a, b| a.0.total_cmp(&b.0))?;
    if !cost.is_finite() {
        return None;
    }
    let mut out = vec![0; n];
    for k in (0..n).rev() {
        let label = base[k] + l as i32 - WINDOW;
        out[(start + k) % n] = if start + k >= n { label - 4 } else { label };
        l = best[k][l].1;
    }
    Some(out)
}

/// K of each boundary vertex: by how many quarters the boundary turns to the left there.
pub(super) fn turns(targets: &[i32]) -> Vec<i32> {
    let n = targets.len();
    (0..n).map(|i| targets[i] - targets[(i + n - 1) % n] + if i == 0 { 4 } else { 0 }).collect()
}
