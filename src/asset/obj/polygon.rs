//! Polygons into triangles: a fan where the polygon is convex, ears where it is not.

use glam::{DVec2, DVec3};

/// Triangulates polygons; carries the work that is left for ear clipping, which is quadratic.
#[derive(Debug)]
pub(crate) struct Triangulator {
    /// Corner tests that may still be done over the whole file.
    left: u64,
    /// Concave polygons that were fanned because the work ran out.
    pub(crate) given_up: usize,
    ring: Vec<u32>,
}

impl Default for Triangulator {
    fn default() -> Self {
        Triangulator { left: 500_000_000, given_up: 0, ring: Vec::new() }
    }
}

impl Triangulator {
    /// Triangles of a polygon, as indices into `points`, appended to `out`: `points.len() - 2` of them, in the
    /// polygon's winding.
    pub(crate) fn triangulate(&mut self, points: &[DVec3], out: &mut Vec<[u32; 3]>) {
        let n = points.len() as u32;
        if n <= 3 {
            out.extend((n == 3).then_some([0, 1, 2]));
            return;
        }
        let flat = flatten(points);
        if is_convex(&flat) {
            out.extend((1..n - 1).map(|k| [0, k, k + 1]));
            return;
        }
        self.clip(&flat, out);
    }

    /// Cuts ears off until three corners are left. Where rounding or a self-intersection leaves no ear, the corner with
    /// the largest area goes, so that it always ends with `n - 2` triangles.
    fn clip(&mut self, flat: &[DVec2], out: &mut Vec<[u32; 3]>) {
        let point = |i: u32| flat.get(i as usize).copied().unwrap_or_default();
        self.ring.clear();
        self.ring.extend(0..flat.len() as u32);
        let mut at = 0;
        while self.ring.len() > 3 {
            let n = self.ring.len();
            let corner = |ring: &[u32], k: usize| [k + n - 1, k, k + 1].map(|k| ring.get(k % n).copied().unwrap_or(0));
            let mut best: Option<(f64, usize)> = None;
            let mut found = None;
            for step in 0..n {
                let k = (at + step) % n;
                let triangle = corner(&self.ring, k);
                let [a, b, c] = triangle.map(point);
                let area = cross(a, b, c);
                if best.is_none_or(|(most, _)| area > most) {
                    best = Some((area, k));
                }
                // Every look at a corner counts: a polygon may have ears in one place only.
                self.left = self.left.saturating_sub(if area <= 0.0 { 1 } else { n as u64 });
                if self.left == 0 {
                    break;
                }
                if area <= 0.0 {
                    continue;
                }
                let blocked = self.ring.iter().any(|i| {
                    let p = point(*i);
                    !triangle.contains(i) && p != a && p != b && p != c && within(p, a, b, c)
                });
                if !blocked {
                    found = Some(k);
                    break;
                }
            }
            if self.left == 0 {
                self.given_up += 1;
                let first = self.ring.first().copied().unwrap_or(0);
                out.extend(self.ring.windows(2).skip(1).map(|w| [first, w[0], w[1]]));
                return;
            }
            let k = found.or(best.map(|b| b.1)).unwrap_or(0);
            out.push(corner(&self.ring, k));
            self.ring.remove(k);
            // The next ear is sought beyond this one, so that strips do not turn into slivers about one corner.
            at = k % self.ring.len();
        }
        if let [a, b, c] = self.ring[..] {
            out.push([a, b, c]);
        }
    }
}

/// The polygon in the plane of its Newell normal, counterclockwise.
fn flatten(points: &[DVec3]) -> Vec<DVec2> {
    let origin = points.first().copied().unwrap_or_default();
    let mut normal = DVec3::ZERO;
    for (a, b) in points.iter().zip(points.iter().cycle().skip(1)) {
        normal += (*a - origin).cross(*b - origin);
    }
    let axis = normal.abs();
    // Dropping the largest axis of the normal keeps the polygon's shape up to a shear, and its orientation by the sign.
    let (u, v, along) = if axis.x >= axis.y && axis.x >= axis.z {
        (DVec3::Y, DVec3::Z, normal.x)
    } else if axis.y >= axis.z {
        (DVec3::Z, DVec3::X, normal.y)
    } else {
        (DVec3::X, DVec3::Y, normal.z)
    };
    let u = if along < 0.0 { -u } else { u };
    points.iter().map(|p| DVec2::new(u.dot(*p - origin), v.dot(*p - origin))).collect()
}

