//! The symmetric Dirichlet energy of maps of triangles (Smith and Schaefer 2015), its gradient and its Hessian made positive
//! semidefinite, in closed form (Smith, de Goes and Kim 2019, section 4, for isotropic energies of the plane).
//!
//! Of one triangle it is s1^2 + s2^2 + s1^-2 + s2^-2 with the singular values s1, s2 of the map's Jacobian: 4 where the map is an isometry,
//! infinite where it collapses or turns the triangle over.

use glam::{DMat2, DVec2, DVec3};

/// A triangle at rest, as what maps of it need: gradients of the barycentric coordinates, and a weight.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct RestTriangle {
    /// Gradient of each corner's barycentric coordinate: the Jacobian of a map is the sum of x_i b_i^T.
    b: [DVec2; 3],
    /// What its energy counts.
    pub weight: f64,
}

impl RestTriangle {
    /// Of a triangle in the plane with positive area; `None` where it has none.
    pub fn new([p, q, r]: [DVec2; 3], weight: f64) -> Option<Self> {
        let (e, f) = (q - p, r - p);
        let twice = e.perp_dot(f);
        if !(twice > 0.0 && twice.is_finite()) {
            return None;
        }
        let (b1, b2) = (DVec2::new(f.y, -f.x) / twice, DVec2::new(-e.y, e.x) / twice);
        let own = RestTriangle { b: [-b1 - b2, b1, b2], weight };
        own.b.iter().all(|b| b.is_finite()).then_some(own)
    }

    /// Of a triangle in space, laid into the plane; `None` where it has no area.
    pub fn of_surface([p, q, r]: [DVec3; 3], weight: f64) -> Option<Self> {
        Self::new(flattened([p, q, r]), weight)
    }

    /// The Jacobian of the map to `x`.
    pub fn jacobian(&self, x: [DVec2; 3]) -> DMat2 {
        let [b0, b1, b2] = self.b;
        DMat2::from_cols(x[0] * b0.x + x[1] * b1.x + x[2] * b2.x, x[0] * b0.y + x[1] * b1.y + x[2] * b2.y)
    }

    /// The weighted energy; infinite where the map is not injective.
    pub fn energy(&self, x: [DVec2; 3]) -> f64 {
        let j = self.jacobian(x);
        let det = j.determinant();
        if det > 0.0 { self.weight * squares(&j) * (1.0 + 1.0 / (det * det)) } else { f64::INFINITY }
    }

    /// The weighted energy and its gradient by corner. Only where the map is injective.
    pub fn gradient(&self, x: [DVec2; 3]) -> (f64, [DVec2; 3]) {
        let j = self.jacobian(x);
        let det = j.determinant();
        let (squares, inverse) = (squares(&j), 1.0 / (det * det));
        let cofactor = DMat2::from_cols(DVec2::new(j.y_axis.y, -j.y_axis.x), DVec2::new(-j.x_axis.y, j.x_axis.x));
        let p = (j * (1.0 + inverse) - cofactor * (squares * inverse / det)) * (2.0 * self.weight);
        (self.weight * squares * (1.0 + inverse), self.b.map(|b| p * b))
    }

