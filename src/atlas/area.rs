//! Area that faces cover: each point once, and how much of it more than once.
//!
//! Where nothing overlaps the area is the plain sum, exactly. Only connected groups of overlapping faces are
//! scanned: what is measured by scan lines is not the area but the *excess* of the sum over the union, so the
//! error shrinks with the overlap. Between two vertices' heights the length covered by a line is linear but
//! for crossings of edges, and lines stand at the middle of such strips.

use glam::DVec2;
use rayon::prelude::*;

use super::bvh::Bounds;
use super::clusters::components;
use super::groups::sorted_unique;
use super::overlap::{faces_with_area, page_count, turned, turned_overlap};
use super::{Atlas, Charts, Clusters, FaceId};

/// Areas in square texels of the reference.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Coverage {
    /// Area covered at least once.
    pub covered: f64,
    /// Sum over charts of the area that each covers at least once.
    pub by_charts: f64,
    /// Area covered at least twice by one chart, or by charts of different clusters.
    pub accidental: f64,
    /// Area covered by at least two charts of one cluster.
    pub stacked: f64,
}

impl Coverage {
    pub(crate) fn add(&mut self, other: Coverage, weight: f64) {
        self.covered += other.covered * weight;
        self.by_charts += other.by_charts * weight;
        self.accidental += other.accidental * weight;
        self.stacked += other.stacked * weight;
    }
}

/// The coverage of all pages together.
pub fn coverage(atlas: &Atlas, charts: &Charts, clusters: &Clusters) -> Coverage {
    let mut whole = Coverage::default();
    for page in 0..page_count(atlas) {
        whole.add(coverage_of_page(atlas, charts, clusters, page), 1.0);
    }
    whole
}

/// The coverage of one page.
pub fn coverage_of_page(atlas: &Atlas, charts: &Charts, clusters: &Clusters, page: usize) -> Coverage {
    let faces = faces_with_area(atlas, atlas.faces().filter(|f| usize::from(atlas.page[f.index()]) == page));
    let triangles = turned(atlas, &faces);
    let boxes: Vec<Bounds> = triangles.iter().map(Bounds::of).collect();
    let sets = components(&boxes, |a, b| turned_overlap(&triangles[a], &triangles[b])).sets();

    let sum: f64 = faces.iter().map(|&f| atlas.uv_area(f).abs()).sum();
    let mut whole = Coverage { covered: sum, by_charts: sum, ..Coverage::default() };
    let parts: Vec<Coverage> = sets
        .par_iter()
        .filter(|group| group.len() > 1)
        .map(|group| {
            let member = |&i: &u32| Member::new(atlas, charts, clusters, faces[i as usize]);
            scan(&group.iter().map(member).collect::<Vec<_>>())
        })
        .collect();
    for part in parts {
        whole.add(part, 1.0);
    }
    whole
}

/// A face of an overlapping group.
struct Member {
    /// Corners by ascending y.
    corners: [DVec2; 3],
    chart: u32,
    cluster: u32,
}

impl Member {
    fn new(atlas: &Atlas, charts: &Charts, clusters: &Clusters, face: FaceId) -> Self {
        let mut corners = atlas.uv_triangle(face);
        corners.sort_by(|a, b| a.y.total_cmp(&b.y));
        let chart = charts.of_face[face.index()];
        Member { corners, chart: chart.0, cluster: clusters.of_chart[chart.index()] }
    }

    /// Where the line at height `y` enters and leaves; `None` where it passes by.
    fn span(&self, y: f64) -> Option<(f64, f64)> {
        let [a, b, c] = self.corners;
        if y <= a.y || y >= c.y {
            return None;
        }
        let at = |p: DVec2, q: DVec2| p.x + (q.x - p.x) * ((y - p.y) / (q.y - p.y));
        let long = at(a, c);
        let short = if y < b.y { at(a, b) } else { at(b, c) };
        Some((long.min(short), long.max(short)))
    }
}

/// A strip between two scan heights.
#[derive(Clone, Copy)]
struct Strip {
    middle: f64,
    height: f64,
}

/// Triangles times lines that one group may cost.
const BUDGET: f64 = 2e7;
/// Lines over a group's height, at least, where the budget allows.
const LINES: f64 = 4096.0;
/// Groups of so few faces are measured without error.
const SMALL_GROUP: usize = 48;
const STRIPS_PER_TASK: usize = 64;

/// What a group changes about the plain sum of areas: `covered` and `by_charts` are negative corrections.
fn scan(members: &[Member]) -> Coverage {
    let strips = strips(members);
    let tasks: Vec<&[Strip]> = strips.chunks(STRIPS_PER_TASK).collect();
    let mut by_task: Vec<Vec<u32>> = vec![Vec::new(); tasks.len()];
    for (i, m) in members.iter().enumerate() {
        let first = strips.partition_point(|s| s.middle <= m.corners[0].y) / STRIPS_PER_TASK;
        let last = strips.partition_point(|s| s.middle < m.corners[2].y).div_ceil(STRIPS_PER_TASK);
        for own in by_task.iter_mut().take(last).skip(first) {
            own.push(i as u32);
        }
    }
    let parts: Vec<Coverage> = tasks
        .par_iter()
        .zip(&by_task)
        .map(|(strips, own)| {
            let own: Vec<&Member> = own.iter().map(|&i| &members[i as usize]).collect();
            let mut line = Line::new(&own);
            let mut sum = Coverage::default();
            for strip in *strips {
                sum.add(line.measure(&own, strip.middle), strip.height);
            }
            sum
        })
        .collect();
    let mut whole = Coverage::default();
    for part in parts {
        whole.add(part, 1.0);
    }
    whole
}

