//! Charts become disks first: the construction is for maps of disks without flips (section 3, *Inputs*).
//!
//! Charts that overlap themselves stay as they are. Faces that are wound against each other do not hang together. A vertex at which parts
//! of a chart meet becomes several; a chart with holes is cut from hole to hole along short paths of edges; what is closed or has handles is grown into disks face by face; a chart in which faces are turned over gets
//! a map of its own (Tutte 1963, then the least distortion).

use std::cmp::Reverse;
use std::collections::{BTreeSet, BinaryHeap};

use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;

use super::chart_map::ChartMap;
use crate::atlas::bvh::Bounds;
use crate::atlas::groups::{Cost, DisjointSets, Grouped, sorted_unique};
use crate::atlas::{
    Atlas, Charts, FaceId, HalfEdge, Loops, Mesh, Provenance, TrailEnd, TrailPoint, TrailStart, UvId, orientation,
};
use crate::error::Result;
use crate::numeric::dirichlet::flattened;
use crate::numeric::newton::{self, Workspace};
use crate::numeric::tutte;

/// Rounds of joining holes, and of growing disks.
const ROUNDS: usize = 8;
/// Least edges of a boundary that is to have four corners, and some freedom.
const LEAST_EDGES: usize = 8;
/// Places from which cuts across a disk are tried.
const TRIALS: usize = 96;
/// Part of the boundary that a cut across a disk should leave on either side.
const EVEN: f64 = 0.2;
/// Steps towards the least distortion of a map that is made anew.
const STEPS: usize = 60;
/// Relative decrease of a step below which they end.
const STILL: f64 = 1e-4;

/// The surface in disks.
#[derive(Debug, Clone)]
pub(super) struct Prepared {
    pub mesh: Mesh,
    pub labels: Labels,
    pub layout: Layout,
    pub disks: Vec<Disk>,
    /// Charts that were cut to become disks, and those that were flattened anew.
    pub opened: usize,
    pub flattened: usize,
}

/// The number of no disk: the face is in none.
pub(super) const NO_DISK: u32 = u32::MAX;

/// A disk.
#[derive(Debug, Clone)]
pub(super) struct Disk {
    pub faces: Vec<FaceId>,
    /// Whether its faces have negative areas.
    pub reversed: bool,
    /// Texels by unit of the surface.
    pub density: f64,
    /// Whether its map was made here, so that the uploaded one says nothing of its faces.
    pub fresh: bool,
    /// Area on the surface in texels.
    pub area: f64,
}

/// What a face is measured against.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Target {
    Surface,
    Uploaded,
}

impl Prepared {
    /// Cuts some disks in two, each straight across at a place where that is short for the boundary that it leaves on either side; gives whether any was.
    pub fn halve(&mut self, which: &[usize]) -> bool {
        let mut any = false;
        for &d in which {
            let Some((corner, direction, snap)) = self.across(d) else {
                continue;
            };
            let cut = self.mesh.cut_trail(TrailStart::Corner(corner), direction, f64::INFINITY, snap);
            self.labels.extend(&cut.faces);
            // Others have the edges in which it begins and ends.
            for (new, _) in &cut.faces {
                if let Some(disk) = self.disks.get_mut(self.labels.disk[new.index()] as usize) {
                    disk.faces.push(*new);
                }
            }
            any |= !cut.path.is_empty();
        }
        if any {
            // The parts of a disk are those that hang together.
            let charts = Charts::new(self.mesh.topology());
            let mut disks = Vec::with_capacity(self.disks.len());
            for faces in charts.faces {
                let old = self.labels.disk[faces[0].index()];
                if old == NO_DISK {
                    continue;
                }
                let of = &self.disks[old as usize];
                let atlas = self.mesh.atlas();
                let area = faces.iter().map(|f| atlas.area(*f)).sum::<f64>() * of.density * of.density;
                disks.push(Disk { faces, area, ..of.clone() });
            }
            for (d, disk) in disks.iter().enumerate() {
                disk.faces.iter().for_each(|f| self.labels.disk[f.index()] = d as u32);
            }
            self.disks = disks;
        }
        any
    }

