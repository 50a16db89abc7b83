//! Performing a merge operation (section 4.2), without changing anything: what would become of the mesh, or why not.

use std::collections::BinaryHeap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use glam::DVec2;

use super::border::Loops;
use super::mesh::Mesh;
use super::operation::{Kind, Operation, pairs};
use super::params::{Defrag, Search};
use crate::atlas::bvh::Bounds;
use crate::atlas::rigid::Rigid;
use crate::atlas::{find_root, penetration, triangles_overlap};

mod collide;
mod shape;

/// Vertices that move by less, in texels, leave their texels as they are: uploads hold float32.
pub(super) const STILL: f64 = 4e-4;
/// Work beyond which an attempt that failed is not made again with more room.
const CHEAP: u64 = 3_000;
/// Times that vertices are held where the border crossed, and the rest is tried again.
const AGAIN: usize = 3;
/// Faces of a band that is tried again only once.
const MANY: usize = 2_000;
/// Vertices that one merge may deform: at all, where one chart gives way alone, and where deformation spreads further than published.
/// Beyond, such merges all but never succeed.
const WIDEST: [usize; 3] = [6_000, 1_500, 200];
/// Vertices beyond which both ways to fit a seam are tried at the same time, and what nobody waits for any more is given up. Some
/// milliseconds: waking another thread may take as long.
const HEAVY: usize = if cfg!(test) { 20 } else { 500 };

/// Why an operation failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Reason {
    /// The rest of the borders collide after alignment.
    Collision,
    /// Triangles overlap after the shapes were optimised.
    Overlap,
    /// A triangle turned over or lost its area.
    Fold,
    /// The deformed triangles are deformed too much.
    Local,
    /// The whole atlas would be.
    Global,
    /// The chart would not be flat: a handle, or no border left.
    Topology,
    /// Too much of the surface would be resampled.
    Resampled,
    /// The chart would be larger than a sheet.
    Size,
    /// Nothing that can be solved.
    Singular,
}

impl Reason {
    /// The name in reports.
    pub(super) fn name(self) -> &'static str {
        match self {
            Reason::Collision => "collision",
            Reason::Overlap => "overlap",
            Reason::Fold => "fold",
            Reason::Local => "local_energy",
            Reason::Global => "global_energy",
            Reason::Topology => "topology",
            Reason::Resampled => "resampled",
            Reason::Size => "sheet_size",
            Reason::Singular => "singular",
        }
    }
}

/// What a successful operation does.
#[derive(Debug, Clone)]
pub(super) struct Merge {
    /// Pairs of half edges that become one: of the kept chart, and of the other.
    pub zip: Vec<(u32, u32)>,
    /// UV vertices that become another: (gone, stays).
    pub fuse: Vec<(u32, u32)>,
    /// New places, in the coordinates of the kept chart.
    pub places: Vec<(u32, DVec2)>,
    /// Faces whose corners move (by more than the chart does), with their energy.
    pub band: Vec<(u32, f64)>,
    /// Those of them that are deformed.
    pub deformed: Vec<u32>,
    /// What the energy grows by.
    pub energy: f64,
}

/// The outcome, and where it depends on the kept chart: as long as nothing changes there, nor the moved chart, it stands. Only whether
/// the chart stays flat is a matter of all of its border.
#[derive(Debug, Clone)]
pub(super) struct Attempt {
    /// The merge, or why there is none.
    pub outcome: Result<Merge, Reason>,
    /// In the coordinates of the kept chart.
    pub region: Bounds,
    /// Faces looked at.
    pub work: u64,
    /// Whether it was an island that came, which may be deformed more.
    pub island: bool,
}

/// Who gives way where a seam does not fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Target {
    /// Both: vertices meet at their mean (section 4.2.1).
    Mean,
    /// The moved chart: the other stays as it is.
    Kept,
}

