//! Writing, on small documents made by code.

use glam::{DAffine2, DMat2, DVec2, DVec3};
use serde_json::{Value, json};

use super::*;
use crate::asset::ReadOptions;
use crate::asset::fixture::{attribute, bowtie, document, mesh, png, primitive};
use crate::asset::{
    ComponentType, File, Kind, Limits, load, raw_elements, read, read_indices, read_vec2, read_vec3, read_vec4,
};
use crate::atlas::{Charts, FaceId, Move, Provenance, Topology, UvId, VertexId};

fn sets_of(doc: &Document) -> Vec<TextureSet> {
    let mut sets = read(doc, &MaterialIndex::new(doc).unwrap(), ReadOptions::default(), &Context::silent()).unwrap();
    sets.retain(|set| set.atlas.has_layout());
    sets
}

/// Charts moved as told, one page unless told.
fn moved(set: &TextureSet, moves: &[(DAffine2, u16)], sheets: &[[u32; 2]]) -> Atlas {
    let charts = Charts::new(&Topology::new(&set.atlas));
    let moves: Vec<Move> =
        moves.iter().map(|(m, page)| Move { page: *page, linear: m.matrix2, translate: m.translation }).collect();
    set.atlas.moved(&charts, &moves, sheets.to_vec())
}

fn shift(x: f64, y: f64) -> (DAffine2, u16) {
    (DAffine2::from_translation(DVec2::new(x, y)), 0)
}

fn baked(set: &TextureSet, pages: usize) -> Vec<BakedImage> {
    let slots = (0..set.slots.len()).flat_map(|slot| (0..pages).map(move |page| (slot, page)));
    slots
        .map(|(slot, page)| BakedImage {
            slot,
            page,
            format: Format::Png,
            bytes: png(3, page as u32 + 1),
            shared: None,
        })
        .collect()
}

/// Writes one set, saves and loads it.
fn round(doc: &Document, set: &TextureSet, atlas: &Atlas) -> Document {
    let refined = [Refined { set, atlas, images: baked(set, atlas.sheets.len()) }];
    let out = write(doc, &MaterialIndex::new(doc).unwrap(), &refined, &Context::silent()).unwrap();
    let again = read_back(&out, &refined, 0, &Context::silent()).unwrap();
    assert_eq!(again.face_count(), atlas.face_count());
    for face in atlas.faces() {
        for (a, b) in again.uv_triangle(face).into_iter().zip(atlas.uv_triangle(face)) {
            assert!((a - b).length() < 1e-4, "{face:?}: {a} is not {b}");
        }
    }
    let file = File { path: "model.glb".to_owned(), bytes: out.to_glb().unwrap() };
    load(&[file], None, &Limits::default()).unwrap();
    out
}

fn accessor(doc: &Document, pointer: &str) -> usize {
    doc.json.pointer(pointer).and_then(Value::as_u64).unwrap() as usize
}

const FIRST: &str = "/meshes/0/primitives/0";

