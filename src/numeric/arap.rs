//! As-rigid-as-possible parameterization (Liu et al. 2008) of a patch of triangles, some of whose vertices stay where they are.

use glam::DVec2;

use super::cholesky::Cholesky;
use super::energy::jacobian;
use crate::atlas::groups::DisjointSets;

/// Weight of the edges of triangles without a shape: they follow the others.
const LOOSE: f64 = 1e-4;

/// A patch: triangles over vertices 0..n, and the shapes that they should have.
#[derive(Debug)]
pub(crate) struct Patch<'a> {
    /// Vertices of each triangle.
    pub triangles: &'a [[u32; 3]],
    /// Target shape of each triangle; where it lies does not matter.
    pub rest: &'a [[DVec2; 3]],
    /// By triangle: how much more than its shape it counts; 1 is usual.
    pub stiffness: &'a [f64],
    /// By vertex: whether it may move. Where none of a connected part is held, its first vertex is.
    pub free: &'a [bool],
}

/// The patch's equations, factored: valid as long as the same vertices are free.
pub(crate) struct Arap<'a> {
    patch: &'a Patch<'a>,
    /// By triangle and edge (k to k + 1): half the cotangent of the angle across.
    weights: Vec<[f64; 3]>,
    /// Row by vertex, for those that are free.
    row: Vec<Option<u32>>,
    factor: Cholesky,
}

impl<'a> Arap<'a> {
    /// Factors the patch's Laplacian; `None` where it is not positive definite in floating point.
    pub(crate) fn new(patch: &'a Patch<'a>) -> Option<Self> {
        let weights: Vec<[f64; 3]> =
            patch.rest.iter().zip(patch.stiffness).map(|(rest, s)| weights(rest).map(|w| w * s)).collect();
        let held = held(patch);
        let mut row = vec![None; patch.free.len()];
        let mut rows = 0;
        for (row, held) in row.iter_mut().zip(&held) {
            if !held {
                *row = Some(rows as u32);
                rows += 1;
            }
        }
        let mut diagonal = vec![0.0; rows];
        let mut entries = Vec::new();
        for (t, w) in patch.triangles.iter().zip(&weights) {
            for k in 0..3 {
                let (i, j) = (row[t[k] as usize], row[t[(k + 1) % 3] as usize]);
                for end in [i, j].into_iter().flatten() {
                    diagonal[end as usize] += w[k];
                }
                if let (Some(i), Some(j)) = (i, j)
                    && i != j
                {
                    entries.push((i.min(j), i.max(j), -w[k]));
                }
            }
        }
        let factor = Cholesky::new(&diagonal, &entries)?;
        Some(Arap { patch, weights, row, factor })
    }

    /// Moves the free vertices, at most so many rounds of rotations and positions; ends when no vertex moves by more than
    /// `tolerance`.
    pub(crate) fn relax(&self, positions: &mut [DVec2], rounds: usize, tolerance: f64) {
        // Weighted target edges, and what held vertices contribute: the same in every round.
        let edges: Vec<[DVec2; 3]> = (self.patch.rest.iter().zip(&self.weights))
            .map(|(rest, w)| [0, 1, 2].map(|k| w[k] * (rest[k] - rest[(k + 1) % 3])))
            .collect();
        let rows = self.row.iter().flatten().count();
        let mut held = vec![DVec2::ZERO; rows];
        for (t, w) in self.patch.triangles.iter().zip(&self.weights) {
            for k in 0..3 {
                let [i, j] = [t[k] as usize, t[(k + 1) % 3] as usize];
                match (self.row[i], self.row[j]) {
                    (Some(row), None) => held[row as usize] += w[k] * positions[j],
                    (None, Some(row)) => held[row as usize] += w[k] * positions[i],
                    _ => {}
                }
            }
        }
        // Rows of held vertices lead to one more, which is not read.
        let row: Vec<usize> = self.row.iter().map(|r| r.map_or(rows, |r| r as usize)).collect();
        let ends: Vec<[usize; 3]> = self.patch.triangles.iter().map(|t| t.map(|v| row[v as usize])).collect();
        let mut side = vec![DVec2::ZERO; rows + 1];
        for _ in 0..rounds {
            side[..rows].copy_from_slice(&held);
            for ((t, e), rows) in self.patch.triangles.iter().zip(&edges).zip(&ends) {
                let [a, b, c] = t.map(|v| positions[v as usize]);
                // The rotation nearest to the map from rest to now: its cosine and sine up to a factor.
                let now = [a - b, b - c, c - a];
                let dot = e[0].dot(now[0]) + e[1].dot(now[1]) + e[2].dot(now[2]);
                let cross = e[0].perp_dot(now[0]) + e[1].perp_dot(now[1]) + e[2].perp_dot(now[2]);
                let turn = DVec2::new(dot, cross).try_normalize().unwrap_or(DVec2::X);
                let [p, q, r] = e.map(|e| turn.rotate(e));
                side[rows[0]] += p - r;
                side[rows[1]] += q - p;
                side[rows[2]] += r - q;
            }
            self.factor.solve(&mut side[..rows]);
            let mut moved: f64 = 0.0;
            for (position, row) in positions.iter_mut().zip(&row) {
                if *row < rows {
                    moved = moved.max(position.distance_squared(side[*row]));
                    *position = side[*row];
                }
            }
            if moved <= tolerance * tolerance {
                break;
            }
        }
    }
}

