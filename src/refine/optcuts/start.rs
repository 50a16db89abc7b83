//! A first map of a surface of any topology (section 6.2): cut open until it is a disk with holes, then Tutte's embedding.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};

use glam::DVec2;

use super::cut_map::CutMap;
use crate::atlas::groups::{Cost, DisjointSets};
use crate::atlas::{Charts, HalfEdge, Loops, UvId};
use crate::error::Result;
use crate::numeric::tutte;

/// Rounds of cutting, and those without a better map after which the best will do.
const ROUNDS: usize = 200;
const PATIENCE: usize = 10;

/// Cuts the surface open where it must be, and embeds it; as long as its E_d is more than `enough`, it is cut from the border to the extremum (Gu et al. 2002)
/// and embedded anew, which is much less work than to improve a bad map. `None` where it cannot be embedded.
///
/// # Errors
/// `canceled`.
pub(super) fn embed(map: &mut CutMap, enough: f64, interrupt: &dyn Fn() -> Result<bool>) -> Result<Option<()>> {
    cut_handles(map);
    if map.borders.is_empty() && cut_closed(map).is_none() {
        return Ok(None);
    }
    // Cuts make the map of a long border worse: the best map counts then.
    let mut best: Option<(f64, CutMap)> = None;
    let mut since = 0;
    for round in 0..ROUNDS {
        let out_of_time = interrupt()?;
        if tutte(map).is_some() {
            let distortion = map.distortion();
            if distortion < enough {
                return Ok(Some(()));
            }
            if best.as_ref().is_none_or(|(least, _)| distortion < *least) {
                (best, since) = (Some((distortion, map.clone())), round);
            }
        }
        let path = extremum(map).and_then(|worst| path_to_border(map, worst));
        let last = best.is_some() && (out_of_time || round >= since + PATIENCE);
        match path.filter(|_| !last) {
            Some(path) => cut(map, &path),
            None => break,
        }
    }
    Ok(best.map(|(_, found)| *map = found))
}

/// Cuts along edges, leaving positions as they are.
fn cut(map: &mut CutMap, path: &[HalfEdge]) {
    map.mesh.cut(path);
    let uv = &map.mesh.atlas().uv;
    map.x.extend(uv[map.x.len()..].iter());
    map.find_borders();
}

/// Two edges in a row, as straight as they come.
fn cut_closed(map: &mut CutMap) -> Option<()> {
    let corner = HalfEdge(0);
    let fan = map.fan(map.mesh.uv_at(corner)).corners;
    if fan.len() < 3 {
        return None;
    }
    cut(map, &[fan[0], fan[fan.len() / 2]]);
    Some(())
}

/// Loops about the handles, short ones.
fn cut_handles(map: &mut CutMap) {
    let topology = map.mesh.topology();
    let charts = Charts::new(topology);
    let loops = Loops::new(topology, &charts);
    let n = map.x.len() as i64;
    let faces = map.rest.len() as i64;
    let edges = (3 * faces + map.borders.len() as i64) / 2;
    let genus = (2 - loops.half_edges.len() as i64 - (n - edges + faces)) / 2;
    if genus <= 0 || charts.len() != 1 {
        return;
    }
    // From each of some base points.
    let tries = 24.min(n);
    let best = (0..tries)
        .map(|k| (k * n / tries) as u32)
        .map(|base| {
            let cut = cut_graph(map, &loops, UvId(base));
            (Cost(cut.iter().map(|h| map.cost[h.index()]).sum()), cut)
        })
        .min_by_key(|(cost, _)| *cost);
    if let Some((_, path)) = best {
        cut(map, &path);
    }
}

