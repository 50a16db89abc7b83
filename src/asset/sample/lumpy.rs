//! The samples made from a lumpy ball.

use glam::{DVec2, DVec3};
use serde_json::json;

use super::paint::{bumps, glow, marble, orm, paint};
use super::random::Random;
use super::scene::Scene;
use super::surface::{Unwrapped, lumpy_ball, regions, unwrap};
use crate::asset::{ARRAY_BUFFER, ComponentType, Kind};

const BACKGROUND: [u8; 3] = [40, 40, 44];

/// The whole ball as one shape of `charts` charts.
fn ball(squares: i32, charts: usize, slack: f64, seed: u64) -> Unwrapped {
    let surface = lumpy_ball(squares, false);
    let mut random = Random(seed);
    let region = regions(&surface, surface.triangles.len(), charts, &mut random);
    let faces: Vec<usize> = (0..surface.triangles.len()).collect();
    unwrap(&surface, &faces, &region, slack, &mut random)
}

/// Every slot of the core material, the packed one at half size, and tangents.
pub(crate) fn textured() -> Scene {
    let shape = ball(18, 24, 0.1, 1);
    let mut scene = Scene::new("textured");
    let shapes = [&shape];
    let base = scene.texture("base_color", paint(&shapes, [1024; 2], BACKGROUND, |p| marble(p.position)));
    let packed = scene.texture("orm", paint(&shapes, [512; 2], [255, 128, 0], |p| orm(p.position)));
    let normal = scene.texture("normal", paint(&shapes, [1024; 2], [128, 128, 255], bumps));
    let emissive = scene.texture("emissive", paint(&shapes, [1024; 2], [0; 3], |p| glow(p.position)));
    let material = scene.push(
        "materials",
        json!({
            "name": "lumpy",
            "pbrMetallicRoughness": {
                "baseColorTexture": { "index": base },
                "metallicRoughnessTexture": { "index": packed },
            },
            "normalTexture": { "index": normal },
            "occlusionTexture": { "index": packed, "strength": 0.8 },
            "emissiveTexture": { "index": emissive },
            "emissiveFactor": [1, 1, 1],
        }),
    );
    let primitive = scene.primitive(&shape, material, true, true);
    scene.mesh("lumpy", vec![primitive])
}

/// Many small charts, as scans have.
pub(crate) fn fragmented() -> Scene {
    let shape = ball(30, 500, 0.15, 2);
    let mut scene = Scene::new("fragmented");
    let base = scene.texture("base_color", paint(&[&shape], [2048; 2], BACKGROUND, |p| marble(p.position)));
    let material = scene.material("scan", base);
    let primitive = scene.primitive(&shape, material, false, false);
    scene.mesh("scan", vec![primitive])
}

/// The half at negative x reads the texels of the other, and one chart of each lies over its neighbour by accident.
pub(crate) fn overlapping() -> Scene {
    let surface = lumpy_ball(16, true);
    let half = surface.triangles.len() / 2;
    let mut random = Random(3);
    let region = regions(&surface, half, 12, &mut random);
    let faces: Vec<usize> = (0..half).collect();
    let mut shape = unwrap(&surface, &faces, &region, 0.1, &mut random);
    let shift = centre(&shape, 1) - centre(&shape, 0);
    let vertices = shape.uvs.len();
    for vertex in (0..vertices).filter(|v| shape.chart[*v] == 0) {
        shape.uvs[vertex] += shift * 0.7;
    }
    let mut scene = Scene::new("overlapping");
    let base = scene.texture("base_color", paint(&[&shape], [1024; 2], BACKGROUND, |p| marble(p.position)));
    let material = scene.material("mirrored", base);
    let flip = DVec3::new(-1.0, 1.0, 1.0);
    let mut whole = shape.clone();
    whole.positions.extend(shape.positions.iter().map(|p| *p * flip));
    whole.normals.extend(shape.normals.iter().map(|n| *n * flip));
    whole.uvs.extend(&shape.uvs);
    whole.triangles.extend(shape.triangles.iter().map(|[a, b, c]| [c + vertices, b + vertices, a + vertices]));
    let primitive = scene.primitive(&whole, material, true, false);
    scene.mesh("mirrored", vec![primitive])
}

fn centre(shape: &Unwrapped, chart: usize) -> DVec2 {
    let own: Vec<DVec2> = shape.chart.iter().zip(&shape.uvs).filter(|(c, _)| **c == chart).map(|(_, uv)| *uv).collect();
    own.iter().sum::<DVec2>() / own.len().max(1) as f64
}

