//! Cuts along mesh edges: the shortest path near a cut line, so that no triangle is split (Box Cutter, section 3.2, Fig. 10 and 11).

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};
use std::sync::Arc;

use glam::DVec2;

use super::outline::{Chord, Line, Outline, signed_area};
use crate::atlas::groups::{DisjointSets, sorted_unique};
use crate::atlas::seams::uv_length;
use crate::atlas::{FaceId, HalfEdge, Mesh, UvId};

/// Finds cuts along the edges of a mesh.
pub(crate) struct EdgeCutter<'a> {
    mesh: &'a Mesh,
    /// Importance at the corners of each face.
    weights: Option<&'a [[f64; 3]]>,
}

/// The triangles of a panel, and the edges inside it that are cut already.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Patch {
    /// Ascending.
    pub faces: Arc<Vec<FaceId>>,
    /// Both half edges of each.
    pub slits: Arc<BTreeSet<HalfEdge>>,
}

/// What a cut along edges makes of a panel.
pub(crate) struct Parts {
    /// Outlines and patches of the parts.
    pub parts: Vec<(Outline, Patch)>,
    /// The edges cut, one half edge each.
    pub cuts: Vec<HalfEdge>,
    /// Their length in texels, each once.
    pub length: f64,
    /// The same, times importance.
    pub weighted: f64,
}

/// A path longer than the chord by more than this factor is no cut along the line any more.
const DETOUR: f64 = 2.5;

impl<'a> EdgeCutter<'a> {
    /// Over a mesh whose edges have lengths in texels.
    pub fn new(mesh: &'a Mesh, weights: Option<&'a [[f64; 3]]>) -> Self {
        EdgeCutter { mesh, weights }
    }

    fn at(&self, u: UvId) -> DVec2 {
        self.mesh.position(u)
    }

    /// Length of an edge times the mean importance of its ends (section 3.2.2).
    fn weighted(&self, h: HalfEdge) -> f64 {
        let length = uv_length(self.mesh.atlas(), h);
        self.weights.map_or(length, |weights| {
            let own = weights[h.face().index()];
            length * (own[h.corner()] + own[h.end_corner()]) * 0.5
        })
    }

    /// The half edge across an edge that is interior to the patch.
    fn across(&self, patch: &Patch, h: HalfEdge) -> Option<HalfEdge> {
        let twin = self.mesh.topology().uv_twin(h)?;
        (!patch.slits.contains(&h) && patch.faces.binary_search(&twin.face()).is_ok()).then_some(twin)
    }

    /// Cuts the patch along paths that follow the chords; `None` when no path was found or a part is smaller than `least` across the line.
    pub fn cut(&self, outline: &Outline, patch: &Patch, line: &Line, chords: &[Chord], least: f64) -> Option<Parts> {
        let boundary = self.boundary_vertices(patch);
        let mut cuts: Vec<HalfEdge> = Vec::new();
        for chord in chords {
            // Of the two edges that the chord ends at, the nearer vertex first.
            let edges = chord.edges(outline);
            let nearer = |k: usize, t: f64| {
                let ((a, b), p) = (edges[k], line.at(t));
                if a.distance(p) <= b.distance(p) { [a, b] } else { [b, a] }
            };
            let ends = [nearer(0, chord.from), nearer(1, chord.to)];
            let vertex = |p: DVec2| boundary.iter().find(|u| self.at(**u) == p).copied();
            let tries = [(0, 0), (1, 0), (0, 1), (1, 1)];
            let path = tries.iter().find_map(|&(i, j)| {
                let (from, to) = (vertex(ends[0][i])?, vertex(ends[1][j])?);
                self.path(patch, from, to, DETOUR * chord.length().max(least))
            });
            cuts.extend(path?);
        }
        let mut slits = (*patch.slits).clone();
        for &h in &cuts {
            slits.insert(h);
            slits.extend(self.mesh.topology().uv_twin(h));
        }
        let parts = self.parts(patch, slits);
        let extent = |o: &Outline| o.loops.iter().flatten().map(|v| line.side(*v).abs()).fold(0.0, f64::max);
        if parts.len() > 1 && parts.iter().any(|(o, _)| extent(o) < least) {
            return None;
        }
        let length = cuts.iter().map(|&h| uv_length(self.mesh.atlas(), h)).sum();
        let weighted = cuts.iter().map(|&h| self.weighted(h)).sum();
        Some(Parts { parts, cuts, length, weighted })
    }

