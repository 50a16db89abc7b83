//! Edits against an Atlas looked at from scratch.

use glam::{DVec2, DVec3};

use super::*;
use crate::atlas::testing::{Rng, atlas, join, non_manifold_edges, sheet, soup};
use crate::atlas::{Charts, Exactness, Violation, check};

/// Sheets whose surface is closed up along a border, and worse: each with the reason that it is here.
fn surfaces() -> Vec<(&'static str, Atlas)> {
    let wrapped = |nx: usize, ny: usize, vertex: &dyn Fn(usize, usize) -> usize| {
        let mut own = sheet(nx, ny, DVec2::ZERO);
        for v in own.surface.triangles.iter_mut().flatten() {
            *v = VertexId::new(vertex(v.index() % (nx + 1), v.index() / (nx + 1)));
        }
        // Places that no fold makes equal: provenance is looked at in 3D too.
        for (i, p) in own.surface.positions.iter_mut().enumerate() {
            *p = DVec3::new((i as f64 * 1.7).sin(), (i as f64 * 0.9).cos(), (i as f64 * 0.3).sin()) * 5.0;
        }
        own
    };
    let fins = || {
        let uv = [[0.0, 0.0], [4.0, 0.0], [2.0, 2.0], [2.0, -2.0], [3.0, 3.0], [1.0, -3.0]].map(DVec2::from).to_vec();
        let corner = |a, b, c| [a, b, c].map(UvId);
        atlas(uv, vec![corner(0, 1, 2), corner(1, 0, 3), corner(0, 1, 4), corner(0, 1, 5)])
    };
    let degenerate = || {
        let uv = [[0.0, 0.0], [4.0, 0.0], [2.0, 2.0], [6.0, 2.0]].map(DVec2::from).to_vec();
        let corner = |a, b, c| [a, b, c].map(UvId);
        atlas(
            uv,
            vec![corner(0, 1, 2), corner(1, 1, 2), corner(1, 3, 2), corner(2, 2, 2), corner(2, 2, 2), corner(1, 2, 1)],
        )
    };
    vec![
        ("a disk", sheet(5, 4, DVec2::ZERO)),
        ("two charts that share nothing", join(&sheet(2, 2, DVec2::ZERO), &sheet(3, 1, DVec2::splat(9.0)))),
        ("a tube: one seam joins a chart to itself", wrapped(6, 3, &|x, y| y * 7 + x % 6)),
        ("a torus: closed, with a handle", wrapped(5, 4, &|x, y| (y % 4) * 6 + x % 5)),
        ("a moebius band: it has no inside", wrapped(6, 2, &|x, y| if x == 6 { (2 - y) * 7 } else { y * 7 + x })),
        ("fins: an edge with four faces", fins()),
        ("triangles collapsed to edges and points", degenerate()),
        ("a soup: nothing is joined", soup(&[[DVec2::ZERO, DVec2::X, DVec2::Y], [DVec2::X, DVec2::ONE, DVec2::Y]])),
        ("nothing", Atlas::default()),
    ]
}

/// Everything that the mesh keeps, against what follows from its Atlas.
fn assert_true(mesh: &Mesh, what: &str) {
    let own = mesh.atlas();
    assert_eq!(mesh.topology(), &Topology::new(own), "{what}: adjacency");
    let corners = |h: HalfEdge| (mesh.uv_at(h), mesh.vertex_at(h));
    for (count, lists, of) in [
        (own.uv.len(), &mesh.at_uv, (|c: (UvId, VertexId)| c.0.index()) as fn((UvId, VertexId)) -> usize),
        (own.surface.positions.len(), &mesh.at_vertex, |c| c.1.index()),
    ] {
        let mut expected = vec![Vec::new(); count];
        for h in mesh.topology().half_edges() {
            expected[of(corners(h))].push(h);
        }
        for (v, expected) in expected.into_iter().enumerate() {
            let mut found: Vec<HalfEdge> = lists.of(v).collect();
            found.sort_unstable();
            assert_eq!(found, expected, "{what}: corners of vertex {v}");
        }
    }
}

