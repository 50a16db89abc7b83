//! Recomputes from scratch what must hold of every Atlas that a stage gives.
//!
//! What the uploaded atlas had wrong is exempt, by source face: its flips, its overlaps, its UVs outside the sheet. What it did
//! not have excuses nothing: where it came without a layout, every flip, overlap and step over the sheet's edge counts, and
//! lost area is measured against the surface.

use std::fmt;

use glam::{DVec2, DVec3};

use super::bvh::TriangleTree;
use super::groups::DisjointSets;
use super::overlap::{orientation, overlaps_where, penetration, triangles_overlap};
use super::{Atlas, FaceId, UvId};

/// How exactly UVs and positions are known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Exactness {
    /// In memory, in double precision: rigid moves may have rounded the last digits.
    Exact,
    /// Read back from a file in float32: an overlap, a flip or a step over the sheet's edge counts when it
    /// is deeper than this many texels.
    Rounded(f64),
}

impl Exactness {
    /// Texels that do not count, on an atlas whose UVs reach `extent` texels.
    fn texels(self, extent: f64) -> f64 {
        match self {
            Exactness::Exact => 1e-11 * extent.max(1.0),
            Exactness::Rounded(texels) => texels,
        }
    }

    /// Distance in 3D that does not count, on a surface of this size.
    fn length(self, size: f64) -> f64 {
        match self {
            Exactness::Exact => 1e-9 * size,
            Exactness::Rounded(_) => 1e-6 * size,
        }
    }
}

/// What is wrong with an Atlas.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Violation {
    /// The arrays by face have different lengths.
    Lengths,
    /// A face has no UVs, though the input or other faces have.
    Unmapped(FaceId),
    /// A face names a UV vertex, surface vertex, page or source face that does not exist.
    Index(FaceId),
    /// A UV vertex is used for two surface vertices.
    SharedUv(UvId),
    /// A face claims another primitive than its source.
    Primitive(FaceId),
    /// A face is not a part of its source: outside it, turned over or empty.
    Part(FaceId),
    /// The parts of a source face do not add up to it; the sum of their areas over its area.
    Cover(FaceId, f64),
    /// Two parts of one source face overlap in it.
    Parts(FaceId, FaceId),
    /// A corner is not where its provenance says; the distance.
    Moved(FaceId, f64),
    /// A UV is not a number.
    NotFinite(FaceId),
    /// A face leaves its sheet, by so many texels.
    OutsideSheet(FaceId, f64),
    /// A face is turned over against its chart, or has lost its area.
    Flipped(FaceId),
    /// Two faces overlap whose sources did not.
    Overlap(FaceId, FaceId),
    /// So many triangles lie on each other that the search for overlaps was cut short.
    TooManyOverlaps,
}

impl fmt::Display for Violation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Violation::Lengths => write!(f, "the arrays by face have different lengths"),
            Violation::Unmapped(a) => write!(f, "face {} has no UVs", a.0),
            Violation::Index(a) => write!(f, "face {} names an index out of range", a.0),
            Violation::SharedUv(u) => write!(f, "UV vertex {} belongs to two surface vertices", u.0),
            Violation::Primitive(a) => write!(f, "face {} is of another primitive than its source", a.0),
            Violation::Part(a) => write!(f, "face {} is not a part of its source", a.0),
            Violation::Cover(a, sum) => write!(f, "source face {} is covered {sum} times", a.0),
            Violation::Parts(a, b) => write!(f, "faces {} and {} overlap in their source", a.0, b.0),
            Violation::Moved(a, by) => write!(f, "a corner of face {} is {by:e} from its place", a.0),
            Violation::NotFinite(a) => write!(f, "a UV of face {} is not finite", a.0),
            Violation::OutsideSheet(a, by) => write!(f, "face {} leaves its sheet by {by} texels", a.0),
            Violation::Flipped(a) => write!(f, "face {} is turned over or has lost its area", a.0),
            Violation::Overlap(a, b) => write!(f, "faces {} and {} overlap and their sources did not", a.0, b.0),
            Violation::TooManyOverlaps => write!(f, "too many overlaps to search them all"),
        }
    }
}

