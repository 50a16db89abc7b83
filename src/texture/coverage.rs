//! Coverage: which face owns which texel of a page. Those whose centre it covers, then, dilated, the ring that filtering reads around it.

use glam::DVec2;

use super::texel_map::TexelMaps;
use crate::atlas::{Atlas, FaceId, HalfEdge, Topology};
use crate::context::Context;
use crate::error::Result;

/// No face.
pub(crate) const NO_FACE: u32 = u32::MAX;
/// Faces and edges between two looks at the context.
const LOOK_EVERY: usize = 1024;

/// What is rasterised on one page.
pub(crate) struct PageRaster {
    pub(crate) width: u32,
    pub(crate) height: u32,
    /// Faces in order, with the rows whose centres they may cover.
    faces: Vec<(u32, [u32; 2])>,
    /// Silhouette edges in the order of their faces, with the rows that their ring may reach.
    edges: Vec<Edge>,
    bleed: f64,
}

struct Edge {
    ends: [DVec2; 2],
    face: u32,
    rows: [u32; 2],
}

/// The owners of a band of rows.
#[derive(Default)]
pub(crate) struct Coverage {
    /// Owning face by texel, or [`NO_FACE`].
    pub(crate) owner: Vec<u32>,
    /// 0 where the face covers the texel's centre; above it is ring.
    pub(crate) distance: Vec<f32>,
}

impl PageRaster {
    /// The faces of `page` that have a map, and the edges where their charts end: borders, and folds.
    pub(crate) fn new(
        atlas: &Atlas,
        topology: &Topology,
        maps: &TexelMaps,
        page: u16,
        size: [u32; 2],
        bleed: u32,
    ) -> Self {
        // The bilinear footprint is always part of the ring.
        let bleed = f64::from(bleed).max(1.5);
        let mut faces = Vec::new();
        let mut edges = Vec::new();
        let here = |f: usize| atlas.page[f] == page && maps.of_face[f] != TexelMaps::NONE;
        // On which side of its edge `k` a face lies: turning senses say nothing where faces are wound inconsistently.
        let side = |f: usize, k: usize, [a, b]: [DVec2; 2]| {
            let area = (b - a).perp_dot(maps.corners[f][(k + 2) % 3] - a);
            if area == 0.0 { 0.0 } else { area.signum() }
        };
        for f in (0..atlas.face_count()).filter(|f| here(*f)) {
            let [a, b, c] = maps.corners[f];
            let low = a.y.min(b.y).min(c.y);
            let high = a.y.max(b.y).max(c.y);
            faces.push((f as u32, centres_within(low, high, size[1])));
            for k in 0..3 {
                let ends = [maps.corners[f][k], maps.corners[f][(k + 1) % 3]];
                let inside = topology.uv_twin(HalfEdge::of(FaceId::new(f), k)).is_some_and(|twin| {
                    let other = twin.face().index();
                    here(other) && side(f, k, ends) * side(other, twin.corner(), ends) < 0.0
                });
                if !inside {
                    let (low, high) = (ends[0].y.min(ends[1].y), ends[0].y.max(ends[1].y));
                    let rows = centres_within(low - bleed, high + bleed, size[1]);
                    edges.push(Edge { ends, face: f as u32, rows });
                }
            }
        }
        PageRaster { width: size[0], height: size[1], faces, edges, bleed }
    }

    /// Makes `coverage` the owners of the rows `top..top + count`.
    pub(crate) fn rows(
        &self,
        top: u32,
        count: u32,
        context: &Context,
        maps: &TexelMaps,
        coverage: &mut Coverage,
    ) -> Result<()> {
        let bottom = (top + count).min(self.height);
        let width = self.width as usize;
        let texels = width * (bottom - top) as usize;
        coverage.owner.clear();
        coverage.owner.resize(texels, NO_FACE);
        coverage.distance.clear();
        coverage.distance.resize(texels, f32::INFINITY);
        let mut free = vec![width; (bottom - top) as usize];
        for (i, (face, rows)) in self.faces.iter().enumerate() {
            if i % LOOK_EVERY == 0 {
                context.check()?;
            }
            for y in rows[0].max(top)..rows[1].min(bottom) {
                let row = (y - top) as usize;
                if free[row] > 0 {
                    let line = row * width..(row + 1) * width;
                    let owner = &mut coverage.owner[line.clone()];
                    free[row] -=
                        rasterize_row(&maps.corners[*face as usize], *face, y, owner, &mut coverage.distance[line]);
                }
            }
        }
        for (i, edge) in self.edges.iter().enumerate() {
            if i % LOOK_EVERY == 0 {
                context.check()?;
            }
            for y in edge.rows[0].max(top)..edge.rows[1].min(bottom) {
                let row = (y - top) as usize;
                if free[row] > 0 {
                    let line = row * width..(row + 1) * width;
                    let owner = &mut coverage.owner[line.clone()];
                    self.ring_row(edge, y, owner, &mut coverage.distance[line]);
                }
            }
        }
        Ok(())
    }

