//! What is done to an Atlas as a whole: moving charts, setting them apart, taking a part out and putting several together.

use glam::{DMat2, DVec2};

use super::bvh::Bounds;
use super::groups::sorted_unique;
use super::{Atlas, Charts, FaceId, Provenance, Topology, UvId, VertexId};

/// Where a chart, or a piece of several, goes: `uv' = linear * uv + translate` on sheet `page`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Move {
    /// Sheet.
    pub page: u16,
    /// Rotation, mirror and scale.
    pub linear: DMat2,
    /// Translation in texels of the new sheet.
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

    /// Drops UV vertices that no face uses; the others keep their order.
    pub(crate) fn drop_unused_uvs(&mut self) {
        let mut used = vec![false; self.uv.len()];
        self.corners.iter().flatten().for_each(|c| used[c.index()] = true);
        if used.iter().all(|u| *u) {
            return;
        }
        let mut name = Vec::with_capacity(used.len());
        let mut uv = Vec::new();
        for (used, at) in used.iter().zip(&self.uv) {
            name.push(UvId::new(uv.len()));
            uv.extend(used.then_some(*at));
        }
        self.corners.iter_mut().flatten().for_each(|c| *c = name[c.index()]);
        self.uv = uv;
    }

    /// Some of the faces, in the order given, as an Atlas of their own. Vertices keep their order; provenance still names the whole's
    /// sources.
    pub(crate) fn subset(&self, faces: &[FaceId]) -> Atlas {
        let mut part = Atlas { sheets: self.sheets.clone(), ..Atlas::default() };
        let uvs = sorted_unique(faces.iter().flat_map(|f| self.corners[f.index()]));
        let vertices = sorted_unique(faces.iter().flat_map(|f| self.surface.triangles[f.index()]));
        part.uv = uvs.iter().map(|u| self.uv[u.index()]).collect();
        part.surface.positions = vertices.iter().map(|v| self.surface.positions[v.index()]).collect();
        for f in faces {
            let place = |u: UvId| UvId::new(uvs.partition_point(|x| *x < u));
            part.corners.push(self.corners[f.index()].map(place));
            let place = |v: VertexId| VertexId::new(vertices.partition_point(|x| *x < v));
            part.surface.triangles.push(self.surface.triangles[f.index()].map(place));
            part.provenance.push(self.provenance[f.index()]);
            part.page.push(self.page[f.index()]);
        }
        part
    }

    /// Adds all faces of another Atlas behind the own ones, its UVs moved by `shift`; no vertex becomes one with another. Provenance counts
    /// `first_source` and `first_primitive` on. Sheets stay the own ones.
    pub(crate) fn append(&mut self, other: &Atlas, shift: DVec2, first_source: usize, first_primitive: usize) {
        let (vertex, uv) = (self.surface.positions.len() as u32, self.uv.len() as u32);
        self.surface.positions.extend(&other.surface.positions);
        self.surface.triangles.extend(other.surface.triangles.iter().map(|t| t.map(|v| VertexId(v.0 + vertex))));
        self.uv.extend(other.uv.iter().map(|p| *p + shift));
        self.corners.extend(other.corners.iter().map(|t| t.map(|c| UvId(c.0 + uv))));
        self.provenance.extend(other.provenance.iter().map(|p| Provenance {
            source: FaceId::new(p.source.index() + first_source),
            primitive: p.primitive + first_primitive as u32,
            ..*p
        }));
        self.page.extend(&other.page);
    }

    /// Moves the charts that hold a face of `moved` to places of their own beside the layout, by whole multiples of `step` texels: where they
    /// were, they would seem to share texels with others.
    pub(crate) fn set_apart(&self, moved: &[bool], step: f64) -> Atlas {
        let charts = Charts::new(&Topology::new(self));
        let points = self.corners.iter().flatten().map(|u| self.uv[u.index()]).filter(|p| p.is_finite());
        let high = points.fold(DVec2::ZERO, DVec2::max);
        let mut x = (high.x / step).ceil() * step + step;
        let moves: Vec<_> = charts
            .faces
            .iter()
            .map(|faces| {
                let mut by = DVec2::ZERO;
                if faces.iter().any(|f| moved[f.index()]) {
                    let own = faces.iter().flat_map(|f| self.uv_triangle(*f)).filter(|p| p.is_finite());
                    let Bounds { min, max } = Bounds::around(own);
                    if min.is_finite() {
                        by = DVec2::new(x - (min.x / step).floor() * step, -(min.y / step).floor() * step);
                        x += ((max.x - min.x) / step).ceil() * step + 2.0 * step;
                    }
                }
                let page = faces.first().map_or(0, |f| self.page[f.index()]);
                Move { page, linear: DMat2::IDENTITY, translate: by }
            })
            .collect();
        self.moved(&charts, &moves, self.sheets.clone())
    }
}
