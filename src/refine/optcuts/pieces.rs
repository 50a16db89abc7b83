//! A surface as it comes, in pieces that can be flattened: connected, manifold, consistently wound, without degenerate faces.
//!
//! Nothing is repaired. Where a surface is not what the search can work on it is cut: faces hang together over an edge where two of
//! them run along it in opposite directions; of more than two at one edge those go together that bend least there. Faces that
//! are there twice stay apart. A vertex at which several fans of faces meet is one vertex for each of them.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use glam::{DVec2, DVec3};

use crate::atlas::groups::{Cost, DisjointSets};
use crate::atlas::{Atlas, Charts, FaceId, HalfEdge, Provenance, Surface, Topology, UvId, VertexId, seams};

/// Height over longest edge up to which a face has no area in double precision.
const SLIVER: f64 = 1e-12;
/// Faces at one edge beyond which no pairs are looked for.
const MOST_AT_AN_EDGE: usize = 64;
/// Faces of a piece at most, about: to flatten so many takes minutes and some hundred megabytes.
const LARGEST: usize = 150_000;
/// Room between charts that are laid out in a row, in units of the side of a square of their area.
const GAP: f64 = 0.1;

/// A part of a surface that can be flattened.
#[derive(Debug, Clone)]
pub(super) struct Piece {
    /// Its faces with vertices of their own. A layout, where there is one, has the unit of the surface, all charts face up and apart.
    pub atlas: Atlas,
    /// Its faces in the whole, ascending.
    pub faces: Vec<FaceId>,
    /// Its vertices in the whole. One with several fans of faces stands here several times.
    pub vertices: Vec<VertexId>,
    /// Units of the uploaded layout by unit of the surface.
    pub density: Option<f64>,
}

/// What stood in the way of one piece for each component.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Faults {
    /// Edges with more than two faces.
    pub non_manifold_edges: u64,
    /// Edges along which two faces run in the same direction.
    pub winding_edges: u64,
    /// Vertices at which several fans of faces meet, over their number of fans less one.
    pub doubled_vertices: u64,
    /// Components that are too large to be flattened at once.
    pub segmented: u64,
}

/// A surface divided into pieces.
#[derive(Debug, Clone)]
pub(super) struct Division {
    /// Faces of each piece, ascending; pieces by their first face.
    pub pieces: Vec<Vec<FaceId>>,
    /// By corner (three of each face): the fan of faces that it belongs to.
    fan: Vec<u32>,
    /// By half edge: the one across in the same piece, or none.
    across: Vec<HalfEdge>,
    /// Why it is cut.
    pub faults: Faults,
}

/// Whether a face has no area.
pub(super) fn is_degenerate([a, b, c]: [DVec3; 3]) -> bool {
    let longest = (b - a).length_squared().max((c - b).length_squared()).max((a - c).length_squared());
    let area = (b - a).cross(c - a).length();
    // Not a number is no area either.
    !(area > SLIVER * longest && area > 0.0 && area.is_finite())
}

/// Divides those faces of a surface that are `wanted`. None of these may be degenerate.
pub(super) fn divide(atlas: &Atlas, wanted: &[bool]) -> Division {
    let mut faults = Faults::default();
    let mut across = join_faces(atlas, wanted, &mut faults);
    faults.segmented = segment(atlas, &mut across, LARGEST);
    let fan = loop {
        let fan = fans(atlas, &across);
        let misfits = misfits(&fan, wanted);
        if misfits.is_empty() {
            break fan;
        }
        // What does not fit in with others goes by itself.
        for h in misfits.into_iter().flat_map(|f| [0, 1, 2].map(|k| HalfEdge::of(f, k))) {
            if let Some(twin) = std::mem::replace(&mut across[h.index()], HalfEdge::NONE).some() {
                across[twin.index()] = HalfEdge::NONE;
            }
        }
    };
    let mut sets = DisjointSets::new(atlas.face_count());
    for (h, twin) in across.iter().enumerate().filter(|(_, twin)| **twin != HalfEdge::NONE) {
        sets.unite(h as u32 / 3, twin.face().0);
    }
    let all = sets.sets().into_iter().filter(|own| wanted[own[0] as usize]);
    let pieces = all.map(|own| own.into_iter().map(FaceId).collect()).collect();
    faults.doubled_vertices = doubled(atlas, &fan, wanted);
    Division { pieces, fan, across, faults }
}

