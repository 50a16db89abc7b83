//! The three local operations, what each would gain, and how they go on (sections 5.2 to 5.4).

use glam::DVec2;

use super::cut_map::{CutMap, Fan};
use super::stencil::Stencil;
use crate::atlas::{HalfEdge, UvId};
use crate::numeric::dirichlet::RestTriangle;

/// Weight of a void triangle in a query, in parts of the mean of the faces there.
const VOID_WEIGHT: f64 = 0.01;

/// A change of the topology.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Operation {
    /// A border vertex is split along an interior edge that leaves it.
    BoundarySplit(HalfEdge),
    /// An interior vertex is split along two edges that leave it.
    InteriorSplit(HalfEdge, HalfEdge),
    /// The seam that leaves a tip is closed by one edge.
    Merge(HalfEdge),
    /// A face with two seams in a row, of which this is the first, goes over to the other side: the seam takes the third edge, which is shorter.
    Ear(HalfEdge),
}

/// An operation and what it would change.
#[derive(Debug, Clone)]
pub(super) struct Candidate {
    pub operation: Operation,
    /// Change of E_s.
    pub seam: f64,
    /// Change of E_d with only the new vertices moved.
    pub energy: f64,
    /// Corners and where their UV vertices go once it is done.
    pub places: Vec<(HalfEdge, DVec2)>,
}

impl Candidate {
    /// d(o), eq. 9.
    pub fn gain(&self, lambda: f64) -> f64 {
        self.seam + lambda * self.energy
    }
}

/// A group of corners that become one free vertex.
struct Group<'a> {
    corners: &'a [HalfEdge],
    from: DVec2,
}

