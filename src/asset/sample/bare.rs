//! Surfaces without texture coordinates: sound ones, and one with every fault that a surface can have.

use std::f64::consts::TAU;

use glam::{DVec2, DVec3};
use serde_json::{Value, json};

use super::scene::{Scene, floats3};
use super::surface::lumpy_ball;

/// Positions, and triangles of them.
#[derive(Default)]
struct Soup {
    positions: Vec<DVec3>,
    triangles: Vec<[usize; 3]>,
}

/// A ring and a lumpy ball, each with a material; the top of the ball is painted, for what heeds importance.
pub(crate) fn bare() -> Scene {
    let mut scene = Scene::new("bare");
    let (ring, normals) = torus(24, 12, DVec3::new(-1.6, 0.0, 0.0));
    let stone = lumpy_ball(8, false);
    let ring = primitive(&mut scene, "ring", &ring.positions, &normals, &ring.triangles);
    let shifted: Vec<DVec3> = stone.positions.iter().map(|p| *p + DVec3::new(1.2, 0.0, 0.0)).collect();
    let mut stone_primitive = primitive(&mut scene, "stone", &shifted, &stone.normals, &stone.triangles);
    let painted = |d: &DVec3| if d.y > 0.6 { [1.0, 0.2, 0.2, 1.0] } else { [0.0, 0.6, 0.6, 1.0] };
    let colours: Vec<[f32; 4]> = stone.directions.iter().map(painted).collect();
    stone_primitive["attributes"]["COLOR_0"] = json!(scene.attribute(&colours));
    scene.mesh("bare", vec![ring, stone_primitive])
}

/// A primitive with a material of that name, and no texture coordinates.
fn primitive(scene: &mut Scene, name: &str, positions: &[DVec3], normals: &[DVec3], faces: &[[usize; 3]]) -> Value {
    let pbr = json!({ "metallicFactor": 0.0, "roughnessFactor": 0.8 });
    let material = scene.push("materials", json!({ "name": name, "pbrMetallicRoughness": pbr }));
    let attributes = json!({ "POSITION": scene.positions(positions), "NORMAL": scene.attribute(&floats3(normals)) });
    json!({ "attributes": attributes, "indices": scene.indices(faces.as_flattened()), "material": material })
}

/// A torus and its normals.
fn torus(around: usize, about: usize, centre: DVec3) -> (Soup, Vec<DVec3>) {
    let (mut soup, mut normals) = (Soup::default(), Vec::new());
    for (i, j) in (0..around).flat_map(|i| (0..about).map(move |j| (i, j))) {
        let out = DVec2::from_angle(TAU * i as f64 / around as f64);
        let tube = DVec2::from_angle(TAU * j as f64 / about as f64);
        let normal = (out * tube.x).extend(tube.y);
        soup.positions.push(centre + out.extend(0.0) + normal * 0.35);
        normals.push(normal);
    }
    let at = |i: usize, j: usize| (i % around) * about + j % about;
    for (i, j) in (0..around).flat_map(|i| (0..about).map(move |j| (i, j))) {
        let [a, b, c, d] = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
        soup.triangles.extend([[a, b, c], [a, c, d]]);
    }
    (soup, normals)
}

