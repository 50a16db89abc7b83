//! Sparse Cholesky factorisation of the Hessians of triangle meshes, two unknowns a vertex.
//!
//! The multifrontal method (Duff and Reid 1983) on a nested dissection of the plane (George 1973): the vertices of a mesh that is laid
//! into the plane are halved by straight lines again and again; the line's neighbours are a separator and one dense front. A triangle's
//! own 6 x 6 matrix goes directly into the front that eliminates its first vertex, so that no sparse matrix is ever formed.

use glam::{DMat2, DVec2};

use crate::atlas::groups::{Grouped, sorted_unique};

/// No vertex: one that is held fixed.
pub(crate) const FIXED: u32 = u32::MAX;

/// Most vertices of a part that is not halved any more.
const LEAF: usize = 20;
/// Separators longer than this, in units of the square root of what they separate, are worth a search for shorter ones.
const WIDE: f64 = 2.5;
/// Mark of what separates two halves.
const SEPARATES: u32 = u32::MAX;

/// A dense front: what is eliminated together, and all that these touch.
#[derive(Debug, Clone)]
struct Front {
    /// First of its own in the order of elimination.
    start: u32,
    /// How many are its own.
    own: u32,
    /// Places in the order of elimination beyond the own ones, ascending.
    rest: Vec<u32>,
    parent: u32,
    /// Row in the parent's front of each of `rest`.
    in_parent: Vec<u32>,
    /// Elements whose first vertex is eliminated here: range in `Structure::elements`.
    elements: std::ops::Range<usize>,
}

impl Front {
    fn rows(&self) -> usize {
        self.own as usize + self.rest.len()
    }
}

/// The order of elimination of a mesh, and its fronts. It depends on which vertices the triangles join, not on where they are: positions only
/// make it better or worse.
#[derive(Debug, Clone)]
pub(crate) struct Structure {
    /// Vertex by place.
    order: Vec<u32>,
    fronts: Vec<Front>,
    /// (element, rows of its corners in the front, `FIXED` for those that are not free).
    elements: Vec<(u32, [u32; 3])>,
}

/// The factor of a mesh's Hessian, and the room in which it was made: one that is used again allocates nothing.
#[derive(Debug, Clone, Default)]
pub(crate) struct Factor {
    /// The columns of the own unknowns of each front, column-major, one front after the other.
    panels: Vec<f64>,
    /// By front: what it left over for its parent.
    updates: Vec<Vec<f64>>,
    /// By front: children whose updates wait.
    waiting: Vec<Vec<u32>>,
    spare: Vec<Vec<f64>>,
    dense: Vec<f64>,
}