    /// Halves some disks, and of their parts again those that `bent` names, that often at most; gives whether any was. What `bent` is given has these parts as its only disks.
    ///
    /// # Errors
    /// What `bent` gives.
    pub fn halve_apart(
        &mut self,
        which: &[usize],
        rounds: usize,
        bent: &dyn Fn(&Prepared) -> Result<Vec<usize>>,
    ) -> Result<bool> {
        let home = self.labels.disk.clone();
        let all = std::mem::take(&mut self.disks);
        let mut name = vec![NO_DISK; all.len()];
        which.iter().zip(0..).for_each(|(d, k)| name[*d] = k);
        self.labels.disk.iter_mut().filter(|d| **d != NO_DISK).for_each(|d| *d = name[*d as usize]);
        self.disks = which.iter().map(|d| all[*d].clone()).collect();
        let those: Vec<usize> = (0..which.len()).collect();
        let any = self.halve(&those);
        let again = if any && rounds > 1 { bent(self)? } else { Vec::new() };
        if !again.is_empty() {
            self.halve_apart(&again, rounds - 1, bent)?;
        }
        // The others, which may have got faces where they have an edge in common with these.
        let worked = std::mem::take(&mut self.disks);
        for faces in Charts::new(self.mesh.topology()).faces {
            let known = faces.iter().filter_map(|f| home.get(f.index()));
            let of = match self.labels.disk[faces[0].index()] {
                NO_DISK => known.copied().find(|d| *d != NO_DISK).map(|d| &all[d as usize]),
                own => worked.get(own as usize),
            };
            let Some(of) = of else { continue };
            faces.iter().for_each(|f| self.labels.disk[f.index()] = self.disks.len() as u32);
            self.disks.push(Disk { faces, ..of.clone() });
        }
        Ok(any)
    }

    /// Where to cut a disk in two.
    fn across(&self, d: usize) -> Option<(HalfEdge, DVec2, f64)> {
        let map = self.map(&self.disks[d], Target::Surface).filter(ChartMap::is_valid)?;
        let n = map.boundary.len();
        let mut along = vec![0.0];
        for l in map.lengths() {
            along.push(along[along.len() - 1] + l);
        }
        let total = along[n];
        let place = map.places();
        let snap = 1e-7 * total;
        let mut best: Option<(f64, HalfEdge, DVec2)> = None;
        for k in 0..TRIALS.min(n) {
            let i = k * n / TRIALS.min(n);
            let inward = (map.edge((i + n - 1) % n).normalize_or_zero() + map.edge(i).normalize_or_zero()).perp();
            let uv = map.uvs[map.boundary[i] as usize];
            let own = |c: &HalfEdge| self.labels.disk[c.face().index()] == d as u32;
            let Some(corner) = self.mesh.corners_of(uv).find(own) else { continue };
            let trail = self.mesh.trail(TrailStart::Corner(corner), inward, f64::INFINITY, snap);
            if trail.end != TrailEnd::Border || trail.points.len() < 3 {
                continue;
            }
            let end = match trail.points.last() {
                Some(TrailPoint::Vertex(u)) => place.get(u),
                Some(TrailPoint::Edge(h, _)) => place.get(&self.mesh.uv_at(*h)),
                None => None,
            };
            let Some(&end) = end else { continue };
            let arc = (along[end] - along[i]).abs();
            let part = (arc / total).min(1.0 - arc / total);
            // What cuts off but a little leaves the other part as it was.
            let score = trail.length / part.max(1e-300) / (part / EVEN).min(1.0);
            if best.as_ref().is_none_or(|b| score < b.0) {
                best = Some((score, corner, inward));
            }
        }
        best.map(|(_, corner, direction)| (corner, direction, snap))
    }

    /// The map of a disk.
    pub fn map(&self, disk: &Disk, target: Target) -> Option<ChartMap> {
        let boundary = boundary(&self.mesh, &disk.faces)?;
        let mesh = &self.mesh;
        let shape = |f: FaceId| rest_shape(mesh.atlas(), &self.layout, &self.labels, f, disk, target);
        ChartMap::new(mesh, &disk.faces, &boundary, disk.reversed, &shape)
    }
}

