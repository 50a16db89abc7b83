//! Overlap removal (Box Cutter, section 4.1): charts that overlap themselves are cut apart where that is cheapest.
//!
//! For each chart that overlaps itself a graph is made ([`graph`]): its triangles, drawn together by their common edges, forbidden
//! to meet where they overlap, and gently driven apart across globally continuous boundaries. The multicut of the graph with the
//! least weight ([`solve`]) tells where to cut. Charts that do not overlap themselves stay as they are, bit for bit.
//!
//! The result never overlaps: every step of the solver keeps overlapping triangles apart, a chart with too many pairs to
//! list is grown apart instead ([`grow`]), and the outcome is tested again from scratch, and cut further should that be needed.

pub mod baseline;
mod graph;
mod greedy;
mod grow;
mod klj;
mod mincut;
mod partition;
mod refine;
mod solve;
mod split;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use rayon::prelude::*;

use self::graph::{Graph, Scale};
use self::partition::Partition;
use super::weld;
use crate::atlas::seams::{border_length, uv_length};
use crate::atlas::{Atlas, ChartId, Charts, FaceId, HalfEdge, NONE, Topology, UvId, VertexId};
use crate::context::Context;
use crate::error::Result;

/// Overlapping pairs of one chart, and of all charts that are solved at the same time: 8 bytes each in the list and 8 in the
/// graph. A chart with more is grown apart instead.
const PAIR_LIMIT: usize = 12_000_000;
/// Edges and overlaps that the search for one chart may look at: this many, and more for large charts.
const WORK: u64 = 50_000_000;
const WORK_PER_NODE: u64 = 1_500;
/// Charts are tested and cut again at most this often. One round is enough but for freaks of topology; what overlaps in the last
/// is cut into single triangles, which cannot.
const ROUNDS: usize = 4;

/// What overlap removal did.
#[derive(Debug, Clone)]
pub struct Removed {
    /// The atlas, no chart of which overlaps itself any more (of those that might be touched).
    pub atlas: Atlas,
    /// UV length of the cuts, both sides counted, as in the boundary length.
    pub cut_length: f64,
    /// Charts that were cut.
    pub charts_touched: usize,
    /// Edges and overlaps looked at.
    pub work: u64,
    /// Whether a limit ended a search early. The result is free of overlaps all the same.
    pub cut_short: bool,
}

/// Which solutions are looked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Bias {
    /// Never count bias edges.
    Off,
    /// Always count them, as published.
    On,
    /// Solve with and without, weld both on trial, and keep what has the shorter boundary then: bias cuts whose weld fails
    /// would lengthen it.
    Trial,
}

/// How the multicut is looked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Method {
    /// Greedy contraction, then Kernighan-Lin with joins: the paper and nothing else.
    Published,
    /// The best of several starts, with exact cuts between pairs of clusters and neighbourhoods split anew.
    Best,
}

/// Cuts every chart that overlaps itself, and for which `touchable` holds, into charts that do not (Box Cutter, section 4.1).
/// `weight` makes cutting an edge dearer or cheaper (importance; 1 is neutral).
pub fn remove_overlaps(
    atlas: &Atlas,
    touchable: &(dyn Fn(ChartId) -> bool + Sync),
    weight: Option<&(dyn Fn(HalfEdge) -> f64 + Sync)>,
    context: &Context,
) -> Result<Removed> {
    remove_overlaps_with(atlas, touchable, weight, (Bias::Trial, Method::Best), context)
}

/// [`remove_overlaps`] with a choice of bias and method.
pub fn remove_overlaps_with(
    atlas: &Atlas,
    touchable: &(dyn Fn(ChartId) -> bool + Sync),
    weight: Option<&(dyn Fn(HalfEdge) -> f64 + Sync)>,
    (bias, method): (Bias, Method),
    context: &Context,
) -> Result<Removed> {
    let before = border_length(atlas, &Topology::new(atlas));
    let mut removed = Removed { atlas: atlas.clone(), cut_length: 0.0, charts_touched: 0, work: 0, cut_short: false };
    // Faces that may be cut: parts of touchable charts.
    let mut open: Option<Vec<bool>> = None;
    for round in 0..ROUNDS {
        let topology = Topology::new(&removed.atlas);
        let charts = Charts::new(&topology);
        let open = open.get_or_insert_with(|| charts.of_face.iter().map(|&c| touchable(c)).collect());
        let wanted: Vec<ChartId> = charts.ids().filter(|c| open[charts.faces[c.index()][0].index()]).collect();
        let found = count_all(&removed.atlas, &charts, &wanted, context)?;
        if found.is_empty() {
            break;
        }
        if round == 0 {
            removed.charts_touched = found.len();
        }
        let scale = Scale::new(&removed.atlas, &topology, weight);
        let labels = if round + 1 == ROUNDS {
            let faces = |c: &(ChartId, Option<usize>)| charts.faces[c.0.index()].len() as u32;
            let single = |n: u32| solve::Solved { label: (0..n).collect(), work: n.into(), cut_short: true };
            found.iter().map(|c| single(faces(c))).collect()
        } else {
            solve_all(&scale, &charts, &found, (if round == 0 { bias } else { Bias::Off }, method), context)?
        };
        let mut of_face = vec![0u32; removed.atlas.face_count()];
        for ((chart, _), solved) in found.iter().zip(labels) {
            removed.work += solved.work;
            removed.cut_short |= solved.cut_short;
            for (face, label) in charts.faces[chart.index()].iter().zip(solved.label) {
                of_face[face.index()] = label;
            }
        }
        removed.atlas = cut_by_label(&removed.atlas, &topology, &of_face);
    }
    if removed.charts_touched > 0 {
        removed.cut_length = border_length(&removed.atlas, &Topology::new(&removed.atlas)) - before;
    }
    Ok(removed)
}

