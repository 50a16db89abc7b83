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
    assert_eq!(primitives.iter().map(|p| p["material"].as_u64().unwrap()).collect::<Vec<_>>(), [0, 1, 2]);
    assert_eq!(indices(&doc, 0).len(), 6);
    assert_eq!(read_vec3(&doc, attribute(&doc, 0, "NORMAL")).unwrap()[0], [0.0, 0.0, 1.0]);
    let materials = &doc.json["materials"];
    assert_eq!(materials[0]["pbrMetallicRoughness"]["baseColorFactor"], serde_json::Value::Null);
    assert_eq!(materials[1]["pbrMetallicRoughness"]["baseColorFactor"], serde_json::json!([0.5, 0.5, 0.5, 0.5]));
    assert_eq!(materials[1]["alphaMode"], "BLEND");
    assert_eq!(doc.json["images"][0]["uri"], "my%20tex.png");
    assert_eq!(doc.images, [Some(b"PNG".to_vec()), None]);
    let codes: Vec<&str> = warnings.iter().map(|w| w.code.as_str()).collect();
    assert_eq!(codes, ["missing_image", "material_map_dropped", "missing_material", "vertex_colors_dropped"]);
    assert_eq!(warnings[0].pointer.as_deref(), Some("/images/1"));
    assert!(doc.json["meshes"][0]["primitives"][1]["attributes"].get("COLOR_0").is_some());
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
        ("v 0 0 0\nf 1/1 1 1\n", "line 2"),
        ("v 0 0 0\nf 1/1/1/1 1 1\n", "line 2"),
        ("v 0 0\n", "line 1"),
        ("v 0 0 nan\n", "line 1"),
        ("v 0 0 0\n\nv 1e39 0 0\n", "line 3"),
        ("v 0 0 0\nvt inf 0\n", "line 2"),
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
