//! Panels: the pieces that are cut and packed, as outlines in their chart's coordinates, with what packing needs of them.

use std::sync::{Arc, OnceLock};

use glam::{DMat2, DVec2};

use super::edges::Patch;
use super::outline::{Line, Outline};
use super::void::{VoidBox, void_boxes};
use crate::atlas::bvh::Bounds;
use crate::packing::{Mask, Orientation, Pitch, Probe, Rotation, Shape, fill, l1_norm, quarter_turns};

/// How panels are rasterised during the search.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Raster {
    /// Texels per cell.
    pub cell: f64,
    /// Panels grow outwards by so many texels, half of the gutter (Box Cutter 3.2.2, "Outward Offsetting").
    pub inflate: f64,
    /// How sheets lie in memory.
    pub pitch: Pitch,
    /// Rotations that packing may use.
    pub rotation: Rotation,
    /// Whether panels may be mirrored.
    pub mirror: bool,
}

/// A chart, or a part of one.
#[derive(Debug)]
pub(crate) struct Panel {
    /// Number of the chart, or cluster, that it is a part of.
    pub chart: u32,
    /// Its polygon.
    pub outline: Outline,
    /// Area in square texels.
    pub area: f64,
    /// Length of the border in texels.
    pub length: f64,
    /// Its triangles, where cuts follow edges.
    pub patch: Option<Patch>,
    /// What it covers, where the outline does not say: it cannot be cut then.
    rigid: Option<Vec<[DVec2; 3]>>,
    /// The angle that turns its border along the axes, in 0..pi/2 (Box Cutter 3.2.1).
    pub axes: f64,
    /// Whether it may be turned by a half only.
    pub half_turns: bool,
    shapes: OnceLock<Arc<Vec<Shape>>>,
    voids: OnceLock<Vec<LocalVoid>>,
}

/// A void box in a panel's own best-axes box, as lines in chart coordinates.
#[derive(Debug, Clone)]
pub(crate) struct LocalVoid {
    /// Area in square texels.
    pub area: f64,
    /// Pairs of lines, those of one direction together: each box offers its sides in one direction or in the other.
    pub sides: [Vec<Line>; 2],
    /// How far each direction's lines may shift: the panel's box across them, in texels.
    pub across: [f64; 2],
}

impl Panel {
    /// A panel that can be cut.
    pub fn new(chart: u32, outline: Outline, patch: Option<Patch>, rotation: Rotation, half_turns: bool) -> Self {
        let axes = if rotation == Rotation::Any && !half_turns { best_axes(&outline) } else { 0.0 };
        let (area, length) = (outline.area(), outline.length());
        let (shapes, voids) = (OnceLock::new(), OnceLock::new());
        Panel { chart, outline, area, length, patch, rigid: None, axes, half_turns, shapes, voids }
    }

    /// A panel that stays as it is: what overlaps itself, is several charts, or has no proper border.
    pub fn rigid(
        chart: u32,
        outline: Outline,
        triangles: Vec<[DVec2; 3]>,
        rotation: Rotation,
        half_turns: bool,
    ) -> Self {
        let area = triangles.iter().map(|[a, b, c]| 0.5 * (*b - *a).perp_dot(*c - *a).abs()).sum();
        Panel { rigid: Some(triangles), area, ..Panel::new(chart, outline, None, rotation, half_turns) }
    }

    /// A part of it.
    pub fn part(&self, outline: Outline, patch: Option<Patch>, rotation: Rotation) -> Self {
        Panel::new(self.chart, outline, patch, rotation, self.half_turns)
    }

    /// Whether it may be cut.
    pub fn cuttable(&self) -> bool {
        self.rigid.is_none()
    }

    /// The middle of its area.
    pub fn middle(&self) -> DVec2 {
        match &self.rigid {
            Some(triangles) => middle(triangles.iter().map(|t| (*t, (t[1] - t[0]).perp_dot(t[2] - t[0]).abs()))),
            None => {
                let origin = self.outline.bounds().min;
                middle(self.outline.edges().map(|(a, b)| ([origin, a, b], (a - origin).perp_dot(b - origin))))
            }
        }
    }

