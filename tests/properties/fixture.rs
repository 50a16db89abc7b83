//! Small valid models to deal damage to: every part of the format that Intarsia reads, in as few bytes as may be.

use std::io::{Cursor, Write};

use image::RgbImage;
use intarsia::asset::{ARRAY_BUFFER, Document, ELEMENT_ARRAY_BUFFER, File, RawAccessor};
use intarsia::texture::{Coding, Format, JpegCoding, encode};
use serde_json::{Value, json};

pub fn file(path: &str, bytes: impl AsRef<[u8]>) -> File {
    File { path: path.to_owned(), bytes: bytes.as_ref().to_vec() }
}

/// A picture of `side` x `side` texels.
pub fn picture(side: u32, format: Format) -> Vec<u8> {
    let samples = (0..side * side * 3).map(|i| (i * 37 % 251) as u8).collect();
    let image = RgbImage::from_raw(side, side, samples).expect("as many samples");
    let coding = match format {
        Format::Jpeg => Coding::Jpeg(JpegCoding::of_quality(90)),
        Format::Webp => Coding::Webp(None),
        _ => Coding::Png,
    };
    encode(&image.into(), &coding).expect("an image")
}

/// Two charts with base colour (PNG), normal (JPEG), a sparse morph target, a skin, an animation, a strip of the same
/// material, cameras and things that nobody knows of.
pub fn tiny() -> Document {
    let mut doc = Document {
        json: json!({ "asset": { "version": "2.0", "extras": { "a": [1, 2.5] } }, "scene": 0 }),
        buffers: Vec::new(),
        images: Vec::new(),
        name: "tiny".to_owned(),
        merging: Default::default(),
        tile: None,
        undefined: Default::default(),
        origins: Default::default(),
        compressed: None,
    };
    let places = [[0.5, 0.5], [0.25, 0.75], [0.25, 0.25], [0.75, 0.25], [0.75, 0.75]];
    let mut floats = |values: &RawAccessor, bounds| doc.append_accessor(values, Some(ARRAY_BUFFER), bounds);
    let positions = floats(&RawAccessor::from_floats(&places.map(|[x, y]| [x, y, x * y])), true);
    let normals = floats(&RawAccessor::from_floats(&[[0.0, 0.0, 1.0]; 5]), false);
    let tangents = floats(&RawAccessor::from_floats(&[[1.0, 0.0, 0.0, 1.0]; 5]), false);
    let uvs = floats(&RawAccessor::from_floats(&places.map(|[x, y]| [x, 1.0 - y])), false);
    let joints = floats(&RawAccessor::from_floats(&[[0.0_f32; 4]; 5]), false);
    let weights = floats(&RawAccessor::from_floats(&[[1.0, 0.0, 0.0, 0.0]; 5]), false);
    let times = floats(&RawAccessor::from_floats(&[[0.0], [1.0]]), true);
    let moves = floats(&RawAccessor::from_floats(&[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), false);
    doc.json["accessors"][joints]["componentType"] = json!(5123);
    let list = doc.append_accessor(&RawAccessor::from_indices(&[0, 1, 2, 0, 3, 4]), Some(ELEMENT_ARRAY_BUFFER), false);
    let strip = doc.append_accessor(&RawAccessor::from_indices(&[1, 2, 4, 3]), Some(ELEMENT_ARRAY_BUFFER), false);
    let moved = doc.append_buffer_view(&[1, 0, 4, 0], None);
    let by = doc.append_buffer_view(&[0.1_f32; 6].map(f32::to_le_bytes).concat(), None);
    let sparse = json!({
        "count": 2, "indices": { "bufferView": moved, "componentType": 5123 }, "values": { "bufferView": by } });
    let target = doc.push(
        "accessors",
        json!({ "componentType": 5126, "count": 5, "type": "VEC3", "min": [0.0, 0.0, 0.0],
            "max": [0.1, 0.1, 0.1], "sparse": sparse }),
    );
    for (format, media_type) in [(Format::Png, "image/png"), (Format::Jpeg, "image/jpeg")] {
        let bytes = picture(16, format);
        let view = doc.append_buffer_view(&bytes, None);
        doc.push("images", json!({ "bufferView": view, "mimeType": media_type }));
        doc.images.push(Some(bytes));
    }
    doc.json["samplers"] = json!([{ "wrapS": 33648, "minFilter": 9987 }]);
    doc.json["textures"] = json!([{ "source": 0, "sampler": 0 }, { "source": 1 }]);
    doc.json["materials"] = json!([{
        "name": "m", "alphaMode": "MASK", "doubleSided": true,
        "pbrMetallicRoughness": { "baseColorTexture": { "index": 0 }, "baseColorFactor": [1, 1, 1, 1] },
        "normalTexture": { "index": 1, "scale": 0.5 },
        "extensions": { "KHR_materials_unlit": {} },
    }]);
    let attributes = json!({ "POSITION": positions, "NORMAL": normals, "TANGENT": tangents, "TEXCOORD_0": uvs });
    let mut skinned = attributes.clone();
    skinned["JOINTS_0"] = json!(joints);
    skinned["WEIGHTS_0"] = json!(weights);
    doc.json["meshes"] = json!([
        { "weights": [0.5], "primitives": [{ "attributes": skinned, "indices": list, "material": 0, "targets": [{ "POSITION": target }] }] },
        { "primitives": [{ "attributes": attributes, "indices": strip, "material": 0, "mode": 5 }], "extras": "x" },
    ]);
    doc.json["nodes"] =
        json!([{ "children": [1, 2], "name": "root" }, { "mesh": 0, "skin": 0 }, { "mesh": 1, "camera": 0 }]);
    doc.json["skins"] = json!([{ "joints": [0, 2] }]);
    doc.json["cameras"] = json!([{ "type": "perspective", "perspective": { "yfov": 1, "znear": 0.1 } }]);
    doc.json["scenes"] = json!([{ "nodes": [0] }]);
    doc.json["animations"] = json!([{
        "samplers": [{ "input": times, "output": moves }],
        "channels": [{ "sampler": 0, "target": { "node": 0, "path": "translation" } }],
    }]);
    doc.json["extensionsUsed"] = json!(["KHR_materials_unlit"]);
    doc
}

/// A GLB of a JSON text and a binary chunk.
pub fn glb(json: &[u8], bin: &[u8]) -> Vec<u8> {
    let mut json = json.to_vec();
    json.resize(json.len().next_multiple_of(4), b' ');
    let mut bin = bin.to_vec();
    bin.resize(bin.len().next_multiple_of(4), 0);
    let mut out = b"glTF\x02\0\0\0".to_vec();
    let chunks = [(json, b"JSON"), (bin, b"BIN\0")];
    let length = 12 + chunks.iter().map(|(bytes, _)| 8 + bytes.len()).sum::<usize>();
    out.extend((length as u32).to_le_bytes());
    for (bytes, kind) in chunks {
        out.extend((bytes.len() as u32).to_le_bytes());
        out.extend(kind);
        out.extend(bytes);
    }
    out
}

/// The JSON and the binary chunk of a GLB that is in order.
pub fn parts(glb: &[u8]) -> (Value, Vec<u8>) {
    let word = |at: usize| u32::from_le_bytes(glb[at..at + 4].try_into().expect("four bytes")) as usize;
    let end = 20 + word(12);
    (serde_json::from_slice(&glb[20..end]).expect("JSON"), glb.get(end + 8..).unwrap_or_default().to_vec())
}

/// Polygons, negative and partial indices, two materials, continued lines, comments.
pub const OBJ: &str = "# a small model\nmtllib all of it.mtl\no thing\nv 0 0 0\nv 1 0 0 1 0 0\nv 1 1 0\nv 0 1 0\nv .5 2e0 +0\n\
v 0 0 1\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1 0\nvn 0 0 1\nvn 0 1 0\ng a b\ns 1\nusemtl first one\nf 1/1/1 2/2/1 3/3/1 4/4/1\n\
f -3/-2/1 \\\n  -4/-3/1 -2/-1/1\nusemtl second\nf 1//2 2//2 6//2\nf 1 5 6\nf 1/1 2/2 3/3 5/4 4/1\nl 1 2\np 1\n";

/// Maps with options, numbers of every kind.
pub const MTL: &str = "newmtl first one\nKd 1 0.5 0.25\nKe 0 0 1\nd 0.5\nPr 0.5\nPm 1\nmap_Kd -clamp on -s 1 1 1 a b.png\n\
norm n.png\nmap_Ke -o 0.5 0 a b.png\nnewmtl second\nKd .5\nmap_Kd \"n.png\"\nmap_d a b.png\nbump -bm 0.5 n.png\nmap_Ka -mm 0 1 x.png\n";

/// The OBJ model with its files.
pub fn obj() -> Vec<File> {
    let maps = [file("a b.png", picture(16, Format::Png)), file("n.png", picture(8, Format::Png))];
    [file("model.obj", OBJ), file("all of it.mtl", MTL)].into_iter().chain(maps).collect()
}

/// A zip of files.
pub fn zip(files: &[File]) -> Vec<u8> {
    let mut writer = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for file in files {
        writer.start_file(file.path.as_str(), zip::write::SimpleFileOptions::default()).expect("an entry");
        writer.write_all(&file.bytes).expect("its bytes");
    }
    writer.finish().expect("a zip").into_inner()
}
