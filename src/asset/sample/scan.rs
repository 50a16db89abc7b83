//! Scans as photogrammetry makes them: each face is textured from one of many photographs, and the parts of one
//! photograph are packed as charts, each as it was seen.

use std::collections::BTreeMap;

use glam::{DMat2, DVec2, DVec3};

use super::paint::{marble, paint};
use super::random::{Random, smooth};
use super::scene::Scene;
use super::surface::{Surface, Unwrapped, lumpy_ball, tangents};
use crate::atlas::find_root;

/// Directions that the surface was seen from.
const VIEWS: usize = 96;
/// Cosine below which a face is seen too obliquely to be textured from a view.
const OBLIQUE: f64 = 0.4;
/// How much the choice of a view varies over the surface: the size of charts.
const PATCHY: f64 = 2.5;
/// How much it varies from face to face: ragged borders, islands, holes.
const RAGGED: f64 = 0.10;
/// How often lone faces get a chance to join their neighbours, and how often they do not take it.
const ROUNDS: usize = 2;
const ISLANDS: f64 = 0.25;
/// Distance of the cameras from the middle of the surface, in units of its mean radius.
const DISTANCE: f64 = 7.0;
/// Texel densities of charts, about the common one.
const DENSITY: [f64; 2] = [0.8, 1.25];
/// Free texels about each chart.
const MARGIN: f64 = 4.0;

/// Some 500 charts.
pub(crate) fn few() -> Scene {
    scan("scan", 29, 2.75, 2048)
}

/// Some 2,000 charts.
pub(crate) fn many() -> Scene {
    scan("scan_2000", 58, 5.8, 2048)
}

/// Some 10,000 charts.
pub(crate) fn very_many() -> Scene {
    scan("scan_10000", 130, 13.0, 4096)
}

/// Some 20,000 charts of some ten faces, torn.
pub(crate) fn torn_20000() -> Scene {
    torn("scan_20000", 130, 22.0, 4096)
}

/// Some 50,000.
pub(crate) fn torn_50000() -> Scene {
    torn("scan_50000", 206, 34.2, 4096)
}

/// A scan of 12 `squares`^2 faces on a sheet of `size`^2 texels; `patches` is how often the choice of views changes
/// over a unit of length.
fn scan(name: &str, squares: i32, patches: f64, size: usize) -> Scene {
    let mut random = Random(7);
    let mut surface = lumpy_ball(squares, false);
    roughen(&mut surface, squares, &mut random);
    photographed(name, surface, patches, size, random)
}

/// One whose surface has slivers, and vertices at which sheets meet that are not neighbours.
fn torn(name: &str, squares: i32, patches: f64, size: usize) -> Scene {
    let mut random = Random(11);
    let mut surface = lumpy_ball(squares, false);
    roughen(&mut surface, squares, &mut random);
    squeeze(&mut surface, &mut random);
    pinch(&mut surface, &mut random);
    photographed(name, surface, patches, size, random)
}

/// Slivers: vertices that have come next to a neighbour.
fn squeeze(surface: &mut Surface, random: &mut Random) {
    let faces = surface.triangles.len();
    for _ in 0..faces / 60 {
        let [a, b, _] = surface.triangles[(random.bits() % faces as u64) as usize];
        surface.positions[a] = surface.positions[b].lerp(surface.positions[a], 0.02);
    }
}

/// Vertices that become one with another, two edges off.
fn pinch(surface: &mut Surface, random: &mut Random) {
    let mut around: Vec<Vec<usize>> = vec![Vec::new(); surface.positions.len()];
    for [a, b, c] in &surface.triangles {
        for (v, others) in [(*a, [*b, *c]), (*b, [*c, *a]), (*c, [*a, *b])] {
            around[v].extend(others);
        }
    }
    let mut name: Vec<usize> = (0..around.len()).collect();
    for _ in 0..around.len() / 200 {
        let v = (random.bits() % around.len() as u64) as usize;
        let second = around[v].iter().flat_map(|b| &around[*b]).find(|w| **w != v && !around[v].contains(w));
        if let Some(w) = second.filter(|w| name[v] == v && name[**w] == **w) {
            name[*w] = v;
        }
    }
    surface.triangles.iter_mut().flatten().for_each(|v| *v = name[*v]);
    surface.triangles.retain(|[a, b, c]| a != b && b != c && c != a);
}

/// The scan of a surface.
fn photographed(name: &str, mut surface: Surface, patches: f64, size: usize, mut random: Random) -> Scene {
    puncture(&mut surface, &mut random);
    hang_fins(&mut surface, &mut random);
    let mut view = views(&surface, patches, &mut random);
    let near = neighbours(&surface);
    settle(&mut view, &near, &mut random);
    let chart = components(&view, &near);
    let mut shape = project(&surface, &view, &chart, &mut random);
    place_in_rows(&mut shape, size as f64, &mut random);
    soil(&mut shape, &mut random);
    shape.tangents = tangents(&shape);
    let mut scene = Scene::new(name);
    let base = scene.texture("base_color", paint(&[&shape], [size; 2], [0; 3], |p| marble(p.position)));
    let material = scene.material("scan", base);
    let primitive = scene.primitive(&shape, material, false, false);
    scene.mesh(name, vec![primitive])
}

