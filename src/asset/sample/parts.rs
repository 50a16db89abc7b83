//! The samples with skins, morph targets, strips and fans.

use std::f64::consts::TAU;

use glam::{DVec2, DVec3};
use serde_json::json;

use super::paint::{marble, paint};
use super::scene::{Scene, floats2, floats3};
use super::surface::Unwrapped;
use crate::asset::{ARRAY_BUFFER, ComponentType, Kind, RawAccessor};

const BACKGROUND: [u8; 3] = [40, 40, 44];

/// A grid of `columns` x `rows` squares: positions and normals by fractions in 0..1, UVs in a rectangle.
fn grid(columns: usize, rows: usize, low: DVec2, high: DVec2, point: impl Fn(f64, f64) -> (DVec3, DVec3)) -> Unwrapped {
    let mut shape = Unwrapped::default();
    for (j, i) in (0..=rows).flat_map(|j| (0..=columns).map(move |i| (j, i))) {
        let at = DVec2::new(i as f64 / columns as f64, j as f64 / rows as f64);
        let (position, normal) = point(at.x, at.y);
        shape.positions.push(position);
        shape.normals.push(normal);
        shape.tangents.push((normal.any_orthonormal_vector(), 1.0));
        shape.uvs.push(low + (high - low) * at);
    }
    for (j, i) in (0..rows).flat_map(|j| (0..columns).map(move |i| (j, i))) {
        let a = j * (columns + 1) + i;
        let c = a + columns + 1;
        shape.triangles.extend([[a, c, a + 1], [a + 1, c, c + 1]]);
    }
    shape
}

/// A tube that bends: two primitives on one material, three joints, a morph target that swells it, and an animation.
pub(crate) fn skinned() -> Scene {
    let part = |from: f64, low: DVec2, high: DVec2| {
        grid(24, 16, low, high, move |around, down| {
            let (s, c) = (around * TAU).sin_cos();
            let height = from - down;
            // From outside, u runs to the right and v down.
            (DVec3::new(0.35 * s, height, 0.35 * c), DVec3::new(s, 0.0, c))
        })
    };
    let shapes = [
        part(2.0, DVec2::new(0.05, 0.05), DVec2::new(0.6, 0.35)),
        part(1.0, DVec2::new(0.3, 0.55), DVec2::new(0.85, 0.85)),
    ];
    let mut scene = Scene::new("skinned");
    let base =
        scene.texture("base_color", paint(&[&shapes[0], &shapes[1]], [512; 2], BACKGROUND, |p| marble(p.position)));
    let material = scene.material("tube", base);
    let mut primitives = Vec::new();
    for shape in &shapes {
        let mut primitive = scene.primitive(shape, material, true, false);
        let joints: Vec<u8> = shape
            .positions
            .iter()
            .flat_map(|p| [p.y.floor().clamp(0.0, 1.0) as u8, p.y.floor().clamp(0.0, 1.0) as u8 + 1, 0, 0])
            .collect();
        let weights: Vec<[f32; 4]> = shape
            .positions
            .iter()
            .map(|p| {
                let upper = (p.y - p.y.floor().clamp(0.0, 1.0)).clamp(0.0, 1.0) as f32;
                [1.0 - upper, upper, 0.0, 0.0]
            })
            .collect();
        // A weight of zero names joint 0.
        let joints = joints
            .chunks(4)
            .zip(&weights)
            .flat_map(|(j, w)| [0, 1, 2, 3].map(|k| if w[k] == 0.0 { 0 } else { j[k] }))
            .collect();
        let joints = RawAccessor::new(ComponentType::U8, Kind::Vec4, false, joints);
        primitive["attributes"]["JOINTS_0"] = json!(scene.document.append_accessor(&joints, Some(ARRAY_BUFFER), false));
        primitive["attributes"]["WEIGHTS_0"] = json!(scene.attribute(&weights));
        let swell: Vec<DVec3> =
            shape.positions.iter().zip(&shape.normals).map(|(p, n)| *n * 0.2 * (p.y * 3.0).sin().abs()).collect();
        let target = scene.positions(&swell);
        primitive["targets"] = json!([{ "POSITION": target }]);
        primitives.push(primitive);
    }
    let mesh = scene.push("meshes", json!({ "name": "tube", "primitives": primitives, "weights": [0.0] }));
    animate(&mut scene, mesh);
    scene
}