/// The greedy system of loops through a base point (Erickson and Whittlesey 2005), and without the tails that no loop needs: edges whose removal leaves
/// a surface without handles in one part. Each hole is a face to it, whose edges need no cutting.
fn cut_graph(map: &CutMap, holes: &Loops, base: UvId) -> Vec<HalfEdge> {
    let (distance, towards) = distances(map, base, true);
    let topology = map.mesh.topology();
    let edge = |h: HalfEdge| topology.uv_twin(h).map_or(h, |t| h.min(t));
    let in_tree: BTreeSet<HalfEdge> = towards.iter().flatten().map(|h| edge(*h)).collect();
    let faces = map.rest.len() as u32;
    let numbered = (faces..).zip(&holes.half_edges);
    let hole: BTreeMap<HalfEdge, u32> = numbered.flat_map(|(n, own)| own.iter().map(move |h| (*h, n))).collect();
    // Largest loops are crossed first by the tree of faces.
    let mut crossing: Vec<(Cost, HalfEdge)> = topology
        .half_edges()
        .filter(|h| edge(*h) == *h && !in_tree.contains(h))
        .map(|h| {
            let [a, b] = map.mesh.uv_ends(h).map(|u| distance[u.index()]);
            (Cost(-(a + b + map.cost[h.index()])), h)
        })
        .collect();
    crossing.sort_unstable();
    let mut parts = DisjointSets::new(map.rest.len() + holes.half_edges.len());
    let mut left = Vec::new();
    for (_, h) in crossing {
        let across = topology.uv_twin(h).map(|t| t.face().0).or_else(|| hole.get(&h).copied());
        let Some(across) = across else { continue };
        if parts.find(h.face().0) == parts.find(across) {
            left.push(h);
        } else {
            parts.unite(h.face().0, across);
        }
    }
    let mut graph: BTreeSet<HalfEdge> = left.iter().copied().collect();
    for h in &left {
        for mut u in map.mesh.uv_ends(*h) {
            while let Some(next) = towards[u.index()] {
                if !graph.insert(edge(next)) {
                    break;
                }
                u = other_end(map, next, u);
            }
        }
    }
    // Tails: edges with an end of degree one.
    let mut degree: BTreeMap<UvId, u32> = BTreeMap::new();
    graph.iter().flat_map(|h| map.mesh.uv_ends(*h)).for_each(|u| *degree.entry(u).or_default() += 1);
    loop {
        let loose: Vec<HalfEdge> =
            graph.iter().copied().filter(|h| map.mesh.uv_ends(*h).iter().any(|u| degree[u] == 1)).collect();
        if loose.is_empty() {
            break;
        }
        for h in loose {
            graph.remove(&h);
            for u in map.mesh.uv_ends(h) {
                degree.entry(u).and_modify(|d| *d -= 1);
            }
        }
    }
    graph.retain(|h| topology.uv_twin(*h).is_some());
    graph.into_iter().collect()
}

/// The end of an edge that is not the one given.
fn other_end(map: &CutMap, h: HalfEdge, u: UvId) -> UvId {
    let [a, b] = map.mesh.uv_ends(h);
    if a == u { b } else { a }
}

/// Distances along edges from a vertex, and by vertex the edge towards there: the half edge that leaves it, where it has one.
/// `borders`: whether border edges count.
fn distances(map: &CutMap, from: UvId, borders: bool) -> (Vec<f64>, Vec<Option<HalfEdge>>) {
    let mut distance = vec![f64::INFINITY; map.x.len()];
    let mut towards = vec![None; map.x.len()];
    let mut heap = BinaryHeap::from([Reverse((Cost(0.0), from.0))]);
    distance[from.index()] = 0.0;
    while let Some(Reverse((Cost(d), u))) = heap.pop() {
        if d > distance[u as usize] {
            continue;
        }
        for corner in map.mesh.corners_of(UvId(u)) {
            for h in [corner, corner.previous()] {
                let twin = map.mesh.topology().uv_twin(h);
                if twin.is_none() && !borders {
                    continue;
                }
                // The one that ends here, if there is one.
                let back = if h == corner { twin.unwrap_or(h) } else { h };
                let v = other_end(map, h, UvId(u));
                let to = d + map.cost[h.index()];
                if to < distance[v.index()] {
                    distance[v.index()] = to;
                    towards[v.index()] = Some(back);
                    heap.push(Reverse((Cost(to), v.0)));
                }
            }
        }
    }
    (distance, towards)
}

