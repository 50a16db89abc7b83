//! Grid-preserving coordinates for the merged charts (section 4.5).
//!
//! Packing keeps texels whole by moving charts in whole texels and quarter turns. So each chart is put where the larger part of its
//! surface that was only moved lies as it did in the input, and packing takes it from there.

use glam::DVec2;
use rayon::prelude::*;

use super::attempt::new_overlap;
use super::mesh::{MergeChart, MergeMesh, mirror, sign};
use super::sheet_limit::SheetLimit;
use crate::atlas::bvh::Bounds;
use crate::atlas::groups::sorted_unique;
use crate::atlas::rigid::{Rigid, back, nearest_quarter_turn, on_multiples};
use crate::atlas::{Atlas, triangle_area};
use crate::refine::stage::SheetInfo;

/// How far corners may lie from whole texels to be put there: resampling counts less than this as none.
const WHOLE: f64 = 5e-4;

/// How often single faces are left out that would overlap others there, before their chart is.
const APART_ROUNDS: usize = 4;

/// Charts grow by no more than this.
const MOST_GROWTH: f64 = 1.25;

/// The atlas, with charts ready for packing.
pub(super) struct PlacedCharts {
    /// Charts may overlap: pack it before use.
    pub atlas: Atlas,
    /// By chart of `atlas` (numbered by smallest face): whether its texels are resampled anyway.
    pub free: Vec<bool>,
    /// 3D area that keeps its texels / all of it.
    pub preserved: f64,
}

/// Puts each chart where the part of its input that was moved only, and is largest in 3D, lies as it did; not where that is under
/// `least` of the chart's 3D area. Without `whole_texels` nothing is.
pub(super) fn place(
    mesh: &MergeMesh,
    before: &Atlas,
    least: f64,
    sheet_info: &SheetInfo,
    limit: Option<SheetLimit>,
    whole_texels: bool,
) -> PlacedCharts {
    let unit = f64::from(sheet_info.unit);
    let charts = mesh.charts();
    let mut motion = vec![Rigid::IDENTITY; charts.len()];
    let mut exact = vec![false; mesh.faces().len()];
    let mut free = vec![true; charts.len()];
    // Charts most of which was mirrored are mirrored back.
    let mut mirrored = vec![false; charts.len()];
    let mut preserved = 0.0;
    let mut total = 0.0;
    for (c, chart) in charts.iter().enumerate().filter(|(_, c)| !c.faces.is_empty()) {
        let area: f64 = chart.faces.iter().map(|&f| mesh.area[f as usize]).sum();
        total += area;
        mirrored[c] = mesh.mirrored[chart.main_part as usize];
        if !whole_texels {
            continue;
        }
        let Some(part) = largest_moved_part(mesh, chart, unit) else { continue };
        if part.area < least * area {
            continue;
        }
        preserved += part.area;
        mirrored[c] = part.mirrored;
        free[c] = false;
        motion[c] = back(&part.motion);
        part.faces.iter().for_each(|&f| exact[f as usize] = true);
    }
    let mut at = positions_apart(mesh, &motion, &mut exact, unit);
    // Charts that were not touched, and those that are not finite, stay bit for bit.
    let touched: Vec<bool> = charts.iter().map(|c| c.parts.len() > 1 || !c.changes.is_empty()).collect();
    let free: Vec<bool> = free.iter().zip(&touched).map(|(free, touched)| *free && *touched).collect();
    enlarge(mesh, &free, limit, &mut at);
    let mut seen = vec![false; charts.len()];
    let mut in_order = Vec::new();
    for c in mesh.faces().map(|f| mesh.chart_of(f) as usize) {
        if !std::mem::replace(&mut seen[c], true) {
            in_order.push(free[c]);
        }
    }
    let atlas = mesh.to_atlas(before, |f| {
        let (c, own) = (mesh.chart_of(f) as usize, mesh.triangle(f));
        let corners = mesh.corners(f);
        let now = if touched[c] { [0, 1, 2].map(|k| at[corners[k] as usize].unwrap_or(own[k])) } else { own };
        if mirrored[c] { now.map(mirror) } else { now }
    });
    PlacedCharts { atlas, free: in_order, preserved: preserved / f64::max(total, 1e-300) }
}

