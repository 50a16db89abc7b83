//! The chosen trails are cut (section 3.2, *Cutting*): straight through faces, or along edges near them (section 4.1).

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};

use glam::DVec2;

use super::arrangement::Arrangement;
use super::chart_map::ChartMap;
use super::decomposition::Division;
use super::deform::axis_direction;
use super::prepare::Labels;
use crate::atlas::bvh::Bounds;
use crate::atlas::groups::{Cost, sorted_unique};
use crate::atlas::{FaceId, HalfEdge, Mesh, TrailStart, UvId};

/// Distance from a trail, in parts of the chart's extent, within which a vertex is on it.
const SNAP: f64 = 1e-9;

/// Cuts one chart along the motorcycles that ran. `own` is the number of its disk.
pub(super) fn cut_chart(
    mesh: &mut Mesh,
    map: &ChartMap,
    arrangement: &Arrangement,
    division: &Division,
    labels: &mut Labels,
    own: u32,
) {
    let snap = SNAP * Bounds::of(&map.x).size().max_element();
    for &m in &division.ran {
        let motorcycle = &arrangement.motorcycles[m as usize];
        let direction = axis_direction(motorcycle.direction as i32);
        let uv = map.uvs[map.boundary[motorcycle.start] as usize];
        let Some(corner) = start_corner(mesh, uv, direction, &labels.disk, own) else { continue };
        // No farther than it was walked: it may touch a corner on its way, and go on behind it.
        let length = motorcycle.length + 100.0 * snap;
        let cut = mesh.cut_trail(TrailStart::Corner(corner), direction, length, snap);
        labels.extend(&cut.faces);
        straighten(mesh, &cut.path, motorcycle.direction, &labels.disk, own);
    }
}

/// What a path that leaves its trail costs, by the distance from it in parts of the trail's length; and one that ends beside its end.
const ASIDE: f64 = 8.0;
const BESIDE: f64 = 2.0;

/// Cuts one chart along the edges of its `faces` that follow the motorcycles best; no face is divided, and the parts have edges as even as the mesh allows.
/// Each path runs over vertices inside the chart until it comes to the boundary or to a path before it.
pub(super) fn cut_along_edges(
    mesh: &mut Mesh,
    map: &ChartMap,
    arrangement: &Arrangement,
    division: &Division,
    faces: &[FaceId],
) {
    let uvs = sorted_unique(faces.iter().flat_map(|f| mesh.atlas().corners[f.index()]));
    let local = |u: UvId| uvs.binary_search(&u).ok();
    let at: Vec<DVec2> = uvs.iter().map(|u| mesh.position(*u)).collect();
    let mut links: Vec<BTreeMap<usize, HalfEdge>> = vec![BTreeMap::new(); uvs.len()];
    // Where paths end: at what is a border already.
    let mut is_end = vec![false; uvs.len()];
    for h in faces.iter().flat_map(|f| (0..3).map(|k| HalfEdge::of(*f, k))) {
        let [Some(a), Some(b)] = mesh.uv_ends(h).map(local) else { continue };
        if mesh.topology().is_border(h) {
            (is_end[a], is_end[b]) = (true, true);
        } else {
            links[a].insert(b, h);
            links[b].insert(a, h);
        }
    }
    let mut busy: Vec<bool> = arrangement.nodes.iter().map(|n| n.on_boundary).collect();
    let mut cut = Vec::new();
    for &m in &division.ran {
        let own = &arrangement.motorcycles[m as usize];
        let end = own.edges.iter().find(|(_, node)| std::mem::replace(&mut busy[*node as usize], true));
        let Some(goal) = end.or(own.edges.last()).map(|(_, node)| arrangement.nodes[*node as usize].at) else {
            continue;
        };
        let Some(start) = local(map.uvs[map.boundary[own.start] as usize]) else { continue };
        let Some(path) = path(&links, &at, &is_end, start, axis_direction(own.direction as i32), goal) else {
            continue;
        };
        for pair in path.windows(2) {
            cut.extend(links[pair[0]].get(&pair[1]));
        }
        path.iter().for_each(|v| is_end[*v] = true);
    }
    mesh.cut(&cut);
}

