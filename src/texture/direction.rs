//! Quarter turns of charts, and how directions in a texture turn with their chart.
//!
//! In a glTF normal map +X points right (along +U) and +Y points *up* in the image, against glTF's v. A texel's
//! `(n.x, n.y)` is therefore the image vector `(n.x, -n.y)`, and where a chart's new texels map to the uploaded ones by the
//! orthogonal `R`, the image vector on the new sheet is the transpose of `R` times the old. With the tangent frame turned
//! along, `T' n'.x + B' n'.y = T n.x + B n.y` holds, mirrored charts included (their bitangent sign flips). `normalTexture.scale` is a
//! factor on both x and y, and so stays the same.
//!
//! The direction of an anisotropy lies in the same frame and turns alike; its strength stays. A material's `anisotropyRotation` comes
//! on top of the texture's direction, in the same frame: it stays true when charts turn, and changes its sense when one is mirrored.

use glam::{DMat2, DVec2};

use super::pixels::Depth;

/// One of the eight symmetries of the texel grid, as the matrix from new to uploaded texels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Turn {
    /// Columns: where the new +x and +y point on the uploaded image.
    pub(crate) x: [i8; 2],
    /// See `x`.
    pub(crate) y: [i8; 2],
}

impl Turn {
    /// All eight; the first is no turn, the last four are mirrored.
    pub(crate) const ALL: [Turn; 8] = [
        Turn { x: [1, 0], y: [0, 1] },
        Turn { x: [0, 1], y: [-1, 0] },
        Turn { x: [-1, 0], y: [0, -1] },
        Turn { x: [0, -1], y: [1, 0] },
        Turn { x: [-1, 0], y: [0, 1] },
        Turn { x: [0, 1], y: [1, 0] },
        Turn { x: [1, 0], y: [0, -1] },
        Turn { x: [0, -1], y: [-1, 0] },
    ];

    /// The same as a matrix.
    pub(crate) fn matrix(self) -> DMat2 {
        let column = |c: [i8; 2]| DVec2::new(f64::from(c[0]), f64::from(c[1]));
        DMat2::from_cols(column(self.x), column(self.y))
    }

    /// Whether nothing turns.
    pub(crate) fn is_identity(self) -> bool {
        self == Turn::ALL[0]
    }

    /// Turns the direction in one texel (at least three samples), exactly: components swap or change sign.
    #[inline]
    pub(crate) fn turn_samples<T: Depth>(self, texel: &mut [T]) {
        let [nx, ny, ..] = texel else { return };
        let flip = |v: T| T::from_value(T::MAX - v.value());
        let (old_x, old_y) = (*nx, *ny);
        // Image vector (old_x, -old_y), times the transposed matrix, back to (x, -y).
        *nx = match self.x {
            [1, _] => old_x,
            [-1, _] => flip(old_x),
            [_, 1] => flip(old_y),
            _ => old_y,
        };
        *ny = match self.y {
            [_, 1] => old_y,
            [_, -1] => flip(old_y),
            [1, _] => flip(old_x),
            _ => old_x,
        };
    }
}

/// Turns a direction by the transpose of the orthogonal `rotation` from new to uploaded texels.
#[inline]
pub(crate) fn turn_vector<const C: usize>(rotation: [f32; 4], texel: &mut [f32; C]) {
    if let [x, y, ..] = &mut texel[..] {
        let (u, v) = (*x, -*y);
        *x = rotation[0] * u + rotation[1] * v;
        *y = -(rotation[2] * u + rotation[3] * v);
    }
}

/// An anisotropy (x, y, strength) as the strength times the unit vector at twice the angle, in which opposite directions are the same
/// and sums make sense; the third number stays.
#[inline]
pub(crate) fn doubled<const C: usize>(texel: &mut [f32; C]) {
    if let [x, y, strength, ..] = &mut texel[..] {
        let (u, v) = (*x, *y);
        let squared = u * u + v * v;
        // A zero vector has no direction to bring in.
        let scale = if squared > 1e-12 { *strength / squared } else { 0.0 };
        *x = (u * u - v * v) * scale;
        *y = 2.0 * u * v * scale;
    }
}

