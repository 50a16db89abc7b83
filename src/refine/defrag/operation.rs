//! Merge operations: which seams are dissolved together, and how appealing that is (sections 4.1 and 4.3).

use glam::DVec2;

use super::mesh::Mesh;
use super::params::{Appeal, Defrag, Search};
use crate::atlas::find_root;
use crate::atlas::rigid::{Rigid, RigidFit};

/// Texels that a seam may lose in fit for its two sides to keep their texels together.
const SNAP: f64 = 0.75;

/// Which part of what two charts share an operation dissolves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    /// All of it (section 4.1).
    Whole,
    /// One connected run of it.
    Run,
    /// A stretch of a run.
    Stretch,
    /// A connected group of seams within a chart (section 4.1).
    Within,
}

/// An operation.
#[derive(Debug, Clone)]
pub(super) struct Operation {
    /// What it dissolves.
    pub kind: Kind,
    /// One half edge of each pair of linked edges, ascending.
    pub edges: Vec<u32>,
    /// The chart that stays, and the one that comes to it: the smaller. The same for a seam within a chart.
    pub kept: u32,
    /// See `kept`.
    pub moved: u32,
    /// Takes the moved chart to the other (section 4.2.1).
    pub motion: Rigid,
    /// Whether the texels of both charts stay whole then.
    pub whole_texels: bool,
    /// Length of the seam on either side, that of the kept chart first, in texels.
    pub lengths: [f64; 2],
    /// Mean distance of the vertices to be fused after alignment (eq. 2), in texels.
    pub cost: f64,
    /// What a random ranking goes by, in 0..1.
    pub chance: f64,
    /// Times that it failed.
    pub fails: u32,
    /// The less, the sooner it is tried: the reciprocal of the appeal (eq. 5), which would be infinite where seams fit exactly.
    pub rank: f64,
}

impl Operation {
    /// Aligns the two sides of the seam and ranks the operation; `None` where they do not fit at all. `chance` in 0..1 is what a random
    /// ranking goes by.
    pub(super) fn new(
        mesh: &Mesh,
        kind: Kind,
        edges: Vec<u32>,
        fails: u32,
        params: &Defrag,
        unit: f64,
        chance: f64,
    ) -> Option<Self> {
        let h = edges[0];
        let (a, b) = (mesh.chart(h), mesh.chart(mesh.link[h as usize]));
        let (kept, moved) = Self::roles(mesh, a, b);
        let mut pairs: Vec<(u32, u32)> = Vec::with_capacity(2 * edges.len());
        let (mut length, mut other) = (0.0, 0.0);
        for &h in &edges {
            let (own, across) = sides(mesh, h, kept);
            pairs.extend([(mesh.start(own), mesh.end(across)), (mesh.end(own), mesh.start(across))]);
            length += mesh.length(own);
            other += mesh.length(across);
        }
        pairs.sort_unstable();
        pairs.dedup();
        let at = |u: u32| mesh.uv[u as usize];
        let within = a == b;
        let mut whole_texels = within;
        let cost = |motion: &Rigid| {
            pairs.iter().map(|&(own, across)| at(own).distance(motion.apply(at(across)))).sum::<f64>()
                / pairs.len() as f64
        };
        let mut motion = Rigid::IDENTITY;
        if !within {
            let mut fit = RigidFit::default();
            pairs.iter().for_each(|&(own, across)| fit.add(at(across), at(own)));
            let (own, across) = pairs[0];
            motion = fit.solve().unwrap_or(Rigid { translate: at(own) - at(across), ..Rigid::IDENTITY });
        }
        let mut residual = cost(&motion);
        if !within && params.search == Search::Partial {
            let main = |c: u32| mesh.motion[mesh.charts[c as usize].main as usize];
            let mean = |side: &dyn Fn(&(u32, u32)) -> u32| {
                pairs.iter().map(|pair| at(side(pair))).sum::<DVec2>() / pairs.len() as f64
            };
            let snapped = snap(&motion, &main(kept), &main(moved), (mean(&|p| p.1), mean(&|p| p.0)), unit);
            let worse = cost(&snapped);
            if worse <= residual + SNAP {
                (motion, residual, whole_texels) = (snapped, worse, true);
            }
        }
        if residual > params.max_misalignment * 0.5 * (length + other) || residual.is_nan() {
            return None;
        }
        let mut own = Operation {
            kind,
            edges,
            kept,
            moved,
            motion,
            whole_texels,
            lengths: [length, other],
            cost: residual,
            chance,
            fails,
            rank: 0.0,
        };
        own.rank = own.ranked(mesh, params);
        Some(own)
    }

