//! The parts on a sheet: boxes packed, and what becomes of them in the Atlas.

use std::collections::BTreeMap;

use glam::DVec2;

use super::chart_map::{WEIGHT, area, rest_triangle};
use super::construct::Constructed;
use super::layer::layer;
use super::prepare::{Labels, NO_DISK, boundary, had_area, rest_shape};
use super::reduce::PackedCharts;
use crate::atlas::bvh::Bounds;
use crate::atlas::groups::sorted_unique;
use crate::atlas::rounding::{Facing, STEPS, round_uvs};
use crate::atlas::{Atlas, Charts, FaceId, HalfEdge, Mesh, OverlapMode, Topology, clusters, coverage, orientation};
use crate::error::Warning;
use crate::numeric::dirichlet::RestTriangle;
use crate::numeric::repair::repair_inversions;
use crate::packing::{RectanglePacker, RectangleRequest, Rotation};
use crate::refine::pack::sides;
use crate::refine::stage::StageInput;
use crate::texture::Size;

/// Weight of the layer about charts, in units of its area's share.
const STIFF: f64 = 4.0;
/// Area of a face that is too small to be written, in parts of the mean, once it is widened.
const WIDENED: f64 = 1e-4;
/// How far edges of straight sides are from the axes, in parts of the box.
const STRAIGHT: f64 = 1e-6;
/// How much wider the layer is than it must be.
pub(super) const WIDER: f64 = 1.1;

/// A part of a chart, or what stays as it is.
#[derive(Debug, Clone)]
pub(super) struct Piece {
    pub faces: Vec<FaceId>,
    /// Whether it stays in its shape.
    pub is_rigid: bool,
    pub bounds: Bounds,
    /// Where its box lies, and whether it is turned by a quarter.
    pub at: DVec2,
    pub turned: bool,
}

impl Piece {
    fn new(mesh: &Mesh, faces: Vec<FaceId>, is_rigid: bool) -> Self {
        let bounds = Bounds::around(faces.iter().flat_map(|f| mesh.atlas().uv_triangle(*f)));
        Piece { faces, is_rigid, bounds, at: DVec2::ZERO, turned: false }
    }

    /// Sides of its box as it lies.
    fn size(&self) -> DVec2 {
        let own = self.bounds.size();
        if self.turned { DVec2::new(own.y, own.x) } else { own }
    }

    /// Where a place of it comes to lie.
    fn place(&self, p: DVec2) -> DVec2 {
        let own = p - self.bounds.min;
        let own = if self.turned { DVec2::new(self.bounds.size().y - own.y, own.x) } else { own };
        self.at + own
    }
}

/// All parts packed.
#[derive(Debug, Clone)]
pub(super) struct Packed {
    pub pieces: Vec<Piece>,
    pub charts: PackedCharts,
    /// By UV vertex: its vertex among the charts'.
    pub name: Vec<u32>,
}

/// Texels that must be free between two charts so that the gutter is: along an axis a texel more than the gutter has.
pub(super) fn gap(input: &StageInput<'_>) -> f64 {
    let unit = f64::from(input.sheet_info.unit);
    match input.sheet_info.gutter(&input.options.pack) {
        0 => 0.0,
        g => (f64::from(g) + 1.0) * unit,
    }
}

/// Aspect that the box should have: that of the sheet where there is one.
pub(super) fn aspect(input: &StageInput<'_>) -> Option<f64> {
    let of = |size: [u32; 2]| f64::from(size[0]) / f64::from(size[1]);
    match input.options.texture.size {
        Size::KeepSize => Some(of(input.sheet_info.reference)),
        Size::Fixed(size) => Some(of(size)),
        Size::KeepDensity if input.options.texture.power_of_two => Some(input.options.pack.aspect.unwrap_or(1.0)),
        Size::KeepDensity => input.options.pack.aspect,
    }
}

/// Whether parts may be turned by a quarter: all of them, as boxes know nothing of what is in them.
pub(super) fn turns(input: &StageInput<'_>) -> bool {
    input.options.pack.rotation != Rotation::None && input.sheet_info.half_turns.is_empty()
}