/// Leaves some disks as they were uploaded; gives the others, which get new numbers.
pub(super) fn leave_out(
    mesh: &mut Mesh,
    labels: &mut Labels,
    layout: &Layout,
    disks: Vec<Disk>,
    is_out: impl Fn(usize) -> bool,
) -> Vec<Disk> {
    let mut name = Vec::with_capacity(disks.len());
    let mut kept = Vec::new();
    for (d, disk) in disks.into_iter().enumerate() {
        if is_out(d) {
            layout.restore(mesh, labels, &disk.faces);
            name.push(NO_DISK);
        } else {
            name.push(kept.len() as u32);
            kept.push(disk);
        }
    }
    labels.disk.iter_mut().filter(|d| **d != NO_DISK).for_each(|d| *d = name[*d as usize]);
    kept
}

/// The shape of a face at rest in texels, with a positive area; none where it has none.
pub(super) fn rest_shape(
    atlas: &Atlas,
    layout: &Layout,
    labels: &Labels,
    face: FaceId,
    disk: &Disk,
    target: Target,
) -> Option<[DVec2; 3]> {
    let uploaded = || {
        let own = layout.of(labels.origin[face.index()], &atlas.provenance[face.index()])?;
        let own = if disk.reversed { own.map(|p| DVec2::new(p.x, -p.y)) } else { own };
        is_shape(&own).then_some(own)
    };
    let surface = || {
        let own = flattened(atlas.triangle(face).map(|p| p * disk.density));
        is_shape(&own).then_some(own)
    };
    match target {
        Target::Uploaded if !disk.fresh => uploaded().or_else(surface),
        _ => surface().or_else(|| if disk.fresh { None } else { uploaded() }),
    }
}

/// Whether a face has an area on the surface and in the layout that the stage was given.
pub(super) fn had_area(atlas: &Atlas, layout: &Layout, labels: &Labels, face: FaceId) -> bool {
    let uploaded = layout.of(labels.origin[face.index()], &atlas.provenance[face.index()]);
    let any_way = |[a, b, c]: [DVec2; 3]| is_shape(&[a, b, c]) || is_shape(&[a, c, b]);
    uploaded.is_some_and(any_way) && is_shape(&flattened(atlas.triangle(face)))
}

/// What is known of each face of a mesh while faces are divided.
#[derive(Debug, Clone, Default)]
pub(super) struct Labels {
    /// Its disk, or [`NO_DISK`].
    pub disk: Vec<u32>,
    /// The face of the stage's input that it is a part of.
    pub origin: Vec<FaceId>,
}

impl Labels {
    /// Takes new faces in, each after the one that it is a part of.
    pub fn extend(&mut self, made: &[(FaceId, FaceId)]) {
        for (new, of) in made {
            if self.disk.len() <= new.index() {
                self.disk.resize(new.index() + 1, NO_DISK);
                self.origin.resize(new.index() + 1, FaceId(0));
            }
            self.disk[new.index()] = self.disk[of.index()];
            self.origin[new.index()] = self.origin[of.index()];
        }
    }
}

/// The layout that the stage was given, as a map of each of its faces from barycentric coordinates of the source.
#[derive(Debug, Clone)]
pub(super) struct Layout(Vec<Option<[DVec2; 3]>>);

impl Layout {
    fn new(atlas: &Atlas) -> Self {
        let of_face = |f: FaceId| {
            let [a, b, c] = atlas.uv_triangle(f);
            let [p, q, r] = atlas.provenance[f.index()].barycentric;
            let inverse = DMat3::from_cols(p, q, r).inverse();
            // Columns: what a unit of each coordinate is.
            let column = |w: DVec3| a * w.x + b * w.y + c * w.z;
            inverse.is_finite().then(|| [inverse.x_axis, inverse.y_axis, inverse.z_axis].map(column))
        };
        Layout(atlas.faces().map(of_face).collect())
    }