impl Structure {
    /// Of triangles of free vertices 0..n at `at`; corners that are held fixed are [`FIXED`].
    pub fn new(at: &[DVec2], triangles: &[[u32; 3]]) -> Self {
        let n = at.len();
        let pairs = triangles.iter().flat_map(|t| (0..6).map(|k| (t[k / 2], t[(k / 2 + 1 + k % 2) % 3])));
        let graph = Grouped::new(n, pairs.filter(|(a, b)| *a != FIXED && *b != FIXED));
        let mut vertices: Vec<u32> = (0..n as u32).collect();
        let mut dissection = Dissection {
            at,
            graph: &graph,
            side: vec![0; n],
            round: 0,
            order: Vec::with_capacity(n),
            parts: Vec::new(),
        };
        dissection.part(&mut vertices);
        let Dissection { order, parts, .. } = dissection;
        let mut place = vec![0u32; n];
        order.iter().enumerate().for_each(|(p, &v)| place[v as usize] = p as u32);
        // By place: the front that eliminates it.
        let mut front_of = vec![0u32; n];
        for (f, part) in parts.iter().enumerate() {
            front_of[part.start as usize..(part.start + part.own) as usize].fill(f as u32);
        }
        let mut fronts: Vec<Front> = Vec::with_capacity(parts.len());
        let mut children: Vec<Vec<u32>> = vec![Vec::new(); parts.len()];
        for (f, part) in parts.iter().enumerate() {
            let end = part.start + part.own;
            let own = order[part.start as usize..end as usize].iter();
            let touched = own.flat_map(|&v| graph.of(v)).map(|&u| place[u as usize]);
            let inherited = children[f].iter().flat_map(|&c| fronts[c as usize].rest.iter().copied());
            let rest = sorted_unique(touched.chain(inherited).filter(|&p| p >= end));
            let parent = rest.first().map_or(FIXED, |&p| front_of[p as usize]);
            if parent != FIXED {
                children[parent as usize].push(f as u32);
            }
            fronts.push(Front {
                start: part.start,
                own: part.own,
                rest,
                parent,
                in_parent: Vec::new(),
                elements: 0..0,
            });
        }
        for f in 0..fronts.len() {
            if let Some(parent) = fronts.get(fronts[f].parent as usize) {
                let rows = fronts[f].rest.iter().map(|&p| row_in(parent, p)).collect();
                fronts[f].in_parent = rows;
            }
        }
        let first = |t: &[u32; 3]| t.iter().filter(|v| **v != FIXED).map(|v| place[*v as usize]).min();
        let by_front = (0..triangles.len()).filter_map(|e| Some((front_of[first(&triangles[e])? as usize], e as u32)));
        let by_front = Grouped::new(fronts.len(), by_front);
        let mut elements = Vec::with_capacity(triangles.len());
        for (f, front) in fronts.iter_mut().enumerate() {
            let from = elements.len();
            for &e in by_front.of(f as u32) {
                let rows =
                    triangles[e as usize].map(|v| if v == FIXED { FIXED } else { row_in(front, place[v as usize]) });
                elements.push((e, rows));
            }
            front.elements = from..elements.len();
        }
        Structure { order, fronts, elements }
    }

    /// Factors the sum of the elements' matrices: `element` gives the blocks of one as [`super::dirichlet::RestTriangle::projected_hessian`] does.
    /// `ridge` is added to the diagonal. False where the sum is not positive definite; the factor is of no use then.
    pub fn factor(&self, ridge: f64, element: impl Fn(u32) -> [DMat2; 6], factor: &mut Factor) -> bool {
        let Factor { panels, updates, waiting, spare, dense } = factor;
        panels.clear();
        spare.extend(updates.drain(..).filter(|u| u.capacity() > 0));
        updates.resize_with(self.fronts.len(), Vec::new);
        waiting.iter_mut().for_each(Vec::clear);
        waiting.resize_with(self.fronts.len(), Vec::new);
        for (f, front) in self.fronts.iter().enumerate() {
            let (n, own) = (2 * front.rows(), 2 * front.own as usize);
            dense.clear();
            dense.resize(n * n, 0.0);
            (0..own).for_each(|k| dense[k * n + k] = ridge);
            for (e, rows) in &self.elements[front.elements.clone()] {
                add_element(dense, n, rows, &element(*e));
            }
            for &child in &waiting[f] {
                let update = std::mem::take(&mut updates[child as usize]);
                add_update(dense, n, &update, &self.fronts[child as usize].in_parent);
                spare.push(update);
            }
            if !eliminate(dense, n, own) {
                return false;
            }
            panels.extend_from_slice(&dense[..n * own]);
            if front.parent != FIXED {
                let mut update = spare.pop().unwrap_or_default();
                update.clear();
                for k in own..n {
                    update.extend_from_slice(&dense[k * n + own..(k + 1) * n]);
                }
                updates[f] = update;
                waiting[front.parent as usize].push(f as u32);
            }
        }
        true
    }