/// Packs the boxes about all parts, and about what stays as it is. `cluster` by uploaded face: what stays together is one; [`NO_DISK`] where a face is by itself.
pub(super) fn pack(
    mesh: &Mesh,
    labels: &Labels,
    constructed: &Constructed,
    cluster: &[u32],
    weights: Option<&[f64]>,
    [padding, gap]: [f64; 2],
    request: &RectangleRequest,
) -> Packed {
    let charts = Charts::new(mesh.topology());
    let mut pieces: Vec<Piece> = Vec::new();
    // What stays, by cluster; what is in none stays by itself.
    let mut rigid: BTreeMap<(u32, usize), Vec<FaceId>> = BTreeMap::new();
    for (c, faces) in charts.faces.into_iter().enumerate() {
        if labels.disk[faces[0].index()] == NO_DISK {
            let own = cluster[labels.origin[faces[0].index()].index()];
            rigid.entry((own, if own == NO_DISK { c } else { 0 })).or_default().extend(faces);
        } else {
            // What has turned over cannot be relaxed.
            let right = if constructed.info[labels.disk[faces[0].index()] as usize].reversed { -1 } else { 1 };
            let is_turned = |f: &FaceId| {
                let [a, b, c] = mesh.atlas().uv_triangle(*f);
                orientation(a, b, c) != right
            };
            let is_rigid = faces.iter().any(is_turned);
            pieces.push(Piece::new(mesh, faces, is_rigid));
        }
    }
    pieces.extend(rigid.into_values().map(|faces| Piece::new(mesh, faces, true)));
    let sizes: Vec<DVec2> = pieces.iter().map(|p| p.bounds.size() + padding).collect();
    if let Some(packing) = RectanglePacker::default().pack(&sizes, request) {
        for (piece, place) in pieces.iter_mut().zip(packing.places) {
            (piece.at, piece.turned) = (place.at + 0.5 * padding, place.turned);
        }
    }
    let (mut charts, mut name) = charts_of(mesh, labels, constructed, &pieces, weights, [padding, gap]);
    // Parts that lie on themselves keep their shape, so that there is a void about the others.
    if !charts.has_void() {
        for piece in pieces.iter_mut().filter(|p| !p.is_rigid) {
            let own = std::slice::from_ref(piece);
            let is_alone = charts_of(mesh, labels, constructed, own, weights, [padding, gap]).0.has_void();
            piece.is_rigid = !is_alone;
        }
        (charts, name) = charts_of(mesh, labels, constructed, &pieces, weights, [padding, gap]);
    }
    Packed { pieces, charts, name }
}

