//! Charts while they are being welded.

use std::collections::BTreeMap;

use glam::DVec2;
use rayon::prelude::*;

use crate::atlas::dynamic_triangles::DynamicTriangleSet;
use crate::atlas::groups::{DisjointSets, sorted_unique};
use crate::atlas::rigid::{Rigid, back};
use crate::atlas::seams::RigidSeam;
use crate::atlas::{Atlas, ChartId, Charts, FaceId, HalfEdge, Mark, Mesh, UvId, orientation};

/// An atlas under welding.
pub(super) struct WeldState {
    /// As welded so far. Every UV vertex belongs to one chart.
    pub mesh: Mesh,
    /// How near UV points count as one.
    pub tolerance: f64,
    /// Triangles tested.
    pub work: u64,
    /// By half edge: seams that start here cannot be welded.
    banned: Vec<bool>,
    touchable: Vec<bool>,
    /// Chart by face at the start.
    home: Vec<u32>,
    charts: WeldedCharts,
}

/// What is known of charts, beside the mesh.
#[derive(Clone)]
struct WeldedCharts {
    /// Charts joined.
    welds: usize,
    /// Chart by face, under its name at the start.
    owner: Vec<u32>,
    /// Faces by chart; none once it has joined another.
    faces: Vec<Vec<FaceId>>,
    /// By chart: the charts of the start that it is made of.
    parts: Vec<Vec<u32>>,
    /// By chart of the start: moved in this round.
    moved: Vec<bool>,
    /// By chart, made when needed.
    triangles: Vec<Option<DynamicTriangleSet>>,
    changed: bool,
}

/// A state to go back to.
pub(super) struct Snapshot {
    mark: Mark,
    charts: WeldedCharts,
}

impl WeldState {
    pub(super) fn new(atlas: &Atlas, touchable: &dyn Fn(ChartId) -> bool, tolerance: f64) -> Self {
        let mut mesh = Mesh::new(atlas.clone());
        let charts = Charts::new(mesh.topology());
        let home: Vec<u32> = charts.of_face.iter().map(|c| c.0).collect();
        mesh.divide_by_chart(|f| home[f.index()]);
        WeldState {
            tolerance,
            work: 0,
            banned: vec![false; mesh.topology().len()],
            touchable: charts.ids().map(touchable).collect(),
            charts: WeldedCharts {
                welds: 0,
                owner: home.clone(),
                parts: charts.ids().map(|c| vec![c.0]).collect(),
                moved: vec![false; charts.len()],
                triangles: vec![None; charts.len()],
                faces: charts.faces,
                changed: false,
            },
            home,
            mesh,
        }
    }

    /// Charts joined so far.
    pub(super) fn welds(&self) -> usize {
        self.charts.welds
    }

    /// The welded atlas, without UV vertices that became superfluous; the given one where nothing changed.
    pub(super) fn into_atlas(self, start: &Atlas) -> Atlas {
        if self.charts.changed { self.mesh.into_atlas() } else { start.clone() }
    }

    /// The state as it is now; an earlier snapshot is not valid any more.
    pub(super) fn snapshot(&mut self) -> Snapshot {
        self.mesh.forget();
        Snapshot { mark: self.mesh.mark(), charts: self.charts.clone() }
    }

    /// Goes back; what was tried in vain, and the work done, is remembered.
    pub(super) fn restore(&mut self, snapshot: &Snapshot) {
        self.mesh.undo(snapshot.mark);
        self.charts = snapshot.charts.clone();
    }

    /// Whether the chart of a face may be welded.
    pub(super) fn may_touch(&self, face: FaceId) -> bool {
        self.touchable[self.charts.owner[face.index()] as usize]
    }

    /// Whether the seam was tried in vain.
    pub(super) fn is_banned(&self, seam: &RigidSeam) -> bool {
        seam.edges.iter().any(|&h| self.banned[h.index()])
    }

    /// Never try this seam again: what overlaps now overlaps also when the charts have grown.
    pub(super) fn ban(&mut self, seam: &RigidSeam) {
        // The middle, since ends may change when charts next to it are joined.
        self.banned[seam.edges[seam.edges.len() / 2].index()] = true;
    }

