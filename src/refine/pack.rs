//! The stage `pack`: the charts as they are, placed better.

use glam::DVec2;
use rayon::prelude::*;
use serde_json::{Map, Value};

use super::options::{Options, Weighed};
use super::refinement::NOT_SMALLER;
use super::stage::{SheetInfo, Stage, StageInput, Staged};
use crate::asset::lcm;
use crate::atlas::{
    Atlas, ChartId, Charts, Clusters, HalfEdge, Move, OverlapMode, Topology, clusters, overlapping_charts,
};
use crate::error::{Code, Failure, Result, Warning};
use crate::packing::{self, InitialLayout, Packing, Piece, Request, Rounding, Spacing};
use crate::packing::{Grid, Pack, Rotation};
use crate::texture::{BASIS_BLOCK, Overflow, Size};

/// Quarter-turned charts of mipmapped textures keep to multiples of this many texels, so that mip levels 1 and 2 stay as they were.
const MIP_LATTICE: u32 = 4;
/// Of the charts' area, what may be spent to keep the blocks of JPEG files whole, and those of KTX2 files, which lose more.
const BLOCKS_COST: f64 = 0.02;
const KTX2_BLOCKS_COST: f64 = 0.1;

impl Stage for Pack {
    const NAME: &'static str = "pack";
    const DESCRIPTION: &'static str = "Places the charts as they are, better.";
    const WEIGHT: f64 = 2.0;
    const SHARED: bool = true;

    fn run(&self, input: &StageInput<'_>) -> Result<Staged> {
        pack(input)
    }
}

/// Packs the charts, or the clusters of charts that share texels, on new sheets.
///
/// # Errors
/// `too_large` when a chart fits on no sheet, `canceled`.
pub fn pack(input: &StageInput<'_>) -> Result<Staged> {
    let (next, work) = lay_out(input, &[], &[], 1.0)?;
    let figures = Map::from_iter([("work".to_owned(), Value::from(work))]);
    Ok(finished(input, next, "done", figures))
}

/// What a stage gives back: its result or, with a warning, the input again, where the result has more pixels and nothing else speaks for it.
pub(super) fn finished(
    input: &StageInput<'_>,
    result: Atlas,
    stopped_by: &'static str,
    figures: Map<String, Value>,
) -> Staged {
    if !keeps_input(input, &result) {
        return Staged { atlas: result, stopped_by, figures, kept: false };
    }
    let text = format!(
        "the sheet of atlas {} would become larger: it stays as it was (set atlas.if_larger to \"accept\" to take the result)",
        input.sheet_info.id
    );
    input.context.warn(Warning::new("kept_input", text));
    Staged { atlas: input.atlas.clone(), stopped_by: NOT_SMALLER, figures, kept: true }
}

/// Packs the charts, or the clusters of charts, on new sheets, and gives the work that it took. `starts` are layouts of the clusters in
/// order for the thorough search to start from; `effort` multiplies its budget. `free` says by chart whether its texels are resampled
/// anyway, so that it may turn by any angle where rotation is `quarter`; a cluster may where all its charts may. Empty, none may.
///
/// # Errors
/// `too_large` when a chart fits on no sheet, `canceled`.
pub(super) fn lay_out(
    input: &StageInput<'_>,
    starts: &[InitialLayout],
    free: &[bool],
    effort: f64,
) -> Result<(Atlas, u64)> {
    let StageInput { atlas, sheet_info, options, context, .. } = *input;
    let topology = Topology::new(atlas);
    let charts = Charts::new(&topology);
    let together = clusters(atlas, &charts, options.atlas.overlaps);
    context.step(0.02, "outlining charts")?;
    let is_free = |own: &[ChartId]| own.iter().all(|c| free.get(c.index()).is_some_and(|free| *free));
    let by_half = |own: &[ChartId]| {
        sheet_info.turns_by_half(atlas, own.iter().flat_map(|c| charts.faces[c.index()].iter().copied()))
    };
    let outlined = |own: &Vec<ChartId>| Piece {
        free: is_free(own),
        half_turns: by_half(own),
        ..piece(atlas, &topology, &charts, own)
    };
    let pieces: Vec<Piece> = together.charts.par_iter().map(outlined).collect();
    let starts = if starts.iter().all(|s| s.places.len() == pieces.len()) { starts } else { &[] };
    let packed = place(&pieces, input, starts, effort)?;
    Ok((apply(atlas, &charts, &together, &packed), packed.work))
}

/// Whether the result has more pixels than the input and nothing else speaks for it.
fn keeps_input(input: &StageInput<'_>, after: &Atlas) -> bool {
    let StageInput { atlas: before, sheet_info, options, .. } = *input;
    options.weighed().contains(&Weighed::Pixels)
        && !sheet_info.is_virtual
        && !sheet_info.joined
        && after.pixels() > before.pixels()
        // Charts that were to be pulled apart need room of their own.
        && (options.atlas.overlaps == OverlapMode::Stack || overlapping_charts(before, &Charts::new(&Topology::new(before))).is_empty())
}

