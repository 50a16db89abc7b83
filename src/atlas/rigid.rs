//! Rigid motions of the plane, and the one that maps a polyline to another best.

use glam::{DAffine2, DMat2, DVec2};

/// A turn and a shift, never a mirror.
pub(crate) type Rigid = DAffine2;

/// The motion back. The inverse of a turn is its transpose, to the last digit.
pub(crate) fn back(motion: &Rigid) -> Rigid {
    let turn = motion.matrix2.transpose();
    Rigid { matrix2: turn, translation: -(turn * motion.translation) }
}

/// The turn by quarters that is nearest to that of a motion.
pub(crate) fn nearest_quarter_turn(motion: &Rigid) -> DMat2 {
    let turn = motion.matrix2.x_axis;
    let nearest = match turn.x.abs() >= turn.y.abs() {
        true => DVec2::new(turn.x.signum(), 0.0),
        false => DVec2::new(0.0, turn.y.signum()),
    };
    DMat2::from_cols(nearest, nearest.perp())
}

/// The motion with this turn whose shift, to the nearest multiple of `unit`, is this one.
pub(crate) fn on_multiples(turn: DMat2, shift: DVec2, unit: f64) -> Rigid {
    Rigid { matrix2: turn, translation: (shift / unit).round() * unit }
}

/// Sums over point pairs from which the best motion follows: pairs can be added one by one at constant cost. Points are taken
/// relative to the first pair, so that far from the origin no digits are lost.
#[derive(Debug, Clone, Default)]
pub(crate) struct RigidFit {
    origin: Option<(DVec2, DVec2)>,
    count: f64,
    from: DVec2,
    to: DVec2,
    dot: f64,
    cross: f64,
}

impl RigidFit {
    /// Adds a pair: `from` should go to `to`.
    pub(crate) fn add(&mut self, from: DVec2, to: DVec2) {
        let origin = *self.origin.get_or_insert((from, to));
        let (p, q) = (from - origin.0, to - origin.1);
        self.count += 1.0;
        self.from += p;
        self.to += q;
        self.dot += p.dot(q);
        self.cross += p.perp_dot(q);
    }

    /// The motion with the least sum of squared distances, or `None` without two different points.
    pub(crate) fn solve(&self) -> Option<Rigid> {
        let origin = self.origin?;
        let (p, q) = (self.from / self.count, self.to / self.count);
        let turn = DVec2::new(self.dot - self.count * p.dot(q), self.cross - self.count * p.perp_dot(q));
        let turn = turn.try_normalize()?;
        let matrix2 = DMat2::from_cols(turn, turn.perp());
        Some(Rigid { matrix2, translation: origin.1 + q - matrix2 * (origin.0 + p) })
    }
}

/// The rigid motion, without mirroring, that maps the points `from` to `to` best in the least-squares sense, and the largest
/// distance that is left. `None` where the points do not determine a turn.
pub(crate) fn fit_rigid(pairs: &[(DVec2, DVec2)]) -> Option<(Rigid, f64)> {
    let mut fit = RigidFit::default();
    for &(from, to) in pairs {
        fit.add(from, to);
    }
    let motion = fit.solve()?;
    let residual = pairs.iter().map(|&(from, to)| motion.transform_point2(from).distance(to)).fold(0.0, f64::max);
    residual.is_finite().then_some((motion, residual))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::testing::Rng;

    #[test]
    fn a_motion_is_found_again_and_a_mirror_is_not_one() {
        let mut rng = Rng(5);
        for _ in 0..100 {
            let angle = rng.unit() * std::f64::consts::TAU;
            let motion = Rigid::from_angle_translation(angle, rng.point(4096.0));
            let points: Vec<DVec2> = (0..9).map(|_| rng.point(4096.0)).collect();
            let pairs: Vec<_> = points.iter().map(|&p| (p, motion.transform_point2(p))).collect();
            let (found, residual) = fit_rigid(&pairs).unwrap();
            assert!(residual < 1e-9, "{residual}");
            assert!((found.matrix2 - motion.matrix2).abs_diff_eq(DMat2::ZERO, 1e-12));
            for &(p, q) in &pairs {
                assert!(back(&found).transform_point2(q).distance(p) < 1e-8);
            }
            let mirrored: Vec<_> = points.iter().map(|&p| (p, DVec2::new(-p.x, p.y))).collect();
            assert!(fit_rigid(&mirrored).is_none_or(|f| f.1 > 1.0));
        }
        assert_eq!(fit_rigid(&[(DVec2::ONE, DVec2::ZERO)]), None);
    }
}