    /// The Hessian of the weighted energy, its negative eigenvalues put to zero: blocks for the pairs of corners 00, 10, 11, 20, 21, 22,
    /// each the derivative by the first corner's coordinates (rows) and the second's (columns).
    pub fn projected_hessian(&self, x: [DVec2; 3]) -> [DMat2; 6] {
        let j = self.jacobian(x);
        // Conformal and anticonformal part: the singular values are |turn| +- |mirror|, and the directions halve their angles.
        let turn = DVec2::new(j.x_axis.x + j.y_axis.y, j.x_axis.y - j.y_axis.x) / 2.0;
        let mirror = DVec2::new(j.x_axis.x - j.y_axis.y, j.x_axis.y + j.y_axis.x) / 2.0;
        let (t, m) = (turn.length(), mirror.length());
        let (s1, s2) = (t + m, t - m);
        let turn_unit = turn / t;
        let mirror_unit = if m > 1e-14 * t { mirror / m } else { turn_unit };
        let u = half_angle(turn_unit.rotate(mirror_unit));
        let v = DVec2::new(u.x, -u.y).rotate(turn_unit);
        let product = s1 * s2;
        let cube = product * product * product;
        let (l1, l2) = (2.0 + 6.0 / (s1 * s1 * s1 * s1), 2.0 + 6.0 / (s2 * s2 * s2 * s2));
        let squares = s1 * s1 + s2 * s2;
        let flip = 2.0 + 2.0 * (squares + product) / cube;
        let twist = (2.0 - 2.0 * (squares - product) / cube).max(0.0);
        let (w, sum, difference) = (self.weight, 0.5 * (flip + twist), 0.5 * (flip - twist));
        let p = self.b.map(|b| v.x * b.x - v.y * b.y);
        let q = self.b.map(|b| v.y * b.x + v.x * b.y);
        let block = |i: usize, k: usize| {
            let (pp, qq) = (p[i] * p[k], q[i] * q[k]);
            let a = w * (l1 * pp + sum * qq);
            let d = w * (l2 * qq + sum * pp);
            let b = w * difference * q[i] * p[k];
            let c = w * difference * p[i] * q[k];
            // [a b; c d] is in the basis of the left singular vectors.
            let rows =
                [DVec2::new(u.x * a - u.y * c, u.x * b - u.y * d), DVec2::new(u.y * a + u.x * c, u.y * b + u.x * d)];
            DMat2::from_cols(
                DVec2::new(rows[0].x * u.x - rows[0].y * u.y, rows[1].x * u.x - rows[1].y * u.y),
                DVec2::new(rows[0].x * u.y + rows[0].y * u.x, rows[1].x * u.y + rows[1].y * u.x),
            )
        };
        [block(0, 0), block(1, 0), block(1, 1), block(2, 0), block(2, 1), block(2, 2)]
    }
}

/// A triangle in space, laid into the plane with positive area.
pub(crate) fn flattened([p, q, r]: [DVec3; 3]) -> [DVec2; 3] {
    let (e, f) = (q - p, r - p);
    let length = e.length();
    let along = if length > 0.0 { f.dot(e) / length } else { 0.0 };
    let up = if length > 0.0 { e.cross(f).length() / length } else { 0.0 };
    [DVec2::ZERO, DVec2::new(length, 0.0), DVec2::new(along, up)]
}

/// How far along `p` a triangle at `x` can go until it collapses: the smallest positive root of its area (Smith and Schaefer 2015,
/// section 3.3); infinite where it never does.
pub(crate) fn step_bound(x: [DVec2; 3], p: [DVec2; 3]) -> f64 {
    let (e, f) = (x[1] - x[0], x[2] - x[0]);
    let (de, df) = (p[1] - p[0], p[2] - p[0]);
    let (a, b, c) = (de.perp_dot(df), e.perp_dot(df) + de.perp_dot(f), e.perp_dot(f));
    // c + b t + a t^2 = 0 with c > 0, in the form that does not cancel.
    let discriminant = b * b - 4.0 * a * c;
    if discriminant < 0.0 {
        return f64::INFINITY;
    }
    let root = discriminant.sqrt();
    if b <= 0.0 {
        let t = 2.0 * c / (root - b);
        return if t.is_nan() { f64::INFINITY } else { t };
    }
    let t = -(b + root) / (2.0 * a);
    if t > 0.0 { t } else { f64::INFINITY }
}

fn squares(j: &DMat2) -> f64 {
    j.x_axis.length_squared() + j.y_axis.length_squared()
}