/// Bumps, and noise of measurement: vertices stray from their places by a part of a square.
fn roughen(surface: &mut Surface, squares: i32, random: &mut Random) {
    let square = 1.5 / f64::from(squares);
    for (position, direction) in surface.positions.iter_mut().zip(&surface.directions) {
        let bump = 0.1 * smooth(*position * 4.0 + 5.0) + 0.03 * smooth(*position * 11.0);
        let stray = DVec3::new(random.unit(), random.unit(), random.unit()) - 0.5;
        *position += *direction * bump + stray * (0.25 * square);
    }
}

/// Takes away the faces where nothing was seen.
fn puncture(surface: &mut Surface, random: &mut Random) {
    let holes: Vec<(DVec3, f64)> = (0..5).map(|_| (direction(random), 0.05 + 0.08 * random.unit())).collect();
    let directions = &surface.directions;
    surface.triangles.retain(|t| {
        let middle = t.iter().map(|v| directions[*v]).sum::<DVec3>().normalize_or(DVec3::Z);
        holes.iter().all(|(hole, radius)| middle.distance(*hole) > radius * (0.8 + 0.4 * random.unit()))
    });
}

/// Edges that a third face hangs on.
fn hang_fins(surface: &mut Surface, random: &mut Random) {
    let faces = surface.triangles.len();
    for _ in 0..faces / 2500 + 1 {
        let [a, b, c] = surface.triangles[(random.bits() % faces as u64) as usize];
        let height = surface.directions[c] * surface.positions[a].distance(surface.positions[b]);
        surface.positions.push(surface.positions[c] + height);
        surface.directions.push(surface.directions[c]);
        surface.normals.push(surface.normals[c]);
        surface.triangles.push([b, a, surface.positions.len() - 1]);
    }
}

/// A direction by chance, evenly.
fn direction(random: &mut Random) -> DVec3 {
    let (z, turn) = (2.0 * random.unit() - 1.0, DVec2::from_angle(random.unit() * std::f64::consts::TAU));
    (turn * (1.0 - z * z).max(0.0).sqrt()).extend(z)
}

/// The view that each face is textured from: of those that see it well, one that chance prefers in this place.
fn views(surface: &Surface, patches: f64, random: &mut Random) -> Vec<usize> {
    let axes = axes();
    let choose = |t: &[usize; 3]| {
        let [a, b, c] = t.map(|v| surface.positions[v]);
        let normal = (b - a).cross(c - a).normalize_or(DVec3::Z);
        let place = (a + b + c) / 3.0 * patches;
        let mut best = (f64::NEG_INFINITY, 0);
        for (view, axis) in axes.iter().enumerate() {
            let cosine = normal.dot(*axis);
            if cosine > OBLIQUE || best.0 == f64::NEG_INFINITY {
                let shift = DVec3::new(view as f64 * 17.3, view as f64 * -5.7, 0.5);
                let score = cosine + PATCHY * smooth(place + shift) + RAGGED * random.unit();
                let score = if cosine > OBLIQUE { score } else { cosine - 9.0 };
                if score > best.0 {
                    best = (score, view);
                }
            }
        }
        best.1
    };
    surface.triangles.iter().map(choose).collect()
}

/// Towards the cameras: evenly over the sphere, on a spiral.
fn axes() -> Vec<DVec3> {
    let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    let axis = |k: usize| {
        let z = 1.0 - (2.0 * k as f64 + 1.0) / VIEWS as f64;
        (DVec2::from_angle(golden * k as f64) * (1.0 - z * z).sqrt()).extend(z)
    };
    (0..VIEWS).map(axis).collect()
}

/// The faces across the edges of each face, of a third one at an edge only the last before it; `usize::MAX` at a border.
fn neighbours(surface: &Surface) -> Vec<[usize; 3]> {
    let mut across: BTreeMap<[usize; 2], (usize, usize)> = BTreeMap::new();
    let mut out = vec![[usize::MAX; 3]; surface.triangles.len()];
    for (face, t) in surface.triangles.iter().enumerate() {
        for k in 0..3 {
            let (a, b) = (t[k], t[(k + 1) % 3]);
            if let Some((other, edge)) = across.insert([a.min(b), a.max(b)], (face, k)) {
                out[face][k] = other;
                out[other][edge] = face;
            }
        }
    }
    out
}

/// Most faces that stand alone among those of another view join them; islands and holes are the rest.
fn settle(view: &mut [usize], near: &[[usize; 3]], random: &mut Random) {
    for _ in 0..ROUNDS {
        for (face, near) in near.iter().enumerate() {
            let [a, b, c] = near.map(|n| view.get(n).copied());
            let common = if a == b || a == c { a } else { b.filter(|_| b == c) };
            if let Some(common) = common.filter(|_| random.unit() > ISLANDS) {
                view[face] = common;
            }
        }
    }
}

