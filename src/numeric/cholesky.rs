//! Sparse Cholesky factorisation for small and middling systems: one factor, many right-hand sides.
//!
//! L D L^T row by row within the envelope of a reverse Cuthill-McKee order (George and Liu 1981, chapter 4). Regions about a seam
//! are long and thin: there this order leaves a narrow envelope, and within it all sums run over neighbours in memory.

use glam::DVec2;

use crate::atlas::groups::{Grouped, sorted_unique};

/// The factor of a symmetric positive definite matrix.
#[derive(Debug, Clone)]
pub(crate) struct Cholesky {
    /// Old index by new.
    order: Vec<u32>,
    /// First column of each row of L that is kept; from there to the diagonal all are.
    first: Vec<u32>,
    /// Start of each row in `values`; L has a unit diagonal, which is not kept.
    start: Vec<usize>,
    values: Vec<f64>,
    pivots: Vec<f64>,
}

impl Cholesky {
    /// Factors the matrix with this diagonal and sums of `entries`: (row, column, value) with row < column, each standing for both
    /// triangles. `None` where a pivot is not positive.
    pub(crate) fn new(diagonal: &[f64], entries: &[(u32, u32, f64)]) -> Option<Self> {
        let n = diagonal.len();
        let pairs = sorted_unique(entries.iter().flat_map(|&(i, j, _)| [(i, j), (j, i)]));
        let order = reverse_cuthill_mckee(n, &Grouped::new(n, pairs.into_iter()));
        let mut place = vec![0u32; n];
        order.iter().enumerate().for_each(|(new, &old)| place[old as usize] = new as u32);
        let lower = |&(i, j, v): &(u32, u32, f64)| {
            let (p, q) = (place[i as usize], place[j as usize]);
            (p.max(q) as usize, p.min(q), v)
        };
        let mut first: Vec<u32> = (0..n as u32).collect();
        for (row, column, _) in entries.iter().map(lower) {
            first[row] = first[row].min(column);
        }
        let mut start = vec![0; n + 1];
        (0..n).for_each(|k| start[k + 1] = start[k] + k - first[k] as usize);
        let mut values = vec![0.0; start[n]];
        for (row, column, v) in entries.iter().map(lower) {
            values[start[row] + (column - first[row]) as usize] += v;
        }
        let mut pivots: Vec<f64> = order.iter().map(|&old| diagonal[old as usize]).collect();
        for k in 0..n {
            let (done, row) = values.split_at_mut(start[k]);
            let (from, row) = (first[k] as usize, &mut row[..start[k + 1] - start[k]]);
            // First the row of L D, then of L.
            for j in from..k {
                let own = first[j] as usize;
                let common = own.max(from);
                let above = &done[start[j] + common - own..start[j + 1]];
                row[j - from] -= dot(&row[common - from..j - from], above);
            }
            let mut pivot = pivots[k];
            for (value, by) in row.iter_mut().zip(&pivots[from..k]) {
                let entry = *value / by;
                pivot -= entry * *value;
                *value = entry;
            }
            if !(pivot > 0.0 && pivot.is_finite()) {
                return None;
            }
            pivots[k] = pivot;
        }
        Some(Cholesky { order, first, start, values, pivots })
    }

    fn row(&self, k: usize) -> (std::ops::Range<usize>, &[f64]) {
        (self.first[k] as usize..k, &self.values[self.start[k]..self.start[k + 1]])
    }

    /// Solves for two right-hand sides at once, in place.
    pub(crate) fn solve(&self, b: &mut [DVec2]) {
        let mut x: Vec<DVec2> = self.order.iter().map(|&old| b[old as usize]).collect();
        for k in 0..x.len() {
            let (columns, row) = self.row(k);
            // Two sums: one addition does not wait for the other.
            let mut sums = [DVec2::ZERO; 2];
            let (x_pairs, x_rest) = x[columns].as_chunks::<2>();
            let (pairs, rest) = row.as_chunks::<2>();
            for (x, l) in x_pairs.iter().zip(pairs) {
                sums[0] += l[0] * x[0];
                sums[1] += l[1] * x[1];
            }
            for (x, l) in x_rest.iter().zip(rest) {
                sums[0] += *l * *x;
            }
            x[k] -= sums[0] + sums[1];
        }
        x.iter_mut().zip(&self.pivots).for_each(|(x, pivot)| *x /= *pivot);
        for k in (0..x.len()).rev() {
            let (columns, row) = self.row(k);
            let value = x[k];
            x[columns].iter_mut().zip(row).for_each(|(x, l)| *x -= *l * value);
        }
        for (&old, value) in self.order.iter().zip(x) {
            b[old as usize] = value;
        }
    }
}

