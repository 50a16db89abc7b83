//! From the work done to the report.

use rayon::prelude::*;
use serde_json::Value;

use super::group::{Group, Member};
use super::importance::{Importance, material_name};
use super::load::{Loaded, Model};
use super::refinement::Refinement;
use crate::asset::{Document, declared_triangles, is_small};
use crate::atlas::OverlapMode;
use crate::atlas::groups::sorted_unique;
use crate::atlas::{Atlas, Charts, Clusters, Topology, clusters};
use crate::context::Context;
use crate::error::Result;
use crate::metrics::{
    AtlasReport, ImageReport, InputReport, MeasureInputs, Measures, ModelInput, ModelReport, RefinementOutcome, Report,
    SlotSize, TextureReport, TextureSource, measure, roll_up, without_layout,
};
use crate::texture::Slot;

impl Refinement<'_> {
    /// Sizes of the images as uploaded, those that `pick` takes.
    fn sizes(&self, loaded: &Loaded, pick: impl Fn(&Slot) -> bool) -> Vec<SlotSize> {
        let size = |member: &Member, slot: &Slot| SlotSize {
            page: 0,
            width: slot.header.width,
            height: slot.header.height,
            bytes: image_bytes(&loaded.models[member.model].doc, slot.image),
            // Images of several sets lie on no common sheet.
            exempt: slot.exempt || self.group.is_joined() || is_small(slot, member.set.reference),
        };
        let members = self.group.members.iter();
        members.flat_map(|m| m.set.slots.iter().filter(|s| pick(s)).map(move |s| size(m, s))).collect()
    }

    /// Size of the smallest slot on the sheet that several sets share as uploaded.
    fn smallest_before(&self) -> Option<[u32; 2]> {
        let set = self.group.set();
        let slots = set.slots.iter().filter(|s| self.group.is_joined() && !is_small(s, set.reference));
        slots.map(|s| [s.header.width, s.header.height]).min_by_key(|s| u64::from(s[0]) * u64::from(s[1]))
    }

    /// Sizes of the images as delivered.
    fn sizes_after(&self, loaded: &Loaded) -> Vec<SlotSize> {
        if self.kept {
            return self.sizes(loaded, |_| true);
        }
        let mut sizes = self.sizes(loaded, |s| s.exempt);
        let set = self.group.set();
        for baked in &self.slots {
            let slot = &set.slots[baked.slot];
            sizes.extend(baked.files.iter().enumerate().map(|(page, file)| SlotSize {
                page: page as u16,
                width: file.size[0],
                height: file.size[1],
                bytes: file.bytes.len() as u64,
                exempt: is_small(slot, set.reference),
            }));
        }
        sizes
    }

    /// Fraction of the 3D area that was resampled: the worst slot's.
    fn resampled_area(&self) -> Option<f64> {
        if self.kept {
            return Some(0.0);
        }
        self.slots.iter().map(|s| s.resampled_area).reduce(f64::max)
    }
}

fn image_bytes(doc: &Document, image: usize) -> u64 {
    doc.images.get(image).and_then(Option::as_ref).map_or(0, |b| b.len() as u64)
}

/// Measures everything before and after. `refined` tells a job that refines from one that only looks.
///
/// # Errors
/// `canceled`.
pub(super) fn report(
    loaded: &Loaded,
    refinements: &[Refinement<'_>],
    refined: bool,
    context: &Context,
) -> Result<Report> {
    let atlases: Vec<AtlasReport> = refinements
        .par_iter()
        .map(|r| {
            context.check()?;
            Ok(atlas_report(loaded, r, refined))
        })
        .collect::<Result<_>>()?;
    let all = |pick: fn(&AtlasReport) -> &Measures| {
        roll_up(&atlases.iter().filter(|a| a.refined).map(|a| pick(a).clone()).collect::<Vec<_>>())
    };
    let model = ModelReport { before: all(|a| &a.before), after: all(|a| &a.after) };
    let textures = refinements.iter().flat_map(|r| textures(loaded, r)).collect();
    let outcome = refined.then(|| RefinementOutcome::of_job(refinements.iter().map(Refinement::outcome), loaded.left));
    Ok(Report {
        schema: Report::SCHEMA,
        intarsia: env!("CARGO_PKG_VERSION").to_owned(),
        outcome,
        input: input_report(loaded),
        stages: refinements.iter().flat_map(|r| r.stages.clone()).collect(),
        atlases,
        textures,
        model,
        merged: Vec::new(),
        warnings: context.warnings(),
    })
}

fn atlas_report(loaded: &Loaded, r: &Refinement<'_>, refined: bool) -> AtlasReport {
    let set = r.group.set();
    let of = |atlas: &Atlas, inputs: MeasureInputs<'_>| {
        if !atlas.has_layout() {
            return without_layout(atlas);
        }
        let topology = Topology::new(atlas);
        let charts = Charts::new(&topology);
        let clusters = clusters(atlas, &charts, OverlapMode::Stack);
        measure(atlas, &topology, &charts, &MeasureInputs { clusters: &clusters, ..inputs })
    };
    let none = Clusters::default();
    let inputs = MeasureInputs {
        input: None,
        clusters: &none,
        slots: &r.sizes(loaded, |_| true),
        smallest_slot: r.smallest_before(),
        resampled_area: None,
        signal_error: None,
    };
    let changed = || {
        let (input, resampled_area) = (Some(&set.atlas).filter(|a| a.has_layout()), r.resampled_area());
        of(
            &r.atlas,
            MeasureInputs { input, slots: &r.sizes_after(loaded), smallest_slot: None, resampled_area, ..inputs },
        )
    };
    let (before, after) = rayon::join(|| of(&set.atlas, inputs), || (!r.kept).then(changed));
    let resampled_area = (refined && r.atlas.has_layout()).then_some(0.0);
    let after = after.unwrap_or_else(|| Measures { resampled_area, ..before.clone() });
    let mut models: Vec<u64> = r.group.members.iter().map(|m| m.model as u64).collect();
    models.dedup();
    AtlasReport {
        id: set.id as u64,
        name: set.name.clone(),
        models,
        materials: material_names(loaded, r.group),
        uv_sets: uv_sets(r),
        pages: r.atlas.sheets.len() as u64,
        outcome: refined.then(|| r.outcome()),
        // What is only inspected is judged as it is.
        refined: r.atlas.has_layout(),
        importance: r.group.importance.as_ref().and_then(Importance::range),
        before,
        after,
    }
}

