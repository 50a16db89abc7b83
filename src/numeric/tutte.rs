//! Tutte's embedding (1963): the boundary of a disk on a convex polygon, every other vertex at the mean of its neighbours.

use std::f64::consts::TAU;

use glam::{DMat2, DVec2};

use super::multifrontal::{FIXED, Factor, Structure};

/// Places on the circle about the origin with that radius for the vertices of a loop, by the lengths of the edges that leave them.
pub(crate) fn on_circle(lengths: &[f64], radius: f64) -> Vec<DVec2> {
    let total: f64 = lengths.iter().sum();
    let mut along = 0.0;
    let place = |length: &f64| {
        let at = DVec2::from_angle(TAU * along / total) * radius;
        along += length;
        at
    };
    lengths.iter().map(place).collect()
}

/// Places all vertices that are not `held`. `edges`: pairs, each once; `guide`: points that order the elimination well, about where the vertices will be or are in
/// any picture of the mesh. `None` where a part of the mesh hangs on no held vertex.
pub(crate) fn embed(x: &mut [DVec2], held: &[bool], edges: &[[u32; 2]], guide: &[DVec2]) -> Option<()> {
    let mut place = vec![FIXED; x.len()];
    let free: Vec<u32> = (0..x.len() as u32).filter(|&v| !held[v as usize]).collect();
    free.iter().enumerate().for_each(|(k, &v)| place[v as usize] = k as u32);
    let mut b = vec![DVec2::ZERO; free.len()];
    for &[p, q] in edges {
        for (from, to) in [(p, q), (q, p)] {
            if place[from as usize] != FIXED && held[to as usize] {
                b[place[from as usize] as usize] += x[to as usize];
            }
        }
    }
    let at: Vec<DVec2> = free.iter().map(|&v| guide[v as usize]).collect();
    let springs: Vec<[u32; 3]> = edges.iter().map(|[p, q]| [place[*p as usize], place[*q as usize], FIXED]).collect();
    let one = DMat2::IDENTITY;
    let structure = Structure::new(&at, &springs);
    let mut factor = Factor::default();
    if !structure.factor(0.0, |_| [one, -one, one, DMat2::ZERO, DMat2::ZERO, DMat2::ZERO], &mut factor) {
        return None;
    }
    structure.solve(&factor, &mut b);
    free.iter().zip(b).for_each(|(&v, at)| x[v as usize] = at);
    Some(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_free_vertex_is_the_mean_of_its_neighbours_and_no_triangle_is_turned_over() {
        let side = 9u32;
        let at = |i: u32, j: u32| i * side + j;
        let (mut edges, mut triangles) = (Vec::new(), Vec::new());
        for i in 0..side {
            for j in 0..side {
                edges.extend((j + 1 < side).then(|| [at(i, j), at(i, j + 1)]));
                edges.extend((i + 1 < side).then(|| [at(i, j), at(i + 1, j)]));
                if i + 1 < side && j + 1 < side {
                    edges.push([at(i, j + 1), at(i + 1, j)]);
                    triangles.push([at(i, j), at(i, j + 1), at(i + 1, j)]);
                    triangles.push([at(i, j + 1), at(i + 1, j + 1), at(i + 1, j)]);
                }
            }
        }
        let last = side - 1;
        let mut ring: Vec<u32> = (0..last).map(|k| at(0, k)).collect();
        ring.extend((0..last).map(|k| at(k, last)));
        ring.extend((0..last).map(|k| at(last, last - k)));
        ring.extend((0..last).map(|k| at(last - k, 0)));
        let n = (side * side) as usize;
        let (mut x, mut held) = (vec![DVec2::ZERO; n], vec![false; n]);
        for (v, p) in ring.iter().zip(on_circle(&vec![1.0; ring.len()], 2.0)) {
            x[*v as usize] = p;
            held[*v as usize] = true;
        }
        let guide: Vec<DVec2> = (0..n).map(|k| DVec2::new((k % 9) as f64, (k / 9) as f64)).collect();
        embed(&mut x, &held, &edges, &guide).expect("all hangs on the ring");
        for v in (0..n as u32).filter(|v| !held[*v as usize]) {
            let around: Vec<DVec2> = edges
                .iter()
                .filter_map(|[p, q]| if *p == v { Some(*q) } else { (*q == v).then_some(*p) })
                .map(|u| x[u as usize])
                .collect();
            let mean = around.iter().sum::<DVec2>() / around.len() as f64;
            assert!(mean.distance(x[v as usize]) < 1e-9);
        }
        for [a, b, c] in triangles.iter().map(|t| t.map(|v| x[v as usize])) {
            assert!((b - a).perp_dot(c - a) > 0.0);
        }
    }
}