/// What must hold of provenance however UVs were moved.
fn assert_provenance(before: &Atlas, after: &Atlas, what: &str) {
    let about_uvs = |v: &Violation| {
        use Violation::*;
        matches!(v, NotFinite(_) | OutsideSheet(..) | Flipped(_) | Overlap(..) | TooManyOverlaps)
    };
    let found = check(before, after, Exactness::Exact).err().unwrap_or_default();
    let found: Vec<_> = found.into_iter().filter(|v| !about_uvs(v)).collect();
    // Parts of what had no area to begin with have none either.
    let flat = |f: FaceId| before.area(after.provenance.get(f.index()).map_or(f, |p| p.source)) == 0.0;
    let found: Vec<_> = found.iter().filter(|v| !matches!(v, Violation::Part(f) if flat(*f))).collect();
    assert!(found.is_empty(), "{what}: {found:?}");
}

fn any_half_edge(mesh: &Mesh, rng: &mut Rng) -> HalfEdge {
    HalfEdge::new(rng.next() as usize % mesh.topology().len())
}

fn edit(mesh: &mut Mesh, rng: &mut Rng) -> &'static str {
    let h = any_half_edge(mesh, rng);
    match rng.next() % 8 {
        0..=2 => {
            // A walk along edges, wherever it leads.
            let mut path = vec![h];
            for _ in 0..rng.next() % 4 {
                let Some(last) = path.last().copied() else { break };
                let leaving: Vec<HalfEdge> = mesh.corners_of(mesh.uv_ends(last)[1]).collect();
                path.push(leaving[rng.next() as usize % leaving.len()]);
            }
            mesh.cut(&path);
            "cut"
        }
        3..=4 => {
            mesh.weld(h);
            "weld"
        }
        5 => {
            let uv = mesh.uv_at(h);
            mesh.move_uv(uv, rng.point(9.0));
            "move"
        }
        6 => {
            mesh.set_page(h.face(), (rng.next() % 3) as u16);
            "page"
        }
        _ => {
            let [a, b] = mesh.surface_ends(h);
            if a != b && mesh.atlas().face_count() < 400 {
                mesh.split_edge(h, 0.2 + 0.6 * rng.unit());
            }
            "split"
        }
    }
}

fn same(a: &Mesh, b: &Mesh) -> bool {
    a.atlas == b.atlas && a.topology == b.topology && a.at_uv == b.at_uv && a.at_vertex == b.at_vertex
}

#[test]
fn thousands_of_edits_and_undos_leave_what_a_rebuilt_mesh_has() {
    for (name, mut start) in surfaces() {
        start.sheets = vec![[100, 100]; 3];
        let mut mesh = Mesh::new(start.clone());
        assert_true(&mesh, name);
        if start.face_count() == 0 {
            continue;
        }
        let mut rng = Rng(name.len() as u64);
        let mut states: Vec<(Mark, Mesh)> = Vec::new();
        let mut done = [0usize; 2];
        for step in 0..3000 {
            if rng.next().is_multiple_of(12) {
                states.push((mesh.mark(), mesh.clone()));
            }
            if rng.next().is_multiple_of(25)
                && let Some((mark, then)) = states.pop()
            {
                mesh.undo(mark);
                assert!(same(&mesh, &then), "{name}, step {step}: undone is not as it was");
                done[1] += 1;
                continue;
            }
            let what = edit(&mut mesh, &mut rng);
            assert_true(&mesh, &format!("{name}, step {step}, {what}"));
            done[0] += 1;
        }
        assert_provenance(&start, mesh.atlas(), name);
        assert!(done[0] > 2000 && done[1] > 20, "{done:?}");
    }
}

#[test]
fn recording_changes_nothing_and_everything_can_be_undone() {
    for (name, start) in surfaces().into_iter().filter(|s| s.1.face_count() > 0) {
        let (mut plain, mut recorded) = (Mesh::new(start.clone()), Mesh::new(start));
        let before = recorded.clone();
        let mark = recorded.mark();
        let (mut a, mut b) = (Rng(5), Rng(5));
        for _ in 0..300 {
            edit(&mut plain, &mut a);
            edit(&mut recorded, &mut b);
        }
        assert!(same(&plain, &recorded), "{name}");
        recorded.undo(mark);
        assert!(same(&recorded, &before), "{name}");
    }
}

