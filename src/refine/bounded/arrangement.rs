//! All straight trails from the corners of an axis-aligned chart, and the rectangles that they divide it into (section 3.2, the quad mesh Q).
//!
//! The chart may lie on itself, so that nothing is asked of the plane: trails are walked from face to face, two of them cross where they are in the same face at
//! the same place, and the cells are found by turning left.

use std::collections::BTreeMap;

use glam::DVec2;

use super::angles::turns;
use super::chart_map::ChartMap;
use super::deform::{axis_direction, runs};
use crate::atlas::bvh::Bounds;
use crate::atlas::{FaceId, HalfEdge, Mesh, TrailEnd, TrailPoint, TrailStart, UvId};

/// Distance in parts of the chart's extent at which two places are one.
const SAME: f64 = 1e-7;

/// Distance from a trail, in parts of [`SAME`], within which a vertex is on it.
const SNAP: f64 = 1e-2;

/// A place where trails begin, end or cross, or a corner.
#[derive(Debug, Clone)]
pub(super) struct Node {
    pub at: DVec2,
    /// By direction (east, north, west, south): the edge that leaves there and the node at its end.
    pub links: [Option<(u32, u32)>; 4],
    /// Whether it is on the boundary of the chart.
    pub on_boundary: bool,
}

/// A stretch between two nodes.
#[derive(Debug, Clone)]
pub(super) struct Edge {
    /// What a cut there costs: its length on the surface. Of the boundary nothing.
    pub cost: f64,
    /// The node from which it was made; the chart is on the left of a boundary edge that leaves there.
    from: u32,
    /// Cells on its left and right, seen along its trail. The boundary has one.
    pub cells: [Option<u32>; 2],
    pub is_boundary: bool,
}

/// A straight walk from a corner, or from a place on a side, to the boundary.
#[derive(Debug, Clone)]
pub(super) struct Motorcycle {
    /// Vertex of the boundary where it starts.
    pub start: usize,
    /// 0..4: east, north, west, south.
    pub direction: usize,
    /// Edges in order, each with the node at its end.
    pub edges: Vec<(u32, u32)>,
    /// The node at which it starts.
    pub from: u32,
    /// Whether it starts at a reflex corner, where one of two must run.
    pub is_corner: bool,
    /// How far it can run, in texels.
    pub length: f64,
}

/// Trails, nodes, edges and cells of one chart.
#[derive(Debug, Clone, Default)]
pub(super) struct Arrangement {
    pub nodes: Vec<Node>,
    pub edges: Vec<Edge>,
    pub motorcycles: Vec<Motorcycle>,
    /// Rectangles that no trail divides.
    pub cells: Vec<Bounds>,
}

/// A trail as it was walked.
struct Walk {
    start: usize,
    direction: usize,
    is_corner: bool,
    origin: DVec2,
    length: f64,
    /// (how far at the end, the faces that may be walked until there).
    stretches: Vec<(f64, Vec<FaceId>)>,
    /// (how far, how far on the surface).
    surface: Vec<(f64, f64)>,
    /// Where it ends: at a boundary vertex, or on the boundary edge from one.
    end: End,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum End {
    Vertex(usize),
    Edge(usize),
}

impl Walk {
    fn axis(&self) -> usize {
        self.direction % 2
    }

    fn along(&self, p: DVec2) -> f64 {
        (p - self.origin).dot(axis_direction(self.direction as i32))
    }

    /// The faces in which it is at a distance from its start.
    fn faces_at(&self, t: f64, near: f64) -> impl Iterator<Item = FaceId> + '_ {
        let from = self.stretches.partition_point(|s| s.0 < t - near);
        let mut begin = if from == 0 { 0.0 } else { self.stretches[from - 1].0 };
        self.stretches[from..]
            .iter()
            .take_while(move |s| {
                let is_near = begin <= t + near;
                begin = s.0;
                is_near
            })
            .flat_map(|s| s.1.iter().copied())
    }

