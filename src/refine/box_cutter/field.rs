//! Importance along cuts (Box Cutter, section 3.2.2, "Biasing Cut Locations").

use glam::DVec2;

use super::outline::Line;
use crate::atlas::bvh::Bounds;
use crate::atlas::{Atlas, Charts, FaceId};

/// Cells along the longest side of a chart.
const CELLS: f64 = 384.0;

/// The importance of each chart's points, on a grid in chart coordinates.
#[derive(Debug, Clone)]
pub(crate) struct Field {
    charts: Vec<Grid>,
}

#[derive(Debug, Clone)]
struct Grid {
    corner: DVec2,
    cell: f64,
    width: usize,
    values: Vec<f32>,
}

impl Field {
    /// Samples the weights, given at the corners of each face; the mean of an edge's two ends is that of the straight line between them.
    pub fn new(atlas: &Atlas, charts: &Charts, weights: &[[f64; 3]]) -> Self {
        let grid = |faces: &Vec<FaceId>| {
            let bounds = Bounds::around(faces.iter().flat_map(|f| atlas.uv_triangle(*f)));
            let (low, extent) = (bounds.min, bounds.max - bounds.min);
            let cell = (extent.max_element() / CELLS).max(1e-12);
            let size = (extent / cell).floor() + DVec2::ONE;
            let (width, height) = (size.x as usize, size.y as usize);
            let mut grid = Grid { corner: low, cell, width, values: vec![1.0; width * height] };
            for face in faces {
                grid.paint(atlas.uv_triangle(*face), weights[face.index()]);
            }
            grid
        };
        Field { charts: charts.faces.iter().map(grid).collect() }
    }

    /// Length of the part of a line, each piece times its importance.
    pub fn length(&self, chart: u32, line: &Line, from: f64, to: f64) -> f64 {
        let grid = &self.charts[chart as usize];
        let steps = ((to - from) / grid.cell).ceil().max(1.0) as usize;
        let mean =
            (0..steps).map(|k| grid.at(line.at(from + (to - from) * (k as f64 + 0.5) / steps as f64))).sum::<f64>()
                / steps as f64;
        mean * (to - from)
    }
}

impl Grid {
    fn at(&self, p: DVec2) -> f64 {
        let c = ((p - self.corner) / self.cell).floor();
        let height = self.values.len() / self.width;
        let x = c.x.clamp(0.0, self.width as f64 - 1.0) as usize;
        let y = c.y.clamp(0.0, height as f64 - 1.0) as usize;
        f64::from(self.values[y * self.width + x])
    }

    /// Sets the cells whose middle the triangle covers, and those of its corners.
    fn paint(&mut self, t: [DVec2; 3], w: [f64; 3]) {
        let t = t.map(|p| (p - self.corner) / self.cell);
        let area = (t[1] - t[0]).perp_dot(t[2] - t[0]);
        let height = self.values.len() / self.width;
        let low = t[0].min(t[1]).min(t[2]).floor().max(DVec2::ZERO);
        let high = t[0].max(t[1]).max(t[2]).floor();
        for k in 0..3 {
            let (x, y) = (t[k].x.floor().max(0.0) as usize, t[k].y.floor().max(0.0) as usize);
            if x < self.width && y < height {
                self.values[y * self.width + x] = w[k] as f32;
            }
        }
        if area == 0.0 || !area.is_finite() {
            return;
        }
        for y in low.y as usize..=(high.y as usize).min(height - 1) {
            for x in low.x as usize..=(high.x as usize).min(self.width - 1) {
                let p = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
                let b = [0, 1, 2].map(|k| (t[(k + 1) % 3] - p).perp_dot(t[(k + 2) % 3] - p) / area);
                if b.iter().all(|b| *b >= -1e-9) {
                    self.values[y * self.width + x] = (0..3).map(|k| b[k] * w[k]).sum::<f64>() as f32;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::testing::sheet;
    use crate::atlas::{Charts, Topology};

    #[test]
    fn a_weighted_length_is_the_integral() {
        let atlas = sheet(10, 10, DVec2::new(3.0, 5.0));
        let charts = Charts::new(&Topology::new(&atlas));
        // The weight grows from 1 at the left to 11 at the right.
        let weights: Vec<[f64; 3]> = atlas.faces().map(|f| atlas.uv_triangle(f).map(|p| 1.0 + p.x - 3.0)).collect();
        let field = Field::new(&atlas, &charts, &weights);
        let across = Line { point: DVec2::new(3.0, 9.3), along: DVec2::X };
        assert!((field.length(0, &across, 0.0, 10.0) - 60.0).abs() < 0.2);
        let down = Line { point: DVec2::new(12.0, 5.0), along: DVec2::Y };
        assert!((field.length(0, &down, 2.0, 7.0) - 50.0).abs() < 0.5);
    }
}
