//! One case for each way in which an Atlas can be wrong, on an Atlas that came with a layout and on one that came without.

use super::*;
use crate::atlas::testing::{atlas, join, sheet};
use crate::atlas::{Provenance, VertexId};

/// The first face split in three at its centre.
fn split(before: &Atlas) -> Atlas {
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
        let part =
            Provenance { barycentric: [whole[k], whole[(k + 1) % 3], DVec3::splat(1.0 / 3.0)], ..before.provenance[0] };
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
    after
}

/// Two charts that lie apart.
fn pair() -> Atlas {
    join(&sheet(2, 2, DVec2::splat(1.0)), &sheet(3, 3, DVec2::new(10.0, 1.0)))
}

/// Two charts and a third that lies on the second; and the same with its first face split.
fn atlases() -> (Atlas, Atlas) {
    let before = join(&pair(), &sheet(2, 2, DVec2::new(11.5, 1.5)));
    let after = split(&before);
    (before, after)
}

/// The same surface without a layout.
fn bare(atlas: &Atlas) -> Atlas {
    Atlas { uv: Vec::new(), corners: vec![[Atlas::NO_UV; 3]; atlas.face_count()], ..atlas.clone() }
}

fn faults(before: &Atlas, after: &Atlas) -> Vec<Violation> {
    check(before, after, Exactness::Exact).err().unwrap_or_default()
}

/// A number for each kind of violation, from 0 on.
fn kind(violation: &Violation) -> usize {
    match violation {
        Violation::Lengths => 0,
        Violation::Unmapped(_) => 1,
        Violation::Index(_) => 2,
        Violation::SharedUv(_) => 3,
        Violation::Primitive(_) => 4,
        Violation::Part(_) => 5,
        Violation::Cover(..) => 6,
        Violation::Parts(..) => 7,
        Violation::Moved(..) => 8,
        Violation::NotFinite(_) => 9,
        Violation::OutsideSheet(..) => 10,
        Violation::Flipped(_) => 11,
        Violation::Overlap(..) => 12,
        Violation::TooManyOverlaps => 13,
    }
}

/// Kinds of violations that there are.
const KINDS: usize = 14;

/// Strips along a diagonal, whose boxes all hold thousands of small triangles beyond it: nothing overlaps, and a search by boxes
/// does not come to an end.
fn crossed_boxes() -> Atlas {
    let mut uv = Vec::new();
    for i in 0..512 {
        let c = 60.0 + 0.002 * f64::from(i);
        uv.extend([DVec2::new(c, 0.0), DVec2::new(c + 0.001, 0.0), DVec2::new(0.0, c)]);
    }
    for i in 0..145 * 145 {
        let corner = DVec2::new(f64::from(i % 145), f64::from(i / 145)) * 0.15 + 35.0;
        uv.extend([corner, corner + DVec2::new(0.1, 0.0), corner + DVec2::new(0.0, 0.1)]);
    }
    let corners = (0..uv.len() / 3).map(|f| [0, 1, 2].map(|k| UvId::new(3 * f + k))).collect();
    atlas(uv, corners)
}

