//! `/v1/recipes` and `/v1/limits`: what can be asked for, and how much of it.

use axum::Json;
use axum::extract::State;
use serde::Serialize;
use serde_json::{Map, Value, json};
use utoipa::openapi::{RefOr, Schema};
use utoipa::{PartialSchema, ToSchema};

use super::App;
use super::examples;
use crate::asset::MAX_ENTRIES;
use crate::refine::erased::{ErasedStage, NamedSchemas};
use crate::refine::options::{Options, OptionsSchema};
use crate::refine::parse::MAX_METADATA_BYTES;
use crate::refine::recipe::{self, MAX_STAGES};
use crate::refine::table;

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
    parameters_at: Option<String>,
    /// JSON Schema of its parameters.
    parameters: Value,
}

/// Presets, and stages with their parameters as JSON Schema.
#[utoipa::path(get, path = "/v1/recipes", tag = "service", responses(
    (status = 200, description = "What can be asked for", body = Recipes, example = json!(examples::recipes()))))]
pub(super) async fn recipes() -> Json<Recipes> {
    let recipes = recipe::recipes().map(|(name, description)| Named { name, description }).collect();
    let stages = table::all().map(|stage| StageInfo::new(&stage)).collect();
    let mut parts = Vec::new();
    OptionsSchema::schemas(&mut parts);
    let options = standalone(OptionsSchema::schema(), parts, &Options::default());
    Json(Recipes { recipes, stages, options })
}

impl StageInfo {
    fn new(stage: &ErasedStage) -> Self {
        StageInfo {
            stage: stage.name(),
            description: stage.description(),
            parameters_at: stage.is_shared().then(|| format!("/{}", stage.name())),
            parameters: standalone(stage.schema(), stage.referred(), &stage.to_value()),
        }
    }
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
    /// Bytes a second that an upload must send on average, after a grace.
    min_upload_rate: u64,
    /// Seconds of that grace.
    upload_rate_grace_s: f64,
    /// Jobs that wait.
    max_queued: u32,
    /// Bytes of the uploads of all jobs that wait or run.
    max_waiting_bytes: u64,
    /// Bytes of all artifacts that are kept.
    max_stored_bytes: u64,
    /// Texels of one image.
    max_image_pixels: u64,
    /// Triangles of one model.
    max_triangles: u64,
    /// Bytes of a model's JSON.
    max_json_bytes: u64,
    /// Levels of a model's JSON.
    max_json_nesting: u32,
    /// Entries of an archive.
    max_archive_entries: u64,
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
    /// Items of a batch.
    max_batch_items: u64,
    /// Uploads in pieces that are kept.
    max_kept_uploads: u32,
    /// Seconds that an upload in pieces is kept after its last byte came.
    keep_uploads_s: f64,
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
#[utoipa::path(get, path = "/v1/limits", tag = "service", responses(
    (status = 200, description = "How much of it", body = LimitList, example = json!(examples::limits()))))]
pub(super) async fn limits(State(app): State<App>) -> Json<LimitList> {
    let l = &app.jobs.limits;
    Json(LimitList {
        max_upload_bytes: l.max_upload,
        max_files: l.max_files as u64,
        max_uploads: l.max_uploads as u64,
        upload_idle_s: l.upload_idle.as_secs_f64(),
        min_upload_rate: l.min_upload_rate,
        upload_rate_grace_s: super::upload::RATE_GRACE.as_secs_f64(),
        max_queued: l.max_queued,
        max_waiting_bytes: l.max_waiting,
        max_stored_bytes: l.max_stored,
        max_image_pixels: l.max_image_pixels,
        max_triangles: l.max_triangles,
        max_json_bytes: l.max_json,
        max_json_nesting: super::preflight::MAX_JSON_NESTING,
        max_archive_entries: MAX_ENTRIES as u64,
        max_options_bytes: super::upload::MAX_OPTIONS_BYTES as u64,
        max_metadata_bytes: MAX_METADATA_BYTES as u64,
        max_stages: MAX_STAGES as u64,
        max_wait_s: l.max_wait.as_secs_f64(),
        keep_artifacts_s: l.keep_artifacts.as_secs_f64(),
        keep_jobs_s: l.keep_jobs.as_secs_f64(),
        max_batch_items: super::batch_request::MAX_ITEMS as u64,
        max_kept_uploads: l.max_kept_uploads,
        keep_uploads_s: l.keep_uploads.as_secs_f64(),
        threads: app.jobs.slots.threads() as u64,
        jobs: app.jobs.slots.count() as u64,
        memory_bytes: app.jobs.slots.memory(),
        max_prefer_wait_s: super::prefer::MAX_WAIT,
    })
}