/// Violations of one kind that are reported at most.
const LIMIT: usize = 100;
/// Slack of barycentric coordinates and of their areas.
const SLACK: f64 = 1e-9;

/// Checks `after` against `before`, the atlas as uploaded (whose faces provenance names). The violations are in the order
/// of the list above, at most 100 of a kind; those that would make later checks meaningless end it.
pub fn check(before: &Atlas, after: &Atlas, exactness: Exactness) -> Result<(), Vec<Violation>> {
    check_with(before, after, exactness, false)
}

/// The same; where `self_overlaps`, faces of one chart may lie on each other, as the user asked for it.
///
/// # Errors
/// What is wrong.
pub fn check_with(
    before: &Atlas,
    after: &Atlas,
    exactness: Exactness,
    self_overlaps: bool,
) -> Result<(), Vec<Violation>> {
    let mut found = indices(before, after);
    if !found.is_empty() {
        return Err(found);
    }
    let mapped = after.has_layout();
    if mapped {
        found.extend(shared_uvs(after).take(LIMIT));
    }
    found.extend(provenance(before, after));
    found.extend(positions(before, after, exactness).take(LIMIT));
    if !mapped {
        return if found.is_empty() { Ok(()) } else { Err(found) };
    }
    found.extend(placement(before, after, exactness).take(LIMIT));
    if !found.iter().any(|v| matches!(v, Violation::NotFinite(_))) {
        found.extend(flips(before, after, exactness).into_iter().take(LIMIT));
        found.extend(new_overlaps(before, after, exactness, self_overlaps));
    }
    if found.is_empty() { Ok(()) } else { Err(found) }
}

fn indices(before: &Atlas, after: &Atlas) -> Vec<Violation> {
    let n = after.corners.len();
    if [after.surface.triangles.len(), after.provenance.len(), after.page.len()] != [n; 3] {
        return vec![Violation::Lengths];
    }
    if before.has_layout() || after.has_layout() {
        let unmapped = |f: &FaceId| after.corners[f.index()].contains(&Atlas::NO_UV);
        let bad: Vec<_> = after.faces().filter(unmapped).take(LIMIT).map(Violation::Unmapped).collect();
        if !bad.is_empty() {
            return bad;
        }
    }
    let mapped = after.has_layout();
    let bad = |f: &FaceId| {
        let i = f.index();
        mapped && after.corners[i].iter().any(|u| u.index() >= after.uv.len())
            || after.surface.triangles[i].iter().any(|v| v.index() >= after.surface.positions.len())
            || usize::from(after.page[i]) >= after.sheets.len()
            || after.provenance[i].source.index() >= before.face_count()
    };
    after.faces().filter(bad).take(LIMIT).map(Violation::Index).collect()
}

fn shared_uvs(atlas: &Atlas) -> impl Iterator<Item = Violation> {
    let mut owner = vec![None; atlas.uv.len()];
    atlas
        .corners
        .iter()
        .flatten()
        .zip(atlas.surface.triangles.iter().flatten())
        .filter_map(move |(&u, &v)| (*owner[u.index()].get_or_insert(v) != v).then_some(Violation::SharedUv(u)))
}

/// Area of a part over the area of its source, signed.
fn part_area(barycentric: &[DVec3; 3]) -> f64 {
    let [a, b, c] = barycentric;
    a.dot(b.cross(*c))
}