    /// The ways round that packing tries, best axes first.
    pub fn orientations(&self, raster: &Raster) -> Vec<Orientation> {
        let quarters = quarter_turns(raster.rotation, self.half_turns);
        let mirrors = if raster.mirror { &[false, true][..] } else { &[false] };
        let turn = |mirror: bool, q: u8| {
            let quarter = std::f64::consts::FRAC_PI_2 * f64::from(q);
            Orientation { angle: if mirror { quarter - self.axes } else { quarter + self.axes }, mirror }
        };
        mirrors.iter().flat_map(|&m| quarters.iter().map(move |&q| turn(m, q))).collect()
    }

    /// The panel's shapes, in the order of its orientations.
    pub fn shapes(&self, raster: &Raster) -> Arc<Vec<Shape>> {
        let shape = |o: Orientation| {
            let linear = o.matrix();
            let (mask, anchor) = rasterise(&self.outline, self.rigid.as_deref(), linear, raster);
            let probe = Probe::new(&mask, raster.pitch, false);
            Shape { cells: mask.count(), mask, probe, anchor, linear }
        };
        let make = || Arc::new(self.orientations(raster).into_iter().map(shape).collect());
        self.shapes.get_or_init(make).clone()
    }

    /// The largest void boxes of the panel in its best-axes box.
    pub fn voids(&self, raster: &Raster, count: usize, shared: f64) -> &[LocalVoid] {
        self.voids.get_or_init(|| {
            let shapes = self.shapes(raster);
            let Some(shape) = shapes.first() else { return Vec::new() };
            let (w, h) = (shape.mask.width, shape.mask.height);
            let across = [h as f64 * raster.cell, w as f64 * raster.cell];
            void_boxes(&shape.mask, w, h, count, shared)
                .iter()
                .map(|b| LocalVoid {
                    area: b.area() as f64 * raster.cell * raster.cell,
                    sides: sides(b, w, h).map(|lines| {
                        lines.iter().map(|(p, d)| to_chart(shape.linear, shape.anchor, *p * raster.cell, *d)).collect()
                    }),
                    across,
                })
                .collect()
        })
    }
}

/// The middle of triangles that weigh so much each.
pub(crate) fn middle(triangles: impl Iterator<Item = ([DVec2; 3], f64)>) -> DVec2 {
    let add =
        |(sum, area): (DVec2, f64), (t, own): ([DVec2; 3], f64)| (sum + (t[0] + t[1] + t[2]) / 3.0 * own, area + own);
    let (sum, area) = triangles.fold((DVec2::ZERO, 0.0), add);
    sum / if area == 0.0 { 1.0 } else { area }
}

/// The sides of a void box that do not lie on the whole box's own: horizontal ones and vertical ones, as point and direction in cells.
pub(crate) fn sides(b: &VoidBox, width: usize, height: usize) -> [Vec<(DVec2, DVec2)>; 2] {
    let horizontal = [b.y.0, b.y.1].into_iter().filter(|y| *y > 0 && *y < height);
    let vertical = [b.x.0, b.x.1].into_iter().filter(|x| *x > 0 && *x < width);
    [
        horizontal.map(|y| (DVec2::new(0.0, y as f64), DVec2::X)).collect(),
        vertical.map(|x| (DVec2::new(x as f64, 0.0), DVec2::Y)).collect(),
    ]
}

/// A line of the sheet in the coordinates of a chart that lies there as `linear * uv - anchor`.
pub(crate) fn to_chart(linear: DMat2, anchor: DVec2, point: DVec2, along: DVec2) -> Line {
    let back = linear.transpose();
    Line { point: back * (point + anchor), along: back * along }
}