/// Memory that attempts use again: nothing in it outlives one.
#[derive(Debug, Default)]
pub(super) struct Scratch {
    epoch: u32,
    /// (epoch, node) by UV vertex.
    node: Vec<(u32, u32)>,
    /// (epoch, index in the band) by face.
    band: Vec<(u32, u32)>,
    loops: Loops,
}

impl Scratch {
    fn begin(&mut self, mesh: &Mesh) {
        self.epoch += 1;
        self.node.resize(mesh.uv.len(), (0, 0));
        self.band.resize(mesh.corners.len(), (0, 0));
    }

    fn node(&self, vertex: u32) -> Option<u32> {
        let (epoch, node) = self.node[vertex as usize];
        (epoch == self.epoch).then_some(node)
    }

    fn in_band(&self, face: u32) -> Option<u32> {
        let (epoch, index) = self.band[face as usize];
        (epoch == self.epoch).then_some(index)
    }
}

/// Memory for as many attempts as are made at once.
#[derive(Debug, Default)]
pub(super) struct Pool(Mutex<Vec<Scratch>>);

impl Pool {
    fn with<T>(&self, work: impl FnOnce(&mut Scratch) -> T) -> T {
        let own = || self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let mut scratch = own().pop().unwrap_or_default();
        let result = work(&mut scratch);
        own().push(scratch);
        result
    }
}

/// Says that nobody waits for an attempt any more.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Quit<'a>([Option<&'a AtomicBool>; 2]);

impl<'a> Quit<'a> {
    /// When this is set.
    pub(super) fn when(flag: &'a AtomicBool) -> Self {
        Quit([Some(flag), None])
    }

    fn or(self, flag: &'a AtomicBool) -> Self {
        Quit([self.0[0], Some(flag)])
    }

    fn now(self) -> bool {
        self.0.into_iter().flatten().any(|flag| flag.load(Ordering::Relaxed))
    }
}

/// Whether the operation leaves a flat chart with a border.
pub(super) fn stays_flat(mesh: &Mesh, op: &Operation, pool: &Pool) -> bool {
    pool.with(|scratch| scratch.loops.stays_flat(mesh, &pairs(mesh, op), op.kept == op.moved))
}

/// Tries an operation that leaves a flat chart; `None` only where `quit` says that nobody waits for it. Calls `heavy` where it is going to take long.
pub(super) fn attempt(
    mesh: &Mesh,
    op: &Operation,
    params: &Defrag,
    pool: &Pool,
    quit: Quit<'_>,
    heavy: &(dyn Fn() + Sync),
) -> Option<Attempt> {
    let mut so_far = Attempt::failed(mesh, op, params, Reason::Singular);
    let partial = params.search == Search::Partial;
    // A chart that keeps its texels is left alone where the other, which is resampled anyway, can do the fitting.
    let gentle = partial && op.kind != Kind::Within && !op.whole_texels;
    for wide in [false, true] {
        if wide && (!partial || so_far.work > CHEAP) {
            break;
        }
        let mean = |quit: Quit<'_>, first: bool| {
            pool.with(|scratch| {
                let mut mean = Trial::new(mesh, op, params, (Target::Mean, wide), scratch, quit);
                let prepared = mean.prepare();
                if first && prepared.is_ok() && mean.is_heavy() {
                    heavy();
                }
                mean.finish(prepared)
            })
        };
        if !gentle {
            if so_far.is_decided_by(mean(quit, true)?, wide) {
                break;
            }
            continue;
        }
        let decided = AtomicBool::new(false);
        let (kept, mean) = pool.with(|scratch| {
            let mut kept = Trial::new(mesh, op, params, (Target::Kept, wide), scratch, quit);
            let prepared = kept.prepare();
            let both = prepared.is_ok() && kept.is_heavy() && rayon::current_num_threads() > 1;
            let kept = || {
                if both {
                    heavy();
                }
                let kept = kept.finish(prepared);
                decided.store(kept.as_ref().is_none_or(Attempt::decides), Ordering::Relaxed);
                kept
            };
            // Where the first way succeeds, the second is not waited for.
            let mean = |first| if decided.load(Ordering::Relaxed) { None } else { mean(quit.or(&decided), first) };
            if both { rayon::join(kept, || mean(false)) } else { (kept(), mean(true)) }
        });
        if so_far.is_decided_by(kept?, wide) || so_far.is_decided_by(mean?, wide) {
            break;
        }
    }
    Some(so_far)
}