    /// Forgets which charts moved.
    pub(super) fn start_round(&mut self) {
        self.charts.moved.fill(false);
    }

    fn owner(&self, h: HalfEdge) -> usize {
        self.charts.owner[h.face().index()] as usize
    }

    /// Joins the charts of a seam if they do not overlap then. A seam whose charts moved in this round is left for the next.
    pub(super) fn weld(&mut self, seam: &RigidSeam) -> bool {
        let h = seam.edges[0];
        let Some(twin) = self.mesh.topology().across_seam(h) else { return false };
        let (a, b) = (self.owner(h), self.owner(twin));
        let moved = |h: HalfEdge| self.charts.moved[self.home[h.face().index()] as usize];
        if a == b || moved(h) || moved(twin) {
            return false;
        }
        let (keep, go, motion) = if (self.charts.faces[a].len(), b) >= (self.charts.faces[b].len(), a) {
            (a, b, seam.motion)
        } else {
            (b, a, back(&seam.motion))
        };
        let motion = self.settle(go, motion);
        let join = self.join(keep, go, &motion);
        if join.to.is_empty() || self.overlaps(keep, go, &motion, &join) {
            self.ban(seam);
            return false;
        }
        self.commit(keep, go, &motion, &join);
        true
    }

    /// A motion that moves nothing by more than rounding is none.
    fn settle(&self, chart: usize, motion: Rigid) -> Rigid {
        let still = |f: &FaceId| {
            let near = |p: &DVec2| motion.transform_point2(*p).distance(*p) <= 1e-4 * self.tolerance;
            self.mesh.atlas().uv_triangle(*f).iter().all(near)
        };
        if self.charts.faces[chart].iter().all(still) { Rigid::IDENTITY } else { motion }
    }

    /// What becomes one when chart `go` moves to chart `keep`: all their common seams that meet.
    fn join(&self, keep: usize, go: usize, motion: &Rigid) -> Join {
        let mut join = Join::default();
        let at = |u: UvId| self.mesh.position(u);
        for face in &self.charts.faces[go] {
            for h in (0..3).map(|k| HalfEdge::of(*face, k)) {
                let Some(twin) = self.mesh.topology().across_seam(h).filter(|twin| self.owner(*twin) == keep) else {
                    continue;
                };
                let ends = self.mesh.linked(h, twin);
                let meet = |&(own, other): &(UvId, UvId)| {
                    motion.transform_point2(at(own)).distance(at(other)) <= 2.0 * self.tolerance
                };
                // One vertex may close a slit of the larger chart if the slit is exactly shut.
                let agree = |&(own, other): &(UvId, UvId)| join.to.get(&own).is_none_or(|&t| at(t) == at(other));
                if !ends.iter().all(|e| meet(e) && agree(e)) {
                    continue;
                }
                for (own, other) in ends {
                    let target = *join.to.entry(own).or_insert(other);
                    if target != other {
                        join.also.push((other, target));
                    }
                }
            }
        }
        join
    }

    /// Where a face of chart `go` comes to lie.
    fn moved_triangle(&self, face: FaceId, motion: &Rigid, join: &Join) -> [DVec2; 3] {
        self.mesh.atlas().corners[face.index()].map(|c| match join.to.get(&c) {
            Some(target) => self.mesh.position(*target),
            None if *motion == Rigid::IDENTITY => self.mesh.position(c),
            None => motion.transform_point2(self.mesh.position(c)),
        })
    }

    /// Whether the moved chart would overlap the other, or itself by rounding. Exact.
    fn overlaps(&mut self, keep: usize, go: usize, motion: &Rigid, join: &Join) -> bool {
        let fixed = self.charts.triangles[keep].take().unwrap_or_else(|| self.triangles(keep));
        let faces = &self.charts.faces[go];
        let new: Vec<[DVec2; 3]> = faces.iter().map(|&f| self.moved_triangle(f, motion, join)).collect();
        self.work += new.len() as u64;
        let mut bad = new.par_iter().with_min_len(256).any(|t| fixed.hits(t, |_| true).0);
        let old = |f: FaceId| self.mesh.atlas().uv_triangle(f);
        let exact = *motion == Rigid::IDENTITY && faces.iter().zip(&new).all(|(&f, t)| old(f) == *t);
        if !bad && !exact {
            let sign = |t: &[DVec2; 3]| orientation(t[0], t[1], t[2]);
            let mut own = DynamicTriangleSet::default();
            own.add(new.iter().copied());
            bad = faces.iter().zip(&new).any(|(&f, t)| sign(&old(f)) != sign(t))
                || new.par_iter().with_min_len(256).any(|t| own.hits(t, |o| o != t).0);
        }
        self.charts.triangles[keep] = Some(fixed);
        bad
    }

