//! The search for cuts: candidates from void boxes, each executed and repacked, the best kept (Box Cutter, section 3.2).

use std::sync::Arc;

use glam::DVec2;
use rayon::prelude::*;

use super::arrange::{Arrangement, Sheet};
use super::lines::{OFFSETS, add_lengths, chords, offset, shifted};
use super::outline::Line;
use super::panel::{Panel, sides};
use super::void::void_boxes;

/// A cut that was made: chords of one line in a chart.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Cut {
    /// Number of the chart.
    pub chart: u32,
    /// In chart coordinates.
    pub line: Line,
    /// The parts of the line that were cut.
    pub chords: Vec<(f64, f64)>,
}

/// Panels, their layout, and how they came about.
#[derive(Debug, Clone)]
pub(crate) struct State {
    pub panels: Vec<Arc<Panel>>,
    pub arrangement: Arrangement,
    /// Total border length in texels.
    pub length: f64,
    /// The same, new cuts weighted by importance.
    pub weighted: f64,
    /// All cuts, in the order in which they were made.
    pub cuts: Vec<Cut>,
}

/// Lines to cut along, each with the panels that it may cut; the lines of one candidate are cut together.
#[derive(Debug, Clone)]
pub(crate) struct Candidate {
    /// By panel: its lines, in chart coordinates.
    pub lines: Vec<(usize, Vec<Line>)>,
}

/// Parameters of the search that candidates need.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Choice {
    /// Void boxes that offer candidates, globally and locally.
    pub boxes: usize,
    /// Fraction of a void box that a larger one may share.
    pub shared: f64,
    /// Lines shift within this fraction of the box's side.
    pub shift: f64,
    /// Smallest extent of a panel, in texels.
    pub least: f64,
    /// Whether each line and each panel is offered alone, too, which the paper does not do.
    pub more: bool,
}

impl State {
    /// The candidates of this state, global ones first (Box Cutter 3.1, 3.2).
    pub fn candidates(&self, sheet: &Sheet, choice: &Choice) -> Vec<Candidate> {
        let mut all = self.global(sheet, choice);
        all.extend(self.local(sheet, choice));
        all
    }

    fn global(&self, sheet: &Sheet, choice: &Choice) -> Vec<Candidate> {
        let raster = &sheet.raster;
        let layout = &self.arrangement.layout;
        let taken = self.arrangement.taken(&self.panels, raster);
        let boxes = void_boxes(&taken, layout.width, layout.height, choice.boxes, choice.shared);
        let extent = [layout.height as f64 * raster.cell, layout.width as f64 * raster.cell];
        let jobs: Vec<(usize, Vec<(DVec2, DVec2)>)> = boxes
            .iter()
            .flat_map(|b| sides(b, layout.width, layout.height).into_iter().enumerate())
            .filter(|(_, lines)| !lines.is_empty())
            .collect();
        jobs.into_par_iter()
            .flat_map_iter(|(direction, lines)| {
                let reach = choice.shift * extent[direction];
                // Of each line, its place in each panel.
                let placed: Vec<Vec<(usize, Line)>> = lines
                    .iter()
                    .map(|&(point, along)| {
                        let own = |i: usize| {
                            let line = self.arrangement.line(i, &self.panels, raster, point, along)?;
                            Some((i, line))
                        };
                        self.best_shift((0..self.panels.len()).filter_map(own).collect(), reach, choice)
                    })
                    .collect();
                offers(&placed, choice.more)
            })
            .collect()
    }

    fn local(&self, sheet: &Sheet, choice: &Choice) -> Vec<Candidate> {
        let raster = &sheet.raster;
        let own: Vec<Vec<(f64, usize, usize)>> = self
            .panels
            .par_iter()
            .enumerate()
            .map(|(i, p)| {
                let voids = if p.cuttable { p.voids(raster, choice.boxes, choice.shared) } else { &[] };
                voids.iter().enumerate().map(|(n, v)| (v.area, i, n)).collect()
            })
            .collect();
        let mut boxes: Vec<(f64, usize, usize)> = own.into_iter().flatten().collect();
        boxes.sort_by(|a, b| b.0.total_cmp(&a.0).then((a.1, a.2).cmp(&(b.1, b.2))));
        boxes.truncate(choice.boxes);
        boxes
            .into_par_iter()
            .flat_map_iter(|(_, i, n)| {
                let void = &self.panels[i].voids(raster, choice.boxes, choice.shared)[n];
                let mut offered = Vec::new();
                for (direction, lines) in void.sides.iter().enumerate() {
                    let reach = choice.shift * void.across[direction];
                    let placed: Vec<_> =
                        lines.iter().map(|line| self.best_shift(vec![(i, *line)], reach, choice)).collect();
                    offered.extend(offers(&placed, choice.more));
                }
                offered
            })
            .collect()
    }

