//! The usual way to remove overlaps, as a measure for ours (Levy et al. 2002, section 4; compared in Box Cutter, Figure 16).

use super::graph::{self, Scale};
use super::grow;
use crate::atlas::{Atlas, Charts, Mesh};
use crate::context::Context;
use crate::error::Result;

/// What the usual method does with regions that lie over each other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outlines {
    /// Each becomes a chart: the chart is segmented along all outlines.
    All,
    /// The largest stays with the rest of the chart, if it can; the others become charts. The most lenient reading.
    AllButOne,
}

/// Cuts charts that overlap themselves along the outlines of the overlapping regions: the triangles that overlap others form
/// regions, bounded by the edges nearest to where the border of one sheet falls on the other, and
/// become charts of their own. A region that overlaps itself is grown apart. For tests and benchmarks only.
pub fn remove_overlaps_along_outlines(atlas: &Atlas, outlines: Outlines, context: &Context) -> Result<Atlas> {
    let mut mesh = Mesh::new(atlas.clone());
    let charts = Charts::new(mesh.topology());
    let scale = Scale::new(atlas, mesh.topology(), None);
    let mut of_face = vec![0u32; atlas.face_count()];
    for faces in &charts.faces {
        context.check()?;
        let pairs = graph::list_pairs(atlas, faces, context)?;
        if pairs.is_empty() {
            continue;
        }
        let graph = graph::build(&scale, faces, &pairs);
        let regions = regions(&graph);
        // 0 is what remains of the chart.
        let mut label: Vec<u32> = vec![u32::MAX; graph.len()];
        for v in 0..graph.len() as u32 {
            if graph.conflicts(v).is_empty() {
                label[v as usize] = 0;
            }
        }
        let mut next = 1;
        for region in regions {
            let own = |v: u32| region.binary_search(&v).is_ok();
            let meets = |label: &[u32], v: u32| graph.conflicts(v).iter().any(|&u| label[u as usize] == 0 || own(u));
            if outlines == Outlines::AllButOne && !region.iter().any(|&v| meets(&label, v)) {
                region.iter().for_each(|&v| label[v as usize] = 0);
                continue;
            }
            let inner: Vec<_> = region.iter().map(|&v| graph.faces[v as usize]).collect();
            let part = graph::build(&scale, &inner, &[]);
            let parts = grow::grow(atlas, &part, &mut 0, context)?;
            for (&v, l) in region.iter().zip(&parts) {
                label[v as usize] = next + l;
            }
            next += parts.iter().max().map_or(0, |m| m + 1);
        }
        for (f, l) in graph.faces.iter().zip(label) {
            of_face[f.index()] = l;
        }
    }
    super::cut_by_label(&mut mesh, &of_face);
    Ok(mesh.into_atlas())
}

/// The connected regions of overlapping triangles, each ascending; the largest first.
fn regions(graph: &graph::Graph) -> Vec<Vec<u32>> {
    let mut seen = vec![false; graph.len()];
    let mut regions = Vec::new();
    for seed in 0..graph.len() as u32 {
        if seen[seed as usize] || graph.conflicts(seed).is_empty() {
            continue;
        }
        seen[seed as usize] = true;
        let mut region = vec![seed];
        let mut head = 0;
        while let Some(&v) = region.get(head) {
            head += 1;
            for (w, _) in graph.near.neighbours(v) {
                if !graph.conflicts(w).is_empty() && !std::mem::replace(&mut seen[w as usize], true) {
                    region.push(w);
                }
            }
        }
        region.sort_unstable();
        regions.push(region);
    }
    regions.sort_by_key(|r| std::cmp::Reverse(r.len()));
    regions
}