#[test]
fn one_uv_a_vertex_changes_nothing_else() {
    let mut doc = document(&[[16, 8]]);
    let p = bowtie(&mut doc);
    mesh(&mut doc, vec![p]);
    doc.json["extras"] = json!({ "kept": [1.5, null] });
    let sets = sets_of(&doc);
    let atlas = moved(&sets[0], &[shift(1.0, 2.0), shift(1.0, 2.0)], &[[32, 16]]);
    let out = round(&doc, &sets[0], &atlas);
    let mut expected = doc.json.clone();
    let uv = accessor(&out, &format!("{FIRST}/attributes/TEXCOORD_0"));
    expected["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = Value::from(uv);
    expected["textures"][0]["sampler"] = Value::from(0);
    expected["samplers"] = json!([{ "wrapS": 33071, "wrapT": 33071 }]);
    for key in ["accessors", "bufferViews", "buffers"] {
        expected[key] = out.json[key].clone();
        let old = doc.json[key].as_array().unwrap();
        assert!(key == "buffers" || out.json[key].as_array().unwrap()[..old.len()] == old[..]);
    }
    assert_eq!(out.json, expected);
    assert_eq!(uv, doc.json["accessors"].as_array().unwrap().len());
    assert_eq!(out.images[0].as_ref().unwrap(), &png(3, 1));
    assert_eq!(read_vec2(&out, uv).unwrap()[0], [(0.5 * 16.0 + 1.0) / 32.0, (0.5 * 8.0 + 2.0) / 16.0]);
}

#[test]
fn a_vertex_of_two_uvs_is_copied_bit_by_bit() {
    let mut doc = document(&[[16, 8]]);
    let mut p = bowtie(&mut doc);
    let delta = attribute(&mut doc, &[[f32::MIN_POSITIVE, -0.0, 3.0]; 5]);
    p["targets"] = json!([{ "POSITION": delta }]);
    // A strip and another primitive on the same accessors.
    let mut strip = p.clone();
    strip["mode"] = Value::from(5);
    strip["indices"] = Value::from(doc.append_accessor(&RawAccessor::from_indices(&[0, 1, 2]), None, false));
    mesh(&mut doc, vec![p, strip]);
    let sets = sets_of(&doc);
    assert_eq!(sets[0].atlas.face_count(), 3);
    // Primitive 0's first triangle and the strip are one chart.
    let atlas = moved(&sets[0], &[shift(0.0, 0.0), shift(20.0, 0.0)], &[[40, 16]]);
    let out = round(&doc, &sets[0], &atlas);
    let (a, b) = (&out.json["meshes"][0]["primitives"][0], &out.json["meshes"][0]["primitives"][1]);
    assert_eq!(a["attributes"], b["attributes"], "vertices are shared as they were");
    assert_eq!((&b["mode"], &b["indices"]), (&Value::from(5), &doc.json["meshes"][0]["primitives"][1]["indices"]));
    let indices = read_indices(&out, accessor(&out, &format!("{FIRST}/indices"))).unwrap();
    assert_eq!(indices, [0, 1, 2, 5, 3, 4]);
    for name in ["attributes/POSITION", "attributes/NORMAL", "targets/0/POSITION"] {
        let at = format!("{FIRST}/{name}");
        let (old, new) =
            (raw_elements(&doc, accessor(&doc, &at)).unwrap(), raw_elements(&out, accessor(&out, &at)).unwrap());
        assert_eq!(new.data[..old.data.len()], old.data);
        assert_eq!(new.data[old.data.len()..], old.data[..old.element_size]);
    }
}

#[test]
fn a_strip_becomes_a_list_where_its_triangles_part() {
    let mut doc = document(&[[16, 8]]);
    let mut p = bowtie(&mut doc);
    p["mode"] = Value::from(5);
    p["indices"] = Value::from(doc.append_accessor(&RawAccessor::from_indices(&[1, 2, 0, 3]), None, false));
    mesh(&mut doc, vec![p]);
    let sets = sets_of(&doc);
    let mut atlas = sets[0].atlas.clone();
    for corner in &mut atlas.corners[1] {
        atlas.uv.push(atlas.uv[corner.index()] + 10.0);
        *corner = UvId::new(atlas.uv.len() - 1);
    }
    atlas.sheets = vec![[32, 32]];
    let out = round(&doc, &sets[0], &atlas);
    assert_eq!(out.json["meshes"][0]["primitives"][0]["mode"], 4);
    let indices = read_indices(&out, accessor(&out, &format!("{FIRST}/indices"))).unwrap();
    assert_eq!(indices, [1, 2, 0, 5, 3, 6]);
}

#[test]
fn tangents_turn_with_their_chart() {
    let mut doc = document(&[[16, 16], [16, 16]]);
    doc.json["materials"][0]["normalTexture"] = json!({ "index": 1 });
    let mut p = bowtie(&mut doc);
    let (s, c) = 0.4f32.sin_cos();
    let tangents = attribute(&mut doc, &[[c, s, 0.0, 1.0]; 5]);
    let steps = attribute(&mut doc, &[[0.0, 1.0, 0.0]; 5]);
    p["attributes"]["TANGENT"] = Value::from(tangents);
    p["targets"] = json!([{ "TANGENT": steps }]);
    mesh(&mut doc, vec![p]);
    let sets = sets_of(&doc);
    let mirror = DAffine2::from_mat2(DMat2::from_diagonal(DVec2::new(-1.0, 1.0)));
    let first = DAffine2::from_angle_translation(0.7, DVec2::new(20.0, 5.0));
    let second = DAffine2::from_translation(DVec2::new(40.0, 20.0)) * DAffine2::from_angle(2.0) * mirror;
    let atlas = moved(&sets[0], &[(first, 0), (second, 0)], &[[64, 64]]);
    let out = round(&doc, &sets[0], &atlas);
    /// Signed angle of TANGENT from dP/dU about +z for each corner of each face, and whether
    /// w gives the direction up the image.
    fn angles(doc: &Document) -> Vec<(f64, f64)> {
        let get = |name: &str| accessor(doc, &format!("{FIRST}/attributes/{name}"));
        let indices = read_indices(doc, accessor(doc, &format!("{FIRST}/indices"))).unwrap();
        let positions = read_vec3(doc, get("POSITION")).unwrap();
        let tangents = read_vec4(doc, get("TANGENT")).unwrap();
        let uvs = read_vec2(doc, get("TEXCOORD_0")).unwrap();
        let mut out = Vec::new();
        for face in indices.as_chunks::<3>().0 {
            let p = face.map(|v| DVec3::from(positions[v as usize].map(f64::from)));
            let t = face.map(|v| DVec2::from(uvs[v as usize].map(f64::from)));
            let (e, f, a, b) = (p[1] - p[0], p[2] - p[0], t[1] - t[0], t[2] - t[0]);
            let (du, dv) = ((e * b.y - f * a.y) / a.perp_dot(b), (f * a.x - e * b.x) / a.perp_dot(b));
            for v in face {
                let [x, y, z, w] = tangents[*v as usize].map(f64::from);
                let tangent = DVec3::new(x, y, z);
                let bitangent = DVec3::Z.cross(tangent) * w;
                out.push((tangent.dot(DVec3::Z.cross(du)).atan2(tangent.dot(du)), bitangent.dot(-dv).signum()));
            }
        }
        out
    }
    let (before, after) = (angles(&doc), angles(&out));
    assert_eq!(before.len(), 6);
    for (b, a) in before.iter().zip(&after) {
        assert!((b.0 - a.0).abs() < 1e-3 && b.1 == a.1, "{before:?} {after:?}");
    }
    // A step along +y is turned by the same angle as the tangents: at vertex 1, by 0.7 against the UVs' sense.
    let steps = read_vec3(&out, accessor(&out, &format!("{FIRST}/targets/0/TANGENT"))).unwrap();
    let angle = f64::from(steps[1][1]).atan2(f64::from(steps[1][0]));
    assert!((angle - (std::f64::consts::FRAC_PI_2 + 0.7)).abs() < 1e-6, "{angle}");
}

#[test]
fn pages_clone_materials_and_split_primitives() {
    let mut doc = document(&[[16, 8]]);
    let mut p = bowtie(&mut doc);
    doc.push("materials", json!({ "name": "n", "pbrMetallicRoughness": { "baseColorTexture": { "index": 0 } } }));
    p["extensions"] = json!({ "KHR_materials_variants": { "mappings": [{ "material": 1, "variants": [0] }] } });
    mesh(&mut doc, vec![p]);
    let sets = sets_of(&doc);
    let there = |page| (DAffine2::IDENTITY, page);
    let out = round(&doc, &sets[0], &moved(&sets[0], &[there(0), there(1)], &[[16, 8], [16, 16]]));
    let primitives = out.json["meshes"][0]["primitives"].as_array().unwrap();
    assert_eq!(primitives.len(), 2);
    assert_eq!((&primitives[0]["material"], &primitives[1]["material"]), (&json!(0), &json!(2)));
    let mapped = |p: &Value| p["extensions"]["KHR_materials_variants"]["mappings"][0]["material"].clone();
    assert_eq!((mapped(&primitives[0]), mapped(&primitives[1])), (json!(1), json!(3)));
    assert_eq!(out.json["materials"][2]["name"], "m (page 2)");
    assert_eq!(out.json["materials"][2]["pbrMetallicRoughness"]["baseColorTexture"]["index"], 1);
    assert_eq!(out.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["index"], 0);
    assert_eq!(out.json["textures"][1]["source"], 1);
    assert_eq!(out.images[1].as_ref().unwrap(), &png(3, 2));
    assert_eq!(read_indices(&out, accessor(&out, "/meshes/0/primitives/1/indices")).unwrap().len(), 3);
}

#[test]
fn what_others_read_stays_theirs() {
    let mut doc = document(&[[16, 8]]);
    let p = bowtie(&mut doc);
    let mut points = p.clone();
    points["mode"] = Value::from(0);
    mesh(&mut doc, vec![p, points]);
    let sets = sets_of(&doc);
    let out = round(&doc, &sets[0], &moved(&sets[0], &[shift(0.0, 0.0), shift(0.0, 0.0)], &[[32, 16]]));
    assert_eq!(out.json["meshes"][0]["primitives"][1], doc.json["meshes"][0]["primitives"][1]);
    for key in ["materials", "textures", "images"] {
        assert_eq!(out.json[key][0], doc.json[key][0]);
        assert_eq!(out.json[key].as_array().unwrap().len(), 2, "{key}");
    }
    assert_eq!(out.images[0], doc.images[0]);
    assert_eq!(out.json["meshes"][0]["primitives"][0]["material"], 1);
    assert_eq!(out.json["materials"][1]["pbrMetallicRoughness"]["baseColorTexture"]["index"], 1);
    assert_eq!((&out.json["textures"][1]["source"], &out.json["textures"][1]["sampler"]), (&json!(1), &json!(0)));
}

#[test]
fn uvs_with_other_readers_stay_and_a_new_set_is_written() {
    let mut doc = document(&[[16, 8]]);
    let mut p = bowtie(&mut doc);
    p["extensions"] = json!({ "EXT_mesh_features": { "featureIds": [{ "featureCount": 1, "texture": { "texCoord": 0, "index": 0 } }] } });
    mesh(&mut doc, vec![p]);
    let sets = sets_of(&doc);
    let out = round(&doc, &sets[0], &moved(&sets[0], &[shift(0.0, 0.0), shift(0.0, 0.0)], &[[32, 16]]));
    let (old, new) = (&doc.json["meshes"][0]["primitives"][0], &out.json["meshes"][0]["primitives"][0]);
    assert_eq!(new["attributes"]["TEXCOORD_0"], old["attributes"]["TEXCOORD_0"]);
    assert!(new["attributes"]["TEXCOORD_1"].is_u64());
    let info = &out.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"];
    // The extension reads the old image, which stays.
    assert_eq!(info, &json!({ "index": 1, "texCoord": 1 }));
    assert_eq!(out.images[0], doc.images[0]);
}

/// Splits each of two faces that share the edge from (1,0,0) to (0,1,0) at a point of it, as a stage would.
fn split(set: &TextureSet, t: f64) -> Atlas {
    let mut atlas = set.atlas.clone();
    let ends = [DVec3::new(1.0, 0.0, 0.1), DVec3::new(0.0, 1.0, 0.3)];
    let middle = VertexId::new(atlas.surface.positions.len());
    atlas.surface.positions.push(ends[0].lerp(ends[1], t));
    for source in [0, 1] {
        let corners = atlas.triangle(FaceId(source));
        let [i, j] = ends.map(|e| corners.iter().position(|p| (*p - e).length() < 1e-6).unwrap());
        let mut b = DVec3::ZERO;
        // Each side computes its own way.
        (b[i], b[j]) = if source == 0 { (1.0 - t, t) } else { (1.0 - t * (1.0 + 1e-15), t * (1.0 + 1e-15)) };
        let uv = atlas.uv_triangle(FaceId(source));
        let new = UvId::new(atlas.uv.len());
        atlas.uv.push(uv[0] * b.x + uv[1] * b.y + uv[2] * b.z);
        let (surface, uvs) = (atlas.surface.triangles[source as usize], atlas.corners[source as usize]);
        for (n, end) in [i, j].into_iter().enumerate() {
            let (mut s, mut c, mut whole) = (surface, uvs, Provenance::WHOLE);
            (s[end], c[end], whole[end]) = (middle, new, b);
            if n == 0 {
                atlas.surface.triangles[source as usize] = s;
                atlas.corners[source as usize] = c;
                atlas.provenance[source as usize].barycentric = whole;
            } else {
                atlas.surface.triangles.push(s);
                atlas.corners.push(c);
                atlas.provenance.push(Provenance { barycentric: whole, ..set.atlas.provenance[source as usize] });
                atlas.page.push(0);
            }
        }
    }
    atlas
}

#[test]
fn split_edges_leave_no_crack_between_primitives() {
    let mut doc = document(&[[16, 8]]);
    let (a, b) = ([1.0, 0.0, 0.1], [0.0, 1.0, 0.3]);
    // The shared edge runs the other way in the second primitive, as it should, and its ends have other numbers.
    let make = |doc: &mut Document, places: [[f32; 3]; 3], u: f32, joints: [u8; 3]| {
        let p = attribute(doc, &places);
        let n = attribute(doc, &[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
        let t = attribute(doc, &[[u, 0.1], [u + 0.2, 0.1], [u, 0.9]]);
        let c = doc.append_accessor(
            &RawAccessor::new(
                ComponentType::U8,
                Kind::Vec4,
                true,
                vec![255, 0, 0, 255, 0, 255, 0, 255, 0, 0, 255, 255],
            ),
            Some(34962),
            false,
        );
        let j = doc.append_accessor(
            &RawAccessor::new(
                ComponentType::U8,
                Kind::Vec4,
                false,
                joints.into_iter().flat_map(|j| [j, j + 1, j + 2, 0]).collect(),
            ),
            Some(34962),
            false,
        );
        let w = attribute(doc, &[[0.5, 0.3, 0.2, 0.0]; 3]);
        let names =
            [("POSITION", p), ("NORMAL", n), ("TEXCOORD_0", t), ("COLOR_0", c), ("JOINTS_0", j), ("WEIGHTS_0", w)];
        primitive(doc, &names, &[])
    };
    let first = make(&mut doc, [[0.0, 0.0, 0.0], a, b], 0.1, [0, 10, 20]);
    let second = make(&mut doc, [b, a, [1.0, 1.0, 0.0]], 0.5, [20, 10, 30]);
    mesh(&mut doc, vec![first, second]);
    let sets = sets_of(&doc);
    let t = 0.3712345678;
    let out = round(&doc, &sets[0], &split(&sets[0], t));
    let mut points = Vec::new();
    for p in 0..2 {
        let get = |name: &str| accessor(&out, &format!("/meshes/0/primitives/{p}/attributes/{name}"));
        let positions = read_vec3(&out, get("POSITION")).unwrap();
        assert_eq!(positions.len(), 4, "one new vertex");
        points.push(positions[3].map(f32::to_bits));
        let normal = DVec3::from(read_vec3(&out, get("NORMAL")).unwrap()[3].map(f64::from));
        assert!((normal.length() - 1.0).abs() < 1e-6);
        let color = read_vec4(&out, get("COLOR_0")).unwrap();
        assert_eq!(color[0], [1.0, 0.0, 0.0, 1.0]);
        assert!((color[3].iter().sum::<f32>() - 2.0).abs() < 1e-6);
        let weights = read_vec4(&out, get("WEIGHTS_0")).unwrap()[3];
        assert!((weights.iter().sum::<f32>() - 1.0).abs() < 1e-6, "six influences cut to four: {weights:?}");
        let joints = raw_elements(&out, get("JOINTS_0")).unwrap();
        assert_eq!(joints.data[12..], [10, 11, 20, 12], "the same for both primitives, strongest first");
    }
    assert_eq!(points[0], points[1]);
}

/// Where the real models are; none where they are not at hand.
fn data_folder() -> std::path::PathBuf {
    let beside = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    std::env::var_os("INTARSIA_DATA").map_or(beside, std::path::PathBuf::from)
}

fn data(path: &str) -> Option<Document> {
    let path = data_folder().join(path);
    if !path.exists() {
        println!("skipped: {} is not there", path.display());
        return None;
    }
    let files = crate::asset::read_paths(std::slice::from_ref(&path)).unwrap();
    Some(load(&files, None, &Limits::default()).unwrap().0)
}

#[test]
fn real_models_keep_every_vertex_of_every_face() {
    let mut tried = 0;
    for path in [
        "pbr/khr_Monster/Monster.glb",
        "pbr/khr_CesiumMan/CesiumMan.glb",
        "pbr/khr_BoomBoxWithAxes/BoomBoxWithAxes.gltf",
        "pbr/khr_AnimatedCube/AnimatedCube.gltf",
        "pbr/khr_TextureSettingsTest/TextureSettingsTest.glb",
        "pbr/trimesh_fuze/fuze.obj",
        "uv/spot.obj",
    ] {
        let Some(doc) = data(path) else { continue };
        tried += 1;
        let sets = sets_of(&doc);
        assert!(!sets.is_empty(), "{path}");
        let turn = DAffine2::from_angle(std::f64::consts::FRAC_PI_2);
        let atlases: Vec<Atlas> = sets
            .iter()
            .map(|set| {
                let charts = Charts::new(&Topology::new(&set.atlas)).len();
                let moves = (0..charts).map(|i| {
                    let there = DAffine2::from_translation(DVec2::new(5000.0, 10.0 * i as f64));
                    (if i % 2 == 0 { there } else { there * turn }, (i % 3 / 2) as u16)
                });
                moved(set, &moves.collect::<Vec<_>>(), &[[9000, 9000], [8000, 8000]])
            })
            .collect();
        let refined: Vec<Refined<'_>> =
            sets.iter().zip(&atlases).map(|(set, atlas)| Refined { set, atlas, images: baked(set, 2) }).collect();
        let out = write(&doc, &MaterialIndex::new(&doc).unwrap(), &refined, &Context::silent()).unwrap();
        for (i, one) in refined.iter().enumerate() {
            let again = read_back(&out, &refined, i, &Context::silent()).unwrap();
            for face in one.atlas.faces() {
                assert_eq!(again.triangle(face), one.atlas.triangle(face), "{path}");
                let uvs = again.uv_triangle(face).into_iter().zip(one.atlas.uv_triangle(face));
                assert!(uvs.into_iter().all(|(a, b)| (a - b).length() < 2e-3), "{path}");
            }
            let charts = |atlas: &Atlas| Charts::new(&Topology::new(atlas)).len();
            assert_eq!(charts(&again), charts(one.atlas), "{path}");
            vertices_are_kept(&doc, &out, one, path);
        }
        let file = File { path: "model.glb".to_owned(), bytes: out.to_glb().unwrap() };
        load(&[file], None, &Limits::default()).unwrap();
    }
    assert!(tried > 0 || !data_folder().is_dir(), "models are at hand, and none was tried");
}

/// Every corner of the first page has all attributes of its uploaded vertex, bit by bit, but for what turns with the layout.
fn vertices_are_kept(doc: &Document, out: &Document, refined: &Refined<'_>, path: &str) {
    let faces = faces_of(refined.set, refined.atlas).unwrap();
    for (primitive, faces) in refined.set.primitives.iter().zip(faces) {
        let pointer = primitive_pointer(primitive.mesh, primitive.primitive);
        let page = pages(refined.atlas, &faces)[0];
        let indices = read_indices(out, accessor(out, &format!("{pointer}/indices"))).unwrap();
        let on_page = faces.iter().filter(|f| refined.atlas.page[f.index()] == page);
        let old: Vec<u32> = on_page.flat_map(|f| primitive.corners[f.index() - primitive.first_face]).collect();
        assert_eq!(indices.len(), old.len());
        let names = doc.json.pointer(&format!("{pointer}/attributes")).unwrap().as_object().unwrap().keys();
        for name in names.filter(|n| !["TEXCOORD_0", "TANGENT"].contains(&n.as_str())) {
            let [before, after] =
                [doc, out].map(|d| raw_elements(d, accessor(d, &format!("{pointer}/attributes/{name}"))).unwrap());
            let size = before.element_size;
            for (new, old) in indices.iter().zip(&old) {
                let element = |raw: &RawAccessor, v: u32| raw.data[v as usize * size..][..size].to_vec();
                assert_eq!(element(&after, *new), element(&before, *old), "{path} {name}");
            }
        }
    }
}

#[test]
fn a_texture_transform_is_taken_into_the_uvs() {
    let mut doc = document(&[[16, 16], [8, 8]]);
    let transform = json!({ "KHR_texture_transform": { "scale": [0.5, 0.5], "offset": [0.25, 0.0] } });
    let info = json!({ "index": 0, "extensions": transform, "extras": 1 });
    doc.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] = info;
    doc.json["extensionsUsed"] = json!(["KHR_texture_transform"]);
    doc.json["extensionsRequired"] = json!(["KHR_texture_transform"]);
    let p = bowtie(&mut doc);
    mesh(&mut doc, vec![p]);
    let sets = sets_of(&doc);
    let atlas = moved(&sets[0], &[shift(1.0, 2.0), shift(1.0, 2.0)], &[[16, 16]]);
    let out = round(&doc, &sets[0], &atlas);
    let expected = json!({ "index": 0, "extras": 1 });
    assert_eq!(out.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"], expected);
    assert!(out.json.get("extensionsUsed").is_none() && out.json.get("extensionsRequired").is_none());
    let uvs = read_vec2(&out, accessor(&out, &format!("{FIRST}/attributes/TEXCOORD_0"))).unwrap();
    assert_eq!(uvs[0], [(0.5 * 8.0 + 4.0 + 1.0) / 16.0, (0.5 * 8.0 + 2.0) / 16.0]);
    // Another texture that reads the set untransformed keeps it, and the new layout is a set of its own.
    doc.json["materials"][0]["emissiveTexture"] = json!({ "index": 1 });
    let sets = sets_of(&doc);
    let atlas = moved(&sets[0], &[shift(1.0, 2.0), shift(1.0, 2.0)], &[[16, 16]]);
    let out = round(&doc, &sets[0], &atlas);
    let material = &out.json["materials"][0];
    let expected = json!({ "index": 0, "extras": 1, "texCoord": 1 });
    assert_eq!(material["pbrMetallicRoughness"]["baseColorTexture"], expected);
    assert_eq!(material["emissiveTexture"], json!({ "index": 1 }));
    let attributes = format!("{FIRST}/attributes");
    let old = doc.json.pointer(&attributes).unwrap()["TEXCOORD_0"].clone();
    assert_eq!(out.json.pointer(&attributes).unwrap()["TEXCOORD_0"], old);
    assert_eq!(read_vec2(&out, accessor(&out, &format!("{attributes}/TEXCOORD_1"))).unwrap(), uvs);
}

#[test]
fn an_image_of_two_meanings_becomes_two_images() {
    let mut doc = document(&[[16, 16]]);
    doc.json["materials"][0]["normalTexture"] = json!({ "index": 0, "scale": 0.5 });
    let p = bowtie(&mut doc);
    mesh(&mut doc, vec![p]);
    let sets = sets_of(&doc);
    let atlas = moved(&sets[0], &[shift(1.0, 2.0), shift(1.0, 2.0)], &[[16, 16]]);
    let out = round(&doc, &sets[0], &atlas);
    let material = &out.json["materials"][0];
    assert_eq!(material["pbrMetallicRoughness"]["baseColorTexture"], json!({ "index": 0 }));
    assert_eq!(material["normalTexture"], json!({ "index": 1, "scale": 0.5 }));
    let sources: Vec<_> = out.json["textures"].as_array().unwrap().iter().map(|t| t["source"].clone()).collect();
    assert_eq!((sources, out.images.len()), (vec![json!(0), json!(1)], 2));
}

#[test]
fn a_texture_loses_the_extension_that_gave_its_image() {
    let mut doc = document(&[[16, 16], [16, 16]]);
    doc.json["textures"] = json!([{ "source": 0, "extensions": { "EXT_texture_webp": { "source": 1 } } }]);
    doc.json["extensionsUsed"] = json!(["EXT_texture_webp"]);
    let p = bowtie(&mut doc);
    mesh(&mut doc, vec![p]);
    let sets = sets_of(&doc);
    assert_eq!(sets[0].slots[0].image, 1);
    let atlas = moved(&sets[0], &[shift(1.0, 2.0), shift(1.0, 2.0)], &[[16, 16]]);
    let out = round(&doc, &sets[0], &atlas);
    // The image for other readers is nobody's any more.
    assert_eq!(out.json["textures"][0], json!({ "source": 0, "sampler": 0 }));
    assert_eq!((out.images.len(), out.json.get("extensionsUsed")), (1, None));
    assert_eq!(out.images[0].as_ref().unwrap(), &png(3, 1));
}

#[test]
fn a_layout_made_for_a_surface_without_one_is_written_and_read_back() {
    let mut doc = document(&[]);
    let places = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]];
    let positions = attribute(&mut doc, &places);
    let normals = attribute(&mut doc, &[[0.0, 0.0, 1.0]; 4]);
    let p = primitive(&mut doc, &[("POSITION", positions), ("NORMAL", normals)], &[0, 1, 2, 2, 1, 3]);
    mesh(&mut doc, vec![p]);
    let index = MaterialIndex::new(&doc).unwrap();
    let set = read(&doc, &index, ReadOptions::default(), &Context::silent()).unwrap().remove(0);
    assert!(!set.atlas.has_layout() && set.atlas.face_count() == 2);
    // Its two triangles apart.
    let mut atlas = Atlas { sheets: vec![[64, 64]], ..set.atlas.clone() };
    for face in 0..2 {
        let own = set.atlas.triangle(FaceId::new(face));
        atlas.corners[face] = [0, 1, 2].map(|k| UvId::new(3 * face + k));
        atlas.uv.extend(own.map(|p| p.truncate() * 16.0 + DVec2::new(20.0 * face as f64, 0.0) + 4.0));
    }
    let refined = [Refined { set: &set, atlas: &atlas, images: Vec::new() }];
    let out = write(&doc, &index, &refined, &Context::silent()).unwrap();
    let again = read_back(&out, &refined, 0, &Context::silent()).unwrap();
    assert_eq!(crate::atlas::check(&set.atlas, &again, crate::atlas::Exactness::Rounded(1e-4)), Ok(()));
    let attributes = &out.json["meshes"][0]["primitives"][0]["attributes"];
    assert_eq!(attributes.as_object().unwrap().keys().collect::<Vec<_>>(), ["POSITION", "NORMAL", "TEXCOORD_0"]);
    let uvs = attributes["TEXCOORD_0"].as_u64().unwrap() as usize;
    assert!(read_vec2(&out, uvs).unwrap().len() == 6);
}
