//! The last step of resampling at about the same density: what a renderer shows is not the texels but their bilinear
//! interpolation, so the texels are moved towards the least-squares fit of that to the uploaded image's.
//!
//! The fit is the projection onto bilinear elements. Its mass matrix is never formed: relaxed Jacobi steps on the normal
//! equations, with four points in each covered texel, give each texel the mean of the differences in its reach, weighted
//! as bilinear filtering weights the texel there.

/// Steps, each of which reads two texels further.
pub(crate) const STEPS: usize = 2;
/// Rows beyond a band on which its own texels depend.
pub(crate) const HALO: u32 = 2 * STEPS as u32;
/// Relaxation: under 2, the fit cannot diverge, for the weights of a row sum to 1 at most.
const RELAXATION: f32 = 1.5;

/// Where the four quadrature points of a texel lie, from its centre, in texels.
pub(crate) const QUADRATURE: [[f64; 2]; 4] = [[-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]];

/// The fit of a band of rows.
pub(crate) struct BilinearFit<const C: usize> {
    /// Texels of a row.
    pub(crate) width: usize,
    /// Values, row by row.
    pub(crate) values: Vec<[f32; C]>,
    /// Whether a texel may change.
    pub(crate) free: Vec<bool>,
    /// By texel, where its points are on the surface: an index into `targets`; else `u32::MAX`.
    pub(crate) target_of: Vec<u32>,
    /// What is to be shown at the four points of a texel.
    pub(crate) targets: Vec<[[f32; C]; 4]>,
}

impl<const C: usize> BilinearFit<C> {
    /// `texels` texels in rows of `width`, none of them free.
    pub(crate) fn new(width: usize, texels: usize) -> Self {
        BilinearFit {
            width,
            values: vec![[0.0; C]; texels],
            free: vec![false; texels],
            target_of: vec![u32::MAX; texels],
            targets: Vec::new(),
        }
    }

    /// Moves the free texels towards the fit.
    pub(crate) fn solve(&mut self) {
        let runs = self.runs();
        let mut differences = vec![[[0.0; C]; 4]; self.targets.len()];
        let mut relaxed: Vec<[f32; C]> = Vec::with_capacity(runs.iter().map(ExactSizeIterator::len).sum());
        for _ in 0..STEPS {
            for i in runs.iter().cloned().flatten() {
                let target = self.target_of[i] as usize;
                let Some(points) = self.targets.get(target) else { continue };
                let neighbours = self.neighbours(i);
                for (k, point) in points.iter().enumerate() {
                    let shown = self.shown(i, neighbours[k]);
                    for c in 0..C {
                        differences[target][k][c] = point[c] - shown[c];
                    }
                }
            }
            relaxed.extend(runs.iter().cloned().flatten().map(|i| self.relaxed(i, &differences)));
            for (i, value) in runs.iter().cloned().flatten().zip(relaxed.drain(..)) {
                self.values[i] = value;
            }
        }
    }

    /// The free texels, in runs of a row.
    fn runs(&self) -> Vec<std::ops::Range<usize>> {
        let mut runs = Vec::new();
        for (y, row) in self.free.chunks(self.width).enumerate() {
            let mut x = 0;
            for run in row.chunk_by(|a, b| a == b) {
                let start = y * self.width + x;
                x += run.len();
                if run[0] {
                    runs.push(start..start + run.len());
                }
            }
        }
        runs
    }

    /// The texels next to `i` in the direction of each point: across, down, and both; edges repeat.
    #[inline]
    fn neighbours(&self, i: usize) -> [[usize; 3]; 4] {
        let x = i % self.width;
        let left = if x > 0 { i - 1 } else { i };
        let right = if x + 1 < self.width { i + 1 } else { i };
        let up = if i >= self.width { self.width } else { 0 };
        let down = if i + self.width < self.values.len() { self.width } else { 0 };
        [
            [left, i - up, left - up],
            [right, i - up, right - up],
            [left, i + down, left + down],
            [right, i + down, right + down],
        ]
    }

