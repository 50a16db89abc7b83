//! Grid-preserving coordinates for the merged charts (section 4.5).
//!
//! Packing keeps texels whole by moving charts in whole texels and quarter turns. So each chart is put where the larger part of its
//! surface that was only moved lies as it did in the input, and packing takes it from there.

use glam::DVec2;

use super::mesh::{Mesh, mirror};
use super::room::Room;
use crate::atlas::Atlas;
use crate::atlas::bvh::Bounds;
use crate::atlas::rigid::Rigid;
use crate::refine::stage::SheetInfo;

/// How far corners may lie from whole texels to be put there: resampling counts less than this as none.
const WHOLE: f64 = 5e-4;

/// Charts grow by no more than this.
const MOST_GROWTH: f64 = 1.25;

/// The atlas, with charts ready for packing.
pub(super) struct Placed {
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
    mesh: Mesh,
    before: &Atlas,
    least: f64,
    sheet_info: &SheetInfo,
    room: Option<Room>,
    whole_texels: bool,
) -> Placed {
    let unit = f64::from(sheet_info.unit);
    let mut motion = vec![Rigid::IDENTITY; mesh.charts.len()];
    let mut exact = vec![false; mesh.corners.len()];
    let mut free = vec![true; mesh.charts.len()];
    // Charts most of which was mirrored are mirrored back.
    let mut mirrored = vec![false; mesh.charts.len()];
    let mut preserved = 0.0;
    let mut total = 0.0;
    for (c, chart) in mesh.charts.iter().enumerate().filter(|(_, c)| !c.faces.is_empty()) {
        let area: f64 = chart.faces.iter().map(|&f| mesh.area[f as usize]).sum();
        total += area;
        mirrored[c] = mesh.mirrored[chart.main as usize];
        if !whole_texels {
            continue;
        }
        // Area that was only moved, by chart of the input.
        let mut moved: Vec<(u32, f64, Vec<u32>)> = Vec::new();
        let mut faces: Vec<(u32, u32)> =
            chart.faces.iter().filter(|&&f| !mesh.deformed[f as usize]).map(|&f| (mesh.home[f as usize], f)).collect();
        faces.sort_unstable();
        for own in faces.chunk_by(|a, b| a.0 == b.0) {
            let home = own[0].0;
            let there: Vec<u32> = own.iter().map(|o| o.1).filter(|&f| is_moved(&mesh, f)).collect();
            let area = there.iter().map(|&f| mesh.area[f as usize]).sum();
            moved.push((home, area, there));
        }
        // Groups by motion, up to whole texels and quarter turns: the first of a group stands for it.
        let mut groups: Vec<(Rigid, f64, Vec<usize>)> = Vec::new();
        for (i, (home, area, there)) in moved.iter().enumerate() {
            let own = mesh.motion[*home as usize];
            let Some(&face) = there.first() else { continue };
            let sample = mesh.rest[face as usize];
            let alike = |g: &&mut (Rigid, f64, Vec<usize>)| {
                mesh.mirrored[moved[g.2[0]].0 as usize] == mesh.mirrored[*home as usize]
                    && on_grid(&g.0, &own, &sample, unit)
            };
            match groups.iter_mut().find(alike) {
                Some(group) => {
                    group.1 += area;
                    group.2.push(i);
                }
                None => groups.push((own, *area, vec![i])),
            }
        }
        let Some(best) = groups.into_iter().reduce(|a, b| if b.1 > a.1 { b } else { a }) else { continue };
        if best.1 < least * area {
            continue;
        }
        preserved += best.1;
        mirrored[c] = mesh.mirrored[moved[best.2[0]].0 as usize];
        free[c] = false;
        motion[c] = best.0.inverse();
        for (_, _, there) in best.2.into_iter().map(|i| &moved[i]) {
            there.iter().for_each(|&f| exact[f as usize] = true);
        }
    }
    // Vertices of faces that keep their texels lie exactly where they did, by whole texels and quarter turns.
    let mut at: Vec<Option<DVec2>> = vec![None; mesh.uv.len()];
    for f in (0..mesh.corners.len()).filter(|&f| exact[f]) {
        let own = motion[mesh.chart_of[f] as usize].after(&mesh.motion[mesh.home[f] as usize]);
        let whole = whole(&own, unit);
        for (u, p) in mesh.corners[f].iter().zip(mesh.rest[f]) {
            at[*u as usize].get_or_insert(whole.apply(p));
        }
    }
    for (u, at) in at.iter_mut().enumerate() {
        if at.is_none()
            && let Some(&f) = mesh.star[u].first()
        {
            *at = Some(motion[mesh.chart_of[f as usize] as usize].apply(mesh.uv[u]));
        }
    }
    // Charts that were not touched, and those that are not finite, stay bit for bit.
    let touched: Vec<bool> = mesh.charts.iter().map(|c| c.parts.len() > 1 || !c.changes.is_empty()).collect();
    let free: Vec<bool> = free.iter().zip(&touched).map(|(free, touched)| *free && *touched).collect();
    enlarge(&mesh, &free, room, &mut at);
    let mut seen = vec![false; mesh.charts.len()];
    let mut in_order = Vec::new();
    for &c in &mesh.chart_of {
        if !std::mem::replace(&mut seen[c as usize], true) {
            in_order.push(free[c as usize]);
        }
    }
    let (corners, chart_of) = (mesh.corners.clone(), mesh.chart_of.clone());
    let atlas = mesh.into_atlas(before, |f, own| {
        let c = chart_of[f as usize] as usize;
        let now =
            if touched[c] { [0, 1, 2].map(|k| at[corners[f as usize][k] as usize].unwrap_or(own[k])) } else { own };
        if mirrored[c] { now.map(mirror) } else { now }
    });
    Placed { atlas, free: in_order, preserved: preserved / f64::max(total, 1e-300) }
}

