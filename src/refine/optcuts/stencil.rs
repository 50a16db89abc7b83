//! The few vertices that an operation makes, placed where they cost least, all others held (section 5.1).

use glam::{DMat2, DVec2};

use crate::numeric::dirichlet::{RestTriangle, step_bound};

/// Most vertices that move.
pub(super) const MOST_FREE: usize = 4;
const N: usize = 2 * MOST_FREE;
/// Newton steps of a query.
const ROUNDS: usize = 10;
/// A step that gains less than this part ends it.
const ENOUGH: f64 = 1e-4;

/// A small problem: the first vertices are free.
#[derive(Debug, Clone, Default)]
pub(super) struct Stencil {
    pub x: Vec<DVec2>,
    pub free: usize,
    /// Corners and rest of each triangle; those of the void come last.
    pub elements: Vec<([u8; 3], RestTriangle)>,
    /// How many are faces.
    pub faces: usize,
}

impl Stencil {
    fn at(&self, corners: [u8; 3]) -> [DVec2; 3] {
        corners.map(|k| self.x[k as usize])
    }

    fn energy(&self) -> f64 {
        self.elements.iter().map(|(c, rest)| rest.energy(self.at(*c))).sum()
    }

    /// The energy of the faces alone.
    pub fn face_energy(&self) -> f64 {
        self.elements[..self.faces].iter().map(|(c, rest)| rest.energy(self.at(*c))).sum()
    }

    /// Moves the free vertices to a minimum. All triangles must be injective before.
    pub fn minimise(&mut self) {
        let n = 2 * self.free;
        let mut energy = self.energy();
        for _ in 0..ROUNDS {
            let mut h = [[0.0; N]; N];
            let mut g = [0.0; N];
            for (corners, rest) in &self.elements {
                let at = self.at(*corners);
                let (_, gradient) = rest.gradient(at);
                let blocks = rest.projected_hessian(at);
                for (k, &v) in corners.iter().enumerate().filter(|(_, v)| (**v as usize) < self.free) {
                    g[2 * v as usize] += gradient[k].x;
                    g[2 * v as usize + 1] += gradient[k].y;
                }
                for (block, (i, k)) in blocks.iter().zip([(0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)]) {
                    let (r, c) = (corners[i] as usize, corners[k] as usize);
                    if r < self.free && c < self.free {
                        add(&mut h, r, c, block);
                        if i != k {
                            add(&mut h, c, r, &block.transpose());
                        }
                    }
                }
            }
            let Some(p) = solve(&mut h, &g, n) else { return };
            let slope: f64 = (0..n).map(|k| g[k] * p[k]).sum();
            if slope.is_nan() || slope >= 0.0 {
                return;
            }
            let direction = |v: u8| {
                let v = v as usize;
                if v < self.free { DVec2::new(p[2 * v], p[2 * v + 1]) } else { DVec2::ZERO }
            };
            let bounds = self.elements.iter().map(|(c, _)| step_bound(self.at(*c), c.map(direction)));
            let mut alpha = (0.9 * bounds.fold(f64::INFINITY, f64::min)).min(1.0);
            let before: [DVec2; MOST_FREE] = std::array::from_fn(|k| self.x[k]);
            let after = loop {
                for (k, from) in before.iter().enumerate().take(self.free) {
                    self.x[k] = *from + alpha * DVec2::new(p[2 * k], p[2 * k + 1]);
                }
                let after = self.energy();
                if after <= energy + 1e-4 * alpha * slope {
                    break after;
                }
                alpha *= 0.5;
                if alpha < 1e-8 {
                    self.x[..self.free].copy_from_slice(&before[..self.free]);
                    return;
                }
            };
            let gained = energy - after;
            energy = after;
            if gained < ENOUGH * energy {
                return;
            }
        }
    }
}

fn add(h: &mut [[f64; N]; N], r: usize, c: usize, block: &DMat2) {
    h[2 * r][2 * c] += block.x_axis.x;
    h[2 * r + 1][2 * c] += block.x_axis.y;
    h[2 * r][2 * c + 1] += block.y_axis.x;
    h[2 * r + 1][2 * c + 1] += block.y_axis.y;
}

/// `-h^-1 g` by Cholesky; `None` where `h` is not positive definite.
fn solve(h: &mut [[f64; N]; N], g: &[f64; N], n: usize) -> Option<[f64; N]> {
    let mut x = [0.0; N];
    for k in 0..n {
        let pivot = h[k][k] - (0..k).map(|p| h[k][p] * h[k][p]).sum::<f64>();
        if !(pivot > 0.0 && pivot.is_finite()) {
            return None;
        }
        h[k][k] = pivot.sqrt();
        for i in k + 1..n {
            h[i][k] = (h[i][k] - (0..k).map(|p| h[i][p] * h[k][p]).sum::<f64>()) / h[k][k];
        }
    }
    for k in 0..n {
        x[k] = (-g[k] - (0..k).map(|p| h[k][p] * x[p]).sum::<f64>()) / h[k][k];
    }
    for k in (0..n).rev() {
        x[k] = (x[k] - (k + 1..n).map(|i| h[i][k] * x[i]).sum::<f64>()) / h[k][k];
    }
    Some(x)
}