    /// UV vertices on the patch's border, ascending.
    fn boundary_vertices(&self, patch: &Patch) -> Vec<UvId> {
        let edges = patch.faces.iter().flat_map(|f| (0..3).map(|k| HalfEdge::of(*f, k)));
        sorted_unique(edges.filter(|&h| self.across(patch, h).is_none()).flat_map(|h| self.mesh.uv_ends(h)))
    }

    /// The shortest path over interior edges (A*), at most `limit` long, as half edges.
    fn path(&self, patch: &Patch, from: UvId, to: UvId, limit: f64) -> Option<Vec<HalfEdge>> {
        // Lengths are compared as bits: they are not negative.
        let mut best: BTreeMap<UvId, (f64, HalfEdge)> = BTreeMap::from([(from, (0.0, HalfEdge::NONE))]);
        let mut open = BinaryHeap::from([Reverse((0u64, from))]);
        let mut done: BTreeSet<UvId> = BTreeSet::new();
        let goal = self.at(to);
        while let Some(Reverse((_, u))) = open.pop() {
            if !done.insert(u) {
                continue;
            }
            if u == to {
                break;
            }
            let so_far = best[&u].0;
            for corner in self.mesh.corners_of(u) {
                if patch.faces.binary_search(&corner.face()).is_err() {
                    continue;
                }
                // The edge that leaves this corner and the one that arrives.
                for h in [corner, corner.previous()] {
                    let [a, b] = self.mesh.uv_ends(h);
                    let v = if a == u { b } else { a };
                    if v == u || done.contains(&v) || self.across(patch, h).is_none() {
                        continue;
                    }
                    let length = so_far + self.weighted(h);
                    if self.weights.is_none() && length + self.at(v).distance(goal) > limit {
                        continue;
                    }
                    if best.get(&v).is_none_or(|(l, _)| length < *l) {
                        best.insert(v, (length, h));
                        let ahead = if self.weights.is_none() { self.at(v).distance(goal) } else { 0.0 };
                        open.push(Reverse(((length + ahead).to_bits(), v)));
                    }
                }
            }
        }
        let mut path = Vec::new();
        let mut at = to;
        while at != from {
            let (_, h) = *best.get(&at).filter(|_| done.contains(&to))?;
            path.push(h);
            let [a, b] = self.mesh.uv_ends(h);
            at = if b == at { a } else { b };
        }
        Some(path)
    }

    /// The parts of a patch that is cut open along slits.
    pub fn parts(&self, patch: &Patch, slits: BTreeSet<HalfEdge>) -> Vec<(Outline, Patch)> {
        let whole = Patch { faces: patch.faces.clone(), slits: Arc::new(slits) };
        let index = |f: FaceId| whole.faces.binary_search(&f).ok();
        let mut sets = DisjointSets::new(whole.faces.len());
        for (i, &face) in whole.faces.iter().enumerate() {
            let twins = (0..3).filter_map(|k| self.across(&whole, HalfEdge::of(face, k)));
            twins.filter_map(|twin| index(twin.face())).for_each(|j| sets.unite(i as u32, j as u32));
        }
        let lots = sets.sets().into_iter().map(|own| own.into_iter().map(|i| whole.faces[i as usize]).collect());
        lots.map(|faces: Vec<FaceId>| {
            let own = |h: &HalfEdge| faces.binary_search(&h.face()).is_ok();
            let slits = whole.slits.iter().copied().filter(own).collect();
            let patch = Patch { faces: Arc::new(faces), slits: Arc::new(slits) };
            (self.outline(&patch), patch)
        })
        .collect()
    }

    /// The border of a patch, as loops.
    fn outline(&self, patch: &Patch) -> Outline {
        let mut seen = BTreeSet::new();
        let mut loops = Vec::new();
        for start in patch.faces.iter().flat_map(|f| (0..3).map(|k| HalfEdge::of(*f, k))) {
            let mut own = Vec::new();
            let mut h = start;
            while self.across(patch, h).is_none() && seen.insert(h) {
                own.push(self.at(self.mesh.uv_ends(h)[0]));
                h = h.next();
                // Around the end vertex to the next border edge; a fan has no more faces than the patch.
                for _ in 0..3 * patch.faces.len() {
                    let Some(twin) = self.across(patch, h) else { break };
                    h = twin.next();
                }
            }
            if own.len() > 1 {
                loops.push(own);
            }
        }
        let mut outline = Outline { loops };
        if outline.loops.iter().map(|l| signed_area(l)).sum::<f64>() < 0.0 {
            outline.loops.iter_mut().for_each(|l| l.reverse());
        }
        outline
    }
}
