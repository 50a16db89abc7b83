//! The best coarse plans, built again at the fine resolution.

use rayon::prelude::*;

use super::Search;
use super::coarse::Evaluated;
use crate::atlas::groups::sorted_unique;
use crate::error::Result;
use crate::packing::greedy::{Plan, StripBuilder, StripLayout, compact, greedy};
use crate::packing::orientation::Orientation;
use crate::packing::shape::Shapes;
use crate::packing::tuning::Frontiers;
use crate::packing::{PackSearch, Packing};

/// Rounds of compaction for each finalist, and for the best alone.
const ROUNDS_OF_EACH: usize = 2;
const ROUNDS_OF_BEST: usize = 1;

/// A layout at the fine resolution, and the strip that it was built on.
struct FineLayout<'s> {
    cost: f64,
    layout: StripLayout,
    strip: StripBuilder<'s>,
}

impl Search<'_> {
    /// The best layout of the finalists on one sheet with its cost, if there is one; and `work` with theirs added.
    pub(super) fn finalists(
        &self,
        plans: &[Evaluated],
        coarse: &Shapes,
        cell: f64,
        mut work: u64,
    ) -> Result<(Option<(f64, Packing)>, u64)> {
        let widest = plans.iter().map(|t| t.width).max().unwrap_or(0) as f64 * coarse.cell;
        let fine = if cell == coarse.cell && !self.tuning.keeps_orientations {
            None
        } else {
            Some(self.shapes(&self.orientations_of(plans), cell, widest + cell))
        };
        let fine = fine.as_ref().unwrap_or(coarse);
        self.context.step(0.6, "placing")?;
        let built: Vec<Result<FineLayout<'_>>> =
            plans.par_iter().map(|plan| self.rebuilt(plan, coarse, fine)).collect();
        let mut best: Option<FineLayout<'_>> = None;
        for next in built {
            let next = next?;
            work += next.layout.work;
            if next.layout.left_over.is_empty() && best.as_ref().is_none_or(|best| next.cost < best.cost) {
                best = Some(next);
            }
        }
        if let Some(best) = best.as_mut().filter(|_| !self.tuning.compacts_all) {
            work -= best.layout.work;
            compact(&mut best.strip, &mut best.layout, ROUNDS_OF_BEST, &|| self.stopped());
            self.context.check()?;
            work += best.layout.work;
            best.cost = self.cost(&best.layout, fine);
        }
        self.context.step(0.95, "placing")?;
        Ok((best.map(|best| (best.cost, self.one_sheet(&best.layout, fine, work))), work))
    }

    /// A coarse plan at the fine resolution.
    fn rebuilt<'s>(&self, of: &Evaluated, coarse: &Shapes, fine: &'s Shapes) -> Result<FineLayout<'s>> {
        self.context.check()?;
        let ratio = coarse.cell / fine.cell;
        let width = ((of.width as f64 * ratio).ceil() as usize).min(self.limit(0, fine));
        let height = (self.height_at(of.cost, of.width, coarse) as f64 * ratio * 1.3) as usize + 64;
        let frontiers = match self.tuning.frontiers {
            Frontiers::Nowhere | Frontiers::Coarse => false,
            Frontiers::CoarseAndFast => self.request.search == PackSearch::Fast,
            Frontiers::Everywhere => true,
        };
        let height = height.min(self.limit(1, fine));
        let plan = Plan { width, height, partial: false, frontiers, ..of.plan.clone() };
        let (mut layout, mut strip) = greedy(fine, &plan, &|| self.stopped());
        if layout.left_over.is_empty() && self.tuning.compacts_all {
            compact(&mut strip, &mut layout, ROUNDS_OF_EACH, &|| self.stopped());
        }
        self.context.check()?;
        Ok(FineLayout { cost: self.cost(&layout, fine), layout, strip })
    }

    /// The orientations worth trying at the fine resolution: those that the plans chose, or all, with which small pieces fill holes
    /// better.
    fn orientations_of(&self, plans: &[Evaluated]) -> Vec<Vec<Orientation>> {
        let chosen = |(piece, all): (usize, &Vec<Orientation>)| {
            if !self.tuning.keeps_orientations {
                return all.clone();
            }
            let chosen = sorted_unique(plans.iter().map(|t| t.chosen[piece]));
            chosen.into_iter().map(|k| all[k as usize]).collect()
        };
        self.orientations.iter().enumerate().map(chosen).collect()
    }
}