/// The inverse of [`doubled`], for a mean: its direction has the sense that is nearer to that of `like`, and its strength is what is
/// left where directions differ. Where nothing is left, the direction is that of `like`.
#[inline]
pub(crate) fn halved<const C: usize>(texel: &mut [f32; C], like: &[f32; C]) {
    if let ([x, y, strength, ..], [like_x, like_y, ..]) = (&mut texel[..], &like[..]) {
        *strength = x.hypot(*y);
        let angle = 0.5 * y.atan2(*x);
        (*x, *y) = if *strength > 1e-6 { (angle.cos(), angle.sin()) } else { (*like_x, *like_y) };
        if *x * like_x + *y * like_y < 0.0 {
            (*x, *y) = (-*x, -*y);
        }
    }
}

/// The orthogonal matrix nearest to `m`: its polar factor. No turn for a matrix of rank 0.
pub(crate) fn nearest_orthogonal(m: DMat2) -> DMat2 {
    let mirrored = m.determinant() < 0.0;
    let sign = if mirrored { -1.0 } else { 1.0 };
    // (c, s) of the rotation, or of the reflection, with the largest trace against `m`.
    let axis = DVec2::new(m.x_axis.x + sign * m.y_axis.y, m.x_axis.y - sign * m.y_axis.x);
    let axis = axis.try_normalize().unwrap_or(DVec2::X);
    DMat2::from_cols(axis, DVec2::new(-axis.y, axis.x) * sign)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    /// A plane with a tangent frame, seen through the uploaded layout and through a turned one: the world-space normal
    /// must be the same.
    #[test]
    fn world_normals_are_the_same_in_the_old_and_the_new_frame() {
        let normal = DVec3::new(1.0, 2.0, -0.5).normalize();
        let tangent = normal.any_orthonormal_vector();
        for w in [1.0, -1.0] {
            let bitangent = normal.cross(tangent) * w;
            // Surface vectors of the old image's +u and +v (down).
            let (dpdu, dpdv) = (tangent, -bitangent);
            for turn in Turn::ALL {
                let m = turn.matrix();
                // The new image's +u is the old image vector m.x_axis.
                let new_u = dpdu * m.x_axis.x + dpdv * m.x_axis.y;
                let new_v = dpdu * m.y_axis.x + dpdv * m.y_axis.y;
                let new_w = w * m.determinant();
                let new_bitangent = normal.cross(new_u) * new_w;
                assert!((new_bitangent + new_v).length() < 1e-12);
                let texel = [200u8, 90, 240];
                let decode = |v: u8| f64::from(v) / 255.0 * 2.0 - 1.0;
                let world = tangent * decode(texel[0]) + bitangent * decode(texel[1]) + normal * decode(texel[2]);
                let mut turned = texel;
                turn.turn_samples(&mut turned);
                let again = new_u * decode(turned[0]) + new_bitangent * decode(turned[1]) + normal * decode(turned[2]);
                assert!((world - again).length() < 1e-12, "{turn:?}");
                let mut vector = texel.map(|v| decode(v) as f32);
                turn_vector(m.to_cols_array().map(|v| v as f32), &mut vector);
                for (v, t) in vector.iter().zip(turned) {
                    assert!((f64::from(*v) - decode(t)).abs() < 1e-6, "{turn:?}");
                }
            }
        }
    }

    #[test]
    fn the_nearest_orthogonal_matrix_undoes_scale_and_keeps_turns() {
        for turn in Turn::ALL {
            let m = turn.matrix() * 3.5;
            assert!((nearest_orthogonal(m) - turn.matrix()).to_cols_array().iter().all(|v| v.abs() < 1e-12));
        }
        let r = DMat2::from_angle(0.7);
        let found = nearest_orthogonal(r * DMat2::from_diagonal(DVec2::new(2.0, 2.0)));
        assert!((found - r).to_cols_array().iter().all(|v| v.abs() < 1e-12));
        assert!(nearest_orthogonal(DMat2::ZERO).is_finite());
    }
}
