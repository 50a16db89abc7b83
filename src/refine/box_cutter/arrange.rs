//! The inner loop's packer: panels on one sheet, in milliseconds (Box Cutter, section 3.3).

use std::sync::Arc;

use glam::DVec2;

use super::outline::Line;
use super::panel::{Panel, Raster, to_chart};
use crate::context::Context;
use crate::packing::{Mask, Plan, RULES, Shapes, StripLayout, greedy};

/// A layout of panels.
#[derive(Debug, Clone)]
pub(crate) struct Arrangement {
    /// The layout in cells.
    pub layout: StripLayout,
    /// True area of the panels over the area of the layout's box (with its aspect ratio, where one is prescribed).
    pub efficiency: f64,
}

/// What is asked of every arrangement.
#[derive(Debug, Clone)]
pub(crate) struct Sheet {
    /// Resolution, growth and rotations.
    pub raster: Raster,
    /// Widths of the strip to try, in cells.
    pub widths: Vec<usize>,
    /// Width / height, or free.
    pub aspect: Option<f64>,
    /// Highest strip.
    pub height: usize,
}

/// Widths about a known one.
const NEAR: [f64; 3] = [1.0, 0.94, 1.06];
/// Fewer panels are cheap enough for all strips.
const SOME: usize = 32;
/// So many panels are packed in one order only, where strips are near a known one.
const MANY: usize = 80;

impl Sheet {
    /// Packs the panels greedily, in several orders and on strips of several widths, and gives the best; and the work. Where panels
    /// are those of a known layout but for few, strips about `near` as wide as that one are enough. When time is up the best so far counts; none
    /// only where a layout is known. None when the job is cancelled, too.
    pub fn arrange(&self, panels: &[Arc<Panel>], near: Option<usize>, context: &Context) -> (Option<Arrangement>, u64) {
        let is_known = near.is_some();
        let near = near.filter(|_| panels.len() > SOME);
        let widths: Vec<usize> = match near {
            Some(width) => NEAR.iter().map(|f| ((width as f64 * f) as usize).clamp(1, self.widest())).collect(),
            None => self.widths.clone(),
        };
        let stop = |any: bool| context.check().is_err() || (is_known || any) && context.out_of_time();
        let found = self.on_strips(panels, &widths, near.is_some(), &stop);
        if found.0.is_none() && near.is_some() && !stop(false) {
            let (arranged, work) = self.on_strips(panels, &self.widths, false, &stop);
            return (arranged, work + found.1);
        }
        found
    }

    fn widest(&self) -> usize {
        self.widths.iter().copied().max().unwrap_or(1)
    }

    /// `stop` is told whether there is a layout already.
    fn on_strips(
        &self,
        panels: &[Arc<Panel>],
        widths: &[usize],
        near: bool,
        stop: &dyn Fn(bool) -> bool,
    ) -> (Option<Arrangement>, u64) {
        let raster = &self.raster;
        let of_piece = panels.iter().map(|p| p.shapes(raster)).collect();
        let shapes = Shapes { cell: raster.cell, gutter: 0, of_piece, pitch: raster.pitch };
        let area: f64 = panels.iter().map(|p| p.area).sum();
        let mut by_area: Vec<u32> = (0..panels.len() as u32).collect();
        by_area.sort_by(|&a, &b| panels[b as usize].area.total_cmp(&panels[a as usize].area).then(a.cmp(&b)));
        let longest = |p: u32| {
            let mask = &shapes.of_piece[p as usize][0].mask;
            mask.width.max(mask.height)
        };
        let mut by_side = by_area.clone();
        by_side.sort_by_key(|&p| std::cmp::Reverse(longest(p)));
        let mut best: Option<(f64, StripLayout)> = None;
        let mut work = 0;
        let plans = [(&by_area, RULES[0]), (&by_side, RULES[0]), (&by_area, RULES[1])];
        let count = match near {
            false => 3,
            true => 1 + usize::from(panels.len() <= MANY),
        };
        for (order, rule) in &plans[..count] {
            for &width in widths {
                let height = match &best {
                    Some((least, _)) => self.height_for(*least, width).min(self.height),
                    None => self.height,
                };
                let plan =
                    Plan { order: (*order).clone(), width, height, rule: *rule, partial: false, frontiers: false };
                let any = best.is_some();
                if stop(any) {
                    break;
                }
                let (layout, _) = greedy(&shapes, &plan, &|| stop(any));
                work += layout.work + 20 * panels.len() as u64;
                if !layout.left_over.is_empty() {
                    continue;
                }
                let cost = self.cost(&layout);
                if best.as_ref().is_none_or(|(least, _)| cost < *least) {
                    best = Some((cost, layout));
                }
            }
        }
        let arranged = best.map(|(cost, layout)| Arrangement {
            layout,
            efficiency: area / (cost * raster.cell * raster.cell).max(1e-300),
        });
        (arranged, work)
    }

    /// Cells of the sheet that holds a layout.
    fn cost(&self, layout: &StripLayout) -> f64 {
        let (w, h) = (layout.width as f64, layout.height as f64);
        match self.aspect {
            Some(aspect) => w.max(h * aspect) * h.max(w / aspect),
            None => w * h,
        }
    }

    /// The height at which a strip of this width costs so much.
    fn height_for(&self, cost: f64, width: usize) -> usize {
        match self.aspect {
            Some(aspect) => (cost / aspect).sqrt().ceil() as usize,
            // A strip need not be used in its whole width.
            None => (cost / width as f64 * 1.1).ceil() as usize,
        }
    }
}

impl Arrangement {
    /// The cells that the panels cover.
    pub fn taken(&self, panels: &[Arc<Panel>], raster: &Raster) -> Mask {
        let mut taken = Mask::new(self.layout.width, self.layout.height);
        for (panel, spot) in panels.iter().zip(&self.layout.spots) {
            if let Some(s) = spot {
                let shapes = panel.shapes(raster);
                taken.stamp(&shapes[s.orientation as usize].mask, s.x as usize, s.y as usize);
            }
        }
        taken
    }

    /// A line of the sheet, in cells, in the coordinates of a panel's chart.
    pub fn line(
        &self,
        panel: usize,
        panels: &[Arc<Panel>],
        raster: &Raster,
        point: DVec2,
        along: DVec2,
    ) -> Option<Line> {
        let spot = self.layout.spots[panel]?;
        let shapes = panels[panel].shapes(raster);
        let shape = &shapes[spot.orientation as usize];
        Some(to_chart(shape.linear, shape.anchor, (point - spot.corner()) * raster.cell, along))
    }
}