fn provenance(before: &Atlas, after: &Atlas) -> Vec<Violation> {
    let mut bad = Vec::new();
    let mut by_source: Vec<FaceId> = after.faces().collect();
    by_source.sort_by_key(|f| after.provenance[f.index()].source);
    let mut expected = 0;
    for group in by_source.chunk_by(|a, b| after.provenance[a.index()].source == after.provenance[b.index()].source) {
        let source = after.provenance[group[0].index()].source;
        bad.extend((expected..source.index()).map(|f| Violation::Cover(FaceId::new(f), 0.0)).take(LIMIT));
        expected = source.index() + 1;
        let mut sum = 0.0;
        for &f in group {
            let own = &after.provenance[f.index()];
            let inside =
                own.barycentric.iter().all(|b| b.min_element() >= -SLACK && (b.element_sum() - 1.0).abs() <= SLACK);
            let area = part_area(&own.barycentric);
            sum += area;
            if own.primitive != before.provenance.get(source.index()).map_or(own.primitive, |p| p.primitive) {
                bad.push(Violation::Primitive(f));
            }
            if !inside || area <= 0.0 {
                bad.push(Violation::Part(f));
            }
        }
        if (sum - 1.0).abs() > SLACK || sum.is_nan() {
            bad.push(Violation::Cover(source, sum));
        }
        if group.len() > 1 {
            bad.extend(overlapping_parts(after, group));
        }
        if bad.len() > LIMIT {
            bad.truncate(LIMIT);
            return bad;
        }
    }
    bad.extend((expected..before.face_count()).map(|f| Violation::Cover(FaceId::new(f), 0.0)).take(LIMIT));
    bad
}

fn overlapping_parts(after: &Atlas, group: &[FaceId]) -> Vec<Violation> {
    let flat = |f: &FaceId| after.provenance[f.index()].barycentric.map(|b| DVec2::new(b.x, b.y));
    let triangles: Vec<[DVec2; 3]> = group.iter().map(flat).collect();
    let TriangleTree { tree, triangles } = TriangleTree::new(&triangles);
    let mut found = Vec::new();
    for (p, own) in triangles.iter().enumerate() {
        tree.query(&tree.bounds_at(p), p + 1, |q| {
            if penetration(own, &triangles[q]) > SLACK {
                let (i, j) = (tree.order[p], tree.order[q]);
                found.push((i.min(j) as usize, i.max(j) as usize));
            }
            found.len() < LIMIT
        });
    }
    found.sort_unstable();
    found.into_iter().map(|(i, j)| Violation::Parts(group[i], group[j])).collect()
}

fn positions<'a>(before: &'a Atlas, after: &'a Atlas, exactness: Exactness) -> impl Iterator<Item = Violation> + 'a {
    let all = &before.surface.positions;
    let low = all.iter().copied().fold(DVec3::INFINITY, DVec3::min);
    let high = all.iter().copied().fold(DVec3::NEG_INFINITY, DVec3::max);
    let slack = exactness.length((high - low).length());
    after.faces().filter_map(move |f| {
        let provenance = &after.provenance[f.index()];
        let source = before.triangle(provenance.source);
        let there = |b: &DVec3| source[0] * b.x + source[1] * b.y + source[2] * b.z;
        let corners = after.triangle(f);
        let distances = provenance.barycentric.iter().zip(corners).map(|(b, p)| there(b).distance(p));
        let worst = distances.fold(0.0, |a: f64, b| if b.is_nan() { f64::INFINITY } else { a.max(b) });
        (worst > slack).then_some(Violation::Moved(f, worst))
    })
}

fn extent(atlas: &Atlas) -> f64 {
    atlas.uv.iter().map(|p| p.abs().max_element()).filter(|v| v.is_finite()).fold(0.0, f64::max)
}

/// How far a triangle leaves its sheet; infinite where it is not finite.
fn outside(atlas: &Atlas, face: FaceId) -> f64 {
    let sheet = atlas.sheets.get(usize::from(atlas.page[face.index()])).copied().unwrap_or_default();
    let size = DVec2::new(f64::from(sheet[0]), f64::from(sheet[1]));
    let by = |p: DVec2| if p.is_finite() { (-p).max(p - size).max_element() } else { f64::INFINITY };
    atlas.uv_triangle(face).map(by).into_iter().fold(0.0, f64::max)
}

