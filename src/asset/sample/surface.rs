//! A lumpy closed surface, cut into charts and unwrapped.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};

use glam::{DMat2, DVec2, DVec3};

use super::random::Random;

/// A triangle mesh about the origin, seen from outside counterclockwise.
#[derive(Debug, Default)]
pub(crate) struct Surface {
    /// Unit directions of the vertices.
    pub(crate) directions: Vec<DVec3>,
    /// Positions.
    pub(crate) positions: Vec<DVec3>,
    /// Unit normals.
    pub(crate) normals: Vec<DVec3>,
    /// Vertices of each face.
    pub(crate) triangles: Vec<[usize; 3]>,
}

/// A cube of `n` x `n` squares a side blown up to a lumpy ball; symmetric in x where `mirrored`, which wants an even `n`:
/// then the second half of the faces mirrors the first.
pub(crate) fn lumpy_ball(n: i32, mirrored: bool) -> Surface {
    let mut surface = Surface::default();
    let mut known: BTreeMap<[i32; 3], usize> = BTreeMap::new();
    let mut vertex = |surface: &mut Surface, lattice: [i32; 3]| {
        *known.entry(lattice).or_insert_with(|| {
            let cube = lattice.map(|i| ((f64::from(i) / f64::from(n) - 0.5) * std::f64::consts::FRAC_PI_2).tan());
            let direction = DVec3::from_array(cube).normalize();
            surface.directions.push(direction);
            surface.positions.push(direction * radius(direction, mirrored));
            surface.directions.len() - 1
        })
    };
    let mut squares = Vec::new();
    for side in 0..6 {
        let (axis, top) = (side / 2, side % 2 == 1);
        for (i, j) in (0..n).flat_map(|i| (0..n).map(move |j| (i, j))) {
            let corner = |di: i32, dj: i32| {
                let mut lattice = [if top { n } else { 0 }; 3];
                lattice[(axis + 1) % 3] = i + di;
                lattice[(axis + 2) % 3] = j + dj;
                lattice
            };
            let mut square = [corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)];
            if !top {
                square.reverse();
            }
            if !mirrored || square.iter().map(|c| 2 * c[0] - n).sum::<i32>() > 0 {
                squares.push(square);
            }
        }
    }
    for [a, b, c, d] in &squares {
        for corners in [[a, b, c], [a, c, d]] {
            let triangle = corners.map(|lattice| vertex(&mut surface, *lattice));
            surface.triangles.push(triangle);
        }
    }
    if mirrored {
        for [a, b, c, d] in &squares {
            for corners in [[c, b, a], [d, c, a]] {
                let triangle = corners.map(|[x, y, z]| vertex(&mut surface, [n - x, *y, *z]));
                surface.triangles.push(triangle);
            }
        }
    }
    surface.normals = vec![DVec3::ZERO; surface.positions.len()];
    for &triangle in &surface.triangles {
        let [a, b, c] = triangle.map(|v| surface.positions[v]);
        for v in triangle {
            surface.normals[v] += (b - a).cross(c - a);
        }
    }
    for normal in &mut surface.normals {
        *normal = normal.normalize_or(DVec3::Z);
    }
    surface
}

fn radius(direction: DVec3, mirrored: bool) -> f64 {
    let d = if mirrored { DVec3::new(direction.x.abs(), direction.y, direction.z) } else { direction };
    1.0 + 0.16 * (3.1 * d.x + 0.4).sin() * (2.7 * d.y + 1.0).cos() + 0.07 * (5.0 * d.z + 2.0 * d.x * d.x).sin()
}

