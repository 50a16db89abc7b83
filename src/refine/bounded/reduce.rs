//! Distortion reduction with a bounded packing efficiency (section 3.3, Algorithm 2).

use glam::DVec2;

use crate::atlas::bvh::Bounds;
use crate::atlas::groups::sorted_unique;
use crate::error::Result;
use crate::numeric::dirichlet::RestTriangle;
use crate::numeric::newton::{self, Element, Workspace};
use crate::numeric::scaffold::{raised, void_triangles};

/// All charts on a sheet, as triangles over common vertices.
#[derive(Debug, Clone, Default)]
pub(super) struct PackedCharts {
    pub x: Vec<DVec2>,
    /// With positive areas.
    pub triangles: Vec<[u32; 3]>,
    /// Weights are such that an isometry of all has the energy 1.
    pub rest: Vec<RestTriangle>,
    /// Directed edges with their chart, and its layer, on the left.
    pub walls: Vec<[u32; 2]>,
    /// Vertices on the boundaries of charts.
    pub border: Vec<u32>,
    /// Boundary edges with the number of their chart.
    pub segments: Vec<([u32; 2], u32)>,
    /// The layer about each chart: triangles and their shape at rest, heavy.
    pub layer: Vec<([u32; 3], RestTriangle)>,
    /// Boxes that stay where they are, and are no part of the charts: what lies in them was not to be changed.
    pub fixed: Vec<Bounds>,
    /// The same with the layer about them.
    pub fixed_walls: Vec<Bounds>,
    /// Vertices of charts that have no layer though they are to be apart: these charts stay as they are.
    pub still: Vec<u32>,
    /// How far charts without a layer are to be apart.
    pub apart: f64,
    /// Area that is covered in them.
    pub fixed_area: f64,
    /// Area of all triangles at rest.
    pub rest_area: f64,
}

/// What is to be kept and reached.
#[derive(Debug, Clone, Copy)]
pub(super) struct Reduction {
    /// Least packing efficiency.
    pub efficiency: f64,
    /// Energy at which it is enough.
    pub enough: f64,
    /// What charts are to be apart.
    pub gap: f64,
    /// Rounds of growing the box at most.
    pub rounds: usize,
    /// Steps in a round at most.
    pub steps: usize,
    /// Steps after which no round begins: where layers hold charts apart they would go on for long.
    pub most: usize,
}

/// What was reached.
#[derive(Debug, Clone, Copy)]
pub(super) struct Reduced {
    pub energy: f64,
    pub steps: usize,
}

/// Energy of all void triangles together, in parts of that of an isometry of all charts.
const VOID_ENERGY: f64 = 0.002;
/// Height in mean edges below which a void triangle wants to be higher.
const NARROWEST: f64 = 0.02;
/// Area of the charts at the begin, in parts of that at rest, and that to which they come.
const SMALLER: f64 = 0.95;
const SETTLED: f64 = 0.985;
/// How often a step that leaves the charts packed too loosely is halved.
const HALVINGS: usize = 8;
/// Steps that may be undone because they bring charts too near to each other.
const REFUSALS: usize = 24;
/// Rounds in which the box grows.
const GROWING: usize = 6;
/// Relative decrease of a step below which a round ends.
const STILL: f64 = 1e-5;

impl PackedCharts {
    pub fn energy(&self) -> f64 {
        self.triangles.iter().zip(&self.rest).map(|(t, r)| r.energy(t.map(|v| self.x[v as usize]))).sum()
    }

    pub fn area(&self) -> f64 {
        self.triangles.iter().map(|t| super::chart_map::area(t.map(|v| self.x[v as usize]))).sum()
    }

    /// The box about all charts and all that stays.
    pub fn bounds(&self) -> Bounds {
        let own = Bounds::around(self.border.iter().map(|v| self.x[*v as usize]));
        self.fixed.iter().fold(own, |all, b| all.union(*b))
    }

    /// The box about their layers too.
    fn outer_bounds(&self) -> Bounds {
        let walls = Bounds::around(self.walls.iter().flatten().map(|v| self.x[*v as usize]));
        self.fixed_walls.iter().fold(self.bounds().union(walls), |all, b| all.union(*b))
    }

