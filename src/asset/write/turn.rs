//! How far a face was turned on its sheet, and TANGENT turned with it.
//!
//! In the tangent space of glTF x is the direction of +U and y = w (N x T) points up the image, against v.
//! UVs in texels have v down. A turn by the angle a in those coordinates, u + iv -> e^(ia) (u + iv), makes
//! the new +U, seen on the surface, cos a T + sin a B; after a mirroring v -> -v that comes before the turn
//! it is cos a T - sin a B, and w changes its sign. A normal (x, y) in the texture becomes
//! (x cos a + y sin a, y cos a - x sin a), so that the shading stays.

use glam::{DVec2, DVec3};

/// A tangent with its handedness, as glTF has it.
pub(crate) type Tangent = [f32; 4];

/// The turn of a face from its uploaded to its new UVs: the best rigid fit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Turn {
    /// cos and sin of the angle, times a weight: the sum over the edges of squared lengths.
    pub(super) z: DVec2,
    /// Whether the face was mirrored (v -> -v) before it was turned.
    pub(super) mirrored: bool,
}

/// Faces whose turns differ by less than the angle with this cosine (0.1 rad) share their tangents: shapes that
/// change smoothly keep smooth tangents.
const SAME: f64 = 0.995;
/// A turn this close to a quarter turn is one.
const SNAP: f64 = 1e-6;
/// Twice a triangle's area over its longest edge squared: less says nothing of its orientation.
const SLIVER: f64 = 1e-9;

impl Turn {
    /// No turn.
    pub(super) const NONE: Turn = Turn { z: DVec2::X, mirrored: false };

    /// The turn of a face; none where its UVs have no area.
    pub(super) fn of(before: [DVec2; 3], after: [DVec2; 3]) -> Option<Turn> {
        let edges = |t: [DVec2; 3]| [t[1] - t[0], t[2] - t[1], t[0] - t[2]];
        let (old, new) = (edges(before), edges(after));
        let orientation = |e: [DVec2; 3]| {
            let longest = e.iter().map(|v| v.length_squared()).fold(0.0, f64::max);
            let area = e[0].perp_dot(e[1]);
            (area.abs() > SLIVER * longest).then_some(area > 0.0)
        };
        let mirrored = orientation(old)? != orientation(new)?;
        let flip = if mirrored { DVec2::new(1.0, -1.0) } else { DVec2::ONE };
        // Sum of new * conj(old).
        let z = old.iter().zip(new).fold(DVec2::ZERO, |z, (&a, b)| {
            let a = a * flip;
            z + DVec2::new(a.dot(b), a.perp_dot(b))
        });
        (z.length_squared() > 0.0 && z.is_finite()).then_some(Turn { z, mirrored })
    }

    /// Whether two turns are the same but for noise.
    pub(super) fn agrees(&self, other: &Turn) -> bool {
        self.mirrored == other.mirrored && self.z.dot(other.z) > SAME * self.z.length() * other.z.length()
    }

    /// Cosine and sine, exact for quarter turns.
    pub(super) fn direction(&self) -> DVec2 {
        let d = self.z.normalize_or(DVec2::X);
        let quarter = d.round();
        if (d - quarter).length() < SNAP { quarter } else { d }
    }

    /// Whether tangents stay as they are.
    pub(super) fn is_none(&self) -> bool {
        !self.mirrored && self.direction() == DVec2::X
    }

