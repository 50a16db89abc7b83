//! How much a triangle is deformed by a map of the plane.

use glam::{DMat2, DVec2};

/// Triangles lower than this part of their longest edge have no shape to compare with.
const FLAT: f64 = 1e-9;

/// The linear part of the map that takes triangle `from` to triangle `to`; `None` where `from` has no area to speak of.
pub(crate) fn jacobian(from: &[DVec2; 3], to: &[DVec2; 3]) -> Option<DMat2> {
    let (a, b) = (from[1] - from[0], from[2] - from[0]);
    let longest = a.length_squared().max(b.length_squared()).max((b - a).length_squared());
    let twice = a.perp_dot(b);
    if twice.abs() <= FLAT * longest || !twice.is_finite() {
        return None;
    }
    let inverse = DMat2::from_cols(DVec2::new(b.y, -a.y), DVec2::new(-b.x, a.x)) * (1.0 / twice);
    Some(DMat2::from_cols(to[1] - to[0], to[2] - to[0]) * inverse)
}

/// The singular values of a 2 x 2 matrix, the larger first; the smaller has the sign of the determinant.
pub(crate) fn singular_values(j: &DMat2) -> [f64; 2] {
    let (turn, mirror) = parts(j);
    [turn + mirror, turn - mirror]
}

/// (s1 - 1)^2 + (s2 - 1)^2 with signed s2: the integrand of the as-rigid-as-possible energy (Liu et al. 2008, section 3). A triangle
/// that is turned over is no isometry, however long its edges.
pub(crate) fn arap(j: &DMat2) -> f64 {
    // s = turn +- mirror, so that the two squares sum to this without cancellation.
    let (turn, mirror) = parts(j);
    2.0 * ((turn - 1.0) * (turn - 1.0) + mirror * mirror)
}

/// Lengths of the conformal and the anticonformal part.
fn parts(j: &DMat2) -> (f64, f64) {
    let turn = DVec2::new(j.x_axis.x + j.y_axis.y, j.x_axis.y - j.y_axis.x).length() / 2.0;
    let mirror = DVec2::new(j.x_axis.x - j.y_axis.y, j.x_axis.y + j.y_axis.x).length() / 2.0;
    (turn, mirror)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn singular_values_are_those_of_a_turn_a_stretch_and_a_turn() {
        for (s, t) in [(2.0, 0.5), (1.0, 1.0), (3.0, -0.25), (1.5, 0.0)] {
            for (p, q) in [(0.3, 1.1), (2.0, -0.7), (0.0, 0.0)] {
                let j = DMat2::from_angle(p) * DMat2::from_diagonal(DVec2::new(s, t)) * DMat2::from_angle(q);
                let got = singular_values(&j);
                assert!((got[0] - s).abs() < 1e-12 && (got[1] - t).abs() < 1e-12, "{got:?}");
                let expected = (s - 1.0_f64).powi(2) + (t - 1.0_f64).powi(2);
                assert!((arap(&j) - expected).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn a_jacobian_takes_the_edges_along() {
        let from = [DVec2::new(1.0, 2.0), DVec2::new(4.0, 1.0), DVec2::new(2.0, 5.0)];
        let j = DMat2::from_cols(DVec2::new(0.3, -1.0), DVec2::new(2.0, 0.7));
        let to = from.map(|p| j * p + DVec2::new(5.0, 5.0));
        let got = jacobian(&from, &to).expect("it has an area");
        assert!((got.x_axis - j.x_axis).length() + (got.y_axis - j.y_axis).length() < 1e-12);
        assert!(jacobian(&[from[0], from[1], from[1].lerp(from[0], 0.4)], &to).is_none());
    }
}