/// Faces of a chart that were only moved, all alike up to whole texels and quarter turns.
struct MovedPart {
    motion: Rigid,
    mirrored: bool,
    /// In 3D.
    area: f64,
    faces: Vec<u32>,
}

/// The largest such part of a chart: faces are grouped by their chart of the input, and those by motion.
fn largest_moved_part(mesh: &MergeMesh, chart: &MergeChart, unit: f64) -> Option<MovedPart> {
    let undeformed = chart.faces.iter().filter(|&&f| !mesh.deformed[f as usize]);
    let mut faces: Vec<(u32, u32)> = undeformed.map(|&f| (mesh.source[f as usize], f)).collect();
    faces.sort_unstable();
    // The first of a part stands for it.
    let mut parts: Vec<MovedPart> = Vec::new();
    for own in faces.chunk_by(|a, b| a.0 == b.0) {
        let source = own[0].0 as usize;
        let (motion, mirrored) = (mesh.motion[source], mesh.mirrored[source]);
        let faces: Vec<u32> = own.iter().map(|o| o.1).filter(|&f| is_moved(mesh, f)).collect();
        let area: f64 = faces.iter().map(|&f| mesh.area[f as usize]).sum();
        let Some(&face) = faces.first() else { continue };
        let sample = &mesh.rest[face as usize];
        let alike = |part: &&mut MovedPart| part.mirrored == mirrored && on_grid(&part.motion, &motion, sample, unit);
        match parts.iter_mut().find(alike) {
            Some(part) => {
                part.area += area;
                part.faces.extend(faces);
            }
            None => parts.push(MovedPart { motion, mirrored, area, faces }),
        }
    }
    parts.into_iter().reduce(|a, b| if b.area > a.area { b } else { a })
}

/// [`positions`], with fewer `exact` faces where that brings together what merging held apart: faces that go to whole texels go there by a little, and
/// those beside them in the chart, of other charts in the input, do not.
fn positions_apart(mesh: &MergeMesh, motion: &[Rigid], exact: &mut [bool], unit: f64) -> Vec<Option<DVec2>> {
    let mut at = positions(mesh, motion, exact, unit);
    for round in 0..=APART_ROUNDS {
        let found = brought_together(mesh, motion, &at);
        if found.is_empty() {
            break;
        }
        let leave = |exact: &mut [bool], f: u32| exact[f as usize] = false;
        for f in found {
            if round == APART_ROUNDS {
                // As merging left it, the whole chart is in order.
                mesh.chart(mesh.chart_of(f)).faces.iter().for_each(|f| leave(exact, *f));
            } else {
                mesh.corners(f).into_iter().flat_map(|u| mesh.star(u)).for_each(|f| leave(exact, f));
            }
        }
        at = positions(mesh, motion, exact, unit);
    }
    at
}

