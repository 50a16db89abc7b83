//! Charts while they are being welded.

use std::collections::BTreeMap;

use glam::DVec2;
use rayon::prelude::*;

use crate::atlas::forest::Forest;
use crate::atlas::rigid::Rigid;
use crate::atlas::seams::{RigidSeam, linked_corners};
use crate::atlas::{Atlas, ChartId, Charts, FaceId, HalfEdge, NONE, Topology, UvId, find_root};

/// An atlas under welding.
#[derive(Clone)]
pub(super) struct State {
    /// As welded so far. Every UV vertex belongs to one chart.
    pub atlas: Atlas,
    /// How near UV points count as one.
    pub tolerance: f64,
    /// Charts joined.
    pub welds: usize,
    /// Triangles tested.
    pub work: u64,
    /// By half edge: seams that start here cannot be welded.
    pub banned: Vec<bool>,
    uv_twin: Vec<HalfEdge>,
    surface_twin: Vec<HalfEdge>,
    /// Chart by face, under its name at the start.
    owner: Vec<u32>,
    /// Faces by chart; none once it has joined another.
    faces: Vec<Vec<FaceId>>,
    touchable: Vec<bool>,
    /// Chart by face at the start.
    home: Vec<u32>,
    /// By chart: the charts of the start that it is made of.
    parts: Vec<Vec<u32>>,
    /// By chart of the start: moved in this round.
    moved: Vec<bool>,
    /// By chart, made when needed.
    forests: Vec<Option<Forest>>,
    changed: bool,
}

impl State {
    pub(super) fn new(atlas: &Atlas, touchable: &dyn Fn(ChartId) -> bool, tolerance: f64) -> Self {
        let topology = Topology::new(atlas);
        let charts = Charts::new(&topology);
        let touchable: Vec<bool> = charts.ids().map(touchable).collect();
        let mut own = atlas.clone();
        own.separate_uvs(&charts);
        State {
            tolerance,
            welds: 0,
            work: 0,
            banned: vec![false; topology.uv_twin.len()],
            owner: charts.of_face.iter().map(|c| c.0).collect(),
            home: charts.of_face.iter().map(|c| c.0).collect(),
            parts: charts.ids().map(|c| vec![c.0]).collect(),
            forests: vec![None; charts.len()],
            moved: vec![false; charts.len()],
            faces: charts.faces,
            touchable,
            uv_twin: topology.uv_twin,
            surface_twin: topology.surface_twin,
            atlas: own,
            changed: false,
        }
    }

    /// The welded atlas, without UV vertices that became superfluous; the given one where nothing changed.
    pub(super) fn into_atlas(self, start: &Atlas) -> Atlas {
        if !self.changed {
            return start.clone();
        }
        let mut atlas = self.atlas;
        let mut used = vec![false; atlas.uv.len()];
        atlas.corners.iter().flatten().for_each(|c| used[c.index()] = true);
        let mut name = Vec::with_capacity(used.len());
        let mut uv = Vec::new();
        for (used, at) in used.iter().zip(&atlas.uv) {
            name.push(UvId::new(uv.len()));
            uv.extend(used.then_some(*at));
        }
        atlas.corners.iter_mut().flatten().for_each(|c| *c = name[c.index()]);
        atlas.uv = uv;
        atlas
    }

    /// Whether the chart of a face may be welded.
    pub(super) fn may_touch(&self, face: FaceId) -> bool {
        self.touchable[self.owner[face.index()] as usize]
    }

    /// Whether the seam was tried in vain.
    pub(super) fn is_banned(&self, seam: &RigidSeam) -> bool {
        seam.edges.iter().any(|&h| self.banned[h as usize])
    }

    /// Never try this seam again: what overlaps now overlaps also when the charts have grown.
    pub(super) fn ban(&mut self, seam: &RigidSeam) {
        // The middle, since ends may change when charts next to it are joined.
        self.banned[seam.edges[seam.edges.len() / 2] as usize] = true;
    }

    /// Forgets which charts moved.
    pub(super) fn start_round(&mut self) {
        self.moved.fill(false);
    }