/// The parts that may change their shape, where they lie.
fn charts_of(
    mesh: &Mesh,
    labels: &Labels,
    constructed: &Constructed,
    pieces: &[Piece],
    weights: Option<&[f64]>,
    [padding, gap]: [f64; 2],
) -> (PackedCharts, Vec<u32>) {
    let atlas = mesh.atlas();
    let mut out = PackedCharts::default();
    let mut name = vec![u32::MAX; atlas.uv.len()];
    let own = || pieces.iter().filter(|p| !p.is_rigid);
    let info = |f: FaceId| &constructed.info[labels.disk[f.index()] as usize];
    let shape = |f: FaceId| rest_shape(atlas, &constructed.layout, labels, f, info(f), constructed.target);
    let total: f64 = own().flat_map(|p| &p.faces).filter_map(|f| shape(*f)).map(area).sum();
    out.rest_area = total;
    let count = own().map(|p| p.faces.len()).sum::<usize>().max(1);
    let mean = total / count as f64;
    for (piece, number) in own().zip(0..) {
        let reversed = info(piece.faces[0]).reversed;
        for &f in &piece.faces {
            let corners = atlas.corners[f.index()].map(|u| {
                let own = &mut name[u.index()];
                if *own == u32::MAX {
                    *own = out.x.len() as u32;
                    out.x.push(piece.place(atlas.uv[u.index()]));
                }
                *own
            });
            let rest = rest_triangle(shape(f), reversed, mean, total);
            // Every shape with an area has one.
            let Some(mut rest) = rest else { continue };
            rest.weight *= weights.map_or(1.0, |w| w[labels.origin[f.index()].index()]);
            out.triangles.push(if reversed { [corners[0], corners[2], corners[1]] } else { corners });
            out.rest.push(rest);
        }
        let own_vertices =
            || sorted_unique(piece.faces.iter().flat_map(|f| atlas.corners[f.index()]).map(|u| name[u.index()]));
        let Some(loop_) = boundary(mesh, &piece.faces) else {
            // No disk any more: it has its borders, and no layer.
            let all = piece.faces.iter().flat_map(|f| (0..3).map(|k| HalfEdge::of(*f, k)));
            for h in all.filter(|h| mesh.topology().is_border(*h)) {
                let [a, b] = mesh.uv_ends(h).map(|u| name[u.index()]);
                out.border.push(a);
                out.segments.push(([a, b], number));
                out.walls.push(if reversed { [b, a] } else { [a, b] });
            }
            if gap > 0.0 {
                out.still.extend(own_vertices());
            }
            continue;
        };
        let mut around: Vec<u32> = loop_.iter().map(|h| name[mesh.uv_at(*h).index()]).collect();
        if reversed {
            around.reverse();
        }
        let n = around.len();
        out.border.extend(&around);
        let edges = (0..n).map(|i| [around[i], around[(i + 1) % n]]);
        out.segments.extend(edges.clone().map(|e| (e, number)));
        let width = 0.5 * gap * WIDER;
        let points: Vec<DVec2> = around.iter().map(|v| out.x[*v as usize]).collect();
        // What was cut along edges has no straight sides to lay a layer about: the void itself keeps it apart.
        let has_layer = gap > 0.0 && is_aligned(&points);
        match has_layer.then(|| layer(&points, width)).flatten() {
            Some(made) => {
                let first = out.x.len() as u32;
                out.x.extend(&made.outer);
                let outer = |i: usize| first + made.of[i % n];
                for i in 0..n {
                    let (p, q) = (around[i], around[(i + 1) % n]);
                    let (a, b) = (outer(i), outer(i + 1));
                    let mut add = |corners: [u32; 3]| {
                        let own = corners.map(|v| out.x[v as usize]);
                        let weight = STIFF * WEIGHT * area(own).max(0.0) / total;
                        out.layer.extend(RestTriangle::new(own, weight).map(|rest| (corners, rest)));
                    };
                    if a != b {
                        add([p, a, b]);
                        out.walls.push([a, b]);
                    }
                    add([p, b, q]);
                }
            }
            None => {
                if has_layer {
                    out.still.extend(own_vertices());
                }
                out.walls.extend(edges);
            }
        }
    }
    for piece in pieces.iter().filter(|p| p.is_rigid) {
        let own = Bounds { min: piece.at, max: piece.at + piece.size() };
        out.fixed.push(own);
        // What has no width has a wall nevertheless.
        let margin = (0.5 * gap).max(0.1 * padding);
        out.fixed_walls.push(Bounds { min: own.min - margin, max: own.max + margin });
        let part = Atlas { page: vec![0; piece.faces.len()], ..atlas.subset(&piece.faces) };
        let charts = Charts::new(&Topology::new(&part));
        out.fixed_area += coverage(&part, &charts, &clusters(&part, &charts, OverlapMode::Separate)).covered;
    }
    out.apart = gap;
    (out, name)
}

/// Whether all edges of a loop run along the axes.
fn is_aligned(points: &[DVec2]) -> bool {
    let size = Bounds::around(points.iter().copied()).size().max_element();
    let edges = points.iter().zip(points.iter().cycle().skip(1));
    edges.map(|(a, b)| (*b - *a).abs().min_element()).all(|off| off <= STRAIGHT * size)
}

/// Gives small faces a little area, by moving vertices inside their charts; false where that is not possible.
pub(super) fn widen(packed: &mut Packed) -> bool {
    let charts = &mut packed.charts;
    let mut is_free = vec![true; charts.x.len()];
    charts.walls.iter().flatten().chain(&charts.border).for_each(|v| is_free[*v as usize] = false);
    let mean = charts.area() / charts.triangles.len().max(1) as f64;
    let areas = vec![mean; charts.triangles.len()];
    let mut x = charts.x.clone();
    let is_done = repair_inversions(&charts.triangles, &areas, &is_free, WIDENED, &mut x);
    if is_done {
        charts.x = x;
    }
    is_done
}

