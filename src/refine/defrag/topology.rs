//! What merging does to the topology of a chart: it must stay planar (section 4.1: genus 0, never closed).

use super::mesh::MergeMesh;

/// No half edge.
const NONE: u32 = u32::MAX;

/// Memory for the boundary loops of charts while pairs of their edges are dissolved.
#[derive(Debug, Default)]
pub(super) struct BoundaryLoops {
    epoch: u32,
    /// (epoch, next, previous) by half edge.
    links: Vec<(u32, u32, u32)>,
    /// The half edges of the loops.
    walked: Vec<u32>,
}

impl BoundaryLoops {
    fn begin(&mut self, mesh: &MergeMesh) {
        // One number for what is there, one for what has been counted.
        self.epoch += 2;
        self.links.resize(mesh.half_edges().len(), (0, NONE, NONE));
        self.walked.clear();
    }

    fn contains(&self, h: u32) -> bool {
        self.links[h as usize].0 == self.epoch
    }

    /// Neighbours on the boundary: before, and after.
    fn neighbours(&self, h: u32) -> Option<(u32, u32)> {
        let (epoch, next, prev) = self.links[h as usize];
        (epoch == self.epoch).then_some((prev, next))
    }

    /// Whether dissolving these pairs of border edges leaves a planar chart with a boundary. `within`: both sides are of one chart.
    ///
    /// Each pair that becomes one edge either joins two loops or splits one. Loops of different charts are joined once; any further
    /// joint makes a handle. Joints are counted from the number of loops before and after.
    pub(super) fn stays_planar(&mut self, mesh: &MergeMesh, zip: &[(u32, u32)], within: bool) -> bool {
        let Some(loops) = self.walk(mesh, zip) else {
            // Without loops there is no telling: what does not overlap itself is planar enough.
            return true;
        };
        let Some(closed) = self.dissolve(zip) else { return false };
        let left = self.count();
        let joints = (loops + zip.len()).saturating_sub(left + closed) / 2;
        left > 0 && joints == usize::from(!within)
    }

    /// Takes in the loops of these edges and counts them; `None` where there are none.
    fn walk(&mut self, mesh: &MergeMesh, zip: &[(u32, u32)]) -> Option<usize> {
        let &(first, across) = zip.first()?;
        if ![first, across].iter().all(|&h| mesh.chart(mesh.chart_at(h)).manifold) {
            return None;
        }
        self.begin(mesh);
        let mut loops = 0;
        for h in zip.iter().flat_map(|&(h, t)| [h, t]) {
            if self.contains(h) {
                continue;
            }
            loops += 1;
            let mut e = h;
            loop {
                let to = mesh.next_on_border(e)?;
                let known = self.contains(to);
                self.links[e as usize] = (self.epoch, to, self.links[e as usize].2);
                self.links[to as usize] = (self.epoch, self.links[to as usize].1, e);
                self.walked.push(e);
                if known || to == h {
                    break;
                }
                e = to;
            }
        }
        Some(loops)
    }

    /// Takes the pairs out of the loops; gives how often a loop closed to nothing by that.
    fn dissolve(&mut self, zip: &[(u32, u32)]) -> Option<usize> {
        let mut closed = 0;
        for &(h, t) in zip {
            let ((h_prev, h_next), (t_prev, t_next)) = (self.neighbours(h)?, self.neighbours(t)?);
            for e in [h, t] {
                self.links[e as usize].0 = 0;
            }
            // The two ends: of h, where t starts, and of t, where h starts.
            for (before, to, closes) in [(h_prev, t_next, t_next == h), (t_prev, h_next, h_next == t)] {
                if closes {
                    closed += 1;
                } else {
                    self.links[before as usize].1 = to;
                    self.links[to as usize].2 = before;
                }
            }
        }
        Some(closed)
    }

    /// The loops that are left.
    fn count(&mut self) -> usize {
        let mut left = 0;
        for i in 0..self.walked.len() {
            let mut e = self.walked[i];
            left += usize::from(self.contains(e));
            while self.contains(e) {
                self.links[e as usize].0 = self.epoch + 1;
                e = self.links[e as usize].1;
            }
        }
        left
    }
}

#[cfg(test)]
mod tests;