/// Strips between the heights of all vertices, cut so that none is high; evenly spaced where that would cost too much.
fn strips(members: &[Member]) -> Vec<Strip> {
    let heights: f64 = members.iter().map(|m| m.corners[2].y - m.corners[0].y).sum();
    let mut levels: Vec<f64> = members.iter().flat_map(|m| m.corners.map(|c| c.y)).collect();
    levels.sort_unstable_by(f64::total_cmp);
    levels.dedup();
    let (low, high) = (levels[0], levels[levels.len() - 1]);
    let mean_active = (heights / (high - low)).max(1.0);
    let affordable = (BUDGET / mean_active).max(64.0);
    let step = (high - low) / LINES.min(affordable);
    if members.len() <= SMALL_GROUP {
        // With the crossings too there is nothing between the levels but straight lines: no strip need be cut.
        add_crossings(members, &mut levels);
        let middle = |w: &[f64]| Strip { middle: 0.5 * (w[0] + w[1]), height: w[1] - w[0] };
        return levels.windows(2).map(middle).collect();
    }
    if levels.len() as f64 + LINES > affordable {
        levels = vec![low, high];
    }
    let step = if levels.len() == 2 { (high - low) / affordable.min(16.0 * LINES) } else { step };
    let mut strips = Vec::new();
    for pair in levels.windows(2) {
        let count = ((pair[1] - pair[0]) / step).ceil().max(1.0) as usize;
        let height = (pair[1] - pair[0]) / count as f64;
        strips.extend((0..count).map(|i| Strip { middle: pair[0] + (i as f64 + 0.5) * height, height }));
    }
    strips
}

/// Adds the heights at which edges cross.
fn add_crossings(members: &[Member], levels: &mut Vec<f64>) {
    let edges: Vec<[DVec2; 2]> =
        members.iter().flat_map(|m| (0..3).map(|k| [m.corners[k], m.corners[(k + 1) % 3]])).collect();
    for (i, &[p, q]) in edges.iter().enumerate() {
        for &[r, s] in &edges[i + 1..] {
            let (d, e) = (q - p, s - r);
            let t = (r - p).perp_dot(e) / d.perp_dot(e);
            let u = (r - p).perp_dot(d) / d.perp_dot(e);
            if t > 0.0 && t < 1.0 && u > 0.0 && u < 1.0 {
                levels.push(p.y + t * d.y);
            }
        }
    }
    levels.sort_unstable_by(f64::total_cmp);
    levels.dedup();
}

/// Scans lines; counts by chart and by cluster are kept dense over the charts of one task.
struct Line {
    /// (x, +1 or -1, position of the chart in `charts`).
    events: Vec<(f64, i32, u32)>,
    /// Position of each member's chart.
    chart_of: Vec<u32>,
    /// Cluster position by chart position.
    cluster_of: Vec<u32>,
    in_chart: Vec<i32>,
    in_cluster: Vec<i32>,
}

impl Line {
    fn new(members: &[&Member]) -> Self {
        let charts: Vec<(u32, u32)> = sorted_unique(members.iter().map(|m| (m.chart, m.cluster)));
        let clusters: Vec<u32> = sorted_unique(charts.iter().map(|c| c.1));
        Line {
            events: Vec::new(),
            chart_of: members.iter().map(|m| charts.partition_point(|c| c.0 < m.chart) as u32).collect(),
            cluster_of: charts.iter().map(|c| clusters.partition_point(|x| *x < c.1) as u32).collect(),
            in_chart: vec![0; charts.len()],
            in_cluster: vec![0; clusters.len()],
        }
    }

