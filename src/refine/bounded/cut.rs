//! The chosen trails are cut (section 3.2, *Cutting*), through faces.

use glam::DVec2;

use super::arrangement::Arrangement;
use super::chart_map::ChartMap;
use super::decomposition::Division;
use super::deform::axis_direction;
use super::prepare::Labels;
use crate::atlas::bvh::Bounds;
use crate::atlas::{HalfEdge, Mesh, TrailStart, UvId};

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
        straighten(mesh, &cut.path, motorcycle.direction);
    }
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

/// Puts the vertices of a cut on one line.
fn straighten(mesh: &mut Mesh, path: &[HalfEdge], direction: usize) {
    let axis = 1 - direction % 2;
    let vertices: Vec<UvId> = path
        .iter()
        .flat_map(|h| [Some(*h), mesh.topology().across_seam(*h)].into_iter().flatten())
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
