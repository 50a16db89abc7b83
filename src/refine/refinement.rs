//! One Atlas on its way through the stages of a recipe.

use serde_json::{Map, Value, json};

use super::give_back::give_back;
use super::group::Group;
use super::options::Options;
use super::pack::finished;
use super::recipe::Step;
use super::stage::{SheetInfo, StageInput, Staged};
use super::textures::BakedSlot;
use super::{check, fabrication};
use crate::atlas::rounding::{Facing, STEPS, round_uvs};
use crate::atlas::{Atlas, FaceId, orientation};
use crate::context::Context;
use crate::error::{Result, Warning};
use crate::metrics::{RefinementOutcome, StageReport};
use crate::packing::{Gutter, Pack};

/// Code of the warning that a stage broke an Atlas and was undone.
pub(super) const STAGE_REVERTED: &str = "stage_reverted";

/// Code of the warning that charts that a stage broke were given back.
const CHARTS_GIVEN_BACK: &str = "charts_given_back";

/// Why a stage ended whose result was not taken because it has too many pixels.
pub(super) const NOT_SMALLER: &str = "not_smaller";

/// Steps of the grid of texture coordinates in a texel, where geometry is compressed: what a 32nd of a texel changes in a picture is below the
/// rounding of 8 bits (66 dB on a scan), and each bit more costs a quarter of a byte for each vertex.
const STEPS_OF_A_TEXEL: f64 = 16.0;
/// Texels by which a texture coordinate may be moved: more than rounding needs, where a face would be turned over otherwise.
const MOST_MOVED: f64 = 0.25;
/// Steps along the side of a sheet, at least.
const LEAST_STEPS: f64 = 4096.0;

/// Figures of stages that say that a part of the surface was not refined.
const LEFT_AS_UPLOADED: [&str; 4] = ["held_back", "charts_given_back", "charts_kept", "pieces_reverted"];

/// One group of texture sets on its way through the recipe.
pub(super) struct Refinement<'a> {
    /// As read.
    pub group: &'a Group,
    /// As the last stage left it; as it was read back, once it is written.
    pub atlas: Atlas,
    /// Whether nothing has been changed so far: the sets stay as uploaded.
    pub kept: bool,
    /// Whether a part of it is as uploaded, or as it was before a stage that was undone.
    partly: bool,
    /// What the stages said.
    pub stages: Vec<StageReport>,
    /// The images, once they are baked.
    pub slots: Vec<BakedSlot>,
    /// Texels by which texture coordinates were rounded, at most.
    pub step: f64,
    /// Whether a stage was asked not to care for faces of one chart that lie on each other.
    pub self_overlaps: bool,
}

/// An Atlas with its texture coordinates on a grid.
pub(super) struct Rounded {
    pub atlas: Atlas,
    /// Texels from one place of the grid to the next.
    pub step: f64,
}

impl<'a> Refinement<'a> {
    /// Before any stage.
    pub fn untouched(group: &'a Group) -> Self {
        let atlas = group.set().atlas.clone();
        Refinement {
            group,
            atlas,
            kept: true,
            partly: false,
            stages: Vec::new(),
            slots: Vec::new(),
            step: 0.0,
            self_overlaps: false,
        }
    }

    /// What became of it.
    pub fn outcome(&self) -> RefinementOutcome {
        match (self.atlas.has_layout(), self.kept) {
            (false, _) => RefinementOutcome::NothingToRefine,
            (true, true) => RefinementOutcome::KeptInput,
            (true, false) if self.partly => RefinementOutcome::PartlyRefined,
            (true, false) => RefinementOutcome::Refined,
        }
    }

    /// Goes back to what was uploaded.
    pub fn keep_input(&mut self) {
        let mut stages = std::mem::take(&mut self.stages);
        stages.iter_mut().for_each(|stage| stage.stopped_by = NOT_SMALLER.to_owned());
        *self = Refinement { stages, ..Refinement::untouched(self.group) };
    }