/// The unit vector of half the angle.
fn half_angle(z: DVec2) -> DVec2 {
    // The larger of the two components first, so that nothing cancels.
    if z.x >= 0.0 {
        let c = ((1.0 + z.x) / 2.0).sqrt();
        DVec2::new(c, z.y / (2.0 * c))
    } else {
        let s = ((1.0 - z.x) / 2.0).sqrt().copysign(z.y);
        DVec2::new(z.y / (2.0 * s), s)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::testing::Rng;

    /// A rest triangle and a map of it that does not turn it over.
    fn random(rng: &mut Rng) -> (RestTriangle, [DVec2; 3]) {
        loop {
            let rest = [rng.point(1.0), rng.point(1.0), rng.point(1.0)];
            let x = [rng.point(1.0), rng.point(1.0), rng.point(1.0)];
            let area = |t: &[DVec2; 3]| (t[1] - t[0]).perp_dot(t[2] - t[0]);
            if area(&rest) > 0.05 && area(&x) > 0.05 {
                return (RestTriangle::new(rest, 0.7).expect("it has an area"), x);
            }
        }
    }

    fn flat(x: [DVec2; 3]) -> [f64; 6] {
        [x[0].x, x[0].y, x[1].x, x[1].y, x[2].x, x[2].y]
    }

    fn points(x: [f64; 6]) -> [DVec2; 3] {
        [DVec2::new(x[0], x[1]), DVec2::new(x[2], x[3]), DVec2::new(x[4], x[5])]
    }

    fn full(blocks: &[DMat2; 6]) -> [[f64; 6]; 6] {
        let mut h = [[0.0; 6]; 6];
        for (n, (i, k)) in [(0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)].into_iter().enumerate() {
            for (r, c) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                h[2 * i + r][2 * k + c] = blocks[n].col(c)[r];
                h[2 * k + c][2 * i + r] = blocks[n].col(c)[r];
            }
        }
        h
    }

    #[test]
    fn the_energy_is_that_of_the_singular_values_and_4_for_isometries() {
        let mut rng = Rng(5);
        for _ in 0..200 {
            let (rest, x) = random(&mut rng);
            let [s, t] = crate::numeric::energy::singular_values(&rest.jacobian(x));
            let expected = 0.7 * (s * s + t * t + 1.0 / (s * s) + 1.0 / (t * t));
            assert!((rest.energy(x) - expected).abs() < 1e-9 * expected);
            assert!((rest.gradient(x).0 - expected).abs() < 1e-9 * expected);
        }
        let corners = [DVec3::new(1.0, 2.0, 3.0), DVec3::new(2.0, 2.5, 1.0), DVec3::new(0.0, 4.0, 4.0)];
        let rest = RestTriangle::of_surface(corners, 1.0).expect("it has an area");
        let turned = flattened(corners).map(|p| DVec2::from_angle(0.8).rotate(p) + DVec2::new(5.0, -2.0));
        assert!((rest.energy(turned) - 4.0).abs() < 1e-12);
        assert_eq!(rest.energy([turned[0], turned[2], turned[1]]), f64::INFINITY);
    }

    #[test]
    fn gradient_and_hessian_are_the_differences_of_the_energy() {
        let mut rng = Rng(6);
        let (mut whole, mut cut) = (0, 0);
        for _ in 0..300 {
            let (rest, x) = random(&mut rng);
            let (_, gradient) = rest.gradient(x);
            let step = 1e-6;
            let mut second = [[0.0; 6]; 6];
            for i in 0..6 {
                let moved = |by: f64| {
                    let mut y = flat(x);
                    y[i] += by;
                    points(y)
                };
                let slope = (rest.energy(moved(step)) - rest.energy(moved(-step))) / (2.0 * step);
                assert!((slope - flat(gradient)[i]).abs() < 1e-5 * (1.0 + rest.energy(x).powi(2)), "{slope}");
                let (up, down) = (flat(rest.gradient(moved(step)).1), flat(rest.gradient(moved(-step)).1));
                (0..6).for_each(|k| second[i][k] = (up[k] - down[k]) / (2.0 * step));
            }
            let scale = 1.0 + second.iter().flatten().fold(0.0, |a: f64, v| a.max(v.abs()));
            let expected = by_rotations(&rest, x);
            let projected = full(&rest.projected_hessian(x));
            let worst = (0..36).map(|n| (projected[n / 6][n % 6] - expected[n / 6][n % 6]).abs()).fold(0.0, f64::max);
            assert!(worst < 1e-4 * scale, "{worst} of {scale}");
            let differs = (0..36).any(|n| (second[n / 6][n % 6] - projected[n / 6][n % 6]).abs() > 1e-4 * scale);
            if differs { cut += 1 } else { whole += 1 }
        }
        assert!(whole > 0 && cut > 0, "both kinds are met: {whole} {cut}");
    }

    /// The twin: the Hessian by the four entries of the Jacobian as differences, its negative eigenvalues dropped, taken to the corners.
    fn by_rotations(rest: &RestTriangle, x: [DVec2; 3]) -> [[f64; 6]; 6] {
        let entries = RestTriangle::new([DVec2::ZERO, DVec2::X, DVec2::Y], rest.weight).expect("it has an area");
        let j = rest.jacobian(x);
        let j = [j.x_axis.x, j.x_axis.y, j.y_axis.x, j.y_axis.y];
        let slopes = |j: [f64; 4]| {
            let g = flat(entries.gradient([DVec2::ZERO, DVec2::new(j[0], j[1]), DVec2::new(j[2], j[3])]).1);
            [g[2], g[3], g[4], g[5]]
        };
        let mut second = [[0.0; 4]; 4];
        for i in 0..4 {
            let moved = |by: f64| {
                let mut j = j;
                j[i] += by;
                slopes(j)
            };
            let (up, down) = (moved(1e-6), moved(-1e-6));
            (0..4).for_each(|k| second[i][k] = (up[k] - down[k]) / 2e-6);
        }
        let positive = positive_part(second);
        // The Jacobian's entry 2 c + r is the sum of the corners' r coordinates times their gradients' c coordinates.
        let by = |n: usize, entry: usize| if n % 2 == entry % 2 { rest.b[n / 2][entry / 2] } else { 0.0 };
        let mut out = [[0.0; 6]; 6];
        for n in 0..36 {
            let sum = (0..16).map(|m| by(n / 6, m / 4) * positive[m / 4][m % 4] * by(n % 6, m % 4));
            out[n / 6][n % 6] = sum.sum();
        }
        out
    }

    /// The positive semidefinite part of a symmetric matrix, by Jacobi's rotations.
    fn positive_part(mut a: [[f64; 4]; 4]) -> [[f64; 4]; 4] {
        let mut v = [[0.0; 4]; 4];
        (0..4).for_each(|i| v[i][i] = 1.0);
        for (p, q) in (0..60).flat_map(|_| [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]) {
            let (s, c) = (0.5 * (2.0 * a[p][q]).atan2(a[q][q] - a[p][p])).sin_cos();
            for row in a.iter_mut().chain(&mut v) {
                (row[p], row[q]) = (c * row[p] - s * row[q], s * row[p] + c * row[q]);
            }
            let (row_p, row_q) = (a[p], a[q]);
            a[p] = std::array::from_fn(|k| c * row_p[k] - s * row_q[k]);
            a[q] = std::array::from_fn(|k| s * row_p[k] + c * row_q[k]);
        }
        let mut out = [[0.0; 4]; 4];
        for n in 0..16 {
            out[n / 4][n % 4] = (0..4).map(|m| v[n / 4][m] * a[m][m].max(0.0) * v[n % 4][m]).sum();
        }
        out
    }

    #[test]
    fn no_triangle_collapses_before_its_step_bound_and_it_does_there() {
        let mut rng = Rng(7);
        for _ in 0..500 {
            let (_, x) = random(&mut rng);
            let p = [rng.point(2.0) - DVec2::ONE, rng.point(2.0) - DVec2::ONE, rng.point(2.0) - DVec2::ONE];
            let area = |t: f64| {
                let y = [x[0] + t * p[0], x[1] + t * p[1], x[2] + t * p[2]];
                (y[1] - y[0]).perp_dot(y[2] - y[0])
            };
            let bound = step_bound(x, p);
            let tested = bound.min(10.0);
            (0..100).for_each(|k| assert!(area(tested * f64::from(k) / 100.0) > 0.0));
            assert!(bound.is_infinite() || area(bound).abs() < 1e-9 * (1.0 + bound * bound));
        }
    }
}