    /// The segments that are less than `gap` from one of another chart, by their place in `segments`.
    fn too_near(&self, gap: f64) -> Vec<usize> {
        let own = self.segments.iter().map(|(s, c)| (s.map(|v| self.x[v as usize]), *c));
        let fixed = self.fixed.iter().zip(u32::MAX - self.fixed.len() as u32..).flat_map(|(b, c)| {
            let corners = corners(b);
            (0..4).map(move |k| ([corners[k], corners[(k + 1) % 4]], c))
        });
        let near = super::layer::too_near(&own.chain(fixed).collect::<Vec<_>>(), gap);
        near.into_iter().flat_map(|(i, j)| [i, j]).filter(|i| *i < self.segments.len()).collect()
    }

    /// Whether there is a void about the charts: none touches another or itself.
    pub fn has_void(&self) -> bool {
        let Bounds { min, max } = self.outer_bounds();
        let margin = 0.1 * (max - min).max_element();
        Void::new(self, &Bounds { min: min - margin, max: max + margin }).is_some()
    }

    /// Area of the charts over area of the box about them.
    pub fn efficiency(&self) -> f64 {
        (self.area() + self.fixed_area) / self.bounds().size().element_product()
    }
}

/// Lowers the distortion while no two charts touch and they stay packed well enough; what was reached when time is up will do.
pub(super) fn reduce(
    charts: &mut PackedCharts,
    goal: &Reduction,
    interrupt: &dyn Fn() -> Result<()>,
    out_of_time: &dyn Fn() -> bool,
) -> Result<Reduced> {
    let mut workspace = Workspace::default();
    let n = charts.x.len();
    let mut is_free = vec![true; n];
    charts.still.iter().for_each(|v| is_free[*v as usize] = false);
    let mut free: Vec<u32> = (0..n as u32).filter(|v| is_free[*v as usize]).collect();
    let mut energy = charts.energy();
    let mut taken = 0;
    // The box grows from what the charts need now to what the bound allows, and they press against each other before it does.
    let Bounds { min, max } = charts.bounds();
    let middle = 0.5 * (min + max);
    // Smaller than at rest they expand, which packs them more tightly; larger, they would shrink away from each other. What has its distances keeps them.
    let scale = (SMALLER * charts.rest_area / charts.area()).sqrt();
    if charts.fixed.is_empty() && charts.still.is_empty() && charts.layer.is_empty() && scale < 1.0 {
        charts.x.iter_mut().for_each(|p| *p = middle + (*p - middle) * scale);
        energy = charts.energy();
    }
    let size = charts.bounds().size();
    // Where the bound is missed already, what there is is kept.
    let efficiency = goal.efficiency.min(charts.efficiency());
    let mut refused = 0;
    'rounds: for round in 0..goal.rounds {
        let (inner, outer) = (charts.bounds(), charts.outer_bounds());
        let part = ((round + 1) as f64 / GROWING as f64).min(1.0);
        let area = SETTLED * charts.rest_area + charts.fixed_area;
        let allowed = (area / efficiency / size.element_product()).sqrt() * (1.0 - 5e-4);
        let grown = 1.0 + part * (allowed - 1.0).max(0.0);
        let extent = (outer.max - middle).max(middle - outer.min);
        let margin = 0.5 * (outer.size() - inner.size());
        let half = (0.5 * size * grown + margin).max(extent * (1.0 + 1e-4));
        let sheet = Bounds { min: middle - half, max: middle + half };
        let mut gained = 0.0;
        for _ in 0..goal.steps {
            interrupt()?;
            if out_of_time() {
                break 'rounds;
            }
            let kept = charts.x.clone();
            let Some(step) = step(charts, &free, &sheet, &mut workspace) else { break };
            taken += 1;
            let mut halvings = 0;
            while charts.efficiency() < efficiency && halvings < HALVINGS {
                halvings += 1;
                charts.x.iter_mut().zip(&kept).for_each(|(x, old)| *x = *old + (*x - *old) * 0.5);
            }
            if charts.efficiency() < efficiency {
                charts.x = kept;
                break;
            }
            let near = if goal.gap > 0.0 { charts.too_near(goal.gap) } else { Vec::new() };
            if !near.is_empty() {
                // The step is undone, and what came too near stays where it is from here on.
                charts.x = kept;
                let ends = near.iter().flat_map(|i| charts.segments[*i].0);
                let stopped = ends.filter(|v| std::mem::take(&mut is_free[*v as usize])).count();
                free.retain(|v| is_free[*v as usize]);
                refused += 1;
                if stopped == 0 || free.is_empty() || refused == REFUSALS {
                    break 'rounds;
                }
                continue;
            }
            let now = charts.energy();
            let own = energy - now;
            energy = now;
            gained += own;
            if step.alpha == 0.0 || own < STILL * now * step.alpha || energy <= goal.enough {
                break;
            }
        }
        if energy <= goal.enough || taken >= goal.most || part >= 1.0 && gained < STILL * energy {
            break;
        }
    }
    Ok(Reduced { energy, steps: taken })
}

