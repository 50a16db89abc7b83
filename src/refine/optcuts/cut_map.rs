//! A surface, cut open and laid into the plane: what the search works on.

use std::f64::consts::PI;

use glam::DVec2;

use crate::atlas::{Atlas, FaceId, HalfEdge, Mesh, UvId, VertexId};
use crate::numeric::dirichlet::RestTriangle;
use crate::numeric::newton::{self, Element, Workspace};
use crate::numeric::scaffold::{raised, void_triangles};

/// Energy of all void triangles together, in parts of that of an isometry of the whole surface (Jiang et al. 2017 take a hundredth).
const VOID_ENERGY: f64 = 0.01;
/// Height in mean edges below which a void triangle wants to be higher.
const NARROWEST: f64 = 0.1;
/// Part of the vertices beyond which all move in a local step.
const MOST_LOCAL: f64 = 0.67;

/// A piece of a surface and its map. Lengths are such that the surface's area is pi, so that seam lengths are E_s (eq. 4) and energies E_d (eq. 5).
#[derive(Debug, Clone)]
pub(super) struct CutMap {
    /// Which corners hang together. Its positions are not kept up: see `x`.
    pub mesh: Mesh,
    /// Where each UV vertex lies.
    pub x: Vec<DVec2>,
    /// By face.
    pub rest: Vec<RestTriangle>,
    /// By half edge: what a seam there costs, weights counted.
    pub cost: Vec<f64>,
    /// Border half edges, in no order that matters.
    pub borders: Vec<HalfEdge>,
    /// Whether the void is triangulated.
    pub bijective: bool,
    workspace: Room<Workspace>,
    marks: Room<Marks>,
    /// Vertices that the last step moved.
    moved: usize,
}

/// Room to work in, which is no part of the value: a copy has its own.
#[derive(Debug, Default)]
struct Room<T>(T);

impl<T: Default> Clone for Room<T> {
    fn clone(&self) -> Self {
        Self::default()
    }
}

impl<T> std::ops::Deref for Room<T> {
    type Target = T;
    fn deref(&self) -> &T {
        &self.0
    }
}

impl<T> std::ops::DerefMut for Room<T> {
    fn deref_mut(&mut self) -> &mut T {
        &mut self.0
    }
}

/// Vertices and faces that were reached in the current round.
#[derive(Debug, Default)]
struct Marks {
    round: u32,
    vertices: Vec<u32>,
    faces: Vec<u32>,
}

impl Marks {
    fn next(&mut self, vertices: usize, faces: usize) {
        self.round += 1;
        self.vertices.resize(vertices.max(self.vertices.len()), 0);
        self.faces.resize(faces.max(self.faces.len()), 0);
    }

    /// Marks a vertex; false where it was.
    fn vertex(&mut self, u: u32) -> bool {
        std::mem::replace(&mut self.vertices[u as usize], self.round) != self.round
    }

    fn face(&mut self, f: FaceId) -> bool {
        std::mem::replace(&mut self.faces[f.index()], self.round) != self.round
    }

    fn has_face(&self, f: FaceId) -> bool {
        self.faces[f.index()] == self.round
    }
}

/// The corners about a UV vertex in counter-clockwise order, each the half edge that leaves it.
#[derive(Debug, Clone, Default)]
pub(super) struct Fan {
    pub corners: Vec<HalfEdge>,
    /// Whether the first and the last corner's outer edges are borders.
    pub open: bool,
}

impl CutMap {
    /// Of an Atlas whose surface has the area pi. `weights` by surface vertex: an edge costs its length times the mean of its ends' weights.
    pub fn new(atlas: Atlas, weights: Option<&[f64]>, bijective: bool) -> Option<CutMap> {
        let area: f64 = atlas.faces().map(|f| atlas.area(f)).sum();
        let rest = atlas.faces().map(|f| RestTriangle::of_surface(atlas.triangle(f), atlas.area(f) / area));
        let rest: Vec<RestTriangle> = rest.collect::<Option<_>>()?;
        let mesh = Mesh::new(atlas);
        let cost = mesh.topology().half_edges().map(|h| {
            let [a, b] = mesh.surface_ends(h).map(VertexId::index);
            let at = |v: usize| mesh.atlas().surface.positions[v];
            let weight = weights.map_or(1.0, |w| 0.5 * (w[a] + w[b]));
            at(a).distance(at(b)) * weight
        });
        let cost = cost.collect();
        let x = mesh.atlas().uv.clone();
        let mut map = CutMap {
            mesh,
            x,
            rest,
            cost,
            borders: Vec::new(),
            bijective,
            workspace: Room::default(),
            marks: Room::default(),
            moved: 0,
        };
        map.find_borders();
        Some(map)
    }

