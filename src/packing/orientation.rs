//! Which ways round a piece may be placed.

use glam::{DMat2, DVec2};

use super::Piece;
use crate::atlas::bvh::Bounds;
use crate::packing::Rotation;

/// A rotation, after an optional mirroring of x.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Orientation {
    /// Radians, from +x to +y, in 0..2 pi.
    pub angle: f64,
    /// Mirrored before turning.
    pub mirror: bool,
}

impl Orientation {
    /// The linear map; exact for quarter turns.
    pub fn matrix(self) -> DMat2 {
        let quarters = self.angle / std::f64::consts::FRAC_PI_2;
        let (sin, cos) = if (quarters - quarters.round()).abs() < 1e-12 {
            [(0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0)][quarters.round() as usize % 4]
        } else {
            self.angle.sin_cos()
        };
        let flip = if self.mirror { -1.0 } else { 1.0 };
        DMat2::from_cols(DVec2::new(cos, sin) * flip, DVec2::new(-sin, cos))
    }
}

/// Most angles beside the best axes of a piece that is free where others keep to quarter turns.
const FREE_ANGLES: u32 = 3;

/// The orientations to try for a piece: quarter turns, and where any rotation is allowed or the piece is free its own best axes (Box
/// Cutter, 3.2.1: least L1 norm of the boundary's directions) and `more` angles, evenly spread, and where that is more than one, the
/// tightest box and upright as it is. A piece that half turns must do for has these alone.
pub(crate) fn orientations(piece: &Piece, rotation: Rotation, mirror: bool, more: u32) -> Vec<Orientation> {
    use std::f64::consts::FRAC_PI_2;
    let mut within = vec![0.0];
    let free = piece.free && rotation == Rotation::Quarter;
    if !piece.half_turns && (rotation == Rotation::Any || free) {
        let axes = best_axes(piece);
        within = vec![axes];
        let more = if free { more.min(FREE_ANGLES) } else { more };
        if more > 1 {
            within.extend([0.0, tightest_box(piece)].into_iter().filter(|a| (a - axes).abs() > 1e-5));
        }
        within.extend((1..=more).map(|k| (axes + FRAC_PI_2 * f64::from(k) / f64::from(more + 1)) % FRAC_PI_2));
    }
    let quarters = quarter_turns(rotation, piece.half_turns);
    let mut all = Vec::new();
    for mirror in if mirror { &[false, true][..] } else { &[false] } {
        for angle in &within {
            for q in quarters {
                all.push(Orientation { angle: angle + FRAC_PI_2 * f64::from(*q), mirror: *mirror });
            }
        }
    }
    all
}

/// The quarter turns that are allowed.
pub(crate) fn quarter_turns(rotation: Rotation, half_turns: bool) -> &'static [u8] {
    match rotation {
        Rotation::None => &[0],
        _ if half_turns => &[0, 2],
        _ => &[0, 1, 2, 3],
    }
}

/// The angle in 0..pi/2 that turns the piece's border as far as possible along the axes: the border edges' mean
/// L1 norm is least. Searched on a grid of one degree, then by golden section.
pub(crate) fn best_axes(piece: &Piece) -> f64 {
    use std::f64::consts::FRAC_PI_2;
    let cost = |angle: f64| l1_norm(&piece.border, angle);
    let found = least(cost, FRAC_PI_2 / 90.0);
    // Axis-aligned pieces stay exactly so.
    if cost(0.0) <= cost(found) * (1.0 + 1e-9) { 0.0 } else { found.rem_euclid(FRAC_PI_2) }
}

/// The L1 norm of vectors turned by an angle: the least, the more of them lie along the axes.
pub(crate) fn l1_norm(vectors: &[DVec2], angle: f64) -> f64 {
    let (sin, cos) = angle.sin_cos();
    vectors.iter().map(|d| (d.x * cos - d.y * sin).abs() + (d.x * sin + d.y * cos).abs()).sum()
}

/// The angle in 0..pi/2 at which the piece's bounding box is smallest. Searched on a grid of one degree, then by golden section.
fn tightest_box(piece: &Piece) -> f64 {
    use std::f64::consts::FRAC_PI_2;
    let points = hull(piece.triangles.iter().flatten().copied().collect());
    let area = |angle: f64| -> f64 {
        let (sin, cos) = angle.sin_cos();
        let turned = points.iter().map(|p| DVec2::new(p.x * cos - p.y * sin, p.x * sin + p.y * cos));
        Bounds::around(turned).or_zero().size().element_product()
    };
    least(area, FRAC_PI_2 / 90.0).rem_euclid(FRAC_PI_2)
}