    /// The line, given by its place in each panel, shifted to where its cuts are shortest, of those that cut anything; with
    /// the panels that are cut there.
    fn best_shift(&self, mut line: Vec<(usize, Line)>, reach: f64, choice: &Choice) -> Vec<(usize, Line)> {
        line.retain(|(i, _)| self.panels[*i].cuttable);
        let mut lengths = [0.0; OFFSETS];
        for (i, l) in &line {
            add_lengths(&self.panels[*i].outline, l, reach, &mut lengths);
        }
        let mut order: Vec<usize> = (0..OFFSETS).filter(|&k| lengths[k] > 0.0).collect();
        order.sort_by(|&a, &b| {
            let off = |k: usize| offset(k, reach).abs();
            lengths[a].total_cmp(&lengths[b]).then(off(a).total_cmp(&off(b))).then(a.cmp(&b))
        });
        for k in order {
            let by = offset(k, reach);
            let cut: Vec<(usize, Line)> = line
                .iter()
                .map(|(i, l)| (*i, shifted(l, by)))
                .filter(|(i, l)| !chords(&self.panels[*i].outline, l, choice.least).is_empty())
                .collect();
            if !cut.is_empty() {
                return cut;
            }
        }
        Vec::new()
    }

    /// Cuts the panels; `None` when nothing is cut. The arrangement is still the old one's.
    pub fn execute(&self, candidate: &Candidate, choice: &Choice, sheet: &Sheet) -> Option<State> {
        let mut next = self.clone();
        let mut added = Vec::new();
        let mut gone = vec![false; self.panels.len()];
        for (i, lines) in &candidate.lines {
            let panel = &self.panels[*i];
            let mut parts = vec![panel.outline.clone()];
            let mut cuts = Vec::new();
            for line in lines {
                let mut after = Vec::new();
                for part in parts {
                    let own = chords(&part, line, choice.least);
                    if own.is_empty() {
                        after.push(part);
                        continue;
                    }
                    let length: f64 = own.iter().map(|c| c.length()).sum();
                    next.length += 2.0 * length;
                    next.weighted += 2.0 * length;
                    after.extend(part.split(line, &own));
                    cuts.push(Cut { chart: panel.chart, line: *line, chords: own.iter().map(|c| (c.from, c.to)).collect() });
                }
                parts = after;
            }
            if cuts.is_empty() {
                continue;
            }
            gone[*i] = true;
            next.cuts.extend(cuts);
            added.extend(parts.into_iter().map(|o| {
                let area = o.area();
                Arc::new(Panel::new(panel.chart, o, area, true, sheet.raster.rotation))
            }));
        }
        if added.is_empty() {
            return None;
        }
        let mut keep = gone.iter().map(|g| !g);
        next.panels.retain(|_| keep.next().unwrap_or(true));
        next.panels.extend(added);
        Some(next)
    }

    /// The paper's score: s = p / b^alpha (section 3.2), b relative to `unit` texels.
    pub fn score(&self, unit: f64, alpha: f64) -> f64 {
        self.arrangement.efficiency / (self.weighted / unit).powf(alpha)
    }
}

/// The lines of one direction of a box as candidates: together, and where more are wanted each alone, and each in each panel alone.
fn offers(lines: &[Vec<(usize, Line)>], more: bool) -> Vec<Candidate> {
    let mut together: Vec<(usize, Vec<Line>)> = Vec::new();
    for (i, line) in lines.iter().flatten() {
        match together.iter_mut().find(|(j, _)| j == i) {
            Some((_, own)) => own.push(*line),
            None => together.push((*i, vec![*line])),
        }
    }
    let mut all = Vec::new();
    if more {
        let single = |line: &Vec<(usize, Line)>| Candidate { lines: line.iter().map(|(i, l)| (*i, vec![*l])).collect() };
        if lines.iter().filter(|l| !l.is_empty()).count() > 1 {
            all.extend(lines.iter().filter(|l| !l.is_empty()).map(single));
        }
        for line in lines.iter().filter(|l| l.len() > 1) {
            all.extend(line.iter().map(|(i, l)| Candidate { lines: vec![(*i, vec![*l])] }));
        }
    }
    if !together.is_empty() {
        all.push(Candidate { lines: together });
    }
    all
}
