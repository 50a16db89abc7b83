//! The way out for charts with more overlapping pairs than can be listed: sheets grown one after the other, each until the next
//! triangle would overlap it. Needs no list of pairs; the cuts are longer than they could be.

use std::collections::VecDeque;

use super::graph::Graph;
use crate::atlas::Atlas;
use crate::atlas::dynamic_triangles::DynamicTriangleSet;
use crate::context::Context;
use crate::error::Result;

/// Labels under which no cluster overlaps itself.
pub(crate) fn grow(atlas: &Atlas, graph: &Graph, work: &mut u64, context: &Context) -> Result<Vec<u32>> {
    const NONE: u32 = u32::MAX;
    let mut label = vec![NONE; graph.len()];
    let mut next = 0;
    let mut looked = 0;
    // Where a sheet ended, the next one starts: so cuts are shared.
    let mut seeds: VecDeque<u32> = VecDeque::new();
    // Sheets in which a node was found not to fit, latest only: it is not asked twice by one sheet.
    let mut refused = vec![NONE; graph.len()];
    for first in 0..graph.len() as u32 {
        seeds.push_back(first);
        while let Some(seed) = seeds.pop_front() {
            if label[seed as usize] != NONE {
                continue;
            }
            let mut sheet = DynamicTriangleSet::default();
            let mut queue = VecDeque::from([seed]);
            while let Some(v) = queue.pop_front() {
                if label[v as usize] != NONE || refused[v as usize] == next {
                    continue;
                }
                let triangle = atlas.uv_triangle(graph.faces[v as usize]);
                let (hit, tests) = sheet.hits(&triangle, |_| true);
                looked += tests + 1;
                if looked > 1 << 16 {
                    context.check()?;
                    *work += std::mem::take(&mut looked);
                }
                if hit {
                    refused[v as usize] = next;
                    seeds.push_back(v);
                    continue;
                }
                sheet.add([triangle]);
                label[v as usize] = next;
                queue.extend(graph.near.neighbours(v).map(|n| n.0).filter(|&w| label[w as usize] == NONE));
            }
            next += 1;
        }
    }
    *work += looked;
    Ok(label)
}