/// The numbers of the TEXCOORD sets that have the layout, ascending.
fn uv_sets(r: &Refinement<'_>) -> Vec<u64> {
    let primitives = r.group.members.iter().flat_map(|m| &m.set.primitives).filter(|_| r.atlas.has_layout());
    sorted_unique(primitives.map(|p| if r.kept { p.layout.uv_set } else { p.written } as u64))
}

/// The names of the members' materials, model by model, each once.
fn material_names(loaded: &Loaded, group: &Group) -> Vec<String> {
    let primitives = |m: &Member| m.set.primitives.iter().filter_map(|p| p.material).collect::<Vec<_>>();
    let materials = sorted_unique(group.members.iter().flat_map(|m| primitives(m).into_iter().map(|p| (m.model, p))));
    materials.into_iter().map(|(model, m)| material_name(&loaded.models[model].doc, m)).collect()
}

fn textures(loaded: &Loaded, r: &Refinement<'_>) -> Vec<TextureReport> {
    let mut all = Vec::new();
    for baked in &r.slots {
        let slot = &r.group.set().slots[baked.slot];
        let sources: Vec<TextureSource> = r
            .group
            .sources(baked.slot)
            .map(|(member, own)| source_report(loaded, member, &member.set.slots[own]))
            .collect();
        let pixels = |s: &TextureSource| u64::from(s.before.width) * u64::from(s.before.height);
        // The first of the largest.
        let largest = sources.iter().reduce(|a, b| if pixels(b) > pixels(a) { b } else { a });
        let Some(largest) = largest.cloned() else { continue };
        let (f, layout) = (&baked.fidelity, &baked.layout_fidelity);
        let spoilt = f != layout;
        let direction = slot.role.is_direction();
        for (page, file) in baked.files.iter().enumerate() {
            all.push(TextureReport {
                atlas_id: r.group.set().id as u64,
                page: page as u64,
                slot: slot.name.clone(),
                image_index: largest.image_index,
                name: largest.name.clone(),
                before: largest.before.clone(),
                sources: sources.clone(),
                after: ImageReport {
                    width: file.size[0],
                    height: file.size[1],
                    format: file.format,
                    bytes: file.bytes.len() as u64,
                },
                verbatim_texels: baked.verbatim_texels,
                psnr_db: (!direction).then_some(f.psnr_db),
                layout_psnr_db: (!direction && spoilt).then_some(layout.psnr_db),
                exact: f.exact,
                layout_exact: layout.exact,
                angle_median_deg: f.angle_median_deg,
                angle_p95_deg: f.angle_p95_deg,
                layout_angle_median_deg: layout.angle_median_deg.filter(|_| spoilt),
                layout_angle_p95_deg: layout.angle_p95_deg.filter(|_| spoilt),
                max_error: f.max_error,
                mip2_mean_error: f.mip2_mean_error,
                mip2_max_error: f.mip2_max_error,
            });
        }
    }
    all
}

fn source_report(loaded: &Loaded, member: &Member, slot: &Slot) -> TextureSource {
    let uploaded = &loaded.models[member.model].doc;
    let name = uploaded.json.pointer(&format!("/images/{}/name", slot.image)).and_then(Value::as_str);
    TextureSource {
        model: member.model as u64,
        image_index: slot.image as u64,
        name: name.map(str::to_owned),
        before: ImageReport {
            width: slot.header.width,
            height: slot.header.height,
            format: slot.header.format,
            bytes: image_bytes(uploaded, slot.image),
        },
    }
}

fn input_report(loaded: &Loaded) -> InputReport {
    let models: Vec<ModelInput> = loaded.models.iter().map(model_input).collect();
    let names: Vec<&str> = models.iter().map(|m| m.name.as_str()).collect();
    let sum = |pick: fn(&ModelInput) -> u64| models.iter().map(pick).sum();
    InputReport {
        name: names.join(", "),
        bytes: loaded.bytes,
        meshes: sum(|m| m.meshes),
        primitives: sum(|m| m.primitives),
        triangles: sum(|m| m.triangles),
        materials: sum(|m| m.materials),
        images: sum(|m| m.images),
        models,
    }
}

fn model_input(model: &Model) -> ModelInput {
    let json = &model.doc.json;
    let list = |key: &str| json.get(key).and_then(Value::as_array).map_or(&[][..], Vec::as_slice);
    let primitives = || list("meshes").iter().flat_map(|m| m["primitives"].as_array().into_iter().flatten());
    ModelInput {
        name: model.doc.name.clone(),
        bytes: model.bytes,
        meshes: list("meshes").len() as u64,
        primitives: primitives().count() as u64,
        triangles: primitives().map(|p| declared_triangles(json, p)).sum(),
        materials: list("materials").len() as u64,
        images: (list("images").len() - model.doc.merging.constants.len().min(list("images").len())) as u64,
    }
}