/// Cuts components of more than `largest` faces into compact regions of about that size: the memory and the time of flattening grow faster than the
/// number of faces. Gives how many were cut.
///
/// Regions grow from faces that are far from each other (farthest point sampling, then nearest seed, along the surface from face to face).
fn segment(atlas: &Atlas, across: &mut [HalfEdge], largest: usize) -> u64 {
    let mut sets = DisjointSets::new(atlas.face_count());
    for (h, twin) in across.iter().enumerate().filter(|(_, twin)| **twin != HalfEdge::NONE) {
        sets.unite(h as u32 / 3, twin.face().0);
    }
    let large: Vec<Vec<u32>> = sets.sets().into_iter().filter(|own| own.len() > largest).collect();
    if large.is_empty() {
        return 0;
    }
    let middle = |f: u32| atlas.triangle(FaceId(f)).iter().sum::<DVec3>() / 3.0;
    let mut region = vec![0u32; atlas.face_count()];
    let mut distance = vec![f64::INFINITY; atlas.face_count()];
    let count = large.len() as u64;
    for own in large {
        let mut seed = own[0];
        for number in 0..=own.len().div_ceil(largest) as u32 {
            // The first only finds an end of the surface.
            if number == 1 {
                own.iter().for_each(|f| distance[*f as usize] = f64::INFINITY);
            }
            distance[seed as usize] = 0.0;
            region[seed as usize] = number;
            let mut heap = BinaryHeap::from([Reverse((Cost(0.0), seed))]);
            while let Some(Reverse((Cost(d), f))) = heap.pop() {
                if d > distance[f as usize] {
                    continue;
                }
                for twin in [0, 1, 2].map(|k| across[HalfEdge::of(FaceId(f), k).index()]) {
                    let Some(g) = twin.some().map(|t| t.face().0) else { continue };
                    let to = d + middle(f).distance(middle(g));
                    if to < distance[g as usize] {
                        distance[g as usize] = to;
                        region[g as usize] = number;
                        heap.push(Reverse((Cost(to), g)));
                    }
                }
            }
            seed = own.iter().copied().max_by_key(|f| (Cost(distance[*f as usize]), Reverse(*f))).unwrap_or(seed);
        }
    }
    for h in 0..across.len() {
        let Some(twin) = across[h].some() else { continue };
        if region[h / 3] != region[twin.face().index()] {
            across[h] = HalfEdge::NONE;
            across[twin.index()] = HalfEdge::NONE;
        }
    }
    count
}

/// By half edge: the one that its face goes on over.
fn join_faces(atlas: &Atlas, wanted: &[bool], faults: &mut Faults) -> Vec<HalfEdge> {
    let triangles = &atlas.surface.triangles;
    let mut across = vec![HalfEdge::NONE; 3 * triangles.len()];
    let ends = |h: HalfEdge| [h.corner(), h.end_corner()].map(|k| triangles[h.face().index()][k]);
    let mut keys: Vec<(VertexId, VertexId, bool, HalfEdge)> = (0..3 * triangles.len())
        .map(HalfEdge::new)
        .filter(|h| wanted[h.face().index()])
        .map(|h| (ends(h), h))
        .map(|([a, b], h)| (a.min(b), a.max(b), a > b, h))
        .collect();
    keys.sort_unstable();
    let vertices = |h: HalfEdge| {
        let mut own = triangles[h.face().index()];
        own.sort_unstable();
        own
    };
    let normal = |h: HalfEdge| {
        let [a, b, c] = atlas.triangle(h.face());
        (b - a).cross(c - a).normalize_or_zero()
    };
    for run in keys.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)) {
        let twice = |a: HalfEdge, b: HalfEdge| vertices(a) == vertices(b);
        let mut join = |a: HalfEdge, b: HalfEdge| (across[a.index()], across[b.index()]) = (b, a);
        match *run {
            [_] => {}
            [a, b] if a.2 != b.2 => {
                if !twice(a.3, b.3) {
                    join(a.3, b.3);
                }
            }
            [_, _] => faults.winding_edges += 1,
            _ => {
                faults.non_manifold_edges += 1;
                if run.len() > MOST_AT_AN_EDGE {
                    continue;
                }
                let (up, down): (Vec<_>, Vec<_>) = run.iter().map(|k| (k.2, k.3)).partition(|k| !k.0);
                let mut pairs: Vec<(f64, HalfEdge, HalfEdge)> = Vec::new();
                for (a, b) in up.iter().flat_map(|a| down.iter().map(|b| (a.1, b.1))) {
                    if !twice(a, b) {
                        pairs.push((normal(a).dot(normal(b)), a, b));
                    }
                }
                // The smoothest first.
                pairs.sort_by(|p, q| q.0.total_cmp(&p.0).then((p.1, p.2).cmp(&(q.1, q.2))));
                let mut taken: Vec<HalfEdge> = Vec::new();
                for (_, a, b) in pairs {
                    if !taken.contains(&a) && !taken.contains(&b) {
                        taken.extend([a, b]);
                        join(a, b);
                    }
                }
            }
        }
    }
    across
}

