//! Merge operations: which seams are dissolved together, and how appealing that is (sections 4.1 and 4.3).

use glam::DVec2;

use super::mesh::MergeMesh;
use super::params::{Appeal, Defrag, Search};
use crate::atlas::groups::sorted_unique;
use crate::atlas::rigid::{Rigid, RigidFit, back, nearest_quarter_turn, on_multiples};

/// Texels that a seam may lose in fit for its two sides to keep their texels together.
const SNAP: f64 = 0.75;

/// Which part of what two charts share an operation dissolves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum SeamPart {
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
    pub part: SeamPart,
    /// One half edge of each pair of linked edges, ascending.
    pub edges: Vec<u32>,
    /// The chart that stays, and the one that moves to it: the smaller. The same for a seam within a chart.
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
    /// Times that it failed: k of eq. 4.
    pub fails: u32,
    /// The less, the sooner it is tried: the reciprocal of the appeal (eq. 5), which would be infinite where seams fit exactly.
    pub rank: f64,
}

/// What operations are made by.
#[derive(Debug, Clone, Copy)]
pub(super) struct OperationContext<'a> {
    pub mesh: &'a MergeMesh,
    pub params: &'a Defrag,
    /// Charts whose texels stay whole move by multiples of this many texels.
    pub unit: f64,
}

impl Operation {
    /// Aligns the two sides of the seam and ranks the operation; `None` where they do not fit at all. `fails` is how often it failed
    /// before, `chance` in 0..1 is what a random ranking goes by.
    pub(super) fn new(
        context: OperationContext<'_>,
        part: SeamPart,
        edges: Vec<u32>,
        fails: u32,
        chance: f64,
    ) -> Option<Self> {
        let OperationContext { mesh, params, .. } = context;
        let h = *edges.first()?;
        let (a, b) = (mesh.chart_at(h), mesh.chart_at(mesh.linked(h)?));
        let (kept, moved) = Self::roles(mesh, a, b);
        let alignment = Alignment::new(context, &edges, kept, moved)?;
        let [own, other] = alignment.lengths;
        if alignment.cost > params.max_misalignment * 0.5 * (own + other) || alignment.cost.is_nan() {
            return None;
        }
        let Alignment { motion, whole_texels, lengths, cost } = alignment;
        let mut op =
            Operation { part, edges, kept, moved, motion, whole_texels, lengths, cost, chance, fails, rank: 0.0 };
        op.rank = op.ranked(mesh, params);
        Some(op)
    }

    /// Which chart stays: the larger.
    pub(super) fn roles(mesh: &MergeMesh, a: u32, b: u32) -> (u32, u32) {
        let (p, q) = (mesh.chart(a), mesh.chart(b));
        if (p.area, b) >= (q.area, a) { (a, b) } else { (b, a) }
    }

    /// Whether both sides are of one chart.
    pub(super) fn is_within(&self) -> bool {
        self.kept == self.moved
    }

    /// The pairs of half edges that become one, those of the kept chart first.
    pub(super) fn pairs(&self, mesh: &MergeMesh) -> Vec<(u32, u32)> {
        self.edges.iter().filter_map(|&h| mesh.linked_pair(h, self.kept)).collect()
    }

    /// Part of a border that the operation removes (eq. 1).
    pub(super) fn benefit(&self, mesh: &MergeMesh) -> f64 {
        let [p, q] = [self.kept, self.moved].map(|c| mesh.chart(c).perimeter.max(1e-300));
        let [own, other] = self.lengths;
        if self.is_within() { (own + other) / p } else { (own / p).max(other / q) }
    }

    /// Whether the chart that moves is too small to matter.
    pub(super) fn is_island(&self, mesh: &MergeMesh, params: &Defrag) -> bool {
        params.search == Search::Partial && mesh.chart(self.moved).area < params.island_area
    }

