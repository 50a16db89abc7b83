//! A job from uploaded files to a refined model, its report and its pictures: read, stages, bake, write, report.

use serde_json::Value;

use super::deliver::deliver;
use super::group::Member;
use super::load::{Loaded, load};
use super::options::{Container, Options, Weighed};
use super::recipe::Step;
use super::refinement::{Refinement, Rounded, STAGE_REVERTED};
use super::report::report;
use super::textures::{Images, bake_slots, has_grown};
use super::write::write;
use crate::asset::{File, Limits};
use crate::context::Context;
use crate::error::{Failure, Result, Warning};
use crate::metrics::{RefinementOutcome, Verdict, judge};

/// What comes in.
#[derive(Debug, Clone, Default)]
pub struct Input {
    /// Files of each model, the model first. Several models share their atlases.
    pub models: Vec<Vec<File>>,
    /// What is refused as too large.
    pub limits: Limits,
    /// Whether textures and pictures are wanted as files of their own, an archive of all that, and the preview that a page draws.
    pub extras: bool,
}

/// A file of the result.
#[derive(Debug, Clone)]
pub struct Artifact {
    /// File name.
    pub name: String,
    /// `model`, `side_file`, `report`, `texture`, `picture`, `fabrication`, `archive` or `preview`.
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
    /// What became of all that came in.
    pub outcome: RefinementOutcome,
    /// What it fails its job for.
    pub verdict: Verdict,
}

/// Measures every atlas of the models as they are; nothing is written. Gives the report, where `before` and `after` are the same.
///
/// # Errors
/// Those of the input: see [`Code`](crate::error::Code).
pub fn inspect(input: &Input, options: &Options, context: &Context) -> Result<Value> {
    Ok(inspect_and_judge(input, options, context)?.0)
}

/// [`inspect`], and the requirements and warnings that the model fails for.
///
/// # Errors
/// Those of the input, and `invalid_options` for an unknown path in `require`.
pub fn inspect_and_judge(input: &Input, options: &Options, context: &Context) -> Result<(Value, Verdict)> {
    context.plan(&[("read", 2.0), ("measure", 1.0)]);
    context.enter(0);
    let loaded = load(input, options, false, context)?;
    context.enter(1);
    let report = report(&loaded, &loaded.untouched(), false, context)?;
    let verdict = judge(&report, &options.require, &options.strict, context.warning_counts())?;
    context.finish();
    Ok((serde_json::to_value(&report).map_err(|e| Failure::internal(e.to_string()))?, verdict))
}

/// Runs the recipe on the models. The texture sets of several models become one Atlas, those without images another.
///
/// # Errors
/// Those of the input and the options: see [`Code`](crate::error::Code); `canceled`.
pub fn refine(input: &Input, options: &Options, context: &Context) -> Result<Outcome> {
    let outcome = Run::new(input, options, context).walk()?;
    // Users get the last good state; whoever tests a stage shall hear of it.
    debug_assert!(context.warnings().iter().all(|w| w.code != STAGE_REVERTED), "{:?}", context.warnings());
    Ok(outcome)
}

/// A job on its way through its phases. Each phase has a type for what it leaves to the next.
pub(super) struct Run<'a> {
    input: &'a Input,
    options: &'a Options,
    context: &'a Context,
    /// The stages of the recipe.
    steps: Vec<Step>,
}

/// What the stages leave: every Atlas as the last of them left it, and the images that are needed first, decoded while the stages ran.
type Refined<'a> = (Vec<Refinement<'a>>, Option<Images<'a>>);

impl<'a> Run<'a> {
    pub(super) fn new(input: &'a Input, options: &'a Options, context: &'a Context) -> Self {
        Run { input, options, context, steps: options.steps() }
    }

    /// All phases, one after the other.
    pub(super) fn walk(&self) -> Result<Outcome> {
        let mut plan = vec![("read", 1.0)];
        plan.extend(self.steps.iter().map(|step| (step.stage.name(), step.stage.weight())));
        plan.extend([("bake", 2.0), ("write", 1.0)]);
        self.context.plan(&plan);

        self.context.enter(0);
        let loaded = load(self.input, self.options, true, self.context)?;
        let refined = self.stages(&loaded)?;
        self.context.enter(1 + self.steps.len());
        let baked = self.bake(&loaded, refined)?;
        self.context.enter(2 + self.steps.len());
        // Where textures are files of their own, side files are these.
        let named = self.input.extras && self.options.output.container == Container::Gltf;
        let written = write(&loaded, baked, named, self.context)?;
        let outcome = deliver(self.input, self.options, &loaded, written, self.context)?;
        self.context.finish();
        Ok(outcome)
    }

    fn images<'l>(&self, loaded: &'l Loaded, refinement: &Refinement<'l>) -> Images<'l> {
        Images::new(loaded, refinement.group, self.input.limits.max_image_pixels)
    }

    fn stages<'l>(&self, loaded: &'l Loaded) -> Result<Refined<'l>> {
        let mut refinements = loaded.untouched();
        // Stages leave threads idle, and decoders use one.
        let first = refinements.first().map(|refinement| self.images(loaded, refinement));
        let mut run_stages = || {
            for (n, step) in self.steps.iter().enumerate() {
                self.context.enter(1 + n);
                // A stage that reads UVs leaves surfaces that have none.
                let takes = |r: &&mut Refinement<'_>| r.atlas.has_layout() || !step.stage.needs_layout();
                for refinement in refinements.iter_mut().filter(takes) {
                    refinement.apply(step, self.options, self.context)?;
                }
            }
            Ok(())
        };
        let (done, images) = rayon::join(&mut run_stages, || first.map(|images| images.begun(self.context)));
        done.map(|()| (refinements, images))
    }

    /// Gives every Atlas its textures.
    fn bake<'l>(&self, loaded: &'l Loaded, (mut refinements, images): Refined<'l>) -> Result<Vec<Refinement<'l>>> {
        let mut begun = images.filter(|_| refinements.first().is_some_and(|r| !r.kept));
        let count = refinements.len();
        for (n, r) in refinements.iter_mut().enumerate().filter(|(_, r)| !r.kept) {
            let progress = |fraction: f64| (n as f64 + fraction) / count as f64;
            let images = begun.take().filter(|_| n == 0).unwrap_or_else(|| self.images(loaded, r));
            let of = |m: &Member| &loaded.models[m.model].doc;
            let mut rounded = None;
            if r.group.members.iter().any(|m| of(m).is_compressed(self.options.output.compression)) {
                rounded = r.rounded(self.context)?;
            }
            let layouts = [&r.atlas, rounded.as_ref().map_or(&r.atlas, |rounded| &rounded.atlas)];
            r.slots = bake_slots(images, layouts, &self.options.texture, self.context, &progress)?;
            if let Some(Rounded { atlas, step }) = rounded {
                (r.atlas, r.step) = (atlas, step);
            }
            // Pixels were weighed when the charts were packed.
            let weighed = self.options.weighed().iter().filter(|w| **w != Weighed::Pixels && !r.group.is_joined());
            if let Some(what) = weighed.copied().find(|what| has_grown(loaded, r.group, &r.slots, *what)) {
                let (id, what) = (r.group.set().id, what.told());
                let text = format!(
                    "the textures of atlas {id} would take more {what}: it stays as it was (set atlas.if_larger to \"accept\" to take the result)"
                );
                self.context.warn(Warning::new("kept_input", text));
                r.keep_input();
            }
            r.slots.iter_mut().flat_map(|slot| slot.warnings.drain(..)).for_each(|warning| self.context.warn(warning));
        }
        Ok(refinements)
    }
}