/// By corner: the least corner of its fan, the corners at one vertex of faces that hang together there.
fn fans(atlas: &Atlas, across: &[HalfEdge]) -> Vec<u32> {
    let corner = |h: HalfEdge, k: usize| 3 * h.face().0 + k as u32;
    let mut sets = DisjointSets::new(3 * atlas.face_count());
    for (h, twin) in across.iter().enumerate().filter(|(_, twin)| **twin != HalfEdge::NONE) {
        let h = HalfEdge::new(h);
        sets.unite(corner(h, h.corner()), corner(*twin, twin.end_corner()));
        sets.unite(corner(h, h.end_corner()), corner(*twin, twin.corner()));
    }
    (0..3 * atlas.face_count() as u32).map(|c| sets.find(c)).collect()
}

/// Faces that share an edge, told by the fans at its ends, with more than one other, or with one that runs the same way.
fn misfits(fan: &[u32], wanted: &[bool]) -> Vec<FaceId> {
    let at = |h: HalfEdge, k: usize| fan[3 * h.face().index() + k];
    let mut keys: Vec<(u32, u32, HalfEdge, bool)> = (0..fan.len())
        .map(HalfEdge::new)
        .filter(|h| wanted[h.face().index()])
        .map(|h| (at(h, h.corner()), at(h, h.end_corner()), h))
        .map(|(a, b, h)| (a.min(b), a.max(b), h, a > b))
        .collect();
    keys.sort_unstable();
    let mut found = Vec::new();
    for run in keys.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)) {
        let fits = |n: usize| n == 0 || n == 1 && run[0].3 != run[1].3;
        found.extend((0..run.len()).filter(|n| !fits(*n)).map(|n| run[n].2.face()));
    }
    found.sort_unstable();
    found.dedup();
    found
}

/// Fans that meet others at their vertex.
fn doubled(atlas: &Atlas, fan: &[u32], wanted: &[bool]) -> u64 {
    let mut fans = vec![0u64; atlas.surface.positions.len()];
    for (corner, own) in fan.iter().enumerate().filter(|(c, own)| **own == *c as u32 && wanted[c / 3]) {
        debug_assert_eq!(*own as usize, corner);
        fans[atlas.surface.triangles[corner / 3][corner % 3].index()] += 1;
    }
    fans.iter().map(|n| n.saturating_sub(1)).sum()
}

impl Division {
    /// The pieces. Where `layout` has UVs for a piece, they are its start.
    pub(super) fn build(&self, atlas: &Atlas, layout: &dyn Fn(&[FaceId]) -> bool) -> Vec<Piece> {
        let mut vertex = vec![u32::MAX; self.fan.len()];
        let mut out = Vec::with_capacity(self.pieces.len());
        for faces in &self.pieces {
            let mut vertices = Vec::new();
            let mut surface = Surface::default();
            for &f in faces {
                let triangle = [0, 1, 2].map(|k| {
                    let own = &mut vertex[self.fan[3 * f.index() + k] as usize];
                    if *own == u32::MAX {
                        *own = vertices.len() as u32;
                        let v = atlas.surface.triangles[f.index()][k];
                        vertices.push(v);
                        surface.positions.push(atlas.surface.positions[v.index()]);
                    }
                    VertexId(*own)
                });
                surface.triangles.push(triangle);
            }
            let n = faces.len();
            let piece = Atlas {
                surface,
                uv: Vec::new(),
                corners: vec![[Atlas::NO_UV; 3]; n],
                provenance: (0..n).map(|f| Provenance::whole(FaceId::new(f), 0)).collect(),
                page: vec![0; n],
                sheets: vec![[1, 1]],
            };
            let mut piece = Piece { atlas: piece, faces: faces.clone(), vertices, density: None };
            if layout(faces) {
                self.lay_out(atlas, &mut piece);
            }
            out.push(piece);
        }
        out
    }