impl Attempt {
    /// One that failed before it looked at anything.
    pub(super) fn failed(mesh: &Mesh, op: &Operation, params: &Defrag, reason: Reason) -> Self {
        Attempt { outcome: Err(reason), region: Bounds::EMPTY, work: 0, island: op.is_island(mesh, params) }
    }

    /// That of an operation that would not leave a flat chart.
    pub(super) fn not_flat(mesh: &Mesh, op: &Operation, params: &Defrag) -> Self {
        Attempt { work: op.edges.len() as u64, ..Attempt::failed(mesh, op, params, Reason::Topology) }
    }

    /// Whether no other way is to be tried: what collides without any deformation does so whoever gives way.
    fn decides(&self) -> bool {
        !matches!(self.outcome, Err(reason) if reason != Reason::Collision)
    }

    /// Adds the next way that was tried; says whether it is the last one. Why the published ways failed says more than why others did.
    fn is_decided_by(&mut self, next: Attempt, wide: bool) -> bool {
        let decides = next.decides();
        self.region = self.region.union(next.region);
        self.work += next.work;
        if decides || !wide {
            self.outcome = next.outcome;
        }
        decides
    }
}

/// One or several UV vertices that are, or become, one.
struct Node {
    vertices: Vec<u32>,
    /// Where it is, in the coordinates of the kept chart.
    at: DVec2,
    /// How much further deformation spreads from it.
    budget: f64,
    /// May move in the optimisation.
    free: bool,
    /// Fused by the operation.
    seam: bool,
}

struct Trial<'a> {
    mesh: &'a Mesh,
    op: &'a Operation,
    params: &'a Defrag,
    scratch: &'a mut Scratch,
    target: Target,
    /// Deformation spreads further than published.
    wide: bool,
    region: Bounds,
    work: u64,
    nodes: Vec<Node>,
    /// Faces with a corner that moves.
    band: Vec<u32>,
    quit: Quit<'a>,
    /// Nobody waits for it.
    gave_up: bool,
}

/// The seam that a trial is about.
struct Seam {
    /// See [`Merge`].
    zip: Vec<(u32, u32)>,
    /// How far its vertices are moved at most.
    displaced: f64,
}

impl<'a> Trial<'a> {
    fn new(
        mesh: &'a Mesh,
        op: &'a Operation,
        params: &'a Defrag,
        (target, wide): (Target, bool),
        scratch: &'a mut Scratch,
        quit: Quit<'a>,
    ) -> Self {
        scratch.begin(mesh);
        let (nodes, band) = (Vec::new(), Vec::new());
        Trial {
            mesh,
            op,
            params,
            scratch,
            target,
            wide,
            region: Bounds::EMPTY,
            work: 0,
            nodes,
            band,
            quit,
            gave_up: false,
        }
    }

    /// Whether it is going to take long.
    fn is_heavy(&self) -> bool {
        self.nodes.len() > HEAVY
    }

    /// The rest of it; `None` where nobody waits for it.
    fn finish(mut self, seam: Result<Seam, Reason>) -> Option<Attempt> {
        let outcome = seam.and_then(|seam| self.fit(seam));
        let island = self.op.is_island(self.mesh, self.params);
        (!self.gave_up).then_some(Attempt { outcome, region: self.region, work: self.work, island })
    }

    /// Gives up where nobody waits for what takes long.
    fn go_on(&mut self) -> Result<(), Reason> {
        self.gave_up |= self.is_heavy() && self.quit.now();
        if self.gave_up { Err(Reason::Singular) } else { Ok(()) }
    }

    fn within(&self) -> bool {
        self.op.kept == self.op.moved
    }