fn piece(atlas: &Atlas, topology: &Topology, charts: &Charts, own: &[ChartId]) -> Piece {
    let mut piece = Piece::default();
    for face in own.iter().flat_map(|c| &charts.faces[c.index()]) {
        let triangle = atlas.uv_triangle(*face);
        piece.area += atlas.uv_area(*face).abs();
        for k in 0..3 {
            if topology.is_border(HalfEdge::of(*face, k)) {
                piece.border.push(triangle[(k + 1) % 3] - triangle[k]);
            }
        }
        piece.triangles.push(triangle);
    }
    piece
}

/// The finest steps that charts may move by, in texels of the smallest slot.
fn finest_grid(sheet_info: &SheetInfo, pack: &Pack) -> u32 {
    let asked = match pack.grid {
        Grid::Texels(n) => n,
        Grid::Auto => 1,
    };
    if sheet_info.mipmaps && !sheet_info.is_virtual {
        asked.max(MIP_LATTICE.min(sheet_info.gutter(pack).max(1)))
    } else {
        asked
    }
}

/// Steps that charts move by, in texels of the smallest slot. Of the blocks of JPEG and KTX2 files, or of a half where chroma has half the
/// resolution, those that cost little: a chart that keeps to steps of n texels takes about n / 2 more of them on either axis.
fn grid(sheet_info: &SheetInfo, options: &Options, pieces: &[Piece]) -> u32 {
    let fine = finest_grid(sheet_info, &options.pack);
    if options.pack.grid != Grid::Auto || !options.texture.format.keeps_blocks() {
        return fine;
    }
    let unit = f64::from(sheet_info.unit);
    let (max, _) = sides(sheet_info, options);
    let (mut area, mut around, mut longest) = (0.0, 0.0, 0.0f64);
    for piece in pieces {
        let corners = || piece.triangles.iter().flatten();
        let low = corners().fold(DVec2::INFINITY, |low, p| low.min(*p));
        let high = corners().fold(DVec2::NEG_INFINITY, |high, p| high.max(*p));
        let extent = (high - low).max(DVec2::ZERO);
        area += piece.area;
        around += extent.element_sum();
        longest = longest.max(extent.max_element());
    }
    let cost = if sheet_info.block == BASIS_BLOCK { KTX2_BLOCKS_COST } else { BLOCKS_COST };
    let cheap = |n: u32| {
        let step = f64::from(n.saturating_sub(fine)) * unit;
        n > fine && around * step / 2.0 <= cost * area && longest + 4.0 * f64::from(n) * unit <= max
    };
    [sheet_info.block, sheet_info.block / 2]
        .into_iter()
        .find(|n| (*n >= 8 || *n == sheet_info.block) && cheap(*n))
        .unwrap_or(fine)
}

/// What the options and the slots' sizes ask of packing; charts move by `grid` texels of the smallest slot.
fn spacing(sheet_info: &SheetInfo, pack: &Pack, grid: u32, scaled: bool) -> Spacing {
    let unit = f64::from(sheet_info.unit);
    let gutter = f64::from(sheet_info.gutter(pack)) * unit;
    let margin = if gutter > 0.0 { (gutter / unit / 2.0).ceil().max(1.0) * unit } else { 0.0 };
    if pack.rotation == Rotation::Any || scaled {
        return Spacing { gutter, margin, lattice: None, unit };
    }
    // Cells divide the lattice by a power of two: an odd factor goes into the cell.
    let twos = 1 << grid.trailing_zeros().min(6);
    let unit = unit * f64::from(grid / twos);
    let lattice = unit * f64::from(twos);
    Spacing { gutter, margin: (margin / lattice).ceil() * lattice, lattice: Some(lattice), unit }
}

/// The longest side that a sheet may have, and what sides are rounded to.
pub(super) fn sides(sheet_info: &SheetInfo, options: &Options) -> (f64, Rounding) {
    let texture = &options.texture;
    // The smallest slot, too, is made of whole blocks.
    let blocks = if sheet_info.basis || texture.format.asks_for_ktx2() { BASIS_BLOCK } else { 1 };
    let step = f64::from(lcm(texture.multiple_of, sheet_info.unit.saturating_mul(blocks)).unwrap_or(u32::MAX));
    let round = match (sheet_info.is_virtual, texture.power_of_two) {
        (true, true) => Rounding::PowerOfTwo(1.0),
        (true, false) => Rounding::MultipleOf(1.0),
        (false, true) => Rounding::PowerOfTwo(step),
        (false, false) => Rounding::MultipleOf(step),
    };
    ((f64::from(texture.max_size) / step).floor().max(1.0) * step, round)
}

