//! What a job hands back: the models written and checked, and the files of its result.

use std::borrow::Cow;
use std::io::Write as _;

use super::check;
use super::fabrication::{FabricationParams, panels, worst_scale};
use super::load::Loaded;
use super::options::{Options, Output};
use super::report::{Refinement, report};
use super::run::{Artifact, Input, Outcome};
use super::textures::BakedSlot;
use crate::asset::{self, BakedImage, Document, File, Merged, Refined};
use crate::atlas::{Atlas, FaceId};
use crate::context::Context;
use crate::error::{Failure, Result, Warning};
use crate::metrics::{picture, unmet};

/// Longest side of a picture, in pixels.
const PICTURE_SIDE: u32 = 1024;

/// Panels whose size is off by more than this factor do not fit together.
const SAME_SCALE: f64 = 1.01;

/// Writes the refined groups into their models, reads them back, checks and measures them, and gathers the files.
///
/// # Errors
/// `internal` when something written fails its check; `too_large`; `invalid_options` for an unknown path in `require`; `canceled`.
pub(super) fn deliver(
    input: &Input,
    options: &Options,
    loaded: &Loaded,
    mut refinements: Vec<Refinement<'_>>,
    context: &Context,
) -> Result<Outcome> {
    let mut documents = write(loaded, &mut refinements, context)?;
    let merged = merge(loaded, &refinements, &mut documents)?;
    context.step(0.5, "measuring")?;
    let mut panels = Vec::new();
    if let Some(params) = &options.fabrication {
        for r in refinements.iter().filter(|r| r.atlas.has_layout()) {
            panels.extend(panel_files(r, params, context));
        }
    }
    let mut report = report(loaded, &refinements, true, context)?;
    report.merged = merged;
    let failures = unmet(&report, &options.require)?;
    let report = serde_json::to_value(&report).map_err(|e| Failure::internal(e.to_string()))?;

    context.step(0.8, "saving")?;
    let mut artifacts = models(&documents, options.output)?;
    let text = serde_json::to_vec_pretty(&report).map_err(|e| Failure::internal(e.to_string()))?;
    artifacts.push(Artifact::new("report.json", "report", "application/json", text));
    artifacts.append(&mut panels);
    if input.extras {
        for r in &refinements {
            // A texture that several sets share may stand beside its models already.
            let fresh = extras(r).into_iter().filter(|e| artifacts.iter().all(|a| a.name != e.name));
            artifacts.extend(fresh.collect::<Vec<_>>());
        }
        let archive = archive(&artifacts)?;
        artifacts.push(Artifact::new("result.zip", "archive", "application/zip", archive));
    }
    Ok(Outcome { artifacts, report, failures })
}

/// The documents with what was refined; the Atlases of the refinements become those that the documents hold.
fn write(loaded: &Loaded, refinements: &mut [Refinement<'_>], context: &Context) -> Result<Vec<Document>> {
    let mut parts: Vec<Vec<(Cow<'_, Atlas>, Vec<FaceId>)>> = Vec::new();
    for r in refinements.iter() {
        parts.push(if r.kept { Vec::new() } else { r.group.part(&r.atlas)? });
    }
    let mut documents = Vec::new();
    let mut written: Vec<Vec<(Atlas, Vec<FaceId>)>> = parts.iter().map(|_| Vec::new()).collect();
    for (index, model) in loaded.models.iter().enumerate() {
        context.step(0.3 * index as f64 / loaded.models.len() as f64, "writing")?;
        loaded.speak_of(index, context);
        let (mut refined, mut owners) = (Vec::new(), Vec::new());
        for (g, (r, parts)) in refinements.iter().zip(&parts).enumerate() {
            for (member, (atlas, faces)) in r.group.members.iter().zip(parts).filter(|(m, _)| m.model == index) {
                let images = r.slots.iter().filter_map(|baked| {
                    let slot = member.slots.iter().position(|s| *s == Some(baked.slot))?;
                    Some(baked_images(r, baked, slot))
                });
                refined.push(Refined { set: &member.set, atlas, images: images.flatten().collect() });
                owners.push((g, faces));
            }
        }
        let doc = asset::write(&model.doc, &model.index, &refined, context)?;
        for (i, (g, faces)) in owners.into_iter().enumerate() {
            written[g].push((asset::read_back(&doc, &refined, i, context)?, faces.clone()));
        }
        documents.push(doc);
    }
    drop(parts);
    context.speak_of(None);
    context.step(0.3, "checking what was written")?;
    for (r, written) in refinements.iter_mut().zip(written).filter(|(r, _)| !r.kept) {
        let atlas = r.group.rejoin(&r.atlas, written);
        check::written(&r.group.set().atlas, &atlas, context)?;
        r.atlas = atlas;
    }
    Ok(documents)
}

/// Makes what became equal one, in the models of which something was refined.
fn merge(loaded: &Loaded, refinements: &[Refinement<'_>], documents: &mut [Document]) -> Result<Vec<Merged>> {
    let mut merged = Vec::new();
    for (index, (model, doc)) in loaded.models.iter().zip(documents).enumerate() {
        let refined = refinements.iter().any(|r| !r.kept && r.group.members.iter().any(|m| m.model == index));
        if let Some(merge) = model.merge.clone().filter(|_| refined) {
            merged.push(asset::finish_merge(doc, merge)?);
        }
    }
    Ok(merged)
}

/// The pages of a slot, for the slot of a member. Sets that share an Atlas share the files.
fn baked_images(r: &Refinement<'_>, baked: &BakedSlot, slot: usize) -> Vec<BakedImage> {
    let files = baked.files.iter().enumerate();
    files
        .map(|(page, file)| BakedImage {
            slot,
            page,
            format: file.format,
            bytes: file.bytes.clone(),
            shared: r.group.is_joined().then(|| texture_name(r, baked, page)),
        })
        .collect()
}

/// The name of a texture as a file of its own.
fn texture_name(r: &Refinement<'_>, baked: &BakedSlot, page: usize) -> String {
    let set = r.group.set();
    let extension = baked.files.get(page).map_or("png", |f| f.format.extension());
    format!("atlas-{}.page-{page}.{}.{extension}", set.id, set.slots[baked.slot].name)
}

/// The models as files: `model`, or `model-0`, `model-1`, … where there are several.
fn models(documents: &[Document], output: Output) -> Result<Vec<Artifact>> {
    let stem = |index: usize| if documents.len() == 1 { "model".to_owned() } else { format!("model-{index}") };
    match output {
        Output::Glb => {
            let glb = |(index, doc): (usize, &Document)| {
                Ok(Artifact::new(format!("{}.glb", stem(index)), "model", "model/gltf-binary", doc.to_glb()?))
            };
            documents.iter().enumerate().map(glb).collect()
        }
        Output::Gltf => {
            let named: Vec<(String, &Document)> = documents.iter().enumerate().map(|(i, d)| (stem(i), d)).collect();
            Ok(asset::to_gltf(&named)?.into_iter().map(side_file).collect())
        }
    }
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
            "the charts of atlas {id} differ in scale: some panels are too large or too small by a factor of {off:.3}"
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