    /// Vertices that it may deform.
    fn widest(&self) -> usize {
        WIDEST[if self.wide { 2 } else { usize::from(self.target == Target::Kept) }]
    }

    /// Whether a face is of the chart that comes.
    fn comes(&self, face: u32) -> bool {
        !self.within() && self.mesh.chart_of[face as usize] == self.op.moved
    }

    /// Where a vertex is once the charts are aligned.
    fn aligned(&self, vertex: u32) -> DVec2 {
        let at = self.mesh.uv[vertex as usize];
        match self.mesh.star[vertex as usize].first() {
            Some(&f) if self.comes(f) => self.op.motion.apply(at),
            _ => at,
        }
    }

    /// Where a face is then.
    fn aligned_triangle(&self, face: u32) -> [DVec2; 3] {
        let motion = if self.comes(face) { self.op.motion } else { Rigid::IDENTITY };
        self.mesh.triangle(face).map(|p| if motion == Rigid::IDENTITY { p } else { motion.apply(p) })
    }

    /// Where a face of the band comes to lie.
    fn placed_triangle(&self, face: u32) -> [DVec2; 3] {
        self.mesh.corners[face as usize].map(|u| match self.scratch.node(u) {
            Some(node) => self.nodes[node as usize].at,
            None => self.aligned(u),
        })
    }

    /// Finds what is to be deformed.
    fn prepare(&mut self) -> Result<Seam, Reason> {
        let zip = pairs(self.mesh, self.op);
        let displaced = self.fuse(&zip);
        if self.vanishes() {
            self.reach_out();
            return Err(Reason::Fold);
        }
        self.spread();
        self.reach_out();
        self.gather()?;
        Ok(Seam { zip, displaced })
    }

    /// Deforms it until it fits.
    fn fit(&mut self, Seam { zip, displaced }: Seam) -> Result<Merge, Reason> {
        self.go_on()?;
        self.work += self.band.len() as u64;
        for &f in &self.band {
            self.region = self.region.union(Bounds::of(&self.placed_triangle(f)));
        }
        if !self.within() && self.border_collides() {
            return Err(Reason::Collision);
        }
        let start: Vec<DVec2> = self.nodes.iter().map(|n| n.at).collect();
        for again in 0.. {
            if displaced > STILL {
                self.optimise(displaced)?;
            }
            for &f in &self.band {
                self.region = self.region.union(Bounds::of(&self.placed_triangle(f)));
            }
            self.folds()?;
            self.local_energy()?;
            self.go_on()?;
            let crossing = self.overlapping();
            if crossing.is_empty() {
                break;
            }
            // What crosses is held where it was before the optimisation, and the rest is fitted to it.
            let mut held = false;
            for f in crossing {
                for u in self.mesh.corners[f as usize] {
                    if let Some(n) = self.scratch.node(u) {
                        held |= std::mem::replace(&mut self.nodes[n as usize].free, false);
                    }
                }
            }
            if !held || again == if self.band.len() > MANY { 1 } else { AGAIN } {
                return Err(Reason::Overlap);
            }
            self.nodes.iter_mut().zip(&start).for_each(|(n, at)| n.at = *at);
        }
        if !self.within() && self.interior_collides() {
            return Err(Reason::Overlap);
        }
        Ok(self.merge(zip))
    }

    /// It depends on what lies about every vertex that it names, whether that moves or not.
    fn reach_out(&mut self) {
        for &f in self.nodes.iter().flat_map(|n| &n.vertices).flat_map(|&u| &self.mesh.star[u as usize]) {
            self.region = self.region.union(Bounds::of(&self.aligned_triangle(f)));
        }
    }