    /// Gives a piece the UVs of the whole, in the unit of its surface: at the scale at which they distort least.
    fn lay_out(&self, atlas: &Atlas, piece: &mut Piece) {
        let local = |f: FaceId| piece.faces.partition_point(|own| *own < f);
        let mut sets = DisjointSets::new(3 * piece.faces.len());
        for (i, &f) in piece.faces.iter().enumerate() {
            for h in [0, 1, 2].map(|k| HalfEdge::of(f, k)) {
                let Some(twin) = self.across[h.index()].some() else { continue };
                let uv = |h: HalfEdge, k: usize| atlas.corners[h.face().index()][k];
                let g = local(twin.face());
                let pairs = [(h.corner(), twin.end_corner()), (h.end_corner(), twin.corner())];
                if pairs.iter().all(|&(k, l)| uv(h, k) == uv(twin, l)) {
                    pairs.iter().for_each(|&(k, l)| sets.unite((3 * i + k) as u32, (3 * g + l) as u32));
                }
            }
        }
        let (of_corner, corners) = sets.numbered();
        let place = |c: u32| atlas.uv[atlas.corners[piece.faces[c as usize / 3].index()][c as usize % 3].index()];
        // Texels run down.
        piece.atlas.uv = corners.iter().map(|own| place(own[0]) * DVec2::new(1.0, -1.0)).collect();
        piece.atlas.corners = of_corner.chunks_exact(3).map(|c| [c[0], c[1], c[2]].map(UvId)).collect();
        let strain = Strain::of(&piece.atlas);
        let scale = strain.best_scale();
        piece.density = Some(scale.recip());
        face_up(&mut piece.atlas, scale);
    }
}

/// Scales a layout, mirrors the charts that face down, and sets the charts apart.
pub(super) fn face_up(atlas: &mut Atlas, scale: f64) {
    let charts = Charts::new(&Topology::new(atlas));
    let area: f64 = atlas.faces().map(|f| atlas.uv_area(f).abs()).sum();
    let gap = GAP * area.sqrt() * scale;
    let mut chart_of = vec![0; atlas.uv.len()];
    for (f, corners) in atlas.corners.iter().enumerate() {
        corners.iter().for_each(|c| chart_of[c.index()] = charts.of_face[f].index());
    }
    let area = |faces: &Vec<FaceId>| faces.iter().map(|f| atlas.uv_area(*f)).sum::<f64>();
    let mirror: Vec<f64> = charts.faces.iter().map(|faces| if area(faces) < 0.0 { -1.0 } else { 1.0 }).collect();
    let mut boxes = vec![(DVec2::INFINITY, DVec2::NEG_INFINITY); charts.len()];
    for (uv, chart) in atlas.uv.iter_mut().zip(&chart_of) {
        *uv *= DVec2::new(mirror[*chart], 1.0) * scale;
        boxes[*chart] = (boxes[*chart].0.min(*uv), boxes[*chart].1.max(*uv));
    }
    if charts.len() > 1 {
        let places = shelves(boxes.iter().map(|(low, high)| *high - *low), gap);
        for (uv, chart) in atlas.uv.iter_mut().zip(&chart_of) {
            *uv += places[*chart] - boxes[*chart].0;
        }
    }
}

/// Places for boxes of these sizes in rows, so that none meets another.
pub(super) fn shelves(sizes: impl Iterator<Item = DVec2>, gap: f64) -> Vec<DVec2> {
    let sizes: Vec<DVec2> = sizes.collect();
    let area: f64 = sizes.iter().map(|s| (*s + gap).element_product()).sum();
    let width = sizes.iter().map(|s| s.x).fold(area.sqrt(), f64::max);
    let mut order: Vec<usize> = (0..sizes.len()).collect();
    order.sort_by_key(|&i| (Reverse(sizes[i].y.to_bits()), i));
    let mut places = vec![DVec2::ZERO; sizes.len()];
    let (mut corner, mut row) = (DVec2::ZERO, 0.0f64);
    for i in order {
        if corner.x > 0.0 && corner.x + sizes[i].x > width {
            corner = DVec2::new(0.0, corner.y + row + gap);
            row = 0.0;
        }
        places[i] = corner;
        corner.x += sizes[i].x + gap;
        row = row.max(sizes[i].y);
    }
    places
}