/// What is resampled anyway gets as many texels as it had: seams that were pulled together made it smaller. It stays within `room`. `at`
/// is by UV vertex.
fn enlarge(mesh: &Mesh, free: &[bool], room: Option<Room>, at: &mut [Option<DVec2>]) {
    let mut scale: Vec<f64> =
        mesh.charts.iter().zip(free).map(|(c, free)| if *free { growth(mesh, &c.faces) } else { 1.0 }).collect();
    // Nor is the usual texel coarser: the faces that lost most are not all in charts that grew.
    let density = |f: usize, t: [DVec2; 3]| area(t) / mesh.area[f];
    let scaled = |f: usize, u: u32| at[u as usize].unwrap_or(mesh.uv[u as usize]) * scale[mesh.chart_of[f] as usize];
    let faces = 0..mesh.corners.len();
    let before = median(faces.clone().map(|f| density(f, mesh.rest[f])).collect());
    let now = median(faces.map(|f| density(f, mesh.corners[f].map(|u| scaled(f, u)))).collect());
    let lost = (before / now).sqrt();
    if lost > 1.0 && lost < MOST_GROWTH {
        scale.iter_mut().zip(free).filter(|(_, free)| **free).for_each(|(s, _)| *s *= lost);
    }
    if let Some(room) = room {
        for (chart, scale) in mesh.charts.iter().zip(&mut scale).filter(|(_, s)| **s > 1.0) {
            let lies = chart.faces.iter().flat_map(|&f| mesh.corners[f as usize]).filter_map(|u| at[u as usize]);
            let bounds = lies.map(|p| Bounds::of(&[p])).fold(Bounds::EMPTY, Bounds::union);
            *scale = scale.min(room.growth(bounds.size()).max(1.0));
        }
    }
    for (at, star) in at.iter_mut().zip(&mesh.star) {
        if let (Some(at), Some(&f)) = (at, star.first()) {
            *at *= scale[mesh.chart_of[f as usize] as usize];
        }
    }
}

/// By how much the faces must grow in both directions to cover as many texels as in the input; never less than one.
fn growth(mesh: &Mesh, faces: &[u32]) -> f64 {
    let before: f64 = faces.iter().map(|&f| area(mesh.rest[f as usize])).sum();
    let now: f64 = faces.iter().map(|&f| area(mesh.triangle(f))).sum();
    let grown = (before / now).sqrt();
    if grown.is_finite() { grown.clamp(1.0, MOST_GROWTH) } else { 1.0 }
}

fn area(t: [DVec2; 3]) -> f64 {
    0.5 * (t[1] - t[0]).perp_dot(t[2] - t[0]).abs()
}

/// The median of those that are finite; NaN where none is.
fn median(mut values: Vec<f64>) -> f64 {
    values.retain(|v| v.is_finite());
    let middle = values.len() / 2;
    if values.is_empty() { f64::NAN } else { *values.select_nth_unstable_by(middle, f64::total_cmp).1 }
}

/// Whether a face lies where its chart of the input was moved.
fn is_moved(mesh: &Mesh, face: u32) -> bool {
    let motion = &mesh.motion[mesh.home[face as usize] as usize];
    mesh.triangle(face).iter().zip(&mesh.rest[face as usize]).all(|(p, q)| motion.apply(*q).distance(*p) <= WHOLE)
}

/// Whether two motions differ by quarter turns and whole units, at the place of a face.
fn on_grid(a: &Rigid, b: &Rigid, rest: &[DVec2; 3], unit: f64) -> bool {
    let relative = a.inverse().after(b);
    let whole = whole(&relative, unit);
    rest.iter().all(|p| relative.apply(*p).distance(whole.apply(*p)) <= WHOLE)
}

/// The motion by quarter turns and whole units that is nearest.
fn whole(motion: &Rigid, unit: f64) -> Rigid {
    let (cos, sin) =
        if motion.cos.abs() >= motion.sin.abs() { (motion.cos.signum(), 0.0) } else { (0.0, motion.sin.signum()) };
    Rigid { cos, sin, translate: (motion.translate / unit).round() * unit }
}
