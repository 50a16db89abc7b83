//! `/v1/recipes` and `/v1/limits`: what can be asked for, and how much of it.

use axum::Json;
use axum::extract::State;
use serde::Serialize;
use serde_json::{Map, Value, json};
use utoipa::{PartialSchema, ToSchema};

use super::App;
use crate::packing::Pack;
use crate::refine::box_cutter::params::BoxCutter;
use crate::refine::defrag::params::Defrag;
use crate::refine::options::Options;
use crate::refine::parse::{MAX_METADATA_BYTES, MAX_STAGES, RECIPES};

/// The presets, the stages and all options, as JSON Schema.
#[derive(Serialize, ToSchema)]
pub(super) struct Recipes {
    /// Names for `recipe`.
    recipes: Vec<Named>,
    /// Stages for a `recipe` that is a list.
    stages: Vec<StageInfo>,
    /// JSON Schema of the options, with all defaults.
    options: Value,
}

/// A preset.
#[derive(Serialize, ToSchema)]
struct Named {
    /// Its name.
    name: &'static str,
    /// What it does.
    description: &'static str,
}

/// A stage and its parameters.
#[derive(Serialize, ToSchema)]
struct StageInfo {
    /// Its name.
    stage: &'static str,
    /// What it does.
    description: &'static str,
    /// Where its parameters stand in the options: a JSON pointer, or null when they stand in the stage itself.
    parameters_at: Option<&'static str>,
    /// JSON Schema of its parameters.
    parameters: Value,
}

/// Presets, and stages with their parameters as JSON Schema.
#[utoipa::path(get, path = "/v1/recipes", tag = "service", responses((status = 200, body = Recipes)))]
pub(super) async fn recipes() -> Json<Recipes> {
    let recipes = RECIPES.iter().map(|&(name, description)| Named { name, description }).collect();
    let described = |stage: &str| RECIPES.iter().find(|r| r.0 == stage).map_or("", |r| r.1);
    let stage = |stage: &'static str, parameters_at, parameters| StageInfo {
        stage,
        description: described(stage),
        parameters_at,
        parameters,
    };
    let stages = vec![
        stage("pack", Some("/pack"), schema::<Pack>(&Pack::default())),
        stage("box_cutter", None, schema::<BoxCutter>(&BoxCutter::default())),
        stage("defrag", None, schema::<Defrag>(&Defrag::default())),
    ];
    Json(Recipes { recipes, stages, options: schema::<Options>(&Options::default()) })
}

/// Every limit of this service.
#[derive(Serialize, ToSchema)]
pub(super) struct LimitList {
    /// Bytes of one submission, all files together.
    max_upload_bytes: u64,
    /// Files of one submission.
    max_files: u64,
    /// Submissions that are received at the same time.
    max_uploads: u64,
    /// Seconds that an upload may stand still.
    upload_idle_s: f64,
    /// Jobs that wait.
    max_queued: u32,
    /// Texels of one image.
    max_image_pixels: u64,
    /// Triangles of one model.
    max_triangles: u64,
    /// Bytes of a model's JSON.
    max_json_bytes: u64,
    /// Bytes of a submission's `options`.
    max_options_bytes: u64,
    /// Bytes of `metadata`.
    max_metadata_bytes: u64,
    /// Stages of a recipe.
    max_stages: u64,
    /// Seconds that a job may wait before it expires.
    max_wait_s: f64,
    /// Seconds that artifacts are kept.
    keep_artifacts_s: f64,
    /// Seconds that a job can be asked for after its end.
    keep_jobs_s: f64,
    /// Threads of one job.
    threads: u64,
    /// Jobs that run at once.
    jobs: u64,
    /// Bytes that running jobs may need together; a job that is expected to need more is refused.
    memory_bytes: u64,
    /// Longest `Prefer: wait=N`, in seconds.
    max_prefer_wait_s: u64,
}

/// Every limit of this service.
#[utoipa::path(get, path = "/v1/limits", tag = "service", responses((status = 200, body = LimitList)))]
pub(super) async fn limits(State(app): State<App>) -> Json<LimitList> {
    let l = &app.jobs.limits;
    Json(LimitList {
        max_upload_bytes: l.max_upload,
        max_files: l.max_files as u64,
        max_uploads: l.max_uploads as u64,
        upload_idle_s: l.upload_idle.as_secs_f64(),
        max_queued: l.max_queued,
        max_image_pixels: l.max_image_pixels,
        max_triangles: l.max_triangles,
        max_json_bytes: l.max_json,
        max_options_bytes: super::upload::MAX_OPTIONS_BYTES as u64,
        max_metadata_bytes: MAX_METADATA_BYTES as u64,
        max_stages: MAX_STAGES as u64,
        max_wait_s: l.max_wait.as_secs_f64(),
        keep_artifacts_s: l.keep_artifacts.as_secs_f64(),
        keep_jobs_s: l.keep_jobs.as_secs_f64(),
        threads: app.jobs.slots.threads() as u64,
        jobs: app.jobs.slots.count() as u64,
        memory_bytes: app.jobs.slots.memory(),
        max_prefer_wait_s: super::prefer::MAX_WAIT,
    })
}

/// The JSON Schema of a type that stands alone, its defaults filled in.
fn schema<T: ToSchema + PartialSchema + Serialize>(defaults: &T) -> Value {
    let mut parts = Vec::new();
    T::schemas(&mut parts);
    let mut out = serde_json::to_value(T::schema()).unwrap_or_default();
    let mut definitions = Map::new();
    for (name, part) in parts {
        definitions.insert(name, serde_json::to_value(part).unwrap_or_default());
    }
    if let Some(map) = out.as_object_mut() {
        map.insert("$schema".to_owned(), json!("https://json-schema.org/draft/2020-12/schema"));
        map.insert("default".to_owned(), serde_json::to_value(defaults).unwrap_or_default());
        if !definitions.is_empty() {
            map.insert("$defs".to_owned(), Value::Object(definitions));
        }
    }
    local_references(&mut out);
    out
}

fn local_references(value: &mut Value) {
    match value {
        Value::Object(map) => {
            if let Some(Value::String(target)) = map.get_mut("$ref") {
                *target = target.replace("#/components/schemas/", "#/$defs/");
            }
            map.values_mut().for_each(local_references);
        }
        Value::Array(list) => list.iter_mut().for_each(local_references),
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_schema_of_options_stands_alone() {
        let schema = schema(&Options::default());
        assert_eq!(schema["default"]["texture"]["max_size"], 8192);
        let text = schema.to_string();
        assert!(!text.contains("#/components"));
        for part in text.split("#/$defs/").skip(1) {
            let name = part.split('"').next().unwrap();
            assert!(schema["$defs"].get(name).is_some(), "{name} is not defined");
        }
    }
}