fn animate(scene: &mut Scene, mesh: usize) {
    let tip = scene.push("nodes", json!({ "name": "tip", "translation": [0, 1, 0] }));
    let middle = scene.push("nodes", json!({ "name": "middle", "translation": [0, 1, 0], "children": [tip] }));
    let root = scene.root(json!({ "name": "root", "children": [middle] }));
    let mut inverse = Vec::new();
    for height in [0.0_f32, 1.0, 2.0] {
        let mut matrix = [0.0_f32; 16];
        for k in 0..4 {
            matrix[k * 5] = 1.0;
        }
        matrix[13] = -height;
        inverse.extend(matrix.iter().flat_map(|v| v.to_le_bytes()));
    }
    let view = scene.document.append_buffer_view(&inverse, None);
    let inverse =
        scene.push("accessors", json!({ "bufferView": view, "componentType": 5126, "count": 3, "type": "MAT4" }));
    let skin = scene.push("skins", json!({ "joints": [root, middle, tip], "inverseBindMatrices": inverse }));
    let node = scene.root(json!({ "name": "tube", "mesh": mesh, "skin": skin }));
    let times = RawAccessor::from_floats(&[[0.0_f32], [1.0], [2.0]]);
    let times = scene.document.append_accessor(&times, None, true);
    let half = std::f32::consts::FRAC_1_SQRT_2;
    let turns = RawAccessor::from_floats(&[[0.0, 0.0, 0.0, 1.0], [half, 0.0, 0.0, half], [0.0, 0.0, 0.0, 1.0]]);
    let turns = scene.document.append_accessor(&turns, None, false);
    let swells = RawAccessor::from_floats(&[[0.0_f32], [1.0], [0.0]]);
    let swells = scene.document.append_accessor(&swells, None, false);
    scene.push(
        "animations",
        json!({
            "name": "bend",
            "samplers": [{ "input": times, "output": turns }, { "input": times, "output": swells }],
            "channels": [
                { "sampler": 0, "target": { "node": middle, "path": "rotation" } },
                { "sampler": 1, "target": { "node": node, "path": "weights" } },
            ],
        }),
    );
}

/// A strip whose heights come from a sparse accessor, and a fan without indices.
pub(crate) fn strips() -> Scene {
    let flat = grid(12, 12, DVec2::new(0.05, 0.05), DVec2::new(0.55, 0.55), |x, z| {
        (DVec3::new(x * 2.0 - 1.0, 0.0, z * 2.0 - 1.0), DVec3::Y)
    });
    let disc = disc(DVec2::new(0.75, 0.75), 0.2);
    let mut scene = Scene::new("strips");
    let base = scene.texture("base_color", paint(&[&flat, &disc], [512; 2], BACKGROUND, |p| marble(p.position)));
    let material = scene.material("ribbon", base);
    let position = sparse_heights(&mut scene, &flat);
    let uv = scene.attribute(&floats2(&flat.uvs));
    // Rows one after the other, joined by triangles without area.
    let mut strip = Vec::new();
    for row in 0..12 {
        if row > 0 {
            strip.extend([row * 13 + 12, row * 13]);
        }
        strip.extend((0..13).flat_map(|i| [row * 13 + i, row * 13 + i + 13]));
    }
    let indices = scene.indices(&strip);
    let attributes = json!({ "POSITION": position, "TEXCOORD_0": uv });
    let ribbon = json!({ "attributes": attributes, "indices": indices, "material": material, "mode": 5 });
    let attributes = json!({
        "POSITION": scene.positions(&disc.positions),
        "NORMAL": scene.attribute(&floats3(&disc.normals)),
        "TEXCOORD_0": scene.attribute(&floats2(&disc.uvs)),
    });
    let fan = json!({ "attributes": attributes, "material": material, "mode": 6 });
    scene.mesh("strips", vec![ribbon, fan])
}

fn disc(centre: DVec2, radius: f64) -> Unwrapped {
    let mut shape = Unwrapped::default();
    for k in 0..=33 {
        // The middle first, then the rim, closed by its first point again.
        let angle = f64::from(k - 1) / 32.0 * TAU;
        let at = if k == 0 { DVec2::ZERO } else { DVec2::from_angle(-angle) };
        shape.positions.push(DVec3::new(at.x, 0.8, at.y));
        shape.normals.push(DVec3::Y);
        shape.tangents.push((DVec3::X, 1.0));
        shape.uvs.push(centre + at * radius);
    }
    shape.triangles = (1..33).map(|k| [0, k, k + 1]).collect();
    shape
}

/// A flat grid whose every third vertex is raised by the accessor's sparse part.
fn sparse_heights(scene: &mut Scene, flat: &Unwrapped) -> usize {
    let accessor = scene.positions(&flat.positions);
    let raised: Vec<u16> = (0..flat.positions.len() as u16).step_by(3).collect();
    let values: Vec<DVec3> = raised
        .iter()
        .map(|v| {
            let p = flat.positions[usize::from(*v)];
            p + DVec3::Y * 0.3 * (p.x * 3.0).cos() * (p.z * 2.0).cos().abs()
        })
        .collect();
    let indices: Vec<u8> = raised.iter().flat_map(|v| v.to_le_bytes()).collect();
    let indices = scene.document.append_buffer_view(&indices, None);
    let values = floats3(&values);
    let heights = || values.iter().map(|v| v[1]);
    let bounds = [heights().fold(0.0, f32::min), heights().fold(0.0, f32::max)];
    let bytes: Vec<u8> = values.as_flattened().iter().flat_map(|v| v.to_le_bytes()).collect();
    let values = scene.document.append_buffer_view(&bytes, None);
    let json = &mut scene.document.json["accessors"][accessor];
    json["min"][1] = json!(bounds[0]);
    json["max"][1] = json!(bounds[1]);
    json["sparse"] = json!({
        "count": raised.len(),
        "indices": { "bufferView": indices, "componentType": 5123 },
        "values": { "bufferView": values },
    });
    accessor
}