/// The atlas cut wherever two neighbouring faces of one chart carry different labels.
fn cut_by_label(atlas: &Atlas, topology: &Topology, label: &[u32]) -> Atlas {
    let differ = |f: usize, g: usize| label[f] != label[g];
    let cuts: Vec<HalfEdge> = (0..topology.uv_twin.len() as u32)
        .filter(|&h| {
            let twin = topology.uv_twin[h as usize];
            twin != NONE && twin > h && differ(h as usize / 3, twin as usize / 3)
        })
        .collect();
    let mut parted = topology.clone();
    parted.crowded.retain(|p| !differ(p[0].index(), p[1].index()));
    if cuts.is_empty() && parted.crowded.len() == topology.crowded.len() {
        return atlas.clone();
    }
    if parted.crowded.len() == topology.crowded.len() {
        return atlas.cut_along(topology, &cuts);
    }
    // Crowded faces meet at a border, where nothing is cut: their vertices become one for each label.
    let mut next = atlas.cut_along(&parted, &cuts);
    let mut shared = vec![false; next.uv.len()];
    for pair in topology.crowded.iter().filter(|p| differ(p[0].index(), p[1].index())) {
        let corners = pair.iter().flat_map(|f| next.corners[f.index()]);
        corners.for_each(|c| shared[c.index()] = true);
    }
    let mut copies: BTreeMap<(UvId, u32), UvId> = BTreeMap::new();
    let mut named = vec![false; shared.len()];
    for (corners, &label) in next.corners.iter_mut().zip(label) {
        for corner in corners.iter_mut().filter(|c| c.index() < shared.len() && shared[c.index()]) {
            let old = *corner;
            *corner = *copies.entry((old, label)).or_insert_with(|| {
                if !std::mem::replace(&mut named[old.index()], true) {
                    return old;
                }
                next.uv.push(next.uv[old.index()]);
                UvId::new(next.uv.len() - 1)
            });
        }
    }
    next
}

/// The charts among `wanted` that overlap themselves, with the number of pairs (`None`: too many to list).
fn count_all(
    atlas: &Atlas,
    charts: &Charts,
    wanted: &[ChartId],
    context: &Context,
) -> Result<Vec<(ChartId, Option<usize>)>> {
    let mut found = Vec::new();
    for some in wanted.chunks(256) {
        context.check()?;
        let count = |c: &ChartId| graph::count_pairs(atlas, &charts.faces[c.index()], PAIR_LIMIT, context);
        let counts: Vec<Result<Option<usize>>> = some.par_iter().map(count).collect();
        for (&chart, count) in some.iter().zip(counts) {
            let count = count?;
            found.extend((count != Some(0)).then_some((chart, count)));
        }
    }
    Ok(found)
}

