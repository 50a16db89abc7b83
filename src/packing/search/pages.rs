//! Several sheets, where one does not hold everything.

use super::{RULES, Search};
use crate::error::{Code, Failure, Result};
use crate::packing::Packing;
use crate::packing::greedy::{Plan, compact, greedy};
use crate::packing::shape::Shapes;
use crate::packing::tuning::Frontiers;

impl Search<'_> {
    /// Fills sheets of the largest size one after the other.
    pub(super) fn pages(&self, shapes: &Shapes, mut work: u64) -> Result<Packing> {
        let (width, height) = (self.limit(0, shapes), self.limit(1, shapes));
        let mut placements = vec![None; self.request.pieces.len()];
        let mut sheets = Vec::new();
        let mut rest = self.orders(shapes).swap_remove(0);
        while !rest.is_empty() {
            self.context.check()?;
            let plan = Plan {
                order: rest.clone(),
                width,
                height,
                rule: RULES[0],
                partial: true,
                frontiers: self.tuning.frontiers != Frontiers::Nowhere,
            };
            let (mut layout, mut strip) = greedy(shapes, &plan, &|| self.stopped());
            self.context.check()?;
            if layout.left_over.len() == rest.len() {
                return Err(Failure::new(
                    Code::TooLarge,
                    format!(
                        "a chart does not fit on a sheet of {} x {} texels; raise texture.max_size or set texture.overflow to \"scale\"",
                        self.request.max[0], self.request.max[1]
                    ),
                ));
            }
            compact(&mut strip, &mut layout, 2, &|| self.stopped());
            work += layout.work;
            let page = sheets.len() as u16;
            for (piece, slot) in placements.iter_mut().enumerate() {
                if layout.spots[piece].is_some() {
                    *slot = self.placement(shapes, &layout, piece, page);
                }
            }
            sheets.push(self.sheet(&layout, shapes));
            rest = std::mem::take(&mut layout.left_over);
        }
        Ok(Packing { placements: placements.into_iter().flatten().collect(), sheets, work })
    }
}
