//! Where to cut: lines along the sides of void boxes, global and local (Box Cutter, sections 3.1 and 3.2).

use glam::DVec2;
use rayon::prelude::*;

use super::lines::{OFFSETS, add_lengths, chords, offset, shifted};
use super::outline::{Chord, Line};
use super::panel::sides;
use super::params::Search;
use super::search::{SearchContext, SearchState};
use super::void::void_boxes;
use crate::packing::Random;

/// Lines that are cut together, by panel, in chart coordinates.
#[derive(Debug, Clone)]
pub(crate) struct Candidate {
    /// Index of the panel and its lines.
    pub lines: Vec<(usize, Vec<Line>)>,
}

/// So many panels offer one local box more.
const PANELS_A_BOX: usize = 12;

/// A line of the sheet: its place in each panel that it may cut.
type Placed = Vec<(usize, Line)>;

impl SearchState {
    /// The candidates of this state, global ones first: each void box offers its sides in one direction and in the other.
    pub fn candidates(&self, search: &SearchContext<'_>, random: &mut Random) -> Vec<Candidate> {
        let (global, local) = if search.params.search == Search::Random {
            (self.random_global(search, random), self.random_local(search, random))
        } else {
            (self.global(search), self.local(search))
        };
        global.into_par_iter().chain(local).filter_map(|(lines, reach)| self.offer(&lines, reach, search)).collect()
    }

    /// Lines of the global void boxes, each set with the texels that it may shift by.
    fn global(&self, search: &SearchContext<'_>) -> Vec<(Vec<Placed>, f64)> {
        let layout = &self.arrangement.layout;
        let taken = self.arrangement.taken(&self.panels, &search.sheet.raster);
        let boxes = void_boxes(
            &taken,
            layout.width,
            layout.height,
            search.params.void_boxes as usize,
            search.params.void_overlap,
        );
        boxes
            .iter()
            .flat_map(|b| sides(b, layout.width, layout.height).into_iter().enumerate())
            .map(|(direction, lines)| self.on_sheet(&lines, direction, search))
            .collect()
    }

    /// Lines of the sheet, horizontal (0) or vertical (1), in cells, in all panels.
    fn on_sheet(&self, lines: &[(DVec2, DVec2)], direction: usize, search: &SearchContext<'_>) -> (Vec<Placed>, f64) {
        let raster = &search.sheet.raster;
        let layout = &self.arrangement.layout;
        let across = [layout.height, layout.width][direction] as f64 * raster.cell;
        let place = |&(point, along): &(DVec2, DVec2)| {
            let own = |i: usize| Some((i, self.arrangement.line(i, &self.panels, raster, point, along)?));
            (0..self.panels.len()).filter_map(own).collect()
        };
        (lines.iter().map(place).collect(), search.params.line_shift * across)
    }

    /// Lines of the largest void boxes in the panels' own boxes, over all panels together.
    fn local(&self, search: &SearchContext<'_>) -> Vec<(Vec<Placed>, f64)> {
        let (raster, count) = (&search.sheet.raster, search.params.void_boxes as usize);
        let voids = |i: usize| self.panels[i].voids(raster, count, search.params.void_overlap);
        let own: Vec<Vec<(f64, usize, usize)>> = (0..self.panels.len())
            .into_par_iter()
            .map(|i| {
                let voids = if self.panels[i].cuttable() { voids(i) } else { &[] };
                voids.iter().enumerate().map(|(n, v)| (v.area, i, n)).collect()
            })
            .collect();
        let mut boxes: Vec<(f64, usize, usize)> = own.into_iter().flatten().collect();
        boxes.sort_by(|a, b| b.0.total_cmp(&a.0).then((a.1, a.2).cmp(&(b.1, b.2))));
        // Of many panels more, which the paper does not have.
        boxes.truncate(if search.is_beam() { count.max(self.panels.len() / PANELS_A_BOX) } else { count });
        let lines = |(_, i, n): (f64, usize, usize)| {
            let void = &voids(i)[n];
            [0, 1].map(|d| {
                (void.sides[d].iter().map(|l| vec![(i, *l)]).collect(), search.params.line_shift * void.across[d])
            })
        };
        boxes.into_iter().flat_map(lines).collect()
    }

