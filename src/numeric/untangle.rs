//! Turning back the few triangles of a patch that lie the wrong way round.

use glam::DVec2;

/// Sweeps over the vertices of triangles that are turned over.
const SWEEPS: usize = 60;
/// Projections of one vertex in a sweep.
const PROJECTIONS: usize = 24;
/// Beyond the boundary of the half plane, relative to the distance: relaxation reaches a region with an interior.
const OVER: f64 = 1.3;

/// Moves free vertices of triangles whose signed area is under `least` times `areas` until there are none, each to a nearby point from
/// which all triangles about it are seen the right way round: by relaxation over their half planes (Agmon 1954), vertex by vertex.
/// Triangles with an area of zero or less in `areas` are left as they are. Gives whether none is left.
pub(crate) fn untangle(
    triangles: &[[u32; 3]],
    areas: &[f64],
    free: &[bool],
    least: f64,
    positions: &mut [DVec2],
) -> bool {
    let deficit = |t: &[u32; 3], area: f64, positions: &[DVec2]| {
        let [a, b, c] = t.map(|v| positions[v as usize]);
        if area > 0.0 { least * area - 0.5 * (b - a).perp_dot(c - a) } else { f64::NEG_INFINITY }
    };
    // Triangles about the vertices that are near the trouble; grown as it spreads.
    let mut around: Vec<Option<Vec<u32>>> = vec![None; free.len()];
    for _ in 0..SWEEPS {
        let wrong: Vec<usize> =
            (0..triangles.len()).filter(|&i| deficit(&triangles[i], areas[i], positions) > 0.0).collect();
        if wrong.is_empty() {
            return true;
        }
        let mut vertices: Vec<u32> = wrong.iter().flat_map(|&i| triangles[i]).filter(|v| free[*v as usize]).collect();
        vertices.sort_unstable();
        vertices.dedup();
        if vertices.iter().any(|v| around[*v as usize].is_none()) {
            let mut new = vec![false; free.len()];
            for &v in vertices.iter().filter(|v| around[**v as usize].is_none()) {
                new[v as usize] = true;
            }
            for (i, t) in triangles.iter().enumerate() {
                for v in t.iter().filter(|v| new[**v as usize]) {
                    around[*v as usize].get_or_insert_default().push(i as u32);
                }
            }
        }
        let mut moved = false;
        for &v in &vertices {
            let Some(own) = &around[v as usize] else { continue };
            let start = positions[v as usize];
            let worst = |positions: &[DVec2]| {
                own.iter()
                    .map(|&i| (deficit(&triangles[i as usize], areas[i as usize], positions), i as usize))
                    .fold((f64::NEG_INFINITY, 0), |a, b| if b.0 > a.0 { b } else { a })
            };
            let before = worst(positions).0;
            for _ in 0..PROJECTIONS {
                let (by, i) = worst(positions);
                if by <= 0.0 {
                    break;
                }
                let t = &triangles[i];
                let k = t.iter().position(|u| *u == v).unwrap_or(0);
                let edge = positions[t[(k + 2) % 3] as usize] - positions[t[(k + 1) % 3] as usize];
                let square = edge.length_squared();
                if square == 0.0 {
                    break;
                }
                // Twice the area grows by the edge's length for each step along its inner normal.
                positions[v as usize] += edge.perp() * (2.0 * by * OVER / square);
            }
            let after = worst(positions).0;
            if after < before && positions[v as usize].is_finite() {
                moved = true;
            } else {
                positions[v as usize] = start;
            }
        }
        if !moved {
            return false;
        }
    }
    triangles.iter().zip(areas).all(|(t, a)| deficit(t, *a, positions) <= 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::testing::{Rng, sheet};

    #[test]
    fn crossed_vertices_are_pulled_apart_and_held_ones_stay() {
        let atlas = sheet(8, 8, DVec2::ZERO);
        let triangles: Vec<[u32; 3]> = atlas.corners.iter().map(|c| c.map(|u| u.0)).collect();
        let areas = vec![0.5; triangles.len()];
        let free: Vec<bool> = atlas.uv.iter().map(|p| p.min_element() > 0.5 && p.max_element() < 7.5).collect();
        let mut rng = Rng(11);
        let mut tangled = 0;
        for _ in 0..20 {
            let mut at = atlas.uv.clone();
            for _ in 0..4 {
                let v = 20 + rng.next() as usize % 40;
                if free[v] {
                    at[v] += (rng.point(2.0) - 1.0) * 1.6;
                }
            }
            let start = at.clone();
            let wrong = |at: &[DVec2]| {
                let area = |t: &[u32; 3]| {
                    let [a, b, c] = t.map(|v| at[v as usize]);
                    (b - a).perp_dot(c - a)
                };
                triangles.iter().filter(|t| area(t) <= 0.0).count()
            };
            tangled += usize::from(wrong(&at) > 0);
            assert!(untangle(&triangles, &areas, &free, 0.1, &mut at));
            assert_eq!(wrong(&at), 0);
            assert!(at.iter().zip(&start).zip(&free).all(|((a, s), free)| *free || a == s));
        }
        assert!(tangled > 5, "{tangled}");
    }

    #[test]
    fn what_cannot_be_turned_back_is_told() {
        // A triangle that is held the wrong way round.
        let mut at = vec![DVec2::ZERO, DVec2::Y, DVec2::X];
        assert!(!untangle(&[[0, 1, 2]], &[0.5], &[false; 3], 0.1, &mut at));
    }
}