    /// Puts faces back to where they were.
    pub fn restore(&self, mesh: &mut Mesh, labels: &Labels, faces: &[FaceId]) {
        for f in faces {
            let own = self.of(labels.origin[f.index()], &mesh.atlas().provenance[f.index()]);
            let corners = mesh.atlas().corners[f.index()];
            corners.into_iter().zip(own.into_iter().flatten()).for_each(|(u, at)| mesh.move_uv(u, at));
        }
    }

    /// The triangle of a part of a face.
    fn of(&self, face: FaceId, part: &Provenance) -> Option<[DVec2; 3]> {
        let [x, y, z] = self.0[face.index()]?;
        Some(part.barycentric.map(|w| x * w.x + y * w.y + z * w.z))
    }
}

/// Whether a triangle has an area that can be computed with.
fn is_shape(t: &[DVec2; 3]) -> bool {
    let longest = (0..3).map(|k| t[k].distance_squared(t[(k + 1) % 3])).fold(0.0, f64::max);
    let twice = (t[1] - t[0]).perp_dot(t[2] - t[0]);
    twice.is_finite() && twice > 1e-9 * longest && longest > 0.0
}

/// The boundary loop of a disk, from its first half edge on.
pub(super) fn boundary(mesh: &Mesh, faces: &[FaceId]) -> Option<Vec<HalfEdge>> {
    let topology = mesh.topology();
    let mut borders = faces.iter().flat_map(|f| (0..3).map(|k| HalfEdge::of(*f, k))).filter(|h| topology.is_border(*h));
    let first = borders.next()?;
    let count = 1 + borders.count();
    let mut out = vec![first];
    let mut h = topology.next_on_boundary(first);
    while h != first && out.len() <= count {
        out.push(h);
        h = topology.next_on_boundary(h);
    }
    (out.len() == count).then_some(out)
}

