//! Axis-aligned charts of all disks (section 3.1), and the trails that divide them.

use std::collections::BTreeSet;

use glam::DVec2;
use rayon::prelude::*;

use super::angles::{global_rotation, smoothed, targets};
use super::arrangement::{Arrangement, arrange};
use super::chart_map::ChartMap;
use super::deform::{deform, flatten, runs};
use super::prepare::{Disk, Labels, Layout, NO_DISK, Prepared, Target, embed, leave_out};
use super::subdivide::{flattened_edges, split_at_middles};
use crate::atlas::groups::sorted_unique;
use crate::atlas::{FaceId, HalfEdge, Mesh};
use crate::error::Result;

/// How charts are made axis-aligned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Construction {
    /// Standard deviation of smoothing, in parts of the boundary's length.
    pub sigma: f64,
    /// What a corner costs, in parts of the square root of the chart's area.
    pub corner: f64,
    /// What is kept near: the shape on the surface, or the uploaded one.
    pub target: Target,
    /// Length of the parts of sides between which trails may start too, where corners do not suffice; infinite where they are to.
    pub part: f64,
}

/// An axis-aligned disk.
#[derive(Debug, Clone)]
pub(super) struct AlignedDisk {
    pub map: ChartMap,
    pub arrangement: Arrangement,
    /// Whether it had to become a plain rectangle.
    pub is_fallback: bool,
}

/// All disks axis-aligned.
#[derive(Debug, Clone)]
pub(super) struct Constructed {
    pub mesh: Mesh,
    pub labels: Labels,
    pub layout: Layout,
    pub disks: Vec<AlignedDisk>,
    /// By disk: what it was made of.
    pub info: Vec<Disk>,
    /// By disk: its number before those that failed were left out.
    pub number: Vec<usize>,
    /// The numbers of those that failed, which lie as they were uploaded.
    failed: Vec<usize>,
    /// What is kept near.
    pub target: Target,
}

/// What corners cost where the first try fails; that of the first stands for it.
const OTHERWISE: [f64; 5] = [0.0, 0.0, 0.05, 0.15, 0.4];
/// Distortion, as a multiple of an isometry's, of a plain rectangle that is bent out of shape.
const BENT: f64 = 1.5;
/// Rounds of dividing faces that would be flattened.
const ROUNDS: usize = 4;

/// Makes all disks axis-aligned.
///
/// # Errors
/// What `interrupt` gives.
pub(super) fn construct(
    prepared: &Prepared,
    how: &Construction,
    weights: Option<&[f64]>,
    interrupt: &(dyn Fn() -> Result<()> + Sync),
) -> Result<Constructed> {
    let mut own = prepared.clone();
    let start = |d: &Disk| -> Option<Aimed> {
        let mut map = own.map(d, how.target)?;
        let targets = if map.is_valid() { aim(&mut map, how) } else { None };
        Some(Aimed { map, targets: targets.unwrap_or_default() })
    };
    let mut aimed: Vec<Option<Aimed>> = own.disks.par_iter().map(start).collect();
    let mut aligned: Vec<Option<AlignedDisk>> = vec![None; aimed.len()];
    let last = OTHERWISE.len();
    for round in 0..=last {
        let is_fallback = round == last;
        if round > 0 {
            // What did not succeed is tried with other corners, and becomes a plain rectangle at last.
            let again = |(own, _): (&mut Option<Aimed>, &Option<AlignedDisk>)| {
                let Some(Aimed { mut map, .. }) = own.take() else { return };
                let targets = match OTHERWISE.get(round) {
                    Some(corner) if map.is_valid() => aim(&mut map, &Construction { corner: *corner, ..*how }),
                    Some(_) => None,
                    None => rectangle(&map),
                };
                *own = Some(Aimed { map, targets: targets.unwrap_or_default() });
            };
            aimed.par_iter_mut().zip(&aligned).filter(|(_, done)| done.is_none()).for_each(again);
        }
        subdivide(&mut own, &mut aimed, how.target, interrupt)?;
        let done: Vec<Option<ChartMap>> = aimed
            .par_iter()
            .map(|a| {
                let Some(Aimed { map, targets }) = a.as_ref().filter(|a| !a.targets.is_empty()) else {
                    return Ok(None);
                };
                let mut map = map.clone();
                if is_fallback && !onto_rectangle(&mut map, targets) {
                    return Ok(None);
                }
                let kept = is_fallback.then(|| map.x.clone());
                if deform(&mut map, targets, interrupt)?.is_ok() {
                    return Ok(Some(map));
                }
                // The rectangle as it was embedded will do.
                let Some(kept) = kept else { return Ok(None) };
                map.x = kept;
                Ok(flatten(&mut map, targets).is_ok().then_some(map))
            })
            .collect::<Result<_>>()?;
        // Trails are walked on the mesh; where they get lost it is as if the deformation had failed.
        let before: Vec<DVec2> = own.mesh.atlas().uv.clone();
        let moved = |mesh: &mut Mesh, map: &ChartMap, at: &dyn Fn(usize) -> DVec2| {
            map.uvs.iter().enumerate().for_each(|(v, u)| mesh.move_uv(*u, at(v)));
        };
        done.iter().flatten().for_each(|map| moved(&mut own.mesh, map, &|v| map.x[v]));
        let (mesh, origin) = (&own.mesh, &own.labels.origin);
        let weight = |f: FaceId| weights.map_or(1.0, |w| w[origin[f.index()].index()]);
        let walked: Vec<Option<Arrangement>> = done
            .par_iter()
            .zip(&aimed)
            .map(|(map, a)| {
                let (map, targets) = (map.as_ref()?, &a.as_ref()?.targets);
                let all = more(map, targets, how.part);
                let found = arrange(mesh, map, targets, &all, &weight);
                found.or_else(|| if all.is_empty() { None } else { arrange(mesh, map, targets, &[], &weight) })
            })
            .collect();
        for (((out, map), walked), from) in aligned.iter_mut().zip(done).zip(walked).zip(&mut aimed) {
            let Some(map) = map else { continue };
            match walked {
                Some(arrangement) => {
                    *out = Some(AlignedDisk { map, arrangement, is_fallback });
                    *from = None;
                }
                None => moved(&mut own.mesh, &map, &|v| before[map.uvs[v].index()]),
            }
        }
    }
    // A disk without a map keeps no place among them.
    let failed: Vec<usize> = (0..aligned.len()).filter(|d| aligned[*d].is_none()).collect();
    let number = (0..aligned.len()).filter(|d| aligned[*d].is_some()).collect();
    let info = leave_out(&mut own.mesh, &mut own.labels, &own.layout, own.disks, |d| aligned[d].is_none());
    let disks = aligned.into_iter().flatten().collect();
    Ok(Constructed {
        mesh: own.mesh,
        labels: own.labels,
        layout: own.layout,
        disks,
        info,
        number,
        failed,
        target: how.target,
    })
}