/// A JSON Schema that stands alone: with the schemas that it refers to, and the defaults.
fn standalone(schema: RefOr<Schema>, referred: NamedSchemas, defaults: &impl Serialize) -> Value {
    let mut out = serde_json::to_value(schema).unwrap_or_default();
    let mut definitions = Map::new();
    for (name, part) in referred {
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
    use clap::Parser;

    use super::*;
    use crate::config::{Cli, Command};
    use crate::refine::parse;

    async fn listing() -> Value {
        serde_json::to_value(&recipes().await.0).unwrap()
    }

    #[tokio::test]
    async fn every_schema_stands_alone() {
        let listing = listing().await;
        assert_eq!(listing["options"]["default"]["texture"]["max_size"], 8192);
        let stages = listing["stages"].as_array().unwrap().iter().map(|stage| &stage["parameters"]);
        for schema in stages.chain([&listing["options"]]) {
            let text = schema.to_string();
            assert!(!text.contains("#/components"));
            for part in text.split("#/$defs/").skip(1) {
                let name = part.split('"').next().unwrap();
                assert!(schema["$defs"].get(name).is_some(), "{name} is not defined");
            }
        }
    }

    /// A schema with those that it refers to or is one of, except other sections.
    fn alternatives<'a>(all: &'a Value, schema: &'a Value) -> Vec<&'a Value> {
        let referred = schema["$ref"].as_str().map(|target| &all["$defs"][target.trim_start_matches("#/$defs/")]);
        let one_of = schema["oneOf"].as_array().into_iter().flatten();
        let more = referred.into_iter().chain(one_of).flat_map(|part| alternatives(all, part));
        std::iter::once(schema).chain(more).collect()
    }

    #[tokio::test]
    async fn the_bounds_of_the_schema_are_those_that_are_held() {
        let all = &listing().await["options"];
        let mut bounds = 0;
        let mut hold = |path: &[&str], schema: &Value| {
            for (key, beyond) in [("minimum", -1.0), ("maximum", 1.0), ("exclusiveMinimum", 0.0)] {
                let Some(end) = alternatives(all, schema).iter().find_map(|s| s[key].as_f64()) else { continue };
                let number = |n: f64| if n.fract() == 0.0 { json!(n as i64) } else { json!(n) };
                let given = |n: f64| path.iter().rev().fold(number(n), |inner, key| json!({*key: inner}));
                assert!(beyond == 0.0 || parse::options(&given(end)).is_ok(), "{path:?}: {key} {end} is refused");
                assert!(parse::options(&given(end + beyond)).is_err(), "{path:?}: {key} {end} does not hold");
                bounds += 1;
            }
        };
        for (key, schema) in all["properties"].as_object().unwrap() {
            hold(&[key], schema);
            for section in alternatives(all, schema) {
                for (parameter, schema) in section["properties"].as_object().into_iter().flatten() {
                    hold(&[key, parameter], schema);
                }
            }
        }
        assert!(bounds > 60, "{bounds} bounds");
    }

    /// What a preset has another value for has no default: a client that sends defaults along would undo the preset.
    #[tokio::test]
    async fn a_default_holds_with_every_recipe() {
        let all = &listing().await["options"];
        for (name, _) in recipe::recipes() {
            let with_recipe = serde_json::to_value(Options::preset(name)).unwrap();
            for (section, schema) in all["properties"].as_object().unwrap() {
                for part in alternatives(all, schema) {
                    for (key, schema) in part["properties"].as_object().into_iter().flatten() {
                        let own = with_recipe.pointer(&format!("/{section}/{key}"));
                        if let (Some(default), Some(own)) = (schema.get("default"), own) {
                            assert_eq!(own, default, "{section}.{key} with {name}");
                        }
                    }
                }
            }
        }
    }

    /// `nudge` is one file under `refine/tests`, and one line in the table.
    #[tokio::test]
    async fn a_stage_of_one_file_and_one_line_is_everywhere() {
        // In the listing.
        let listing = listing().await;
        let of = |list: &str, key: &str| {
            let all = listing[list].as_array().unwrap();
            all.iter().find(|e| e[key] == "nudge").unwrap_or_else(|| panic!("not in {list}")).clone()
        };
        assert_eq!(of("recipes", "name")["description"], "Moves all charts a little.");
        let stage = of("stages", "stage");
        let by = &stage["parameters"]["properties"]["by"];
        assert_eq!((&stage["parameters_at"], &by["minimum"], &by["maximum"]), (&Value::Null, &json!(1), &json!(64)));
        assert_eq!(listing["options"]["default"]["nudge"], json!({"by": 1, "breaks": false, "spoils": false}));

        // In the OpenAPI document: its parameters, their section in the options, and the stage in a recipe.
        let contract = serde_json::to_value(crate::http::router::openapi()).unwrap();
        let schemas = &contract["components"]["schemas"];
        let by = &schemas["Nudge"]["properties"]["by"];
        assert_eq!(
            (&by["description"], &by["default"]),
            (&json!("How far the charts move to the right, in texels."), &json!(1))
        );
        assert_eq!(schemas["Options"]["properties"]["nudge"]["$ref"], "#/components/schemas/Nudge");
        assert_eq!(schemas["Options"]["additionalProperties"], false);
        assert_eq!(schemas["Options"]["description"], "All options of a job.");
        let stages = schemas["Stage"]["oneOf"].as_array().unwrap();
        let nudge = stages.iter().find(|s| s["properties"]["stage"]["enum"][0] == "nudge").unwrap();
        assert_eq!(nudge["properties"]["by"]["maximum"], 64);

        // On the command line: as a recipe, among others, and with its parameters; what is wrong is told.
        let given = |arguments: &[&str]| {
            let line = ["intarsia", "refine", "in.glb", "-o", "out.glb"].iter().chain(arguments);
            let Command::Refine(refine) = Cli::try_parse_from(line).unwrap().command else { panic!("refine") };
            parse::command_line(json!({}), &refine.options, None)
        };
        for recipe in ["nudge", "pack,nudge"] {
            let options = given(&["--recipe", recipe, "--set", "nudge.by=3"]).unwrap();
            let last = options.steps().pop().unwrap().stage;
            assert_eq!((last.name(), &last.to_value()["by"]), ("nudge", &json!(3)));
        }
        let wrong = given(&["--recipe", "nudg", "--set", "nudge.by=65", "--set", "nudge.buy=1"]).unwrap_err();
        let told: Vec<&str> = wrong.iter().map(|p| p.message.as_str()).collect();
        assert_eq!(
            told,
            [
                "no recipe or stage is called `nudg`; did you mean `nudge`?",
                "unknown option `buy`; did you mean `by`?",
                "`by` is 65, outside 1..=64",
            ]
        );
    }
}
