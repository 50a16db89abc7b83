//! The mesh of an atlas whose charts are to be merged.

use glam::DVec2;

use super::winding::{Winding, consistent_winding};
use super::{MergeChart, MergeMesh, mirror};
use crate::atlas::bvh::Bounds;
use crate::atlas::rigid::Rigid;
use crate::atlas::{Atlas, Charts, FaceId, NONE, Topology};
use crate::numeric::energy::jacobian;
use crate::refine::defrag::face_grid::FaceGrid;

impl MergeMesh {
    /// `mergeable` says which charts may be merged; `may_mirror` whether a chart may be mirrored to fit its neighbours.
    pub(crate) fn new(atlas: &Atlas, charts: &Charts, mergeable: &[bool], may_mirror: bool) -> Self {
        let Winding { atlas: mut own, reversed, mirrored } = consistent_winding(atlas, charts, may_mirror);
        own.separate_uvs(charts);
        mirror_charts(&mut own, charts, &mirrored);
        let topology = Topology::new(&own);
        let n = own.face_count();
        let extent = own.uv.iter().filter(|p| p.is_finite()).map(|p| p.abs().max_element()).fold(1.0, f64::max);
        let rest: Vec<[DVec2; 3]> = own.faces().map(|f| own.uv_triangle(f)).collect();
        let weight: Vec<f64> = rest
            .iter()
            .map(|r| jacobian(r, r).map_or(0.0, |_| 0.5 * (r[1] - r[0]).perp_dot(r[2] - r[0]).abs()))
            .collect();
        let mostly_reversed: Vec<bool> = (charts.faces.iter())
            .map(|faces| {
                let area = |f: &FaceId| if reversed[f.index()] { weight[f.index()] } else { -weight[f.index()] };
                faces.iter().map(area).sum::<f64>() > 0.0
            })
            .collect();
        let borders = Borders::new(&own, charts, &topology);
        let mut mesh = MergeMesh {
            corners: own.corners.iter().map(|c| c.map(|u| u.0)).collect(),
            star: stars(&own),
            link: linked_edges(&own, charts, &topology, &reversed, &mostly_reversed),
            twin: topology.uv_twin,
            next: borders.next,
            prev: borders.prev,
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
            uv: own.uv,
        };
        let cell = mesh.usual_size();
        for (c, faces) in charts.faces.iter().enumerate() {
            let faces: Vec<u32> = faces.iter().map(|f| f.0).collect();
            let chart = mesh.input_chart(c as u32, faces, cell, borders.manifold[c], mergeable[c]);
            mesh.charts.push(chart);
        }
        mesh
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
fn mirror_charts(atlas: &mut Atlas, charts: &Charts, mirrored: &[bool]) {
    let mut done = vec![false; atlas.uv.len()];
    for (corners, _) in atlas.corners.iter().zip(&charts.of_face).filter(|(_, c)| mirrored[c.index()]) {
        for u in corners {
            if !std::mem::replace(&mut done[u.index()], true) {
                atlas.uv[u.index()] = mirror(atlas.uv[u.index()]);
            }
        }
    }
}

/// Faces incident to each UV vertex.
fn stars(atlas: &Atlas) -> Vec<Vec<u32>> {
    let mut star: Vec<Vec<u32>> = vec![Vec::new(); atlas.uv.len()];
    for (f, c) in atlas.corners.iter().enumerate() {
        for (k, u) in c.iter().enumerate() {
            if !c[..k].contains(u) {
                star[u.index()].push(f as u32);
            }
        }
    }
    star
}

/// By half edge: that across the seam, where both may be dissolved.
fn linked_edges(
    atlas: &Atlas,
    charts: &Charts,
    topology: &Topology,
    reversed: &[bool],
    mostly_reversed: &[bool],
) -> Vec<u32> {
    let opposite = |h: u32, t: u32| {
        let vertex = |h: u32| atlas.surface.triangles[h as usize / 3][h as usize % 3];
        vertex(h) == vertex(after(t)) && vertex(after(h)) == vertex(t)
    };
    // Sides of a surface that is wound one way here and another there would look folded to each other.
    let mostly = |h: u32| mostly_reversed[charts.of_face[h as usize / 3].index()];
    let usual = |h: u32| reversed[h as usize / 3] == mostly(h);
    (0..3 * atlas.face_count() as u32)
        .map(|h| {
            let t = topology.surface_twin[h as usize];
            let is_seam = topology.is_seam(h) && topology.is_seam(t) && opposite(h, t);
            if is_seam && usual(h) && usual(t) && mostly(h) == mostly(t) { t } else { NONE }
        })
        .collect()
}

/// The borders of charts.
struct Borders {
    /// By half edge on a border.
    next: Vec<u32>,
    prev: Vec<u32>,
    /// By chart: whether its border falls into loops.
    manifold: Vec<bool>,
}

impl Borders {
    fn new(atlas: &Atlas, charts: &Charts, topology: &Topology) -> Self {
        let n = 3 * atlas.face_count();
        let corner = |h: u32| atlas.corners[h as usize / 3][h as usize % 3];
        let chart = |h: u32| charts.of_face[h as usize / 3].index();
        let (mut next, mut prev) = (vec![NONE; n], vec![NONE; n]);
        let mut manifold = vec![true; charts.len()];
        topology.crowded.iter().flatten().for_each(|f| manifold[charts.of_face[f.index()].index()] = false);
        for h in 0..n as u32 {
            let twin = topology.uv_twin[h as usize];
            if twin != NONE {
                // Faces that still run alike along a common edge.
                manifold[chart(h)] &= corner(h) == corner(after(twin));
                continue;
            }
            let mut to = after(h);
            let mut left = n;
            while topology.uv_twin[to as usize] != NONE && left > 0 {
                to = after(topology.uv_twin[to as usize]);
                left -= 1;
            }
            if left == 0 || prev[to as usize] != NONE {
                manifold[chart(h)] = false;
            } else {
                next[h as usize] = to;
                prev[to as usize] = h;
            }
        }
        Borders { next, prev, manifold }
    }
}

/// The next half edge of the face.
pub(super) fn after(h: u32) -> u32 {
    h / 3 * 3 + (h + 1) % 3
}
