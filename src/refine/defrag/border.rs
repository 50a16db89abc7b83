//! What merging does to the topology of a chart: it must stay a part of the plane (section 4.1: genus 0, never closed).

use super::mesh::{Mesh, NONE};

/// Memory for the borders of charts while pairs of their edges are dissolved.
#[derive(Debug, Default)]
pub(super) struct Loops {
    epoch: u32,
    /// (epoch, next, previous) by half edge.
    links: Vec<(u32, u32, u32)>,
    /// The half edges of the loops.
    walked: Vec<u32>,
}

impl Loops {
    fn begin(&mut self, mesh: &Mesh) {
        // One number for what is there, one for what has been counted.
        self.epoch += 2;
        self.links.resize(mesh.link.len(), (0, NONE, NONE));
        self.walked.clear();
    }

    fn is_there(&self, h: u32) -> bool {
        self.links[h as usize].0 == self.epoch
    }

    /// Neighbours on the border: before, and after.
    fn about(&self, h: u32) -> Option<(u32, u32)> {
        let (epoch, next, prev) = self.links[h as usize];
        (epoch == self.epoch).then_some((prev, next))
    }

    /// Whether dissolving these pairs of border edges leaves a flat chart with a border. `within`: both sides are of one chart.
    ///
    /// Each pair that becomes one edge either joins two loops or splits one. Loops of different charts are joined once; any further
    /// joint makes a handle. Joints are counted from the number of loops before and after.
    pub(super) fn stays_flat(&mut self, mesh: &Mesh, zip: &[(u32, u32)], within: bool) -> bool {
        let charts = [mesh.chart(zip[0].0), mesh.chart(zip[0].1)];
        if !charts.iter().all(|&c| mesh.charts[c as usize].sound) {
            // Without loops there is no telling: what does not overlap itself is flat enough.
            return true;
        }
        self.begin(mesh);
        let mut loops = 0usize;
        for h in zip.iter().flat_map(|&(h, t)| [h, t]) {
            if self.is_there(h) {
                continue;
            }
            loops += 1;
            let mut e = h;
            loop {
                let to = mesh.next[e as usize];
                if to == NONE {
                    return true;
                }
                let known = self.is_there(to);
                self.links[e as usize] = (self.epoch, to, self.links[e as usize].2);
                self.links[to as usize] = (self.epoch, self.links[to as usize].1, e);
                self.walked.push(e);
                if known || to == h {
                    break;
                }
                e = to;
            }
        }
        let mut empty = 0usize;
        for &(h, t) in zip {
            let (Some((hp, hn)), Some((tp, tn))) = (self.about(h), self.about(t)) else { return false };
            for e in [h, t] {
                self.links[e as usize].0 = 0;
            }
            // The two ends: of h, where t starts, and of t, where h starts.
            for (before, to, closes) in [(hp, tn, tn == h), (tp, hn, hn == t)] {
                if closes {
                    empty += 1;
                } else {
                    self.links[before as usize].1 = to;
                    self.links[to as usize].2 = before;
                }
            }
        }
        let mut left = 0usize;
        for &start in &self.walked {
            if !self.is_there(start) {
                continue;
            }
            left += 1;
            let mut e = start;
            while self.is_there(e) {
                self.links[e as usize].0 = self.epoch + 1;
                e = self.links[e as usize].1;
            }
        }
        let joints = (loops + zip.len()).saturating_sub(left + empty) / 2;
        left > 0 && joints == usize::from(!within)
    }
}

#[cfg(test)]
mod tests;