    fn surface_at(&self, t: f64) -> f64 {
        let k = self.surface.partition_point(|s| s.0 < t).clamp(1, self.surface.len() - 1);
        let (a, b) = (self.surface[k - 1], self.surface[k]);
        let part = if b.0 > a.0 { ((t - a.0) / (b.0 - a.0)).clamp(0.0, 1.0) } else { 0.0 };
        a.1 + part * (b.1 - a.1)
    }
}

/// The arrangement of a chart whose flattened map is in the mesh. `more` are boundary vertices on straight sides from which a trail may run too.
/// `weight` multiplies the cost of what is cut in a face. `None` where trails get lost.
pub(super) fn arrange(
    mesh: &Mesh,
    map: &ChartMap,
    targets: &[i32],
    more: &[usize],
    weight: &dyn Fn(FaceId) -> f64,
) -> Option<Arrangement> {
    let n = map.boundary.len();
    let turns = turns(targets);
    let near = SAME * Bounds::of(&map.x).size().max_element();
    let place = map.places();
    let mut starts = Vec::new();
    for i in (0..n).filter(|i| turns[*i] < 0) {
        let before = targets[(i + n - 1) % n] - if i == 0 { 4 } else { 0 };
        starts.push((i, before.rem_euclid(4) as usize, true));
        starts.push((i, (targets[i] + 2).rem_euclid(4) as usize, true));
    }
    for &i in more.iter().filter(|i| turns[**i] == 0) {
        starts.push((i, (targets[i] + 1).rem_euclid(4) as usize, false));
    }
    let ground = Ground { mesh, map, place, near, weight };
    let walks = starts.into_iter().map(|start| walk(&ground, start)).collect::<Option<_>>()?;
    build(map, targets, &turns, walks, near)
}

/// What trails of one chart are walked on.
struct Ground<'a> {
    mesh: &'a Mesh,
    map: &'a ChartMap,
    /// Place on the boundary, by UV vertex.
    place: BTreeMap<UvId, usize>,
    near: f64,
    weight: &'a dyn Fn(FaceId) -> f64,
}

/// Walks from a boundary vertex to the boundary. `None` where the trail gets lost.
fn walk(ground: &Ground<'_>, (start, direction, is_corner): (usize, usize, bool)) -> Option<Walk> {
    let Ground { mesh, map, place, near, weight } = ground;
    let uv = map.uvs[map.boundary[start] as usize];
    let own = |c: &HalfEdge| map.faces.binary_search(&c.face()).is_ok();
    let corner = mesh.corners_of(uv).find(own)?;
    let along = axis_direction(direction as i32);
    let mut trail = mesh.trail(TrailStart::Corner(corner), along, f64::INFINITY, near * SNAP);
    // A corner that it touches on its way ends it, as any place of the boundary does.
    let touches = |p: &TrailPoint| matches!(p, TrailPoint::Vertex(u) if place.contains_key(u));
    if let Some(at) = trail.points.iter().skip(1).position(touches) {
        trail.points.truncate(at + 2);
        trail.end = TrailEnd::Border;
        trail.length = (mesh.point_position(trail.points[at + 1]) - mesh.position(uv)).dot(along);
    }
    if trail.end != TrailEnd::Border || trail.points.len() < 2 {
        return None;
    }
    let topology = mesh.topology();
    let mut walk = Walk {
        start,
        direction,
        is_corner,
        origin: mesh.position(uv),
        length: trail.length,
        stretches: Vec::with_capacity(trail.points.len()),
        surface: vec![(0.0, 0.0)],
        end: End::Vertex(0),
    };
    let surface_at = |p: TrailPoint| {
        let positions = &mesh.atlas().surface.positions;
        match p {
            TrailPoint::Vertex(u) => {
                let c = mesh.corners_of(u).next()?;
                Some(positions[mesh.vertex_at(c).index()])
            }
            TrailPoint::Edge(h, t) => {
                let [a, b] = mesh.surface_ends(h).map(|v| positions[v.index()]);
                Some(a + (b - a) * t)
            }
        }
    };
    let mut length = 0.0;
    for pair in trail.points.windows(2) {
        let faces = faces_between(mesh, pair[0], pair[1]);
        if faces.is_empty() {
            return None;
        }
        let t = walk.along(mesh.point_position(pair[1]));
        let cost = weight(faces[0]);
        length += cost * surface_at(pair[0])?.distance(surface_at(pair[1])?);
        walk.surface.push((t, length));
        walk.stretches.push((t, faces));
    }
    let last = *trail.points.last()?;
    walk.end = match last {
        TrailPoint::Vertex(u) => End::Vertex(*place.get(&u)?),
        TrailPoint::Edge(h, _) => {
            topology.is_border(h).then_some(())?;
            let [a, b] = mesh.uv_ends(h);
            let (i, j) = (*place.get(&a)?, *place.get(&b)?);
            let n = map.boundary.len();
            if (i + 1) % n == j { End::Edge(i) } else { End::Edge(j) }
        }
    };
    Some(walk)
}

