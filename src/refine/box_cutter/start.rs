//! From an Atlas to panels, and from the cuts back to an Atlas.

use std::collections::BTreeSet;
use std::sync::Arc;

use glam::DVec2;
use rayon::prelude::*;

use super::edges::Patch;
use super::outline::Outline;
use super::panel::{Panel, Raster, middle};
use super::search::{Cut, SearchState};
use crate::atlas::{
    Atlas, ChartId, Charts, Clusters, FaceId, LineCutter, Loops, Mesh, OverlapMode, Segment, Topology, clusters,
    overlaps,
};
use crate::packing::{InitialLayout, Rotation};
use crate::refine::stage::SheetInfo;

/// Overlapping pairs that are looked for; beyond, charts are told apart by their areas alone.
const PAIRS: usize = 1_000_000;
/// Relative difference of areas up to which an outline describes its chart.
const SAME_AREA: f64 = 1e-6;

/// The charts, or clusters of charts, as panels. A cluster, a chart that overlaps itself and one whose border is not that of a
/// disk with holes cannot be cut.
pub(crate) fn panels(
    atlas: &Atlas,
    topology: &Topology,
    charts: &Charts,
    together: &Clusters,
    along_edges: bool,
    sheet_info: &SheetInfo,
    rotation: Rotation,
) -> Vec<Arc<Panel>> {
    let loops = Loops::new(topology, charts);
    let mut borders: Vec<Vec<Vec<DVec2>>> = vec![Vec::new(); charts.len()];
    for i in 0..loops.chart.len() {
        borders[loops.chart[i].index()].push(loops.uv_vertices(atlas, i).map(|u| atlas.uv[u.index()]).collect());
    }
    let mut broken: BTreeSet<ChartId> = topology.incident_faces().map(|p| charts.of_face[p[0].index()]).collect();
    broken.extend(overlaps(atlas, charts, PAIRS).intra.iter().map(|p| charts.of_face[p.0.index()]));
    together
        .charts
        .par_iter()
        .map(|own| {
            let faces = || own.iter().flat_map(|c| charts.faces[c.index()].iter().copied());
            let area: f64 = faces().map(|f| atlas.uv_area(f).abs()).sum();
            let id = own[0].0;
            let half_turns = sheet_info.turns_by_half(atlas, faces());
            let mut outline = Outline { loops: own.iter().flat_map(|c| borders[c.index()].iter().cloned()).collect() };
            if outline.area() < 0.0 {
                outline.loops.iter_mut().for_each(|l| l.reverse());
            }
            let simple = own.len() == 1
                && !broken.contains(&own[0])
                && (outline.area() - area).abs() <= SAME_AREA * area
                && outline.loops.iter().flatten().all(|p| p.is_finite());
            if !simple {
                let triangles =
                    faces().map(|f| atlas.uv_triangle(f)).filter(|t| t.iter().all(|p| p.is_finite())).collect();
                return Arc::new(Panel::rigid(id, outline, triangles, rotation, half_turns));
            }
            let patch = along_edges.then(|| Patch { faces: Arc::new(faces().collect()), ..Patch::default() });
            Arc::new(Panel::new(id, outline, patch, rotation, half_turns))
        })
        .collect()
}

/// Lines pass through a vertex that is nearer than this, relative to the longest side of the layout's box.
const SNAP: f64 = 1e-5;

/// Makes the cuts of a search; gives the Atlas and the chart that each of its faces comes from. `unit` is the longest side of the
/// layout's box in texels. The charts keep their coordinates.
pub(crate) fn apply(mesh: &Mesh, charts: &Charts, cuts: &[Arc<Cut>], unit: f64) -> (Atlas, Vec<ChartId>) {
    let along: Vec<_> = cuts
        .iter()
        .filter_map(|c| match &**c {
            Cut::Edges(edges) => Some(edges.iter().copied()),
            Cut::Straight { .. } => None,
        })
        .flatten()
        .collect();
    if !along.is_empty() {
        let mut mesh = mesh.clone();
        mesh.cut(&along);
        return (mesh.into_atlas(), charts.of_face.clone());
    }
    let mut cutter = LineCutter::new(mesh.clone(), SNAP * unit);
    let mut faces: Vec<Vec<FaceId>> = charts.faces.clone();
    let mut of_face: Vec<ChartId> = charts.of_face.clone();
    for cut in cuts {
        let Cut::Straight { chart, line, chords } = &**cut else { continue };
        for &(from, to) in chords {
            let mut own = std::mem::take(&mut faces[*chart as usize]);
            let mut others = Vec::new();
            cutter.cut(&mut own, Segment { from: line.at(from), to: line.at(to) }, &mut others);
            // New faces are numbered as they come, over both lists.
            let mut fresh: Vec<(FaceId, ChartId)> =
                own.iter().filter(|f| f.index() >= of_face.len()).map(|f| (*f, ChartId(*chart))).collect();
            faces[*chart as usize] = own;
            for (new, parent) in others {
                let home = of_face[parent.index()];
                faces[home.index()].push(new);
                fresh.push((new, home));
            }
            fresh.sort_unstable();
            of_face.extend(fresh.iter().map(|f| f.1));
        }
    }
    (cutter.finish(), of_face)
}

/// The layout of a search's last arrangement for the clusters of the Atlas that its cuts made, each matched to the panel that has its
/// middle; `None` when they are not one to one.
pub(crate) fn layout(
    atlas: &Atlas,
    origin: &[ChartId],
    mode: OverlapMode,
    state: &SearchState,
    raster: &Raster,
) -> Option<InitialLayout> {
    let charts = Charts::new(&Topology::new(atlas));
    let together = clusters(atlas, &charts, mode);
    if together.charts.len() != state.panels.len() {
        return None;
    }
    let mut free: Vec<(u32, DVec2, usize)> =
        state.panels.iter().enumerate().map(|(i, p)| (p.chart, p.middle(), i)).collect();
    let mut places = Vec::with_capacity(together.charts.len());
    for own in &together.charts {
        let faces = || own.iter().flat_map(|c| charts.faces[c.index()].iter().copied());
        let chart = origin[faces().next()?.index()].0;
        let middle = middle(faces().map(|f| (atlas.uv_triangle(f), atlas.uv_area(f).abs())));
        let place = free
            .iter()
            .enumerate()
            .filter(|(_, p)| p.0 == chart || own.len() > 1)
            .min_by(|a, b| a.1.1.distance_squared(middle).total_cmp(&b.1.1.distance_squared(middle)))?
            .0;
        let (_, _, panel) = free.swap_remove(place);
        let spot = state.arrangement.layout.spots[panel]?;
        let orientation = state.panels[panel].orientations(raster)[spot.orientation as usize];
        let corner = spot.corner() * raster.cell + DVec2::splat(raster.inflate);
        places.push((orientation, corner));
    }
    let layout = &state.arrangement.layout;
    Some(InitialLayout { places, sides: [layout.width, layout.height].map(|s| s as f64 * raster.cell) })
}