    /// As many global lines as void boxes would offer, anywhere on the sheet.
    fn random_global(&self, search: &SearchContext<'_>, random: &mut Random) -> Vec<(Vec<Placed>, f64)> {
        let layout = &self.arrangement.layout;
        (0..2 * search.params.void_boxes as usize)
            .map(|n| {
                let at = |random: &mut Random| match n % 2 {
                    0 => (DVec2::new(0.0, random.unit() * layout.height as f64), DVec2::X),
                    _ => (DVec2::new(random.unit() * layout.width as f64, 0.0), DVec2::Y),
                };
                let lines: Vec<_> = (0..1 + random.below(2)).map(|_| at(random)).collect();
                self.on_sheet(&lines, n % 2, search)
            })
            .collect()
    }

    /// As many local lines as void boxes would offer, each in a panel chosen by area.
    fn random_local(&self, search: &SearchContext<'_>, random: &mut Random) -> Vec<(Vec<Placed>, f64)> {
        let area: f64 = self.panels.iter().map(|p| p.area).sum();
        (0..2 * search.params.void_boxes as usize)
            .filter_map(|n| {
                let mut rest = random.unit() * area;
                let i = self.panels.iter().position(|p| {
                    rest -= p.area;
                    rest < 0.0
                })?;
                let shapes = self.panels[i].shapes(&search.sheet.raster);
                let shape = shapes.first().filter(|_| self.panels[i].cuttable())?;
                let cell = search.sheet.raster.cell;
                let size = DVec2::new(shape.mask.width as f64, shape.mask.height as f64) * cell;
                let along = [DVec2::X, DVec2::Y][n % 2];
                let across = size.dot(along.perp().abs());
                let line = |random: &mut Random| {
                    let point = along.perp().abs() * across * random.unit();
                    vec![(i, super::panel::to_chart(shape.linear, shape.anchor, point, along))]
                };
                Some(((0..1 + random.below(2)).map(|_| line(random)).collect(), search.params.line_shift * across))
            })
            .collect()
    }

    /// The lines, each shifted to its best place, as one candidate.
    fn offer(&self, lines: &[Placed], reach: f64, search: &SearchContext<'_>) -> Option<Candidate> {
        let mut together: Vec<(usize, Vec<Line>)> = Vec::new();
        for line in lines {
            for (i, line) in self.best_shift(line, reach, search) {
                match together.iter_mut().find(|(j, _)| *j == i) {
                    Some((_, own)) => own.push(line),
                    None => together.push((i, vec![line])),
                }
            }
        }
        (!together.is_empty()).then_some(Candidate { lines: together })
    }

    /// The line shifted to where its cuts are shortest, of those places where it cuts anything (section 3.2, "Optimizing Cut Locations").
    fn best_shift(&self, line: &Placed, reach: f64, search: &SearchContext<'_>) -> Placed {
        let line: Placed = line.iter().copied().filter(|(i, _)| self.panels[*i].cuttable()).collect();
        let mut lengths = [0.0; OFFSETS];
        for (i, l) in &line {
            add_lengths(&self.panels[*i].outline, l, reach, &mut lengths);
        }
        if let Some(field) = &search.field {
            for (k, sum) in lengths.iter_mut().enumerate().filter(|(_, sum)| **sum > 0.0) {
                let weighted = |(i, l): &(usize, Line)| {
                    let l = shifted(l, offset(k, reach));
                    let own = self.panels[*i].outline.chords(&l);
                    own.iter().map(|c: &Chord| field.length(self.panels[*i].chart, &l, c.from, c.to)).sum::<f64>()
                };
                *sum = line.iter().map(weighted).sum();
            }
        }
        let mut order: Vec<usize> = (0..OFFSETS).filter(|&k| lengths[k] > 0.0).collect();
        order.sort_by(|&a, &b| {
            let off = |k: usize| offset(k, reach).abs();
            lengths[a].total_cmp(&lengths[b]).then(off(a).total_cmp(&off(b))).then(a.cmp(&b))
        });
        for k in order {
            let by = offset(k, reach);
            let cut: Placed = line
                .iter()
                .map(|(i, l)| (*i, shifted(l, by)))
                .filter(|(i, l)| !chords(&self.panels[*i].outline, l, search.least).is_empty())
                .collect();
            if !cut.is_empty() {
                return cut;
            }
        }
        Vec::new()
    }
}