/// The faces in which a trail is between two of its points that follow each other.
fn faces_between(mesh: &Mesh, a: TrailPoint, b: TrailPoint) -> Vec<FaceId> {
    let faces = |p: TrailPoint| -> Vec<FaceId> {
        match p {
            TrailPoint::Vertex(u) => mesh.star(u).collect(),
            TrailPoint::Edge(h, _) => {
                let twin = mesh.topology().uv_twin(h);
                [Some(h.face()), twin.map(HalfEdge::face)].into_iter().flatten().collect()
            }
        }
    };
    let other = faces(b);
    faces(a).into_iter().filter(|f| other.contains(f)).collect()
}

/// Nodes on one line in order.
fn build(map: &ChartMap, targets: &[i32], turns: &[i32], walks: Vec<Walk>, near: f64) -> Option<Arrangement> {
    let n = map.boundary.len();
    let mut out = Arrangement::default();
    let node = |out: &mut Arrangement, at: DVec2, on_boundary: bool| {
        out.nodes.push(Node { at, links: [None; 4], on_boundary });
        out.nodes.len() as u32 - 1
    };
    let at = |i: usize| map.x[map.boundary[i] as usize];
    // The sides, with the nodes on each by how far along.
    let sides = runs(targets);
    let mut side_of_edge = vec![0; n];
    let mut side_nodes: Vec<Vec<(f64, u32)>> = vec![Vec::new(); sides.len()];
    let mut corner_node = vec![u32::MAX; n];
    for i in (0..n).filter(|i| turns[*i] != 0) {
        corner_node[i] = node(&mut out, at(i), true);
    }
    for (s, (run, _)) in sides.iter().enumerate() {
        run.iter().for_each(|i| side_of_edge[*i] = s);
    }
    let along_side = |s: usize, p: DVec2| {
        let first = sides[s].0[0];
        (p - at(first)).dot(axis_direction(targets[first]))
    };
    for (s, (run, _)) in sides.iter().enumerate() {
        let end = (run[run.len() - 1] + 1) % n;
        side_nodes[s].push((0.0, corner_node[run[0]]));
        side_nodes[s].push((along_side(s, at(end)), corner_node[end]));
    }
    let on_side = |out: &mut Arrangement, side_nodes: &mut Vec<Vec<(f64, u32)>>, s: usize, p: DVec2| {
        let t = along_side(s, p);
        if let Some((_, known)) = side_nodes[s].iter().find(|(other, _)| (other - t).abs() <= near) {
            return *known;
        }
        let made = node(out, p, true);
        side_nodes[s].push((t, made));
        made
    };
    // By walk: nodes with their distance from its start.
    let mut on_walk: Vec<Vec<(f64, u32)>> = Vec::with_capacity(walks.len());
    for w in &walks {
        let from = if corner_node[w.start] != u32::MAX {
            corner_node[w.start]
        } else {
            on_side(&mut out, &mut side_nodes, side_of_edge[w.start], at(w.start))
        };
        let end_at = w.origin + axis_direction(w.direction as i32) * w.length;
        let to = match w.end {
            End::Vertex(i) if corner_node[i] != u32::MAX => corner_node[i],
            End::Vertex(i) | End::Edge(i) => on_side(&mut out, &mut side_nodes, side_of_edge[i], end_at),
        };
        on_walk.push(vec![(0.0, from), (w.length, to)]);
    }
    let across: [Vec<usize>; 2] = [0, 1].map(|axis| (0..walks.len()).filter(|w| walks[*w].axis() == axis).collect());
    // Crossings of walks that lie on each other are the same places.
    for &h in &across[0] {
        for &v in &across[1] {
            let p = DVec2::new(walks[v].origin.x, walks[h].origin.y);
            let (s, t) = (walks[h].along(p), walks[v].along(p));
            if s < -near || t < -near || s > walks[h].length + near || t > walks[v].length + near {
                continue;
            }
            let other: Vec<FaceId> = walks[v].faces_at(t, near).collect();
            if !walks[h].faces_at(s, near).any(|f| other.contains(&f)) {
                continue;
            }
            let known_on = |w: usize, at: f64| on_walk[w].iter().find(|(d, _)| (d - at).abs() <= near).map(|(_, n)| *n);
            let made = match (known_on(h, s), known_on(v, t)) {
                (Some(a), Some(b)) if a == b => continue,
                (Some(a), Some(b)) => {
                    // Two names of one place: walks that lie on each other.
                    let (keep, drop) = (a.min(b), a.max(b));
                    merge(&mut out, keep, drop);
                    let rename =
                        |list: &mut Vec<(f64, u32)>| list.iter_mut().filter(|e| e.1 == drop).for_each(|e| e.1 = keep);
                    on_walk.iter_mut().for_each(rename);
                    side_nodes.iter_mut().for_each(rename);
                    corner_node.iter_mut().filter(|e| **e == drop).for_each(|e| *e = keep);
                    continue;
                }
                (Some(a), None) | (None, Some(a)) => a,
                (None, None) => node(&mut out, p, false),
            };
            for (w, d) in [(h, s), (v, t)] {
                if !on_walk[w].iter().any(|(_, known)| *known == made) {
                    on_walk[w].push((d, made));
                }
            }
        }
    }
    // Sides first, then walks; a stretch that is known already is used again.
    for (s, nodes) in side_nodes.iter_mut().enumerate() {
        nodes.sort_by(|a, b| a.0.total_cmp(&b.0));
        let direction = targets[sides[s].0[0]].rem_euclid(4) as usize;
        for pair in nodes.windows(2) {
            link(&mut out, pair[0].1, pair[1].1, direction, 0.0, true)?;
        }
    }
    for (w, nodes) in walks.iter().zip(&mut on_walk) {
        nodes.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut edges = Vec::with_capacity(nodes.len());
        for pair in nodes.windows(2) {
            if pair[0].1 == pair[1].1 {
                continue;
            }
            let cost = w.surface_at(pair[1].0) - w.surface_at(pair[0].0);
            edges.push((link(&mut out, pair[0].1, pair[1].1, w.direction, cost, false)?, pair[1].1));
        }
        // A walk that only follows a side is none.
        if edges.is_empty() || edges.iter().any(|(e, _)| out.edges[*e as usize].is_boundary) {
            return None;
        }
        let from = nodes[0].1;
        out.motorcycles.push(Motorcycle {
            start: w.start,
            direction: w.direction,
            edges,
            from,
            is_corner: w.is_corner,
            length: w.length,
        });
    }
    find_cells(&mut out)?;
    Some(out)
}

