//! The atlas while its charts are being merged.
//!
//! Faces are wound so that neighbours in a chart run along their common edge in opposite directions and each chart's area is positive:
//! what the upload wound the other way round is turned here, and turned back at the end.

use std::collections::BTreeMap;

use glam::DVec2;

use super::grid::Grid;
use crate::atlas::bvh::Bounds;
use crate::atlas::rigid::Rigid;
use crate::atlas::{Atlas, Charts, FaceId, HalfEdge, Topology, UvId, orientation};
use crate::numeric::energy::{arap, jacobian};

/// No half edge.
pub(super) const NONE: u32 = u32::MAX;

fn raw(h: Option<HalfEdge>) -> u32 {
    h.map_or(NONE, |h| h.0)
}

/// A chart under merging.
#[derive(Debug, Clone, Default)]
pub(super) struct Chart {
    /// Its faces; none once it is part of another.
    pub faces: Vec<u32>,
    /// UV area.
    pub area: f64,
    /// UV length of the border.
    pub perimeter: f64,
    /// Where it lies, or a little more.
    pub bounds: Bounds,
    /// Faces by place.
    pub grid: Grid,
    /// Charts of the input that it is made of.
    pub parts: Vec<u32>,
    /// The one of them whose texels it is placed for, as far as known.
    pub main: u32,
    /// Whether its border falls into loops: not where more than two faces share an edge.
    pub sound: bool,
    /// Whether it may be merged at all.
    pub open: bool,
    /// What became of it, in order: where it changed, in its own coordinates.
    pub changes: Vec<Bounds>,
    /// 3D area that keeps its texels if the chart is placed for it, about.
    pub kept: f64,
}

/// The atlas under merging. Every UV vertex belongs to one chart.
#[derive(Debug, Clone)]
pub(super) struct Mesh {
    /// UV vertices by face.
    pub corners: Vec<[u32; 3]>,
    /// UV triangles of the input.
    pub rest: Vec<[DVec2; 3]>,
    /// Their area, zero where they have no shape.
    pub weight: Vec<f64>,
    /// 3D area by face.
    pub area: Vec<f64>,
    /// Whether the face was turned over.
    turned: Vec<bool>,
    /// By UV vertex.
    pub uv: Vec<DVec2>,
    /// Faces about each UV vertex.
    pub star: Vec<Vec<u32>>,
    /// By half edge: across it in the chart.
    pub twin: Vec<u32>,
    /// By half edge: across it on the surface, where it may be merged: the two run in opposite directions.
    pub link: Vec<u32>,
    /// By half edge on a border: the next along it, and the one before.
    pub next: Vec<u32>,
    pub prev: Vec<u32>,
    /// By face.
    pub chart_of: Vec<u32>,
    /// By face: its chart in the input.
    pub home: Vec<u32>,
    /// By chart.
    pub charts: Vec<Chart>,
    /// By chart of the input: how it moved, after it was mirrored where it was.
    pub motion: Vec<Rigid>,
    /// By chart of the input: whether it was mirrored (x to -x), its triangles in `rest` too.
    pub mirrored: Vec<bool>,
    /// By chart of the input: one whose texels lie on the same grid as its own.
    pub grid_of: Vec<u32>,
    /// By face: turned over against most of its chart, so that in the input's winding it looks right where it is folded.
    pub odd: Vec<bool>,
    /// By face: deformed, and not only moved.
    pub deformed: Vec<bool>,
    /// By face: its energy times its weight.
    pub energy: Vec<f64>,
    /// Distances below this are rounding.
    pub tolerance: f64,
}

