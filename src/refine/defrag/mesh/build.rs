//! The mesh of an atlas whose charts are to be merged.

use glam::DVec2;

use super::winding::{Winding, consistent_winding};
use super::{MergeChart, MergeMesh, mirror};
use crate::atlas::bvh::Bounds;
use crate::atlas::groups::sorted_unique;
use crate::atlas::rigid::Rigid;
use crate::atlas::{Atlas, Charts, FaceId, HalfEdge, Mesh, triangle_area};
use crate::numeric::energy::jacobian;
use crate::refine::defrag::face_grid::FaceGrid;

impl MergeMesh {
    /// `mergeable` says which charts may be merged; `may_mirror` whether a chart may be mirrored to fit its neighbours.
    pub(crate) fn new(atlas: &Atlas, charts: &Charts, mergeable: &[bool], may_mirror: bool) -> Self {
        let Winding { atlas: wound, reversed, mirrored } = consistent_winding(atlas, charts, may_mirror);
        let mut mesh = Mesh::new(wound);
        mesh.divide_by_chart(|f| charts.of_face[f.index()].0);
        mirror_charts(&mut mesh, charts, &mirrored);
        let (own, topology) = (mesh.atlas(), mesh.topology());
        let n = own.face_count();
        let extent = own.uv.iter().filter(|p| p.is_finite()).map(|p| p.abs().max_element()).fold(1.0, f64::max);
        let rest: Vec<[DVec2; 3]> = own.faces().map(|f| own.uv_triangle(f)).collect();
        let weight: Vec<f64> = rest.iter().map(|r| jacobian(r, r).map_or(0.0, |_| triangle_area(r))).collect();
        let mostly_reversed: Vec<bool> = (charts.faces.iter())
            .map(|faces| {
                let area = |f: &FaceId| if reversed[f.index()] { weight[f.index()] } else { -weight[f.index()] };
                faces.iter().map(area).sum::<f64>() > 0.0
            })
            .collect();
        let manifold = manifold_borders(&mesh, charts);
        let mut merging = MergeMesh {
            border: topology.half_edges().map(|h| topology.is_border(h)).collect(),
            mergeable: mergeable_edges(&mesh, charts, &reversed, &mostly_reversed),
            chart_of: charts.of_face.iter().map(|c| c.0).collect(),
            charts: Vec::new(),
            area: own.faces().map(|f| own.area(f)).collect(),
            rest,
            weight,
            source: charts.of_face.iter().map(|c| c.0).collect(),
            motion: vec![Rigid::IDENTITY; charts.len()],
            mirrored,
            lattice: (0..charts.len() as u32).collect(),
            against_chart: (0..n).map(|f| reversed[f] != mostly_reversed[charts.of_face[f].index()]).collect(),
            reversed,
            deformed: vec![false; n],
            energy: vec![0.0; n],
            tolerance: 1e-12 * extent,
            mesh,
        };
        let cell = merging.usual_size();
        for (c, faces) in charts.faces.iter().enumerate() {
            let faces: Vec<u32> = faces.iter().map(|f| f.0).collect();
            let chart = merging.input_chart(c as u32, faces, cell, manifold[c], mergeable[c]);
            merging.charts.push(chart);
        }
        merging
    }

    /// Chart `c` of the input, of these faces.
    fn input_chart(&self, c: u32, faces: Vec<u32>, cell: f64, manifold: bool, mergeable: bool) -> MergeChart {
        let finite = faces.iter().all(|&f| self.triangle(f).iter().all(|p| p.is_finite()));
        let mut chart = MergeChart {
            parts: vec![c],
            main_part: c,
            manifold,
            mergeable: mergeable && finite,
            grid: FaceGrid::new(cell),
            ..MergeChart::default()
        };
        for &f in &faces {
            let bounds = Bounds::of(&self.triangle(f));
            chart.bounds = chart.bounds.union(bounds);
            chart.area += self.weight[f as usize];
            chart.preserved_area += self.area[f as usize];
            chart.grid.add(f, &bounds);
            for h in (3 * f..3 * f + 3).filter(|&h| self.is_border(h)) {
                chart.perimeter += self.length(h);
            }
        }
        chart.faces = faces;
        chart
    }

    /// Side of the smallest cells of grids: the usual size of faces.
    fn usual_size(&self) -> f64 {
        let mut sizes: Vec<f64> = self
            .rest
            .iter()
            .map(|r| Bounds::of(r).size().max_element())
            .filter(|s| *s > 0.0 && s.is_finite())
            .collect();
        sizes.sort_unstable_by(f64::total_cmp);
        sizes.get(sizes.len() / 2).copied().unwrap_or(1.0).max(1e-9)
    }
}

/// Mirrors the charts that are said to be.
fn mirror_charts(mesh: &mut Mesh, charts: &Charts, mirrored: &[bool]) {
    let corners = mesh.atlas().corners.iter().zip(&charts.of_face);
    let vertices = sorted_unique(corners.filter(|(_, c)| mirrored[c.index()]).flat_map(|(corners, _)| *corners));
    for u in vertices {
        mesh.move_uv(u, mirror(mesh.position(u)));
    }
}

/// By half edge: whether it is of a seam that may be dissolved.
fn mergeable_edges(mesh: &Mesh, charts: &Charts, reversed: &[bool], mostly_reversed: &[bool]) -> Vec<bool> {
    let opposite = |h: HalfEdge, t: HalfEdge| {
        mesh.vertex_at(h) == mesh.vertex_at(t.next()) && mesh.vertex_at(h.next()) == mesh.vertex_at(t)
    };
    // Sides of a surface that is wound one way here and another there would look folded to each other.
    let mostly = |h: HalfEdge| mostly_reversed[charts.of_face[h.face().index()].index()];
    let usual = |h: HalfEdge| reversed[h.face().index()] == mostly(h);
    let topology = mesh.topology();
    let may = |h: HalfEdge, t: HalfEdge| opposite(h, t) && usual(h) && usual(t) && mostly(h) == mostly(t);
    topology.half_edges().map(|h| topology.across_seam(h).is_some_and(|t| may(h, t))).collect()
}

/// By chart: whether its border falls into loops: not where more than two faces share an edge, or where faces run alike.
fn manifold_borders(mesh: &Mesh, charts: &Charts) -> Vec<bool> {
    let topology = mesh.topology();
    let chart = |f: FaceId| charts.of_face[f.index()].index();
    let mut manifold = vec![true; charts.len()];
    topology.incident_faces().flatten().for_each(|f| manifold[chart(f)] = false);
    let mut entered = vec![false; topology.len()];
    for h in topology.half_edges() {
        let sound = match topology.uv_twin(h) {
            // Faces that still run alike along a common edge.
            Some(twin) => mesh.uv_at(h) == mesh.uv_at(twin.next()),
            None => {
                let next = topology.next_on_boundary(h);
                topology.is_border(next) && !std::mem::replace(&mut entered[next.index()], true)
            }
        };
        manifold[chart(h.face())] &= sound;
    }
    manifold
}