/// A triangle laid flat, face up, its longest edge on the axis.
pub(super) fn laid_flat(triangle: [DVec3; 3]) -> [DVec2; 3] {
    let length = |k: usize| triangle[k].distance(triangle[(k + 1) % 3]);
    let first = (0..3).fold(0, |best, k| if length(k) > length(best) { k } else { best });
    let [a, b, c] = [0, 1, 2].map(|k| triangle[(first + k) % 3]);
    let base = length(first);
    let along = (b - a) / base;
    let apex = DVec2::new((c - a).dot(along), (c - a).cross(along).length());
    let mut flat = [DVec2::ZERO; 3];
    for (k, p) in [DVec2::ZERO, DVec2::new(base, 0.0), apex].into_iter().enumerate() {
        flat[(first + k) % 3] = p;
    }
    flat
}

/// The layout of a piece in which each face is a chart by itself, without distortion. There always is that one.
pub(super) fn all_apart(piece: &Atlas) -> Atlas {
    let flat: Vec<[DVec2; 3]> = piece.faces().map(|f| laid_flat(piece.triangle(f))).collect();
    let boxes: Vec<(DVec2, DVec2)> =
        flat.iter().map(|t| (t[0].min(t[1]).min(t[2]), t[0].max(t[1]).max(t[2]))).collect();
    let area: f64 = piece.faces().map(|f| piece.area(f)).sum();
    let gap = GAP * (area / piece.face_count().max(1) as f64).sqrt();
    let places = shelves(boxes.iter().map(|(low, high)| *high - *low), gap);
    let moved = flat.iter().zip(&places).zip(&boxes).flat_map(|((t, place), (low, _))| t.map(|p| p - *low + *place));
    Atlas {
        uv: moved.collect(),
        corners: (0..piece.face_count()).map(|f| [0, 1, 2].map(|k| UvId::new(3 * f + k))).collect(),
        ..piece.clone()
    }
}

/// Length of the seams on the surface, each once, its boundary apart.
pub(in crate::refine) fn seam_length(atlas: &Atlas) -> f64 {
    let topology = Topology::new(atlas);
    let seams = topology.half_edges().filter(|h| topology.across_seam(*h).is_some_and(|twin| *h < twin));
    // No seams are zero, and not minus zero.
    seams.fold(0.0, |sum, h| sum + seams::length(atlas, h))
}

/// Sums of the symmetric Dirichlet energy of a layout.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Strain {
    /// Of A (s1^2 + s2^2), for faces of area A and singular values s1, s2.
    stretch: f64,
    /// Of A (s1^-2 + s2^-2).
    shrink: f64,
    /// Of A.
    area: f64,
}

/// Area of a surface.
pub(super) fn surface_area(atlas: &Atlas) -> f64 {
    atlas.faces().map(|f| atlas.area(f)).sum()
}

impl Strain {
    /// Of all faces that have an area.
    pub(super) fn of(atlas: &Atlas) -> Self {
        let mut sum = Strain::default();
        for f in atlas.faces().filter(|f| !is_degenerate(atlas.triangle(*f))) {
            let [p, q, r] = laid_flat(atlas.triangle(f));
            let [a, b, c] = atlas.uv_triangle(f);
            let (e, g, u, v) = (q - p, r - p, b - a, c - a);
            let gram = e.perp_dot(g).powi(2);
            let norm = (g.length_squared() * u.length_squared() - 2.0 * e.dot(g) * u.dot(v)
                + e.length_squared() * v.length_squared())
                / gram;
            let area = 0.5 * gram.sqrt();
            sum.stretch += area * norm;
            sum.shrink += area * norm * gram / u.perp_dot(v).powi(2);
            sum.area += area;
        }
        sum
    }

    /// By what the UVs are multiplied to distort least; 1 where nothing can be said.
    pub(super) fn best_scale(&self) -> f64 {
        let scale = (self.shrink / self.stretch).sqrt().sqrt();
        if scale.is_finite() && scale > 0.0 { scale } else { 1.0 }
    }

    /// The mean energy at that scale.
    pub(super) fn least_energy(&self) -> f64 {
        2.0 * (self.stretch.sqrt() * self.shrink.sqrt()) / self.area
    }

    /// The mean energy as it is; infinite where a face lies on a line.
    pub(super) fn energy(&self) -> f64 {
        (self.stretch + self.shrink) / self.area
    }
}

#[cfg(test)]
mod tests;