/// Brings all charts but those of `held` faces into disks.
///
/// # Errors
/// What `interrupt` gives.
pub(super) fn prepare(atlas: &Atlas, held: &[bool], interrupt: &(dyn Fn() -> Result<()> + Sync)) -> Result<Prepared> {
    let mut mesh = Mesh::new(atlas.clone());
    // Densities are those of the uploaded charts.
    let charts = Charts::new(mesh.topology());
    let density_of: Vec<f64> = charts.faces.iter().map(|faces| density(atlas, faces)).collect();
    let density_by_face: Vec<f64> = charts.of_face.iter().map(|c| density_of[c.index()]).collect();
    mesh.divide_by_chart(|f| charts.of_face[f.index()].0);
    // What is nowhere to be seen needs no texels, and may lie as it does. All of it may be at one vertex of the surface, where no edge is told from another.
    let mut held = held.to_vec();
    for faces in &charts.faces {
        if !held[faces[0].index()] && is_unseen(&mesh, faces) {
            shrink(&mut mesh, faces);
            faces.iter().for_each(|f| held[f.index()] = true);
        }
    }
    let held = held.as_slice();
    let mut opened = divide_windings(&mut mesh, held);
    divide_fans(&mut mesh, held);
    for _ in 0..ROUNDS {
        interrupt()?;
        let cuts = open_holes(&mesh, held);
        if cuts.is_empty() {
            break;
        }
        opened += cuts.len();
        mesh.cut(&cuts.concat());
        divide_fans(&mut mesh, held);
    }
    // Where several faces meet at an edge, two of them may hang together only when others have been divided off.
    for _ in 0..ROUNDS {
        interrupt()?;
        match grow_disks(&mut mesh, held) {
            0 => break,
            grown => opened += grown,
        }
        divide_fans(&mut mesh, held);
    }
    let mut labels = Labels { disk: vec![NO_DISK; atlas.face_count()], origin: atlas.faces().collect() };
    // Boundaries with room for corners.
    for _ in 0..3 {
        let short = short_boundaries(&mesh, held);
        if short.is_empty() {
            break;
        }
        labels.extend(&super::subdivide::split_at_middles(&mut mesh, &short));
        divide_fans(&mut mesh, held);
    }
    let held = |f: FaceId| held.get(f.index()).copied().unwrap_or(false);
    let charts = Charts::new(mesh.topology());
    let mut disks = Vec::new();
    for faces in charts.faces.into_iter().filter(|faces| !held(faces[0])) {
        // What divisions have left of a chart may be unseen too.
        if is_unseen(&mesh, &faces) {
            shrink(&mut mesh, &faces);
            continue;
        }
        faces.iter().for_each(|f| labels.disk[f.index()] = disks.len() as u32);
        let atlas = mesh.atlas();
        let signs = faces.iter().map(|f| {
            let [a, b, c] = atlas.uv_triangle(*f);
            orientation(a, b, c)
        });
        let (mut up, mut down, mut flat) = (0, 0, 0);
        signs.for_each(|s| match s {
            1.. => up += 1,
            0 => flat += 1,
            _ => down += 1,
        });
        let area: f64 = faces.iter().map(|f| atlas.uv_area(*f)).sum();
        let reversed = area < 0.0 || area == 0.0 && down >= up;
        let fresh = flat > 0 || (if reversed { up } else { down }) > 0;
        let density = density_by_face[labels.origin[faces[0].index()].index()];
        let area = faces.iter().map(|f| atlas.area(*f)).sum::<f64>() * density * density;
        disks.push(Disk { faces, reversed, density, fresh, area });
    }
    let layout = Layout::new(atlas);
    let mut prepared = Prepared { mesh, labels, layout, disks, opened, flattened: 0 };
    // New maps where the uploaded ones fold.
    let fresh: Vec<usize> = (0..prepared.disks.len()).filter(|d| prepared.disks[*d].fresh).collect();
    prepared.flattened = fresh.len();
    let maps: Vec<Option<ChartMap>> = fresh
        .par_iter()
        .map(|&d| {
            let mut map = prepared.map(&prepared.disks[d], Target::Surface);
            if let Some(own) = &mut map {
                interrupt()?;
                flatten_anew(own, interrupt)?;
            }
            Ok(map)
        })
        .collect::<Result<_>>()?;
    // A map that could not be made leaves the uploaded one, which nobody can use but for keeping it.
    for map in maps.iter().flatten().filter(|map| map.is_valid()) {
        for (u, x) in map.uvs.iter().zip(&map.x) {
            prepared.mesh.move_uv(*u, *x);
        }
    }
    Ok(prepared)
}

/// Whether no face of a chart has an area on the surface.
fn is_unseen(mesh: &Mesh, faces: &[FaceId]) -> bool {
    !faces.iter().any(|f| is_shape(&flattened(mesh.atlas().triangle(*f))))
}

/// Makes a chart small that has no area on the surface: no longer than a square of its area in the layout, or a texel.
fn shrink(mesh: &mut Mesh, faces: &[FaceId]) {
    let own = Bounds::around(faces.iter().flat_map(|f| mesh.atlas().uv_triangle(*f)));
    let area: f64 = faces.iter().map(|f| mesh.atlas().uv_area(*f).abs()).sum();
    let scale = area.sqrt().max(1.0) / own.size().max_element();
    if scale.is_finite() && scale < 1.0 {
        for u in sorted_unique(faces.iter().flat_map(|f| mesh.atlas().corners[f.index()])) {
            let at = mesh.position(u);
            mesh.move_uv(u, own.min + (at - own.min) * scale);
        }
    }
}

/// Texels by unit of the surface.
fn density(atlas: &Atlas, faces: &[FaceId]) -> f64 {
    let (uv, area) = faces.iter().fold((0.0, 0.0), |(u, a), f| (u + atlas.uv_area(*f).abs(), a + atlas.area(*f)));
    let own = (uv / area).sqrt();
    if own.is_finite() && own > 0.0 { own } else { 1.0 }
}