    /// Runs a stage. A result that fails its check is not taken, nor one that had to be smaller and is not.
    ///
    /// # Errors
    /// Those of the stage, `canceled`.
    pub fn apply(&mut self, step: &Step, options: &Options, context: &Context) -> Result<()> {
        let set = self.group.set();
        let sheet_info = SheetInfo { joined: self.group.is_joined(), ..SheetInfo::new(set) };
        let roomy = self.with_room_for_panels(&sheet_info, options);
        let input = StageInput {
            atlas: &self.atlas,
            sheet_info: &sheet_info,
            importance: self.group.importance.as_ref(),
            options: roomy.as_ref().unwrap_or(options),
            context,
        };
        let Staged { mut atlas, mut stopped_by, mut figures, mut kept } = step.stage.run(&input)?;
        let name = step.stage.name();
        let self_overlaps = self.self_overlaps || step.stage.may_overlap() && sheet_info.is_virtual;
        if let Err(wrong) = check::violations(&set.atlas, &atlas, self_overlaps, context)? {
            let (id, what) = (sheet_info.id, check::told(&wrong));
            let Some(mended) = give_back(&input, &set.atlas, atlas, wrong, self_overlaps)? else {
                let message = format!(
                    "{name} was undone for atlas {id}, which is as it was before: its layout would be broken ({what}). The fault is Intarsia's, please report it with the model; another recipe or seed may do"
                );
                context.warn(Warning::new(STAGE_REVERTED, message));
                self.partly = true;
                self.ran(name, "reverted", figures);
                return Ok(());
            };
            let message = format!(
                "{} charts of atlas {id} keep their uploaded shape, packed with the rest: {name} would have broken them ({what}). The result is whole; another seed may spare them",
                mended.charts
            );
            context.warn(Warning::new(CHARTS_GIVEN_BACK, message));
            figures.insert("charts_given_back".to_owned(), json!(mended.charts));
            // Packed anew it may have become larger than it may be.
            Staged { atlas, stopped_by, figures, kept } = finished(&input, mended.atlas, stopped_by, figures);
        }
        if step.only_if_smaller && atlas.pixels() >= self.atlas.pixels() {
            self.ran(name, NOT_SMALLER, figures);
            return Ok(());
        }
        // A result that was not taken leaves the Atlas as it was, whatever it held back.
        let part = |key: &str| figures.get(key).and_then(Value::as_f64).is_some_and(|part| part > 0.0);
        self.partly |= !kept && LEFT_AS_UPLOADED.iter().any(|key| part(key));
        self.ran(name, stopped_by, figures);
        self.kept &= kept;
        self.atlas = atlas;
        self.self_overlaps = self_overlaps;
        Ok(())
    }

    /// The options with a gutter that holds what is drawn between panels: allowances and flaps. None where no panels are drawn.
    fn with_room_for_panels(&self, sheet_info: &SheetInfo, options: &Options) -> Option<Options> {
        let params = options.fabrication.as_ref()?;
        let wanted = fabrication::gutter_texels(&self.atlas, params).div_ceil(sheet_info.unit.max(1));
        let least = if options.pack.gutter == Gutter::Auto { 0 } else { sheet_info.gutter(&options.pack) };
        let gutter = Gutter::Texels(wanted.max(least));
        Some(Options { pack: Pack { gutter, ..options.pack.clone() }, ..options.clone() })
    }

    /// The Atlas with its texture coordinates on a grid that codecs of geometry keep exactly: what is delivered is then what is in memory. The finest
    /// grid of 32-bit floats stands in where a coarser one would turn faces over; none where that would do so too. Images are baked for the Atlas as it
    /// is: texels are copied by where charts were put, and are off by a part of a step only.
    ///
    /// # Errors
    /// `canceled`.
    pub fn rounded(&self, context: &Context) -> Result<Option<Rounded>> {
        let is_inside = |f: FaceId| {
            let [width, height] = self.atlas.sheets[usize::from(self.atlas.page[f.index()])].map(f64::from);
            self.atlas.uv_triangle(f).iter().all(|p| p.min_element() >= 0.0 && p.x <= width && p.y <= height)
        };
        if !self.atlas.has_layout() || !self.atlas.faces().all(is_inside) {
            return Ok(None);
        }
        let longest = self.atlas.sheets.iter().flatten().copied().max().unwrap_or(1);
        let facing: Vec<Facing> = self
            .atlas
            .faces()
            .map(|f| {
                let [a, b, c] = self.atlas.uv_triangle(f);
                match orientation(a, b, c) {
                    0 => Facing::NotAgainst(0),
                    sign => Facing::Like(sign),
                }
            })
            .collect();
        let mut steps = STEPS_OF_A_TEXEL * f64::from(longest.next_power_of_two());
        loop {
            steps = steps.clamp(LEAST_STEPS, STEPS);
            let mut atlas = self.atlas.clone();
            let is_whole = round_uvs(&mut atlas, &facing, steps).is_empty();
            let step = f64::from(longest) / steps;
            let is_close = || {
                let moved = self.atlas.uv.iter().zip(&atlas.uv).map(|(a, b)| (*a - *b).abs().max_element());
                moved.fold(0.0, f64::max) <= MOST_MOVED
            };
            if is_whole
                && is_close()
                && check::within(&self.group.set().atlas, &atlas, step, self.self_overlaps, context)?
            {
                return Ok(Some(Rounded { atlas, step }));
            }
            if steps >= STEPS {
                return Ok(None);
            }
            steps *= 4.0;
        }
    }

    /// Records that a stage ran.
    fn ran(&mut self, stage: &str, stopped_by: &str, figures: Map<String, Value>) {
        self.stages.push(StageReport {
            stage: stage.to_owned(),
            atlas_id: self.group.set().id as u64,
            stopped_by: stopped_by.to_owned(),
            figures,
        });
    }
}
