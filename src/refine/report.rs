//! From the work done to the report.

use rayon::prelude::*;
use serde_json::{Map, Value};

use super::options::{OverlapMode, Stage};
use super::run::Loaded;
use super::textures::BakedSlot;
use crate::asset::{Document, TextureSet, is_small};
use crate::atlas::{Atlas, Charts, Topology, clusters};
use crate::context::Context;
use crate::error::Result;
use crate::metrics::{
    AtlasReport, Frame, ImageReport, InputReport, Measures, ModelReport, Report, SlotSize, StageReport, TextureReport,
    measure, roll_up,
};

/// One texture set on its way through the recipe.
pub(super) struct Refinement<'a> {
    /// As read.
    pub set: &'a TextureSet,
    /// As the last stage left it.
    pub atlas: Atlas,
    /// Whether nothing has been changed so far: the set stays as uploaded.
    pub kept: bool,
    /// What the stages said.
    pub stages: Vec<StageReport>,
    /// The baked images.
    pub slots: Vec<BakedSlot>,
}

impl<'a> Refinement<'a> {
    /// Before any stage.
    pub fn untouched(set: &'a TextureSet) -> Self {
        Refinement { set, atlas: set.atlas.clone(), kept: true, stages: Vec::new(), slots: Vec::new() }
    }

    /// Records that a stage ran.
    pub fn ran(&mut self, stage: &Stage, stopped_by: &str, work: u64) {
        self.stages.push(StageReport {
            stage: stage.name().to_owned(),
            atlas_id: self.set.id as u64,
            stopped_by: stopped_by.to_owned(),
            figures: Map::from_iter([("work".to_owned(), Value::from(work))]),
        });
    }

    /// Sizes of the images as uploaded.
    fn sizes_before(&self, doc: &Document) -> Vec<SlotSize> {
        self.set.slots.iter().map(|s| self.size_of(s, doc)).collect()
    }

    fn size_of(&self, slot: &crate::asset::Slot, doc: &Document) -> SlotSize {
        SlotSize {
            page: 0,
            width: slot.header.width,
            height: slot.header.height,
            bytes: image_bytes(doc, slot.image),
            exempt: slot.exempt || is_small(slot, self.set.reference),
        }
    }

