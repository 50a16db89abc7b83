//! The outlines of charts in millimetres.

use glam::DVec2;

use crate::atlas::{Atlas, ChartId, Charts, FaceId, HalfEdge, Loops, Topology};

/// Where the border half edges of an Atlas lie, and what follows what.
pub(super) struct Outlines {
    /// Start of each half edge.
    start: Vec<DVec2>,
    /// By border half edge, the next and the previous of its loop; else none.
    pub next: Vec<Option<HalfEdge>>,
    pub previous: Vec<Option<HalfEdge>>,
    /// Area of each chart in square millimetres; above zero where its faces run clockwise on the sheet, which mirrors them.
    pub area: Vec<f64>,
}

impl Outlines {
    /// `scale` is millimetres by texel.
    pub fn new(atlas: &Atlas, charts: &Charts, loops: &Loops, scale: f64) -> Self {
        let start = atlas.corners.iter().flatten().map(|c| atlas.uv[c.index()] * scale).collect();
        let none = vec![None; 3 * atlas.face_count()];
        let (mut next, mut previous) = (none.clone(), none);
        for cycle in &loops.half_edges {
            for (i, h) in cycle.iter().enumerate() {
                let following = cycle[(i + 1) % cycle.len()];
                next[h.index()] = Some(following);
                previous[following.index()] = Some(*h);
            }
        }
        let area = |faces: &Vec<FaceId>| faces.iter().map(|f| atlas.uv_area(*f)).sum::<f64>() * scale * scale;
        Outlines { start, next, previous, area: charts.faces.iter().map(area).collect() }
    }

    /// Start and end of a half edge.
    pub fn ends(&self, h: HalfEdge) -> [DVec2; 2] {
        [self.start[h.index()], self.start[h.next().index()]]
    }

    /// The points of a closed loop.
    pub fn points(&self, cycle: &[HalfEdge]) -> Vec<DVec2> {
        cycle.iter().map(|h| self.start[h.index()]).collect()
    }

    /// The points of a run of half edges, its end included.
    pub fn line(&self, run: &[HalfEdge]) -> Vec<DVec2> {
        let end = run.last().map(|h| self.ends(*h)[1]);
        run.iter().map(|h| self.start[h.index()]).chain(end).collect()
    }

    /// What turns the direction of a border edge into the outward one: `outward * (d.y, -d.x)`.
    pub fn outward(&self, chart: ChartId) -> f64 {
        if self.area[chart.index()] < 0.0 { -1.0 } else { 1.0 }
    }
}

/// The unit vector that points away from the chart at an edge.
pub(super) fn normal([a, b]: [DVec2; 2], outward: f64) -> DVec2 {
    let d = (b - a).normalize_or_zero();
    DVec2::new(d.y, -d.x) * outward
}

/// The inner edges at which the surface turns by at least `angle`, each once, with its lower face.
pub(super) fn folds(atlas: &Atlas, topology: &Topology, scale: f64, angle: f64) -> Vec<(FaceId, [DVec2; 2])> {
    let unit = |f: FaceId| {
        let [a, b, c] = atlas.triangle(f);
        (b - a).cross(c - a).try_normalize()
    };
    let mut folds = Vec::new();
    for h in topology.half_edges() {
        let Some(twin) = topology.uv_twin(h).filter(|twin| h < *twin) else { continue };
        let (face, k) = (h.face(), h.corner());
        let (Some(m), Some(n)) = (unit(face), unit(twin.face())) else { continue };
        if m.cross(n).length().atan2(m.dot(n)) >= angle {
            let corners = atlas.uv_triangle(face);
            folds.push((face, [corners[k] * scale, corners[(k + 1) % 3] * scale]));
        }
    }
    folds
}