    /// Solves with a factor of this structure, in place.
    pub fn solve(&self, factor: &Factor, b: &mut [DVec2]) {
        let mut x: Vec<f64> = self.order.iter().flat_map(|&v| b[v as usize].to_array()).collect();
        let mut local: Vec<f64> = Vec::new();
        let mut from = 0;
        for front in &self.fronts {
            let (n, own, start) = (2 * front.rows(), 2 * front.own as usize, 2 * front.start as usize);
            let panel = &factor.panels[from..from + n * own];
            from += n * own;
            local.clear();
            local.resize(n - own, 0.0);
            let (head, _) = x.split_at_mut(start + own);
            let head = &mut head[start..];
            for k in 0..own {
                let column = &panel[k * n..(k + 1) * n];
                let value = head[k] / column[k];
                head[k] = value;
                for (h, l) in head[k + 1..].iter_mut().zip(&column[k + 1..own]) {
                    *h -= l * value;
                }
                for (h, l) in local.iter_mut().zip(&column[own..]) {
                    *h += l * value;
                }
            }
            for (pair, &p) in local.as_chunks::<2>().0.iter().zip(&front.rest) {
                x[2 * p as usize] -= pair[0];
                x[2 * p as usize + 1] -= pair[1];
            }
        }
        for front in self.fronts.iter().rev() {
            let (n, own, start) = (2 * front.rows(), 2 * front.own as usize, 2 * front.start as usize);
            from -= n * own;
            let panel = &factor.panels[from..from + n * own];
            local.clear();
            local.extend(front.rest.iter().flat_map(|&p| [x[2 * p as usize], x[2 * p as usize + 1]]));
            for k in (0..own).rev() {
                let column = &panel[k * n..(k + 1) * n];
                let below: f64 =
                    column[k + 1..own].iter().zip(&x[start + k + 1..start + own]).map(|(l, v)| l * v).sum();
                let beyond: f64 = column[own..].iter().zip(&local).map(|(l, v)| l * v).sum();
                x[start + k] = (x[start + k] - below - beyond) / column[k];
            }
        }
        for (&v, pair) in self.order.iter().zip(x.as_chunks::<2>().0) {
            b[v as usize] = DVec2::new(pair[0], pair[1]);
        }
    }
}

/// The row of a place in a front.
fn row_in(front: &Front, place: u32) -> u32 {
    if place < front.start + front.own {
        return place - front.start;
    }
    front.own + front.rest.partition_point(|&p| p < place) as u32
}

/// Adds the lower blocks of an element.
fn add_element(dense: &mut [f64], n: usize, rows: &[u32; 3], blocks: &[DMat2; 6]) {
    for (block, (i, k)) in blocks.iter().zip([(0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)]) {
        let (r, c) = (rows[i], rows[k]);
        if r == FIXED || c == FIXED {
            continue;
        }
        let (r, c, block) = if r >= c { (r, c, *block) } else { (c, r, block.transpose()) };
        let at = 2 * c as usize * n + 2 * r as usize;
        dense[at] += block.x_axis.x;
        dense[at + 1] += block.x_axis.y;
        if r != c {
            dense[at + n] += block.y_axis.x;
        }
        dense[at + n + 1] += block.y_axis.y;
    }
}

/// Adds what a child left over.
fn add_update(dense: &mut [f64], n: usize, update: &[f64], rows: &[u32]) {
    let m = 2 * rows.len();
    for (k, &c) in rows.iter().enumerate() {
        let from = [&update[2 * k * m..(2 * k + 1) * m], &update[(2 * k + 1) * m..(2 * k + 2) * m]];
        for (i, &r) in rows.iter().enumerate().skip(k) {
            let at = 2 * c as usize * n + 2 * r as usize;
            dense[at] += from[0][2 * i];
            dense[at + 1] += from[0][2 * i + 1];
            dense[at + n] += from[1][2 * i];
            dense[at + n + 1] += from[1][2 * i + 1];
        }
    }
}

/// Columns that are eliminated together.
const BLOCK: usize = 4;

/// [`eliminate_with`] in the widest registers that the processor has.
fn eliminate(dense: &mut [f64], n: usize, own: usize) -> bool {
    #[cfg(target_arch = "x86_64")]
    if n > 16 && std::arch::is_x86_feature_detected!("avx2") {
        #[target_feature(enable = "avx2")]
        fn wide(dense: &mut [f64], n: usize, own: usize) -> bool {
            eliminate_with(dense, n, own)
        }
        // SAFETY: the processor has what the function is compiled for.
        #[allow(unsafe_code)]
        return unsafe { wide(dense, n, own) };
    }
    eliminate_with(dense, n, own)
}