/// The corners of a box, counter-clockwise from the least.
fn corners(b: &Bounds) -> [DVec2; 4] {
    [b.min, DVec2::new(b.max.x, b.min.y), b.max, DVec2::new(b.min.x, b.max.y)]
}

/// The void about all charts in a box.
struct Void {
    /// Vertices that it has in common with charts and what stays; those of what stays have places behind the charts' own.
    points: Vec<u32>,
    /// Places of what stays.
    fixed: Vec<DVec2>,
    /// Of `points`, and beyond them of the corners of the box.
    triangles: Vec<[u32; 3]>,
}

impl Void {
    /// None where charts overlap or touch.
    fn new(charts: &PackedCharts, sheet: &Bounds) -> Option<Void> {
        let n = charts.x.len();
        let mut walls = charts.walls.clone();
        let mut fixed = Vec::with_capacity(4 * charts.fixed_walls.len());
        for own in &charts.fixed_walls {
            let first = (n + fixed.len()) as u32;
            fixed.extend(corners(own));
            walls.extend((0..4).map(|k| [first + k, first + (k + 1) % 4]));
        }
        let points = sorted_unique(walls.iter().flatten().copied());
        let mut local = vec![u32::MAX; n + fixed.len()];
        points.iter().enumerate().for_each(|(k, v)| local[*v as usize] = k as u32);
        let at = points.iter().map(|v| charts.x.get(*v as usize).copied().unwrap_or_else(|| fixed[*v as usize - n]));
        let at: Vec<DVec2> = at.collect();
        walls.iter_mut().for_each(|w| *w = w.map(|v| local[v as usize]));
        let triangles = void_triangles(&at, &walls, walls.len(), sheet.min, sheet.max)?;
        Some(Void { points, fixed, triangles })
    }
}

/// One Newton step of all charts and the void between them in a box, and one of L-BFGS after it.
fn step(charts: &mut PackedCharts, free: &[u32], sheet: &Bounds, workspace: &mut Workspace) -> Option<newton::Step> {
    let n = charts.x.len();
    let Void { points, fixed, triangles: void } = Void::new(charts, sheet)?;
    charts.x.extend(fixed);
    let placed = charts.x.len();
    let pairs = charts.triangles.iter().zip(&charts.rest);
    let layer = charts.layer.iter().map(|(corners, rest)| (corners, rest));
    let triangle = |(corners, rest): (&[u32; 3], &RestTriangle)| Element::Triangle { corners: *corners, rest: *rest };
    let mut elements: Vec<Element> = pairs.chain(layer).map(triangle).collect();
    charts.x.extend(corners(sheet));
    let mean = charts.area() / charts.triangles.len().max(1) as f64;
    let apart = if charts.layer.is_empty() { charts.apart } else { 0.0 };
    let least = (NARROWEST * (mean * 4.0 / 3f64.sqrt()).sqrt()).max(apart);
    let weight = VOID_ENERGY / void.len().max(1) as f64;
    for t in void {
        let vertices =
            t.map(|v| points.get(v as usize).copied().unwrap_or((placed + v as usize - points.len()) as u32));
        let shape = raised(vertices.map(|v| charts.x[v as usize]), least);
        if let Some(rest) = RestTriangle::new(shape, weight) {
            elements.push(Element::Triangle { corners: vertices, rest });
        }
    }
    let step = newton::steps(&mut charts.x, &elements, free, workspace, 2);
    charts.x.truncate(n);
    step
}
