//! Limited-memory BFGS (Nocedal 1980; Liu and Nocedal 1989): what the last steps told of the curvature, on top of a factor that is no longer quite right.

use std::collections::VecDeque;

use glam::DVec2;

/// The last steps, and how each changed the gradient.
#[derive(Debug, Default)]
pub(crate) struct Memory {
    /// (step, change of the gradient, 1 / their product), the oldest first.
    pairs: VecDeque<(Vec<DVec2>, Vec<DVec2>, f64)>,
}

/// So many steps are remembered.
const REMEMBERED: usize = 6;

impl Memory {
    /// Notes a step and what it changed in the gradient. Where the energy curves downward along it, nothing is learnt.
    pub fn note(&mut self, step: Vec<DVec2>, change: Vec<DVec2>) {
        let along = dot(&step, &change);
        if along > 1e-12 * (dot(&step, &step) * dot(&change, &change)).sqrt() {
            if self.pairs.len() == REMEMBERED {
                self.pairs.pop_front();
            }
            self.pairs.push_back((step, change, 1.0 / along));
        }
    }

    /// Multiplies a vector by the inverse of the Hessian as it is known, in place: `solve` multiplies by the inverse at the first of the steps.
    pub fn solve(&self, b: &mut [DVec2], solve: impl FnOnce(&mut [DVec2])) {
        let mut parts = Vec::with_capacity(self.pairs.len());
        for (step, change, inverse) in self.pairs.iter().rev() {
            let part = inverse * dot(step, b);
            add(b, -part, change);
            parts.push(part);
        }
        solve(b);
        for ((step, change, inverse), part) in self.pairs.iter().zip(parts.into_iter().rev()) {
            let back = inverse * dot(change, b);
            add(b, part - back, step);
        }
    }
}

fn dot(a: &[DVec2], b: &[DVec2]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a.dot(*b)).sum()
}

fn add(to: &mut [DVec2], factor: f64, what: &[DVec2]) {
    to.iter_mut().zip(what).for_each(|(to, what)| *to += factor * *what);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::testing::Rng;

    /// The inverse after each step, written out: (1 - r s y^T) H (1 - r y s^T) + r s s^T.
    #[test]
    fn it_multiplies_by_the_inverse_that_bfgs_keeps() {
        let mut rng = Rng(5);
        let n = 4;
        let flat = |v: &[DVec2]| v.iter().flat_map(|p| [p.x, p.y]).collect::<Vec<f64>>();
        let mut inverse: Vec<Vec<f64>> =
            (0..2 * n).map(|i| (0..2 * n).map(|j| if i == j { 0.5 + i as f64 } else { 0.0 }).collect()).collect();
        let first = inverse.clone();
        let mut memory = Memory::default();
        for _ in 0..REMEMBERED {
            let step: Vec<DVec2> = (0..n).map(|_| rng.point(1.0)).collect();
            let change: Vec<DVec2> = step.iter().map(|s| *s + rng.point(0.2)).collect();
            let (s, y) = (flat(&step), flat(&change));
            let product: f64 = s.iter().zip(&y).map(|(s, y)| s * y).sum();
            assert!(product > 0.0);
            let r = 1.0 / product;
            let left = |i: usize, j: usize| f64::from(u8::from(i == j)) - r * s[i] * y[j];
            let mut next = vec![vec![0.0; 2 * n]; 2 * n];
            for (i, row) in next.iter_mut().enumerate() {
                for (j, entry) in row.iter_mut().enumerate() {
                    *entry = r * s[i] * s[j];
                    for (k, own) in inverse.iter().enumerate() {
                        for (l, value) in own.iter().enumerate() {
                            *entry += left(i, k) * value * left(j, l);
                        }
                    }
                }
            }
            inverse = next;
            memory.note(step, change);
        }
        let b: Vec<DVec2> = (0..n).map(|_| rng.point(1.0)).collect();
        let mut x = b.clone();
        memory.solve(&mut x, |b| {
            for (k, p) in b.iter_mut().enumerate() {
                *p = DVec2::new(first[2 * k][2 * k] * p.x, first[2 * k + 1][2 * k + 1] * p.y);
            }
        });
        for (row, got) in inverse.iter().zip(flat(&x)) {
            let expected: f64 = row.iter().zip(flat(&b)).map(|(m, b)| m * b).sum();
            assert!((expected - got).abs() < 1e-9 * expected.abs().max(1.0), "{expected} {got}");
        }
    }

    #[test]
    fn a_step_along_which_the_energy_curves_downward_is_not_noted() {
        let mut memory = Memory::default();
        memory.note(vec![DVec2::X], vec![-DVec2::X]);
        let mut x = [DVec2::new(3.0, 4.0)];
        memory.solve(&mut x, |b| b[0] *= 2.0);
        assert_eq!(x, [DVec2::new(6.0, 8.0)]);
    }
}
