//! What a job hands back: its report, and the files of its result.

use std::io::Write as _;

use super::fabrication::{FabricationParams, panels, worst_scale};
use super::load::Loaded;
use super::options::{Container, Options};
use super::preview;
use super::refinement::Refinement;
use super::report::report;
use super::run::{Artifact, Input, Outcome};
use super::write::{Written, texture_name};
use crate::asset::{self, Document, File};
use crate::context::Context;
use crate::error::{Failure, Result, Warning};
use crate::metrics::{RefinementOutcome, judge, picture};

/// Longest side of a picture, in pixels.
const PICTURE_SIDE: u32 = 1024;

/// Panels whose size is off by more than this factor do not fit together.
const SAME_SCALE: f64 = 1.01;

/// Measures what was written, judges it, and gathers the files.
///
/// # Errors
/// `too_large`; `invalid_options` for an unknown path in `require`; `canceled`.
pub(super) fn deliver(
    input: &Input,
    options: &Options,
    loaded: &Loaded,
    written: Written<'_>,
    context: &Context,
) -> Result<Outcome> {
    let Written { refinements, mut documents, merged } = written;
    context.step(0.4, "compressing")?;
    for (index, document) in documents.iter_mut().enumerate() {
        loaded.speak_of(index, context);
        document.compress(options.output.compression, context)?;
    }
    context.speak_of(None);
    context.step(0.5, "measuring")?;
    let mut panels = Vec::new();
    if let Some(params) = &options.fabrication {
        for r in refinements.iter().filter(|r| r.atlas.has_layout()) {
            panels.extend(panel_files(r, params, context));
        }
    }
    let mut report = report(loaded, &refinements, true, context)?;
    report.merged = merged;
    let verdict = judge(&report, &options.require, &options.strict, context.warning_counts())?;
    let outcome = report.outcome.unwrap_or(RefinementOutcome::NothingToRefine);
    let report = serde_json::to_value(&report).map_err(|e| Failure::internal(e.to_string()))?;

    context.step(0.8, "saving")?;
    let mut artifacts = models(&documents, options.output.container)?;
    let text = serde_json::to_vec_pretty(&report).map_err(|e| Failure::internal(e.to_string()))?;
    artifacts.push(Artifact::new("report.json", "report", "application/json", text));
    artifacts.append(&mut panels);
    if input.extras {
        for r in &refinements {
            for file in extras(r) {
                // A texture may stand beside its models already: it is there once.
                match artifacts.iter_mut().find(|a| a.name == file.name) {
                    Some(known) => known.role = file.role,
                    None => artifacts.push(file),
                }
            }
        }
        let archive = archive(&artifacts)?;
        artifacts.push(Artifact::new("result.zip", "archive", "application/zip", archive));
        let preview = preview::preview(loaded, &refinements, input.limits.max_image_pixels, context)?;
        artifacts.push(Artifact::new(preview::NAME, "preview", "application/octet-stream", preview));
    }
    Ok(Outcome { artifacts, report, outcome, verdict })
}

/// The models as files: `model`, or `model-0`, `model-1`, … where there are several.
fn models(documents: &[Document], output: Container) -> Result<Vec<Artifact>> {
    let stem = |index: usize| if documents.len() == 1 { "model".to_owned() } else { format!("model-{index}") };
    if output == Container::Gltf {
        let named: Vec<(String, &Document)> = documents.iter().enumerate().map(|(i, d)| (stem(i), d)).collect();
        return Ok(asset::to_gltf(&named)?.into_iter().map(side_file).collect());
    }
    let model = |(index, doc): (usize, &Document)| {
        let kind = doc.tile.as_ref().map(|tile| tile.kind);
        let tile = if output.of(kind)? == Container::Glb { None } else { doc.to_tile()? };
        Ok(match kind.zip(tile) {
            // 3D Tiles 1.0 gives its tiles no media type of their own.
            Some((kind, bytes)) => {
                let name = format!("{}.{}", stem(index), kind.extension());
                Artifact::new(name, "model", "application/octet-stream", bytes)
            }
            None => Artifact::new(format!("{}.glb", stem(index)), "model", "model/gltf-binary", doc.to_glb()?),
        })
    };
    documents.iter().enumerate().map(model).collect()
}

fn side_file(file: File) -> Artifact {
    let (role, media_type) = match file.path.rsplit('.').next() {
        Some("gltf") => ("model", "model/gltf+json"),
        _ => ("side_file", asset::image_type(&file.path).unwrap_or("application/octet-stream")),
    };
    Artifact::new(file.path, role, media_type, file.bytes)
}

/// The panels of one atlas: a file for each sheet.
fn panel_files(r: &Refinement<'_>, params: &FabricationParams, context: &Context) -> Vec<Artifact> {
    let id = r.group.set().id;
    let off = worst_scale(&r.atlas);
    if off > SAME_SCALE {
        let text = format!(
            "the charts of atlas {id} differ in scale: some panels are too large or too small by a factor of {off:.3} and will not fit together (optcuts before box_cutter evens that out)"
        );
        context.warn(Warning::new("panel_scale", text));
    }
    let file = |(page, svg): (usize, String)| {
        let name = if page == 0 { format!("panels-{id}.svg") } else { format!("panels-{id}.page-{page}.svg") };
        Artifact::new(name, "fabrication", "image/svg+xml", svg.into_bytes())
    };
    panels(&r.atlas, params).into_iter().enumerate().map(file).collect()
}

/// Textures and pictures of one atlas as files of their own.
fn extras(r: &Refinement<'_>) -> Vec<Artifact> {
    let set = r.group.set();
    let id = set.id;
    let mut files = Vec::new();
    if !r.atlas.has_layout() {
        return files;
    }
    for slot in &r.slots {
        for (page, file) in slot.files.iter().enumerate() {
            let name = texture_name(r, slot, page);
            files.push(Artifact::new(name, "texture", file.format.media_type(), file.bytes.clone()));
        }
    }
    let (before, after) = rayon::join(
        || set.atlas.has_layout().then(|| picture(&set.atlas, 0, PICTURE_SIDE)),
        || (0..r.atlas.sheets.len()).map(|page| picture(&r.atlas, page, PICTURE_SIDE)).collect::<Vec<_>>(),
    );
    if let Some(before) = before {
        files.push(Artifact::new(format!("atlas-{id}.before.png"), "picture", "image/png", before));
    }
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
            "application/json" | "model/gltf+json" | "image/svg+xml" => zip::CompressionMethod::Deflated,
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