/// Sides, the longer first, of the largest chart that has a sheet to lie on as it is; none where charts are scaled to a sheet whatever
/// their size.
pub(super) fn largest_chart(sheet_info: &SheetInfo, options: &Options) -> Option<[f64; 2]> {
    if options.texture.size != Size::KeepDensity || options.texture.overflow != Overflow::Pages {
        return None;
    }
    let (max, round) = sides(sheet_info, options);
    let grid = finest_grid(sheet_info, &options.pack);
    let Spacing { gutter, margin, lattice, unit } = spacing(sheet_info, &options.pack, grid, false);
    let lost = 2.0 * (margin.max(gutter) + lattice.unwrap_or(unit));
    let largest = largest_sheet(max, round, options.pack.aspect);
    let [width, height] = largest.map(|side| (side - lost) / options.texture.scale);
    Some([width.max(height), width.min(height)])
}

fn place(pieces: &[Piece], input: &StageInput<'_>, starts: &[InitialLayout], effort: f64) -> Result<Packing> {
    let StageInput { sheet_info, options, context, .. } = *input;
    let texture = &options.texture;
    let (max, round) = sides(sheet_info, options);
    let request = Request {
        pieces,
        rotation: options.pack.rotation,
        mirror: options.pack.mirror,
        spacing: spacing(sheet_info, &options.pack, grid(sheet_info, options, pieces), texture.scale != 1.0),
        aspect: options.pack.aspect,
        max: [max; 2],
        round,
        scale: texture.scale,
        search: options.pack.search,
        work_budget: options.work_budget,
        starts,
        effort,
    };
    let fitted = |sheet: [f64; 2], largest: f64| -> Result<Packing> {
        let request = Request { spacing: spacing(sheet_info, &options.pack, 1, true), ..request.clone() };
        match packing::pack_into(&request, sheet, largest, context)? {
            Some(fitted) => Ok(fitted.packing),
            None => {
                let [width, height] = sheet;
                let text = format!(
                    "the charts and their gutters do not fit on a sheet of {width} x {height} texels at any scale: take a larger texture.size or a smaller pack.gutter"
                );
                Err(Failure::new(Code::TooLarge, text).at("/texture/size"))
            }
        }
    };
    match texture.size {
        Size::KeepSize => return fitted(sheet_info.reference.map(f64::from), f64::INFINITY),
        Size::Fixed(size) => return fitted(size.map(f64::from), f64::INFINITY),
        Size::KeepDensity => {}
    }
    match packing::pack(&request, context) {
        Ok(packing) if packing.sheets.len() == 1 || texture.overflow == Overflow::Pages => Ok(packing),
        Err(failure) if failure.code != Code::TooLarge => Err(failure),
        _ => {
            let (id, side) = (sheet_info.id, texture.max_size);
            let text = format!(
                "the charts of atlas {id} are scaled down to fit on a sheet of {side} texels, and lose detail (a larger texture.max_size, or texture.overflow \"pages\", keeps it)"
            );
            context.warn(Warning::new("scaled_to_fit", text));
            fitted(largest_sheet(request.max[0], request.round, request.aspect), 1.0)
        }
    }
}

/// The largest sheet with sides up to `max` that rounding allows, of about the aspect (width / height) that is asked for.
fn largest_sheet(max: f64, round: Rounding, aspect: Option<f64>) -> [f64; 2] {
    let down = |side: f64| {
        let up = round.up(side);
        let step = match round {
            Rounding::Free => 0.0,
            Rounding::MultipleOf(m) => m,
            Rounding::PowerOfTwo(_) => up / 2.0,
        };
        // A side that is smaller than the smallest allowed one becomes that.
        if up > side + 1e-9 && up > step { round.up(up - step) } else { up }
    };
    let aspect = aspect.unwrap_or(1.0);
    [max * aspect.min(1.0), max / aspect.max(1.0)].map(down)
}

fn apply(atlas: &Atlas, charts: &Charts, together: &Clusters, packed: &Packing) -> Atlas {
    let moves: Vec<Move> =
        charts.ids().map(|chart| packed.placements[together.of_chart[chart.index()] as usize]).collect();
    let sheets = packed.sheets.iter().map(|s| s.map(|side| side.round().max(1.0) as u32)).collect();
    let mut next = atlas.moved(charts, &moves, sheets);
    // What lies on the sheet's edge must not leave it by a rounding error.
    for uv in &mut next.uv {
        *uv = uv.max(DVec2::ZERO);
    }
    next
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_largest_sheet_keeps_to_rounding_and_aspect() {
        let multiple = Rounding::MultipleOf(12.0);
        assert_eq!(largest_sheet(1008.0, multiple, None), [1008.0, 1008.0]);
        assert_eq!(largest_sheet(1008.0, multiple, Some(2.5)), [1008.0, 396.0]);
        assert_eq!(largest_sheet(1008.0, multiple, Some(0.01)), [12.0, 1008.0]);
        let power = Rounding::PowerOfTwo(4.0);
        assert_eq!(largest_sheet(1000.0, power, None), [512.0, 512.0]);
        assert_eq!(largest_sheet(1024.0, power, Some(0.5)), [512.0, 1024.0]);
    }
}