/// Cuts the first `faces` faces into `count` connected regions of ragged outline; gives the region of each face.
pub(crate) fn regions(surface: &Surface, faces: usize, count: usize, random: &mut Random) -> Vec<usize> {
    let triangles = &surface.triangles[..faces];
    let centres: Vec<DVec3> =
        triangles.iter().map(|t| t.iter().map(|v| surface.directions[*v]).sum::<DVec3>().normalize()).collect();
    let mut across: BTreeMap<(usize, usize), usize> = BTreeMap::new();
    for (face, t) in triangles.iter().enumerate() {
        for k in 0..3 {
            across.insert((t[k], t[(k + 1) % 3]), face);
        }
    }
    let mut region = vec![usize::MAX; faces];
    let mut heap = BinaryHeap::new();
    for seed in spread(&centres, count, random).into_iter().enumerate() {
        heap.push(Reverse((0_u64, seed.1, seed.0)));
    }
    while let Some(Reverse((cost, face, owner))) = heap.pop() {
        if region[face] != usize::MAX {
            continue;
        }
        region[face] = owner;
        let t = triangles[face];
        for k in 0..3 {
            if let Some(&next) = across.get(&(t[(k + 1) % 3], t[k])) {
                heap.push(Reverse((cost + 1000 + random.bits() % 1500, next, owner)));
            }
        }
    }
    region
}

/// `count` different points far from each other, the first by chance.
fn spread(centres: &[DVec3], count: usize, random: &mut Random) -> Vec<usize> {
    let mut distance = vec![f64::INFINITY; centres.len()];
    let mut next = (random.bits() % centres.len() as u64) as usize;
    let mut chosen = Vec::with_capacity(count);
    for _ in 0..count {
        chosen.push(next);
        let mut best = -1.0;
        let from = centres[next];
        for (index, centre) in centres.iter().enumerate() {
            distance[index] = distance[index].min(centre.distance(from));
            // A little chance, or the points would stand in ranks.
            let score = distance[index] * (0.7 + 0.3 * random.unit());
            if score > best {
                best = score;
                next = index;
            }
        }
    }
    chosen
}

/// An unwrapped part of a surface: what a primitive is made of.
#[derive(Debug, Default, Clone)]
pub(crate) struct Unwrapped {
    /// Vertex of the surface that each vertex is a copy of.
    pub(crate) origin: Vec<usize>,
    /// Chart of each vertex.
    pub(crate) chart: Vec<usize>,
    /// Position of each vertex.
    pub(crate) positions: Vec<DVec3>,
    /// Unit normal of each vertex.
    pub(crate) normals: Vec<DVec3>,
    /// Tangent along +u and the sign of the bitangent.
    pub(crate) tangents: Vec<(DVec3, f64)>,
    /// UV of each vertex, in 0..1.
    pub(crate) uvs: Vec<DVec2>,
    /// Vertices of each face.
    pub(crate) triangles: Vec<[usize; 3]>,
}

impl Unwrapped {
    /// Appends a copy of a vertex of the surface, which has no tangent yet; gives its index.
    pub(crate) fn push(&mut self, origin: usize, chart: usize, position: DVec3, normal: DVec3, uv: DVec2) -> usize {
        self.origin.push(origin);
        self.chart.push(chart);
        self.positions.push(position);
        self.normals.push(normal);
        self.uvs.push(uv);
        self.origin.len() - 1
    }

    /// The least and the greatest UV of each of `charts` charts.
    pub(crate) fn chart_boxes(&self, charts: usize) -> Vec<(DVec2, DVec2)> {
        let mut boxes = vec![(DVec2::INFINITY, DVec2::NEG_INFINITY); charts];
        for (chart, uv) in self.chart.iter().zip(&self.uvs) {
            let (low, high) = &mut boxes[*chart];
            (*low, *high) = (low.min(*uv), high.max(*uv));
        }
        boxes
    }
}