    /// Makes nodes of the vertices that become one, at their common place; gives the largest displacement.
    fn fuse(&mut self, zip: &[(u32, u32)]) -> f64 {
        let mesh = self.mesh;
        let pairs: Vec<(u32, u32)> =
            zip.iter().flat_map(|&(h, t)| [(mesh.start(h), mesh.end(t)), (mesh.end(h), mesh.start(t))]).collect();
        let mut vertices: Vec<u32> = pairs.iter().flat_map(|&(p, q)| [p, q]).collect();
        vertices.sort_unstable();
        vertices.dedup();
        let place = |u: u32| vertices.partition_point(|v| *v < u) as u32;
        let mut parent: Vec<u32> = (0..vertices.len() as u32).collect();
        for &(p, q) in &pairs {
            let (a, b) = (find_root(&mut parent, place(p)), find_root(&mut parent, place(q)));
            parent[a.max(b) as usize] = a.min(b);
        }
        let mut number = vec![u32::MAX; vertices.len()];
        for (i, &u) in vertices.iter().enumerate() {
            let root = find_root(&mut parent, i as u32) as usize;
            if number[root] == u32::MAX {
                number[root] = self.nodes.len() as u32;
                self.nodes.push(Node {
                    vertices: Vec::new(),
                    at: DVec2::ZERO,
                    budget: f64::NEG_INFINITY,
                    free: false,
                    seam: true,
                });
            }
            self.nodes[number[root] as usize].vertices.push(u);
            self.scratch.node[u as usize] = (self.scratch.epoch, number[root]);
        }
        let mut largest: f64 = 0.0;
        let extra = if self.wide { 1.5 * self.op.lengths[0].max(self.op.lengths[1]) / zip.len() as f64 } else { 0.0 };
        for n in 0..self.nodes.len() {
            let at: Vec<DVec2> = self.nodes[n].vertices.iter().map(|&u| self.aligned(u)).collect();
            let stays = self.nodes[n]
                .vertices
                .iter()
                .zip(&at)
                .filter(|(u, _)| {
                    self.target == Target::Kept && !self.mesh.star[**u as usize].iter().any(|f| self.comes(*f))
                })
                .map(|(_, p)| *p);
            let (sum, count) = stays.fold((DVec2::ZERO, 0.0), |(s, c), p| (s + p, c + 1.0));
            let target = match count {
                0.0 => at.iter().sum::<DVec2>() / at.len() as f64,
                // One vertex stays bit for bit.
                1.0 => sum,
                _ => sum / count,
            };
            // What fits to within rounding takes the place that is there already.
            let spread = at.iter().map(|p| p.distance(target)).fold(0.0, f64::max);
            let node = &mut self.nodes[n];
            node.at = if spread <= STILL { at[0] } else { target };
            if spread > STILL {
                node.budget = self.params.alpha() * spread * if self.wide { 3.0 } else { 1.0 } + extra;
                node.free = self.target == Target::Mean;
            }
            largest = largest.max(spread);
        }
        largest
    }

    /// Spreads deformation from the seam: a vertex within alpha displacements of a fused one is free (section 4.2.2). Distances are
    /// taken to the fused vertex through which a vertex was reached.
    fn spread(&mut self) {
        let mesh = self.mesh;
        // (budget left, node, source): the largest first; all are finite.
        let mut heap: BinaryHeap<Reach> = BinaryHeap::new();
        for (n, node) in self.nodes.iter().enumerate() {
            if node.budget >= 0.0 {
                heap.push(Reach { left: node.budget, node: n as u32, source: n as u32 });
            }
        }
        let radius: Vec<f64> = self.nodes.iter().map(|n| n.budget).collect();
        while let Some(Reach { left, node, source }) = heap.pop() {
            if left < self.nodes[node as usize].budget || self.nodes.len() > self.widest() {
                continue;
            }
            let from = self.nodes[source as usize].at;
            for i in 0..self.nodes[node as usize].vertices.len() {
                let u = self.nodes[node as usize].vertices[i];
                if self.target == Target::Kept && mesh.star[u as usize].first().is_some_and(|f| !self.comes(*f)) {
                    continue;
                }
                for &f in &mesh.star[u as usize] {
                    for w in mesh.corners[f as usize] {
                        if w == u {
                            continue;
                        }
                        let at = self.aligned(w);
                        let left = radius[source as usize] - at.distance(from);
                        if left < 0.0 || left.is_nan() {
                            continue;
                        }
                        let known = self.scratch.node(w);
                        let n = known.unwrap_or(self.nodes.len() as u32);
                        if known.is_none() {
                            self.scratch.node[w as usize] = (self.scratch.epoch, n);
                            self.nodes.push(Node {
                                vertices: vec![w],
                                at,
                                budget: f64::NEG_INFINITY,
                                free: true,
                                seam: false,
                            });
                        }
                        let own = &mut self.nodes[n as usize];
                        if own.seam && self.target == Target::Kept {
                            continue;
                        }
                        if left > own.budget {
                            own.budget = left;
                            own.free = true;
                            heap.push(Reach { left, node: n, source });
                        }
                    }
                }
            }
        }
    }