/// The chart of each face: faces of one view that hang together by edges.
fn components(view: &[usize], near: &[[usize; 3]]) -> Vec<usize> {
    let mut parent: Vec<u32> = (0..view.len() as u32).collect();
    for (face, near) in near.iter().enumerate() {
        for other in near.iter().filter(|n| view.get(**n) == Some(&view[face])) {
            let (a, b) = (find_root(&mut parent, face as u32), find_root(&mut parent, *other as u32));
            parent[a.max(b) as usize] = a.min(b);
        }
    }
    let mut numbers = BTreeMap::new();
    let number = |face: u32| {
        let next = numbers.len();
        *numbers.entry(find_root(&mut parent, face)).or_insert(next)
    };
    (0..view.len() as u32).map(number).collect()
}

/// Charts as the cameras see them, each turned by chance and at a density of its own, in units of the surface.
fn project(surface: &Surface, view: &[usize], chart: &[usize], random: &mut Random) -> Unwrapped {
    let axes = axes();
    let mut cameras: Vec<(DVec3, DMat2)> = Vec::new();
    let mut known: BTreeMap<(usize, usize), usize> = BTreeMap::new();
    let mut out = Unwrapped::default();
    for ((triangle, view), chart) in surface.triangles.iter().zip(view).zip(chart) {
        if *chart == cameras.len() {
            let density = DENSITY[0] * (DENSITY[1] / DENSITY[0]).powf(random.unit());
            cameras.push((axes[*view], DMat2::from_angle(random.unit() * std::f64::consts::TAU) * density));
        }
        let (axis, turn) = cameras[*chart];
        let right = axis.any_orthonormal_vector();
        let up = axis.cross(right);
        let triangle = triangle.map(|v| {
            *known.entry((*chart, v)).or_insert_with(|| {
                let p = surface.positions[v];
                // v runs downwards.
                let seen = DVec2::new(p.dot(right), -p.dot(up)) * (DISTANCE / (DISTANCE - p.dot(axis)));
                out.push(v, *chart, p, surface.normals[v], turn * seen)
            })
        });
        out.triangles.push(triangle);
    }
    out
}

/// Packs the boxes of the charts in rows, the highest first, as large as a sheet of `size` texels takes them.
fn place_in_rows(shape: &mut Unwrapped, size: f64, random: &mut Random) {
    let charts = shape.chart.iter().max().map_or(0, |last| last + 1);
    let boxes = shape.chart_boxes(charts);
    let size_of = |chart: usize| boxes[chart].1 - boxes[chart].0;
    let mut order: Vec<usize> = (0..charts).collect();
    order.sort_by(|a, b| size_of(*b).y.total_cmp(&size_of(*a).y).then(a.cmp(b)));
    // Corners in texels at a scale, and the height of all rows.
    let rows = |scale: f64| {
        let mut corners = vec![DVec2::ZERO; charts];
        let (mut at, mut height) = (DVec2::ZERO, 0.0);
        for chart in &order {
            let own = size_of(*chart) * scale + 2.0 * MARGIN;
            if at.x + own.x > size {
                at = DVec2::new(0.0, at.y + height);
                height = 0.0;
            }
            corners[*chart] = at + MARGIN;
            at.x += own.x;
            height = own.y.max(height);
        }
        (corners, at.y + height)
    };
    let (mut fits, mut beyond) = (0.0, size);
    for _ in 0..30 {
        let middle = 0.5 * (fits + beyond);
        let widest = order.iter().map(|c| size_of(*c).x).fold(0.0, f64::max) * middle + 2.0 * MARGIN;
        if widest <= size && rows(middle).1 <= size { fits = middle } else { beyond = middle }
    }
    // Photographs are not cut at whole texels.
    let (corners, _) = rows(fits);
    let stray: Vec<DVec2> = corners.iter().map(|_| DVec2::new(random.unit(), random.unit())).collect();
    for (chart, uv) in shape.chart.iter().zip(&mut shape.uvs) {
        *uv = ((*uv - boxes[*chart].0) * fits + corners[*chart] + stray[*chart]) / size;
    }
}

/// What else scans have wrong: vertices in several copies, faces wound the other way round, faces without area.
fn soil(shape: &mut Unwrapped, random: &mut Random) {
    let faces = shape.triangles.len();
    let mut pick = |share: usize| -> Vec<usize> {
        (0..faces / share + 1).map(|_| (random.bits() % faces as u64) as usize).collect()
    };
    for face in pick(300) {
        shape.triangles[face] = shape.triangles[face].map(|v| copy(shape, v));
    }
    for face in pick(1000) {
        shape.triangles[face].swap(1, 2);
    }
    for face in pick(1500) {
        let [a, b, _] = shape.triangles[face];
        let again = copy(shape, b);
        shape.triangles.extend([[a, b, again], [b, b, a]]);
    }
}

/// A vertex once more.
fn copy(shape: &mut Unwrapped, v: usize) -> usize {
    shape.push(shape.origin[v], shape.chart[v], shape.positions[v], shape.normals[v], shape.uvs[v])
}