/// Eliminates the first `own` of `n` columns of a lower triangle, column-major; the rest becomes the Schur complement. False where a pivot is not positive.
#[inline(always)]
fn eliminate_with(dense: &mut [f64], n: usize, own: usize) -> bool {
    let mut done = 0;
    while done < own {
        let block = BLOCK.min(own - done);
        for k in done..done + block {
            let (before, column) = dense.split_at_mut(k * n);
            let column = &mut column[k..n];
            for p in done..k {
                let other = &before[p * n + k..p * n + n];
                let l = other[0];
                column.iter_mut().zip(other).for_each(|(c, o)| *c -= l * o);
            }
            let pivot = column[0];
            if !(pivot > 0.0 && pivot.is_finite()) {
                return false;
            }
            let inverse = 1.0 / pivot.sqrt();
            column.iter_mut().for_each(|c| *c *= inverse);
        }
        let next = done + block;
        let (panel, trailing) = dense.split_at_mut(next * n);
        if block == BLOCK {
            let columns: [&[f64]; BLOCK] = std::array::from_fn(|p| &panel[(done + p) * n..(done + p + 1) * n]);
            for (j, column) in (next..n).zip(trailing.chunks_exact_mut(n)) {
                subtract(&mut column[j..], columns.map(|c| &c[j..n]));
            }
        } else {
            for (j, column) in (next..n).zip(trailing.chunks_exact_mut(n)) {
                for p in done..next {
                    let other = &panel[p * n + j..p * n + n];
                    let l = other[0];
                    column[j..].iter_mut().zip(other).for_each(|(c, o)| *c -= l * o);
                }
            }
        }
        done = next;
    }
    true
}

/// `target -= sum of columns, each times its first entry`.
#[inline(always)]
fn subtract(target: &mut [f64], [a, b, c, d]: [&[f64]; BLOCK]) {
    let n = target.len();
    let (a, b, c, d) = (&a[..n], &b[..n], &c[..n], &d[..n]);
    let (la, lb, lc, ld) = (a[0], b[0], c[0], d[0]);
    for i in 0..n {
        target[i] -= (la * a[i] + lb * b[i]) + (lc * c[i] + ld * d[i]);
    }
}

/// A part of the order that is eliminated together.
struct Part {
    start: u32,
    own: u32,
}

struct Dissection<'a> {
    at: &'a [DVec2],
    graph: &'a Grouped<u32>,
    /// Round in which a vertex was last of the upper half.
    side: Vec<u32>,
    round: u32,
    order: Vec<u32>,
    parts: Vec<Part>,
}

