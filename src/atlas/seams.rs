//! Seams: where two borders of charts are one line on the surface.

use glam::DVec2;

use super::rigid::{Rigid, RigidFit, fit_rigid};
use super::topology::ends;
use super::{Atlas, ChartId, Charts, HalfEdge, Loops, Topology, UvId};

/// A stretch of a seam along which one chart's border follows another's (or its own) edge for edge, without a gap.
#[derive(Debug, Clone)]
pub(crate) struct SeamRun {
    /// Chart of `edges`, and of their twins. `charts[0] <= charts[1]`.
    pub charts: [ChartId; 2],
    /// Border half edges in the order of the loop.
    pub edges: Vec<HalfEdge>,
}

/// A stretch of seam whose two sides differ by a rigid motion: the parameterization is globally continuous across it
/// (Box Cutter, section 4.1).
#[derive(Debug, Clone)]
pub(crate) struct RigidSeam {
    /// Border half edges of the chart with the smaller number.
    pub edges: Vec<HalfEdge>,
    /// Maps the twins onto the edges.
    pub motion: Rigid,
    /// UV length of the edges.
    pub length: f64,
}

/// The UV vertices of a half edge and of its twin on the surface, matched by surface vertex: (own, across) at its start and
/// at its end.
pub(crate) fn linked_corners(atlas: &Atlas, h: HalfEdge, twin: HalfEdge) -> [(UvId, UvId); 2] {
    let (own, mut across) = (ends(&atlas.corners, h), ends(&atlas.corners, twin));
    if ends(&atlas.surface.triangles, h)[0] != ends(&atlas.surface.triangles, twin)[0] {
        across.swap(0, 1);
    }
    [(own[0], across[0]), (own[1], across[1])]
}

/// UV length of a half edge.
pub(crate) fn uv_length(atlas: &Atlas, h: HalfEdge) -> f64 {
    let [a, b] = ends(&atlas.corners, h).map(|u| atlas.uv[u.index()]);
    a.distance(b)
}

/// 3D length of a half edge.
pub(crate) fn length(atlas: &Atlas, h: HalfEdge) -> f64 {
    let [a, b] = ends(&atlas.surface.triangles, h).map(|v| atlas.surface.positions[v.index()]);
    a.distance(b)
}

/// All seams in maximal runs, each once: from the side of the smaller chart index, or of the smaller half edge.
pub(crate) fn seam_runs(atlas: &Atlas, topology: &Topology, charts: &Charts) -> Vec<SeamRun> {
    let chart = |h: HalfEdge| charts.of_face[h.face().index()];
    // Across the seam, for the side from which it is listed.
    let across = |h: HalfEdge| topology.across_seam(h).filter(|&twin| (chart(h), h) < (chart(twin), twin));
    // Whether `next` goes on where `h` ends, on both sides.
    let follows = |h: HalfEdge, next: HalfEdge| {
        across(h).zip(across(next)).is_some_and(|(twin, other)| {
            chart(twin) == chart(other) && linked_corners(atlas, h, twin)[1] == linked_corners(atlas, next, other)[0]
        })
    };
    let mut runs = Vec::new();
    for cycle in &Loops::new(topology, charts).half_edges {
        let n = cycle.len();
        // A run must not be torn where the list of a loop happens to start.
        let start = (0..n).find(|&i| !follows(cycle[(i + n - 1) % n], cycle[i])).unwrap_or(0);
        let mut run: Vec<HalfEdge> = Vec::new();
        for h in (0..n).map(|i| cycle[(start + i) % n]) {
            if run.last().is_some_and(|&last| !follows(last, h)) {
                runs.push(std::mem::take(&mut run));
            }
            if across(h).is_some() {
                run.push(h);
            }
        }
        if !run.is_empty() {
            runs.push(run);
        }
    }
    let of_run = |edges: Vec<HalfEdge>| {
        let twin = across(*edges.first()?)?;
        Some(SeamRun { charts: [chart(edges[0]), chart(twin)], edges })
    };
    runs.into_iter().filter_map(of_run).collect()
}

/// The parts of a run whose two sides are rigid motions of each other, to within `tolerance`.
pub(crate) fn rigid_seams(atlas: &Atlas, topology: &Topology, run: &SeamRun, tolerance: f64) -> Vec<RigidSeam> {
    let ends = |h: HalfEdge| {
        linked_corners(atlas, h, topology.surface_twin(h).unwrap_or(h))
            .map(|(own, across)| (atlas.uv[across.index()], atlas.uv[own.index()]))
    };
    let mut found = Vec::new();
    let mut start = 0;
    while start < run.edges.len() {
        let mut fit = RigidFit::default();
        let mut end = start;
        // Grow while the motion so far predicts the next point.
        while end < run.edges.len() {
            let [(p, q), (r, s)] = ends(run.edges[end]);
            let same_length = (p.distance(r) - q.distance(s)).abs() <= 2.0 * tolerance;
            let predicted =
                end == start || fit.solve().is_none_or(|m| m.transform_point2(r).distance(s) <= 4.0 * tolerance);
            let finite = [p, q, r, s].iter().all(|point| point.is_finite());
            if !(same_length && predicted && finite) {
                break;
            }
            if end == start {
                fit.add(p, q);
            }
            fit.add(r, s);
            end += 1;
        }
        if end == start {
            start += 1;
            continue;
        }
        // The motion of the whole must hold everywhere; else the stretch is halved.
        let mut stop = end;
        while stop > start {
            let edges = &run.edges[start..stop];
            let pairs: Vec<(DVec2, DVec2)> = edges.iter().flat_map(|&h| ends(h)).collect();
            match fit_rigid(&pairs) {
                Some((motion, residual)) if residual <= tolerance => {
                    let length = edges.iter().map(|&h| uv_length(atlas, h)).sum();
                    found.push(RigidSeam { edges: edges.to_vec(), motion, length });
                    break;
                }
                _ => stop = start + (stop - start) / 2,
            }
        }
        start = stop.max(start + 1);
    }
    found
}

/// How far apart two UV points may be and still be one: uploads hold float32 in [0, 1], whose rounding is some 1e-7 of the sheet.
pub(crate) fn weld_tolerance(atlas: &Atlas) -> f64 {
    let side = atlas.sheets.iter().flatten().copied().max().unwrap_or(1).max(1);
    1e-6 * f64::from(side)
}

/// UV length of all borders: a seam counts once for each side.
pub(crate) fn border_length(atlas: &Atlas, topology: &Topology) -> f64 {
    topology.half_edges().filter(|&h| topology.is_border(h)).map(|h| uv_length(atlas, h)).sum()
}