/// Faces that overlap others of their chart or have turned over where these vertices lie, and did not where merging left them.
fn brought_together(mesh: &MergeMesh, motion: &[Rigid], at: &[Option<DVec2>]) -> Vec<u32> {
    let placed = |f: u32, back: &Rigid| {
        let own = mesh.triangle(f);
        let corners = mesh.corners(f);
        [0, 1, 2].map(|k| at[corners[k] as usize].map_or(own[k], |p| back.transform_point2(p)))
    };
    let of_chart = |chart: &MergeChart| -> Vec<u32> {
        let Some(&first) = chart.faces.first() else { return Vec::new() };
        let back = back(&motion[mesh.chart_of(first) as usize]);
        let mut found = Vec::new();
        for &f in &chart.faces {
            let (own, now) = (mesh.triangle(f), placed(f, &back));
            if own.iter().zip(&now).all(|(p, q)| p.distance(*q) <= mesh.tolerance) {
                continue;
            }
            if sign(&now) != sign(&own) {
                found.push(f);
            }
            let bounds = Bounds::of(&now);
            let near = Bounds { min: bounds.min - 2.0 * WHOLE, max: bounds.max + 2.0 * WHOLE };
            chart.grid.query(&near, &chart.faces, |g| {
                if g != f && new_overlap(mesh, f, &now, g, &placed(g, &back)) {
                    found.extend([f, g]);
                }
                true
            });
        }
        found
    };
    sorted_unique(mesh.charts().par_iter().flat_map_iter(of_chart).collect::<Vec<u32>>())
}

/// By UV vertex: where it lies once its chart moved by `motion`. Vertices of faces that keep their texels lie exactly where they did, by
/// whole texels and quarter turns.
fn positions(mesh: &MergeMesh, motion: &[Rigid], exact: &[bool], unit: f64) -> Vec<Option<DVec2>> {
    let mut at: Vec<Option<DVec2>> = vec![None; mesh.vertex_count()];
    for f in mesh.faces().filter(|&f| exact[f as usize]) {
        let own = motion[mesh.chart_of(f) as usize] * mesh.motion[mesh.source[f as usize] as usize];
        let whole = whole(&own, unit);
        for (u, p) in mesh.corners(f).into_iter().zip(mesh.rest[f as usize]) {
            at[u as usize].get_or_insert(whole.transform_point2(p));
        }
    }
    for (u, at) in (0..).zip(&mut at) {
        if at.is_none()
            && let Some(f) = mesh.star(u).next()
        {
            *at = Some(motion[mesh.chart_of(f) as usize].transform_point2(mesh.uv(u)));
        }
    }
    at
}

/// What is resampled anyway gets as many texels as it had: seams that were pulled together made it smaller. It stays within the limit.
/// `at` is by UV vertex.
fn enlarge(mesh: &MergeMesh, free: &[bool], limit: Option<SheetLimit>, at: &mut [Option<DVec2>]) {
    let charts = mesh.charts();
    let mut scale: Vec<f64> =
        charts.iter().zip(free).map(|(c, free)| if *free { growth(mesh, &c.faces) } else { 1.0 }).collect();
    // Nor is the usual texel coarser: the faces that lost most are not all in charts that grew.
    let density = |f: u32, t: &[DVec2; 3]| triangle_area(t) / mesh.area[f as usize];
    let scaled = |f: u32, u: u32| at[u as usize].unwrap_or(mesh.uv(u)) * scale[mesh.chart_of(f) as usize];
    let before = median(mesh.faces().map(|f| density(f, &mesh.rest[f as usize])).collect());
    let now = median(mesh.faces().map(|f| density(f, &mesh.corners(f).map(|u| scaled(f, u)))).collect());
    let lost = (before / now).sqrt();
    if lost > 1.0 && lost < MOST_GROWTH {
        scale.iter_mut().zip(free).filter(|(_, free)| **free).for_each(|(s, _)| *s *= lost);
    }
    if let Some(limit) = limit {
        for (chart, scale) in charts.iter().zip(&mut scale).filter(|(_, s)| **s > 1.0) {
            let lies = chart.faces.iter().flat_map(|&f| mesh.corners(f)).filter_map(|u| at[u as usize]);
            *scale = scale.min(limit.growth(Bounds::around(lies).size()).max(1.0));
        }
    }
    for (u, at) in (0..).zip(at) {
        if let (Some(at), Some(f)) = (at, mesh.star(u).next()) {
            *at *= scale[mesh.chart_of(f) as usize];
        }
    }
}