    /// The reciprocal of the appeal (eq. 5).
    pub(super) fn ranked(&self, mesh: &MergeMesh, params: &Defrag) -> f64 {
        let back_off = f64::exp2(f64::from(self.fails.min(60)));
        let ratio = (self.cost + 1e-9) / self.benefit(mesh).max(1e-300);
        let [p, q] = [self.kept, self.moved].map(|c| mesh.chart(c).area);
        let size = p.min(q).max(1e-9);
        match params.appeal {
            Appeal::Full => ratio * size * back_off,
            Appeal::NoBenefitCost => size * back_off,
            Appeal::NoSizeBonus => ratio * back_off,
            Appeal::Random => self.chance * back_off,
        }
    }
}

/// How the sides of a seam are brought together (section 4.2.1).
struct Alignment {
    motion: Rigid,
    whole_texels: bool,
    lengths: [f64; 2],
    /// See [`Operation::cost`].
    cost: f64,
}

impl Alignment {
    /// The rigid motion that fits the moved side to the kept one in the least-squares sense; where it costs next to nothing, the
    /// nearest that keeps the texels of both charts whole.
    fn new(context: OperationContext<'_>, edges: &[u32], kept: u32, moved: u32) -> Option<Self> {
        let OperationContext { mesh, params, unit } = context;
        let mut pairs: Vec<(u32, u32)> = Vec::with_capacity(2 * edges.len());
        let mut lengths = [0.0, 0.0];
        for &h in edges {
            let (own, across) = mesh.linked_pair(h, kept)?;
            pairs.extend([(mesh.start(own), mesh.end(across)), (mesh.end(own), mesh.start(across))]);
            lengths[0] += mesh.length(own);
            lengths[1] += mesh.length(across);
        }
        let pairs = sorted_unique(pairs);
        let cost = |motion: &Rigid| {
            pairs
                .iter()
                .map(|&(own, across)| mesh.uv(own).distance(motion.transform_point2(mesh.uv(across))))
                .sum::<f64>()
                / pairs.len() as f64
        };
        if kept == moved {
            let motion = Rigid::IDENTITY;
            return Some(Alignment { motion, whole_texels: true, lengths, cost: cost(&motion) });
        }
        let mut fit = RigidFit::default();
        pairs.iter().for_each(|&(own, across)| fit.add(mesh.uv(across), mesh.uv(own)));
        let (own, across) = pairs[0];
        let motion = fit.solve().unwrap_or(Rigid::from_translation(mesh.uv(own) - mesh.uv(across)));
        let residual = cost(&motion);
        if params.search == Search::Partial {
            let main = |c: u32| mesh.motion[mesh.chart(c).main_part as usize];
            let mean = |side: &dyn Fn(&(u32, u32)) -> u32| {
                pairs.iter().map(|pair| mesh.uv(side(pair))).sum::<DVec2>() / pairs.len() as f64
            };
            let snapped = snap(&motion, &main(kept), &main(moved), (mean(&|p| p.1), mean(&|p| p.0)), unit);
            let worse = cost(&snapped);
            if worse <= residual + SNAP {
                return Some(Alignment { motion: snapped, whole_texels: true, lengths, cost: worse });
            }
        }
        Some(Alignment { motion, whole_texels: false, lengths, cost: residual })
    }
}

/// The motion nearest to `motion` under which texels that move as `kept` and as `moved` lie on one grid of `unit` texels;
/// `middle` is the middle of the seam on the moved side and on the kept one.
fn snap(motion: &Rigid, kept: &Rigid, moved: &Rigid, middle: (DVec2, DVec2), unit: f64) -> Rigid {
    let (from_kept, from_moved) = (back(kept), back(moved));
    let turn = nearest_quarter_turn(&(from_kept * (*motion * *moved)));
    let translate = from_kept.transform_point2(middle.1) - turn * from_moved.transform_point2(middle.0);
    *kept * (on_multiples(turn, translate, unit) * from_moved)
}