    /// Lengths on the line at height `y`; `covered` and `by_charts` less the sum of all lengths.
    fn measure(&mut self, members: &[&Member], y: f64) -> Coverage {
        self.events.clear();
        for (m, &chart) in members.iter().zip(&self.chart_of) {
            if let Some((x0, x1)) = m.span(y) {
                self.events.push((x0, 1, chart));
                self.events.push((x1, -1, chart));
            }
        }
        self.events.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)).then(a.2.cmp(&b.2)));
        let mut lengths = Coverage::default();
        // Faces, charts, clusters, charts covering twice, clusters with several charts, at the moment.
        let (mut faces, mut charts, mut clusters, mut doubled, mut stacks) = (0, 0, 0, 0, 0);
        let mut last = 0.0;
        for &(x, step, chart) in &self.events {
            if faces > 1 {
                let length = x - last;
                lengths.covered -= length * f64::from(faces - 1);
                lengths.by_charts -= length * f64::from(faces - charts);
                lengths.accidental += if doubled > 0 || clusters > 1 { length } else { 0.0 };
                lengths.stacked += if stacks > 0 { length } else { 0.0 };
            }
            last = x;
            faces += step;
            let own = &mut self.in_chart[chart as usize];
            let before = *own;
            *own += step;
            doubled += i32::from(*own > 1) - i32::from(before > 1);
            let turned = i32::from(*own > 0) - i32::from(before > 0);
            if turned != 0 {
                charts += turned;
                let group = &mut self.in_cluster[self.cluster_of[chart as usize] as usize];
                let before = *group;
                *group += turned;
                stacks += i32::from(*group > 1) - i32::from(before > 1);
                clusters += i32::from(*group > 0) - i32::from(before > 0);
            }
        }
        lengths
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::OverlapMode;
    use crate::atlas::testing::{Rng, join, sheet, soup};
    use crate::atlas::{Topology, clusters};

    fn measured(atlas: &Atlas, mode: OverlapMode) -> Coverage {
        let charts = Charts::new(&Topology::new(atlas));
        coverage(atlas, &charts, &clusters(atlas, &charts, mode))
    }

    #[test]
    fn stacks_and_accidents_are_told_apart() {
        let one = sheet(4, 4, DVec2::ZERO);
        let three = join(&join(&one, &sheet(4, 4, DVec2::new(3.0, 0.0))), &sheet(2, 4, DVec2::new(20.0, 1.0)));
        let stacked = measured(&three, OverlapMode::Stack);
        let expected = Coverage { covered: 36.0, by_charts: 40.0, accidental: 0.0, stacked: 4.0 };
        for (a, b) in [(stacked.covered, expected.covered), (stacked.by_charts, 40.0), (stacked.stacked, 4.0)] {
            assert!((a - b).abs() < 1e-9, "{stacked:?}");
        }
        assert_eq!(stacked.accidental, 0.0);
        let apart = measured(&three, OverlapMode::Separate);
        assert!((apart.accidental - 4.0).abs() < 1e-9 && apart.stacked == 0.0, "{apart:?}");
    }

    #[test]
    fn few_faces_are_measured_without_error() {
        // Two triangles whose edges cross where no corner is: a star of David with twelve twelfths, six of them shared.
        let side =
            |turn: f64| [0.0, 1.0, 2.0].map(|k| DVec2::from_angle(turn + k * std::f64::consts::TAU / 3.0) * 30.0);
        let found = measured(&soup(&[side(0.3), side(0.3 + std::f64::consts::PI)]), OverlapMode::Stack);
        let one = 0.75 * 3f64.sqrt() * 900.0;
        assert!((found.covered / (one * 4.0 / 3.0) - 1.0).abs() < 1e-12, "{found:?}");
        assert!((found.stacked / (one * 2.0 / 3.0) - 1.0).abs() < 1e-12, "{found:?}");
    }

    #[test]
    fn a_chart_over_itself_counts_once() {
        let mut folded = sheet(4, 2, DVec2::ZERO);
        for uv in &mut folded.uv {
            uv.x = 2.0 - (uv.x - 2.0).abs();
        }
        let found = measured(&folded, OverlapMode::Stack);
        assert!((found.covered - 4.0).abs() < 1e-9 && (found.by_charts - 4.0).abs() < 1e-9, "{found:?}");
        assert!((found.accidental - 4.0).abs() < 1e-9 && found.stacked == 0.0, "{found:?}");
    }

    #[test]
    fn the_union_of_a_heap_is_that_of_many_lines() {
        let mut rng = Rng(5);
        for size in [10.0, 60.0] {
            let triangles: Vec<[DVec2; 3]> = (0..100)
                .map(|_| {
                    let p = rng.point(100.0);
                    [p, p + rng.point(size), p - rng.point(size)]
                })
                .collect();
            let found = measured(&soup(&triangles), OverlapMode::Stack).covered;
            // Many lines through the whole heap, on each the union of the triangles' spans.
            let lines = 40_000;
            let step = (100.0 + 2.0 * size) / f64::from(lines);
            let mut brute = 0.0;
            for line in 0..lines {
                let y = (f64::from(line) + 0.5) * step - size;
                let cut = |t: &[DVec2; 3]| {
                    let edges = (0..3).map(|k| (t[k], t[(k + 1) % 3])).filter(|(p, q)| (p.y < y) != (q.y < y));
                    let xs: Vec<f64> = edges.map(|(p, q)| p.x + (q.x - p.x) * (y - p.y) / (q.y - p.y)).collect();
                    (xs.len() == 2).then(|| (xs[0].min(xs[1]), xs[0].max(xs[1])))
                };
                let mut spans: Vec<(f64, f64)> = triangles.iter().filter_map(cut).collect();
                spans.sort_by(|a, b| a.0.total_cmp(&b.0));
                let mut end = f64::NEG_INFINITY;
                for (x0, x1) in spans {
                    brute += (x1 - x0.max(end)).max(0.0) * step;
                    end = end.max(x1);
                }
            }
            assert!((found / brute - 1.0).abs() < 2e-6, "{found} against {brute}");
        }
    }
}