/// The sum of products, in four interleaved parts.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<4>(), b.as_chunks::<4>());
    let mut sums = [0.0; 4];
    for (a, b) in a.iter().zip(b) {
        for k in 0..4 {
            sums[k] += a[k] * b[k];
        }
    }
    let rest: f64 = a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum();
    (sums[0] + sums[1]) + (sums[2] + sums[3]) + rest
}

/// Old index by new: breadth first from an end of each component, few neighbours first, and all of it backwards. `graph` holds the
/// neighbours of each of `n` rows.
fn reverse_cuthill_mckee(n: usize, graph: &Grouped<u32>) -> Vec<u32> {
    let mut order: Vec<u32> = Vec::with_capacity(n);
    let mut taken = vec![false; n];
    // Round in which a search from an end saw the row.
    let mut seen = vec![0u32; n];
    let mut round = 0;
    let mut queue: Vec<u32> = Vec::new();
    for seed in 0..n as u32 {
        if taken[seed as usize] {
            continue;
        }
        // Twice to the far end.
        let mut end = seed;
        for _ in 0..2 {
            round += 1;
            queue.clear();
            queue.push(end);
            seen[end as usize] = round;
            let mut next = 0;
            while next < queue.len() {
                for &j in graph.of(queue[next]) {
                    if seen[j as usize] != round {
                        seen[j as usize] = round;
                        queue.push(j);
                    }
                }
                next += 1;
            }
            end = queue.last().copied().unwrap_or(seed);
        }
        let mut next = order.len();
        order.push(end);
        taken[end as usize] = true;
        while next < order.len() {
            let from = order.len();
            for &j in graph.of(order[next]) {
                if !taken[j as usize] {
                    taken[j as usize] = true;
                    order.push(j);
                }
            }
            order[from..].sort_by_key(|&j| graph.of(j).len());
            next += 1;
        }
    }
    order.reverse();
    order
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::testing::Rng;

    type Entries = Vec<(u32, u32, f64)>;

    /// The Laplacian of a random graph with something on the diagonal, and the same as a full matrix.
    fn random(n: usize, edges: usize, rng: &mut Rng) -> (Vec<f64>, Entries, Vec<Vec<f64>>) {
        let (mut diagonal, mut entries) = (vec![0.0; n], Vec::new());
        let mut full = vec![vec![0.0; n]; n];
        for (i, row) in full.iter_mut().enumerate() {
            let value = 0.01 + rng.unit();
            diagonal[i] += value;
            row[i] += value;
        }
        for _ in 0..edges {
            let (i, j) = (rng.next() as usize % n, rng.next() as usize % n);
            let w = rng.unit();
            if i != j {
                entries.push((i.min(j) as u32, i.max(j) as u32, -w));
                diagonal[i] += w;
                diagonal[j] += w;
                full[i][j] -= w;
                full[j][i] -= w;
                full[i][i] += w;
                full[j][j] += w;
            }
        }
        (diagonal, entries, full)
    }

    #[test]
    fn the_solution_solves_the_system() {
        let mut rng = Rng(3);
        for n in [1, 2, 7, 40, 150] {
            let (diagonal, entries, full) = random(n, 3 * n, &mut rng);
            let expected: Vec<DVec2> = (0..n).map(|_| rng.point(10.0)).collect();
            let times = |row: &Vec<f64>| row.iter().zip(&expected).map(|(a, x)| *a * *x).sum::<DVec2>();
            let mut b: Vec<DVec2> = full.iter().map(times).collect();
            Cholesky::new(&diagonal, &entries).expect("positive definite").solve(&mut b);
            let worst = b.iter().zip(&expected).map(|(x, y)| x.distance(*y)).fold(0.0, f64::max);
            assert!(worst < 1e-9, "{n}: {worst}");
        }
    }

    #[test]
    fn a_matrix_that_is_not_positive_definite_is_refused() {
        assert!(Cholesky::new(&[1.0, 1.0], &[(0, 1, -2.0)]).is_none());
        assert!(Cholesky::new(&[0.0; 3], &[]).is_none());
    }
}
