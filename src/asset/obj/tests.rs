//! OBJ files as programs and people write them.

use proptest::prelude::*;

use crate::asset::{Document, File, Limits, load, read_indices, read_vec2, read_vec3};
use crate::error::{Code, Result, Warning};

fn file(path: &str, text: impl AsRef<[u8]>) -> File {
    File { path: path.to_owned(), bytes: text.as_ref().to_vec() }
}

fn read(obj: &str) -> Result<(Document, Vec<Warning>)> {
    load(&[file("m.obj", obj)], None, &Limits::default())
}

fn attribute(doc: &Document, primitive: usize, name: &str) -> usize {
    doc.json["meshes"][0]["primitives"][primitive]["attributes"][name].as_u64().unwrap() as usize
}

fn indices(doc: &Document, primitive: usize) -> Vec<u32> {
    read_indices(doc, doc.json["meshes"][0]["primitives"][primitive]["indices"].as_u64().unwrap() as usize).unwrap()
}

#[test]
fn corners_become_unique_vertices_in_order_of_first_use() {
    let (doc, warnings) = read(
        "v 0 0 0\r\nv 1 0 0\r\nv 1 1 0\r\nv 0 1 0\r\nvt 0 0\r\nvt 1 0\r\nvt 1 0.25\r\nvt 0 1\r\n\
         f 3/3 4/4 1/1\r\nf -4/-4 -3/-3 \\\r\n -2/-2\r\n",
    )
    .unwrap();
    assert!(warnings.is_empty(), "{warnings:?}");
    assert_eq!(indices(&doc, 0), [0, 1, 2, 2, 3, 0]);
    let positions = read_vec3(&doc, attribute(&doc, 0, "POSITION")).unwrap();
    assert_eq!(positions, [[1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]);
    let uvs = read_vec2(&doc, attribute(&doc, 0, "TEXCOORD_0")).unwrap();
    assert_eq!(uvs, [[1.0, 0.75], [0.0, 0.0], [0.0, 1.0], [1.0, 1.0]]);
    assert_eq!(doc.json["accessors"][attribute(&doc, 0, "POSITION")]["max"], serde_json::json!([1.0, 1.0, 0.0]));
}

#[test]
fn materials_make_primitives_and_maps_make_textures() {
    let mtl =
        "newmtl b\nKd .6 .6 .6\nmap_Kd my tex.png\nnorm n.png\nmap_Bump h.png\nnewmtl a\nKd .5 .5 .5\nd 0.5\nPr 0.25\n";
    let obj = "mtllib my lib.mtl\nv 0 0 0 1 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 2\nusemtl b\nf 1//1 2//1 3//1\nusemtl a\n\
               f 1 2 3\nusemtl b\nf 3//1 2//1 1//1\nusemtl none\nf 1 2 3\n";
    let files = [file("x/m.obj", obj), file("x/my lib.mtl", mtl), file("x/my tex.png", "PNG")];
    let (doc, warnings) = load(&files, None, &Limits::default()).unwrap();
    let primitives = doc.json["meshes"][0]["primitives"].as_array().unwrap();
    // Without texture coordinates a copy without textures stands for the first.
    assert_eq!(primitives.iter().map(|p| p["material"].as_u64().unwrap()).collect::<Vec<_>>(), [3, 1, 2]);
    assert_eq!(indices(&doc, 0).len(), 6);
    assert_eq!(read_vec3(&doc, attribute(&doc, 0, "NORMAL")).unwrap()[0], [0.0, 0.0, 1.0]);
    let materials = &doc.json["materials"];
    assert_eq!(materials[0]["pbrMetallicRoughness"]["baseColorFactor"], serde_json::Value::Null);
    assert_eq!(materials[1]["pbrMetallicRoughness"]["baseColorFactor"], serde_json::json!([0.5, 0.5, 0.5, 0.5]));
    assert_eq!(materials[1]["alphaMode"], "BLEND");
    assert_eq!(doc.json["images"][0]["uri"], "my%20tex.png");
    assert_eq!(doc.images, [Some(b"PNG".to_vec()), None]);
    let codes: Vec<&str> = warnings.iter().map(|w| w.code.as_str()).collect();
    assert_eq!(codes, ["missing_image", "material_map_dropped", "missing_material"]);
    assert_eq!(warnings[0].pointer.as_deref(), Some("/images/1"));
    for primitive in 0..2 {
        assert!(doc.json["meshes"][0]["primitives"][primitive]["attributes"].get("COLOR_0").is_some(), "{primitive}");
    }
    // Beside a colour map that is seen, vertex colours are not.
    let mapped = obj.replace("vn 0 0 2", "vt 0 0\nvn 0 0 2").replace("//", "/1/");
    let files = [file("x/m.obj", mapped), file("x/my lib.mtl", mtl), file("x/my tex.png", "PNG")];
    let (doc, warnings) = load(&files, None, &Limits::default()).unwrap();
    assert_eq!(warnings.last().map(|w| w.code.as_str()), Some("vertex_colors_dropped"));
    assert!(doc.json["meshes"][0]["primitives"][0]["attributes"].get("COLOR_0").is_none());
}

#[test]
fn polygons_missing_parts_and_thin_faces() {
    let (doc, warnings) =
        read("v 0 0 0\nv 2 1 0\nv 0 2 0\nv 1 1 0\nvt 0 0\nf 1 2 3 4\nf 1/1 2/1 3/1\nf 1/1 2 3\nf 1 2\nl 1 2\n")
            .unwrap();
    let primitives = doc.json["meshes"][0]["primitives"].as_array().unwrap();
    assert_eq!(primitives.len(), 2);
    assert!(primitives[0]["attributes"].get("TEXCOORD_0").is_none());
    assert_eq!((indices(&doc, 0).len(), indices(&doc, 1).len()), (9, 3));
    assert_eq!(indices(&doc, 0)[..6], [3, 0, 1, 1, 2, 3], "the concave corner is not fanned over");
    let codes: Vec<&str> = warnings.iter().map(|w| w.code.as_str()).collect();
    assert_eq!(codes, ["degenerate_faces_dropped", "obj_elements_dropped"]);
}

#[test]
fn bad_lines_are_named() {
    for (obj, line) in [
        ("v 0 0 0\nf 1 2 3\n", "line 2"),
        ("v 0 0 0\nf 0 1 1\n", "line 2"),
        ("v 0 0 0\nf -2 1 1\n", "line 2"),
        ("v 0 0 0\nvt 0 0\nf 1/2 1 1\n", "line 3"),
        ("v 0 0 0\nf 1/1/1/1 1 1\n", "line 2"),
        ("v 0 0\n", "line 1"),
        ("v 0 0 0\nvn 0 x 0\n", "line 2"),
        ("v 0 0 0\nf 1 1 99999999999999999999\n", "line 2"),
        ("v 0 0 0\nf 1 1 4294967296\n", "line 2"),
    ] {
        let failure = read(obj).unwrap_err();
        assert_eq!(failure.code, Code::InvalidModel, "{obj}");
        assert!(failure.message.contains(line), "{obj}: {failure}");
    }
    let few = Limits { max_triangles: 3, ..Limits::default() };
    let failure = load(&[file("m.obj", "v 0 0 0\nf 1 1 1\nf 1 1 1 1 1\n")], None, &few).unwrap_err();
    assert_eq!(failure.code, Code::TooLarge);
}

#[test]
fn numbers_that_are_not_finite_hold_back_their_faces_alone() {
    let mtl = "newmtl a\nmap_Kd t.png\n";
    for (bad, uv) in [("nan", "-nan(ind)"), ("1e39", "1.#QNAN"), ("-1.#IND00", "inf")] {
        let obj = format!(
            "mtllib a.mtl\nusemtl a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv {bad} 0 0\nvt 0 0\nvt 1 0\nvt 0 1\nvt {uv} 0\n\
             f 1/1 2/2 3/3\nf 1/1 2/2 4/3\nf 3/3 2/2 1/4\n"
        );
        let files = [file("m.obj", obj), file("a.mtl", mtl), file("t.png", "PNG")];
        let (doc, warnings) = load(&files, None, &Limits::default()).unwrap();
        let messages: Vec<&str> = warnings.iter().map(|w| w.message.as_str()).collect();
        assert!(warnings.iter().all(|w| w.code == "non_finite_triangles"), "{messages:?}");
        assert!(messages[0].contains("line 12") && messages[1].contains("line 13"), "{messages:?}");
        let primitives = doc.json["meshes"][0]["primitives"].as_array().unwrap();
        assert_eq!((primitives.len(), indices(&doc, 0).len(), indices(&doc, 1).len()), (2, 3, 3));
        assert!(primitives[1]["attributes"].get("TEXCOORD_0").is_none());
        let numbers = read_vec3(&doc, attribute(&doc, 1, "POSITION")).unwrap();
        assert!(numbers.iter().flatten().all(|x| x.is_finite()));
    }
}

#[test]
fn normals_without_direction_are_replaced() {
    let (doc, warnings) =
        read("v 0 0 0\nv 1 0 0\nv 0 1 0\nvn nan nan nan\nvn 0 0 0\nvn 0 3 4\nf 1//1 2//2 3//3\n").unwrap();
    let normals = read_vec3(&doc, attribute(&doc, 0, "NORMAL")).unwrap();
    assert_eq!(normals, [[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.6, 0.8]]);
    assert_eq!(warnings.iter().map(|w| w.code.as_str()).collect::<Vec<_>>(), ["invalid_normals_replaced"]);
    assert!(warnings[0].message.starts_with("2 "));
}

#[test]
fn a_later_vertex_may_be_named_and_no_faces_is_no_crash() {
    let (doc, _) = read("f 1 2 3\nv 0 0 0\nv 1 0 0\nv 0 1 0\n").unwrap();
    assert_eq!(indices(&doc, 0), [0, 1, 2]);
    let (doc, _) = read("v 0 0 0\n").unwrap();
    assert!(doc.json.get("meshes").is_none());
}

proptest! {
    #[test]
    fn any_bytes_are_answered(lines in proptest::collection::vec("(v|vt|vn|f|usemtl|mtllib|o|l|) [-0-9./e a\\\\\r]{0,12}", 0..20)) {
        let failure = read(&lines.join("\n")).err();
        prop_assert!(failure.as_ref().is_none_or(|f| f.code != Code::Internal), "{:?}", failure);
    }

    #[test]
    fn mutations_are_answered(at in 0_usize..120, byte: u8, end in 0_usize..120) {
        let mut bytes = b"mtllib a.mtl\nusemtl a\nv 0 0 0\nv 1.5 0 0\nv 1 1 0\nv 0 1e1 0\nvt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3/1/1 4/1/1\nf 1 2 3\n".to_vec();
        if let Some(slot) = bytes.get_mut(at) {
            *slot = byte;
        }
        bytes.truncate(end);
        let failure = load(&[file("m.obj", &bytes), file("a.mtl", &bytes)], None, &Limits::default()).err();
        prop_assert!(failure.as_ref().is_none_or(|f| f.code != Code::Internal), "{:?}", failure);
    }
}

#[test]
fn names_of_libraries_have_quotes_and_blanks_and_stand_beside_each_other() {
    let mtl = |name: &str| format!("newmtl {name}\nKd 0.25 0.5 1\n");
    let of = |line: &str| {
        let faces = "v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl red\nf 1 2 3\nusemtl blue\nf 1 3 2\n";
        let files =
            [file("m.obj", format!("{line}\n{faces}")), file("box red.mtl", mtl("red")), file("b.mtl", mtl("blue"))];
        let (doc, warnings) = load(&files, None, &Limits::default()).unwrap();
        let named = doc.json["materials"].as_array().unwrap().iter();
        let colored = named.filter(|m| m["pbrMetallicRoughness"].get("baseColorFactor").is_some()).count();
        (colored, warnings.into_iter().map(|w| w.message).collect::<Vec<_>>())
    };
    let none: Vec<String> = Vec::new();
    assert_eq!(of("mtllib box red.mtl b.mtl"), (2, none.clone()));
    assert_eq!(of("mtllib b.mtl box red.mtl"), (2, none.clone()));
    assert_eq!(of("mtllib \"box red.mtl\"\nmtllib b.mtl"), (2, none.clone()));
    assert_eq!(of("mtllib \"box red.mtl\" \"b.mtl\""), (2, none));
    let (colored, messages) = of("mtllib my own.mtl b.mtl other");
    assert_eq!(colored, 1);
    for name in ["\"my own.mtl\"", "\"other\""] {
        assert!(messages.iter().any(|m| m.contains(name) && m.contains("not uploaded")), "{messages:?}");
    }
}

#[test]
fn options_of_maps_are_a_texture_transform() {
    let mtl = "newmtl a\nmap_Kd -s 4 2 1 -o 0.25 0.5 t.png\nnorm -bm 0.5 n.png\n";
    let obj = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl a\nf 1/1 2/2 3/3\n";
    let files = [file("m.obj", obj), file("a.mtl", mtl), file("t.png", "PNG"), file("n.png", "PNG")];
    let (doc, warnings) = load(&files, None, &Limits::default()).unwrap();
    assert!(warnings.is_empty(), "{warnings:?}");
    let material = &doc.json["materials"][0];
    let transform = &material["pbrMetallicRoughness"]["baseColorTexture"]["extensions"]["KHR_texture_transform"];
    // v points down: 1 - (2 v + 0.5) of the file's v.
    assert_eq!(*transform, serde_json::json!({ "offset": [0.25, -1.5], "scale": [4.0, 2.0] }));
    assert_eq!(doc.json["extensionsUsed"], serde_json::json!(["KHR_texture_transform"]));
    assert_eq!(material["normalTexture"]["scale"], 0.5);
    assert!(material["normalTexture"].get("extensions").is_none());
}

#[test]
fn faces_without_texture_coordinates_are_kept_without_any() {
    let mtl = "newmtl a\nmap_Kd t.png\nmap_Ke t.png\n";
    let faces = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl a\nf 1/1 2/2 3/3\nf 1 3 2\n";
    let files = [file("m.obj", format!("mtllib a.mtl\n{faces}")), file("a.mtl", mtl), file("t.png", "PNG")];
    let (doc, _) = load(&files, None, &Limits::default()).unwrap();
    let primitives = doc.json["meshes"][0]["primitives"].as_array().unwrap();
    assert_eq!(primitives.len(), 2);
    let plain = &doc.json["materials"][primitives[1]["material"].as_u64().unwrap() as usize];
    assert!(primitives[1]["attributes"].get("TEXCOORD_0").is_none());
    assert!(plain.get("emissiveTexture").is_none() && plain.get("emissiveFactor").is_none(), "{plain}");
    assert!(plain["pbrMetallicRoughness"].get("baseColorTexture").is_none(), "{plain}");

    let (doc, warnings) = read("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/1 2/2 3/3\n").unwrap();
    assert_eq!(warnings.iter().map(|w| w.code.as_str()).collect::<Vec<_>>(), ["missing_texture_coordinates"]);
    assert!(doc.json["meshes"][0]["primitives"][0]["attributes"].get("TEXCOORD_0").is_none());
}

#[test]
fn what_lies_far_from_the_origin_keeps_its_shape() {
    let obj = "v 399999.98 5500000.01 120.5\nv 400000.02 5500000.01 120.5\nv 399999.98 5500000.05 120.54\nf 1 2 3\n";
    let (doc, warnings) = read(obj).unwrap();
    assert_eq!(warnings.iter().map(|w| w.code.as_str()).collect::<Vec<_>>(), ["recentred"]);
    let p = read_vec3(&doc, attribute(&doc, 0, "POSITION")).unwrap();
    let node = &doc.json["nodes"][0];
    assert_eq!(node["translation"], serde_json::json!([400000.0, 5500000.0, 121.0]));
    assert_eq!(node["extras"]["origin"], node["translation"]);
    assert!((p[1][0] - p[0][0] - 0.04).abs() < 1e-6 && (p[2][2] - p[0][2] - 0.04).abs() < 1e-6, "{p:?}");
    // What is large as well as far away stays as it is.
    let (doc, warnings) = read("v 5000 0 0\nv 9000 0 0\nv 5000 4000 0\nf 1 2 3\n").unwrap();
    assert!(warnings.is_empty() && doc.json["nodes"][0].get("translation").is_none());
}
