//! The triangulated void about charts, which keeps a map bijective while its energy is made small (Jiang, Schaefer and Panozzo 2017).

use glam::DVec2;
use spade::{ConstrainedDelaunayTriangulation, HasPosition, Point2, Triangulation};

/// How much higher a void triangle that is too low wants to be, as a factor: more, and a new cut would tear at its sides.
const WIDENED: f64 = 2.0;

/// A point of the triangulation.
struct Site(DVec2);

impl HasPosition for Site {
    type Scalar = f64;
    fn position(&self) -> Point2<f64> {
        Point2::new(self.0.x, self.0.y)
    }
}

/// Triangles of the void, counter-clockwise, as indices into `points`; those from `points.len()` on are the corners of the box, in order (low, low), (high, low),
/// (high, high), (low, high).
///
/// `walls`: directed edges between points with what is filled on their left; the void is what lies to the right of the first `borders` of them, as far as it
/// gets without crossing a wall. `None` where points coincide or walls cross.
pub(crate) fn void_triangles(
    points: &[DVec2],
    walls: &[[u32; 2]],
    borders: usize,
    low: DVec2,
    high: DVec2,
) -> Option<Vec<[u32; 3]>> {
    let corners = [low, DVec2::new(high.x, low.y), high, DVec2::new(low.x, high.y)];
    let sites: Vec<Site> = points.iter().chain(&corners).map(|p| Site(*p)).collect();
    let n = sites.len();
    let edges = walls.iter().map(|w| w.map(|v| v as usize)).collect();
    let mut conflicts = false;
    let triangulation =
        ConstrainedDelaunayTriangulation::<Site>::try_bulk_load_cdt(sites, edges, |_| conflicts = true).ok()?;
    if conflicts || triangulation.num_vertices() != n {
        return None;
    }
    let mut is_void = vec![false; triangulation.num_all_faces()];
    let mut queue = Vec::new();
    for wall in &walls[..borders] {
        let [from, to] = wall.map(|v| spade::handles::FixedVertexHandle::from_index(v as usize));
        let edge = triangulation.get_edge_from_neighbors(to, from)?;
        queue.extend(edge.face().as_inner());
    }
    let mut triangles = Vec::new();
    while let Some(face) = queue.pop() {
        if std::mem::replace(&mut is_void[face.fix().index()], true) {
            continue;
        }
        triangles.push(face.vertices().map(|v| v.fix().index() as u32));
        for edge in face.adjacent_edges() {
            if !edge.is_constraint_edge() {
                queue.extend(edge.rev().face().as_inner());
            }
        }
    }
    Some(triangles)
}

/// A triangle that is lower than `least` over its longest edge, raised to that height: at rest the void is nowhere narrower, so that what
/// touches pushes back instead of creeping closer for ever.
pub(crate) fn raised(triangle: [DVec2; 3], least: f64) -> [DVec2; 3] {
    let lengths = [0, 1, 2].map(|k| triangle[k].distance_squared(triangle[(k + 1) % 3]));
    let k = (0..3).max_by(|a, b| lengths[*a].total_cmp(&lengths[*b])).unwrap_or(0);
    let (a, b, c) = (triangle[k], triangle[(k + 1) % 3], triangle[(k + 2) % 3]);
    let length = lengths[k].sqrt();
    let normal = (b - a).perp() / length;
    let height = normal.dot(c - a);
    let wanted = least.min(WIDENED * height);
    if height.is_nan() || height >= wanted {
        return triangle;
    }
    let mut out = triangle;
    out[(k + 2) % 3] = c + normal * (wanted - height);
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn area(points: &[DVec2], triangles: &[[u32; 3]]) -> f64 {
        let of = |t: &[u32; 3]| {
            let [a, b, c] = t.map(|v| points[v as usize]);
            (b - a).perp_dot(c - a) / 2.0
        };
        assert!(triangles.iter().all(|t| of(t) > 0.0));
        triangles.iter().map(of).sum()
    }

    #[test]
    fn the_void_is_the_box_without_the_charts_and_with_their_holes() {
        let square = |low: f64, high: f64| {
            [DVec2::new(low, low), DVec2::new(high, low), DVec2::new(high, high), DVec2::new(low, high)]
        };
        let mut points: Vec<DVec2> = square(1.0, 5.0).into_iter().chain(square(2.0, 4.0)).collect();
        // The outer loop runs counter-clockwise, the hole's clockwise.
        let walls = [[0, 1], [1, 2], [2, 3], [3, 0], [5, 4], [6, 5], [7, 6], [4, 7]];
        let found = void_triangles(&points, &walls, 8, DVec2::splat(-1.0), DVec2::splat(7.0)).expect("nothing crosses");
        points.extend([DVec2::splat(-1.0), DVec2::new(7.0, -1.0), DVec2::splat(7.0), DVec2::new(-1.0, 7.0)]);
        assert_eq!(area(&points, &found), 64.0 - 16.0 + 4.0);
    }

    #[test]
    fn walls_that_cross_and_points_that_coincide_are_refused() {
        let points = [DVec2::ZERO, DVec2::ONE, DVec2::X, DVec2::Y];
        let around = (DVec2::splat(-1.0), DVec2::splat(2.0));
        assert!(void_triangles(&points, &[[0, 1], [2, 3]], 2, around.0, around.1).is_none());
        assert!(void_triangles(&[DVec2::ZERO, DVec2::ZERO, DVec2::X], &[[0, 2]], 1, around.0, around.1).is_none());
    }
}