/// Whether no corner turns back and the whole turns about once: a fan from the first corner then covers it once.
fn is_convex(flat: &[DVec2]) -> bool {
    let n = flat.len();
    let at = |i: usize| flat.get(i % n).copied().unwrap_or_default();
    let first = at(0);
    (0..n).all(|i| cross(at(i), at(i + 1), at(i + 2)) >= 0.0)
        && (1..n - 1).all(|i| cross(first, at(i), at(i + 1)) >= 0.0)
}

fn cross(a: DVec2, b: DVec2, c: DVec2) -> f64 {
    (b - a).perp_dot(c - a)
}

fn within(p: DVec2, a: DVec2, b: DVec2, c: DVec2) -> bool {
    cross(a, b, p) >= 0.0 && cross(b, c, p) >= 0.0 && cross(c, a, p) >= 0.0
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Triangles cover the polygon: none turned over, areas add up.
    fn covers(points: &[[f64; 2]], lift: impl Fn(DVec2) -> DVec3) {
        let flat: Vec<DVec2> = points.iter().map(|p| DVec2::from_array(*p)).collect();
        let solid: Vec<DVec3> = flat.iter().map(|p| lift(*p)).collect();
        let mut out = Vec::new();
        Triangulator::default().triangulate(&solid, &mut out);
        assert_eq!(out.len(), points.len() - 2);
        let areas: Vec<f64> =
            out.iter().map(|t| t.map(|i| flat[i as usize])).map(|[a, b, c]| 0.5 * cross(a, b, c)).collect();
        let n = flat.len();
        let whole: f64 = (0..n).map(|i| 0.5 * flat[i].perp_dot(flat[(i + 1) % n])).sum();
        assert!(areas.iter().all(|a| a * whole.signum() >= -1e-12), "{out:?} {areas:?}");
        assert!((areas.iter().sum::<f64>() - whole).abs() < 1e-9);
    }

    #[test]
    fn concave_polygons_in_every_plane() {
        let arrow = [[0.0, 0.0], [2.0, 1.0], [0.0, 2.0], [1.0, 1.0]];
        let comb = [
            [0.0, 0.0],
            [7.0, 0.0],
            [7.0, 3.0],
            [6.0, 3.0],
            [6.0, 1.0],
            [4.0, 1.0],
            [4.0, 3.0],
            [3.0, 3.0],
            [3.0, 1.0],
            [1.0, 1.0],
            [1.0, 3.0],
            [0.0, 3.0],
        ];
        for start in 0..4 {
            let mut turned = arrow;
            turned.rotate_left(start);
            covers(&turned, |p| DVec3::new(p.x, p.y, 0.0));
            turned.reverse();
            covers(&turned, |p| DVec3::new(3.0, p.x, p.y + 0.1 * p.x));
        }
        covers(&comb, |p| DVec3::new(p.y, 5.0, p.x));
        covers(&comb, |p| DVec3::new(p.x, p.y, p.x + p.y));
    }

    #[test]
    fn nonsense_gives_the_right_number_of_triangles() {
        for points in [vec![DVec3::ZERO; 7], (0..9).map(|i| DVec3::splat((i * 5 % 9) as f64)).collect::<Vec<_>>()] {
            let mut out = Vec::new();
            Triangulator::default().triangulate(&points, &mut out);
            assert_eq!(out.len(), points.len() - 2);
        }
        let star: Vec<DVec3> =
            (0..5).map(|i| (i as f64 * 2.513).sin_cos()).map(|(x, y)| DVec3::new(x, y, 0.0)).collect();
        let mut out = Vec::new();
        Triangulator::default().triangulate(&star, &mut out);
        assert_eq!(out.len(), 3);
    }
}
