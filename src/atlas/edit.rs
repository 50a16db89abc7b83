//! Edits that keep provenance: moving charts, setting them apart, and giving each its own UV vertices.

use std::collections::BTreeMap;

use glam::{DMat2, DVec2};

use super::{Atlas, Charts, Topology, UvId};

/// Where a chart goes: `uv' = linear * uv + translate` on sheet `page`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Move {
    /// Sheet.
    pub page: u16,
    /// Rotation, mirror and scale.
    pub linear: DMat2,
    /// Translation in texels.
    pub translate: DVec2,
}

impl Atlas {
    /// Moves every chart as `of_chart` says and gives the Atlas new sheets. A UV vertex at which two charts touch becomes
    /// one for each.
    pub fn moved(&self, charts: &Charts, of_chart: &[Move], sheets: Vec<[u32; 2]>) -> Atlas {
        debug_assert_eq!(charts.len(), of_chart.len());
        let mut next = Atlas { sheets, uv: Vec::with_capacity(self.uv.len()), ..self.clone() };
        // (chart that the copy belongs to, copy) by UV vertex: the latest copy, valid while its chart is being moved.
        let mut copy = vec![(u32::MAX, UvId(0)); self.uv.len()];
        for (chart, faces) in charts.faces.iter().enumerate() {
            let m = of_chart[chart];
            for face in faces {
                next.page[face.index()] = m.page;
                for corner in &mut next.corners[face.index()] {
                    let slot = &mut copy[corner.index()];
                    if slot.0 != chart as u32 {
                        *slot = (chart as u32, UvId::new(next.uv.len()));
                        next.uv.push(m.linear * self.uv[corner.index()] + m.translate);
                    }
                    *corner = slot.1;
                }
            }
        }
        next
    }

    /// UV vertices at which two charts touch become one for each.
    pub(crate) fn separate_uvs(&mut self, charts: &Charts) {
        let mut first = vec![u32::MAX; self.uv.len()];
        let mut copies: BTreeMap<(UvId, u32), UvId> = BTreeMap::new();
        for (corners, chart) in self.corners.iter_mut().zip(&charts.of_face) {
            for corner in corners.iter_mut() {
                let home = &mut first[corner.index()];
                if *home == u32::MAX {
                    *home = chart.0;
                } else if *home != chart.0 {
                    *corner = *copies.entry((*corner, chart.0)).or_insert_with(|| {
                        self.uv.push(self.uv[corner.index()]);
                        UvId::new(self.uv.len() - 1)
                    });
                }
            }
        }
    }

    /// Moves the charts that hold a face of `moved` to places of their own beside the layout, by whole multiples of `step` texels: where they
    /// were, they would seem to share texels with others.
    pub(crate) fn set_apart(&self, moved: &[bool], step: f64) -> Atlas {
        let charts = Charts::new(&Topology::new(self));
        let points = || self.corners.iter().flatten().map(|u| self.uv[u.index()]).filter(|p| p.is_finite());
        let high = points().fold(DVec2::ZERO, DVec2::max);
        let mut x = (high.x / step).ceil() * step + step;
        let moves: Vec<_> = charts
            .faces
            .iter()
            .map(|faces| {
                let mut by = DVec2::ZERO;
                if faces.iter().any(|f| moved[f.index()]) {
                    let own = || faces.iter().flat_map(|f| self.uv_triangle(*f)).filter(|p| p.is_finite());
                    let low = own().fold(DVec2::INFINITY, DVec2::min);
                    let high = own().fold(DVec2::NEG_INFINITY, DVec2::max);
                    if low.is_finite() {
                        by = DVec2::new(x - (low.x / step).floor() * step, -(low.y / step).floor() * step);
                        x += ((high.x - low.x) / step).ceil() * step + 2.0 * step;
                    }
                }
                let page = faces.first().map_or(0, |f| self.page[f.index()]);
                Move { page, linear: DMat2::IDENTITY, translate: by }
            })
            .collect();
        self.moved(&charts, &moves, self.sheets.clone())
    }
}