    fn triangles(&self, chart: usize) -> DynamicTriangleSet {
        let mut set = DynamicTriangleSet::default();
        set.add(self.charts.faces[chart].iter().map(|&f| self.mesh.atlas().uv_triangle(f)));
        set
    }

    fn commit(&mut self, keep: usize, go: usize, motion: &Rigid, join: &Join) {
        let charts = &mut self.charts;
        let faces = std::mem::take(&mut charts.faces[go]);
        let page = charts.faces[keep].first().map_or(0, |f| self.mesh.atlas().page[f.index()]);
        let vertices: Vec<UvId> = sorted_unique(faces.iter().flat_map(|f| self.mesh.atlas().corners[f.index()]));
        if *motion != Rigid::IDENTITY {
            for u in vertices.into_iter().filter(|u| !join.to.contains_key(u)) {
                self.mesh.move_uv(u, motion.transform_point2(self.mesh.position(u)));
            }
        }
        for face in &faces {
            self.mesh.set_page(*face, page);
            charts.owner[face.index()] = keep as u32;
        }
        let mut fused: Vec<(UvId, UvId)> = join.to.iter().map(|(gone, kept)| (*gone, *kept)).collect();
        fused.extend(representatives(&join.also));
        self.mesh.fuse(&fused);
        if let Some(set) = &mut charts.triangles[keep] {
            set.add(faces.iter().map(|f| self.mesh.atlas().uv_triangle(*f)));
        }
        charts.triangles[go] = None;
        charts.faces[keep].extend(faces);
        let parts = std::mem::take(&mut charts.parts[go]);
        if *motion != Rigid::IDENTITY {
            parts.iter().for_each(|&c| charts.moved[c as usize] = true);
        }
        charts.parts[keep].extend(parts);
        charts.welds += 1;
        charts.changed = true;
    }

    /// Closes seams within one chart whose two sides lie exactly on each other: nothing moves.
    pub(super) fn close_slits(&mut self) {
        let mut same = Vec::new();
        for h in self.mesh.topology().half_edges() {
            let Some(twin) = self.mesh.topology().across_seam(h).filter(|twin| *twin > h) else { continue };
            let owner = self.owner(h);
            if owner != self.owner(twin) || !self.touchable[owner] {
                continue;
            }
            let ends = self.mesh.linked(h, twin);
            if ends.iter().all(|&(a, b)| self.mesh.position(a) == self.mesh.position(b)) {
                same.extend(ends);
            }
        }
        self.charts.changed |= !same.is_empty();
        self.mesh.fuse(&representatives(&same));
    }
}

/// What a weld makes one.
#[derive(Default)]
struct Join {
    /// UV vertices of the moving chart, and of the other one in whose place they come.
    to: BTreeMap<UvId, UvId>,
    /// UV vertices of the other chart that become one as well, at the same point.
    also: Vec<(UvId, UvId)>,
}

/// Each UV vertex that is one with others, with the lowest of them.
fn representatives(same: &[(UvId, UvId)]) -> Vec<(UvId, UvId)> {
    let all: Vec<UvId> = sorted_unique(same.iter().flat_map(|&(a, b)| [a, b]));
    let place = |u: UvId| all.partition_point(|x| *x < u) as u32;
    let mut sets = DisjointSets::new(all.len());
    same.iter().for_each(|&(a, b)| sets.unite(place(a), place(b)));
    let pairs = (0..).zip(&all).map(|(i, u)| (*u, all[sets.find(i) as usize]));
    pairs.filter(|(u, root)| u != root).collect()
}
