//! What a stage is, and what every stage is given and gives back.

use serde_json::{Map, Value};

use super::importance::Importance;
use super::options::Options;
use crate::asset::TextureSet;
use crate::atlas::{Atlas, ChartId, Charts, Clusters, FaceId, OverlapMode};
use crate::context::Context;
use crate::error::{Result, Warning};
use crate::packing::{Gutter, Pack};
use crate::params::Params;
use crate::texture::{Format, Slot};

/// An algorithm from Atlas to Atlas. It is its parameters; all that is known of it elsewhere (options, recipes, command line, HTTP,
/// progress, report) follows from this and from its line in the table of stages.
pub trait Stage: Params {
    /// The name in options, reports and progress, in snake case.
    const NAME: &'static str;
    /// What it does, in one sentence.
    const DESCRIPTION: &'static str;
    /// Expected share of a job's work; reading the model is 1.
    const WEIGHT: f64;
    /// Whether its parameters are the job's own, under the same name, because other stages heed them too. In a recipe it has none then.
    const SHARED: bool = false;
    /// Whether it reads the UVs of its input. One that does leaves surfaces without texture coordinates.
    const NEEDS_LAYOUT: bool = true;

    /// Whether faces of one chart may lie on each other in its result, because that was asked for: on sheets without images, where nothing is shown twice.
    fn may_overlap(&self) -> bool {
        false
    }

    /// Refines the Atlas.
    ///
    /// # Errors
    /// `too_large` when a chart fits on no sheet, `canceled`.
    fn run(&self, input: &StageInput<'_>) -> Result<Staged>;
}

/// What a stage is given beside its parameters.
#[derive(Clone, Copy)]
pub struct StageInput<'a> {
    /// The Atlas as the stage before left it.
    pub atlas: &'a Atlas,
    /// What may be known of its images.
    pub sheet_info: &'a SheetInfo,
    /// Which parts of its surface matter more, where the options say so.
    pub importance: Option<&'a Importance>,
    /// The job's options.
    pub options: &'a Options,
    /// Progress, cancellation, seed and clock.
    pub context: &'a Context,
}

impl StageInput<'_> {
    /// Charts of the input that share texels on purpose, as `together` has them, or that must not be turned but by a half.
    pub fn held_back(&self, charts: &Charts, together: &Clusters) -> Vec<bool> {
        let by_half = |c: ChartId| self.sheet_info.turns_by_half(self.atlas, charts.faces[c.index()].iter().copied());
        let is_shared = |c: ChartId| together.charts[together.of_chart[c.index()] as usize].len() > 1;
        charts.ids().map(|c| is_shared(c) || by_half(c)).collect()
    }

    /// The weights at the corners of each face, where the options give weights.
    pub fn corner_weights(&self) -> Option<Vec<[f64; 3]>> {
        self.importance.map(|importance| self.atlas.provenance.iter().map(|p| importance.at(p)).collect())
    }
}

/// The warning that charts are left out by a stage: `part` of the `what` (surface, UV area) is not `done` (cut, merged).
pub(super) fn held_back_warning(input: &StageInput<'_>, part: f64, what: &str, done: &str) -> Warning {
    let (id, percent) = (input.sheet_info.id, 100.0 * part);
    // Of very little is not told that it is nothing.
    let percent = if percent < 0.05 { "less than 0.1".to_owned() } else { format!("{percent:.1}") };
    let tangents = match input.sheet_info.half_turns.is_empty() {
        true => "",
        false => {
            ", or have tangents that are not perpendicular to their normals (compute them anew, by MikkTSpace, to have these charts refined too)"
        }
    };
    let text = match input.options.atlas.overlaps {
        OverlapMode::Stack => format!(
            "{percent} % of the {what} of atlas {id} is not {done}: its charts show the same texels as others (mirrored or repeated parts) or lie on themselves{tangents}, and keep their shape. Set atlas.overlaps to \"separate\" to give each texels of its own, which takes more of them"
        ),
        OverlapMode::Separate => format!(
            "{percent} % of the {what} of atlas {id} is not {done}: its charts lie on themselves{tangents}. Set box_cutter.remove_overlaps to true, or lay them out anew with the recipe unwrap"
        ),
    };
    Warning::new("held_back", text)
}

