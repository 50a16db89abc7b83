//! Sparse Cholesky factorisation for small and middling systems: one factor, many right-hand sides.
//!
//! L D L^T with a reverse Cuthill-McKee order, row by row along the elimination tree (George and Liu 1981; Davis 2006, chapter
//! 4). Regions about a seam are long and thin, and there this order leaves little fill.

use glam::DVec2;

const NONE: u32 = u32::MAX;

/// A symmetric matrix as sums of entries.
#[derive(Debug, Clone, Default)]
pub(crate) struct Symmetric {
    diagonal: Vec<f64>,
    /// (row, column, value) with row < column, each standing for both triangles.
    entries: Vec<(u32, u32, f64)>,
}

impl Symmetric {
    /// The zero matrix of size n.
    pub(crate) fn new(n: usize) -> Self {
        Symmetric { diagonal: vec![0.0; n], entries: Vec::new() }
    }

    /// Adds to a diagonal entry.
    pub(crate) fn add_diagonal(&mut self, i: usize, value: f64) {
        self.diagonal[i] += value;
    }

    /// Adds to the entries (i, j) and (j, i), i != j.
    pub(crate) fn add(&mut self, i: usize, j: usize, value: f64) {
        self.entries.push((i.min(j) as u32, i.max(j) as u32, value));
    }
}

/// The factor of a symmetric positive definite matrix.
#[derive(Debug, Clone)]
pub(crate) struct Cholesky {
    /// Old index by new.
    order: Vec<u32>,
    /// Start of each column of L in `rows` and `values`; L has a unit diagonal.
    start: Vec<usize>,
    rows: Vec<u32>,
    values: Vec<f64>,
    pivots: Vec<f64>,
}

impl Cholesky {
    /// Factors the matrix; `None` where a pivot is not positive.
    pub(crate) fn new(matrix: &Symmetric) -> Option<Self> {
        let n = matrix.diagonal.len();
        let mut entries = matrix.entries.clone();
        entries.sort_unstable_by_key(|e| (e.0, e.1));
        let graph = Graph::new(n, &entries);
        let order = reverse_cuthill_mckee(&graph);
        let mut place = vec![0u32; n];
        order.iter().enumerate().for_each(|(new, &old)| place[old as usize] = new as u32);
        // Rows of the strict lower triangle in the new order.
        let mut lower: Vec<(u32, u32, f64)> = entries
            .iter()
            .map(|&(i, j, v)| {
                let (p, q) = (place[i as usize], place[j as usize]);
                (p.max(q), p.min(q), v)
            })
            .collect();
        lower.sort_by_key(|e| (e.0, e.1));
        let first: Vec<usize> = (0..=n).map(|row| lower.partition_point(|e| (e.0 as usize) < row)).collect();
        let row = |k: usize| &lower[first[k]..first[k + 1]];

        // Elimination tree and the length of each column.
        let mut parent = vec![NONE; n];
        let mut mark = vec![NONE; n];
        let mut count = vec![0usize; n];
        for k in 0..n {
            mark[k] = k as u32;
            for &(_, j, _) in row(k) {
                let mut i = j as usize;
                while mark[i] != k as u32 {
                    if parent[i] == NONE {
                        parent[i] = k as u32;
                    }
                    count[i] += 1;
                    mark[i] = k as u32;
                    i = parent[i] as usize;
                }
            }
        }
        let mut start = vec![0; n + 1];
        (0..n).for_each(|i| start[i + 1] = start[i] + count[i]);
        let mut own =
            Cholesky { rows: vec![0; start[n]], values: vec![0.0; start[n]], pivots: vec![0.0; n], order, start };
        let mut filled: Vec<usize> = own.start[..n].to_vec();
        let mut work = vec![0.0; n];
        let mut pattern = vec![0u32; n];
        let mut path = Vec::new();
        mark.fill(NONE);
        for k in 0..n {
            // The pattern of row k in topological order: it ends up in pattern[top..].
            let mut top = n;
            mark[k] = k as u32;
            for &(_, j, v) in row(k) {
                work[j as usize] += v;
                let mut i = j as usize;
                while mark[i] != k as u32 {
                    path.push(i as u32);
                    mark[i] = k as u32;
                    i = parent[i] as usize;
                }
                while let Some(i) = path.pop() {
                    top -= 1;
                    pattern[top] = i;
                }
            }
            let mut pivot = matrix.diagonal[own.order[k] as usize];
            for &i in &pattern[top..] {
                let i = i as usize;
                let value = std::mem::take(&mut work[i]);
                for p in own.start[i]..filled[i] {
                    work[own.rows[p] as usize] -= own.values[p] * value;
                }
                let entry = value / own.pivots[i];
                pivot -= entry * value;
                own.rows[filled[i]] = k as u32;
                own.values[filled[i]] = entry;
                filled[i] += 1;
            }
            if !(pivot > 0.0 && pivot.is_finite()) {
                return None;
            }
            own.pivots[k] = pivot;
        }
        Some(own)
    }

