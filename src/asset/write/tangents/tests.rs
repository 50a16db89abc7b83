//! Shading over a cut that the uploaded model did not have.

use glam::{DAffine2, DVec2, DVec3};
use serde_json::{Value, json};

use super::*;
use crate::asset::write::{BakedImage, read_back, write};
use crate::asset::{MaterialIndex, ReadOptions};
use crate::asset::{TextureSet, fixture, read, read_indices, read_vec4};
use crate::atlas::testing::cut_open;
use crate::atlas::{Charts, Move, Provenance, UvId};
use crate::context::Context;
use crate::texture::Format;

/// A bent strip of squares with smooth normals and a normal map, its UVs sheared, so that tangents are no one's edges.
fn strip(squares: usize) -> Document {
    let mut doc = fixture::document(&[[64, 64], [64, 64]]);
    doc.json["materials"][0]["normalTexture"] = json!({ "index": 1 });
    let (mut positions, mut normals, mut uvs) = (Vec::new(), Vec::new(), Vec::new());
    for i in 0..=squares {
        for j in 0..2 {
            let angle = 0.3 * i as f32;
            positions.push([angle.sin(), j as f32 * 0.4, angle.cos()]);
            normals.push([angle.sin(), 0.0, angle.cos()]);
            let (u, v) = (0.1 + 0.1 * i as f32, 0.5 - 0.15 * j as f32);
            uvs.push([u + 0.05 * (i * i) as f32 / 9.0, v + 0.02 * (i % 3) as f32]);
        }
    }
    let indices: Vec<u32> = (0..squares as u32).flat_map(|i| [0, 2, 1, 1, 2, 3].map(|k| 2 * i + k)).collect();
    let names = [
        ("POSITION", fixture::attribute(&mut doc, &positions)),
        ("NORMAL", fixture::attribute(&mut doc, &normals)),
        ("TEXCOORD_0", fixture::attribute(&mut doc, &uvs)),
    ];
    let primitive = fixture::primitive(&mut doc, &names, &indices);
    fixture::mesh(&mut doc, vec![primitive]);
    doc
}

fn set_of(doc: &Document) -> TextureSet {
    read(doc, &MaterialIndex::new(doc).unwrap(), ReadOptions::default(), &Context::silent()).unwrap().remove(0)
}

fn written(doc: &Document, set: &TextureSet, atlas: &Atlas) -> Document {
    let image =
        |slot: usize| BakedImage { slot, page: 0, format: Format::Png, bytes: fixture::png(2, 2), shared: None };
    let refined = [Refined { set, atlas, images: vec![image(0), image(1)] }];
    let out = write(doc, &MaterialIndex::new(doc).unwrap(), &refined, &Context::silent()).unwrap();
    read_back(&out, &refined, 0, &Context::silent()).unwrap();
    out
}

fn accessor(doc: &Document, name: &str) -> Option<usize> {
    let value = doc.json.pointer(&format!("/meshes/0/primitives/0/{name}"))?;
    value.as_u64().map(|n| n as usize)
}

/// Face 0 split from its first corner to the middle of the opposite side (its neighbour there stays whole:
/// the tests do not look for cracks).
fn split(set: &TextureSet) -> Atlas {
    let mut atlas = set.atlas.clone();
    let face = FaceId(0);
    let middle = DVec3::new(0.0, 0.5, 0.5);
    let [_, b, c] = atlas.triangle(face);
    let [_, v, w] = atlas.uv_triangle(face);
    let vertex = crate::atlas::VertexId::new(atlas.surface.positions.len());
    atlas.surface.positions.push((b + c) * 0.5);
    let uv = UvId::new(atlas.uv.len());
    atlas.uv.push((v + w) * 0.5);
    let (triangle, corners) = (atlas.surface.triangles[0], atlas.corners[0]);
    atlas.surface.triangles[0][2] = vertex;
    atlas.corners[0][2] = uv;
    atlas.provenance[0].barycentric[2] = middle;
    atlas.surface.triangles.push([triangle[0], vertex, triangle[2]]);
    atlas.corners.push([corners[0], uv, corners[2]]);
    let barycentric = [DVec3::X, middle, DVec3::Z];
    atlas.provenance.push(Provenance { barycentric, ..atlas.provenance[0] });
    atlas.page.push(0);
    atlas
}

