//! The recipe runner: from uploaded files to a refined model, its report and its pictures.

use serde_json::Value;

use super::box_cutter::box_cutter;
use super::defrag::defrag;
use super::deliver::deliver;
use super::load::load;
use super::options::{Options, Stage};
use super::report::{Refinement, report};
use super::stage::{SheetInfo, Staged};
use super::textures::{Images, bake_slots};
use super::{check, fabrication, pack};
use crate::asset::{File, Limits};
use crate::atlas::Atlas;
use crate::context::Context;
use crate::error::{Failure, Result, Warning};
use crate::metrics::{Unmet, unmet};
use crate::packing::{Gutter, Pack};

/// What comes in.
#[derive(Debug, Clone, Default)]
pub struct Input {
    /// Files of each model, the model first. Several models share their atlases.
    pub models: Vec<Vec<File>>,
    /// What is refused as too large.
    pub limits: Limits,
    /// Whether textures and pictures are wanted as files of their own, and an archive of everything.
    pub extras: bool,
}

/// A file of the result.
#[derive(Debug, Clone)]
pub struct Artifact {
    /// File name.
    pub name: String,
    /// `model`, `side_file`, `report`, `texture`, `picture`, `fabrication` or `archive`.
    pub role: String,
    /// Media type.
    pub media_type: String,
    /// Contents.
    pub bytes: Vec<u8>,
}

impl Artifact {
    pub(super) fn new(name: impl Into<String>, role: &str, media_type: &str, bytes: Vec<u8>) -> Self {
        Artifact { name: name.into(), role: role.to_owned(), media_type: media_type.to_owned(), bytes }
    }
}

/// What comes out.
#[derive(Debug, Clone)]
pub struct Outcome {
    /// Files.
    pub artifacts: Vec<Artifact>,
    /// The report.
    pub report: Value,
    /// Requirements that are not met.
    pub failures: Vec<Unmet>,
}

/// Measures every atlas of the models as they are; nothing is written. Gives the report, where `before` and `after` are the same.
///
/// # Errors
/// Those of the input: see [`Code`].
pub fn inspect(input: &Input, options: &Options, context: &Context) -> Result<Value> {
    Ok(inspect_and_judge(input, options, context)?.0)
}

/// [`inspect`], and the requirements that the model does not meet.
///
/// # Errors
/// Those of the input, and `invalid_options` for an unknown path in `require`.
pub fn inspect_and_judge(input: &Input, options: &Options, context: &Context) -> Result<(Value, Vec<Unmet>)> {
    context.plan(&[("read", 2.0), ("measure", 1.0)]);
    context.enter(0);
    let loaded = load(input, options, false, context)?;
    context.enter(1);
    let refinements: Vec<Refinement> = loaded.groups.iter().map(Refinement::untouched).collect();
    let report = report(&loaded, &refinements, false, context)?;
    let failures = unmet(&report, &options.require)?;
    context.finish();
    Ok((serde_json::to_value(&report).map_err(|e| Failure::internal(e.to_string()))?, failures))
}

/// Runs the recipe on the models. The texture sets of several models become one Atlas, those without images another.
///
/// # Errors
/// Those of the input and the options: see [`Code`]; `canceled`.
pub fn refine(input: &Input, options: &Options, context: &Context) -> Result<Outcome> {
    let stages = options.stages();
    let mut plan = vec![("read", 1.0)];
    plan.extend(stages.iter().map(|s| (s.name(), if matches!(s, Stage::Pack {}) { 2.0 } else { 8.0 })));
    plan.extend([("bake", 2.0), ("write", 1.0)]);
    context.plan(&plan);

    context.enter(0);
    let loaded = load(input, options, true, context)?;
    let mut refinements: Vec<Refinement> = loaded.groups.iter().map(Refinement::untouched).collect();
    let max_pixels = input.limits.max_image_pixels;
    let mut run_stages = || {
        for (n, stage) in stages.iter().enumerate() {
            context.enter(1 + n);
            // A stage that reads UVs leaves surfaces that have none.
            for refinement in refinements.iter_mut().filter(|r| r.atlas.has_layout()) {
                run_stage(stage, refinement, options, context)?;
            }
        }
        Ok::<(), Failure>(())
    };
    // Stages leave threads idle, and decoders use one.
    let images = |group| Images::new(&loaded, group, max_pixels);
    let begin = || loaded.groups.first().map(|group| images(group).begun(context));
    let (done, begun) = rayon::join(&mut run_stages, begin);
    done?;
    let mut begun = begun.filter(|_| refinements.first().is_some_and(|r| !r.kept));

    context.enter(1 + stages.len());
    let count = refinements.len();
    for (n, r) in refinements.iter_mut().enumerate().filter(|(_, r)| !r.kept) {
        let progress = |fraction: f64| (n as f64 + fraction) / count as f64;
        let images = begun.take().filter(|_| n == 0).unwrap_or_else(|| images(r.group));
        r.slots = bake_slots(images, &r.atlas, &options.texture, context, &progress)?;
    }

    context.enter(2 + stages.len());
    let outcome = deliver(input, options, &loaded, refinements, context)?;
    context.finish();
    Ok(outcome)
}

fn run_stage(stage: &Stage, refinement: &mut Refinement<'_>, options: &Options, context: &Context) -> Result<()> {
    let group = refinement.group;
    let sheet_info = SheetInfo { joined: group.is_joined(), ..SheetInfo::new(group.set()) };
    // Allowances and flaps lie between the panels.
    let roomy = options.fabrication.as_ref().map(|params| {
        let wanted = fabrication::gutter_texels(&refinement.atlas, params).div_ceil(sheet_info.unit.max(1));
        let gutter = Gutter::Texels(wanted.max(if options.pack.gutter == Gutter::Auto {
            0
        } else {
            sheet_info.gutter(&options.pack)
        }));
        Options { pack: Pack { gutter, ..options.pack.clone() }, ..options.clone() }
    });
    let options = roomy.as_ref().unwrap_or(options);
    let staged = match stage {
        Stage::Pack {} => pack::pack(&refinement.atlas, &sheet_info, options, context)?,
        Stage::Defrag(params) => defrag(&refinement.atlas, &sheet_info, params, options, context)?,
        Stage::BoxCutter(params) => {
            let weights: Option<Vec<[f64; 3]>> =
                group.importance.as_ref().map(|i| refinement.atlas.provenance.iter().map(|p| i.at(p)).collect());
            box_cutter(&refinement.atlas, &sheet_info, weights.as_deref(), params, options, context)?
        }
    };
    let Staged { atlas, stopped_by, figures, kept } = staged;
    if let Err(violation) = check::stage(&group.set().atlas, &atlas, context)? {
        debug_assert!(false, "{}: {violation}", stage.name());
        let message = format!("{} was undone for atlas {}: {violation}", stage.name(), sheet_info.id);
        context.warn(Warning::new("stage_reverted", message));
        refinement.ran(stage, "reverted", figures);
        return Ok(());
    }
    let pixels = |a: &Atlas| a.sheets.iter().map(|s| u64::from(s[0]) * u64::from(s[1])).sum::<u64>();
    if options.only_if_smaller(stage) && pixels(&atlas) >= pixels(&refinement.atlas) {
        refinement.ran(stage, "no_improvement", figures);
        return Ok(());
    }
    refinement.ran(stage, stopped_by, figures);
    refinement.kept &= kept;
    refinement.atlas = atlas;
    Ok(())
}
