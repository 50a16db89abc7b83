//! What merging does to the topology of a chart: it must stay a part of the plane (section 4.1: genus 0, never closed).

use super::grid::{MixedMap, MixedSet};
use super::mesh::Mesh;
use crate::atlas::NONE;

/// Whether dissolving these pairs of border edges leaves a flat chart with a border. `within`: both sides are of one chart.
///
/// Each pair that becomes one edge either joins two loops or splits one. Loops of different charts are joined once; any further
/// joint makes a handle. Joints are counted from the number of loops before and after.
pub(super) fn stays_flat(mesh: &Mesh, zip: &[(u32, u32)], within: bool) -> bool {
    let charts = [mesh.chart(zip[0].0), mesh.chart(zip[0].1)];
    if !charts.iter().all(|&c| mesh.charts[c as usize].sound) {
        // Without loops there is no telling: what does not overlap itself is flat enough.
        return true;
    }
    let mut next: MixedMap<u32, u32> = MixedMap::default();
    let mut prev: MixedMap<u32, u32> = MixedMap::default();
    let mut loops = 0usize;
    for h in zip.iter().flat_map(|&(h, t)| [h, t]) {
        if next.contains_key(&h) {
            continue;
        }
        loops += 1;
        let mut e = h;
        while next.insert(e, mesh.next[e as usize]).is_none() {
            let to = mesh.next[e as usize];
            if to == NONE {
                return true;
            }
            prev.insert(to, e);
            e = to;
        }
    }
    let mut empty = 0usize;
    for &(h, t) in zip {
        let (Some(&hn), Some(&tn), Some(&hp), Some(&tp)) = (next.get(&h), next.get(&t), prev.get(&h), prev.get(&t))
        else {
            return false;
        };
        for e in [h, t] {
            next.remove(&e);
            prev.remove(&e);
        }
        // The two ends: of h, where t starts, and of t, where h starts.
        for (before, to, closes) in [(hp, tn, tn == h), (tp, hn, hn == t)] {
            if closes {
                empty += 1;
            } else {
                next.insert(before, to);
                prev.insert(to, before);
            }
        }
    }
    let mut seen: MixedSet<u32> = MixedSet::with_capacity_and_hasher(next.len(), Default::default());
    let mut left = 0usize;
    for &start in next.keys() {
        if !seen.insert(start) {
            continue;
        }
        left += 1;
        let mut e = next[&start];
        while seen.insert(e) {
            e = next[&e];
        }
    }
    let joints = (loops + zip.len()).saturating_sub(left + empty) / 2;
    left > 0 && joints == usize::from(!within)
}

#[cfg(test)]
mod tests;
