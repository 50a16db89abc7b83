//! What every sample promises.

use std::sync::OnceLock;

use glam::{DVec2, DVec3};

use super::*;
use crate::asset::{Document, File, Limits, load, read, read_indices, read_vec2, read_vec3, read_vec4};
use crate::asset::{MaterialIndex, ReadOptions};
use crate::atlas::{Atlas, ChartId, Charts, FaceId, Loops, Topology, VertexId};
use crate::context::Context;

/// [`sample`], made once for all tests of this process.
pub(crate) fn made(name: &str) -> &'static [u8] {
    static MADE: [OnceLock<Vec<u8>>; SAMPLES.len()] = [const { OnceLock::new() }; SAMPLES.len()];
    let index = SAMPLES.iter().position(|(known, _)| *known == name).expect("a sample of that name");
    MADE[index].get_or_init(|| sample(name).expect("a sample"))
}

fn open(name: &str) -> Document {
    let file = File { path: format!("{name}.glb"), bytes: made(name).to_vec() };
    let (doc, warnings) = load(&[file], None, &Limits::default()).unwrap();
    assert!(warnings.is_empty(), "{name}: {warnings:?}");
    assert!(doc.to_glb().unwrap() == made(name), "{name} is saved as it is");
    doc
}

fn triangles(doc: &Document, primitive: usize) -> Vec<[usize; 3]> {
    let found = &doc.json["meshes"][0]["primitives"][primitive]["indices"];
    let indices = read_indices(doc, found.as_u64().unwrap() as usize).unwrap();
    indices.chunks_exact(3).map(|t| [t[0], t[1], t[2]].map(|i| i as usize)).collect()
}

fn accessor(doc: &Document, primitive: usize, name: &str) -> usize {
    doc.json["meshes"][0]["primitives"][primitive]["attributes"][name].as_u64().unwrap() as usize
}

#[test]
fn textures_are_made_as_large_as_wanted() {
    for (side, jpeg) in [(Some(300), true), (Some(4096), false), (None, true)] {
        let bytes = sample_with("textured", SampleTextures { side, jpeg }).unwrap();
        let (doc, _) = load(&[File { path: "m.glb".to_owned(), bytes }], None, &Limits::default()).unwrap();
        let header = crate::texture::header(doc.images[0].as_ref().unwrap()).unwrap();
        let format = if jpeg { crate::texture::Format::Jpeg } else { crate::texture::Format::Png };
        assert!(
            header.format == format && side.is_none_or(|side| header.width.max(header.height) == side),
            "{header:?}"
        );
        assert_eq!(doc.json["images"][0]["mimeType"], format.media_type());
    }
}

#[test]
fn every_sample_is_made_and_read_back() {
    for name in names() {
        // The larger scans are the smallest once more.
        assert!(name.starts_with("scan_") || sample(name).unwrap() == made(name), "{name}: the same bytes every time");
        let doc = open(name);
        assert!(doc.images.iter().all(Option::is_some), "{name}");
        for image in doc.images.iter().flatten() {
            assert!(crate::texture::header(image).unwrap().width >= 256, "{name}");
        }
    }
    assert_eq!(sample("none").unwrap_err().code, Code::InvalidOptions);
}

/// Charts keep the surface's side, and tangents follow u, against the reader's own arithmetic.
#[test]
fn the_textured_sample_is_sound() {
    let doc = open("textured");
    let uvs = read_vec2(&doc, accessor(&doc, 0, "TEXCOORD_0")).unwrap();
    let uvs: Vec<DVec2> = uvs.iter().map(|v| DVec2::from_array(v.map(f64::from))).collect();
    let points = |name: &str| -> Vec<DVec3> {
        read_vec3(&doc, accessor(&doc, 0, name)).unwrap().iter().map(|v| DVec3::from_array(v.map(f64::from))).collect()
    };
    let (positions, normals) = (points("POSITION"), points("NORMAL"));
    let tangents = read_vec4(&doc, accessor(&doc, 0, "TANGENT")).unwrap();
    let faces = triangles(&doc, 0);
    assert!((3500..4500).contains(&faces.len()));
    let mut covered = 0.0;
    for face in faces {
        let [a, b, c] = face.map(|v| positions[v]);
        let [ua, ub, uc] = face.map(|v| uvs[v]);
        let area = (ub - ua).perp_dot(uc - ua);
        assert!(area < 0.0, "no chart is mirrored: v runs down");
        covered -= area / 2.0;
        let along = ((b - a) * (uc - ua).y - (c - a) * (ub - ua).y) / area;
        let down = ((c - a) * (ub - ua).x - (b - a) * (uc - ua).x) / area;
        for v in face {
            let [x, y, z, w] = tangents[v].map(f64::from);
            let tangent = DVec3::new(x, y, z);
            assert!(tangent.dot(along.normalize()) > 0.8);
            assert!((normals[v].cross(tangent) * w).dot(-down.normalize()) > 0.6);
        }
    }
    assert!((0.2..0.6).contains(&covered), "{covered}");
    assert!(uvs.iter().all(|uv| uv.min_element() > 0.0 && uv.max_element() < 1.0));
}