/// UV vertices at which faces meet that hang together over no edge become one for each fan of faces.
pub(super) fn divide_fans(mesh: &mut Mesh, held: &[bool]) {
    let held = |f: FaceId| held.get(f.index()).copied().unwrap_or(false);
    let mut parts = Vec::new();
    for uv in (0..mesh.atlas().uv.len()).map(UvId::new) {
        let corners: Vec<HalfEdge> = mesh.corners_of(uv).collect();
        let Some(&first) = corners.first() else { continue };
        if held(first.face()) {
            continue;
        }
        let fan = mesh.fan(first);
        if fan.len() == corners.len() {
            continue;
        }
        let mut label: Vec<(HalfEdge, u32)> = Vec::with_capacity(corners.len());
        let mut count = 0;
        for &c in &corners {
            if label.iter().any(|(known, _)| *known == c) {
                continue;
            }
            label.extend(mesh.fan(c).into_iter().map(|own| (own, count)));
            count += 1;
        }
        parts.extend(label);
    }
    parts.sort_unstable();
    parts.dedup();
    mesh.divide(&parts);
}

/// The half edge across a UV edge, where the faces on both sides are wound alike.
fn twin_wound_alike(mesh: &Mesh, half_edge: HalfEdge) -> Option<HalfEdge> {
    mesh.topology().uv_twin(half_edge).filter(|twin| mesh.uv_ends(half_edge) != mesh.uv_ends(*twin))
}

/// Divides charts where faces that are wound against each other meet; gives how many charts that made.
fn divide_windings(mesh: &mut Mesh, held: &[bool]) -> usize {
    let charts = Charts::new(mesh.topology());
    let mut sets = DisjointSets::new(mesh.atlas().face_count());
    for h in mesh.topology().half_edges() {
        let is_held = held.get(h.face().index()).copied().unwrap_or(false);
        let twin = if is_held { mesh.topology().uv_twin(h) } else { twin_wound_alike(mesh, h) };
        if let Some(twin) = twin {
            sets.unite(h.face().0, twin.face().0);
        }
    }
    let (number, parts) = sets.numbered();
    let made = parts.len().saturating_sub(charts.len());
    if made > 0 {
        mesh.divide_by_chart(|f| number[f.index()]);
    }
    made
}

/// By chart with several boundary loops: a tree of edges that joins them, grown from its longest loop by the shortest path to the next.
fn open_holes(mesh: &Mesh, held: &[bool]) -> Vec<Vec<HalfEdge>> {
    let held = |f: FaceId| held.get(f.index()).copied().unwrap_or(false);
    let charts = Charts::new(mesh.topology());
    let loops = Loops::new(mesh.topology(), &charts);
    let by_chart = Grouped::new(charts.len(), loops.chart.iter().enumerate().map(|(l, c)| (c.0, l as u32)));
    let several = (0..charts.len()).filter(|c| by_chart.of(*c as u32).len() > 1 && !held(charts.faces[*c][0]));
    let length = |h: HalfEdge| {
        let [a, b] = mesh.surface_ends(h).map(|v| mesh.atlas().surface.positions[v.index()]);
        a.distance(b)
    };
    let several: Vec<usize> = several.collect();
    several
        .par_iter()
        .filter_map(|&c| {
            let own = by_chart.of(c as u32);
            let total = |l: u32| loops.half_edges[l as usize].iter().map(|h| length(*h)).sum::<f64>();
            let longest = own.iter().copied().max_by(|a, b| total(*a).total_cmp(&total(*b)).then(b.cmp(a)))?;
            let uvs = sorted_unique(charts.faces[c].iter().flat_map(|f| mesh.atlas().corners[f.index()]));
            let local = |u: UvId| uvs.partition_point(|x| *x < u);
            let on = |l: u32| loops.half_edges[l as usize].iter().map(|h| local(mesh.uv_at(*h)));
            let mut on_loop = vec![u32::MAX; uvs.len()];
            own.iter().for_each(|&l| on(l).for_each(|u| on_loop[u] = l));
            // Distances from what is joined so far, over the edges of the chart.
            let mut distance = vec![f64::INFINITY; uvs.len()];
            let mut towards: Vec<Option<HalfEdge>> = vec![None; uvs.len()];
            let mut heap = BinaryHeap::new();
            let mut tree = Vec::new();
            let mut joined = vec![longest];
            let mut fresh: Vec<usize> = on(longest).collect();
            loop {
                for u in fresh.drain(..) {
                    (distance[u], towards[u]) = (0.0, None);
                    heap.push(Reverse((Cost(0.0), u)));
                }
                let Some(Reverse((Cost(at), u))) = heap.pop() else { break };
                if at > distance[u] {
                    continue;
                }
                if on_loop[u] != u32::MAX && !joined.contains(&on_loop[u]) {
                    joined.push(on_loop[u]);
                    fresh.extend(on(on_loop[u]));
                    let mut v = u;
                    while let Some(h) = towards[v] {
                        tree.push(h);
                        fresh.push(v);
                        let [a, b] = mesh.uv_ends(h).map(local);
                        v = if a == v { b } else { a };
                    }
                    continue;
                }
                for corner in mesh.corners_of(uvs[u]) {
                    for h in [corner, corner.previous()] {
                        let [a, b] = mesh.uv_ends(h).map(local);
                        let v = if a == u { b } else { a };
                        let reached = at + length(h);
                        if reached < distance[v] {
                            distance[v] = reached;
                            towards[v] = Some(h);
                            heap.push(Reverse((Cost(reached), v)));
                        }
                    }
                }
            }
            (!tree.is_empty()).then_some(tree)
        })
        .collect()
}