    /// Solves for two right-hand sides at once, in place.
    pub(crate) fn solve(&self, b: &mut [DVec2]) {
        let n = self.order.len();
        let mut x: Vec<DVec2> = self.order.iter().map(|&old| b[old as usize]).collect();
        for i in 0..n {
            let value = x[i];
            for p in self.start[i]..self.start[i + 1] {
                x[self.rows[p] as usize] -= self.values[p] * value;
            }
        }
        for i in (0..n).rev() {
            let mut value = x[i] / self.pivots[i];
            for p in self.start[i]..self.start[i + 1] {
                value -= self.values[p] * x[self.rows[p] as usize];
            }
            x[i] = value;
        }
        for (&old, value) in self.order.iter().zip(x) {
            b[old as usize] = value;
        }
    }
}

/// Neighbours of each row.
struct Graph {
    start: Vec<usize>,
    to: Vec<u32>,
}

impl Graph {
    fn new(n: usize, entries: &[(u32, u32, f64)]) -> Self {
        let mut pairs: Vec<(u32, u32)> = entries.iter().flat_map(|&(i, j, _)| [(i, j), (j, i)]).collect();
        pairs.sort_unstable();
        pairs.dedup();
        let mut start = vec![0; n + 1];
        pairs.iter().for_each(|p| start[p.0 as usize + 1] += 1);
        (0..n).for_each(|i| start[i + 1] += start[i]);
        Graph { start, to: pairs.into_iter().map(|p| p.1).collect() }
    }

    fn of(&self, i: u32) -> &[u32] {
        &self.to[self.start[i as usize]..self.start[i as usize + 1]]
    }
}

/// Old index by new: breadth first from an end of each component, few neighbours first, and all of it backwards.
fn reverse_cuthill_mckee(graph: &Graph) -> Vec<u32> {
    let n = graph.start.len() - 1;
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

    /// The Laplacian of a random graph with something on the diagonal, and the same as a full matrix.
    fn random(n: usize, edges: usize, rng: &mut Rng) -> (Symmetric, Vec<Vec<f64>>) {
        let mut matrix = Symmetric::new(n);
        let mut full = vec![vec![0.0; n]; n];
        for (i, row) in full.iter_mut().enumerate() {
            let value = 0.01 + rng.unit();
            matrix.add_diagonal(i, value);
            row[i] += value;
        }
        for _ in 0..edges {
            let (i, j) = (rng.next() as usize % n, rng.next() as usize % n);
            let w = rng.unit();
            if i != j {
                matrix.add(i, j, -w);
                matrix.add_diagonal(i, w);
                matrix.add_diagonal(j, w);
                full[i][j] -= w;
                full[j][i] -= w;
                full[i][i] += w;
                full[j][j] += w;
            }
        }
        (matrix, full)
    }

    #[test]
    fn the_solution_solves_the_system() {
        let mut rng = Rng(3);
        for n in [1, 2, 7, 40, 150] {
            let (matrix, full) = random(n, 3 * n, &mut rng);
            let expected: Vec<DVec2> = (0..n).map(|_| rng.point(10.0)).collect();
            let times = |row: &Vec<f64>| row.iter().zip(&expected).map(|(a, x)| *a * *x).sum::<DVec2>();
            let mut b: Vec<DVec2> = full.iter().map(times).collect();
            Cholesky::new(&matrix).expect("positive definite").solve(&mut b);
            let worst = b.iter().zip(&expected).map(|(x, y)| x.distance(*y)).fold(0.0, f64::max);
            assert!(worst < 1e-9, "{n}: {worst}");
        }
    }

    #[test]
    fn a_matrix_that_is_not_positive_definite_is_refused() {
        let mut matrix = Symmetric::new(2);
        matrix.add_diagonal(0, 1.0);
        matrix.add_diagonal(1, 1.0);
        matrix.add(0, 1, -2.0);
        assert!(Cholesky::new(&matrix).is_none());
        assert!(Cholesky::new(&Symmetric::new(3)).is_none());
    }
}