/// The cells that an outline covers after `linear`, and what is subtracted from turned coordinates so that the mask's
/// corner is the origin. A cell is set when the polygon, or the triangles in its stead, grown by the raster's margin, touches it.
pub(crate) fn rasterise(
    outline: &Outline,
    triangles: Option<&[[DVec2; 3]]>,
    linear: DMat2,
    raster: &Raster,
) -> (Mask, DVec2) {
    let cell = raster.cell;
    let turned: Vec<Vec<DVec2>> =
        outline.loops.iter().map(|l| l.iter().map(|p| linear * *p / cell).collect()).collect();
    let grow = raster.inflate / cell;
    let inner = || triangles.into_iter().flatten().map(|t| t.map(|p| linear * p / cell));
    let points = turned.iter().flatten().copied().chain(inner().flatten());
    let Bounds { min: low, max: high } = Bounds::around(points).or_zero();
    let anchor = low - DVec2::splat(grow + 2e-3);
    let size = (high + DVec2::splat(grow + 2e-3) - anchor).ceil().max(DVec2::ONE);
    let (width, height) = (size.x as usize, size.y as usize);
    let mut mask = Mask::new(width, height);
    let edge = |l: &Vec<DVec2>, i: usize| [l[i] - anchor, l[(i + 1) % l.len()] - anchor];
    let edges: Vec<[DVec2; 2]> = turned.iter().flat_map(|l| (0..l.len()).map(|i| edge(l, i))).collect();
    edges.iter().for_each(|[a, b]| border(&mut mask, *a, *b, grow));
    for t in inner() {
        mask.add_triangle(&t.map(|p| p - anchor));
    }
    if triangles.is_none() {
        fill(&edges, &mut mask);
    }
    (mask, anchor * cell)
}

/// The cells about an edge, as far as `grow`.
fn border(mask: &mut Mask, a: DVec2, b: DVec2, grow: f64) {
    if grow <= 0.0 {
        mask.add_triangle(&[a, b, b]);
        return;
    }
    let along = (b - a).normalize_or(DVec2::X) * grow;
    let across = along.perp();
    let [p, q, r, s] = [a - along - across, b + along - across, b + along + across, a - along + across];
    mask.add_triangle(&[p, q, r]);
    mask.add_triangle(&[p, r, s]);
}

/// Directions are gathered in so many bins of a quarter turn.
const BINS: usize = 180;

/// The angle in 0..pi/2 that turns the outline as far as possible along the axes: the L1 norm of its edge vectors is least. Each
/// vector is first averaged with its neighbours, so that ragged borders count by where they lead (Box Cutter 3.2.1).
fn best_axes(outline: &Outline) -> f64 {
    use std::f64::consts::FRAC_PI_2;
    let mut weight = [0.0f64; BINS];
    let mut edges: Vec<DVec2> = Vec::new();
    for l in &outline.loops {
        let n = l.len();
        let edge = |i: usize| l[(i + 1) % n] - l[i % n];
        for i in 0..n {
            let smooth = (edge(i + n - 1) + edge(i) + edge(i + 1)) / 3.0;
            let length = smooth.length();
            if length > 0.0 {
                let angle = smooth.to_angle().rem_euclid(FRAC_PI_2);
                weight[(angle / FRAC_PI_2 * BINS as f64) as usize % BINS] += length;
                edges.push(smooth);
            }
        }
    }
    let step = FRAC_PI_2 / BINS as f64;
    let norms: Vec<f64> = (0..2 * BINS)
        .map(|k| {
            let (sin, cos) = (step * ((k % BINS) as f64 + 0.5)).sin_cos();
            sin + cos
        })
        .collect();
    // A direction at angle a turned by t lies at a + t, within a quarter turn.
    let rough = |t: usize| weight.iter().zip(&norms[t..]).map(|(w, n)| w * n).sum::<f64>();
    let costs: Vec<f64> = (0..BINS).map(rough).collect();
    let best = (0..BINS).min_by(|&a, &b| costs[a].total_cmp(&costs[b])).unwrap_or(0) as f64;
    let exact = |t: f64| l1_norm(&edges, t);
    let near = (-4..=4).map(|k| step * (best + f64::from(k) / 4.0));
    let found = near.map(|t| (exact(t), t)).min_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or((0.0, 0.0));
    // What is upright stays exactly so.
    if exact(0.0) <= found.0 * (1.0 + 1e-9) { 0.0 } else { found.1.rem_euclid(FRAC_PI_2) }
}