/// Boundary vertices that divide the sides into parts of about a length.
fn more(map: &ChartMap, targets: &[i32], part: f64) -> Vec<usize> {
    let mut out = Vec::new();
    if part.is_infinite() {
        return out;
    }
    for (run, _) in runs(targets) {
        let total: f64 = run.iter().map(|i| map.edge(*i).length()).sum();
        let parts = (total / part).round().max(1.0);
        let mut along = 0.0;
        let mut next = 1.0;
        for pair in run.windows(2) {
            along += map.edge(pair[0]).length();
            if next < parts && along >= (next - 0.25) * total / parts {
                out.push(pair[1]);
                next = (along / total * parts).floor().max(next) + 1.0;
            }
        }
    }
    out
}

impl Constructed {
    /// The same with some disks, as they were numbered before others were left out, as they were uploaded.
    pub fn without(&self, out: &BTreeSet<usize>) -> Constructed {
        let Constructed { mut mesh, mut labels, layout, disks, info, number, failed, target } = self.clone();
        let is_out = |d: usize| out.contains(&self.number[d]);
        let info = leave_out(&mut mesh, &mut labels, &layout, info, is_out);
        let kept = disks.into_iter().zip(number).filter(|(_, n)| !out.contains(n));
        let (disks, number) = kept.unzip();
        Constructed { mesh, labels, layout, disks, info, number, failed, target }
    }

    /// The disks, as they were numbered before some were left out, that failed or only became rectangles, and bent ones.
    pub fn bent(&self) -> impl Iterator<Item = usize> {
        let pairs = self.disks.iter().zip(&self.number);
        let bent = pairs.filter(|(d, _)| d.is_fallback && d.map.distortion() > BENT).map(|(_, n)| *n);
        bent.chain(self.failed.iter().copied())
    }
}

/// A disk and what its boundary edges are to become.
struct Aimed {
    map: ChartMap,
    /// Empty where it cannot be aimed.
    targets: Vec<i32>,
}

/// Divides faces that the targets would flatten, until there are none. Boundaries stay, and with them the targets.
fn subdivide(
    own: &mut Prepared,
    aimed: &mut [Option<Aimed>],
    target: Target,
    interrupt: &(dyn Fn() -> Result<()> + Sync),
) -> Result<()> {
    for _ in 0..ROUNDS {
        interrupt()?;
        let flat = |(d, a): (usize, &Option<Aimed>)| {
            let a = a.as_ref().filter(|a| !a.targets.is_empty())?;
            let edges = flattened_edges(&own.mesh, &a.map, &a.targets);
            (!edges.is_empty()).then_some((d, edges))
        };
        let flat: Vec<(usize, Vec<HalfEdge>)> = aimed.par_iter().enumerate().filter_map(flat).collect();
        if flat.is_empty() {
            break;
        }
        let edges: Vec<HalfEdge> = flat.iter().flat_map(|(_, e)| e.iter().copied()).collect();
        let made = split_at_middles(&mut own.mesh, &edges);
        own.labels.extend(&made);
        let mut touched: Vec<usize> = Vec::new();
        for (new, _) in made {
            let d = own.labels.disk[new.index()];
            if d != NO_DISK {
                own.disks[d as usize].faces.push(new);
                touched.push(d as usize);
            }
        }
        let touched = sorted_unique(touched);
        // Others have the edges too where the surface is no manifold.
        let again = |d: &usize| {
            let Aimed { map: old, targets } = aimed[*d].as_ref()?;
            let mut map = own.map(&own.disks[*d], target)?;
            let first = old.uvs[old.boundary[0] as usize];
            let at = map.boundary.iter().position(|v| map.uvs[*v as usize] == first)?;
            map.boundary.rotate_left(at);
            map.rest_lengths.rotate_left(at);
            turn(&mut map, old.turned);
            let targets = carried(old, targets, &map)?;
            Some(Aimed { map, targets })
        };
        let again: Vec<Option<Aimed>> = touched.par_iter().map(again).collect();
        for (d, again) in touched.into_iter().zip(again) {
            aimed[d] = again;
        }
    }
    Ok(())
}