/// Divides charts that are no disks into disks, face by face; gives how many charts that were.
fn grow_disks(mesh: &mut Mesh, held: &[bool]) -> usize {
    let held = |f: FaceId| held.get(f.index()).copied().unwrap_or(false);
    let charts = Charts::new(mesh.topology());
    let topology = mesh.topology();
    let mut region: Vec<u32> = charts.of_face.iter().map(|c| c.0).collect();
    let mut regions = charts.len() as u32;
    let mut divided = 0;
    let mut in_region = vec![u32::MAX; mesh.atlas().uv.len()];
    for faces in &charts.faces {
        if held(faces[0]) || is_disk(mesh, faces) {
            continue;
        }
        divided += 1;
        let mut taken = vec![false; faces.len()];
        let local = |f: FaceId| faces.binary_search(&f).ok();
        for seed in 0..faces.len() {
            if taken[seed] {
                continue;
            }
            let own = regions;
            regions += 1;
            let mut queue = std::collections::VecDeque::from([seed]);
            let mut first = true;
            let mut edges = BTreeSet::new();
            while let Some(f) = queue.pop_front() {
                if taken[f] {
                    continue;
                }
                let face = faces[f];
                let half_edges = [0, 1, 2].map(|k| HalfEdge::of(face, k));
                let shares = half_edges.map(|h| {
                    twin_wound_alike(mesh, h)
                        .and_then(|t| local(t.face()))
                        .is_some_and(|g| taken[g] && region[faces[g].index()] == own)
                });
                let corners = mesh.atlas().corners[face.index()];
                let known = corners.map(|u| in_region[u.index()] == own);
                // It joins along one edge with a new vertex, or along two that meet in a vertex.
                let joins = match shares.iter().filter(|s| **s).count() {
                    0 => first,
                    1 => (0..3).any(|k| shares[k] && !known[(k + 2) % 3]),
                    // The third edge is no second one between its ends.
                    2 => (0..3).any(|k| !shares[k] && !edges.contains(&edge_of(mesh, half_edges[k]))),
                    _ => false,
                };
                if !joins {
                    continue;
                }
                edges.extend(half_edges.map(|h| edge_of(mesh, h)));
                first = false;
                taken[f] = true;
                region[face.index()] = own;
                corners.iter().for_each(|u| in_region[u.index()] = own);
                queue.extend(half_edges.iter().filter_map(|h| topology.uv_twin(*h).and_then(|t| local(t.face()))));
            }
        }
    }
    if divided > 0 {
        mesh.divide_by_chart(|f| region[f.index()]);
    }
    divided
}