    /// One row of the ring about an edge: the nearest face wins, the lowest of equals; but first of all those whose
    /// bilinear footprint reads the texel.
    fn ring_row(&self, edge: &Edge, y: u32, owner: &mut [u32], distance: &mut [f32]) {
        let centre = f64::from(y) + 0.5;
        let [a, b] = edge.ends;
        let d = b - a;
        // The part of the edge that is near this row bounds the columns.
        let (mut from, mut to) = (0.0f64, 1.0f64);
        if d.y != 0.0 {
            let (s, t) = ((centre - self.bleed - a.y) / d.y, (centre + self.bleed - a.y) / d.y);
            (from, to) = (from.max(s.min(t)), to.min(s.max(t)));
            if from > to {
                return;
            }
        }
        let (s, t) = (a.x + from * d.x, a.x + to * d.x);
        let [low, high] = centres_within(s.min(t) - self.bleed, s.max(t) + self.bleed, self.width);
        let inverse = if d.length_squared() > 0.0 { d.length_squared().recip() } else { 0.0 };
        for x in low as usize..high as usize {
            if distance[x] == 0.0 {
                continue;
            }
            let p = DVec2::new(x as f64 + 0.5, centre);
            let t = ((p - a).dot(d) * inverse).clamp(0.0, 1.0);
            let squared = (p - (a + d * t)).length_squared();
            if squared > self.bleed * self.bleed {
                continue;
            }
            // Footprint texels rank before all others: their distances stay under the others' by the offset.
            let footprint = squared < 2.0 && meets_square(a - p, d);
            let near = squared.sqrt() as f32;
            let key = if footprint { near.max(f32::MIN_POSITIVE) } else { near + 2.0 };
            if key < distance[x] || (key == distance[x] && edge.face < owner[x]) {
                distance[x] = key;
                owner[x] = edge.face;
            }
        }
    }
}

/// The texels whose centres lie in `low..high`, within `0..size`.
fn centres_within(low: f64, high: f64, size: u32) -> [u32; 2] {
    let clamp = |v: f64| (v - 0.5).ceil().clamp(0.0, f64::from(size)) as u32;
    let first = clamp(low);
    [first, clamp(high + 1e-9).max(first)]
}

/// Covers the free texels of row `y` whose centres a face covers; returns how many.
///
/// Crossings are computed from the lower to the upper end of an edge, so that both its faces find the same ones; a centre on
/// an edge belongs to the face on its right (below, for a level one): the top-left rule.
fn rasterize_row(corners: &[DVec2; 3], face: u32, y: u32, owner: &mut [u32], distance: &mut [f32]) -> usize {
    let centre = f64::from(y) + 0.5;
    let (mut left, mut right) = (f64::INFINITY, f64::NEG_INFINITY);
    for k in 0..3 {
        let (mut a, mut b) = (corners[k], corners[(k + 1) % 3]);
        if a.y > b.y {
            (a, b) = (b, a);
        }
        if a.y <= centre && centre < b.y {
            let x = a.x + (centre - a.y) * ((b.x - a.x) / (b.y - a.y));
            left = left.min(x);
            right = right.max(x);
        }
    }
    if left >= right {
        return 0;
    }
    let column = |x: f64| (x - 0.5).ceil().clamp(0.0, owner.len() as f64) as usize;
    let (from, to) = (column(left), column(right));
    if from >= to {
        return 0;
    }
    if owner[from..to].iter().fold(true, |free, owner| free & (*owner == NO_FACE)) {
        owner[from..to].fill(face);
        distance[from..to].fill(0.0);
        return to - from;
    }
    let mut covered = 0;
    for x in from..to {
        if owner[x] == NO_FACE {
            owner[x] = face;
            distance[x] = 0.0;
            covered += 1;
        }
    }
    covered
}

/// Whether the segment from `a` along `d` meets the open square of half-width 1 about the origin: whether bilinear
/// filtering of some point on it reads the texel there.
fn meets_square(a: DVec2, d: DVec2) -> bool {
    let (mut from, mut to) = (0.0f64, 1.0f64);
    for (start, step) in [(a.x, d.x), (a.y, d.y)] {
        if step == 0.0 {
            if start.abs() >= 1.0 {
                return false;
            }
            continue;
        }
        let (s, t) = ((-1.0 - start) / step, (1.0 - start) / step);
        from = from.max(s.min(t));
        to = to.min(s.max(t));
    }
    let middle = a + d * (0.5 * (from + to));
    from <= to && middle.abs().max_element() < 1.0
}
