//! Repairing the few inversions of a patch.

use glam::DVec2;

use crate::atlas::groups::{Grouped, sorted_unique};

/// Sweeps over the vertices of inverted triangles.
const SWEEPS: usize = 16;
/// Sweeps after which there should be fewer of them than ever: what succeeds does so soon.
const PATIENCE: usize = 6;
/// Projections of one vertex in a sweep.
const PROJECTIONS: usize = 24;
/// Beyond the boundary of the half plane, relative to the distance: relaxation reaches a region with an interior.
const OVER: f64 = 1.3;

/// Moves free vertices of triangles whose signed area is under `least` times `areas` until there are none, each to a nearby point from
/// which all triangles incident to it are seen the right way round: by relaxation over their half planes (Agmon 1954), vertex by vertex.
/// Triangles with an area of zero or less in `areas` are left as they are. Gives whether none is left.
pub(crate) fn repair_inversions(
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
    let corners = triangles.iter().flatten().enumerate();
    let stars = Grouped::new(free.len(), corners.map(|(corner, &v)| (v, corner as u32 / 3)));
    let mut wrong: Vec<u32> = (0..triangles.len() as u32).collect();
    // The fewest so far, and when that was.
    let mut fewest = (usize::MAX, 0);
    for sweep in 0..SWEEPS {
        wrong.retain(|&i| deficit(&triangles[i as usize], areas[i as usize], positions) > 0.0);
        if wrong.is_empty() {
            return true;
        }
        if wrong.len() < fewest.0 {
            fewest = (wrong.len(), sweep);
        } else if sweep > fewest.1 + PATIENCE {
            return false;
        }
        let corners = wrong.iter().flat_map(|&i| triangles[i as usize]);
        let vertices: Vec<u32> = sorted_unique(corners.filter(|v| free[*v as usize]));
        let mut moved = false;
        for &v in &vertices {
            let own = stars.of(v);
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
                wrong.extend(own);
            } else {
                positions[v as usize] = start;
            }
        }
        if !moved {
            return false;
        }
        wrong = sorted_unique(wrong);
    }
    wrong.iter().all(|&i| deficit(&triangles[i as usize], areas[i as usize], positions) <= 0.0)
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
            assert!(repair_inversions(&triangles, &areas, &free, 0.1, &mut at));
            assert_eq!(wrong(&at), 0);
            assert!(at.iter().zip(&start).zip(&free).all(|((a, s), free)| *free || a == s));
        }
        assert!(tangled > 5, "{tangled}");
    }

    #[test]
    fn what_cannot_be_turned_back_is_told() {
        // A triangle that is held the wrong way round.
        let mut at = vec![DVec2::ZERO, DVec2::Y, DVec2::X];
        assert!(!repair_inversions(&[[0, 1, 2]], &[0.5], &[false; 3], 0.1, &mut at));
    }
}