#[test]
fn the_others_have_what_they_are_for() {
    let doc = open("tiled");
    let uvs = read_vec2(&doc, accessor(&doc, 0, "TEXCOORD_0")).unwrap();
    assert!(uvs.iter().any(|uv| uv[0] > 1.0) && uvs.iter().any(|uv| uv[0] < 0.0));
    let doc = open("overlapping");
    let uvs = read_vec2(&doc, accessor(&doc, 0, "TEXCOORD_0")).unwrap();
    assert_eq!(uvs[..uvs.len() / 2], uvs[uvs.len() / 2..]);
    let faces = triangles(&doc, 0);
    let half: Vec<[DVec2; 3]> =
        faces[..faces.len() / 2].iter().map(|f| f.map(|v| DVec2::from_array(uvs[v].map(f64::from)))).collect();
    let inside = |p: DVec2, [a, b, c]: &[DVec2; 3]| {
        [(a, b), (b, c), (c, a)].iter().all(|(a, b)| (**b - **a).perp_dot(p - **a) < 0.0)
    };
    let covered = half.iter().filter(|f| {
        let middle = f.iter().sum::<DVec2>() / 3.0;
        half.iter().filter(|other| inside(middle, other)).count() > 1
    });
    assert!(covered.count() > 10, "one half overlaps itself by accident");
    let doc = open("fragmented");
    assert!(triangles(&doc, 0).len() > 10_000);
    let doc = open("quantized");
    let position = read_vec3(&doc, accessor(&doc, 0, "POSITION")).unwrap();
    assert!(position.iter().flatten().all(|v| v.abs() <= 1.0) && position.iter().flatten().any(|v| v.abs() > 0.7));
    let doc = open("strips");
    let heights = read_vec3(&doc, accessor(&doc, 0, "POSITION")).unwrap();
    assert!(heights.iter().any(|p| p[1] > 0.2) && heights.iter().any(|p| p[1] == 0.0));
    let doc = open("skinned");
    assert_eq!(doc.json["meshes"][0]["primitives"][0]["material"], doc.json["meshes"][0]["primitives"][1]["material"]);
    let doc = open("two_materials");
    assert!(doc.json["meshes"][0]["primitives"][2]["attributes"].get("TEXCOORD_0").is_none());
    assert_eq!(doc.images.len(), 2);
}

#[test]
fn bare_surfaces_have_no_layout_and_the_faults_they_are_for() {
    let faults = |name: &str| {
        let atlas = atlas(name);
        assert!(!atlas.has_layout(), "{name}");
        let flat = atlas.faces().filter(|f| atlas.area(*f) == 0.0).count();
        (crate::atlas::testing::non_manifold_edges(&atlas), flat)
    };
    assert_eq!(faults("bare"), (0, 0));
    let (edges, flat) = faults("defects");
    assert!(edges > 3 && flat == 3, "{edges} {flat}");
}

fn atlas(name: &str) -> Atlas {
    let (doc, _) =
        load(&[File { path: "scan.glb".to_owned(), bytes: made(name).to_vec() }], None, &Limits::default()).unwrap();
    let mut sets = read(&doc, &MaterialIndex::new(&doc).unwrap(), ReadOptions::default(), &Context::silent()).unwrap();
    assert_eq!(sets.len(), 1);
    sets.remove(0).atlas
}

