//! The energy that turns boundary edges into given directions (Liu, Fu, Ye, Chai and Liu 2019, *Atlas Refinement with Bounded Packing Efficiency*, eq. 8).

use glam::{DMat2, DVec2};

/// A boundary edge that is to turn by some angle and to keep its length.
///
/// An angle is not a direction: the edge turns the way that is said, by more than half a turn too, because `direction` follows it from step to step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct AlignedEdge {
    /// Its ends.
    pub ends: [u32; 2],
    /// Where it points, of any length above zero; what the energy is asked for must be within half a turn of that.
    pub direction: DVec2,
    /// By how much it is to turn from `direction`, in radians, counter-clockwise.
    pub turn: f64,
    /// The length that it wants to keep.
    pub length: f64,
    /// What the squared angle counts.
    pub angle_weight: f64,
    /// What the squared relative change of its length counts.
    pub length_weight: f64,
}

impl AlignedEdge {
    /// How far the edge, which is the vector `e` now, has still to turn.
    pub fn deviation(&self, e: DVec2) -> f64 {
        self.direction.perp_dot(e).atan2(self.direction.dot(e)) - self.turn
    }

    /// Half the weighted sum of the squared deviation and the squared relative change of length.
    pub fn energy(&self, e: DVec2) -> f64 {
        let stretch = e.length() / self.length - 1.0;
        0.5 * (self.angle_weight * self.deviation(e).powi(2) + self.length_weight * stretch * stretch)
    }

    /// Its derivative by the vector.
    pub fn gradient(&self, e: DVec2) -> DVec2 {
        let length = e.length();
        let stretch = length / self.length - 1.0;
        e.perp() * (self.angle_weight * self.deviation(e) / (length * length))
            + e * (self.length_weight * stretch / (self.length * length))
    }

    /// Its second derivative without the part that may be negative (Gauss and Newton's).
    pub fn projected_hessian(&self, e: DVec2) -> DMat2 {
        let square = e.length_squared();
        let across = e.perp() * (self.angle_weight / (square * square));
        let along = e * (self.length_weight / (self.length * self.length * square));
        let outer = |a: DVec2, b: DVec2| DMat2::from_cols(a * b.x, a * b.y);
        outer(across, e.perp()) + outer(along, e)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::testing::Rng;

    #[test]
    fn gradients_are_the_differences_and_the_hessian_is_exact_where_nothing_is_left_to_do() {
        let mut rng = Rng(3);
        for _ in 0..200 {
            let (direction, e) = (rng.point(2.0) - DVec2::ONE, rng.point(2.0) - DVec2::ONE);
            if direction.length() < 0.2 || e.length() < 0.2 || direction.dot(e) < 0.0 {
                continue;
            }
            let edge = AlignedEdge {
                ends: [0, 1],
                direction,
                turn: 3.0 * rng.unit() - 1.5,
                length: 0.5 + rng.unit(),
                angle_weight: rng.unit(),
                length_weight: rng.unit(),
            };
            let step = 1e-6;
            for (k, axis) in [DVec2::X, DVec2::Y].into_iter().enumerate() {
                let slope = (edge.energy(e + axis * step) - edge.energy(e - axis * step)) / (2.0 * step);
                assert!((slope - edge.gradient(e)[k]).abs() < 1e-6 * (1.0 + slope.abs()) / e.length());
            }
            // At the goal the parts that were left out vanish.
            let goal = AlignedEdge { turn: edge.deviation(e) + edge.turn, length: e.length(), ..edge };
            let hessian = goal.projected_hessian(e);
            for (k, axis) in [DVec2::X, DVec2::Y].into_iter().enumerate() {
                let second = (goal.gradient(e + axis * step) - goal.gradient(e - axis * step)) / (2.0 * step);
                assert!((second - hessian.col(k)).length() < 1e-4 * (1.0 + second.length()), "{second} {hessian}");
            }
        }
    }

    #[test]
    fn more_than_half_a_turn_is_made_the_way_that_is_said() {
        let edge = AlignedEdge {
            ends: [0, 1],
            direction: DVec2::X,
            turn: 4.0,
            length: 1.0,
            angle_weight: 1.0,
            length_weight: 0.0,
        };
        let mut own = edge;
        for _ in 0..40 {
            let e = own.direction;
            let to = DVec2::from_angle(-0.2 * own.deviation(e).clamp(-1.0, 1.0)).rotate(e);
            own = AlignedEdge { turn: own.turn - e.angle_to(to), direction: to, ..own };
        }
        assert!(own.turn.abs() < 1e-2 && own.direction.angle_to(DVec2::from_angle(4.0)).abs() < 1e-2);
    }
}
