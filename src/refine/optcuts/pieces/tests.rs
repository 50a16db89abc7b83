//! Each fault of a surface, and the pieces that it leaves.

use super::*;
use crate::atlas::Mesh;
use crate::atlas::testing::{Rng, sheet};

/// A surface without a layout.
fn surface(positions: &[[f64; 3]], triangles: &[[u32; 3]]) -> Atlas {
    let n = triangles.len();
    Atlas {
        surface: Surface {
            positions: positions.iter().map(|p| DVec3::from(*p)).collect(),
            triangles: triangles.iter().map(|t| t.map(VertexId)).collect(),
        },
        uv: Vec::new(),
        corners: vec![[Atlas::NO_UV; 3]; n],
        provenance: (0..n).map(|f| Provenance::whole(FaceId::new(f), 0)).collect(),
        page: vec![0; n],
        sheets: vec![[1, 1]],
    }
}

/// The pieces of a surface, once each is what the search may rely on.
fn pieces(atlas: &Atlas) -> (Vec<Piece>, Faults) {
    let wanted: Vec<bool> = atlas.faces().map(|f| !is_degenerate(atlas.triangle(f))).collect();
    let division = divide(atlas, &wanted);
    let pieces = division.build(atlas, &|_| atlas.has_layout());
    pieces.iter().for_each(|p| assert_flat_able(atlas, p));
    let mut all: Vec<FaceId> = pieces.iter().flat_map(|p| p.faces.clone()).collect();
    all.sort_unstable();
    let every: Vec<FaceId> = atlas.faces().filter(|f| wanted[f.index()]).collect();
    assert_eq!(all, every, "each face that has an area is in one piece");
    (pieces, division.faults)
}

/// Connected, edge- and vertex-manifold, consistently wound, and where the whole has it.
fn assert_flat_able(whole: &Atlas, piece: &Piece) {
    let triangles = &piece.atlas.surface.triangles;
    let mut edges = Vec::new();
    for (f, t) in triangles.iter().enumerate() {
        let own = whole.surface.triangles[piece.faces[f].index()];
        assert_eq!(t.map(|v| piece.vertices[v.index()]), own);
        assert_eq!(piece.atlas.triangle(FaceId::new(f)), whole.triangle(piece.faces[f]));
        edges.extend((0..3).map(|k| (t[k].min(t[(k + 1) % 3]), t[k].max(t[(k + 1) % 3]), t[k] > t[(k + 1) % 3], f)));
    }
    edges.sort_unstable();
    let mut sets = DisjointSets::new(triangles.len());
    let mut spokes = vec![0; piece.vertices.len()];
    let mut borders = vec![0; piece.vertices.len()];
    for run in edges.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)) {
        let ends = [run[0].0.index(), run[0].1.index()];
        match *run {
            [_] => ends.iter().for_each(|v| borders[*v] += 1),
            [a, b] => {
                assert_ne!(a.2, b.2, "wound alike");
                sets.unite(a.3 as u32, b.3 as u32);
            }
            _ => panic!("{} faces at an edge", run.len()),
        }
        ends.iter().for_each(|v| spokes[*v] += 1);
    }
    assert_eq!(sets.sets().len(), 1, "connected");
    for v in 0..piece.vertices.len() {
        let faces = triangles.iter().flatten().filter(|t| t.index() == v).count();
        // One closed fan, or one open one.
        assert!(borders[v] == 0 && spokes[v] == faces || borders[v] == 2 && spokes[v] == faces + 1, "vertex {v}");
    }
}

#[test]
fn a_fin_is_a_piece_and_the_sheet_below_it_stays_whole() {
    let places = [[0., 0., 0.], [1., 0., 0.], [0.5, 1., 0.], [0.5, -1., 0.], [0.5, 0.2, 1.]];
    let (pieces, faults) = pieces(&surface(&places, &[[0, 1, 2], [1, 0, 3], [0, 1, 4]]));
    assert_eq!(pieces.iter().map(|p| p.faces.len()).collect::<Vec<_>>(), [2, 1]);
    assert_eq!((faults.non_manifold_edges, faults.winding_edges), (1, 0));
}