/// What a stage may know of an Atlas' images: sizes and filtering, not contents.
#[derive(Debug, Clone, PartialEq)]
pub struct SheetInfo {
    /// Number of the texture set.
    pub id: usize,
    /// Size of the reference sheet as uploaded.
    pub reference: [u32; 2],
    /// Reference texels along a texel of the smallest slot, rounded up to a multiple at which every slot's texels are
    /// whole where there is one.
    pub unit: u32,
    /// Whether any image is read through mipmaps.
    pub mipmaps: bool,
    /// Whether there are no images at all.
    pub is_virtual: bool,
    /// Side of the blocks that files are encoded by, the largest of all slots, in texels of the smallest slot; 1 where there are none.
    pub block: u32,
    /// Whether some slot was uploaded as KTX2: its sheets are made of whole blocks.
    pub basis: bool,
    /// Whether any primitive is skinned or morphed, or so far from the origin that 32 bits hold no points between its vertices: it is better cut along edges.
    pub along_edges: bool,
    /// Whether any image holds directions, which mirroring turns round.
    pub directions: bool,
    /// Whether several texture sets share the Atlas: that is a gain in itself.
    pub joined: bool,
    /// By face as uploaded, whether it shall be turned by a half only: it reads directions through tangents that no other turn can be
    /// given to. Empty where there is no such face.
    pub half_turns: Vec<bool>,
}

/// Share of a chart's area from which faces that shall be turned by a half only speak for the chart.
const HALF_TURNS: f64 = 0.01;

impl SheetInfo {
    /// What is known of a texture set's sheet.
    pub fn new(set: &TextureSet) -> Self {
        let ratio = |slot: &Slot| {
            let along =
                |side: usize, size: u32| (f64::from(set.reference[side]) / f64::from(size.max(1)) - 1e-9).ceil() as u32;
            along(0, slot.header.width).max(along(1, slot.header.height))
        };
        let slots = || set.slots.iter().filter(|s| !s.exempt && !crate::asset::is_small(s, set.reference));
        let smallest = slots().map(ratio).max().unwrap_or(1).max(1);
        // Beyond 64 texels a common grid costs more than resampling the odd slot.
        let unit = match set.grid {
            Some([x, y]) if x.max(y) <= 64 && x.max(y) % x.min(y).max(1) == 0 => x.max(y).max(smallest),
            _ => smallest,
        };
        let block = slots().map(|slot| (slot.block * ratio(slot)).div_ceil(unit)).max().unwrap_or(1);
        SheetInfo {
            id: set.id,
            reference: set.reference,
            unit,
            block,
            basis: slots().any(|s| s.header.format == Format::Ktx2),
            mipmaps: slots().any(|s| s.mipmaps),
            is_virtual: set.slots.is_empty(),
            along_edges: set.primitives.iter().any(|p| p.along_edges),
            directions: set.slots.iter().any(|s| s.role.is_direction()),
            joined: false,
            half_turns: half_turns(set),
        }
    }

    /// Whether some faces, which are placed as one, shall be turned by a half only.
    pub fn turns_by_half(&self, atlas: &Atlas, faces: impl Iterator<Item = FaceId>) -> bool {
        if self.half_turns.is_empty() {
            return false;
        }
        let (mut all, mut half) = (0.0, 0.0);
        for face in faces {
            let area = atlas.uv_area(face).abs();
            all += area;
            let source = atlas.provenance[face.index()].source.index();
            half += if self.half_turns.get(source) == Some(&true) { area } else { 0.0 };
        }
        half > HALF_TURNS * all
    }

    /// Of a sheet without images, for tests.
    #[cfg(test)]
    pub(super) fn plain() -> Self {
        SheetInfo {
            id: 0,
            reference: [100, 100],
            unit: 1,
            block: 1,
            basis: false,
            mipmaps: false,
            is_virtual: true,
            along_edges: false,
            directions: false,
            joined: false,
            half_turns: Vec::new(),
        }
    }

    /// Gutter in texels of the smallest slot.
    pub fn gutter(&self, pack: &Pack) -> u32 {
        match pack.gutter {
            Gutter::Texels(n) => n,
            Gutter::Auto if self.mipmaps => 4,
            Gutter::Auto => 2,
        }
    }
}

/// By face as uploaded, whether its tangents can be turned by a half only and something is read through them; empty where none is.
fn half_turns(set: &TextureSet) -> Vec<bool> {
    let mut faces = Vec::new();
    for (p, primitive) in set.primitives.iter().enumerate().filter(|(_, p)| !p.oblique_tangents.is_empty()) {
        let reads = |s: &Slot| !s.exempt && s.role.is_direction() && s.primitives.contains(&(p as u32));
        if set.slots.iter().any(reads) {
            faces.resize(set.atlas.face_count(), false);
            let own = faces.iter_mut().skip(primitive.first_face).zip(&primitive.oblique_tangents);
            own.for_each(|(face, oblique)| *face = *oblique);
        }
    }
    faces
}

/// What a stage gives back.
#[derive(Debug, Clone)]
pub struct Staged {
    /// The Atlas after the stage.
    pub atlas: Atlas,
    /// Why the stage ended.
    pub stopped_by: &'static str,
    /// What the stage says of itself in the report; `work` is the units of work that its searches spent.
    pub figures: Map<String, Value>,
    /// Whether the Atlas is the stage's input.
    pub kept: bool,
}