fn half_edge(mesh: &Mesh, a: [f64; 2], b: [f64; 2]) -> HalfEdge {
    let runs = |h: &HalfEdge| mesh.uv_ends(*h).map(|u| mesh.position(u)) == [DVec2::from(a), DVec2::from(b)];
    mesh.topology().half_edges().find(runs).unwrap()
}

#[test]
fn a_cut_across_makes_two_charts_and_a_slit_makes_none() {
    let start = sheet(2, 2, DVec2::ZERO);
    let mesh = Mesh::new(start.clone());
    let upper = half_edge(&mesh, [1.0, 0.0], [1.0, 1.0]);
    let lower = half_edge(&mesh, [1.0, 1.0], [1.0, 2.0]);

    let mut slit = mesh.clone();
    slit.cut(&[upper]);
    assert_eq!(Charts::new(slit.topology()).len(), 1);
    assert_eq!(slit.atlas().uv.len(), start.uv.len() + 1, "the end on the border is doubled, the tip is not");
    assert!(slit.topology().is_seam(upper));

    let mut halves = mesh.clone();
    halves.cut(&[upper, lower]);
    assert_eq!(Charts::new(halves.topology()).len(), 2);
    assert_eq!(halves.atlas().uv.len(), start.uv.len() + 3);
    assert_eq!(halves.atlas().surface, start.surface);
    for face in start.faces() {
        assert_eq!(halves.atlas().uv_triangle(face), start.uv_triangle(face));
    }
    let mut none = mesh.clone();
    none.cut(&[]);
    assert_eq!(none.atlas(), &start);

    // Zipped up again, it is as it was but for names.
    halves.weld(upper);
    halves.weld(lower);
    assert_eq!(Charts::new(halves.topology()).len(), 1);
    let whole = halves.into_atlas();
    assert_eq!(whole.uv.len(), start.uv.len());
    check(&start, &whole, Exactness::Exact).unwrap();
}

#[test]
fn a_point_on_a_seam_is_put_on_both_sides() {
    let mut mesh = Mesh::new(sheet(2, 1, DVec2::ZERO));
    let h = half_edge(&mesh, [1.0, 0.0], [1.0, 1.0]);
    mesh.cut(&[h]);
    let start = mesh.atlas().clone();
    let made = mesh.split_edge(h, 0.25);
    assert_eq!((made.vertices.len(), made.uvs.len(), made.faces.len()), (1, 2, 2));
    for (_, _, uv) in &made.uvs {
        assert_eq!(mesh.position(*uv), DVec2::new(1.0, 0.25));
    }
    check(&start, mesh.atlas(), Exactness::Exact).unwrap();
    assert_eq!(mesh.topology().half_edges().filter(|h| mesh.topology().is_seam(*h)).count(), 4, "no T-junction");
}

#[test]
fn stars_and_edges_of_non_manifold_surfaces_are_what_they_are() {
    let fins = surfaces().swap_remove(5).1;
    let mesh = Mesh::new(fins);
    assert_eq!(mesh.star(UvId(0)).collect::<Vec<_>>(), [0, 1, 2, 3].map(FaceId));
    assert_eq!(mesh.half_edges_between(VertexId(0), VertexId(1)), [0, 3, 6, 9].map(HalfEdge));
    assert_eq!(Charts::new(mesh.topology()).len(), 1);
    assert_eq!(non_manifold_edges(mesh.atlas()), 1);
    let degenerate = Mesh::new(surfaces().swap_remove(6).1);
    assert_eq!(degenerate.star(UvId(1)).collect::<Vec<_>>(), [0, 1, 2, 5].map(FaceId), "each face once");
}

#[test]
fn a_surface_without_a_layout_is_one_chart_that_can_be_cut() {
    let mut bare = sheet(2, 2, DVec2::ZERO);
    bare.uv.clear();
    bare.corners.fill([Atlas::NO_UV; 3]);
    let mut mesh = Mesh::new(bare);
    assert_true(&mesh, "bare");
    assert_eq!(Charts::new(mesh.topology()).len(), 1);
    let inner: Vec<HalfEdge> = mesh.topology().half_edges().filter(|h| !mesh.topology().is_border(*h)).collect();
    mesh.cut(&inner);
    assert_eq!(Charts::new(mesh.topology()).len(), 8, "every face for itself");
}
