//! The recipe runner: from uploaded files to a refined model, its report and its pictures.

use std::io::Write as _;

use serde_json::Value;

use super::options::{Options, Output, Recipe, Stage};
use super::report::{Refinement, report};
use super::stage::{Frame, Staged};
use super::textures::{BakedSlot, bake_slots, exempt_uniform};
use super::{check, pack};
use crate::asset::{self, BakedImage, Document, File, Limits, Refined, TextureSet};
use crate::atlas::Atlas;
use crate::context::Context;
use crate::error::{Code, Failure, Result, Warning};
use crate::metrics::{Unmet, picture, unmet};

/// Longest side of a picture, in pixels.
const PICTURE_SIDE: u32 = 1024;

/// What comes in.
#[derive(Debug, Clone, Default)]
pub struct Input {
    /// Files of each model; usually one.
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
    /// `model`, `side_file`, `report`, `texture`, `picture` or `archive`.
    pub role: String,
    /// Media type.
    pub media_type: String,
    /// Contents.
    pub bytes: Vec<u8>,
}

impl Artifact {
    fn new(name: impl Into<String>, role: &str, media_type: &str, bytes: Vec<u8>) -> Self {
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

/// The model as it came in: document and texture sets.
pub(super) struct Loaded {
    pub doc: Document,
    pub sets: Vec<TextureSet>,
    /// Bytes of all files.
    pub bytes: u64,
}

fn loaded(input: &Input, options: &Options, context: &Context) -> Result<Loaded> {
    let [files] = input.models.as_slice() else {
        let message = match input.models.len() {
            0 => "there is no model",
            _ => "several models in one job are not available in this version",
        };
        return Err(Failure::new(Code::InvalidRequest, message));
    };
    let bytes = files.iter().map(|f| f.bytes.len() as u64).sum();
    let (doc, warnings) = asset::load(files, None, &input.limits)?;
    for warning in warnings {
        context.warn(warning);
    }
    context.step(0.5, "reading geometry")?;
    let mut sets = asset::read(&doc, &options.atlas, context)?;
    if sets.is_empty() && context.warnings().is_empty() {
        let message = "the model has no triangles with texture coordinates that could be refined";
        return Err(Failure::new(Code::NothingToRefine, message));
    }
    for set in &mut sets {
        exempt_uniform(&doc, set, input.limits.max_image_pixels, context)?;
    }
    Ok(Loaded { doc, sets, bytes })
}

/// The stages that a recipe stands for.
fn stages(recipe: &Recipe) -> Result<Vec<Stage>> {
    match recipe {
        Recipe::Stages(stages) => Ok(stages.clone()),
        Recipe::Preset(name) if name == "pack" => Ok(vec![Stage::Pack {}]),
        Recipe::Preset(name) => {
            Err(Failure::new(Code::InvalidOptions, format!("there is no recipe `{name}`")).at("/recipe"))
        }
    }
}

/// Measures every atlas of the model; nothing is written. Gives the report, where `before` and `after` are the same.
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
    let loaded = loaded(input, options, context)?;
    context.enter(1);
    let refinements: Vec<Refinement> = loaded.sets.iter().map(Refinement::untouched).collect();
    let report = report(&loaded, &refinements, None, context)?;
    let failures = unmet(&report, &options.require)?;
    context.finish();
    Ok((serde_json::to_value(&report).map_err(|e| Failure::internal(e.to_string()))?, failures))
}

/// Runs the recipe on the model.
///
/// # Errors
/// Those of the input and the options: see [`Code`]; `canceled`.
pub fn refine(input: &Input, options: &Options, context: &Context) -> Result<Outcome> {
    let stages = stages(&options.recipe)?;
    let mut plan = vec![("read", 1.0)];
    plan.extend(stages.iter().map(|s| (s.name(), 2.0)));
    plan.extend([("bake", 2.0), ("write", 1.0)]);
    context.plan(&plan);

    context.enter(0);
    let loaded = loaded(input, options, context)?;
    let mut refinements: Vec<Refinement> = loaded.sets.iter().map(Refinement::untouched).collect();
    for (n, stage) in stages.iter().enumerate() {
        context.enter(1 + n);
        for refinement in &mut refinements {
            run_stage(stage, refinement, options, context)?;
        }
    }

    context.enter(1 + stages.len());
    let count = refinements.len();
    for (n, r) in refinements.iter_mut().enumerate().filter(|(_, r)| !r.kept) {
        let progress = |fraction: f64| (n as f64 + fraction) / count as f64;
        r.slots = bake_slots(
            &loaded.doc,
            r.set,
            &r.atlas,
            &options.texture,
            input.limits.max_image_pixels,
            context,
            &progress,
        )?;
    }

    context.enter(2 + stages.len());
    let outcome = write(input, options, &loaded, refinements, context)?;
    context.finish();
    Ok(outcome)
}

fn run_stage(stage: &Stage, refinement: &mut Refinement<'_>, options: &Options, context: &Context) -> Result<()> {
    let frame = Frame::new(refinement.set);
    let staged = match stage {
        Stage::Pack {} => pack::pack(&refinement.atlas, &frame, options, context)?,
    };
    let Staged { atlas, stopped_by, work, kept } = staged;
    if let Err(violation) = check::stage(&refinement.set.atlas, &atlas, context)? {
        debug_assert!(false, "{}: {violation}", stage.name());
        let message = format!("{} was undone for atlas {}: {violation}", stage.name(), frame.id);
        context.warn(Warning::new("stage_reverted", message));
        refinement.ran(stage, "reverted", work);
        return Ok(());
    }
    refinement.ran(stage, stopped_by, work);
    refinement.kept &= kept;
    refinement.atlas = atlas;
    Ok(())
}

fn write(
    input: &Input,
    options: &Options,
    loaded: &Loaded,
    mut refinements: Vec<Refinement<'_>>,
    context: &Context,
) -> Result<Outcome> {
    let refined: Vec<Refined<'_>> = refinements
        .iter()
        .filter(|r| !r.kept)
        .map(|r| Refined { set: r.set, atlas: &r.atlas, images: r.slots.iter().flat_map(baked_images).collect() })
        .collect();
    let doc = asset::write(&loaded.doc, &refined, context)?;
    context.step(0.3, "checking what was written")?;
    let mut written: Vec<Atlas> = Vec::new();
    for index in 0..refined.len() {
        written.push(asset::read_back(&doc, &refined, index, context)?);
    }
    drop(refined);
    for (r, atlas) in refinements.iter_mut().filter(|r| !r.kept).zip(written) {
        check::written(&r.set.atlas, &atlas, context)?;
        r.atlas = atlas;
    }
    context.step(0.5, "measuring")?;
    let report = report(loaded, &refinements, Some(&doc), context)?;
    let failures = unmet(&report, &options.require)?;
    let report = serde_json::to_value(&report).map_err(|e| Failure::internal(e.to_string()))?;

    context.step(0.8, "saving")?;
    let mut artifacts = match options.output {
        Output::Glb => vec![Artifact::new("model.glb", "model", "model/gltf-binary", doc.to_glb()?)],
        Output::Gltf => doc.to_gltf()?.into_iter().map(side_file).collect(),
    };
    let text = serde_json::to_vec_pretty(&report).map_err(|e| Failure::internal(e.to_string()))?;
    artifacts.push(Artifact::new("report.json", "report", "application/json", text));
    if input.extras {
        for r in &refinements {
            artifacts.extend(extras(r));
        }
        let archive = archive(&artifacts)?;
        artifacts.push(Artifact::new("result.zip", "archive", "application/zip", archive));
    }
    Ok(Outcome { artifacts, report, failures })
}

fn baked_images(slot: &BakedSlot) -> impl Iterator<Item = BakedImage> + '_ {
    slot.files.iter().enumerate().map(|(page, file)| BakedImage {
        slot: slot.slot,
        page,
        format: file.format,
        bytes: file.bytes.clone(),
    })
}