    /// `tangent` turned about `normal`; `w` is its handedness as uploaded. What of a tangent lies along the normal changes its sign where
    /// the turn is more than a quarter: a half turn is the opposite of any tangent, perpendicular or not.
    pub(super) fn apply(&self, tangent: DVec3, w: f64, normal: DVec3) -> DVec3 {
        let Some(n) = normal.try_normalize() else { return tangent };
        let d = self.direction();
        let sin = if self.mirrored { -d.y * w } else { d.y * w };
        let along = if d.x < 0.0 { -1.0 } else { 1.0 };
        tangent * d.x + n.cross(tangent) * sin + n * (n.dot(tangent) * (along - d.x))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// dP/du and dP/dv of a triangle with positions `p` and UVs `t`.
    fn derivatives(p: [DVec3; 3], t: [DVec2; 3]) -> (DVec3, DVec3) {
        let (e, f) = (p[1] - p[0], p[2] - p[0]);
        let (a, b) = (t[1] - t[0], t[2] - t[0]);
        let det = a.perp_dot(b);
        ((e * b.y - f * a.y) / det, (f * a.x - e * b.x) / det)
    }

    #[test]
    fn tangents_follow_the_new_u_axis() {
        let p = [DVec3::new(0.1, 0.2, 0.3), DVec3::new(2.0, 0.1, 0.4), DVec3::new(0.3, 1.5, 1.0)];
        let n = (p[1] - p[0]).cross(p[2] - p[0]).normalize();
        // Conformal UVs: the triangle laid flat, seen from outside (v down) or from inside.
        let x = (p[1] - p[0]).normalize();
        let y = n.cross(x);
        for outside in [true, false] {
            let sign = if outside { -1.0 } else { 1.0 };
            let before = p.map(|q| 7.0 * DVec2::new((q - p[0]).dot(x), sign * (q - p[0]).dot(y)));
            let (du, dv) = derivatives(p, before);
            let t = du.normalize();
            let w = n.cross(t).dot(-dv).signum();
            assert_eq!(w, if outside { 1.0 } else { -1.0 });
            for mirrored in [false, true] {
                for angle in [0.0, 0.3, std::f64::consts::FRAC_PI_2, 2.5, -1.1] {
                    let rotate = DVec2::from_angle(angle);
                    let flip = if mirrored { DVec2::new(1.0, -1.0) } else { DVec2::ONE };
                    let after = before.map(|q| rotate.rotate(q * flip) + DVec2::new(3.0, 40.0));
                    let turn = Turn::of(before, after).unwrap();
                    assert_eq!(turn.mirrored, mirrored);
                    let turned = turn.apply(t, w, n);
                    let (du, dv) = derivatives(p, after);
                    assert!((turned - du.normalize()).length() < 1e-9, "{outside} {mirrored} {angle}");
                    let w = if mirrored { -w } else { w };
                    assert!(((n.cross(turned) * w) - (-dv).normalize()).length() < 1e-9);
                }
            }
        }
    }

    /// What of a tangent lies along the normal stayed as it was.
    #[test]
    fn a_half_turn_is_the_opposite_of_any_tangent() {
        let before = [DVec2::ZERO, DVec2::X, DVec2::Y];
        let (normal, tangent) = (DVec3::new(0.3, -0.2, 2.0), DVec3::new(0.8, 0.1, 0.59));
        let half = Turn::of(before, before.map(|p| 9.0 - p)).unwrap();
        assert_eq!(half.apply(tangent, 1.0, normal), -tangent);
        let mirrored = Turn::of(before, before.map(|p| DVec2::new(9.0 - p.x, p.y))).unwrap();
        assert!(mirrored.mirrored);
        assert_eq!(mirrored.apply(tangent, -1.0, normal), -tangent);
        let other = Turn::of(before, before.map(|p| DVec2::new(p.x, 9.0 - p.y))).unwrap();
        assert_eq!(other.apply(tangent, -1.0, normal), tangent);
    }

    #[test]
    fn quarter_turns_are_exact_and_slivers_say_nothing() {
        let before = [DVec2::ZERO, DVec2::X * 0.001, DVec2::Y * 0.003];
        let after = before.map(|p| DVec2::Y.rotate(p) + 1e3);
        assert_eq!(Turn::of(before, after).unwrap().direction(), DVec2::Y);
        assert!(Turn::of(before, [DVec2::ZERO, DVec2::X, DVec2::X * 2.0]).is_none());
        assert!(Turn::of(before, before.map(|p| p + 5.0)).unwrap().is_none());
    }
}