    /// Lists the borders anew.
    pub fn find_borders(&mut self) {
        let topology = self.mesh.topology();
        self.borders = topology.half_edges().filter(|h| topology.is_border(*h)).collect();
    }

    /// E_s: what all seams cost, each once; the surface's own boundary is none.
    pub fn seam_length(&self) -> f64 {
        self.seams().map(|h| self.cost[h.index()]).sum()
    }

    /// The seams, each once.
    pub fn seams(&self) -> impl Iterator<Item = HalfEdge> + '_ {
        let topology = self.mesh.topology();
        self.borders.iter().copied().filter(|h| topology.surface_twin(*h).is_some_and(|t| t > *h))
    }

    /// Length of all seams, whatever they cost.
    pub fn unweighted_seam_length(&self) -> f64 {
        self.seams().map(|h| self.edge_length(h)).sum()
    }

    /// Length of an edge on the surface.
    pub fn edge_length(&self, h: HalfEdge) -> f64 {
        let [a, b] = self.mesh.surface_ends(h).map(|v| self.mesh.atlas().surface.positions[v.index()]);
        a.distance(b)
    }

    /// The Atlas with its UVs where they lie.
    pub fn into_atlas(self) -> Atlas {
        let mut mesh = self.mesh;
        for (u, at) in self.x.iter().enumerate() {
            mesh.move_uv(UvId::new(u), *at);
        }
        mesh.into_atlas()
    }

    /// E_d.
    pub fn distortion(&self) -> f64 {
        self.mesh.atlas().faces().map(|f| self.rest[f.index()].energy(self.triangle(f))).sum()
    }

    /// Where a face's corners lie.
    pub fn triangle(&self, face: FaceId) -> [DVec2; 3] {
        self.mesh.atlas().corners[face.index()].map(|u| self.x[u.index()])
    }

    fn element(&self, face: FaceId) -> Element {
        Element::Triangle {
            corners: self.mesh.atlas().corners[face.index()].map(|u| u.0),
            rest: self.rest[face.index()],
        }
    }

    /// The corners about a UV vertex.
    pub fn fan(&self, uv: UvId) -> Fan {
        let topology = self.mesh.topology();
        let Some(any) = self.mesh.corners_of(uv).next() else { return Fan::default() };
        // Clockwise to the border or once about.
        let (mut first, mut open) = (any, true);
        while let Some(twin) = topology.uv_twin(first) {
            first = twin.next();
            if first == any {
                open = false;
                break;
            }
        }
        let mut corners = vec![first];
        let mut last = first;
        while let Some(twin) = topology.uv_twin(last.previous()) {
            if twin == first {
                break;
            }
            corners.push(twin);
            last = twin;
        }
        Fan { corners, open }
    }

    /// Whether a UV vertex lies on a border.
    pub fn is_border(&self, uv: UvId) -> bool {
        let topology = self.mesh.topology();
        self.mesh.corners_of(uv).any(|c| topology.is_border(c) || topology.is_border(c.previous()))
    }

    /// How many vertices the last step moved.
    pub fn moved(&self) -> usize {
        self.moved
    }

    /// The other end of a half edge.
    pub fn end(&self, h: HalfEdge) -> UvId {
        self.mesh.uv_at(h.next())
    }

    /// One Newton step of the whole map, and `most` - 1 by L-BFGS after it; gives E_d before and after with what the void costs, and how far it went.
    pub fn global_steps(&mut self, most: usize) -> Option<newton::Step> {
        let elements: Vec<Element> = self.mesh.atlas().faces().map(|f| self.element(f)).collect();
        let mut free = vec![false; self.x.len()];
        elements.iter().flat_map(Element::corners).for_each(|v| free[v as usize] = true);
        let mut free: Vec<u32> = (0..free.len() as u32).filter(|v| free[*v as usize]).collect();
        if self.bijective {
            let borders: Vec<[u32; 2]> = self.borders.iter().map(|h| self.mesh.uv_ends(*h).map(|u| u.0)).collect();
            let walls = borders.len();
            return self.step_in_void(elements, &free, borders, walls, 0.5, most);
        }
        // Nothing else holds it.
        free.remove(0);
        newton::steps(&mut self.x, &elements, &free, &mut self.workspace, most)
    }

    /// One Newton step of the vertices within `rings` edges of some.
    pub fn local_step(&mut self, about: &[UvId], rings: usize) -> Option<newton::Step> {
        self.marks.next(self.x.len(), self.rest.len());
        let mut reached: Vec<u32> = about.iter().map(|u| u.0).filter(|u| self.marks.vertex(*u)).collect();
        let mut from = 0;
        for _ in 0..rings {
            let to = reached.len();
            for k in std::mem::replace(&mut from, to)..to {
                for c in self.mesh.corners_of(UvId(reached[k])) {
                    for u in [self.mesh.uv_at(c.next()), self.mesh.uv_at(c.previous())] {
                        if self.marks.vertex(u.0) {
                            reached.push(u.0);
                        }
                    }
                }
            }
        }
        if reached.len() as f64 > MOST_LOCAL * self.x.len() as f64 {
            self.moved = self.x.len();
            return self.global_steps(1);
        }
        reached.sort_unstable();
        self.moved = reached.len();
        let mut faces: Vec<FaceId> = Vec::with_capacity(3 * reached.len());
        for &u in &reached {
            for c in self.mesh.corners_of(UvId(u)) {
                if self.marks.face(c.face()) {
                    faces.push(c.face());
                }
            }
        }
        faces.sort_unstable();
        let elements: Vec<Element> = faces.iter().map(|f| self.element(*f)).collect();
        if !self.bijective {
            return newton::step(&mut self.x, &elements, &reached, &mut self.workspace);
        }
        let topology = self.mesh.topology();
        let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        for v in elements.iter().flat_map(Element::corners) {
            low = low.min(self.x[v as usize]);
            high = high.max(self.x[v as usize]);
        }
        let margin = 0.1 * (high - low).max_element();
        let (low, high) = (low - margin, high + margin);
        let ends = |h: HalfEdge| self.mesh.uv_ends(h).map(|u| u.0);
        let (mut walls, mut inner) = (Vec::new(), Vec::new());
        for f in &faces {
            for h in (0..3).map(|k| HalfEdge::of(*f, k)) {
                match topology.uv_twin(h) {
                    None => walls.push(ends(h)),
                    Some(twin) if !self.marks.has_face(twin.face()) => inner.push(ends(h)),
                    Some(_) => {}
                }
            }
        }
        let borders = walls.len();
        if borders == 0 {
            return newton::step(&mut self.x, &elements, &reached, &mut self.workspace);
        }
        for &h in self.borders.iter().filter(|h| !self.marks.has_face(h.face())) {
            let [a, b] = ends(h).map(|v| self.x[v as usize]);
            if a.min(b).cmple(high).all() && a.max(b).cmpge(low).all() {
                walls.push(ends(h));
            }
        }
        walls.extend(inner);
        self.step_in_void(elements, &reached, walls, borders, 0.1, 1)
    }

    /// Steps with the void about the elements triangulated.
    fn step_in_void(
        &mut self,
        mut elements: Vec<Element>,
        free: &[u32],
        walls: Vec<[u32; 2]>,
        borders: usize,
        margin: f64,
        most: usize,
    ) -> Option<newton::Step> {
        let mut points: Vec<u32> = walls.iter().flatten().copied().collect();
        points.sort_unstable();
        points.dedup();
        let local = |v: u32| points.partition_point(|p| *p < v) as u32;
        let at: Vec<DVec2> = points.iter().map(|&v| self.x[v as usize]).collect();
        let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        at.iter().for_each(|p| {
            low = low.min(*p);
            high = high.max(*p);
        });
        let margin = margin * (high - low).max_element();
        let (low, high) = (low - margin, high + margin);
        let walls: Vec<[u32; 2]> = walls.iter().map(|w| w.map(local)).collect();
        let air = void_triangles(&at, &walls, borders, low, high)?;
        let n = self.x.len();
        self.x.extend([low, DVec2::new(high.x, low.y), high, DVec2::new(low.x, high.y)]);
        let weight = VOID_ENERGY / self.borders.len() as f64;
        // Of equilateral triangles, these would be the edges.
        let edge = (4.0 / 3.0_f64.sqrt() * PI / self.rest.len() as f64).sqrt();
        let least = NARROWEST * edge;
        let is_free = |v: u32| free.binary_search(&v).is_ok();
        for t in air {
            let corners = t.map(|v| points.get(v as usize).copied().unwrap_or((n + v as usize - points.len()) as u32));
            if !corners.into_iter().any(is_free) {
                continue;
            }
            if let Some(rest) = RestTriangle::new(raised(corners.map(|v| self.x[v as usize]), least), weight) {
                elements.push(Element::Triangle { corners, rest });
            }
        }
        let step = newton::steps(&mut self.x, &elements, free, &mut self.workspace, most);
        self.x.truncate(n);
        step
    }
}