#[test]
fn scans_have_as_many_charts_as_they_say() {
    for (name, count, faces) in [
        ("scan", 500, 18..23),
        ("scan_2000", 2000, 18..23),
        ("scan_10000", 10_000, 18..23),
        ("scan_20000", 20_000, 9..12),
    ] {
        let atlas = atlas(name);
        let charts = Charts::new(&Topology::new(&atlas)).len();
        assert!(charts.abs_diff(count) < count / 10, "{name}: {charts}");
        assert!(faces.contains(&(atlas.face_count() / charts)), "{name}: {}", atlas.face_count());
    }
}

/// A surface that is torn has what others have not: slivers, and vertices of many charts.
#[test]
fn a_torn_scan_has_slivers_and_vertices_of_many_charts() {
    let share = |name: &str| {
        let atlas = atlas(name);
        let charts = Charts::new(&Topology::new(&atlas));
        let is_sliver = |f: &FaceId| {
            let [a, b, c] = atlas.triangle(*f);
            let longest = a.distance(b).max(b.distance(c)).max(c.distance(a));
            (0.0..0.04).contains(&(2.0 * atlas.area(*f) / (longest * longest))) && atlas.area(*f) > 0.0
        };
        let slivers = atlas.faces().filter(is_sliver).count() as f64 / atlas.face_count() as f64;
        let mut at: Vec<(VertexId, ChartId)> = Vec::new();
        for f in atlas.faces() {
            let own = charts.of_face[f.index()];
            at.extend(atlas.surface.triangles[f.index()].iter().map(|v| (*v, own)));
        }
        at.sort_unstable();
        at.dedup();
        let crowded = at.chunk_by(|a, b| a.0 == b.0).filter(|own| own.len() >= 6).count();
        (slivers, crowded as f64 / atlas.face_count() as f64)
    };
    let ((smooth, few), (torn, many)) = (share("scan_2000"), share("scan_20000"));
    assert!(torn > 3.0 * smooth && torn > 0.01, "{smooth} {torn}");
    assert!(many > 4.0 * few, "{few} {many}");
}

/// What makes a scan hard to refine is there, and no more of it than scans have.
#[test]
fn a_scan_has_islands_holes_and_faults() {
    let atlas = atlas("scan");
    let topology = Topology::new(&atlas);
    let charts = Charts::new(&topology);
    let small = charts.faces.iter().filter(|faces| faces.len() <= 3).count();
    assert!((charts.len() / 4..charts.len() / 2).contains(&small), "{small}");
    let loops = Loops::new(&topology, &charts);
    let mut count = vec![0; charts.len()];
    loops.chart.iter().for_each(|chart| count[chart.index()] += 1);
    assert!(count.iter().filter(|n| **n > 1).count() >= 8, "charts with holes");
    assert!(crate::atlas::testing::non_manifold_edges(&atlas) >= 4);
    let flat: Vec<_> = atlas.faces().filter(|f| atlas.uv_area(*f) == 0.0).collect();
    assert!(flat.len() >= 6 && flat.iter().all(|f| atlas.area(*f) == 0.0), "faces without area");
    let mut turned = 0;
    let mut densities = Vec::new();
    for faces in &charts.faces {
        let (area, uv_area): (f64, f64) =
            faces.iter().map(|f| (atlas.area(*f), atlas.uv_area(*f))).fold((0.0, 0.0), |s, a| (s.0 + a.0, s.1 + a.1));
        turned += faces.iter().filter(|f| atlas.uv_area(**f) * uv_area < 0.0).count();
        if faces.len() > 10 {
            densities.push((uv_area.abs() / area).sqrt());
        }
    }
    assert!((5..40).contains(&turned), "{turned}");
    let [low, high] =
        [f64::min, f64::max].map(|pick: fn(f64, f64) -> f64| densities.iter().copied().reduce(pick).unwrap());
    assert!(high / low > 1.5 && low > 30.0, "{low} to {high} texels by unit");
    let doc = open("scan");
    let positions = read_vec3(&doc, accessor(&doc, 0, "POSITION")).unwrap();
    let uvs = read_vec2(&doc, accessor(&doc, 0, "TEXCOORD_0")).unwrap();
    let mut vertices: Vec<_> =
        positions.iter().zip(&uvs).map(|(p, uv)| (p.map(f32::to_bits), uv.map(f32::to_bits))).collect();
    vertices.sort_unstable();
    let all = vertices.len();
    vertices.dedup();
    assert!(all - vertices.len() > 50, "vertices in several copies");
}