/// Unwraps faces chart by chart (central projection from the origin, which turns straight over the whole chart and so
/// cannot overlap), turns each chart by chance and puts it somewhere into its own cell of a square grid. `slack` is the
/// share of a cell that the largest chart leaves free.
pub(crate) fn unwrap(
    surface: &Surface,
    faces: &[usize],
    region: &[usize],
    slack: f64,
    random: &mut Random,
) -> Unwrapped {
    let mut out = Unwrapped::default();
    let mut names: BTreeMap<usize, usize> = BTreeMap::new();
    let mut axes: Vec<DVec3> = Vec::new();
    for &face in faces {
        let chart = *names.entry(region[face]).or_insert(axes.len());
        if chart == axes.len() {
            axes.push(DVec3::ZERO);
        }
        axes[chart] += surface.triangles[face].iter().map(|v| surface.directions[*v]).sum::<DVec3>();
    }
    let frames: Vec<[DVec3; 3]> = axes
        .iter()
        .map(|sum| {
            let axis = sum.normalize_or(DVec3::Z);
            let side = axis.any_orthonormal_vector();
            let turn = DMat2::from_angle(random.unit() * std::f64::consts::TAU) * DVec2::X;
            let right = side * turn.x + axis.cross(side) * turn.y;
            [right, axis.cross(right), axis]
        })
        .collect();
    let mut known: BTreeMap<(usize, usize), usize> = BTreeMap::new();
    for &face in faces {
        let chart = names[&region[face]];
        let [right, up, axis] = frames[chart];
        let triangle = surface.triangles[face].map(|v| {
            *known.entry((chart, v)).or_insert_with(|| {
                let d = surface.directions[v];
                // v runs downwards.
                let uv = DVec2::new(d.dot(right), -d.dot(up)) / d.dot(axis).max(0.2);
                out.push(v, chart, surface.positions[v], surface.normals[v], uv)
            })
        });
        out.triangles.push(triangle);
    }
    place(&mut out, frames.len(), slack, random);
    out.tangents = tangents(&out);
    out
}

/// Scales all charts alike and puts each into its cell.
fn place(out: &mut Unwrapped, charts: usize, slack: f64, random: &mut Random) {
    let side = (charts as f64).sqrt().ceil();
    let cell = 1.0 / side;
    let boxes = out.chart_boxes(charts);
    let largest = boxes.iter().map(|(low, high)| (*high - *low).max_element()).fold(1e-9, f64::max);
    let scale = cell * (1.0 - slack) / largest;
    let shift: Vec<DVec2> = (0..charts)
        .map(|chart| {
            let corner = DVec2::new(chart as f64 % side, (chart as f64 / side).floor()) * cell;
            let (low, high) = boxes[chart];
            let room = DVec2::splat(cell) - (high - low) * scale;
            // A sixth of the room stays free on every side.
            let chance = DVec2::new(random.unit(), random.unit()) * (2.0 / 3.0) + 1.0 / 6.0;
            corner + room * chance - low * scale
        })
        .collect();
    for (chart, uv) in out.chart.iter().zip(&mut out.uvs) {
        *uv = *uv * scale + shift[*chart];
    }
}

/// Tangents along +u, at right angles to the normals. The bitangent runs against v, which points down.
pub(crate) fn tangents(out: &Unwrapped) -> Vec<(DVec3, f64)> {
    let mut along = vec![DVec3::ZERO; out.positions.len()];
    let mut sign = vec![1.0; out.positions.len()];
    for triangle in &out.triangles {
        let [a, b, c] = triangle.map(|v| out.positions[v]);
        let [ua, ub, uc] = triangle.map(|v| out.uvs[v]);
        let (e, f, s, t) = (b - a, c - a, ub - ua, uc - ua);
        let turned = s.perp_dot(t).signum();
        let direction = (e * t.y - f * s.y) * turned;
        for &v in triangle {
            along[v] += direction;
            // Seen from outside an unmirrored chart runs against the clock with v down.
            sign[v] = -turned;
        }
    }
    let tangent = |(t, n): (&DVec3, &DVec3)| (*t - *n * n.dot(*t)).normalize_or(n.any_orthonormal_vector());
    along.iter().zip(&out.normals).map(tangent).zip(sign).collect()
}