/// The path from a vertex that follows a straight line to a goal best, over vertices that are no ends, to one that is.
fn path(
    links: &[BTreeMap<usize, HalfEdge>],
    at: &[DVec2],
    is_end: &[bool],
    start: usize,
    direction: DVec2,
    goal: DVec2,
) -> Option<Vec<usize>> {
    let length = (goal - at[start]).dot(direction);
    if length.is_nan() || length <= 0.0 {
        return None;
    }
    let aside = |p: DVec2| {
        let own = p - at[start];
        let along = own.dot(direction);
        let over = (along - length).max(-along).max(0.0);
        (own.perp_dot(direction).abs() + over) / length
    };
    let mut cost = vec![f64::INFINITY; at.len()];
    let mut from = vec![usize::MAX; at.len()];
    let mut heap = BinaryHeap::from([Reverse((Cost(0.0), start, false))]);
    cost[start] = 0.0;
    // An end is reached twice: as it is, and with what it costs to end there.
    while let Some(Reverse((Cost(now), v, is_last))) = heap.pop() {
        if is_last {
            let mut path = vec![v];
            while path[path.len() - 1] != start {
                path.push(from[path[path.len() - 1]]);
            }
            path.reverse();
            return Some(path);
        }
        if now > cost[v] {
            continue;
        }
        if is_end[v] && v != start {
            heap.push(Reverse((Cost(now + BESIDE * at[v].distance(goal)), v, true)));
            continue;
        }
        for &u in links[v].keys() {
            let middle = 0.5 * (at[u] + at[v]);
            let reached = now + at[u].distance(at[v]) * (1.0 + ASIDE * aside(middle));
            if reached < cost[u] && u != start {
                cost[u] = reached;
                from[u] = v;
                heap.push(Reverse((Cost(reached), u, false)));
            }
        }
    }
    None
}

/// The corner at a boundary vertex, or at a copy of it that cuts have made, from which a direction leads into the chart.
fn start_corner(mesh: &Mesh, uv: UvId, direction: DVec2, disk: &[u32], own: u32) -> Option<HalfEdge> {
    let at = mesh.position(uv);
    let any = mesh.corners_of(uv).next()?;
    let all = mesh.corners_on(mesh.vertex_at(any));
    let mut here = all.filter(|c| disk[c.face().index()] == own && mesh.position(mesh.uv_at(*c)) == at);
    here.find(|c| leads_into(mesh, *c, direction))
}

/// Whether a direction leads from a corner into its face, or along the edge that leaves it.
fn leads_into(mesh: &Mesh, corner: HalfEdge, direction: DVec2) -> bool {
    let [p, q, r] = [corner, corner.next(), corner.previous()].map(|c| mesh.position(mesh.uv_at(c)));
    let sign = (q - p).perp_dot(r - p).signum();
    let (a, b) = (sign * (q - p).perp_dot(direction), sign * direction.perp_dot(r - p));
    a >= 0.0 && b >= 0.0 && (a > 0.0 || (q - p).dot(direction) > 0.0) && (b > 0.0 || (r - p).dot(direction) > 0.0)
}

/// Puts the vertices of a cut on one line: those of its own disk, as other charts may meet its edges on the surface.
fn straighten(mesh: &mut Mesh, path: &[HalfEdge], direction: usize, disk: &[u32], own: u32) {
    let axis = 1 - direction % 2;
    let vertices: Vec<UvId> = path
        .iter()
        .flat_map(|h| [Some(*h), mesh.topology().across_seam(*h)].into_iter().flatten())
        .filter(|h| disk[h.face().index()] == own)
        .flat_map(|h| mesh.uv_ends(h))
        .collect();
    let Some(first) = vertices.first() else { return };
    let line = mesh.position(*first)[axis];
    for u in vertices {
        let mut p = mesh.position(u);
        if p[axis] != line {
            p[axis] = line;
            mesh.move_uv(u, p);
        }
    }
}