#[test]
fn every_fault_is_found() {
    type Case = (&'static str, fn(&mut Atlas), fn(&Violation) -> bool);
    let cases: [Case; 15] = [
        ("lengths", |a| a.page.truncate(1), |v| *v == Violation::Lengths),
        ("a face without UVs", |a| a.corners[3] = [Atlas::NO_UV; 3], |v| *v == Violation::Unmapped(FaceId(3))),
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
        (
            "pulled through its neighbour",
            |a| a.uv.iter_mut().filter(|p| **p == DVec2::new(12.0, 3.0)).for_each(|p| *p = DVec2::new(9.5, 3.2)),
            |v| matches!(v, Violation::Flipped(_)),
        ),
        ("without area", |a| a.uv[0] = a.uv[1], |v| matches!(v, Violation::Flipped(_))),
    ];
    for (input, before) in [("with a layout", pair()), ("without one", bare(&pair()))] {
        assert_eq!(faults(&before, &split(&pair())), [], "{input}");
        let mut kinds = vec![false; KINDS];
        for (name, make, expected) in cases {
            let mut after = split(&pair());
            make(&mut after);
            let found = faults(&before, &after);
            assert!(found.iter().any(expected), "{name}, {input}: {found:?}");
            kinds[found.iter().find(|v| expected(v)).map_or(0, kind)] = true;
        }
        let crowd = crossed_boxes();
        let uploaded = if before.has_layout() { crowd.clone() } else { bare(&crowd) };
        assert_eq!(faults(&uploaded, &crowd), [Violation::TooManyOverlaps], "{input}");
        kinds[kind(&Violation::TooManyOverlaps)] = true;
        assert_eq!(kinds, vec![true; KINDS], "{input}: a kind of violation that no case makes");
    }
}

#[test]
fn faults_of_a_surface_are_found_before_it_has_a_layout() {
    let before = bare(&pair());
    assert_eq!(faults(&before, &before), [], "nothing is missing until a stage makes a layout");
    type Case = (&'static str, fn(&mut Atlas), fn(&Violation) -> bool);
    let cases: [Case; 7] = [
        ("lengths", |a| a.page.truncate(1), |v| *v == Violation::Lengths),
        ("index", |a| a.surface.triangles[3][1] = VertexId(9999), |v| *v == Violation::Index(FaceId(3))),
        ("primitive", |a| a.provenance[4].primitive = 1, |v| *v == Violation::Primitive(FaceId(4))),
        ("turned over", |a| a.provenance[4].barycentric.swap(0, 1), |v| *v == Violation::Part(FaceId(4))),
        ("uncovered", |a| a.provenance[4].source = FaceId(5), |v| *v == Violation::Cover(FaceId(4), 0.0)),
        ("covered twice", |a| a.provenance[4].source = FaceId(5), |v| *v == Violation::Parts(FaceId(4), FaceId(5))),
        ("moved", |a| a.surface.positions[0].z += 1e-6, |v| matches!(v, Violation::Moved(FaceId(0), _))),
    ];
    for (name, make, expected) in cases {
        let mut after = before.clone();
        make(&mut after);
        let found = faults(&before, &after);
        assert!(found.iter().any(expected), "{name}: {found:?}");
    }
}

#[test]
fn a_layout_is_not_lost() {
    let found = faults(&pair(), &bare(&pair()));
    assert!(matches!(found.as_slice(), [Violation::Unmapped(FaceId(0)), ..]), "{found:?}");
}

#[test]
fn what_the_input_did_not_have_excuses_nothing() {
    let found = |after: &Atlas, expected: fn(&Violation) -> bool| {
        assert_eq!(faults(after, after), [], "the input had it wrong");
        let found = faults(&bare(after), after);
        assert!(!found.is_empty() && found.iter().all(expected), "{found:?}");
    };
    found(&atlases().0, |v| matches!(v, Violation::Overlap(..)));
    let mut beyond = pair();
    beyond.sheets[0] = [12, 100];
    found(&beyond, |v| matches!(v, Violation::OutsideSheet(..)));
    let mut folded = sheet(2, 2, DVec2::splat(1.0));
    folded.uv[0] = DVec2::new(2.5, 2.5);
    found(&folded, |v| matches!(v, Violation::Flipped(_) | Violation::Overlap(..)));
    // A triangle without area in 3D has none to lose.
    let mut needle = sheet(1, 1, DVec2::splat(1.0));
    needle.surface.positions[2] = needle.surface.positions[0];
    needle.uv[2] = needle.uv[0];
    assert_eq!(faults(&bare(&needle), &needle), []);
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
        let all = new_overlaps(before, after, Exactness::Rounded(1e-6), false);
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
fn charts_that_may_lie_on_themselves_may_not_lie_on_others() {
    // A closed fan of squares, cut open, over more than a whole turn: it lies on itself.
    let points = (0..=9).flat_map(|k| [1.0, 2.0].map(|r| DVec2::from_angle(0.9 * f64::from(k)) * r + 5.0)).collect();
    let faces = (0..9).flat_map(|k| [[2 * k, 2 * k + 1, 2 * k + 3], [2 * k, 2 * k + 3, 2 * k + 2]]);
    let ramp = atlas(points, faces.map(|f| f.map(UvId)).collect());
    let before = bare(&ramp);
    let of =
        |after: &Atlas, may: bool| check_with(&bare(after), after, Exactness::Exact, may).err().unwrap_or_default();
    let overlaps = |found: Vec<Violation>| found.iter().filter(|v| matches!(v, Violation::Overlap(..))).count();
    assert!(overlaps(faults(&before, &ramp)) > 0);
    assert_eq!(of(&ramp, true), Vec::new());
    let with = |at: f64| Atlas { sheets: vec![[64, 64]], ..join(&ramp, &sheet(2, 2, DVec2::new(at, 5.0))) };
    assert_eq!(of(&with(20.0), true), Vec::new());
    assert!(overlaps(of(&with(5.5), true)) > 0, "another chart lies on it");
}