fn placement<'a>(before: &'a Atlas, after: &'a Atlas, exactness: Exactness) -> impl Iterator<Item = Violation> + 'a {
    let slack = exactness.texels(extent(after));
    after.faces().filter_map(move |f| {
        let by = outside(after, f);
        let source = after.provenance[f.index()].source;
        if by == f64::INFINITY {
            Some(Violation::NotFinite(f))
        } else if by > slack && (!before.has_layout() || outside(before, source) <= slack) {
            Some(Violation::OutsideSheet(f, by))
        } else {
            None
        }
    })
}

/// The smallest height of a triangle.
fn height(t: &[DVec2; 3]) -> f64 {
    let [a, b, c] = *t;
    let longest = a.distance(b).max(b.distance(c)).max(c.distance(a));
    if longest > 0.0 { (b - a).perp_dot(c - a).abs() / longest } else { 0.0 }
}

/// The triangle that a face of the input is laid out like: its UV triangle or, without a layout, itself laid flat.
fn laid_out(before: &Atlas, face: FaceId) -> [DVec2; 3] {
    if before.has_layout() {
        return before.uv_triangle(face);
    }
    let [a, b, c] = before.triangle(face);
    let (along, other) = (b - a, c - a);
    let length = along.length();
    let apex = match length > 0.0 {
        true => DVec2::new(other.dot(along), other.cross(along).length()) / length,
        false => DVec2::new(other.length(), 0.0),
    };
    [DVec2::ZERO, DVec2::new(length, 0.0), apex]
}

/// The triangle that a face was laid out like in the input.
fn uv_before(before: &Atlas, after: &Atlas, face: FaceId) -> [DVec2; 3] {
    let provenance = &after.provenance[face.index()];
    let source = laid_out(before, provenance.source);
    if provenance.is_whole() {
        return source;
    }
    provenance.barycentric.map(|b| source[0] * b.x + source[1] * b.y + source[2] * b.z)
}

/// Faces whose orientation is neither their chart's nor, against that of the source, what their chart's is, and was their chart's in the
/// input: so a chart may be mirrored as a whole, what was folded in the input may stay folded, and charts may be mirrored to be merged.
/// And faces that lost their area, though at their chart's scale (or the atlas', if less) the input's would be seen.
fn flips(before: &Atlas, after: &Atlas, exactness: Exactness) -> Vec<Violation> {
    let slack = exactness.texels(extent(after));
    let charts = charts(after);
    let folded = folded(before);
    let total = |of: &dyn Fn(FaceId) -> f64| after.faces().map(of).sum::<f64>();
    let common_scale =
        (total(&|f| after.uv_area(f).abs()) / total(&|f| triangle_area(&uv_before(before, after, f)))).sqrt();
    let mut bad = Vec::new();
    for faces in &charts {
        let [mut area, mut input_area, mut chart, mut turned] = [0.0; 4];
        let mut signs = Vec::with_capacity(faces.len());
        for &f in faces {
            let sign = |[a, b, c]: [DVec2; 3]| f64::from(orientation(a, b, c));
            let now = sign(after.uv_triangle(f));
            // Without a layout in the input nothing was degenerate or turned over in it.
            let source =
                if before.has_layout() { sign(before.uv_triangle(after.provenance[f.index()].source)) } else { 1.0 };
            let own = after.uv_area(f).abs();
            area += own;
            input_area += triangle_area(&uv_before(before, after, f));
            chart += now * own;
            turned += now * source * own;
            signs.push((now, source));
        }
        // A chart that is all rounding has no scale of its own.
        let scale = if area > 0.0 { (area / input_area).sqrt().min(common_scale) } else { common_scale };
        for (&f, (now, source)) in faces.iter().zip(signs) {
            let flipped = now * chart < 0.0
                && now * source * turned < 0.0
                && !folded[after.provenance[f.index()].source.index()]
                && height(&after.uv_triangle(f)) > slack;
            let lost = || common_scale == 0.0 || scale * height(&uv_before(before, after, f)) > 2.0 * slack;
            if source != 0.0 && (flipped || now == 0.0 && lost()) {
                bad.push(Violation::Flipped(f));
            }
        }
    }
    bad
}