    /// Collects the faces with a corner that moves.
    fn gather(&mut self) -> Result<(), Reason> {
        if self.nodes.len() > self.widest() {
            return Err(Reason::Local);
        }
        for n in 0..self.nodes.len() {
            for i in 0..self.nodes[n].vertices.len() {
                let u = self.nodes[n].vertices[i];
                if !self.nodes[n].free && self.aligned(u) == self.nodes[n].at {
                    continue;
                }
                for &f in &self.mesh.star[u as usize] {
                    if self.scratch.in_band(f).is_none() {
                        self.scratch.band[f as usize] = (self.scratch.epoch, self.band.len() as u32);
                        self.band.push(f);
                    }
                }
            }
        }
        Ok(())
    }

    /// A face between two vertices that become one would vanish.
    fn vanishes(&self) -> bool {
        let collapses = |f: &u32| {
            let c = self.mesh.corners[*f as usize];
            let n = c.map(|u| self.scratch.node(u));
            (0..3).any(|k| c[k] != c[(k + 1) % 3] && n[k].is_some() && n[k] == n[(k + 1) % 3])
        };
        self.nodes.iter().flat_map(|n| &n.vertices).any(|&u| self.mesh.star[u as usize].iter().any(collapses))
    }

    fn merge(&self, zip: Vec<(u32, u32)>) -> Merge {
        let mut merge = Merge {
            zip,
            fuse: Vec::new(),
            places: Vec::new(),
            band: Vec::with_capacity(self.band.len()),
            deformed: Vec::new(),
            energy: 0.0,
        };
        for node in &self.nodes {
            let [first, rest @ ..] = node.vertices.as_slice() else { continue };
            merge.fuse.extend(rest.iter().map(|&u| (u, *first)));
            if self.aligned(*first) != node.at {
                merge.places.push((*first, node.at));
            }
        }
        for &f in &self.band {
            let (now, aligned) = (self.placed_triangle(f), self.aligned_triangle(f));
            let energy = self.mesh.energy_at(f, &now);
            merge.band.push((f, energy));
            merge.energy += energy - self.mesh.energy[f as usize];
            if now.iter().zip(&aligned).any(|(p, q)| p.distance(*q) > STILL) {
                merge.deformed.push(f);
            }
        }
        merge
    }
}

/// A vertex reached from a fused one.
struct Reach {
    left: f64,
    node: u32,
    source: u32,
}

impl PartialEq for Reach {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Reach {}

impl PartialOrd for Reach {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Reach {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.left.total_cmp(&other.left).then(other.node.cmp(&self.node)).then(other.source.cmp(&self.source))
    }
}

/// Whether two faces overlap that did not in the input, or more than there.
fn clash(mesh: &Mesh, f: u32, at: &[DVec2; 3], g: u32, there: &[DVec2; 3]) -> bool {
    let slack = 5.0 * mesh.tolerance;
    if !triangles_overlap(at, there) {
        return false;
    }
    let depth = penetration(at, there);
    if depth <= slack {
        return false;
    }
    let (p, q) = (&mesh.rest[f as usize], &mesh.rest[g as usize]);
    let before = penetration(p, q);
    before == 0.0 || depth > before * 1.01 + slack
}