/// Half the cotangents of the angles across the three edges.
fn weights(rest: &[DVec2; 3]) -> [f64; 3] {
    if jacobian(rest, rest).is_none() {
        return [LOOSE; 3];
    }
    [0, 1, 2].map(|k| {
        let (a, b) = (rest[k] - rest[(k + 2) % 3], rest[(k + 1) % 3] - rest[(k + 2) % 3]);
        0.5 * a.dot(b) / a.perp_dot(b).abs()
    })
}

/// Vertices that stay: those that must, and one of each connected part that would have none.
fn held(patch: &Patch<'_>) -> Vec<bool> {
    let mut parts = DisjointSets::new(patch.free.len());
    for t in patch.triangles {
        parts.unite(t[0], t[1]);
        parts.unite(t[0], t[2]);
    }
    let mut held: Vec<bool> = patch.free.iter().map(|f| !f).collect();
    let mut has = vec![false; held.len()];
    for (v, held) in held.iter().enumerate() {
        has[parts.find(v as u32) as usize] |= held;
    }
    for (v, held) in held.iter_mut().enumerate() {
        *held |= !std::mem::replace(&mut has[parts.find(v as u32) as usize], true);
    }
    held
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::testing::{Rng, sheet};
    use crate::numeric::energy::arap;

    fn grid(n: usize) -> (Vec<[u32; 3]>, Vec<DVec2>) {
        let atlas = sheet(n, n, DVec2::ZERO);
        (atlas.corners.iter().map(|c| c.map(|u| u.0)).collect(), atlas.uv)
    }

    fn energy(triangles: &[[u32; 3]], rest: &[[DVec2; 3]], at: &[DVec2]) -> f64 {
        let one =
            |(t, r): (&[u32; 3], &[DVec2; 3])| jacobian(r, &t.map(|v| at[v as usize])).map_or(0.0, |j| arap(&j)) * 0.5;
        triangles.iter().zip(rest).map(one).sum()
    }

    #[test]
    fn a_crumpled_patch_finds_its_shape_again_wherever_it_is_held() {
        let (triangles, points) = grid(6);
        let rest: Vec<[DVec2; 3]> = triangles.iter().map(|t| t.map(|v| points[v as usize])).collect();
        let turn = |p: DVec2| DVec2::from_angle(0.8).rotate(p) + DVec2::new(30.0, -4.0);
        let mut rng = Rng(7);
        // Held along one side, at two vertices, and nowhere.
        for fixed in [7, 2, 0] {
            let free: Vec<bool> = (0..points.len()).map(|v| v >= fixed).collect();
            let mut at: Vec<DVec2> = points
                .iter()
                .zip(&free)
                .map(|(p, free)| turn(*p) + if *free { rng.point(0.5) - 0.25 } else { DVec2::ZERO })
                .collect();
            let start = energy(&triangles, &rest, &at);
            let stiffness = vec![1.0; rest.len()];
            let patch = Patch { triangles: &triangles, rest: &rest, stiffness: &stiffness, free: &free };
            Arap::new(&patch).expect("positive definite").relax(&mut at, 400, 1e-12);
            let end = energy(&triangles, &rest, &at);
            assert!(end < 1e-5 && start > 0.1, "{fixed}: {start} -> {end}");
        }
    }

    #[test]
    fn no_round_makes_the_energy_larger_and_held_vertices_stay() {
        let (triangles, points) = grid(5);
        let rest: Vec<[DVec2; 3]> = triangles.iter().map(|t| t.map(|v| points[v as usize])).collect();
        let free: Vec<bool> = points.iter().map(|p| p.x > 0.5 && p.x < 4.5).collect();
        let start: Vec<DVec2> = points.iter().map(|p| if p.x > 4.5 { *p + DVec2::new(1.5, 2.0) } else { *p }).collect();
        let stiffness = vec![1.0; rest.len()];
        let patch = Patch { triangles: &triangles, rest: &rest, stiffness: &stiffness, free: &free };
        let system = Arap::new(&patch).expect("positive definite");
        let mut at = start.clone();
        let mut last = f64::INFINITY;
        for _ in 0..30 {
            system.relax(&mut at, 1, 0.0);
            let now = energy(&triangles, &rest, &at);
            assert!(now <= last * (1.0 + 1e-12), "{last} -> {now}");
            last = now;
        }
        assert!(at.iter().zip(&start).zip(&free).all(|((a, s), free)| *free || a == s));
    }
}
