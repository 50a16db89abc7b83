//! Recomputes from scratch what must hold of every Atlas that a stage gives.
//!
//! What the uploaded atlas had wrong is exempt, by source face: its flips, its overlaps, its UVs outside the sheet.

use std::fmt;

use glam::{DVec2, DVec3};

use super::bvh::{Bounds, Bvh};
use super::overlap::{orientation, overlaps_where, penetration, triangles_overlap};
use super::{Atlas, Charts, FaceId, Topology, UvId};

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
    let mut found = indices(before, after);
    if !found.is_empty() {
        return Err(found);
    }
    found.extend(shared_uvs(after).take(LIMIT));
    found.extend(provenance(before, after));
    found.extend(positions(before, after, exactness).take(LIMIT));
    found.extend(placement(before, after, exactness).take(LIMIT));
    if !found.iter().any(|v| matches!(v, Violation::NotFinite(_))) {
        found.extend(flips(before, after, exactness).into_iter().take(LIMIT));
        found.extend(new_overlaps(before, after, exactness));
    }
    if found.is_empty() { Ok(()) } else { Err(found) }
}

fn indices(before: &Atlas, after: &Atlas) -> Vec<Violation> {
    let n = after.corners.len();
    if [after.surface.triangles.len(), after.provenance.len(), after.page.len()] != [n; 3] {
        return vec![Violation::Lengths];
    }
    let bad = |f: &FaceId| {
        let i = f.index();
        after.corners[i].iter().any(|u| u.index() >= after.uv.len())
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
    let boxes: Vec<Bounds> = triangles.iter().map(|t| Bounds::of(t)).collect();
    let tree = Bvh::new(&boxes);
    let mut bad = Vec::new();
    for (i, own) in triangles.iter().enumerate() {
        tree.query(
            &boxes[i],
            0,
            |_| true,
            |p| {
                let j = tree.order[p] as usize;
                if j > i && penetration(own, &triangles[j]) > SLACK {
                    bad.push(Violation::Parts(group[i], group[j]));
                }
                bad.len() < LIMIT
            },
        );
    }
    bad
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
        } else if by > slack && outside(before, source) <= slack {
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

/// The UV triangle that a face had in the input.
fn uv_before(before: &Atlas, after: &Atlas, face: FaceId) -> [DVec2; 3] {
    let provenance = &after.provenance[face.index()];
    let source = before.uv_triangle(provenance.source);
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
    let charts = Charts::new(&Topology::new(after));
    let folded = folded(before);
    let total = |of: &dyn Fn(FaceId) -> f64| after.faces().map(of).sum::<f64>();
    let common_scale =
        (total(&|f| after.uv_area(f).abs()) / total(&|f| triangle_area(&uv_before(before, after, f)))).sqrt();
    let mut bad = Vec::new();
    for faces in &charts.faces {
        let [mut area, mut input_area, mut chart, mut turned] = [0.0; 4];
        let mut signs = Vec::with_capacity(faces.len());
        for &f in faces {
            let sign = |[a, b, c]: [DVec2; 3]| f64::from(orientation(a, b, c));
            let now = sign(after.uv_triangle(f));
            let source = sign(before.uv_triangle(after.provenance[f.index()].source));
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

/// By face: whether it lies against its chart's orientation.
fn folded(atlas: &Atlas) -> Vec<bool> {
    let mut folded = vec![false; atlas.face_count()];
    for faces in &Charts::new(&Topology::new(atlas)).faces {
        let chart: f64 = faces.iter().map(|&f| atlas.uv_area(f)).filter(|a| a.is_finite()).sum();
        for &f in faces {
            let [a, b, c] = atlas.uv_triangle(f);
            folded[f.index()] = f64::from(orientation(a, b, c)) * chart < 0.0;
        }
    }
    folded
}

fn triangle_area(t: &[DVec2; 3]) -> f64 {
    0.5 * (t[1] - t[0]).perp_dot(t[2] - t[0]).abs()
}

/// Whether a triangle covers nothing but what rounding makes of it: lower than `slack` over its longest edge. Such a one may lie
/// in others without overlapping them, until its corners are rounded elsewhere.
fn is_sliver(t: &[DVec2; 3], slack: f64) -> bool {
    let longest = (0..3).map(|k| t[k].distance(t[(k + 1) % 3])).fold(0.0, f64::max);
    2.0 * triangle_area(t) <= slack * longest
}

fn new_overlaps(before: &Atlas, after: &Atlas, exactness: Exactness) -> Vec<Violation> {
    let slack = exactness.texels(extent(after));
    let is_new = |a: FaceId, b: FaceId| {
        let (p, q) = (after.provenance[a.index()].source, after.provenance[b.index()].source);
        let (source, other) = (before.uv_triangle(p), before.uv_triangle(q));
        let had = p != q
            && before.page.get(p.index()) == before.page.get(q.index())
            && (triangles_overlap(&source, &other) || is_sliver(&source, slack) || is_sliver(&other, slack));
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
mod tests {
    use super::*;
    use crate::atlas::testing::{join, sheet};
    use crate::atlas::{Provenance, VertexId};

    /// Two charts and a third that lies on the second; the first face of the first is split in three at its centre.
    fn atlases() -> (Atlas, Atlas) {
        let pair = join(&sheet(2, 2, DVec2::splat(1.0)), &sheet(3, 3, DVec2::new(10.0, 1.0)));
        let before = join(&pair, &sheet(2, 2, DVec2::new(11.5, 1.5)));
        let mut after = before.clone();
        let centre = UvId::new(after.uv.len());
        let place = VertexId::new(after.surface.positions.len());
        after.uv.push(before.uv_triangle(FaceId(0)).iter().sum::<DVec2>() / 3.0);
        after.surface.positions.push(before.triangle(FaceId(0)).iter().sum::<DVec3>() / 3.0);
        for k in 0..3 {
            let f = if k == 0 { 0 } else { after.face_count() };
            let own = |c: [UvId; 3]| [c[k], c[(k + 1) % 3], centre];
            let (corners, triangle) = (before.corners[0], before.surface.triangles[0]);
            let whole = Provenance::WHOLE;
            let part = Provenance {
                barycentric: [whole[k], whole[(k + 1) % 3], DVec3::splat(1.0 / 3.0)],
                ..before.provenance[0]
            };
            if k == 0 {
                after.corners[f] = own(corners);
                after.surface.triangles[f] = [triangle[k], triangle[(k + 1) % 3], place];
                after.provenance[f] = part;
            } else {
                after.corners.push(own(corners));
                after.surface.triangles.push([triangle[k], triangle[(k + 1) % 3], place]);
                after.provenance.push(part);
                after.page.push(0);
            }
        }
        (before, after)
    }

    fn faults(before: &Atlas, after: &Atlas) -> Vec<Violation> {
        check(before, after, Exactness::Exact).err().unwrap_or_default()
    }

    #[test]
    fn a_sliver_inside_another_face_is_no_new_overlap() {
        // Three corners on a line through a face: nothing overlaps, until one of them is rounded off the line.
        let mut before = join(&sheet(1, 1, DVec2::ZERO), &sheet(1, 1, DVec2::splat(5.0)));
        let line = [0.3, 0.9, 0.6].map(|x| DVec2::new(0.1 + 0.5 * x, 0.2));
        for (corner, p) in before.corners[2].into_iter().zip(line) {
            before.uv[corner.index()] = p;
        }
        let mut after = before.clone();
        let corner = after.corners[2][2];
        after.uv[corner.index()].y += 1e-9;
        let found = |before: &Atlas, after: &Atlas| {
            let all = new_overlaps(before, after, Exactness::Rounded(1e-6));
            all.iter().filter(|v| matches!(v, Violation::Overlap(_, FaceId(2)))).count()
        };
        assert_eq!(found(&before, &after), 0);
        // One that had an area and came to lie on others is new.
        let mut apart = before.clone();
        for (k, corner) in apart.corners[2].into_iter().enumerate() {
            apart.uv[corner.index()] = DVec2::new(5.0 + k as f64, 5.0 + f64::from(k == 1));
        }
        let mut moved = apart.clone();
        for corner in moved.corners[2] {
            moved.uv[corner.index()] -= DVec2::splat(4.8);
        }
        assert!(found(&apart, &moved) > 0);
    }

    #[test]
    fn what_is_right_passes_and_what_the_input_had_wrong_too() {
        let (before, after) = atlases();
        assert_eq!(faults(&before, &before), []);
        assert_eq!(faults(&before, &after), []);
        let mut turned = after.clone();
        for uv in &mut turned.uv {
            *uv = DVec2::from_angle(0.7).rotate(DVec2::new(uv.x, -uv.y)) / 3.0 + 30.0;
        }
        assert_eq!(faults(&before, &turned), [], "mirrored, turned and scaled as a whole");
        for uv in &mut turned.uv {
            *uv = uv.as_vec2().as_dvec2();
        }
        assert_eq!(check(&before, &turned, Exactness::Rounded(1e-3)), Ok(()), "read back from float32");
    }

    #[test]
    fn every_fault_is_found() {
        type Case = (&'static str, fn(&mut Atlas), fn(&Violation) -> bool);
        let cases: [Case; 12] = [
            ("lengths", |a| a.page.truncate(1), |v| *v == Violation::Lengths),
            ("index", |a| a.corners[3][1] = UvId(9999), |v| *v == Violation::Index(FaceId(3))),
            ("page", |a| a.page[3] = 1, |v| *v == Violation::Index(FaceId(3))),
            ("shared", |a| a.corners[5][0] = a.corners[0][0], |v| matches!(v, Violation::SharedUv(_))),
            ("primitive", |a| a.provenance[4].primitive = 1, |v| *v == Violation::Primitive(FaceId(4))),
            ("turned over", |a| a.provenance[4].barycentric.swap(0, 1), |v| *v == Violation::Part(FaceId(4))),
            ("uncovered", |a| a.provenance[4].source = FaceId(5), |v| *v == Violation::Cover(FaceId(4), 0.0)),
            ("covered twice", |a| a.provenance[4].source = FaceId(5), |v| *v == Violation::Parts(FaceId(4), FaceId(5))),
            ("moved", |a| a.surface.positions[0].z += 1e-6, |v| matches!(v, Violation::Moved(FaceId(0), _))),
            ("not finite", |a| a.uv[0].x = f64::NAN, |v| matches!(v, Violation::NotFinite(FaceId(0)))),
            ("outside", |a| a.sheets[0] = [12, 100], |v| matches!(v, Violation::OutsideSheet(..))),
            (
                "onto the other",
                |a| a.uv.iter_mut().take(9).for_each(|p| p.x += 8.0),
                |v| matches!(v, Violation::Overlap(..)),
            ),
        ];
        for (name, make, expected) in cases {
            let (before, mut after) = atlases();
            make(&mut after);
            let found = faults(&before, &after);
            assert!(found.iter().any(expected), "{name}: {found:?}");
        }
    }

    #[test]
    fn a_face_pulled_through_its_neighbour_is_flipped() {
        let (before, mut after) = atlases();
        let inner = after.uv.iter().position(|p| *p == DVec2::new(12.0, 3.0)).unwrap_or(0);
        after.uv[inner] = DVec2::new(9.5, 3.2);
        let found = faults(&before, &after);
        assert!(found.iter().any(|v| matches!(v, Violation::Flipped(_))), "{found:?}");
        assert!(found.iter().any(|v| matches!(v, Violation::Overlap(..))), "{found:?}");
        let (_, mut closed) = atlases();
        closed.uv[0] = closed.uv[1];
        let found = check(&before, &closed, Exactness::Rounded(1e-3)).err().unwrap_or_default();
        assert!(found.iter().any(|v| matches!(v, Violation::Flipped(_))), "{found:?}");
    }
}
