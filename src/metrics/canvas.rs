//! What a picture is drawn on: for each sample the chart on top, how many triangles cover it, and ink.

use glam::DVec2;

/// Samples, row by row.
pub(super) struct Canvas {
    width: usize,
    height: usize,
    label: Vec<u32>,
    layers: Vec<u8>,
    ink: Vec<u8>,
}

impl Canvas {
    pub(super) fn new(width: usize, height: usize) -> Self {
        let n = width * height;
        Canvas { width, height, label: vec![u32::MAX; n], layers: vec![0; n], ink: vec![0; n] }
    }

    /// Label (`u32::MAX`: none), number of triangles, and ink.
    pub(super) fn sample(&self, x: usize, y: usize) -> (u32, u8, u8) {
        let i = y * self.width + x;
        (self.label[i], self.layers[i], self.ink[i])
    }

    /// The label of a pixel of `side` x `side` samples, where all have the same, one triangle each and no ink.
    pub(super) fn plain(&self, x: usize, y: usize, side: usize) -> Option<u32> {
        let first = y * side * self.width + x * side;
        let label = self.label[first];
        (0..side)
            .flat_map(|row| (0..side).map(move |column| first + row * self.width + column))
            .all(|i| self.label[i] == label && self.layers[i] == 1 && self.ink[i] == 0)
            .then_some(label)
    }

    /// Covers the samples in a triangle; of two triangles that share an edge only one gets a sample on it.
    pub(super) fn triangle(&mut self, t: [DVec2; 3], label: u32) {
        let mut t = t;
        t.sort_by(|a, b| a.y.total_cmp(&b.y).then(a.x.total_cmp(&b.x)));
        let index = |v: f64, end: usize| (v - 0.5).ceil().clamp(0.0, end as f64) as usize;
        // Ends are ordered by height, so that both triangles of an edge compute the same crossing.
        let at = |p: DVec2, q: DVec2, y: f64| p.x + (q.x - p.x) * ((y - p.y) / (q.y - p.y));
        for y in index(t[0].y, self.height)..index(t[2].y, self.height) {
            let middle = y as f64 + 0.5;
            let long = at(t[0], t[2], middle);
            let short = if middle < t[1].y { at(t[0], t[1], middle) } else { at(t[1], t[2], middle) };
            let (x0, x1) = (index(long.min(short), self.width), index(long.max(short), self.width));
            if x0 < x1 {
                let row = y * self.width;
                self.label[row + x0..row + x1].fill(label);
                for layers in &mut self.layers[row + x0..row + x1] {
                    *layers = layers.saturating_add(1);
                }
            }
        }
    }

    /// Draws a line `thickness` samples wide; the darkest ink stays.
    pub(super) fn line(&mut self, p: DVec2, q: DVec2, thickness: usize, ink: u8) {
        let Some((p, q)) = self.clip(p, q) else { return };
        let steps = (q - p).abs().max_element().ceil().max(1.0);
        let step = (q - p) / steps;
        let shift = (thickness as f64 - 1.0) * 0.5;
        for i in 0..=steps as usize {
            let at = p + step * i as f64 - shift;
            let (x, y) = (at.x.floor() as i64, at.y.floor() as i64);
            for v in y.max(0)..(y + thickness as i64).min(self.height as i64) {
                for u in x.max(0)..(x + thickness as i64).min(self.width as i64) {
                    let own = &mut self.ink[v as usize * self.width + u as usize];
                    *own = (*own).max(ink);
                }
            }
        }
    }

    /// The part of a segment on the canvas (Liang and Barsky 1984).
    fn clip(&self, p: DVec2, q: DVec2) -> Option<(DVec2, DVec2)> {
        let d = q - p;
        let (mut t0, mut t1) = (0.0f64, 1.0f64);
        for (start, along, end) in [(p.x, d.x, self.width as f64), (p.y, d.y, self.height as f64)] {
            if along == 0.0 {
                if start < 0.0 || start > end {
                    return None;
                }
                continue;
            }
            let (a, b) = (-start / along, (end - start) / along);
            t0 = t0.max(a.min(b));
            t1 = t1.min(a.max(b));
        }
        (t0 <= t1).then(|| (p + d * t0, p + d * t1))
    }
}
