//! The fixed layer about each chart that keeps charts apart (section 3.3, *Gaps between charts*), and the proof that it did.

use glam::DVec2;

/// A loop of boundary vertices about a chart, counter-clockwise, and the layer outside it.
#[derive(Debug, Clone, Default)]
pub(super) struct Layer {
    /// Places of the outer vertices.
    pub outer: Vec<DVec2>,
    /// By boundary vertex: its outer vertex. Vertices beside a corner that turns inwards share one.
    pub of: Vec<u32>,
}

/// The layer of a width about an axis-aligned loop. `None` where a notch is narrower than twice the width.
pub(super) fn layer(points: &[DVec2], width: f64) -> Option<Layer> {
    let n = points.len();
    // Outward is to the right of an edge.
    let along = |i: usize| (points[(i + 1) % n] - points[i]).try_normalize();
    let directions: Vec<DVec2> = (0..n).map(along).collect::<Option<_>>()?;
    let turn = |i: usize| directions[(i + n - 1) % n].perp_dot(directions[i]);
    let is_corner = |i: usize| turn(i).abs() > 0.5;
    let first = (0..n).find(|i| is_corner(*i))?;
    let mitre = |i: usize| {
        let (a, b) = (directions[(i + n - 1) % n], directions[i]);
        points[i] - width * (a.perp() + b.perp())
    };
    let mut out = Layer { outer: Vec::with_capacity(n), of: vec![0; n] };
    let mut k = 0;
    while k < n {
        let start = (first + k) % n;
        let mut count = 1;
        while !is_corner((start + count) % n) && count < n {
            count += 1;
        }
        let end = (start + count) % n;
        let d = directions[start];
        let (from, to) = (mitre(start), mitre(end));
        let (low, high) = (from.dot(d), to.dot(d));
        if high <= low {
            return None;
        }
        let mut last = f64::NEG_INFINITY;
        for j in 0..count {
            let i = (start + j) % n;
            let at = if j == 0 { low } else { points[i].dot(d).clamp(low, high) };
            // What is clamped to the far corner is that corner's vertex, which comes next.
            if j > 0 && at >= high {
                out.of[i] = u32::MAX;
            } else if at > last {
                out.outer.push(from + d * (at - low));
                out.of[i] = out.outer.len() as u32 - 1;
                last = at;
            } else {
                out.of[i] = out.outer.len() as u32 - 1;
            }
        }
        k += count;
    }
    // Backwards, so that each takes the corner's that comes after it.
    for k in (0..n).rev() {
        let i = (first + k) % n;
        if out.of[i] == u32::MAX {
            out.of[i] = out.of[(i + 1) % n];
        }
    }
    Some(out)
}

/// The pairs of segments of different charts that are less than `gap` apart along both axes (Chebyshev distance), by their indices.
pub(super) fn too_near(segments: &[([DVec2; 2], u32)], gap: f64) -> Vec<(usize, usize)> {
    let mut order: Vec<usize> = (0..segments.len()).collect();
    let low = |i: usize| segments[i].0[0].min(segments[i].0[1]);
    let high = |i: usize| segments[i].0[0].max(segments[i].0[1]);
    order.sort_by(|&a, &b| low(a).x.total_cmp(&low(b).x).then(a.cmp(&b)));
    let mut open: Vec<usize> = Vec::new();
    let mut near = Vec::new();
    for &i in &order {
        let x = low(i).x - gap;
        open.retain(|&j| high(j).x > x);
        for &j in &open {
            if segments[i].1 == segments[j].1 {
                continue;
            }
            if low(j).y - high(i).y >= gap || low(i).y - high(j).y >= gap {
                continue;
            }
            if chebyshev(&segments[i].0, &segments[j].0) < gap {
                near.push((i, j));
            }
        }
        open.push(i);
    }
    near
}

/// The least over all pairs of points of two segments that do not cross of the larger of the distances along the two axes.
fn chebyshev(a: &[DVec2; 2], b: &[DVec2; 2]) -> f64 {
    let ends = a.iter().map(|p| (p, b)).chain(b.iter().map(|p| (p, a)));
    ends.map(|(p, segment)| to_segment(*p, segment)).fold(f64::INFINITY, f64::min)
}

fn to_segment(p: DVec2, [a, b]: &[DVec2; 2]) -> f64 {
    let (from, d) = (*a - p, *b - *a);
    let at = |t: f64| (from + d * t).abs().max_element();
    // The larger of two absolute values is least where one is zero, where both are equal, or at an end.
    let stops = [-from.x / d.x, -from.y / d.y, (from.y - from.x) / (d.x - d.y), -(from.x + from.y) / (d.x + d.y)];
    let inner = stops.into_iter().filter(|t| *t > 0.0 && *t < 1.0).map(at);
    inner.fold(at(0.0).min(at(1.0)), f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::testing::Rng;

    #[test]
    fn a_layer_goes_round_corners_both_ways() {
        let corners = [[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [2.0, 4.0], [2.0, 2.0], [0.0, 2.0]].map(DVec2::from);
        let mut points = Vec::new();
        for k in 0..6 {
            let (a, b) = (corners[k], corners[(k + 1) % 6]);
            points.extend((0..8).map(|j| a + (b - a) * f64::from(j) / 8.0));
        }
        let made = layer(&points, 0.5).expect("the notch is wide");
        let own: Vec<DVec2> = made.of.iter().map(|o| made.outer[*o as usize]).collect();
        for corner in [[-0.5, -0.5], [4.5, -0.5], [4.5, 4.5], [1.5, 4.5], [1.5, 2.5], [-0.5, 2.5]].map(DVec2::from) {
            assert!(own.contains(&corner), "{corner}");
        }
        // Counter-clockwise, and without steps back.
        let area: f64 =
            (0..made.outer.len()).map(|i| made.outer[i].perp_dot(made.outer[(i + 1) % made.outer.len()])).sum();
        assert!((0.5 * area - (3.0 * 5.0 + 2.0 * 3.0)).abs() < 1e-9, "{area}");
        assert!(layer(&points, 2.5).is_some(), "a step has room on one side");
    }

    #[test]
    fn a_notch_that_is_too_narrow_is_told() {
        let corners = [[0.0, 0.0], [6.0, 0.0], [6.0, 4.0], [4.0, 4.0], [4.0, 2.0], [2.0, 2.0], [2.0, 4.0], [0.0, 4.0]];
        let corners = corners.map(DVec2::from);
        assert!(layer(&corners, 0.9).is_some() && layer(&corners, 1.1).is_none());
    }

    #[test]
    fn distances_are_those_of_many_points() {
        let mut rng = Rng(9);
        for _ in 0..300 {
            let s = [[rng.point(1.0), rng.point(1.0)], [rng.point(1.0) + DVec2::X, rng.point(1.0)]];
            let at = |s: &[DVec2; 2], k: usize| s[0] + (s[1] - s[0]) * k as f64 / 200.0;
            let all = (0..=200).flat_map(|i| (0..=200).map(move |j| (i, j)));
            let brute =
                all.map(|(i, j)| (at(&s[0], i) - at(&s[1], j)).abs().max_element()).fold(f64::INFINITY, f64::min);
            let own = chebyshev(&s[0], &s[1]);
            if brute > 0.02 {
                assert!(own <= brute + 1e-12 && own > brute - 0.02, "{own} {brute}");
                let apart = |gap: f64| too_near(&[(s[0], 0), (s[1], 1)], gap).is_empty();
                assert!(apart(own - 1e-9) && !apart(own + 1e-9));
            }
        }
    }
}