#[test]
fn a_vertex_between_two_fans_is_two() {
    let places = [[0., 0., 0.], [1., 0., 0.], [1., 1., 0.], [-1., 0., 0.], [-1., -1., 0.]];
    let (apart, faults) = pieces(&surface(&places, &[[0, 1, 2], [0, 3, 4]]));
    assert_eq!((apart.len(), faults.doubled_vertices), (2, 1));
    // A strip that touches itself at a vertex stays one piece.
    let places = [[0., 0., 0.], [1., 0., 0.], [1., 1., 0.], [2., 1., 1.], [1., 2., 1.], [0., 1., 1.]];
    let strip = [[0, 1, 2], [1, 3, 2], [2, 3, 4], [4, 3, 5], [4, 5, 0]];
    let (whole, faults) = pieces(&surface(&places, &strip));
    assert_eq!((whole.len(), whole[0].vertices.len(), faults.doubled_vertices), (1, 7, 1));
}

#[test]
fn faces_wound_against_their_neighbours_are_cut_off() {
    let mut atlas = sheet(4, 4, DVec2::ZERO);
    atlas.surface.triangles[10].swap(0, 1);
    let (pieces, faults) = pieces(&surface_of(&atlas));
    assert_eq!(pieces.iter().map(|p| p.faces.len()).collect::<Vec<_>>(), [31, 1]);
    assert_eq!(faults.winding_edges, 3);
}

/// The same surface without its layout.
fn surface_of(atlas: &Atlas) -> Atlas {
    Atlas { uv: Vec::new(), corners: vec![[Atlas::NO_UV; 3]; atlas.face_count()], ..atlas.clone() }
}

#[test]
fn a_band_with_one_side_is_opened() {
    let n = 12;
    let mut places = Vec::new();
    for i in 0..n {
        let turn = std::f64::consts::TAU * f64::from(i) / f64::from(n);
        let (out, half) = (DVec2::from_angle(turn), DVec2::from_angle(turn / 2.0) * 0.3);
        for side in [-1.0, 1.0] {
            let p = out * (1.0 + side * half.x);
            places.push([p.x, p.y, side * half.y]);
        }
    }
    let mut band = Vec::new();
    for i in 0..n as u32 {
        let [c, d] = if i + 1 == n as u32 { [1, 0] } else { [2 * i + 2, 2 * i + 3] };
        band.extend([[2 * i, c, 2 * i + 1], [2 * i + 1, c, d]]);
    }
    let (pieces, faults) = pieces(&surface(&places, &band));
    assert_eq!((pieces.len(), pieces[0].vertices.len()), (1, places.len() + 2));
    assert_eq!((faults.winding_edges, faults.doubled_vertices), (1, 2));
}

#[test]
fn what_is_there_twice_stays_apart() {
    let front = sheet(3, 3, DVec2::ZERO);
    let mut leaf = surface_of(&front);
    // Its back, and one face a third time.
    let back: Vec<_> = front.surface.triangles.iter().map(|[a, b, c]| [*b, *a, *c]).collect();
    leaf.surface.triangles.extend(back);
    leaf.surface.triangles.push(front.surface.triangles[7]);
    let n = leaf.surface.triangles.len();
    leaf.corners = vec![[Atlas::NO_UV; 3]; n];
    leaf.provenance = (0..n).map(|f| Provenance::whole(FaceId::new(f), 0)).collect();
    leaf.page = vec![0; n];
    let (pieces, _) = pieces(&leaf);
    assert_eq!(pieces.iter().map(|p| p.faces.len()).collect::<Vec<_>>(), [18, 18, 1]);
}

#[test]
fn faces_without_area_are_no_piece_and_close_what_lies_about_them() {
    // Between the two faces lies one with two corners at one vertex; beside them one on a line, and one at a point.
    let places = [[0., 0., 0.], [1., 0., 0.], [0.5, 1., 0.], [0.5, -1., 0.], [0.5, 0., 0.]];
    let faces = [[0, 1, 2], [0, 0, 1], [1, 0, 3], [0, 4, 1], [2, 2, 2]];
    let (pieces, faults) = pieces(&surface(&places, &faces));
    assert_eq!((pieces.len(), pieces[0].faces.len(), faults), (1, 2, Faults::default()));
}

#[test]
fn a_t_junction_is_a_cut() {
    let places = [[0., 0., 0.], [1., 0., 0.], [0.5, 1., 0.], [0.5, 0., 0.], [0.5, -1., 0.]];
    let (pieces, faults) = pieces(&surface(&places, &[[0, 1, 2], [3, 0, 4], [1, 3, 4]]));
    assert_eq!((pieces.len(), faults.non_manifold_edges), (2, 0));
}

/// Faces thrown together by chance over few vertices: whatever comes in, the pieces are sound.
#[test]
fn random_soups_fall_into_sound_pieces() {
    let mut rng = Rng(5);
    for round in 0..300 {
        let vertices = 4 + rng.next() % 8;
        let places: Vec<[f64; 3]> = (0..vertices).map(|_| [rng.unit(), rng.unit(), rng.unit()]).collect();
        let faces: Vec<[u32; 3]> = (0..3 + round / 8).map(|_| [0; 3].map(|_| (rng.next() % vertices) as u32)).collect();
        let (found, _) = pieces(&surface(&places, &faces));
        assert!(found.len() <= faces.len());
    }
}