fn side_file(file: File) -> Artifact {
    let (role, media_type) = match file.path.rsplit('.').next() {
        Some("gltf") => ("model", "model/gltf+json"),
        Some("png") => ("side_file", "image/png"),
        Some("jpg" | "jpeg") => ("side_file", "image/jpeg"),
        _ => ("side_file", "application/octet-stream"),
    };
    Artifact::new(file.path, role, media_type, file.bytes)
}

/// Textures and pictures of one atlas as files of their own.
fn extras(r: &Refinement<'_>) -> Vec<Artifact> {
    let id = r.set.id;
    let mut files = Vec::new();
    for slot in &r.slots {
        let name = &r.set.slots[slot.slot].name;
        for (page, file) in slot.files.iter().enumerate() {
            let name = format!("atlas-{id}.page-{page}.{name}.{}", file.format.extension());
            files.push(Artifact::new(name, "texture", file.format.media_type(), file.bytes.clone()));
        }
    }
    let (before, after) = rayon::join(
        || picture(&r.set.atlas, 0, PICTURE_SIDE),
        || (0..r.atlas.sheets.len()).map(|page| picture(&r.atlas, page, PICTURE_SIDE)).collect::<Vec<_>>(),
    );
    files.push(Artifact::new(format!("atlas-{id}.before.png"), "picture", "image/png", before));
    for (page, bytes) in after.into_iter().enumerate() {
        let name =
            if page == 0 { format!("atlas-{id}.after.png") } else { format!("atlas-{id}.after.page-{page}.png") };
        files.push(Artifact::new(name, "picture", "image/png", bytes));
    }
    files
}

/// A zip of all artifacts. What is compressed already is stored; times are fixed, so that equal results are equal bytes.
fn archive(artifacts: &[Artifact]) -> Result<Vec<u8>> {
    let fail = |e: &dyn std::fmt::Display| Failure::internal(format!("the archive cannot be written: {e}"));
    let mut zip = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    for artifact in artifacts {
        let method = match artifact.media_type.as_str() {
            "application/json" | "model/gltf+json" => zip::CompressionMethod::Deflated,
            _ => zip::CompressionMethod::Stored,
        };
        let options = zip::write::SimpleFileOptions::default()
            .compression_method(method)
            .last_modified_time(zip::DateTime::default())
            .large_file(artifact.bytes.len() >= u32::MAX as usize);
        zip.start_file(artifact.name.as_str(), options).map_err(|e| fail(&e))?;
        zip.write_all(&artifact.bytes).map_err(|e| fail(&e))?;
    }
    zip.finish().map(std::io::Cursor::into_inner).map_err(|e| fail(&e))
}