/// Charts in other tiles, to both sides.
pub(crate) fn tiled() -> Scene {
    let mut shape = ball(12, 12, 0.1, 4);
    let mut scene = Scene::new("tiled");
    let base = scene.texture("base_color", paint(&[&shape], [512; 2], BACKGROUND, |p| marble(p.position)));
    let material = scene.material("tiled", base);
    for (chart, uv) in shape.chart.iter().zip(&mut shape.uvs) {
        *uv += DVec2::new((chart % 3) as f64 - 1.0, (chart % 4) as f64 - 2.0);
    }
    let primitive = scene.primitive(&shape, material, true, false);
    scene.mesh("tiled", vec![primitive])
}

/// 16-bit positions, 8-bit normals and 16-bit UVs, interleaved in one buffer view.
pub(crate) fn quantized() -> Scene {
    const SCALE: f64 = 1.5;
    let shape = ball(12, 10, 0.1, 5);
    let mut scene = Scene::new("quantized");
    let base = scene.texture("base_color", paint(&[&shape], [512; 2], BACKGROUND, |p| marble(p.position)));
    let material = scene.material("quantized", base);
    let mut data = Vec::new();
    let mut low = [i16::MAX; 3];
    let mut high = [i16::MIN; 3];
    for ((position, normal), uv) in shape.positions.iter().zip(&shape.normals).zip(&shape.uvs) {
        let place = (*position / SCALE * 32767.0).round().to_array().map(|v| v as i16);
        low = [0, 1, 2].map(|k| low[k].min(place[k]));
        high = [0, 1, 2].map(|k| high[k].max(place[k]));
        data.extend(place.iter().chain(&[0]).flat_map(|v| v.to_le_bytes()));
        data.extend((*normal * 127.0).round().to_array().iter().chain(&[0.0]).map(|v| *v as i8 as u8));
        data.extend((*uv * 65535.0).round().to_array().iter().flat_map(|v| (*v as u16).to_le_bytes()));
    }
    let view = scene.document.append_buffer_view(&data, Some(ARRAY_BUFFER));
    scene.document.json["bufferViews"][view]["byteStride"] = json!(16);
    let mut accessor = |offset: usize, component: ComponentType, kind: Kind| {
        scene.push(
            "accessors",
            json!({
                "bufferView": view, "byteOffset": offset, "componentType": component, "normalized": true,
                "count": shape.positions.len(), "type": kind,
            }),
        )
    };
    let position = accessor(0, ComponentType::I16, Kind::Vec3);
    let normal = accessor(8, ComponentType::I8, Kind::Vec3);
    let uv = accessor(12, ComponentType::U16, Kind::Vec2);
    scene.document.json["accessors"][position]["min"] = json!(low);
    scene.document.json["accessors"][position]["max"] = json!(high);
    let indices = scene.indices(shape.triangles.as_flattened());
    let attributes = json!({ "POSITION": position, "NORMAL": normal, "TEXCOORD_0": uv });
    let primitive = json!({ "attributes": attributes, "indices": indices, "material": material });
    let mesh = scene.push("meshes", json!({ "name": "quantized", "primitives": [primitive] }));
    scene.root(json!({ "name": "quantized", "mesh": mesh, "scale": [SCALE, SCALE, SCALE] }));
    for key in ["extensionsUsed", "extensionsRequired"] {
        scene.document.json[key] = json!(["KHR_mesh_quantization"]);
    }
    scene
}

/// Two halves on textures of their own, of different sizes, and a foot without UVs.
pub(crate) fn two_materials() -> Scene {
    let surface = lumpy_ball(14, false);
    let mut random = Random(6);
    let region = regions(&surface, surface.triangles.len(), 14, &mut random);
    let mut scene = Scene::new("two_materials");
    let mut primitives = Vec::new();
    for (half, (name, size)) in [("left", [512, 512]), ("right", [256, 512])].into_iter().enumerate() {
        let faces: Vec<usize> = (0..region.len()).filter(|f| region[*f] % 2 == half).collect();
        let shape = unwrap(&surface, &faces, &region, 0.1, &mut random);
        let tint = 1.0 + half as f64;
        let base = scene.texture(name, paint(&[&shape], size, BACKGROUND, |p| marble(p.position * tint)));
        let material = scene.material(name, base);
        primitives.push(scene.primitive(&shape, material, true, false));
    }
    let plain = scene.push("materials", json!({ "name": "foot", "pbrMetallicRoughness": { "metallicFactor": 0.0 } }));
    let corners = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]].map(|[x, z]: [f64; 2]| DVec3::new(x, -1.5, z));
    let attributes = json!({ "POSITION": scene.positions(&corners), "NORMAL": scene.attribute(&[[0.0, 1.0, 0.0]; 4]) });
    let indices = scene.indices(&[0, 2, 1, 0, 3, 2]);
    primitives.push(json!({ "attributes": attributes, "indices": indices, "material": plain }));
    scene.mesh("two_materials", primitives)
}