/// Rounds texture coordinates to what 32 bits hold; gives by disk whether it has a face that they cannot hold where its parts lie.
pub(super) fn round(
    atlas: &mut Atlas,
    mesh: &Mesh,
    labels: &Labels,
    constructed: &Constructed,
    packed: &Packed,
) -> Vec<bool> {
    let mut facing = vec![Facing::NotAgainst(0); atlas.face_count()];
    for piece in &packed.pieces {
        let own = |f: FaceId| {
            let [a, b, c] = atlas.uv_triangle(f);
            orientation(a, b, c)
        };
        let most = piece.faces.iter().map(|f| atlas.uv_area(*f)).sum::<f64>();
        for &f in &piece.faces {
            facing[f.index()] = match constructed.info.get(labels.disk[f.index()] as usize) {
                // What folds stays folded.
                None if own(f) != 0 => Facing::NotAgainst(own(f)),
                None => Facing::NotAgainst(if most < 0.0 { -1 } else { 1 }),
                Some(disk) => {
                    let right = if disk.reversed { -1 } else { 1 };
                    // What never had an area has none to lose.
                    let had = had_area(mesh.atlas(), &constructed.layout, labels, f);
                    if had { Facing::Like(right) } else { Facing::NotAgainst(right) }
                }
            };
        }
    }
    let mut out = vec![false; constructed.disks.len()];
    for f in round_uvs(atlas, &facing, STEPS) {
        // What stays as it is was so before.
        if let Some(own) = out.get_mut(labels.disk[f.index()] as usize) {
            *own = true;
        }
    }
    out
}

/// The Atlas with its parts where they have been packed, on a sheet of its own, and by what it had to be scaled for that.
pub(super) fn assemble(input: &StageInput<'_>, mesh: &Mesh, packed: &Packed) -> (Atlas, f64) {
    let mut next = mesh.atlas().clone();
    let bounds = packed.charts.bounds();
    let options = input.options;
    let unit = f64::from(input.sheet_info.unit);
    let gutter = f64::from(input.sheet_info.gutter(&options.pack));
    let margin = if gutter > 0.0 { (gutter / 2.0).ceil().max(1.0) * unit } else { 0.0 };
    let (scale, sheet) = sheet_size(input, bounds.size(), DVec2::splat(2.0 * margin));
    for piece in packed.pieces.iter().filter(|p| p.is_rigid) {
        for u in sorted_unique(piece.faces.iter().flat_map(|f| next.corners[f.index()])) {
            next.uv[u.index()] = piece.place(next.uv[u.index()]);
        }
    }
    for (uv, name) in next.uv.iter_mut().zip(&packed.name) {
        if *name != u32::MAX {
            *uv = packed.charts.x[*name as usize];
        }
    }
    for uv in &mut next.uv {
        *uv = ((*uv - bounds.min) * scale + margin).max(DVec2::ZERO);
    }
    next.page.fill(0);
    next.sheets = vec![sheet];
    next.drop_unused_uvs();
    (next, scale)
}

/// Scale of the layout and sides of its sheet, for a box of this size and what is to be free about it.
fn sheet_size(input: &StageInput<'_>, size: DVec2, room: DVec2) -> (f64, [u32; 2]) {
    let options = input.options;
    let fitted = |sheet: [f64; 2]| ((DVec2::from(sheet) - room).max(DVec2::ONE) / size).min_element();
    let whole = |sheet: [f64; 2]| sheet.map(|s| s.round().max(1.0) as u32);
    match options.texture.size {
        Size::KeepSize => {
            let sheet = input.sheet_info.reference.map(f64::from);
            return (fitted(sheet), whole(sheet));
        }
        Size::Fixed(size) => {
            let sheet = size.map(f64::from);
            return (fitted(sheet), whole(sheet));
        }
        Size::KeepDensity => {}
    }
    let (max, round) = sides(input.sheet_info, options);
    let sheet = (size + room).to_array().map(|s| round.up(s));
    if sheet[0] <= max && sheet[1] <= max {
        // What has no texels yet fills its sheet.
        let scale =
            if input.sheet_info.is_virtual && options.texture.power_of_two { fitted(sheet).max(1.0) } else { 1.0 };
        return (scale, whole(sheet));
    }
    let (id, side) = (input.sheet_info.id, options.texture.max_size);
    let text = format!(
        "the charts of atlas {id} are scaled down to fit on a sheet of {side} texels, and lose detail (a larger texture.max_size keeps it)"
    );
    input.context.warn(Warning::new("scaled_to_fit", text));
    let scale = fitted([max; 2]).min(1.0);
    let sheet = (size * scale + room).to_array().map(|s| round.up(s).min(max));
    (scale, whole(sheet))
}