    /// Joins the charts of a seam if they do not overlap then. A seam whose charts moved in this round is left for the next.
    pub(super) fn weld(&mut self, seam: &RigidSeam) -> bool {
        let h = seam.edges[0] as usize;
        let (a, b) = (self.owner[h / 3] as usize, self.owner[self.surface_twin[h] as usize / 3] as usize);
        let homes = [h / 3, self.surface_twin[h] as usize / 3].map(|f| self.home[f] as usize);
        if a == b || homes.iter().any(|&c| self.moved[c]) || self.uv_twin[h] != NONE {
            return false;
        }
        let (keep, go, motion) = if (self.faces[a].len(), b) >= (self.faces[b].len(), a) {
            (a, b, seam.motion)
        } else {
            (b, a, seam.motion.inverse())
        };
        let motion = self.settle(go, motion);
        let join = self.join(keep, go, &motion);
        if join.edges.is_empty() || self.overlaps(keep, go, &motion, &join) {
            self.ban(seam);
            return false;
        }
        self.commit(keep, go, &motion, join);
        true
    }

    /// A motion that moves nothing by more than rounding is none.
    fn settle(&self, chart: usize, motion: Rigid) -> Rigid {
        let still = |f: &FaceId| {
            let near = |p: &DVec2| motion.apply(*p).distance(*p) <= 1e-4 * self.tolerance;
            self.atlas.uv_triangle(*f).iter().all(near)
        };
        if self.faces[chart].iter().all(still) { Rigid::IDENTITY } else { motion }
    }

    /// What becomes one when chart `go` moves to chart `keep`: all their common seams that meet.
    fn join(&self, keep: usize, go: usize, motion: &Rigid) -> Join {
        let mut join = Join::default();
        let at = |u: UvId| self.atlas.uv[u.index()];
        for face in &self.faces[go] {
            for h in 3 * face.0..3 * face.0 + 3 {
                let twin = self.surface_twin[h as usize];
                let seam = self.uv_twin[h as usize] == NONE && twin != NONE && self.uv_twin[twin as usize] == NONE;
                if !seam || self.owner[twin as usize / 3] as usize != keep {
                    continue;
                }
                let ends = linked_corners(&self.atlas, h, twin);
                let meet =
                    |&(own, other): &(UvId, UvId)| motion.apply(at(own)).distance(at(other)) <= 2.0 * self.tolerance;
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
                join.edges.push((h, twin));
            }
        }
        join
    }

    /// Where a face of chart `go` comes to lie.
    fn moved_triangle(&self, face: FaceId, motion: &Rigid, join: &Join) -> [DVec2; 3] {
        self.atlas.corners[face.index()].map(|c| match join.to.get(&c) {
            Some(target) => self.atlas.uv[target.index()],
            None if *motion == Rigid::IDENTITY => self.atlas.uv[c.index()],
            None => motion.apply(self.atlas.uv[c.index()]),
        })
    }

    /// Whether the moved chart would overlap the other, or itself by rounding. Exact.
    fn overlaps(&mut self, keep: usize, go: usize, motion: &Rigid, join: &Join) -> bool {
        let fixed = self.forests[keep].take().unwrap_or_else(|| self.forest(keep));
        let new: Vec<[DVec2; 3]> = self.faces[go].iter().map(|&f| self.moved_triangle(f, motion, join)).collect();
        self.work += new.len() as u64;
        let mut bad = new.par_iter().with_min_len(256).any(|t| fixed.hits(t, |_| true).0);
        let exact = *motion == Rigid::IDENTITY
            && self.faces[go].iter().zip(&new).all(|(&f, t)| self.atlas.uv_triangle(f) == *t);
        if !bad && !exact {
            let turned = |f: FaceId, t: &[DVec2; 3]| {
                let old = self.atlas.uv_triangle(f);
                let sign = |t: &[DVec2; 3]| crate::atlas::orientation(t[0], t[1], t[2]);
                sign(&old) != sign(t)
            };
            let mut own = Forest::default();
            own.add(new.iter().copied());
            bad = self.faces[go].iter().zip(&new).any(|(&f, t)| turned(f, t))
                || new.par_iter().with_min_len(256).any(|t| own.hits(t, |o| o != t).0);
        }
        self.forests[keep] = Some(fixed);
        bad
    }

