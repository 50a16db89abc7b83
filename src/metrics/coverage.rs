//! How well the sheets are used: packing efficiency, utilisation, overlaps.

use rayon::prelude::*;

use super::boundary::page_boxes;
use super::measures::Totals;
use super::raster::{Bands, centre_spans};
use crate::atlas::{Atlas, Charts, Clusters, coverage};

pub(super) fn add(totals: &mut Totals, atlas: &Atlas, charts: &Charts, clusters: &Clusters) {
    totals.coverage = coverage(atlas, charts, clusters);
    totals.box_area = page_boxes(atlas).iter().map(|b| b.size().element_product()).sum();
    totals.texels = atlas.pixels();
    totals.texels_covered = (0..atlas.sheets.len()).map(|page| texels_covered(atlas, page)).sum();
}

/// Texels of a sheet whose centre lies in or on a triangle; `None` where counting would take too long.
fn texels_covered(atlas: &Atlas, page: usize) -> Option<u64> {
    let [width, height] = atlas.sheets[page];
    let bands = Bands::new(atlas, page, [width, height], 0)?;
    let words = (width as usize).div_ceil(64);
    let counts: Vec<u64> = bands
        .par_iter()
        .map(|band| {
            let mut bits = vec![0u64; words * band.height()];
            for triangle in band.triangles() {
                centre_spans(&triangle, &band.rows, width, |y, x0, x1| {
                    let row = (y - band.rows.start) as usize * words;
                    fill(&mut bits[row..row + words], x0 as usize, x1 as usize);
                });
            }
            bits.iter().map(|w| u64::from(w.count_ones())).sum()
        })
        .collect();
    Some(counts.iter().sum())
}

/// Sets the bits `from..to`.
fn fill(row: &mut [u64], from: usize, to: usize) {
    if from >= to {
        return;
    }
    let (first, last) = (from / 64, (to - 1) / 64);
    let head = u64::MAX << (from % 64);
    let tail = u64::MAX >> (63 - (to - 1) % 64);
    if first == last {
        row[first] |= head & tail;
    } else {
        row[first] |= head;
        row[first + 1..last].fill(u64::MAX);
        row[last] |= tail;
    }
}