/// The UV vertices of an edge, the lower first.
fn edge_of(mesh: &Mesh, half_edge: HalfEdge) -> [UvId; 2] {
    let [a, b] = mesh.uv_ends(half_edge);
    [a.min(b), a.max(b)]
}

/// Whether faces of one chart are a disk that can be laid flat: one boundary loop, no handle, and no two edges between the same vertices.
fn is_disk(mesh: &Mesh, faces: &[FaceId]) -> bool {
    let all = || faces.iter().flat_map(|f| (0..3).map(|k| HalfEdge::of(*f, k)));
    let topology = mesh.topology();
    if all().any(|h| topology.uv_twin(h).is_some() && twin_wound_alike(mesh, h).is_none()) {
        return false;
    }
    if boundary(mesh, faces).is_none() {
        return false;
    }
    let uvs = sorted_unique(faces.iter().flat_map(|f| mesh.atlas().corners[f.index()]));
    let borders = all().filter(|h| topology.is_border(*h)).count();
    let edges = (3 * faces.len() + borders) / 2;
    // Hangs together over its edges, and not by a non-manifold one.
    let mut sets = DisjointSets::new(faces.len());
    for h in all() {
        if let Some(twin) = topology.uv_twin(h)
            && let (Ok(a), Ok(b)) = (faces.binary_search(&h.face()), faces.binary_search(&twin.face()))
        {
            sets.unite(a as u32, b as u32);
        }
    }
    // Two edges between the same vertices cannot both be straight without all between them collapsing.
    let pairs = sorted_unique(all().map(|h| edge_of(mesh, h))).len();
    pairs == edges && sets.numbered().1.len() == 1 && uvs.len() as i64 - edges as i64 + faces.len() as i64 == 1
}

/// Boundary edges of charts that have too few.
fn short_boundaries(mesh: &Mesh, held: &[bool]) -> Vec<HalfEdge> {
    let held = |f: FaceId| held.get(f.index()).copied().unwrap_or(false);
    let charts = Charts::new(mesh.topology());
    let topology = mesh.topology();
    let mut out = Vec::new();
    for faces in charts.faces.iter().filter(|faces| !held(faces[0])) {
        let all = faces.iter().flat_map(|f| (0..3).map(|k| HalfEdge::of(*f, k)));
        let own: Vec<HalfEdge> = all.filter(|h| topology.is_border(*h)).collect();
        if own.len() < LEAST_EDGES {
            out.extend(own);
        }
    }
    out
}

/// A map of least distortion, whatever the one before was.
fn flatten_anew(map: &mut ChartMap, interrupt: &dyn Fn() -> Result<()>) -> Result<()> {
    let radius = (map.rest_area / std::f64::consts::PI).sqrt();
    let mut held = vec![false; map.x.len()];
    for (v, p) in map.boundary.iter().zip(tutte::on_circle(&map.rest_lengths, radius)) {
        map.x[*v as usize] = p;
        held[*v as usize] = true;
    }
    if !embed(map, &held) {
        return Ok(());
    }
    let elements = map.elements();
    let free: Vec<u32> = (1..map.x.len() as u32).collect();
    let mut workspace = Workspace::default();
    for _ in 0..STEPS {
        interrupt()?;
        let Some(step) = newton::step(&mut map.x, &elements, &free, &mut workspace) else { break };
        if step.alpha == 0.0 || step.before - step.after < STILL * step.after * step.alpha {
            break;
        }
    }
    Ok(())
}

/// Tutte's embedding with the boundary where it is.
pub(super) fn embed(map: &mut ChartMap, held: &[bool]) -> bool {
    let mut edges: Vec<[u32; 2]> = map
        .triangles
        .iter()
        .flat_map(|t| [0, 1, 2].map(|k| [t[k].min(t[(k + 1) % 3]), t[k].max(t[(k + 1) % 3])]))
        .collect();
    edges.sort_unstable();
    edges.dedup();
    tutte::embed(&mut map.x, held, &edges, &map.guide).is_some()
}