impl CutMap {
    /// The stencil of some groups of corners, each a free vertex. `None` where a face would be turned over.
    fn stencil(&self, groups: &[Group<'_>], start: &[DVec2], void: &[[Place; 3]]) -> Option<(Stencil, f64)> {
        let mut stencil = Stencil { x: start.to_vec(), free: groups.len(), ..Stencil::default() };
        let mut ids: Vec<UvId> = Vec::with_capacity(16);
        let mut faces: Vec<(crate::atlas::FaceId, [u8; 3])> = Vec::with_capacity(16);
        let mut before = 0.0;
        for (g, group) in groups.iter().enumerate() {
            for corner in group.corners {
                let face = corner.face();
                let at = match faces.iter().position(|(f, _)| *f == face) {
                    Some(at) => at,
                    None => {
                        before += self.rest[face.index()].energy(self.triangle(face));
                        faces.push((face, [u8::MAX; 3]));
                        faces.len() - 1
                    }
                };
                faces[at].1[corner.corner()] = g as u8;
            }
        }
        let local = |id: UvId, stencil: &mut Stencil, ids: &mut Vec<UvId>| {
            let k = ids.iter().position(|u| *u == id).unwrap_or_else(|| {
                ids.push(id);
                stencil.x.push(self.x[id.index()]);
                ids.len() - 1
            });
            (k + groups.len()) as u8
        };
        for (face, corners) in &mut faces {
            for (k, corner) in corners.iter_mut().enumerate().filter(|(_, c)| **c == u8::MAX) {
                *corner = local(self.mesh.uv_at(HalfEdge::of(*face, k)), &mut stencil, &mut ids);
            }
            stencil.elements.push((*corners, self.rest[face.index()]));
        }
        stencil.faces = stencil.elements.len();
        if !stencil.face_energy().is_finite() {
            return None;
        }
        let weight = VOID_WEIGHT * stencil.elements.iter().map(|e| e.1.weight).sum::<f64>() / stencil.faces as f64;
        if self.bijective {
            for t in void {
                let corners = t.map(|p| match p {
                    Place::Free(k) => k,
                    Place::Held(u) => local(u, &mut stencil, &mut ids),
                });
                if let Some(rest) = RestTriangle::new(corners.map(|k| stencil.x[k as usize]), weight) {
                    stencil.elements.push((corners, rest));
                } else if matches!(t, [Place::Free(_), Place::Free(_), _]) {
                    // Between the sides of a cut there must be a gap.
                    return None;
                }
            }
        }
        Some((stencil, before))
    }

    /// Pulls groups apart, each towards the middle of its own ring, far enough to leave a gap.
    fn pulled_apart(&self, groups: &[Group<'_>], part: f64) -> Vec<DVec2> {
        let towards = |group: &Group<'_>| {
            let ring =
                group.corners.iter().flat_map(|c| [c.next(), c.previous()]).map(|c| self.x[self.mesh.uv_at(c).index()]);
            let mean = ring.sum::<DVec2>() / (2 * group.corners.len()) as f64;
            group.from + part * (mean - group.from)
        };
        groups.iter().map(towards).collect()
    }

    fn solved(&self, operation: Operation, seam: f64, groups: &[Group<'_>], void: &[[Place; 3]]) -> Option<Candidate> {
        let mut part = 0.2;
        for _ in 0..6 {
            let start = self.pulled_apart(groups, part);
            if let Some((stencil, before)) = self.stencil(groups, &start, void) {
                return self.finished(operation, seam, groups, stencil, before);
            }
            part *= 0.3;
        }
        None
    }

    fn finished(
        &self,
        operation: Operation,
        seam: f64,
        groups: &[Group<'_>],
        mut stencil: Stencil,
        before: f64,
    ) -> Option<Candidate> {
        stencil.minimise();
        let energy = stencil.face_energy() - before;
        let places = groups.iter().zip(&stencil.x).map(|(g, x)| (g.corners[0], *x)).collect();
        energy.is_finite().then_some(Candidate { operation, seam, energy, places })
    }

    /// What an operation would change as things are now.
    pub fn query(&self, operation: Operation) -> Option<Candidate> {
        match operation {
            Operation::BoundarySplit(edge) => {
                let fan = self.fan(self.mesh.uv_at(edge));
                let at = fan.corners.iter().position(|c| *c == edge).filter(|k| *k > 0 && fan.open)?;
                self.boundary_split(&fan, at)
            }
            Operation::InteriorSplit(a, b) => {
                let fan = self.fan(self.mesh.uv_at(a));
                let at = |h: HalfEdge| fan.corners.iter().position(|c| *c == h);
                let (i, k) = (at(a)?, at(b)?);
                (!fan.open && i < k).then(|| self.interior_split(&fan, i, k))?
            }
            Operation::Merge(edge) => self.merge(self.mesh.uv_at(edge)),
            Operation::Ear(edge) => self.ear(edge),
        }
    }

    /// The ear that begins with a border half edge, if it does.
    pub fn ear(&self, first: HalfEdge) -> Option<Candidate> {
        let topology = self.mesh.topology();
        let (second, third) = (first.next(), first.previous());
        let (p, q) = (topology.across_seam(first)?, topology.across_seam(second)?);
        topology.uv_twin(third)?;
        // Across: the first edge runs from the middle to the start, the second from the end to the middle.
        let [middle, start] = self.mesh.uv_ends(p);
        let [end, other] = self.mesh.uv_ends(q);
        let seam = self.cost[third.index()] - self.cost[first.index()] - self.cost[second.index()];
        if middle != other || start == end || !seam.is_finite() {
            return None;
        }
        let face = first.face();
        let mut corners = [UvId(0); 3];
        corners[first.corner()] = start;
        corners[second.corner()] = middle;
        corners[third.corner()] = end;
        // Both sides may be of one chart, but not its own corners.
        if corners.iter().any(|u| self.mesh.atlas().corners[face.index()].contains(u)) {
            return None;
        }
        let rest = &self.rest[face.index()];
        let energy = rest.energy(corners.map(|u| self.x[u.index()])) - rest.energy(self.triangle(face));
        energy.is_finite().then_some(Candidate { operation: Operation::Ear(first), seam, energy, places: Vec::new() })
    }

    /// Splits along each interior edge that leaves a border vertex.
    pub fn boundary_splits(&self, uv: UvId, out: &mut Vec<Candidate>) {
        let fan = self.fan(uv);
        if !fan.open {
            return;
        }
        out.extend((1..fan.corners.len()).filter_map(|k| self.boundary_split(&fan, k)));
    }

    fn boundary_split(&self, fan: &Fan, k: usize) -> Option<Candidate> {
        let edge = fan.corners[k];
        let seam = self.cost[edge.index()];
        if !seam.is_finite() {
            return None;
        }
        let (v, w) = (self.mesh.uv_at(edge), self.end(edge));
        let from = self.x[v.index()];
        let (right, left) = fan.corners.split_at(k);
        let operation = Operation::BoundarySplit(edge);
        let before = Place::Held(self.mesh.uv_at(left[left.len() - 1].previous()));
        let after = Place::Held(self.end(right[0]));
        let (r, l) = (Place::Free(0), Place::Free(1));
        let mouth = [[r, l, before], [before, after, r]];
        if !self.is_border(w) {
            let groups = [Group { corners: right, from }, Group { corners: left, from }];
            let void = [[l, r, Place::Held(w)], mouth[0], mouth[1]];
            return self.solved(operation, seam, &groups, &void);
        }
        let twin = self.mesh.topology().uv_twin(edge)?;
        let across = self.fan(w);
        let at = across.corners.iter().position(|c| *c == twin)?;
        let (other_left, other_right) = across.corners.split_at(at);
        let far = self.x[w.index()];
        let groups = [
            Group { corners: right, from },
            Group { corners: left, from },
            Group { corners: other_right, from: far },
            Group { corners: other_left, from: far },
        ];
        if groups.iter().any(|g| g.corners.is_empty()) {
            return None;
        }
        let void = [[l, r, Place::Free(2)], [l, Place::Free(2), Place::Free(3)], mouth[0], mouth[1]];
        self.solved(operation, seam, &groups, &void)
    }

    /// Splits of an interior vertex along each pair of its edges, but for those whose far ends lie on a border.
    pub fn interior_splits(&self, uv: UvId, out: &mut Vec<Candidate>) {
        let fan = self.fan(uv);
        if fan.open {
            return;
        }
        let n = fan.corners.len();
        out.extend(
            (0..n).flat_map(|i| (i + 1..n).map(move |k| (i, k))).filter_map(|(i, k)| self.interior_split(&fan, i, k)),
        );
    }

    fn interior_split(&self, fan: &Fan, i: usize, k: usize) -> Option<Candidate> {
        let (a, b) = (fan.corners[i], fan.corners[k]);
        let seam = self.cost[a.index()] + self.cost[b.index()];
        if !seam.is_finite() || self.is_border(self.end(a)) || self.is_border(self.end(b)) {
            return None;
        }
        let from = self.x[self.mesh.uv_at(a).index()];
        let mut turned = fan.corners.clone();
        turned.rotate_left(i);
        let (upper, lower) = turned.split_at(k - i);
        let groups = [Group { corners: upper, from }, Group { corners: lower, from }];
        let (u, l) = (Place::Free(0), Place::Free(1));
        let void = [[u, l, Place::Held(self.end(a))], [l, u, Place::Held(self.end(b))]];
        self.solved(Operation::InteriorSplit(a, b), seam, &groups, &void)
    }

    /// The merge at a tip of a seam, where the UV vertex is one.
    pub fn merge(&self, tip: UvId) -> Option<Candidate> {
        let fan = self.fan(tip);
        let (out, back) = (*fan.corners.first()?, fan.corners.last()?.previous());
        if !fan.open || self.mesh.topology().surface_twin(out) != Some(back) {
            return None;
        }
        let (a, b) = (self.end(out), self.mesh.uv_at(back));
        if a == b {
            return None;
        }
        let (first, second) = (self.fan(a), self.fan(b));
        let (onward, arriving) = (*first.corners.first()?, second.corners.last()?.previous());
        let (next, before) = (self.end(onward), self.mesh.uv_at(arriving));
        let mut seam = -self.cost[out.index()];
        // The last vertex of a slit closes both of its edges.
        if next == before && self.mesh.topology().surface_twin(onward) == Some(arriving) {
            seam -= self.cost[onward.index()];
        }
        if next == before && !self.has_other_border(out, a, b) {
            return None;
        }
        let corners: Vec<HalfEdge> = first.corners.iter().chain(&second.corners).copied().collect();
        let from = self.x[a.index()].midpoint(self.x[b.index()]);
        let start = self.relaxed(&corners, from)?;
        let groups = [Group { corners: &corners, from }];
        let void = [[Place::Free(0), Place::Held(before), Place::Held(next)]];
        let (stencil, energy) = self.stencil(&groups, &[start], if next == before { &[] } else { &void })?;
        self.finished(Operation::Merge(out), seam, &groups, stencil, energy)
    }

    /// Whether the chart of a slit of two edges has another border.
    fn has_other_border(&self, slit: HalfEdge, a: UvId, b: UvId) -> bool {
        let topology = self.mesh.topology();
        let mut seen = vec![false; self.rest.len()];
        let mut queue = vec![slit.face()];
        while let Some(face) = queue.pop() {
            if std::mem::replace(&mut seen[face.index()], true) {
                continue;
            }
            for h in (0..3).map(|k| HalfEdge::of(face, k)) {
                match topology.uv_twin(h) {
                    Some(twin) => queue.push(twin.face()),
                    None if !self.mesh.uv_ends(h).iter().any(|u| *u == a || *u == b) => return true,
                    None => {}
                }
            }
        }
        false
    }

    /// A point from which all the corners' faces are seen from the right side, by relaxation (Agmon 1954).
    fn relaxed(&self, corners: &[HalfEdge], from: DVec2) -> Option<DVec2> {
        let mut at = from;
        for _ in 0..100 {
            let mut inside = true;
            for corner in corners {
                let (p, q) = (self.x[self.end(*corner).index()], self.x[self.mesh.uv_at(corner.previous()).index()]);
                let length = p.distance(q);
                if length == 0.0 {
                    return None;
                }
                let height = (q - p).perp_dot(at - p) / length;
                if height <= 1e-3 * length {
                    inside = false;
                    at += (q - p).perp() * ((0.05 * length - height) / length);
                }
            }
            if inside {
                return Some(at);
            }
        }
        None
    }

    /// Carries out an operation. Gives where it may go on: the vertices at its ends.
    pub fn apply(&mut self, candidate: &Candidate) -> Vec<UvId> {
        let tails = match candidate.operation {
            Operation::BoundarySplit(edge) => {
                let end = self.end(edge);
                let inner = !self.is_border(end);
                let twin = self.mesh.topology().uv_twin(edge);
                self.mesh.cut(&[edge]);
                self.borders.extend([Some(edge), twin].into_iter().flatten());
                if inner { vec![end] } else { Vec::new() }
            }
            Operation::InteriorSplit(a, b) => {
                let topology = self.mesh.topology();
                let sides = [Some(a), topology.uv_twin(a), Some(b), topology.uv_twin(b)];
                let ends = vec![self.end(a), self.end(b)];
                self.mesh.cut(&[a, b]);
                self.borders.extend(sides.into_iter().flatten());
                ends
            }
            Operation::Merge(edge) => {
                let corner = edge.next();
                self.mesh.weld(edge);
                let topology = self.mesh.topology();
                self.borders.retain(|h| topology.is_border(*h));
                vec![self.mesh.uv_at(corner)]
            }
            Operation::Ear(first) => {
                let (second, third) = (first.next(), first.previous());
                let [end, start] = [third, first].map(|c| (self.mesh.vertex_at(c), self.x[self.mesh.uv_at(c).index()]));
                let n = self.x.len();
                self.mesh.cut(&[third]);
                // The face or the rest got new vertices at its ends.
                for u in n..self.mesh.atlas().uv.len() {
                    let at = self.mesh.corners_of(UvId::new(u)).next().map(|c| self.mesh.vertex_at(c));
                    self.x.push(if at == Some(end.0) { end.1 } else { start.1 });
                }
                self.mesh.weld(first);
                self.mesh.weld(second);
                self.find_borders();
                (0..3).map(|k| self.mesh.uv_at(HalfEdge::of(first.face(), k))).collect()
            }
        };
        let uv = &self.mesh.atlas().uv;
        self.x.extend(uv[self.x.len()..].iter());
        for (corner, at) in &candidate.places {
            let uv = self.mesh.uv_at(*corner);
            self.x[uv.index()] = *at;
        }
        tails
    }

    /// How an operation can go on from the vertices at its ends.
    pub fn continued(&self, operation: Operation, tails: &[UvId]) -> Vec<Candidate> {
        let mut out = Vec::new();
        for &tail in tails {
            match operation {
                Operation::Merge(_) => out.extend(self.merge(tail)),
                Operation::Ear(_) => {}
                _ => self.boundary_splits(tail, &mut out),
            }
        }
        out
    }

    /// How much the gradients of the faces about a vertex differ: where they pull apart, a cut helps (section 5.3).
    pub fn deviation(&self, uv: UvId) -> f64 {
        let mut sum = DVec2::ZERO;
        let (mut squares, mut count) = (0.0, 0.0);
        for corner in self.mesh.corners_of(uv) {
            let face = corner.face();
            let g = self.rest[face.index()].gradient(self.triangle(face)).1[corner.corner()];
            sum += g;
            squares += g.length_squared();
            count += 1.0;
        }
        squares / count - (sum / count).length_squared()
    }
}

/// A corner of a void triangle.
#[derive(Debug, Clone, Copy)]
enum Place {
    Free(u8),
    Held(UvId),
}