/// By how much the faces must grow in both directions to cover as many texels as in the input; never less than one.
fn growth(mesh: &MergeMesh, faces: &[u32]) -> f64 {
    let before: f64 = faces.iter().map(|&f| triangle_area(&mesh.rest[f as usize])).sum();
    let now: f64 = faces.iter().map(|&f| triangle_area(&mesh.triangle(f))).sum();
    let grown = (before / now).sqrt();
    if grown.is_finite() { grown.clamp(1.0, MOST_GROWTH) } else { 1.0 }
}

/// The median of those that are finite; NaN where none is.
fn median(mut values: Vec<f64>) -> f64 {
    values.retain(|v| v.is_finite());
    let middle = values.len() / 2;
    if values.is_empty() { f64::NAN } else { *values.select_nth_unstable_by(middle, f64::total_cmp).1 }
}

/// Whether a face lies where its chart of the input was moved.
fn is_moved(mesh: &MergeMesh, face: u32) -> bool {
    let motion = &mesh.motion[mesh.source[face as usize] as usize];
    mesh.triangle(face)
        .iter()
        .zip(&mesh.rest[face as usize])
        .all(|(p, q)| motion.transform_point2(*q).distance(*p) <= WHOLE)
}

/// Whether two motions differ by quarter turns and whole units, at the place of a face.
fn on_grid(a: &Rigid, b: &Rigid, rest: &[DVec2; 3], unit: f64) -> bool {
    let relative = back(a) * *b;
    let whole = whole(&relative, unit);
    rest.iter().all(|p| relative.transform_point2(*p).distance(whole.transform_point2(*p)) <= WHOLE)
}

/// The motion by quarter turns and whole units that is nearest.
fn whole(motion: &Rigid, unit: f64) -> Rigid {
    on_multiples(nearest_quarter_turn(motion), motion.translation, unit)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::testing::{cut_open, sheet};
    use crate::atlas::{Charts, HalfEdge, Topology};

    #[test]
    fn whole_texels_do_not_close_a_slit_that_is_narrower_than_they_move() {
        let whole = sheet(2, 2, DVec2::ZERO);
        let at = |h: HalfEdge| whole.uv[whole.corners[h.face().index()][h.corner()].index()];
        let is_slit = |h: &HalfEdge| [at(*h), at(h.next())].iter().all(|p| p.x == 1.0 && p.y >= 1.0);
        let slit: Vec<HalfEdge> = Topology::new(&whole).half_edges().filter(is_slit).collect();
        let mut open = cut_open(&whole, &slit);
        // The corner on the right of the slit is a little apart from that on the left.
        let top: Vec<usize> = (0..open.uv.len()).filter(|u| open.uv[*u] == DVec2::new(1.0, 2.0)).collect();
        assert_eq!(top.len(), 2);
        let middle = |u: usize| {
            let own = open.faces().filter(|f| open.corners[f.index()].iter().any(|c| c.index() == u));
            own.map(|f| open.uv_triangle(f).iter().map(|p| p.x).sum::<f64>()).sum::<f64>()
        };
        let (left, right) = if middle(top[0]) < middle(top[1]) { (top[0], top[1]) } else { (top[1], top[0]) };
        open.uv[right].x += 1e-5;
        let charts = Charts::new(&Topology::new(&open));
        let mesh = MergeMesh::new(&open, &charts, &[true], true);
        let motion = [Rigid::IDENTITY];
        let mut to: Vec<Option<DVec2>> = (0..mesh.vertex_count()).map(|u| Some(mesh.uv(u as u32))).collect();
        assert!(brought_together(&mesh, &motion, &to).is_empty());
        to[left].as_mut().unwrap().x += 0.8 * WHOLE;
        let found = brought_together(&mesh, &motion, &to);
        assert!(!found.is_empty());
        // The faces on both sides are named, and with them whatever goes to whole texels there.
        for side in [left, right] {
            assert!(found.iter().any(|f| mesh.corners(*f).contains(&(side as u32))), "{found:?}");
        }
    }
}