    /// What bilinear filtering shows at a point of texel `i`.
    #[inline]
    fn shown(&self, i: usize, [across, down, both]: [usize; 3]) -> [f32; C] {
        let (v, a, d, b) = (&self.values[i], &self.values[across], &self.values[down], &self.values[both]);
        let mut shown = [0.0; C];
        for c in 0..C {
            shown[c] = 0.5625 * v[c] + 0.1875 * (a[c] + d[c]) + 0.0625 * b[c];
        }
        shown
    }

    #[inline]
    fn relaxed(&self, i: usize, differences: &[[[f32; C]; 4]]) -> [f32; C] {
        let mut sum = [0.0; C];
        let mut total = 0.0;
        let mut add = |texel: usize, k: usize, weight: f32| {
            if let Some(points) = differences.get(self.target_of[texel] as usize) {
                (0..C).for_each(|c| sum[c] += weight * points[k][c]);
                total += weight;
            }
        };
        let neighbours = self.neighbours(i);
        for (k, [across, down, both]) in neighbours.into_iter().enumerate() {
            // In the quarter towards the texel's neighbours: its own point, and theirs on this side.
            add(i, k, 0.5625);
            if across != i {
                add(across, k ^ 1, 0.1875);
            }
            if down != i {
                add(down, k ^ 2, 0.1875);
            }
            if across != i && down != i {
                add(both, k ^ 3, 0.0625);
            }
        }
        let mut value = self.values[i];
        if total > 0.0 {
            let (mut low, mut high) = (value, value);
            for near in neighbours.into_iter().flatten() {
                let near = &self.values[near];
                (0..C).for_each(|c| (low[c], high[c]) = (low[c].min(near[c]), high[c].max(near[c])));
            }
            // Masks do not ring: no texel leaves the range of those about it.
            (0..C).for_each(|c| value[c] = (value[c] + RELAXATION * sum[c] / total).clamp(low[c], high[c]));
        }
        value
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Texels 0..n of one row of some rows, all free, with targets from `shown` at the points.
    fn field(width: usize, rows: usize, start: f32, shown: impl Fn(f64, f64) -> f32) -> BilinearFit<1> {
        let n = width * rows;
        let targets = (0..n)
            .map(|i| QUADRATURE.map(|[dx, dy]| [shown((i % width) as f64 + 0.5 + dx, (i / width) as f64 + 0.5 + dy)]))
            .collect();
        BilinearFit {
            width,
            values: vec![[start]; n],
            free: vec![true; n],
            target_of: (0..n as u32).collect(),
            targets,
        }
    }

    #[test]
    fn what_is_shown_already_stays() {
        let mut f = field(9, 7, 0.4, |_, _| 0.4);
        f.solve();
        assert!(f.values.iter().all(|v| (v[0] - 0.4).abs() < 1e-6));
    }

    #[test]
    fn each_step_comes_closer_to_what_is_to_be_shown_and_texels_that_are_not_free_stay() {
        let shown = |x: f64, y: f64| (0.5 + 0.3 * (x * 0.9).sin() * (y * 0.7).cos()) as f32;
        let mut f = field(24, 16, 0.0, shown);
        for (i, v) in f.values.iter_mut().enumerate() {
            v[0] = shown((i % 24) as f64 + 0.5, (i / 24) as f64 + 0.5);
        }
        f.free[30] = false;
        let error = |f: &BilinearFit<1>| -> f64 {
            let all = (0..f.values.len()).flat_map(|i| (0..4).map(move |k| (i, k)));
            all.map(|(i, k)| f64::from(f.targets[i][k][0] - f.shown(i, f.neighbours(i)[k])[0]).powi(2)).sum()
        };
        let (before, kept) = (error(&f), f.values[30]);
        f.solve();
        assert!(error(&f) < 0.5 * before, "{} of {before}", error(&f));
        assert_eq!(f.values[30], kept);
    }

    #[test]
    fn a_step_does_not_ring() {
        let edge = |x: f64| if x < 6.3 { 0.2 } else { 0.7 };
        let mut f = field(12, 5, 0.0, |x, _| edge(x));
        f.values.iter_mut().enumerate().for_each(|(i, v)| v[0] = edge((i % 12) as f64 + 0.5));
        f.solve();
        assert!(f.values.iter().all(|v| (0.2..=0.7).contains(&v[0])), "{:?}", &f.values[..12]);
    }
}