/// The multicut of every chart, as many at a time as their pairs fit the limit.
fn solve_all(
    scale: &Scale,
    charts: &Charts,
    found: &[(ChartId, Option<usize>)],
    (bias, method): (Bias, Method),
    context: &Context,
) -> Result<Vec<solve::Solved>> {
    let mut edges: Vec<Vec<(u32, u32, i64)>> = vec![Vec::new(); charts.len()];
    if bias != Bias::Off {
        let mut wanted = vec![false; charts.len()];
        found.iter().for_each(|c| wanted[c.0.index()] = true);
        for (a, b, weight) in graph::bias_edges(scale, charts, &wanted) {
            let chart = charts.of_face[a.index()].index();
            let local = |f: FaceId| charts.faces[chart].binary_search(&f).unwrap_or(0) as u32;
            edges[chart].push((local(a), local(b), weight));
        }
    }
    let mut all = Vec::new();
    let mut rest = found;
    while !rest.is_empty() {
        context.step(all.len() as f64 / found.len() as f64, "separating overlaps")?;
        let mut pairs = 0;
        let mut fits = |c: &(ChartId, Option<usize>)| {
            pairs += c.1.unwrap_or(0);
            pairs <= PAIR_LIMIT
        };
        let (now, later) = rest.split_at(rest.iter().take_while(|c| fits(c)).count().max(1));
        rest = later;
        let solved: Vec<Result<solve::Solved>> = now
            .par_iter()
            .map(|&(chart, count)| {
                solve_chart(scale, &charts.faces[chart.index()], count, &edges[chart.index()], (bias, method), context)
            })
            .collect();
        for one in solved {
            all.push(one?);
        }
    }
    Ok(all)
}

fn solve_chart(
    scale: &Scale,
    faces: &[FaceId],
    pairs: Option<usize>,
    bias_edges: &[(u32, u32, i64)],
    (bias, method): (Bias, Method),
    context: &Context,
) -> Result<solve::Solved> {
    if pairs.is_none() {
        let graph = graph::build(scale, faces, &[]);
        let mut work = 0;
        let label = grow::grow(scale.atlas, &graph, &mut work, context)?;
        return Ok(solve::Solved { label, work, cut_short: true });
    }
    let list = graph::list_pairs(scale.atlas, faces, context)?;
    let mut graph = graph::build(scale, faces, &list);
    drop(list);
    let solve = match method {
        Method::Published => solve::solve_as_published,
        Method::Best => solve::solve,
    };
    let limit = WORK.max(WORK_PER_NODE * faces.len() as u64);
    let biased = bias != Bias::Off && !bias_edges.is_empty();
    if biased && bias == Bias::On {
        graph.set_bias(bias_edges);
    }
    let plain = solve(&graph, limit, context)?;
    if !biased || bias == Bias::On {
        return Ok(plain);
    }
    graph.set_bias(bias_edges);
    let biased = solve(&graph, limit, context)?;
    let work = plain.work + biased.work;
    let trial = |s: &solve::Solved| welded_length(scale, &graph, &s.label, context);
    let better = if trial(&biased)? < trial(&plain)? { biased } else { plain };
    Ok(solve::Solved { work, ..better })
}

/// The boundary, weighted, that a labelling leaves when all is welded that can be, packing left aside.
fn welded_length(scale: &Scale, graph: &Graph, label: &[u32], context: &Context) -> Result<f64> {
    let part = part_of(scale.atlas, &graph.faces);
    let topology = Topology::new(&part);
    let partition = Partition::from_labels(graph, label.to_vec());
    let cut = cut_by_label(&part, &topology, &partition.label);
    let welded = weld::weld(&cut, &|_| true, f64::INFINITY, &|_| Ok(0.0), context)?;
    let topology = Topology::new(&welded.atlas);
    let own = |h: u32| 3 * graph.faces[h as usize / 3].0 + h % 3;
    let borders = (0..topology.uv_twin.len() as u32).filter(|&h| topology.uv_twin[h as usize] == NONE);
    Ok(borders.map(|h| uv_length(&welded.atlas, h) * scale.weight.map_or(1.0, |w| w(own(h)))).sum())
}

/// An atlas of some faces only.
fn part_of(atlas: &Atlas, faces: &[FaceId]) -> Atlas {
    let mut part = Atlas { sheets: atlas.sheets.clone(), ..Atlas::default() };
    let mut uvs: Vec<u32> = faces.iter().flat_map(|f| atlas.corners[f.index()]).map(|u| u.0).collect();
    let mut vertices: Vec<u32> = faces.iter().flat_map(|f| atlas.surface.triangles[f.index()]).map(|v| v.0).collect();
    for ids in [&mut uvs, &mut vertices] {
        ids.sort_unstable();
        ids.dedup();
    }
    let place = |ids: &[u32], id: u32| ids.binary_search(&id).unwrap_or(0);
    part.uv = uvs.iter().map(|&u| atlas.uv[u as usize]).collect();
    part.surface.positions = vertices.iter().map(|&v| atlas.surface.positions[v as usize]).collect();
    for f in faces {
        part.corners.push(atlas.corners[f.index()].map(|u| UvId::new(place(&uvs, u.0))));
        let triangle = atlas.surface.triangles[f.index()];
        part.surface.triangles.push(triangle.map(|v| VertexId::new(place(&vertices, v.0))));
        part.provenance.push(atlas.provenance[f.index()]);
        part.page.push(atlas.page[f.index()]);
    }
    part
}
