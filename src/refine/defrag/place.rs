//! Grid-preserving coordinates for the merged charts (section 4.5).
//!
//! Packing keeps texels whole by moving charts in whole texels and quarter turns. So each chart is put where the larger part of its
//! surface that was only moved lies as it did in the input, and packing takes it from there.

use glam::DVec2;

use super::mesh::{MergeChart, MergeMesh, mirror};
use super::sheet_limit::SheetLimit;
use crate::atlas::bvh::Bounds;
use crate::atlas::rigid::{Rigid, back, nearest_quarter_turn, on_multiples};
use crate::atlas::{Atlas, triangle_area};
use crate::refine::stage::SheetInfo;

/// How far corners may lie from whole texels to be put there: resampling counts less than this as none.
const WHOLE: f64 = 5e-4;

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
    let mut at = positions(mesh, &motion, &exact, unit);
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
