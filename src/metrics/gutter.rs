//! The gutter: free texels between the texels of two clusters.

use rayon::prelude::*;

use super::measures::SlotSize;
use super::raster::{Band, Bands, touched_spans};
use crate::atlas::{Atlas, Charts, Clusters};

/// Widest gutter that is looked for: the widest that can be asked for.
const WIDEST: u32 = 64;

/// Free texels between the closest touched texels of two clusters on one page (Chebyshev distance less one; 0 where they
/// meet or share a texel; at most 64), in the smallest slot that is not exempt, or on the sheet where there
/// are no slots. `None` where no page holds two clusters.
///
/// A texel is touched when a triangle enters it by more than 1/1000 of its side.
pub(super) fn of(atlas: &Atlas, charts: &Charts, clusters: &Clusters, slots: &[SlotSize]) -> Option<u32> {
    (0..atlas.sheets.len()).filter_map(|page| of_page(atlas, charts, clusters, slots, page)).min()
}

fn of_page(atlas: &Atlas, charts: &Charts, clusters: &Clusters, slots: &[SlotSize], page: usize) -> Option<u32> {
    let cluster = |f: crate::atlas::FaceId| clusters.of_chart[charts.of_face[f.index()].index()];
    let mut on_page = atlas.faces().filter(|f| usize::from(atlas.page[f.index()]) == page).map(cluster);
    let first = on_page.next()?;
    if on_page.all(|c| c == first) {
        return None;
    }
    let smallest = slots
        .iter()
        .filter(|s| usize::from(s.page) == page && !s.exempt)
        .map(|s| [s.width, s.height])
        .min_by_key(|s| u64::from(s[0]) * u64::from(s[1]));
    let size = smallest.unwrap_or(atlas.sheets[page]);
    let bands = Bands::new(atlas, page, size, i64::from(WIDEST))?;
    let gaps: Vec<u32> = bands.par_iter().map(|band| of_band(&band, size[0], cluster)).collect();
    gaps.into_iter().min()
}

const FREE: u32 = u32::MAX;

/// All clusters grow at once, a ring of texels at a time, until two meet: then the sum of their distances is the
/// smallest gap. (On the shortest way between the closest two texels some neighbours have different nearest clusters.)
fn of_band(band: &Band<'_>, width: u32, cluster: impl Fn(crate::atlas::FaceId) -> u32) -> u32 {
    let (w, h) = (width as usize, band.height());
    let mut label = vec![FREE; w * h];
    let mut shared = false;
    for &f in band.faces {
        let own = cluster(f);
        touched_spans(&band.triangle(f), &band.rows, width, |y, x0, x1| {
            let row = (y - band.rows.start) as usize * w;
            for texel in &mut label[row + x0 as usize..row + x1 as usize] {
                shared |= *texel != FREE && *texel != own;
                *texel = own;
            }
        });
        if shared {
            return 0;
        }
    }
    let mut best = WIDEST;
    let mut ring: Vec<u32> = (0..label.len() as u32)
        .filter(|&i| label[i as usize] != FREE && neighbours(i, w, h).any(|j| label[j as usize] != label[i as usize]))
        .collect();
    let mut distance = vec![0u8; label.len()];
    for grown in 0..WIDEST as u8 {
        let mut next = Vec::new();
        for &i in &ring {
            let own = label[i as usize];
            for j in neighbours(i, w, h) {
                let other = &mut label[j as usize];
                if *other == FREE {
                    *other = own;
                    distance[j as usize] = grown + 1;
                    next.push(j);
                } else if *other != own {
                    best = best.min(u32::from(grown) + u32::from(distance[j as usize]));
                }
            }
        }
        if next.is_empty() || best <= 2 * (u32::from(grown) + 1) {
            break;
        }
        ring = next;
    }
    best
}

fn neighbours(i: u32, w: usize, h: usize) -> impl Iterator<Item = u32> {
    let (x, y) = (i as usize % w, i as usize / w);
    let (x0, x1) = (x.saturating_sub(1), (x + 1).min(w - 1));
    (y.saturating_sub(1)..=(y + 1).min(h - 1)).flat_map(move |v| (x0..=x1).map(move |u| (v * w + u) as u32))
}