/// The convex hull (monotone chain).
fn hull(mut points: Vec<DVec2>) -> Vec<DVec2> {
    points.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    points.dedup();
    let half = |points: &mut dyn Iterator<Item = &DVec2>| {
        let mut chain: Vec<DVec2> = Vec::new();
        for &p in points {
            while let [.., a, b] = chain[..] {
                if (b - a).perp_dot(p - b) > 0.0 {
                    break;
                }
                chain.pop();
            }
            chain.push(p);
        }
        chain
    };
    let mut all = half(&mut points.iter());
    all.extend(half(&mut points.iter().rev()));
    all
}

/// The place in 0..90 steps where `cost` is least, to a thousandth of a step.
fn least(cost: impl Fn(f64) -> f64, step: f64) -> f64 {
    let mut best = (0, f64::INFINITY);
    for k in 0..90 {
        let c = cost(step * f64::from(k));
        if c < best.1 - 1e-9 {
            best = (k, c);
        }
    }
    let (mut a, mut b) = (step * (f64::from(best.0) - 1.0), step * (f64::from(best.0) + 1.0));
    for _ in 0..20 {
        let (p, q) = (a + (b - a) * 0.382, b - (b - a) * 0.382);
        if cost(p) <= cost(q) {
            b = q;
        } else {
            a = p;
        }
    }
    (a + b) / 2.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_turned_rectangle_finds_its_axes() {
        for degrees in [0.0_f64, 7.3, 30.0, 60.5, 88.0] {
            let turn = DMat2::from_angle(-degrees.to_radians());
            let sides = [DVec2::new(3.0, 0.0), DVec2::new(0.0, 1.0), DVec2::new(-3.0, 0.0), DVec2::new(0.0, -1.0)];
            let piece = Piece { border: sides.map(|d| turn * d).to_vec(), area: 3.0, ..Piece::default() };
            assert!((best_axes(&piece).to_degrees() - degrees).abs() < 0.01, "{degrees}");
            let [a, b, c] = [DVec2::ZERO, DVec2::new(3.0, 0.0), DVec2::new(1.0, 1.0)].map(|p| turn * p);
            let piece = Piece { triangles: vec![[a, b, c]], ..piece };
            assert!((tightest_box(&piece).to_degrees() - degrees).abs() < 0.01, "{degrees}");
        }
    }

    #[test]
    fn a_free_piece_turns_beyond_quarters_unless_nothing_may_turn() {
        let turn = DMat2::from_angle(0.3);
        let sides = [DVec2::new(3.0, 0.0), DVec2::new(0.0, 1.0), DVec2::new(-3.0, 0.0), DVec2::new(0.0, -1.0)];
        let bound = Piece { border: sides.map(|d| turn * d).to_vec(), area: 3.0, ..Piece::default() };
        let free = Piece { free: true, ..bound.clone() };
        let quarter = |o: &Orientation| {
            let quarters = o.angle / std::f64::consts::FRAC_PI_2;
            (quarters - quarters.round()).abs() < 1e-12
        };
        let of = |piece, rotation| orientations(piece, rotation, false, 11);
        assert!(of(&bound, Rotation::Quarter).iter().all(quarter));
        let axes = best_axes(&free);
        let turned = of(&free, Rotation::Quarter);
        assert!(turned.iter().any(|o| o.angle == axes) && !turned.iter().all(quarter));
        assert!(turned.len() < of(&free, Rotation::Any).len());
        assert_eq!(of(&free, Rotation::None), vec![Orientation { angle: 0.0, mirror: false }]);
    }

    #[test]
    fn what_half_turns_must_do_for_lies_along_its_own_axes() {
        let piece = Piece { half_turns: true, free: true, ..Piece::default() };
        for rotation in [Rotation::Quarter, Rotation::Any] {
            for o in orientations(&piece, rotation, true, 11) {
                let m = o.matrix();
                assert!(m.x_axis.y == 0.0 && m.y_axis.x == 0.0, "{o:?}");
            }
            assert_eq!(orientations(&piece, rotation, true, 11).len(), 4);
        }
        assert_eq!(orientations(&piece, Rotation::None, false, 11).len(), 1);
    }

    #[test]
    fn quarter_turns_are_exact() {
        let piece = Piece::default();
        let all = orientations(&piece, Rotation::Quarter, true, 0);
        assert_eq!(all.len(), 8);
        for o in all {
            assert!(o.matrix().to_cols_array().iter().all(|x| [-1.0, 0.0, 1.0].contains(x)));
        }
    }
}
