//! Overlap removal (Box Cutter, section 4.1): charts that overlap themselves are cut apart where that is cheapest.
//!
//! For each chart that overlaps itself a graph is made ([`graph`]): its triangles, drawn together by their common edges, forbidden
//! to meet where they overlap, and gently driven apart across globally continuous boundaries. The multicut of the graph with the
//! least weight ([`solve`]) tells where to cut. Charts that do not overlap themselves stay as they are, bit for bit.
//!
//! The result never overlaps: every step of the solver keeps overlapping triangles apart, a chart with too many pairs to
//! list is grown apart instead ([`grow`]), and the outcome is tested again from scratch, and cut further should that be needed.

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

use rayon::prelude::*;

use self::graph::{Graph, Scale};
use self::partition::Partition;
use super::weld;
use crate::atlas::groups::sorted_unique;
use crate::atlas::seams::{border_length, uv_length};
use crate::atlas::{Atlas, ChartId, Charts, FaceId, HalfEdge, Mesh, Topology, UvId};
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

/// Cuts every chart that overlaps itself, and for which `touchable` holds, into charts that do not (Box Cutter, section 4.1).
/// `weight` makes cutting an edge dearer or cheaper (importance; 1 is neutral).
pub fn remove_overlaps(
    atlas: &Atlas,
    touchable: &(dyn Fn(ChartId) -> bool + Sync),
    weight: Option<&(dyn Fn(HalfEdge) -> f64 + Sync)>,
    context: &Context,
) -> Result<Removed> {
    let mut removed =
        Removed { atlas: Atlas::default(), cut_length: 0.0, charts_touched: 0, work: 0, cut_short: false };
    let mut mesh = Mesh::new(atlas.clone());
    // Faces that may be cut: parts of touchable charts.
    let mut open: Option<Vec<bool>> = None;
    for round in 0..ROUNDS {
        let charts = Charts::new(mesh.topology());
        let open = open.get_or_insert_with(|| charts.of_face.iter().map(|&c| touchable(c)).collect());
        let wanted: Vec<ChartId> = charts.ids().filter(|c| open[charts.faces[c.index()][0].index()]).collect();
        let found = count_all(mesh.atlas(), &charts, &wanted, context)?;
        if found.is_empty() {
            break;
        }
        if round == 0 {
            removed.charts_touched = found.len();
        }
        let scale = Scale::new(mesh.atlas(), mesh.topology(), weight);
        let labels = if round + 1 == ROUNDS {
            let faces = |c: &(ChartId, Option<usize>)| charts.faces[c.0.index()].len() as u32;
            let single = |n: u32| solve::Solved { label: (0..n).collect(), work: n.into(), cut_short: true };
            found.iter().map(|c| single(faces(c))).collect()
        } else {
            solve_all(&scale, &charts, &found, round == 0, context)?
        };
        let mut of_face = vec![0u32; atlas.face_count()];
        for ((chart, _), solved) in found.iter().zip(labels) {
            removed.work += solved.work;
            removed.cut_short |= solved.cut_short;
            for (face, label) in charts.faces[chart.index()].iter().zip(solved.label) {
                of_face[face.index()] = label;
            }
        }
        cut_by_label(&mut mesh, &of_face);
    }
    if removed.charts_touched > 0 {
        let before = border_length(atlas, &Topology::new(atlas));
        removed.cut_length = border_length(mesh.atlas(), mesh.topology()) - before;
    }
    removed.atlas = if removed.charts_touched > 0 { mesh.into_atlas() } else { atlas.clone() };
    Ok(removed)
}

/// The mesh cut wherever two neighbouring faces of one chart carry different labels.
fn cut_by_label(mesh: &mut Mesh, label: &[u32]) {
    let differ = |f: FaceId, g: FaceId| label[f.index()] != label[g.index()];
    let topology = mesh.topology();
    let across = |h: &HalfEdge| topology.uv_twin(*h).is_some_and(|twin| twin > *h && differ(h.face(), twin.face()));
    let cuts: Vec<HalfEdge> = topology.half_edges().filter(across).collect();
    // The faces of a non-manifold edge meet at a border, where nothing is cut: their vertices become one for each label.
    let parted: Vec<[FaceId; 2]> = topology.incident_faces().filter(|p| differ(p[0], p[1])).collect();
    mesh.cut_unless(&cuts, &|f, g| !differ(f, g));
    let shared: Vec<UvId> = sorted_unique(parted.iter().flatten().flat_map(|f| mesh.atlas().corners[f.index()]));
    let corners = shared.iter().flat_map(|&u| mesh.corners_of(u));
    let mut parts: Vec<(HalfEdge, u32)> = corners.map(|c| (c, label[c.face().index()])).collect();
    parts.sort_unstable();
    mesh.divide(&parts);
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

/// The multicut of every chart, as many at a time as their pairs fit the limit; `biased` says whether globally continuous boundaries count.
fn solve_all(
    scale: &Scale,
    charts: &Charts,
    found: &[(ChartId, Option<usize>)],
    biased: bool,
    context: &Context,
) -> Result<Vec<solve::Solved>> {
    let mut edges: Vec<Vec<(u32, u32, i64)>> = vec![Vec::new(); charts.len()];
    if biased {
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
                solve_chart(scale, &charts.faces[chart.index()], count, &edges[chart.index()], context)
            })
            .collect();
        for one in solved {
            all.push(one?);
        }
    }
    Ok(all)
}

/// The multicut of one chart: the better of that with and that without bias, by what is left once all is welded that can be. Bias cuts whose
/// weld fails would lengthen the boundary.
fn solve_chart(
    scale: &Scale,
    faces: &[FaceId],
    pairs: Option<usize>,
    bias_edges: &[(u32, u32, i64)],
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
    let limit = WORK.max(WORK_PER_NODE * faces.len() as u64);
    let plain = solve::solve(&graph, limit, context)?;
    if bias_edges.is_empty() {
        return Ok(plain);
    }
    graph.set_bias(bias_edges);
    let biased = solve::solve(&graph, limit, context)?;
    let work = plain.work + biased.work;
    let trial = |s: &solve::Solved| welded_length(scale, &graph, &s.label, context);
    let better = if trial(&biased)? < trial(&plain)? { biased } else { plain };
    Ok(solve::Solved { work, ..better })
}

/// The boundary, weighted, that a labelling leaves when all is welded that can be, packing left aside.
fn welded_length(scale: &Scale, graph: &Graph, label: &[u32], context: &Context) -> Result<f64> {
    let mut part = Mesh::new(scale.atlas.subset(&graph.faces));
    cut_by_label(&mut part, &Partition::from_labels(graph, label.to_vec()).label);
    let welded = weld::weld(part.atlas(), &|_| true, f64::INFINITY, &|_| Ok(0.0), context)?;
    let topology = Topology::new(&welded.atlas);
    let own = |h: HalfEdge| HalfEdge::of(graph.faces[h.face().index()], h.corner());
    let borders = topology.half_edges().filter(|&h| topology.is_border(h));
    Ok(borders.map(|h| uv_length(&welded.atlas, h) * scale.weight.map_or(1.0, |w| w(own(h)))).sum())
}
