//! Triangles to rows of texels, in bands that can be worked on in parallel and in bounded memory.

use std::ops::Range;

use glam::DVec2;
use rayon::prelude::*;

use crate::atlas::{Atlas, FaceId};

/// Rows of one band, without margins, and rows by row of margin: what is kept of them stays in a core's cache, and margins are few.
const ROWS: i64 = 128;
const ROWS_BY_MARGIN: i64 = 8;
/// Rows of triangles that one sheet may cost; beyond, figures are not defined rather than late.
const BUDGET: f64 = 2e9;

/// The triangles of one page, by band of a raster of a given size.
pub(super) struct Bands<'a> {
    atlas: &'a Atlas,
    scale: DVec2,
    bands: Vec<(Range<i64>, Vec<FaceId>)>,
}

/// One band.
pub(super) struct Band<'a> {
    atlas: &'a Atlas,
    scale: DVec2,
    /// Rows, the margins included.
    pub rows: Range<i64>,
    /// The triangles that may touch the rows.
    pub faces: &'a [FaceId],
}

impl<'a> Bands<'a> {
    /// The page drawn at `size` texels; every band overlaps its neighbours by `margin` rows. `None`
    /// where the triangles have too many rows.
    pub(super) fn new(atlas: &'a Atlas, page: usize, size: [u32; 2], margin: i64) -> Option<Self> {
        let sheet = atlas.sheets.get(page).copied().unwrap_or(size);
        let scale = DVec2::new(f64::from(size[0]), f64::from(size[1]))
            / DVec2::new(f64::from(sheet[0].max(1)), f64::from(sheet[1].max(1)));
        let height = i64::from(size[1]);
        let own = ROWS.max(ROWS_BY_MARGIN * margin);
        let count = (height + own - 1) / own;
        let rows = |i: i64| (i * own - margin).max(0)..((i + 1) * own + margin).min(height);
        let mut bands: Vec<(Range<i64>, Vec<FaceId>)> = (0..count).map(|i| (rows(i), Vec::new())).collect();
        let mut cost = 0.0;
        for f in atlas.faces().filter(|f| usize::from(atlas.page[f.index()]) == page) {
            let ys = atlas.uv_triangle(f).map(|c| c.y * scale.y);
            let (low, high) = (ys[0].min(ys[1]).min(ys[2]), ys[0].max(ys[1]).max(ys[2]));
            if !(low < height as f64 && high > 0.0) {
                continue;
            }
            let (low, high) = (low.max(0.0), high.min(height as f64));
            cost += high - low + 1.0;
            let first = ((low as i64 - margin) / own).max(0);
            let last = ((high as i64 + margin) / own).min(count - 1);
            for i in first..=last {
                bands[i as usize].1.push(f);
            }
        }
        (cost <= BUDGET).then_some(Bands { atlas, scale, bands })
    }

    pub(super) fn par_iter(&self) -> impl IndexedParallelIterator<Item = Band<'_>> {
        self.bands.par_iter().map(|(rows, faces)| Band {
            atlas: self.atlas,
            scale: self.scale,
            rows: rows.clone(),
            faces,
        })
    }
}

impl Band<'_> {
    /// Number of rows.
    pub(super) fn height(&self) -> usize {
        (self.rows.end - self.rows.start).max(0) as usize
    }

    /// The triangle of a face, in texels of the raster.
    pub(super) fn triangle(&self, face: FaceId) -> [DVec2; 3] {
        self.atlas.uv_triangle(face).map(|c| c * self.scale)
    }

    pub(super) fn triangles(&self) -> impl Iterator<Item = [DVec2; 3]> + '_ {
        self.faces.iter().map(|&f| self.triangle(f))
    }
}

/// Calls `row(y, x0, x1)` for each row in which the triangle covers the centres of texels `x0..x1`, edges included.
pub(super) fn centre_spans(t: &[DVec2; 3], rows: &Range<i64>, width: u32, mut row: impl FnMut(i64, i64, i64)) {
    let low = t[0].y.min(t[1].y).min(t[2].y);
    let high = t[0].y.max(t[1].y).max(t[2].y);
    let first = ((low - 0.5).ceil() as i64).max(rows.start);
    let last = ((high - 0.5).floor() as i64).min(rows.end - 1);
    for y in first..=last {
        let middle = y as f64 + 0.5;
        if let Some((x0, x1)) = slab(t, middle, middle) {
            let (x0, x1) = (((x0 - 0.5).ceil() as i64).max(0), ((x1 - 0.5).floor() as i64 + 1).min(i64::from(width)));
            if x0 < x1 {
                row(y, x0, x1);
            }
        }
    }
}

/// Part of a texel by which a triangle must enter it to count as touching it: what float32 UVs on a sheet of 8192 leave uncertain.
pub(super) const TOUCH: f64 = 1e-3;

/// Calls `row(y, x0, x1)` for each row in which the triangle touches the texels `x0..x1`: enters them by more than `touch`.
pub(super) fn touched_spans(
    t: &[DVec2; 3],
    touch: f64,
    rows: &Range<i64>,
    width: u32,
    mut row: impl FnMut(i64, i64, i64),
) {
    let low = t[0].y.min(t[1].y).min(t[2].y);
    let high = t[0].y.max(t[1].y).max(t[2].y);
    let first = ((low + touch).floor() as i64).max(rows.start);
    let last = ((high - touch).ceil() as i64 - 1).min(rows.end - 1);
    for y in first..=last {
        if let Some((x0, x1)) = slab(t, y as f64 + touch, (y + 1) as f64 - touch) {
            let x0 = ((x0 + touch).floor() as i64).max(0);
            let x1 = ((x1 - touch).ceil() as i64).min(i64::from(width));
            if x0 < x1 {
                row(y, x0, x1);
            }
        }
    }
}

/// The x range of the part of a triangle between two heights; `None` where there is none.
fn slab(t: &[DVec2; 3], low: f64, high: f64) -> Option<(f64, f64)> {
    let (mut x0, mut x1) = (f64::INFINITY, f64::NEG_INFINITY);
    let mut see = |x: f64| {
        x0 = x0.min(x);
        x1 = x1.max(x);
    };
    for k in 0..3 {
        let (p, q) = (t[k], t[(k + 1) % 3]);
        if p.y >= low && p.y <= high {
            see(p.x);
        }
        for y in [low, high] {
            if (p.y < y) != (q.y < y) {
                see(p.x + (q.x - p.x) * ((y - p.y) / (q.y - p.y)));
            }
        }
    }
    (x0 <= x1).then_some((x0, x1))
}