impl Mesh {
    /// `open` says which charts may be merged; `may_mirror` whether a chart may be mirrored to fit its neighbours.
    pub(super) fn new(atlas: &Atlas, charts: &Charts, open: &[bool], may_mirror: bool) -> Self {
        let Winding { atlas: own, turned, mirrored } = wound_alike(atlas, charts, may_mirror);
        let mut separate = crate::atlas::Mesh::new(own);
        separate.divide_by_chart(|f| charts.of_face[f.index()].0);
        let mut own = separate.atlas().clone();
        let mut done = vec![false; own.uv.len()];
        for (corners, _) in own.corners.iter().zip(&charts.of_face).filter(|(_, c)| mirrored[c.index()]) {
            for u in corners {
                if !std::mem::replace(&mut done[u.index()], true) {
                    own.uv[u.index()] = mirror(own.uv[u.index()]);
                }
            }
        }
        let topology = Topology::new(&own);
        let uv_twin: Vec<u32> = topology.half_edges().map(|h| raw(topology.uv_twin(h))).collect();
        let n = own.face_count();
        let extent = own.uv.iter().filter(|p| p.is_finite()).map(|p| p.abs().max_element()).fold(1.0, f64::max);
        let rest: Vec<[DVec2; 3]> = own.faces().map(|f| own.uv_triangle(f)).collect();
        let weight: Vec<f64> = rest
            .iter()
            .map(|r| jacobian(r, r).map_or(0.0, |_| 0.5 * (r[1] - r[0]).perp_dot(r[2] - r[0]).abs()))
            .collect();
        let corner = |h: u32| own.corners[h as usize / 3][h as usize % 3];
        let opposite = |h: u32, t: u32| {
            let vertex = |h: u32| own.surface.triangles[h as usize / 3][h as usize % 3];
            vertex(h) == vertex(after(t)) && vertex(after(h)) == vertex(t)
        };
        let mostly: Vec<bool> = (charts.faces.iter())
            .map(|faces| {
                let area = |f: &FaceId| if turned[f.index()] { weight[f.index()] } else { -weight[f.index()] };
                faces.iter().map(area).sum::<f64>() > 0.0
            })
            .collect();
        let mut link = vec![NONE; 3 * n];
        for h in 0..3 * n as u32 {
            let t = raw(topology.across_seam(HalfEdge(h)));
            // Sides of a surface that is wound one way here and another there would look folded to each other.
            let most = |h: u32| mostly[charts.of_face[h as usize / 3].index()];
            let alike = || turned[h as usize / 3] == most(h) && turned[t as usize / 3] == most(t) && most(h) == most(t);
            if t != NONE && opposite(h, t) && alike() {
                link[h as usize] = t;
            }
        }
        let mut star: Vec<Vec<u32>> = vec![Vec::new(); own.uv.len()];
        for (f, c) in own.corners.iter().enumerate() {
            for (k, u) in c.iter().enumerate() {
                if !c[..k].contains(u) {
                    star[u.index()].push(f as u32);
                }
            }
        }
        let (mut next, mut prev) = (vec![NONE; 3 * n], vec![NONE; 3 * n]);
        let mut sound = vec![true; charts.len()];
        topology.incident_faces().flatten().for_each(|f| sound[charts.of_face[f.index()].index()] = false);
        for h in 0..3 * n as u32 {
            if uv_twin[h as usize] != NONE {
                // Faces that still run alike along a common edge.
                let t = uv_twin[h as usize];
                if corner(h) != corner(after(t)) {
                    sound[charts.of_face[h as usize / 3].index()] = false;
                }
                continue;
            }
            let mut to = after(h);
            let mut left = 3 * n;
            while uv_twin[to as usize] != NONE && left > 0 {
                to = after(uv_twin[to as usize]);
                left -= 1;
            }
            if left == 0 || prev[to as usize] != NONE {
                sound[charts.of_face[h as usize / 3].index()] = false;
            } else {
                next[h as usize] = to;
                prev[to as usize] = h;
            }
        }
        let odd = (0..n).map(|f| turned[f] != mostly[charts.of_face[f].index()]).collect();
        let mut mesh = Mesh {
            corners: own.corners.iter().map(|c| c.map(|u| u.0)).collect(),
            area: own.faces().map(|f| own.area(f)).collect(),
            rest,
            weight,
            turned,
            star,
            twin: uv_twin,
            link,
            next,
            prev,
            chart_of: charts.of_face.iter().map(|c| c.0).collect(),
            home: charts.of_face.iter().map(|c| c.0).collect(),
            charts: Vec::new(),
            motion: vec![Rigid::IDENTITY; charts.len()],
            mirrored,
            grid_of: (0..charts.len() as u32).collect(),
            odd,
            deformed: vec![false; n],
            energy: vec![0.0; n],
            tolerance: 1e-12 * extent,
            uv: own.uv,
        };
        let cell = mesh.usual_size();
        for (c, faces) in charts.faces.iter().enumerate() {
            let faces: Vec<u32> = faces.iter().map(|f| f.0).collect();
            let finite = faces.iter().all(|&f| mesh.triangle(f).iter().all(|p| p.is_finite()));
            let mut chart = Chart {
                parts: vec![c as u32],
                main: c as u32,
                sound: sound[c],
                open: open[c] && finite,
                grid: Grid::new(cell),
                ..Chart::default()
            };
            for &f in &faces {
                let bounds = Bounds::of(&mesh.triangle(f));
                chart.bounds = chart.bounds.union(bounds);
                chart.area += mesh.weight[f as usize];
                chart.kept += mesh.area[f as usize];
                chart.grid.add(f, &bounds);
                for h in 3 * f..3 * f + 3 {
                    if mesh.twin[h as usize] == NONE {
                        chart.perimeter += mesh.length(h);
                    }
                }
            }
            chart.faces = faces;
            mesh.charts.push(chart);
        }
        mesh
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

    /// UV vertex at the start of a half edge.
    pub(super) fn start(&self, h: u32) -> u32 {
        self.corners[h as usize / 3][h as usize % 3]
    }

    /// UV vertex at its end.
    pub(super) fn end(&self, h: u32) -> u32 {
        self.corners[h as usize / 3][(h as usize + 1) % 3]
    }

    /// UV length of a half edge.
    pub(super) fn length(&self, h: u32) -> f64 {
        self.uv[self.start(h) as usize].distance(self.uv[self.end(h) as usize])
    }

    /// The chart of a half edge.
    pub(super) fn chart(&self, h: u32) -> u32 {
        self.chart_of[h as usize / 3]
    }

    /// Where a face lies.
    pub(super) fn triangle(&self, face: u32) -> [DVec2; 3] {
        self.corners[face as usize].map(|u| self.uv[u as usize])
    }

    /// Whether a face has a border edge.
    pub(super) fn on_border(&self, face: u32) -> bool {
        (3 * face..3 * face + 3).any(|h| self.twin[h as usize] == NONE)
    }

    /// Energy of a face if it lay there, times its weight.
    pub(super) fn energy_at(&self, face: u32, at: &[DVec2; 3]) -> f64 {
        let weight = self.weight[face as usize];
        if weight == 0.0 {
            return 0.0;
        }
        let rest = &self.rest[face as usize];
        let energy = |rest: &[DVec2; 3]| jacobian(rest, at).map_or(0.0, |j| weight * arap(&j));
        if sign(rest) < 0 { energy(rest).min(energy(&rest.map(mirror))) } else { energy(rest) }
    }

    /// The shape that a face should have: one that was turned over in the input is turned back where it gets the chance. Not one of two
    /// that lie back to back.
    pub(super) fn shape(&self, face: u32) -> [DVec2; 3] {
        let rest = self.rest[face as usize];
        let [a, b, c] =
            [0, 1, 2].map(|k| self.twin[3 * face as usize + k]).map(|t| if t == NONE { NONE } else { t / 3 });
        let back_to_back = a == b && a != NONE || b == c && b != NONE || a == c && a != NONE;
        if sign(&rest) < 0 && !back_to_back && !self.odd[face as usize] { rest.map(mirror) } else { rest }
    }

    /// Pairs of linked half edges by pair of charts (the smaller first), each once.
    pub(super) fn links(&self) -> BTreeMap<(u32, u32), Vec<u32>> {
        let mut links: BTreeMap<(u32, u32), Vec<u32>> = BTreeMap::new();
        for h in 0..self.link.len() as u32 {
            let t = self.link[h as usize];
            if t == NONE || t < h {
                continue;
            }
            let (a, b) = (self.chart(h), self.chart(t));
            if self.charts[a as usize].open && self.charts[b as usize].open {
                links.entry((a.min(b), a.max(b))).or_default().push(h);
            }
        }
        links
    }

    /// The atlas with the merged charts, faces wound as they were; `before` is the one that the mesh was made from.
    pub(super) fn into_atlas(self, before: &Atlas, at: impl Fn(u32, [DVec2; 3]) -> [DVec2; 3]) -> Atlas {
        let mut atlas = Atlas { uv: Vec::new(), ..before.clone() };
        let mut name = vec![u32::MAX; self.uv.len()];
        for f in 0..self.corners.len() {
            let now = at(f as u32, self.triangle(f as u32));
            let mut corners = [0, 1, 2].map(|k| {
                let name = &mut name[self.corners[f][k] as usize];
                if *name == u32::MAX {
                    *name = atlas.uv.len() as u32;
                    atlas.uv.push(now[k]);
                }
                UvId(*name)
            });
            if self.turned[f] {
                corners.swap(1, 2);
            }
            atlas.corners[f] = corners;
        }
        atlas
    }
}

/// The next half edge of the face.
pub(super) fn after(h: u32) -> u32 {
    h / 3 * 3 + (h + 1) % 3
}

/// How faces are wound so that neighbours agree.
struct Winding {
    /// The atlas, wound so.
    atlas: Atlas,
    /// By face: turned over.
    turned: Vec<bool>,
    /// By chart: mirrored (x to -x), because its neighbours on the surface are.
    mirrored: Vec<bool>,
}

/// Faces turned so that neighbours in a chart agree and the chart's area is positive. Where charts then still disagree with larger
/// neighbours along their seams, one of them is the mirror image of what the surface shows: it is mirrored too, if `mirror`.
fn wound_alike(atlas: &Atlas, charts: &Charts, mirror: bool) -> Winding {
    let topology = Topology::new(atlas);
    let n = atlas.face_count();
    let corner = |h: u32| atlas.corners[h as usize / 3][h as usize % 3];
    let mut turned = vec![false; n];
    let mut seen = vec![false; n];
    let mut one_part = vec![true; charts.len()];
    let mut areas = vec![0.0; charts.len()];
    for (c, faces) in charts.faces.iter().enumerate() {
        // Parts that only hang together where an edge is crowded are wound one by one.
        for (i, seed) in faces.iter().enumerate() {
            if std::mem::replace(&mut seen[seed.index()], true) {
                continue;
            }
            one_part[c] &= i == 0;
            let mut part = vec![seed.0];
            let mut next = 0;
            while next < part.len() {
                let f = part[next];
                for h in 3 * f..3 * f + 3 {
                    let t = raw(topology.uv_twin(HalfEdge(h)));
                    if t == NONE || std::mem::replace(&mut seen[t as usize / 3], true) {
                        continue;
                    }
                    let alike = corner(h) == corner(t);
                    turned[t as usize / 3] = turned[f as usize] ^ alike;
                    part.push(t / 3);
                }
                next += 1;
            }
            let area: f64 =
                part.iter().map(|&f| if turned[f as usize] { -1.0 } else { 1.0 } * atlas.uv_area(FaceId(f))).sum();
            areas[c] += area.abs();
            if area < 0.0 {
                part.iter().for_each(|&f| turned[f as usize] ^= true);
            }
        }
    }
    let mut mirrored = vec![false; charts.len()];
    if mirror {
        let vertex = |h: u32| atlas.surface.triangles[h as usize / 3][h as usize % 3];
        let mut order: Vec<usize> = (0..charts.len()).filter(|&c| one_part[c]).collect();
        order.sort_by(|&a, &b| areas[b].total_cmp(&areas[a]).then(a.cmp(&b)));
        let mut decided = vec![false; charts.len()];
        for c in order {
            // Length of seams to larger charts along which windings agree, less that along which they do not.
            let mut agree = 0.0;
            for f in &charts.faces[c] {
                for h in 3 * f.0..3 * f.0 + 3 {
                    let t = raw(topology.across_seam(HalfEdge(h)));
                    if t == NONE || !decided[charts.of_face[t as usize / 3].index()] {
                        continue;
                    }
                    let opposite = vertex(h) != vertex(t);
                    let wound = turned[h as usize / 3] == turned[t as usize / 3];
                    let [p, q] = [vertex(h), vertex(after(h))].map(|v| atlas.surface.positions[v.index()]);
                    agree += if opposite == wound { p.distance(q) } else { -p.distance(q) };
                }
            }
            decided[c] = true;
            if agree < 0.0 {
                mirrored[c] = true;
                charts.faces[c].iter().for_each(|f| turned[f.index()] ^= true);
            }
        }
    }
    let mut own = atlas.clone();
    for (f, _) in turned.iter().enumerate().filter(|(_, t)| **t) {
        own.corners[f].swap(1, 2);
        own.surface.triangles[f].swap(1, 2);
    }
    Winding { atlas: own, turned, mirrored }
}

/// The mirror image of a point.
pub(super) fn mirror(p: DVec2) -> DVec2 {
    DVec2::new(-p.x, p.y)
}

/// The sign of a triangle's area, exact.
pub(super) fn sign(t: &[DVec2; 3]) -> i8 {
    orientation(t[0], t[1], t[2])
}