/// The shortest path of interior edges from a vertex to the border, from the border on: half edges, each leaving the vertex at which the one before ends.
pub(super) fn path_to_border(map: &CutMap, from: UvId) -> Option<Vec<HalfEdge>> {
    let (distance, towards) = distances(map, from, false);
    let mut is_border = vec![false; map.x.len()];
    map.borders.iter().flat_map(|h| map.mesh.uv_ends(*h)).for_each(|u| is_border[u.index()] = true);
    let end = (0..map.x.len())
        .filter(|u| is_border[*u] && distance[*u].is_finite())
        .min_by_key(|u| (Cost(distance[*u]), *u))?;
    let mut path = Vec::new();
    let mut at = UvId::new(end);
    while let Some(h) = towards[at.index()] {
        if !path.is_empty() && is_border[at.index()] {
            // It touches the border on its way: only the part beyond is needed.
            path.clear();
        }
        path.push(h);
        at = map.end(h);
    }
    (!path.is_empty()).then_some(path)
}

/// The interior vertex about which the map is worst: the extremum of Gu et al. (2002).
pub(super) fn extremum(map: &CutMap) -> Option<UvId> {
    let mut worst: Vec<f64> = vec![0.0; map.x.len()];
    let mut area = vec![0.0; map.x.len()];
    for face in map.mesh.atlas().faces() {
        let rest = &map.rest[face.index()];
        let energy = rest.energy(map.triangle(face)).min(1e300);
        for u in map.mesh.atlas().corners[face.index()] {
            worst[u.index()] += energy;
            area[u.index()] += rest.weight;
        }
    }
    map.borders.iter().flat_map(|h| map.mesh.uv_ends(*h)).for_each(|u| worst[u.index()] = 0.0);
    (0..map.x.len())
        .filter(|u| worst[*u] > 0.0)
        .max_by_key(|u| (Cost(worst[*u] / area[*u]), Reverse(*u)))
        .map(UvId::new)
}

/// Tutte's embedding with the longest loop on a circle; the others are filled by a vertex each.
fn tutte(map: &mut CutMap) -> Option<()> {
    let topology = map.mesh.topology();
    let charts = Charts::new(topology);
    let loops = Loops::new(topology, &charts);
    let length = |l: &Vec<HalfEdge>| l.iter().map(|h| map.edge_length(*h)).sum::<f64>();
    let longest = (0..loops.half_edges.len()).max_by_key(|k| (Cost(length(&loops.half_edges[*k])), Reverse(*k)))?;
    let n = map.x.len();
    let mut x = vec![DVec2::ZERO; n + loops.half_edges.len()];
    let mut held = vec![false; x.len()];
    // Vertices that no face uses hang on nothing.
    held[..n].fill(true);
    map.mesh.atlas().corners.iter().flatten().for_each(|u| held[u.index()] = false);
    let mut edges = Vec::new();
    for h in topology.half_edges().filter(|h| topology.uv_twin(*h).is_none_or(|t| t > *h)) {
        edges.push(map.mesh.uv_ends(h).map(|u| u.0));
    }
    for (k, own) in loops.half_edges.iter().enumerate() {
        if k == longest {
            held[n + k] = true;
            let lengths: Vec<f64> = own.iter().map(|h| map.edge_length(*h)).collect();
            for (h, at) in own.iter().zip(tutte::on_circle(&lengths, 1.0)) {
                let u = map.mesh.uv_at(*h).index();
                x[u] = at;
                held[u] = true;
            }
        } else {
            edges.extend(own.iter().map(|h| [map.mesh.uv_at(*h).0, (n + k) as u32]));
        }
    }
    let guide = guide(map, x.len());
    tutte::embed(&mut x, &held, &edges, &guide)?;
    // The void about a hole is not the void outside: its middle is dropped.
    x.truncate(n);
    map.x = x;
    map.mesh.atlas().faces().all(|f| map.rest[f.index()].energy(map.triangle(f)).is_finite()).then_some(())
}

/// A picture of the surface that halves it well: seen from somewhere that no axis looks along.
fn guide(map: &CutMap, n: usize) -> Vec<DVec2> {
    let mut guide = vec![DVec2::ZERO; n];
    for corner in map.mesh.topology().half_edges() {
        let p = map.mesh.atlas().surface.positions[map.mesh.vertex_at(corner).index()];
        guide[map.mesh.uv_at(corner).index()] = DVec2::new(p.x + 0.37 * p.z, p.y - 0.29 * p.z);
    }
    guide
}