/// Every fault in one primitive; what the pieces of it are is told at each.
pub(crate) fn defects() -> Scene {
    let mut soup = Soup::default();
    // A wavy sheet on whose middle edge a fin stands: three faces at one edge.
    let sheet = soup.sheet(6, DVec3::new(0.0, 0.0, 0.0));
    let [a, b] = [sheet + 3 * 7 + 2, sheet + 3 * 7 + 3];
    let tip = soup.vertex((soup.positions[a] + soup.positions[b]) * 0.5 + DVec3::Z * 0.3);
    soup.triangles.push([a, b, tip]);
    // Two faces of it wound the other way round, one twice, one twice and turned over.
    for face in [20, 45] {
        soup.triangles[face].swap(0, 1);
    }
    let [again, back] = [soup.triangles[5], soup.triangles[60]];
    soup.triangles.extend([again, [back[1], back[0], back[2]]]);
    // Faces without area: two corners at one vertex, all three, and three on one line.
    soup.triangles.extend([[a, a, b], [a, a, a]]);
    let [p, q] = [sheet, sheet + 1];
    let middle = soup.vertex((soup.positions[p] + soup.positions[q]) * 0.5);
    soup.triangles.push([q, p, middle]);
    // A second sheet touches the first at one vertex.
    let second = soup.sheet(4, DVec3::ZERO);
    let shift = soup.positions[sheet + 48] - soup.positions[second];
    soup.positions[second..].iter_mut().for_each(|p| *p += shift);
    // A T-junction: two faces at an edge where the other side has one.
    let first = soup.positions.len();
    let corners = [[0.0, 0.0], [1.0, 0.0], [0.5, 0.9], [0.5, 0.0], [0.4, -0.8]];
    soup.positions.extend(corners.map(|[x, y]| DVec3::new(x, y - 2.0, 0.0)));
    soup.triangles.extend([[0, 1, 2], [3, 0, 4], [1, 3, 4]].map(|t| t.map(|v: usize| first + v)));
    // A triangle alone, and one far from the size of all others.
    soup.lone(DVec3::new(3.0, -2.0, 0.0), 0.5);
    soup.lone(DVec3::new(4.0, -2.0, 0.0), 1e-4);
    // A band with one side only.
    let first = soup.positions.len();
    for i in 0..16 {
        let turn = TAU * f64::from(i) / 16.0;
        let (out, half) = (DVec2::from_angle(turn), DVec2::from_angle(turn / 2.0) * 0.3);
        for side in [-1.0, 1.0] {
            let radial = out * (1.0 + side * half.x);
            soup.positions.push(DVec3::new(radial.x + 6.0, radial.y, side * half.y));
        }
    }
    for i in 0..16 {
        // At the end of the turn the sides have changed places.
        let [c, d] = if i == 15 { [1, 0] } else { [2 * i + 2, 2 * i + 3] };
        soup.triangles.extend([[2 * i, c, 2 * i + 1], [2 * i + 1, c, d]].map(|t| t.map(|v| first + v)));
    }
    // A leaf whose back is there too, and a ring.
    let front = soup.triangles.len();
    soup.sheet(3, DVec3::new(0.0, 3.0, 0.0));
    let leaf: Vec<_> = soup.triangles[front..].iter().map(|[a, b, c]| [*b, *a, *c]).collect();
    soup.triangles.extend(leaf);
    let (ring, _) = torus(12, 6, DVec3::new(3.0, 3.0, 0.0));
    let first = soup.positions.len();
    soup.positions.extend(ring.positions);
    soup.triangles.extend(ring.triangles.iter().map(|t| t.map(|v| first + v)));

    let mut scene = Scene::new("defects");
    let attributes = json!({ "POSITION": scene.positions(&soup.positions) });
    let primitive = json!({ "attributes": attributes, "indices": scene.indices(soup.triangles.as_flattened()) });
    scene.mesh("defects", vec![primitive])
}

impl Soup {
    fn vertex(&mut self, position: DVec3) -> usize {
        self.positions.push(position);
        self.positions.len() - 1
    }

    /// A wavy sheet of `n` x `n` squares; gives its first vertex.
    fn sheet(&mut self, n: usize, corner: DVec3) -> usize {
        let first = self.positions.len();
        for (j, i) in (0..=n).flat_map(|j| (0..=n).map(move |i| (j, i))) {
            let at = DVec2::new(i as f64, j as f64) / n as f64;
            self.positions.push(corner + at.extend(0.15 * (5.0 * at.x).sin() * (4.0 * at.y).cos()));
        }
        for (j, i) in (0..n).flat_map(|j| (0..n).map(move |i| (j, i))) {
            let a = first + j * (n + 1) + i;
            let d = a + n + 1;
            self.triangles.extend([[a, a + 1, d + 1], [a, d + 1, d]]);
        }
        first
    }

    fn lone(&mut self, corner: DVec3, size: f64) {
        let first = self.positions.len();
        self.positions.extend([DVec3::ZERO, DVec3::X, DVec3::Y].map(|p| corner + p * size));
        self.triangles.push([first, first + 1, first + 2]);
    }
}