/// The faces of each chart, ascending; charts by their lowest face. Told from UV edges alone: what is judged here is not asked for its adjacency.
fn charts(atlas: &Atlas) -> Vec<Vec<FaceId>> {
    let mut edges: Vec<(UvId, UvId, u32)> = Vec::with_capacity(3 * atlas.face_count());
    for (f, corners) in atlas.corners.iter().enumerate() {
        let edge = |k: usize| (corners[k], corners[(k + 1) % 3]);
        edges.extend((0..3).map(edge).map(|(a, b)| (a.min(b), a.max(b), f as u32)));
    }
    edges.sort_unstable();
    let mut sets = DisjointSets::new(atlas.face_count());
    for pair in edges.windows(2).filter(|w| (w[0].0, w[0].1) == (w[1].0, w[1].1)) {
        sets.unite(pair[0].2, pair[1].2);
    }
    sets.sets().into_iter().map(|own| own.into_iter().map(FaceId).collect()).collect()
}

/// By face: whether it lies against its chart's orientation.
fn folded(atlas: &Atlas) -> Vec<bool> {
    let mut folded = vec![false; atlas.face_count()];
    if !atlas.has_layout() {
        return folded;
    }
    for faces in &charts(atlas) {
        let chart: f64 = faces.iter().map(|&f| atlas.uv_area(f)).filter(|a| a.is_finite()).sum();
        for &f in faces {
            let [a, b, c] = atlas.uv_triangle(f);
            folded[f.index()] = f64::from(orientation(a, b, c)) * chart < 0.0;
        }
    }
    folded
}

/// The area of a triangle.
pub(crate) fn triangle_area(t: &[DVec2; 3]) -> f64 {
    0.5 * (t[1] - t[0]).perp_dot(t[2] - t[0]).abs()
}

/// Whether a triangle covers nothing but what rounding makes of it: lower than `slack` over its longest edge. Such a one may lie
/// in others without overlapping them, until its corners are rounded elsewhere.
fn is_sliver(t: &[DVec2; 3], slack: f64) -> bool {
    let longest = (0..3).map(|k| t[k].distance(t[(k + 1) % 3])).fold(0.0, f64::max);
    2.0 * triangle_area(t) <= slack * longest
}

fn new_overlaps(before: &Atlas, after: &Atlas, exactness: Exactness, self_overlaps: bool) -> Vec<Violation> {
    let slack = exactness.texels(extent(after));
    // By face: its chart, as UV vertices join faces.
    let charts = self_overlaps.then(|| {
        let mut sets = DisjointSets::new(after.uv.len());
        for corners in &after.corners {
            sets.unite(corners[0].0, corners[1].0);
            sets.unite(corners[0].0, corners[2].0);
        }
        sets.numbered().0
    });
    let chart = |f: FaceId| charts.as_ref().map(|charts| charts[after.corners[f.index()][0].index()]);
    let is_new = |a: FaceId, b: FaceId| {
        if charts.is_some() && chart(a) == chart(b) {
            return false;
        }
        let (p, q) = (after.provenance[a.index()].source, after.provenance[b.index()].source);
        let had = p != q && before.has_layout() && before.page.get(p.index()) == before.page.get(q.index()) && {
            let (source, other) = (before.uv_triangle(p), before.uv_triangle(q));
            triangles_overlap(&source, &other) || is_sliver(&source, slack) || is_sliver(&other, slack)
        };
        !had && penetration(&after.uv_triangle(a), &after.uv_triangle(b)) > slack
    };
    let (pairs, cut_short) = overlaps_where(after, LIMIT, is_new);
    let mut bad: Vec<Violation> = pairs.iter().map(|&(a, b)| Violation::Overlap(a, b)).collect();
    if cut_short && bad.len() < LIMIT {
        bad.push(Violation::TooManyOverlaps);
    }
    bad
}

#[cfg(test)]
mod tests;