#[test]
fn uploaded_charts_come_in_surface_units_face_up_and_apart() {
    // Two charts of one surface: three texels a unit, y down, the second mirrored and lying on the first.
    let flat = sheet(4, 2, DVec2::ZERO);
    let mut mesh = Mesh::new(flat.clone());
    let middle: Vec<HalfEdge> = (0..3 * flat.face_count())
        .map(HalfEdge::new)
        .filter(|h| [h.corner(), h.end_corner()].iter().all(|k| flat.uv_triangle(h.face())[*k].x == 2.0))
        .collect();
    mesh.cut(&middle);
    let mut atlas = mesh.into_atlas();
    let charts = Charts::new(&Topology::new(&atlas));
    let mut of_uv = vec![0; atlas.uv.len()];
    for (f, corners) in atlas.corners.iter().enumerate() {
        corners.iter().for_each(|c| of_uv[c.index()] = charts.of_face[f].index());
    }
    for (uv, chart) in atlas.uv.iter_mut().zip(of_uv) {
        *uv *= DVec2::new(3.0, if chart == 0 { -3.0 } else { 3.0 });
    }
    let (pieces, _) = pieces(&atlas);
    let piece = &pieces[0];
    assert_eq!((pieces.len(), piece.faces.len(), piece.vertices.len()), (1, 16, 15));
    assert!((piece.density.unwrap() - 3.0).abs() < 1e-12, "{:?}", piece.density);
    let own = &piece.atlas;
    assert_eq!(Charts::new(&Topology::new(own)).len(), 2);
    assert!(own.faces().all(|f| (own.uv_area(f) - own.area(f)).abs() < 1e-9), "face up, at the surface's scale");
    assert!((Strain::of(own).energy() - 4.0).abs() < 1e-9);
    assert!(crate::atlas::overlap::overlaps_where(own, 1, |_, _| true).0.is_empty());
    assert!((seam_length(own) - 2.0).abs() < 1e-9);
    let mut spread = own.clone();
    spread.uv.iter_mut().for_each(|uv| *uv *= 2.0);
    let strain = Strain::of(&spread);
    assert!((strain.energy() - 8.5).abs() < 1e-9 && (strain.best_scale() - 0.5).abs() < 1e-9);
    assert!((strain.least_energy() - 4.0).abs() < 1e-9);
}

#[test]
fn each_face_alone_is_flat_and_none_meets_another() {
    let mut rng = Rng(9);
    let places: Vec<[f64; 3]> = (0..40).map(|_| [rng.unit(), 1e3 * rng.unit(), rng.unit()]).collect();
    let faces: Vec<[u32; 3]> = (0..60).map(|_| [0; 3].map(|_| (rng.next() % 40) as u32)).collect();
    for piece in pieces(&surface(&places, &faces)).0 {
        let flat = all_apart(&piece.atlas);
        for f in flat.faces() {
            assert!((flat.uv_area(f) - flat.area(f)).abs() <= 1e-9 * flat.area(f));
        }
        assert!(crate::atlas::overlap::overlaps_where(&flat, 1, |_, _| true).0.is_empty());
        assert!(Strain::of(&flat).energy() < 4.0 + 1e-6);
    }
}

#[test]
fn a_large_component_is_cut_into_connected_regions_of_about_the_size_asked_for() {
    let atlas = crate::atlas::testing::sheet(40, 40, DVec2::ZERO);
    let mut across = join_faces(&atlas, &vec![true; atlas.face_count()], &mut Faults::default());
    let whole = across.clone();
    assert_eq!(segment(&atlas, &mut across, 3200), 0);
    assert_eq!(across, whole);
    assert_eq!(segment(&atlas, &mut across, 500), 1);
    let mut sets = DisjointSets::new(atlas.face_count());
    for (h, twin) in across.iter().enumerate().filter(|(_, twin)| **twin != HalfEdge::NONE) {
        assert_eq!(across[twin.index()], HalfEdge::new(h));
        sets.unite(h as u32 / 3, twin.face().0);
    }
    let sizes: Vec<usize> = sets.sets().iter().map(Vec::len).collect();
    assert_eq!(sizes.len(), 7, "{sizes:?}");
    assert!(sizes.iter().all(|n| (100..1500).contains(n)), "{sizes:?}");
}