/// Target angles for a boundary in which edges may have been divided; none where it is another one.
fn carried(old: &ChartMap, targets: &[i32], map: &ChartMap) -> Option<Vec<i32>> {
    if targets.is_empty() {
        return Some(Vec::new());
    }
    let mut next = 0;
    let mut out = Vec::with_capacity(map.boundary.len());
    for v in &map.boundary {
        let is_old = old.boundary.get(next).is_some_and(|o| old.uvs[*o as usize] == map.uvs[*v as usize]);
        next += usize::from(is_old);
        out.push(targets[next.checked_sub(1)?]);
    }
    (next == old.boundary.len()).then_some(out)
}

/// Turns a chart so that its boundary is as near to the axes as can be, and gives the target angles of its edges; none where there are too few.
fn aim(map: &mut ChartMap, how: &Construction) -> Option<Vec<i32>> {
    let lengths = map.lengths();
    let total: f64 = lengths.iter().sum();
    let angles = smoothed(&map.polar_angles(), &lengths, how.sigma * total);
    let by = global_rotation(&angles, &lengths);
    turn(map, by);
    let angles: Vec<f64> = angles.iter().map(|a| a + by).collect();
    targets(&angles, &lengths, how.corner * map.area().abs().sqrt())
}

fn turn(map: &mut ChartMap, by: f64) {
    map.turned += by;
    let turn = DVec2::from_angle(by);
    map.x.iter_mut().for_each(|p| *p = turn.rotate(*p));
}

/// Target angles that make a disk a plain rectangle, the last resort, of about the aspect that its boundary has about its area.
fn rectangle(map: &ChartMap) -> Option<Vec<i32>> {
    let n = map.boundary.len();
    if n < 4 {
        return None;
    }
    let lengths = &map.rest_lengths;
    let half = lengths.iter().sum::<f64>() / 2.0;
    let long = long_side(map, half);
    let mut at = Vec::with_capacity(n);
    let mut along = 0.0;
    for l in lengths {
        at.push(along);
        along += l;
    }
    let mut corners: Vec<usize> = Vec::with_capacity(4);
    for (k, stop) in [0.0, long, half, half + long].into_iter().enumerate() {
        let from = corners.last().map_or(0, |c| c + 1);
        let off = |i: usize| (at[i] - stop).abs();
        corners.push((from..n - (3 - k)).min_by(|&a, &b| off(a).total_cmp(&off(b)).then(a.cmp(&b)))?);
    }
    let side = |i: usize| corners.iter().filter(|c| **c <= i).count() as i32 - 1;
    Some((0..n).map(side).collect())
}

/// The longer side of a rectangle with that half circumference and the area of the disk, as far as that is no sliver.
fn long_side(map: &ChartMap, half: f64) -> f64 {
    let root = (half * half / 4.0 - map.rest_area).max(0.0).sqrt();
    (half / 2.0 + root).min(0.9 * half)
}

/// Lays a disk onto the rectangle with these target angles: its boundary by lengths, the rest by Tutte's embedding (1963). False where that fails.
fn onto_rectangle(map: &mut ChartMap, targets: &[i32]) -> bool {
    let half = map.rest_lengths.iter().sum::<f64>() / 2.0;
    let long = long_side(map, half);
    let scale = (map.rest_area / (long * (half - long))).sqrt();
    let size = DVec2::new(long, half - long) * scale;
    let places = [DVec2::ZERO, DVec2::new(size.x, 0.0), size, DVec2::new(0.0, size.y)];
    let mut held = vec![false; map.x.len()];
    for k in 0..4 {
        let own: Vec<usize> = (0..targets.len()).filter(|i| targets[*i] == k as i32).collect();
        let side: f64 = own.iter().map(|i| map.rest_lengths[*i]).sum();
        let mut along = 0.0;
        for (j, &i) in own.iter().enumerate() {
            let part = if side > 0.0 { along / side } else { j as f64 / own.len() as f64 };
            let v = map.boundary[i] as usize;
            map.x[v] = places[k] + (places[(k + 1) % 4] - places[k]) * part;
            held[v] = true;
            along += map.rest_lengths[i];
        }
    }
    embed(map, &held) && map.is_valid()
}