    /// Sizes of the images as delivered.
    fn sizes_after(&self, doc: &Document) -> Vec<SlotSize> {
        if self.kept {
            return self.sizes_before(doc);
        }
        let mut sizes: Vec<SlotSize> =
            self.set.slots.iter().filter(|s| s.exempt).map(|s| self.size_of(s, doc)).collect();
        for baked in &self.slots {
            let slot = &self.set.slots[baked.slot];
            sizes.extend(baked.files.iter().enumerate().map(|(page, file)| SlotSize {
                page: page as u16,
                width: file.size[0],
                height: file.size[1],
                bytes: file.bytes.len() as u64,
                exempt: is_small(slot, self.set.reference),
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

/// Measures everything before and after. `written` is the document with the refined sets; without it nothing was refined.
///
/// # Errors
/// `canceled`.
pub(super) fn report(
    loaded: &Loaded,
    refinements: &[Refinement<'_>],
    written: Option<&Document>,
    context: &Context,
) -> Result<Report> {
    let atlases: Vec<AtlasReport> = refinements
        .par_iter()
        .map(|r| {
            context.check()?;
            Ok(atlas_report(loaded, r, written.is_some()))
        })
        .collect::<Result<_>>()?;
    let all =
        |pick: fn(&AtlasReport) -> &Measures| roll_up(&atlases.iter().map(|a| pick(a).clone()).collect::<Vec<_>>());
    let model = ModelReport { before: all(|a| &a.before), after: all(|a| &a.after) };
    let textures = refinements.iter().flat_map(|r| textures(loaded, r, written)).collect();
    Ok(Report {
        schema: Report::SCHEMA,
        intarsia: env!("CARGO_PKG_VERSION").to_owned(),
        input: input_report(loaded),
        stages: refinements.iter().flat_map(|r| r.stages.clone()).collect(),
        atlases,
        textures,
        model,
        warnings: context.warnings(),
    })
}

fn atlas_report(loaded: &Loaded, r: &Refinement<'_>, refined: bool) -> AtlasReport {
    let doc = &loaded.doc;
    let of = |atlas: &Atlas, input: Option<&Atlas>, slots: &[SlotSize], resampled_area: Option<f64>| {
        let charts = Charts::new(&Topology::new(atlas));
        let clusters = clusters(atlas, &charts, OverlapMode::Stack);
        measure(atlas, &Frame { input, clusters: &clusters, slots, resampled_area, signal_error: None })
    };
    let before = of(&r.set.atlas, None, &r.sizes_before(doc), None);
    let after = match r.kept {
        true => Measures { resampled_area: refined.then_some(0.0), ..before.clone() },
        false => of(&r.atlas, Some(&r.set.atlas), &r.sizes_after(doc), r.resampled_area()),
    };
    AtlasReport {
        id: r.set.id as u64,
        name: r.set.name.clone(),
        materials: material_names(doc, r.set),
        pages: r.atlas.sheets.len() as u64,
        // What is only inspected is judged as it is.
        refined: true,
        before,
        after,
    }
}

fn material_names(doc: &Document, set: &TextureSet) -> Vec<String> {
    let mut materials: Vec<usize> = set.primitives.iter().filter_map(|p| p.material).collect();
    materials.sort_unstable();
    materials.dedup();
    let name = |m: usize| doc.json.pointer(&format!("/materials/{m}/name")).and_then(Value::as_str);
    materials.into_iter().map(|m| name(m).map_or_else(|| format!("material {m}"), str::to_owned)).collect()
}

fn textures(loaded: &Loaded, r: &Refinement<'_>, written: Option<&Document>) -> Vec<TextureReport> {
    let mut all = Vec::new();
    for baked in &r.slots {
        let slot = &r.set.slots[baked.slot];
        let name = |doc: &Document| {
            doc.json.pointer(&format!("/images/{}/name", slot.image)).and_then(Value::as_str).map(str::to_owned)
        };
        let before = ImageReport {
            width: slot.header.width,
            height: slot.header.height,
            format: slot.header.format,
            bytes: image_bytes(&loaded.doc, slot.image),
        };
        let f = &baked.fidelity;
        let direction = slot.role.is_direction();
        for (page, file) in baked.files.iter().enumerate() {
            all.push(TextureReport {
                atlas_id: r.set.id as u64,
                page: page as u64,
                slot: slot.name.clone(),
                image_index: slot.image as u64,
                name: name(written.unwrap_or(&loaded.doc)),
                before: before.clone(),
                after: ImageReport {
                    width: file.size[0],
                    height: file.size[1],
                    format: file.format,
                    bytes: file.bytes.len() as u64,
                },
                verbatim_texels: baked.verbatim_texels,
                psnr_db: (!direction).then_some(f.psnr_db),
                exact: f.exact,
                angle_median_deg: f.angle_median_deg,
                angle_p95_deg: f.angle_p95_deg,
                max_error: f.max_error,
                mip2_mean_error: f.mip2_mean_error,
                mip2_max_error: f.mip2_max_error,
            });
        }
    }
    all
}

fn input_report(loaded: &Loaded) -> InputReport {
    let json = &loaded.doc.json;
    let list = |key: &str| json.get(key).and_then(Value::as_array).map_or(&[][..], Vec::as_slice);
    let primitives = || list("meshes").iter().flat_map(|m| m["primitives"].as_array().into_iter().flatten());
    let count = |primitive: &Value| {
        let accessor = primitive.get("indices").or_else(|| primitive.pointer("/attributes/POSITION"))?.as_u64()?;
        let corners = json.pointer(&format!("/accessors/{accessor}/count"))?.as_u64()?;
        match primitive.get("mode").and_then(Value::as_u64).unwrap_or(4) {
            4 => Some(corners / 3),
            5 | 6 => Some(corners.saturating_sub(2)),
            _ => Some(0),
        }
    };
    InputReport {
        name: loaded.doc.name.clone(),
        bytes: loaded.bytes,
        meshes: list("meshes").len() as u64,
        primitives: primitives().count() as u64,
        triangles: primitives().filter_map(count).sum(),
        materials: list("materials").len() as u64,
        images: list("images").len() as u64,
    }
}