    /// Which chart stays: the larger.
    pub(super) fn roles(mesh: &Mesh, a: u32, b: u32) -> (u32, u32) {
        let (p, q) = (&mesh.charts[a as usize], &mesh.charts[b as usize]);
        if (p.area, b) >= (q.area, a) { (a, b) } else { (b, a) }
    }

    /// Part of a border that the operation removes (eq. 1).
    pub(super) fn benefit(&self, mesh: &Mesh) -> f64 {
        let [p, q] = [self.kept, self.moved].map(|c| mesh.charts[c as usize].perimeter.max(1e-300));
        let [own, other] = self.lengths;
        if self.kept == self.moved { (own + other) / p } else { (own / p).max(other / q) }
    }

    /// Whether the chart that comes is too small to matter.
    pub(super) fn is_island(&self, mesh: &Mesh, params: &Defrag) -> bool {
        params.search == Search::Partial && mesh.charts[self.moved as usize].area < params.island_area
    }

    /// The reciprocal of the appeal (eq. 5).
    pub(super) fn ranked(&self, mesh: &Mesh, params: &Defrag) -> f64 {
        let back_off = f64::exp2(f64::from(self.fails.min(60)));
        let ratio = (self.cost + 1e-9) / self.benefit(mesh).max(1e-300);
        let [p, q] = [self.kept, self.moved].map(|c| mesh.charts[c as usize].area);
        let size = p.min(q).max(1e-9);
        match params.appeal {
            Appeal::Full => ratio * size * back_off,
            Appeal::NoBenefitCost => size * back_off,
            Appeal::NoSizeBonus => ratio * back_off,
            Appeal::Random => self.chance * back_off,
        }
    }
}

/// The pairs of half edges that an operation makes one, those of the kept chart first.
pub(super) fn pairs(mesh: &Mesh, op: &Operation) -> Vec<(u32, u32)> {
    op.edges.iter().map(|&h| sides(mesh, h, op.kept)).collect()
}

/// The half edges of a pair: that of chart `kept` first. Within a chart: as given.
pub(super) fn sides(mesh: &Mesh, h: u32, kept: u32) -> (u32, u32) {
    let t = mesh.link[h as usize];
    if mesh.chart(h) == kept { (h, t) } else { (t, h) }
}

/// The motion nearest to `motion` under which texels that move as `kept` and as `moved` lie on one grid of `unit` texels;
/// `middle` is the middle of the seam on the moved side and on the kept one.
fn snap(motion: &Rigid, kept: &Rigid, moved: &Rigid, middle: (DVec2, DVec2), unit: f64) -> Rigid {
    let relative = kept.inverse().after(&motion.after(moved));
    // The nearest quarter turn.
    let (cos, sin) = if relative.cos.abs() >= relative.sin.abs() {
        (relative.cos.signum(), 0.0)
    } else {
        (0.0, relative.sin.signum())
    };
    let turned = Rigid { cos, sin, translate: DVec2::ZERO };
    let translate = kept.inverse().apply(middle.1) - turned.apply(moved.inverse().apply(middle.0));
    let whole = Rigid { translate: (translate / unit).round() * unit, ..turned };
    kept.after(&whole.after(&moved.inverse()))
}

/// Connected runs of linked edges: those that share a seam vertex on both sides. Each ascending; ordered by their first.
pub(super) fn runs(mesh: &Mesh, edges: &[u32]) -> Vec<Vec<u32>> {
    let mut parent: Vec<u32> = (0..edges.len() as u32).collect();
    // (vertex on the one side, vertex on the other) of each end.
    let mut ends: Vec<((u32, u32), u32)> = Vec::with_capacity(2 * edges.len());
    for (i, &h) in edges.iter().enumerate() {
        let t = mesh.link[h as usize];
        for (p, q) in [(mesh.start(h), mesh.end(t)), (mesh.end(h), mesh.start(t))] {
            ends.push(((p.min(q), p.max(q)), i as u32));
        }
    }
    ends.sort_unstable();
    for pair in ends.windows(2).filter(|w| w[0].0 == w[1].0) {
        let (a, b) = (find_root(&mut parent, pair[0].1), find_root(&mut parent, pair[1].1));
        parent[a.max(b) as usize] = a.min(b);
    }
    let mut runs: Vec<Vec<u32>> = Vec::new();
    let mut number = vec![usize::MAX; edges.len()];
    for (i, &h) in edges.iter().enumerate() {
        let root = find_root(&mut parent, i as u32) as usize;
        if number[root] == usize::MAX {
            number[root] = runs.len();
            runs.push(Vec::new());
        }
        runs[number[root]].push(h);
    }
    runs
}
