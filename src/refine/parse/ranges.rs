//! Options that their types allow and that make no sense.

use super::words::{child, name, short};
use super::{MAX_METADATA_BYTES, Problem};
use crate::refine::box_cutter::params::BoxCutter;
use crate::refine::defrag::params::Defrag;
use crate::refine::importance::attribute_and_component;
use crate::refine::options::{ImportanceSource, Options, Recipe, Stage};
use crate::texture::Size;

/// What the types cannot say.
pub(super) fn ranges(o: &Options) -> Vec<Problem> {
    let mut out = Vec::new();
    let mut within = |pointer: &str, value: f64, low: f64, high: f64| {
        if !(low..=high).contains(&value) {
            out.push(Problem::new(pointer, format!("`{}` is {value}, outside {low}..={high}", name(pointer))));
        }
    };
    within("/pack/grid", o.pack.grid.into(), 1.0, 64.0);
    if let Some(aspect) = o.pack.aspect {
        within("/pack/aspect", aspect, 0.01, 100.0);
    }
    cutter_ranges("/box_cutter", &o.box_cutter, &mut within);
    defrag_ranges("/defrag", &o.defrag, &mut within);
    if let Recipe::Stages(stages) = &o.recipe {
        for (i, stage) in stages.iter().enumerate() {
            let at = format!("/recipe/{i}");
            match stage {
                Stage::BoxCutter(params) => cutter_ranges(&at, params, &mut within),
                Stage::Defrag(params) => defrag_ranges(&at, params, &mut within),
                Stage::Pack {} => {}
            }
        }
    }
    within("/texture/multiple_of", o.texture.multiple_of.into(), 1.0, 256.0);
    within("/texture/max_size", o.texture.max_size.into(), 16.0, 16384.0);
    within("/texture/jpeg_quality", o.texture.jpeg_quality.into(), 1.0, 100.0);
    within("/atlas/uv_set", o.atlas.uv_set.into(), 0.0, 7.0);
    if let Some(fabrication) = &o.fabrication {
        within("/fabrication/model_unit_mm", fabrication.model_unit_mm, 1e-6, 1e9);
        within("/fabrication/width_mm", fabrication.width_mm, 0.0, 10_000.0);
        within("/fabrication/fold_angle", fabrication.fold_angle.unwrap_or(0.0), 0.0, std::f64::consts::PI);
    }
    if let Some(limit) = o.time_limit_s.filter(|l| !(*l > 0.0 && *l <= 1e9)) {
        out.push(Problem::new(
            "/time_limit_s",
            format!("`time_limit_s` is {limit}, not more than 0 (and at most 1e9)"),
        ));
    }
    if o.work_budget == Some(0) {
        out.push(Problem::new("/work_budget", "`work_budget` is 0; it is at least 1, or null"));
    }
    if let Size::Fixed(size) = o.texture.size {
        let max = o.texture.max_size;
        if size.iter().any(|s| *s > max) {
            out.push(Problem::new("/texture/size", format!("`size` {size:?} exceeds `max_size` {max}")));
        }
        let multiple = o.texture.multiple_of.max(1);
        if size.iter().any(|s| s % multiple != 0) {
            out.push(Problem::new(
                "/texture/size",
                format!("`size` {size:?} is no multiple of `multiple_of` {multiple}"),
            ));
        }
        if o.texture.power_of_two && !size.iter().all(|s| s.is_power_of_two()) {
            out.push(Problem::new("/texture/size", format!("`size` {size:?} is no power of two")));
        }
    }
    importance(o, &mut out);
    if serde_json::to_vec(&o.metadata).map_or(true, |m| m.len() > MAX_METADATA_BYTES) {
        out.push(Problem::new("/metadata", format!("`metadata` is larger than {MAX_METADATA_BYTES} bytes of JSON")));
    }
    out
}

fn importance(o: &Options, out: &mut Vec<Problem>) {
    match &o.importance {
        Some(ImportanceSource::Attribute(name)) if attribute_and_component(name).is_none() => {
            let text = format!("`{}` is not an attribute and a component, such as COLOR_0.r", short(name));
            out.push(Problem::new("/importance/attribute", text));
        }
        Some(ImportanceSource::Texture(name)) if name.is_empty() => {
            out.push(Problem::new("/importance/texture", "`texture` is the name of a file that comes with the model"));
        }
        Some(ImportanceSource::Materials(weights)) => {
            for (name, weight) in weights.iter().filter(|(_, w)| !w.is_finite() || **w < 0.0) {
                let text = format!("the weight of `{}` is {weight}; it is at least 0", short(name));
                out.push(Problem::new(child("/importance/materials", name), text));
            }
        }
        _ => {}
    }
}

fn cutter_ranges(at: &str, p: &BoxCutter, within: &mut impl FnMut(&str, f64, f64, f64)) {
    let mut check = |key: &str, value: Option<f64>, low: f64, high: f64| {
        if let Some(value) = value {
            within(&child(at, key), value, low, high);
        }
    };
    check("max_boundary_length", p.max_boundary_length, 1.0, 100.0);
    check("target_packing_efficiency", p.target_packing_efficiency, 0.0, 1.0);
    check("max_charts", p.max_charts.map(f64::from), 1.0, 1e6);
    check("min_extent", Some(p.min_extent), 0.0, 1.0);
    check("void_boxes", Some(p.void_boxes.into()), 1.0, 64.0);
    check("void_overlap", Some(p.void_overlap), 0.0, 1.0);
    check("line_shift", Some(p.line_shift), 0.0, 0.5);
    check("alpha", Some(p.alpha), 0.0, 4.0);
    check("min_improvement", Some(p.min_improvement), 0.0, 1.0);
    check("patience", Some(p.patience.into()), 1.0, 1000.0);
    check("beam", Some(p.beam.into()), 1.0, 64.0);
    check("weld_loss", Some(p.weld_loss), 0.0, 1.0);
}

fn defrag_ranges(at: &str, p: &Defrag, within: &mut impl FnMut(&str, f64, f64, f64)) {
    let mut check = |key: &str, value: f64, high: f64| within(&child(at, key), value, 0.0, high);
    check("alpha", p.alpha.unwrap_or(0.0), 100.0);
    check("max_local_energy", p.max_local_energy.unwrap_or(0.0), 10.0);
    check("max_global_energy", p.max_global_energy.unwrap_or(0.0), 10.0);
    check("max_misalignment", p.max_misalignment, 100.0);
    check("min_benefit", p.min_benefit, 1.0);
    check("max_resampled", p.max_resampled, 1.0);
    check("resampling_rate", p.resampling_rate, 1e6);
    check("island_area", p.island_area, 1e6);
    check("min_preserved", p.min_preserved, 1.0);
}