    fn forest(&self, chart: usize) -> Forest {
        let mut forest = Forest::default();
        forest.add(self.faces[chart].iter().map(|&f| self.atlas.uv_triangle(f)));
        forest
    }

    fn commit(&mut self, keep: usize, go: usize, motion: &Rigid, join: Join) {
        let faces = std::mem::take(&mut self.faces[go]);
        let new: Vec<[DVec2; 3]> = faces.iter().map(|&f| self.moved_triangle(f, motion, &join)).collect();
        let page = self.faces[keep].first().map_or(0, |f| self.atlas.page[f.index()]);
        for (face, triangle) in faces.iter().zip(&new) {
            for (corner, at) in self.atlas.corners[face.index()].iter_mut().zip(triangle) {
                match join.to.get(corner) {
                    Some(target) => *corner = *target,
                    None => self.atlas.uv[corner.index()] = *at,
                }
            }
            self.atlas.page[face.index()] = page;
            self.owner[face.index()] = keep as u32;
        }
        if !join.also.is_empty() {
            let mut name: Vec<u32> = (0..self.atlas.uv.len() as u32).collect();
            for (gone, kept) in &join.also {
                let (a, b) = (find_root(&mut name, gone.0), find_root(&mut name, kept.0));
                name[a.max(b) as usize] = a.min(b);
            }
            for face in self.faces[keep].iter().chain(&faces) {
                self.atlas.corners[face.index()].iter_mut().for_each(|c| *c = UvId(find_root(&mut name, c.0)));
            }
        }
        for (h, twin) in join.edges {
            self.uv_twin[h as usize] = twin;
            self.uv_twin[twin as usize] = h;
        }
        if let Some(forest) = &mut self.forests[keep] {
            forest.add(new);
        }
        self.forests[go] = None;
        self.faces[keep].extend(faces);
        let parts = std::mem::take(&mut self.parts[go]);
        if *motion != Rigid::IDENTITY {
            parts.iter().for_each(|&c| self.moved[c as usize] = true);
        }
        self.parts[keep].extend(parts);
        self.welds += 1;
        self.changed = true;
    }

    /// Closes seams within one chart whose two sides lie exactly on each other: nothing moves.
    pub(super) fn close_slits(&mut self) {
        let mut name: Vec<u32> = (0..self.atlas.uv.len() as u32).collect();
        let mut closed = Vec::new();
        for h in 0..self.uv_twin.len() as u32 {
            let twin = self.surface_twin[h as usize];
            if self.uv_twin[h as usize] != NONE || twin == NONE || twin < h || self.uv_twin[twin as usize] != NONE {
                continue;
            }
            let owner = self.owner[h as usize / 3];
            if owner != self.owner[twin as usize / 3] || !self.touchable[owner as usize] {
                continue;
            }
            let ends = linked_corners(&self.atlas, h, twin);
            if ends.iter().all(|&(a, b)| self.atlas.uv[a.index()] == self.atlas.uv[b.index()]) {
                for (a, b) in ends {
                    let (a, b) = (find_root(&mut name, a.0), find_root(&mut name, b.0));
                    name[a.max(b) as usize] = a.min(b);
                }
                closed.push((h, twin));
            }
        }
        for &(h, twin) in &closed {
            self.uv_twin[h as usize] = twin;
            self.uv_twin[twin as usize] = h;
        }
        if !closed.is_empty() {
            self.changed = true;
            self.atlas.corners.iter_mut().flatten().for_each(|c| *c = UvId(find_root(&mut name, c.0)));
        }
    }
}

/// What a weld makes one.
#[derive(Default)]
struct Join {
    /// UV vertices of the moving chart, and of the other one in whose place they come.
    to: BTreeMap<UvId, UvId>,
    /// UV vertices of the other chart that become one as well: (gone, kept), at the same point.
    also: Vec<(UvId, UvId)>,
    /// Edges that are closed.
    edges: Vec<(HalfEdge, HalfEdge)>,
}