fn merge(out: &mut Arrangement, keep: u32, drop: u32) {
    let is_boundary = out.nodes[drop as usize].on_boundary;
    out.nodes[keep as usize].on_boundary |= is_boundary;
}

/// Joins two nodes by an edge, or gives the one that joins them already. `None` where another node is joined there.
fn link(out: &mut Arrangement, a: u32, b: u32, direction: usize, cost: f64, is_boundary: bool) -> Option<u32> {
    let back = (direction + 2) % 4;
    let known = (out.nodes[a as usize].links[direction], out.nodes[b as usize].links[back]);
    match known {
        (None, None) => {
            let e = out.edges.len() as u32;
            out.edges.push(Edge { cost, from: a, cells: [None; 2], is_boundary });
            out.nodes[a as usize].links[direction] = Some((e, b));
            out.nodes[b as usize].links[back] = Some((e, a));
            Some(e)
        }
        (Some((e, to)), Some((f, from))) if e == f && to == b && from == a => Some(e),
        _ => None,
    }
}

/// Walks about each cell with it on the left.
fn find_cells(out: &mut Arrangement) -> Option<()> {
    // By edge: whether it was walked in directions 0, 1 and in 2, 3.
    let mut seen = vec![[false; 2]; out.edges.len()];
    for first in 0..out.nodes.len() as u32 {
        for direction in 0..4 {
            let Some((e, _)) = out.nodes[first as usize].links[direction] else { continue };
            if seen[e as usize][direction / 2] || !out.walks_inside(first, direction) {
                continue;
            }
            let cell = out.cells.len() as u32;
            let (mut node, mut d, mut lefts) = (first, direction, 0i32);
            let mut bounds = Bounds::EMPTY;
            loop {
                let (e, to) = out.nodes[node as usize].links[d]?;
                if std::mem::replace(&mut seen[e as usize][d / 2], true) {
                    return None;
                }
                out.edges[e as usize].cells[d / 2] = Some(cell);
                let at = out.nodes[to as usize].at;
                bounds = bounds.union(Bounds { min: at, max: at });
                node = to;
                // The leftmost that there is.
                let turn = [1, 0, 3].into_iter().find(|turn| {
                    let next = (d + turn) % 4;
                    out.nodes[to as usize].links[next].is_some() && out.walks_inside(to, next)
                })?;
                lefts += match turn {
                    1 => 1,
                    3 => -1,
                    _ => 0,
                };
                d = (d + turn) % 4;
                if (node, d) == (first, direction) {
                    break;
                }
                if lefts.abs() > 8 {
                    return None;
                }
            }
            if lefts != 4 {
                return None;
            }
            out.cells.push(bounds);
        }
    }
    let sides = |e: &Edge| e.cells.iter().flatten().count();
    out.edges.iter().all(|e| sides(e) == if e.is_boundary { 1 } else { 2 }).then_some(())
}

impl Arrangement {
    /// The box about some cells.
    pub fn bounds(&self, cells: &[u32]) -> Bounds {
        cells.iter().fold(Bounds::EMPTY, |all, c| all.union(self.cells[*c as usize]))
    }

    /// Whether two of some cells overlap: the chart lies on itself there.
    pub fn lies_on_itself(&self, cells: &[u32]) -> bool {
        let near = SAME * self.bounds(cells).size().max_element();
        cells.iter().enumerate().any(|(i, a)| {
            let a = &self.cells[*a as usize];
            cells[i + 1..].iter().map(|b| &self.cells[*b as usize]).any(|b| {
                let common = a.max.min(b.max) - a.min.max(b.min);
                common.min_element() > near
            })
        })
    }

    /// Whether the chart is on the left of the edge that leaves a node in a direction: of the boundary that is so one way only, the way in which it was made.
    fn walks_inside(&self, node: u32, direction: usize) -> bool {
        match self.nodes[node as usize].links[direction] {
            Some((e, _)) => {
                let edge = &self.edges[e as usize];
                !edge.is_boundary || edge.from == node
            }
            None => false,
        }
    }
}