impl Dissection<'_> {
    /// Orders some vertices: both halves, then what separates them.
    fn part(&mut self, vertices: &mut [u32]) {
        if vertices.len() <= LEAF {
            return self.take(vertices);
        }
        let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        for &v in vertices.iter() {
            low = low.min(self.at[v as usize]);
            high = high.max(self.at[v as usize]);
        }
        let across = (high - low).y > (high - low).x;
        let middle = self.halve(vertices, across);
        let mut separator: Vec<u32> = vertices[..middle].iter().copied().filter(|v| self.is_beside(*v)).collect();
        if separator.len() as f64 > WIDE * (vertices.len() as f64).sqrt() {
            // Where long triangles cross the line, few of their corners may do; or another line.
            let own = self.cover(&separator);
            self.halve(vertices, !across);
            let beside: Vec<u32> = vertices[..middle].iter().copied().filter(|v| self.is_beside(*v)).collect();
            let other = self.cover(&beside);
            separator = if other.len() < own.len() {
                other
            } else {
                self.halve(vertices, across);
                own
            };
        }
        // What separates goes to the end of its half, and is no part of it.
        separator.iter().for_each(|v| self.side[*v as usize] = SEPARATES);
        let side = &self.side;
        let kept = |half: &mut [u32]| {
            let mut kept = 0;
            for k in 0..half.len() {
                if side[half[k] as usize] != SEPARATES {
                    half.swap(kept, k);
                    kept += 1;
                }
            }
            kept
        };
        let (lower, upper) = vertices.split_at_mut(middle);
        let counts = [kept(lower), kept(upper)];
        separator.iter().for_each(|v| self.side[*v as usize] = 0);
        self.part(&mut lower[..counts[0]]);
        self.part(&mut upper[..counts[1]]);
        separator.sort_unstable();
        self.take(&separator);
    }

    /// Puts the lower half of some vertices along an axis before the upper one, which is marked; gives where that begins.
    fn halve(&mut self, vertices: &mut [u32], across: bool) -> usize {
        let key = |v: u32| if across { self.at[v as usize].y } else { self.at[v as usize].x };
        let middle = vertices.len() / 2;
        vertices.select_nth_unstable_by(middle, |&a, &b| key(a).total_cmp(&key(b)).then(a.cmp(&b)));
        self.round += 1;
        vertices[middle..].iter().for_each(|&v| self.side[v as usize] = self.round);
        middle
    }

    /// Whether a vertex has a neighbour in the upper half.
    fn is_beside(&self, v: u32) -> bool {
        self.graph.of(v).iter().any(|&u| self.side[u as usize] == self.round)
    }

    /// The fewest vertices of both halves that hold all edges between them (König 1931), `lower` being those of the lower half that have any.
    fn cover(&self, lower: &[u32]) -> Vec<u32> {
        let across = |v: u32| {
            let mut own: Vec<u32> =
                self.graph.of(v).iter().copied().filter(|&u| self.side[u as usize] == self.round).collect();
            own.sort_unstable();
            own.dedup();
            own
        };
        let edges: Vec<Vec<u32>> = lower.iter().map(|v| across(*v)).collect();
        let upper = sorted_unique(edges.iter().flatten().copied());
        let edges: Vec<Vec<usize>> =
            edges.into_iter().map(|own| own.into_iter().map(|u| upper.partition_point(|x| *x < u)).collect()).collect();
        // A largest matching, by augmenting paths.
        let mut mate_of_upper: Vec<Option<usize>> = vec![None; upper.len()];
        let mut mate_of_lower: Vec<Option<usize>> = vec![None; lower.len()];
        let mut seen = vec![usize::MAX; upper.len()];
        for root in 0..lower.len() {
            // (vertex of the lower half, its next edge); what leads from one to the next is that edge.
            let mut path = vec![(root, 0)];
            while let Some((v, next)) = path.last_mut() {
                let Some(&u) = edges[*v].get(*next) else {
                    path.pop();
                    continue;
                };
                *next += 1;
                if std::mem::replace(&mut seen[u], root) == root {
                    continue;
                }
                match mate_of_upper[u] {
                    Some(other) => path.push((other, 0)),
                    None => {
                        for (v, next) in path.drain(..) {
                            let u = edges[v][next - 1];
                            mate_of_upper[u] = Some(v);
                            mate_of_lower[v] = Some(u);
                        }
                    }
                }
            }
        }
        // What alternating paths reach from what has no mate: the cover is the rest of the lower and the reached of the upper half.
        let mut reached_lower: Vec<bool> = mate_of_lower.iter().map(Option::is_none).collect();
        let mut reached_upper = vec![false; upper.len()];
        let mut stack: Vec<usize> = (0..lower.len()).filter(|v| reached_lower[*v]).collect();
        while let Some(v) = stack.pop() {
            for &u in &edges[v] {
                if !std::mem::replace(&mut reached_upper[u], true)
                    && let Some(mate) = mate_of_upper[u]
                    && !std::mem::replace(&mut reached_lower[mate], true)
                {
                    stack.push(mate);
                }
            }
        }
        let own = lower.iter().zip(&reached_lower).filter(|(_, reached)| !**reached).map(|(v, _)| *v);
        own.chain(upper.iter().zip(&reached_upper).filter(|(_, reached)| **reached).map(|(u, _)| *u)).collect()
    }

    fn take(&mut self, vertices: &[u32]) {
        if !vertices.is_empty() {
            self.parts.push(Part { start: self.order.len() as u32, own: vertices.len() as u32 });
            self.order.extend_from_slice(vertices);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::testing::Rng;
    use crate::numeric::dirichlet::RestTriangle;

    /// A jittered grid of triangles.
    fn grid(side: usize, rng: &mut Rng) -> (Vec<DVec2>, Vec<[u32; 3]>) {
        let at = |i: usize, j: usize| (i * side + j) as u32;
        let mut points = Vec::new();
        let mut triangles = Vec::new();
        for i in 0..side {
            for j in 0..side {
                points.push(DVec2::new(j as f64, i as f64) + rng.point(0.3));
                if i + 1 < side && j + 1 < side {
                    triangles.push([at(i, j), at(i, j + 1), at(i + 1, j)]);
                    triangles.push([at(i, j + 1), at(i + 1, j + 1), at(i + 1, j)]);
                }
            }
        }
        (points, triangles)
    }

    #[test]
    fn the_solution_solves_the_sum_of_the_elements() {
        let mut rng = Rng(11);
        for side in [2, 3, 7, 20, 41] {
            let (points, mut triangles) = grid(side, &mut rng);
            let hold = |v: u32| if v % 5 == 3 { FIXED } else { v };
            let rest = |t: &[u32; 3]| RestTriangle::new(t.map(|v| points[v as usize]), 1.0).expect("it has an area");
            let blocks: Vec<[DMat2; 6]> =
                triangles.iter().map(|t| rest(t).projected_hessian(t.map(|v| 1.1 * points[v as usize]))).collect();
            triangles.iter_mut().for_each(|t| *t = t.map(hold));
            let structure = Structure::new(&points, &triangles);
            let mut factor = Factor::default();
            assert!(structure.factor(0.01, |e| blocks[e as usize], &mut factor));
            let expected: Vec<DVec2> = points.iter().map(|_| rng.point(2.0) - DVec2::ONE).collect();
            let mut b: Vec<DVec2> = expected.iter().map(|x| 0.01 * *x).collect();
            for (t, blocks) in triangles.iter().zip(&blocks) {
                for (block, (i, k)) in blocks.iter().zip([(0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)]) {
                    if t[i] != FIXED && t[k] != FIXED {
                        b[t[i] as usize] += *block * expected[t[k] as usize];
                        if i != k {
                            b[t[k] as usize] += block.transpose() * expected[t[i] as usize];
                        }
                    }
                }
            }
            structure.solve(&factor, &mut b);
            let worst = b.iter().zip(&expected).map(|(x, y)| x.distance(*y)).fold(0.0, f64::max);
            assert!(worst < 1e-8, "{side}: {worst}");
        }
    }

    #[test]
    fn long_triangles_make_no_large_fronts() {
        // Fans about hubs, across all of the plane.
        let mut rng = Rng(5);
        let (hubs, count) = (12u32, 4000u32);
        let mut at: Vec<DVec2> = (0..hubs).map(|k| DVec2::new(f64::from(k) * 80.0, 0.0)).collect();
        let mut triangles = Vec::new();
        for k in 0..count {
            at.push(DVec2::new(f64::from(k) * 0.24, 30.0 + rng.unit()));
            if k > 0 {
                triangles.push([(k * 7) % hubs, hubs + k - 1, hubs + k]);
            }
        }
        let structure = Structure::new(&at, &triangles);
        let widest = structure.fronts.iter().map(Front::rows).max().unwrap();
        assert!(widest < 60, "{widest}");
        let mut order = structure.order.clone();
        order.sort_unstable();
        assert!(order.iter().zip(0..).all(|(v, k)| *v == k) && order.len() == at.len());
    }

    #[test]
    fn what_is_not_positive_definite_is_refused() {
        let structure = Structure::new(&[DVec2::ZERO, DVec2::X, DVec2::Y], &[[0, 1, 2]]);
        assert!(!structure.factor(-1.0, |_| [DMat2::ZERO; 6], &mut Factor::default()));
    }
}
