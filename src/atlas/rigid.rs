//! Rigid motions of the plane, and the one that maps a polyline to another best.

use glam::DVec2;

/// A turn and a shift: `p -> (cos p.x - sin p.y, sin p.x + cos p.y) + translate`. Never mirrors.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Rigid {
    pub cos: f64,
    pub sin: f64,
    pub translate: DVec2,
}

impl Rigid {
    pub(crate) const IDENTITY: Rigid = Rigid { cos: 1.0, sin: 0.0, translate: DVec2::ZERO };

    /// Where `p` goes.
    pub(crate) fn apply(&self, p: DVec2) -> DVec2 {
        self.turn(p) + self.translate
    }

    /// Where the direction `d` goes.
    pub(crate) fn turn(&self, d: DVec2) -> DVec2 {
        DVec2::new(self.cos * d.x - self.sin * d.y, self.sin * d.x + self.cos * d.y)
    }

    /// This motion after `first`.
    pub(crate) fn after(&self, first: &Rigid) -> Rigid {
        Rigid {
            cos: self.cos * first.cos - self.sin * first.sin,
            sin: self.sin * first.cos + self.cos * first.sin,
            translate: self.apply(first.translate),
        }
    }

    /// The motion back.
    pub(crate) fn inverse(&self) -> Rigid {
        let back = Rigid { cos: self.cos, sin: -self.sin, translate: DVec2::ZERO };
        Rigid { translate: -back.turn(self.translate), ..back }
    }
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
        let motion = Rigid { cos: turn.x, sin: turn.y, translate: DVec2::ZERO };
        Some(Rigid { translate: origin.1 + q - motion.turn(origin.0 + p), ..motion })
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
    let residual = pairs.iter().map(|&(from, to)| motion.apply(from).distance(to)).fold(0.0, f64::max);
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
            let motion = Rigid { cos: angle.cos(), sin: angle.sin(), translate: rng.point(4096.0) };
            let points: Vec<DVec2> = (0..9).map(|_| rng.point(4096.0)).collect();
            let pairs: Vec<_> = points.iter().map(|&p| (p, motion.apply(p))).collect();
            let (found, residual) = fit_rigid(&pairs).unwrap();
            assert!(residual < 1e-9, "{residual}");
            assert!((found.cos - motion.cos).abs() + (found.sin - motion.sin).abs() < 1e-12);
            for &(p, q) in &pairs {
                assert!(found.inverse().apply(q).distance(p) < 1e-8);
            }
            let mirrored: Vec<_> = points.iter().map(|&p| (p, DVec2::new(-p.x, p.y))).collect();
            assert!(fit_rigid(&mirrored).is_none_or(|f| f.1 > 1.0));
        }
        assert_eq!(fit_rigid(&[(DVec2::ONE, DVec2::ZERO)]), None);
    }
}