/// The world-space normal that a texel shows at a corner with this frame.
fn shown([x, y]: [f64; 2], tangent: Tangent, normal: DVec3) -> DVec3 {
    let t = wide([tangent[0], tangent[1], tangent[2]]);
    (t * x + normal.cross(t) * f64::from(tangent[3]) * y + normal * 0.7).normalize()
}

#[test]
fn shading_stays_across_a_new_cut() {
    let doc = strip(6);
    let set = set_of(&doc);
    let before = generate(&doc, &set.primitives[0]).unwrap().unwrap();
    let topology = Topology::new(&set.atlas);
    // Cut across between the third and the fourth square: between faces 5 and 6.
    let cut = topology.half_edges().filter(|h| h.face() == FaceId(5));
    let cut = cut.into_iter().find(|h| topology.uv_twin(*h).is_some_and(|t| t.face() == FaceId(6))).unwrap();
    for base in [set.atlas.clone(), split(&set)] {
        let halves = cut_open(&base, &[cut]);
        let charts = Charts::new(&Topology::new(&halves));
        let moves: Vec<DAffine2> = (0..charts.len())
            .map(|i| DAffine2::from_angle_translation(0.9 * i as f64, DVec2::new(100.0, 60.0 + 70.0 * i as f64)))
            .collect();
        let moved: Vec<Move> =
            moves.iter().map(|m| Move { page: 0, linear: m.matrix2, translate: m.translation }).collect();
        let atlas = halves.moved(&charts, &moved, vec![[400, 400]]);
        let out = written(&doc, &set, &atlas);
        let tangents = read_vec4(&out, accessor(&out, "attributes/TANGENT").unwrap()).unwrap();
        let normals = read_vec3(&out, accessor(&out, "attributes/NORMAL").unwrap()).unwrap();
        let indices = read_indices(&out, accessor(&out, "indices").unwrap()).unwrap();
        // The file's faces are in the order of their sources.
        let mut order: Vec<FaceId> = atlas.faces().collect();
        order.sort_by_key(|f| (atlas.provenance[f.index()].source, *f));
        let mut compared = 0;
        for (triangle, face) in indices.as_chunks::<3>().0.iter().zip(order) {
            let provenance = &atlas.provenance[face.index()];
            let (sin, cos) = (0.9 * charts.of_face[face.index()].index() as f64).sin_cos();
            for (v, b) in triangle.iter().zip(provenance.barycentric) {
                let Some(k) = b.to_array().iter().position(|x| *x == 1.0) else { continue };
                let normal = wide(normals[*v as usize]);
                let texel = [0.4, -0.3];
                // The bake turns directions with their chart.
                let turned = [texel[0] * cos - texel[1] * -sin, texel[1] * cos - texel[0] * sin];
                let old = shown(texel, before[provenance.source.index()][k], normal);
                let new = shown(turned, tangents[*v as usize], normal);
                let angle = old.angle_between(new).to_degrees();
                assert!(angle < 1.0, "face {face:?}: {angle} degrees");
                compared += 1;
            }
        }
        assert!(compared >= 36, "{compared}");
        let lengths = tangents.iter().map(|t| wide([t[0], t[1], t[2]]).length());
        assert!(lengths.into_iter().all(|l| (l - 1.0).abs() < 1e-5));
    }
}

#[test]
fn charts_that_only_move_get_no_tangents() {
    let doc = strip(4);
    let set = set_of(&doc);
    let charts = Charts::new(&Topology::new(&set.atlas));
    let out = |angle: f64| {
        let there = Move { page: 0, linear: glam::DMat2::from_angle(angle), translate: DVec2::new(90.0, 30.0) };
        written(&doc, &set, &set.atlas.moved(&charts, &[there], vec![[300, 300]]))
    };
    assert_eq!(accessor(&out(0.0), "attributes/TANGENT"), None);
    // Turned, sheared UVs would give others than the uploaded ones, turned.
    assert!(accessor(&out(0.4), "attributes/TANGENT").is_some());
    // Without normals shading is flat, and tangents would be refused.
    let mut flat = doc.clone();
    flat.json["meshes"][0]["primitives"][0]["attributes"].as_object_mut().unwrap().shift_remove("NORMAL");
    let out = written(&flat, &set, &split(&set));
    assert_eq!(accessor(&out, "attributes/TANGENT"), None);
    assert_eq!(doc.json["materials"][0]["normalTexture"]["index"], Value::from(1));
}
