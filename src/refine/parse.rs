//! Options as users write them: JSON, `--set PATH=VALUE`, a recipe's name. Every problem is found, not only the first.

mod ranges;
mod words;

use std::collections::BTreeMap;

use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

use super::box_cutter::params::BoxCutter;
use super::defrag::params::Defrag;
use super::options::{Options, Recipe, Stage};
use crate::error::{Code, Failure};
use crate::metrics::Requirement;
use crate::packing::Pack;
use crate::texture::Texture;
pub use words::nearest;
use words::{child, kind, name, short};

/// Largest `metadata`, in bytes of JSON.
pub const MAX_METADATA_BYTES: usize = 64 << 10;
/// Most stages of a recipe.
pub const MAX_STAGES: usize = 32;
/// Presets and stages that can be named, each with what it does.
pub const RECIPES: &[(&str, &str)] = &[
    ("pack", "Places the charts as they are, better."),
    (
        "box_cutter",
        "Removes overlaps, then cuts charts where that lets them pack better, within a budget of boundary length.",
    ),
    ("defrag", "Merges charts along their seams without resampling more than it must, then packs them."),
    ("scan", "For photogrammetry: merges charts, each placed for itself, and packs them tightly."),
    (
        "scan_tight",
        "The same, then cuts charts within a budget of boundary length where that makes the textures smaller still.",
    ),
    (
        "fabrication",
        "Cuts and packs 2D panels for sheets of material, without overlaps, and draws them as SVG with seam allowances or flaps.",
    ),
];
/// Names of the contract that this version does not have yet.
const LATER: &[&str] = &["optcuts", "bounded"];
/// Recipes that are no stages.
const PRESETS: &[&str] = &["scan", "scan_tight", "fabrication"];

/// One thing that is wrong with the options.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, utoipa::ToSchema)]
#[schema(as = Wrong)]
pub struct Problem {
    /// JSON pointer into the options.
    pub pointer: String,
    /// One sentence for a person.
    pub message: String,
    /// Whether the pointer names a key that is not known.
    #[serde(skip)]
    pub unknown_key: bool,
}

impl Problem {
    /// What is wrong at `pointer`.
    pub fn new(pointer: impl Into<String>, message: impl Into<String>) -> Self {
        Problem { pointer: pointer.into(), message: message.into(), unknown_key: false }
    }

    fn unknown_key(pointer: impl Into<String>, message: impl Into<String>) -> Self {
        Problem { unknown_key: true, ..Problem::new(pointer, message) }
    }
}

/// The problems as one failure, at the first one's pointer.
pub fn failure(problems: &[Problem]) -> Failure {
    let sentences: Vec<&str> = problems.iter().map(|p| p.message.as_str()).collect();
    let failure = Failure::new(Code::InvalidOptions, sentences.join("; "));
    match problems.first() {
        Some(first) => failure.at(first.pointer.clone()),
        None => failure,
    }
}

/// Options from their JSON, defaults filled in and ranges checked.
///
/// # Errors
/// All problems, in the order of the document, then those of the ranges.
pub fn options(value: &Value) -> Result<Options, Vec<Problem>> {
    let mut problems = Vec::new();
    let Some(map) = value.as_object() else {
        return Err(vec![Problem::new("", format!("options are a JSON object, not {}", kind(value)))]);
    };
    let preset = map.get("recipe").and_then(Value::as_str).unwrap_or("pack");
    let defaults = Options { recipe: Options::default().recipe, ..Options::preset(preset) };
    let known = keys(&defaults);
    let mut out = defaults;
    for (key, value) in map {
        let pointer = child("", key);
        match key.as_str() {
            "recipe" => {
                out.recipe = recipe(value, &pointer, map, &mut problems);
            }
            "pack" => out.pack = section_over(&out.pack, value, &pointer, &mut problems),
            "box_cutter" => out.box_cutter = section_over::<BoxCutter>(&out.box_cutter, value, &pointer, &mut problems),
            "defrag" => out.defrag = section_over::<Defrag>(&out.defrag, value, &pointer, &mut problems),
            "texture" => out.texture = section::<Texture>(value, &pointer, &mut problems),
            "atlas" => out.atlas = section_over(&out.atlas, value, &pointer, &mut problems),
            "fabrication" if !value.is_null() => {
                let base = out.fabrication.clone().unwrap_or_default();
                out.fabrication = Some(section_over(&base, value, &pointer, &mut problems));
            }
            "require" => out.require = requirements(value, &pointer, &mut problems),
            _ if known.iter().any(|k| k == key) => {
                let one = Value::Object(Map::from_iter([(key.clone(), value.clone())]));
                match typed::<Options>(&one, "") {
                    Ok(parsed) => take(&mut out, key, parsed),
                    Err(problem) => problems.push(problem),
                }
            }
            _ => problems.push(unknown(&pointer, key, &known)),
        }
    }
    problems.extend(ranges::ranges(&out));
    if problems.is_empty() { Ok(out) } else { Err(problems) }
}

/// The plain options, those that are not an object or a recipe of their own.
fn take(out: &mut Options, key: &str, parsed: Options) {
    match key {
        "importance" => out.importance = parsed.importance,
        "output" => out.output = parsed.output,
        "seed" => out.seed = parsed.seed,
        "work_budget" => out.work_budget = parsed.work_budget,
        "time_limit_s" => out.time_limit_s = parsed.time_limit_s,
        "metadata" => out.metadata = parsed.metadata,
        _ => {}
    }
}

/// A recipe as people name it: a preset or a stage, or stages joined by commas, as the option's JSON.
pub fn recipe_named(name: &str) -> Value {
    if !name.contains(',') {
        return Value::String(name.trim().to_owned());
    }
    name.split(',').map(|stage| serde_json::json!({ "stage": stage.trim() })).collect()
}

/// Applies `PATH=VALUE` to the options' JSON. The value is JSON where it parses as such, else a string. The path is
/// dotted; a stage's name as its first segment means that stage's parameters (`pack` has them beside the recipe).
///
/// # Errors
/// No `=`, an empty path, or a path through something that is not an object.
pub fn set(options: &mut Value, assignment: &str) -> Result<(), Problem> {
    let Some((path, text)) = assignment.split_once('=') else {
        return Err(Problem::new("", format!("`{assignment}` is not PATH=VALUE")));
    };
    let path = path.trim();
    let value: Value = serde_json::from_str(text).unwrap_or_else(|_| Value::String(text.to_owned()));
    let mut segments: Vec<&str> = path.split('.').collect();
    if segments.iter().any(|s| s.is_empty()) || segments.len() > 16 {
        return Err(Problem::new("", format!("`{path}` is not a dotted path to an option")));
    }
    if let Some(stage) = LATER.iter().find(|s| segments.first() == Some(*s)) {
        return Err(not_yet("/recipe", &format!("stage `{stage}`")));
    }
    // Paths of the report hold dots themselves: `require.atlas.charts.max` bounds `atlas.charts`.
    let joined;
    if let ["require", figure @ .., bound] = segments.as_slice()
        && !figure.is_empty()
    {
        joined = figure.join(".");
        segments = vec!["require", &joined, bound];
    }
    let mut at = options;
    let mut pointer = String::new();
    for (i, segment) in segments.iter().enumerate() {
        let Some(map) = at.as_object_mut() else {
            return Err(Problem::new(pointer, format!("`{path}`: `{}` is not an object", segments[..i].join("."))));
        };
        pointer = child(&pointer, segment);
        at = map.entry(*segment).or_insert_with(|| Value::Object(Map::new()));
    }
    *at = value;
    Ok(())
}

/// One object of options, key by key, so that every problem is found.
fn section<T: Serialize + DeserializeOwned + Default>(value: &Value, pointer: &str, problems: &mut Vec<Problem>) -> T {
    section_over(&T::default(), value, pointer, problems)
}

/// The same, on top of other values than the type's own.
fn section_over<T: Serialize + DeserializeOwned + Default>(
    base: &T,
    value: &Value,
    pointer: &str,
    problems: &mut Vec<Problem>,
) -> T {
    let Some(map) = value.as_object() else {
        problems.push(Problem::new(pointer, format!("`{}` is an object, not {}", name(pointer), kind(value))));
        return T::default();
    };
    let known = keys(&T::default());
    let mut good = Map::new();
    for (key, value) in map {
        let at = child(pointer, key);
        if !known.iter().any(|k| k == key) {
            problems.push(unknown(&at, key, &known));
        } else {
            let one = Value::Object(Map::from_iter([(key.clone(), value.clone())]));
            match typed::<T>(&one, pointer) {
                Ok(_) => drop(good.insert(key.clone(), value.clone())),
                Err(problem) => problems.push(problem),
            }
        }
    }
    let mut all = match serde_json::to_value(base) {
        Ok(Value::Object(all)) => all,
        _ => Map::new(),
    };
    all.extend(good);
    typed(&Value::Object(all), pointer).unwrap_or_default()
}

fn requirements(value: &Value, pointer: &str, problems: &mut Vec<Problem>) -> BTreeMap<String, Requirement> {
    let Some(map) = value.as_object() else {
        problems.push(Problem::new(pointer, format!("`require` is an object, not {}", kind(value))));
        return BTreeMap::new();
    };
    let mut out = BTreeMap::new();
    for (path, bounds) in map {
        let at = child(pointer, path);
        let before = problems.len();
        let requirement: Requirement = section(bounds, &at, problems);
        let bounds = [requirement.min, requirement.max, requirement.min_gain, requirement.max_ratio];
        if problems.len() == before && bounds.iter().all(Option::is_none) {
            problems.push(Problem::new(&at, "a requirement has at least one of min, max, min_gain and max_ratio"));
        }
        if problems.len() == before
            && let Err(failure) = crate::metrics::check_path(path)
        {
            problems.push(Problem::new(at, failure.message));
        }
        out.insert(path.clone(), requirement);
    }
    out
}

/// `job` is what the job's options say beside the recipe: stages start from the parameters there.
fn recipe(value: &Value, pointer: &str, job: &Map<String, Value>, problems: &mut Vec<Problem>) -> Recipe {
    match value {
        Value::String(name) if name.contains(',') => recipe(&recipe_named(name), pointer, job, problems),
        Value::String(name) => {
            if let Some(problem) = stage_problem(pointer, name) {
                problems.push(problem);
            }
            Recipe::Preset(name.clone())
        }
        Value::Array(list) => {
            if list.is_empty() || list.len() > MAX_STAGES {
                problems.push(Problem::new(pointer, format!("a recipe has 1 to {MAX_STAGES} stages")));
            }
            let each = list.iter().take(MAX_STAGES).enumerate();
            // A stage that cannot be read keeps its place, so that the others' pointers are right.
            let read = |(i, v)| stage(v, &format!("{pointer}/{i}"), job, problems).unwrap_or(Stage::Pack {});
            Recipe::Stages(each.map(read).collect())
        }
        other => {
            problems
                .push(Problem::new(pointer, format!("a recipe is a name or a list of stages, not {}", kind(other))));
            Recipe::Preset("pack".to_owned())
        }
    }
}

fn stage(value: &Value, pointer: &str, job: &Map<String, Value>, problems: &mut Vec<Problem>) -> Option<Stage> {
    let Some(name) = value.get("stage").and_then(Value::as_str) else {
        problems.push(Problem::new(pointer, "a stage is an object that names itself: {\"stage\": \"pack\"}"));
        return None;
    };
    if let Some(problem) = stage_problem(&child(pointer, "stage"), name) {
        problems.push(problem);
        return None;
    }
    let before = problems.len();
    if PRESETS.contains(&name) {
        problems.push(Problem::new(child(pointer, "stage"), format!("`{name}` is a recipe, not a stage")));
        return None;
    }
    let own = value.as_object()?;
    match name {
        "box_cutter" => return parameters(own, job, pointer, problems).map(Stage::BoxCutter),
        "defrag" => return parameters(own, job, pointer, problems).map(Stage::Defrag),
        _ => {}
    }
    for key in value.as_object()?.keys().filter(|k| *k != "stage") {
        let at = child(pointer, key);
        let own = keys(&Pack::default()).iter().any(|k| k == key);
        let hint = if own { "; its parameters stand in `pack`, beside the recipe" } else { "" };
        problems.push(Problem::unknown_key(at, format!("stage `{name}` has no parameter `{key}`{hint}")));
    }
    if problems.len() > before {
        return None;
    }
    typed(value, pointer).map_err(|p| problems.push(p)).ok()
}

/// A stage's own parameters over those that the job has for the stage.
fn parameters<T: Serialize + DeserializeOwned + Default>(
    stage: &Map<String, Value>,
    job: &Map<String, Value>,
    pointer: &str,
    problems: &mut Vec<Problem>,
) -> Option<T> {
    let before = problems.len();
    let mut own = stage.clone();
    let name = own.remove("stage");
    let beside = name.as_ref().and_then(Value::as_str).and_then(|n| job.get(n)).and_then(Value::as_object);
    // Known keys only: what is wrong beside the recipe is told there.
    let known = keys(&T::default());
    for (key, value) in beside.into_iter().flatten().filter(|(k, _)| known.contains(k)) {
        own.entry(key.clone()).or_insert_with(|| value.clone());
    }
    let params = section(&Value::Object(own), pointer, problems);
    (problems.len() == before).then_some(params)
}

fn stage_problem(pointer: &str, name: &str) -> Option<Problem> {
    if RECIPES.iter().any(|r| r.0 == name) {
        return None;
    }
    if LATER.contains(&name) {
        return Some(not_yet(pointer, &format!("recipe `{name}`")));
    }
    let names: Vec<&str> = RECIPES.iter().map(|r| r.0).collect();
    let hint = nearest(name, &names).map(|n| format!("; did you mean `{n}`?")).unwrap_or_default();
    Some(Problem::new(pointer, format!("no recipe or stage is called `{}`{hint}", short(name))))
}

fn not_yet(pointer: &str, what: &str) -> Problem {
    Problem::new(pointer, format!("{what} is not available in this version"))
}

fn unknown(pointer: &str, key: &str, known: &[String]) -> Problem {
    let known: Vec<&str> = known.iter().map(String::as_str).collect();
    let hint = match nearest(key, &known) {
        Some(near) => format!("did you mean `{near}`?"),
        None => format!("known here: {}", known.join(", ")),
    };
    Problem::unknown_key(pointer, format!("unknown option `{}`; {hint}", short(key)))
}

/// The value as `T`, or where and why it is not one.
fn typed<T: DeserializeOwned>(value: &Value, pointer: &str) -> Result<T, Problem> {
    serde_path_to_error::deserialize(value).map_err(|error| {
        let mut at = pointer.to_owned();
        for segment in error.path().iter() {
            use serde_path_to_error::Segment;
            match segment {
                Segment::Seq { index } => at = child(&at, &index.to_string()),
                Segment::Map { key } => at = child(&at, key),
                Segment::Enum { .. } | Segment::Unknown => {}
            }
        }
        let text = error.inner().to_string();
        let text = text.replace("expected u32", "expected a whole number of at least 0");
        let text = text.replace("expected u64", "expected a whole number of at least 0");
        let text = text
            .replace("expected u8", "expected a whole number in 0..=255")
            .replace("expected f64", "expected a number");
        let message = format!("`{}`: {}", name(&at), short(&text));
        Problem::new(at, message)
    })
}

fn keys<T: Serialize>(value: &T) -> Vec<String> {
    match serde_json::to_value(value) {
        Ok(Value::Object(map)) => map.keys().cloned().collect(),
        _ => Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::packing::{Gutter, Rotation};
    use crate::texture::Size;

    #[test]
    fn empty_options_are_the_defaults_and_every_default_reads_back() {
        assert_eq!(options(&json!({})).unwrap(), Options::default());
        let filled = serde_json::to_value(Options::default()).unwrap();
        assert_eq!(options(&filled).unwrap(), Options::default());
    }

    #[test]
    fn every_problem_is_found_with_its_pointer() {
        let bad = json!({
            "pack": {"gutters": 2, "grid": 0, "rotation": "quater"}, "texture": {"jpeg_quality": 101, "mutliple_of": 4},
            "atlas": {"merge": 1, "uv_set": 9}, "importance": {"attribute": "COLOR_0.red"}, "time_limit_s": -1,
            "require": {"atlas.charts": {}, "model.x/y": {"minimum": 1}}, "recipe": [{"stage": "pack", "grid": 2}, {"stage": "bounded"}],
            "seed": "x", "colour": 1,
        });
        let problems = options(&bad).unwrap_err();
        let found: BTreeMap<&str, &str> = problems.iter().map(|p| (p.pointer.as_str(), p.message.as_str())).collect();
        for (pointer, part) in [
            ("/pack/gutters", "did you mean `gutter`?"),
            ("/pack/grid", "outside 1..=64"),
            ("/pack/rotation", "`quarter`"),
            ("/texture/jpeg_quality", "outside 1..=100"),
            ("/texture/mutliple_of", "`multiple_of`"),
            ("/atlas/merge", "boolean"),
            ("/atlas/uv_set", "outside 0..=7"),
            ("/importance/attribute", "such as COLOR_0.r"),
            ("/time_limit_s", "-1"),
            ("/require/atlas.charts", "at least one of"),
            ("/require/model.x~1y/minimum", "did you mean `min`?"),
            ("/recipe/0/grid", "beside the recipe"),
            ("/recipe/1/stage", "not available in this version"),
            ("/seed", "invalid type"),
            ("/colour", "unknown option `colour`"),
        ] {
            let message = found.get(pointer).unwrap_or_else(|| panic!("{pointer} is missing in {found:#?}"));
            assert!(message.contains(part), "{pointer}: {message}");
        }
        assert_eq!(problems.len(), 15, "{problems:#?}");
    }

    #[test]
    fn sizes_must_agree() {
        let bad = |texture: Value| options(&json!({ "texture": texture })).unwrap_err().remove(0).pointer;
        assert_eq!(bad(json!({"size": [64, 64], "max_size": 32})), "/texture/size");
        assert_eq!(bad(json!({"size": [63, 64]})), "/texture/size");
        assert_eq!(bad(json!({"size": [0, 64]})), "/texture/size");
        assert_eq!(bad(json!({"size": [96, 64], "power_of_two": true})), "/texture/size");
        assert_eq!(bad(json!({"max_size": 15})), "/texture/max_size");
        assert_eq!(bad(json!({"format": "ktx2"})), "/texture/format");
        assert!(options(&json!({"texture": {"size": [64, 32]}})).is_ok());
    }

    #[test]
    fn what_is_neutral_is_accepted() {
        assert!(options(&json!({"importance": null, "atlas": {"merge": false}, "work_budget": null})).is_ok());
    }

    #[test]
    fn presets_and_stages_have_their_parameters() {
        let panels = options(&json!({"recipe": "fabrication", "pack": {"gutter": 3}})).unwrap();
        assert_eq!((panels.pack.rotation, panels.pack.gutter), (Rotation::Any, Gutter::Texels(3)));
        assert!(panels.fabrication.is_some());
        assert_eq!(panels.stages()[0].name(), "box_cutter");

        let recipe = json!([{"stage": "box_cutter", "max_charts": 9}, {"stage": "pack"}]);
        let listed = options(&json!({"recipe": recipe, "box_cutter": {"max_boundary_length": 1.2}})).unwrap();
        let Stage::BoxCutter(params) = &listed.stages()[0] else { panic!("{listed:?}") };
        assert_eq!((params.max_charts, params.max_boundary_length), (Some(9), Some(1.2)), "the stage's own come first");

        let scan = options(&json!({"recipe": "scan_tight", "box_cutter": {"beam": 2}})).unwrap();
        let names: Vec<&str> = scan.stages().iter().map(Stage::name).collect();
        assert_eq!((names, scan.box_cutter.beam), (vec!["defrag", "box_cutter"], 2));

        let bad = json!({"recipe": [{"stage": "box_cutter", "max_chart": 9}, {"stage": "box_cutter", "beam": 0}], "box_cutter": {"alpha": 9}});
        let found: Vec<String> = options(&bad).unwrap_err().into_iter().map(|p| p.pointer).collect();
        assert_eq!(found, ["/recipe/0/max_chart", "/box_cutter/alpha", "/recipe/1/alpha", "/recipe/1/beam"]);
    }

    #[test]
    fn fabrication_is_asked_for() {
        assert_eq!(options(&json!({"fabrication": null})).unwrap().fabrication, None);
        let asked = options(&json!({"fabrication": {"width_mm": 5}})).unwrap().fabrication;
        assert_eq!(asked.unwrap().width_mm, 5.0);
        let wrong = options(&json!({"fabrication": {"fold_angle": 4, "seam": "flaps"}})).unwrap_err();
        let found: Vec<&str> = wrong.iter().map(|p| p.pointer.as_str()).collect();
        assert_eq!(found, ["/fabrication/seam", "/fabrication/fold_angle"]);
    }

    #[test]
    fn importance_has_one_source() {
        let pointer = |value: Value| options(&json!({ "importance": value })).unwrap_err().remove(0).pointer;
        assert_eq!(pointer(json!({"attribute": "COLOR_0.r", "texture": "x.png"})), "/importance");
        assert_eq!(pointer(json!({"materials": {"a/b": -1}})), "/importance/materials/a~1b");
        assert_eq!(pointer(json!({"texture": ""})), "/importance/texture");
        assert!(pointer(json!({"vertex": 1})).starts_with("/importance"));
        assert!(options(&json!({"importance": {"materials": {"skin": 20}}})).is_ok());
    }

    #[test]
    fn paths_set_values() {
        let mut value = json!({});
        for text in [
            "pack.rotation=any",
            "pack.gutter=3",
            "texture.size=[64, 32]",
            "require.atlas.packing_efficiency.min=0.8",
            "metadata.who=me=you",
        ] {
            set(&mut value, text).unwrap();
        }
        let options = options(&value).unwrap();
        assert_eq!(options.pack.rotation, Rotation::Any);
        assert_eq!(options.pack.gutter, Gutter::Texels(3));
        assert_eq!(options.texture.size, Size::Fixed([64, 32]));
        assert_eq!(options.require["atlas.packing_efficiency"].min, Some(0.8));
        assert_eq!(options.metadata["who"], "me=you");
        assert!(set(&mut value, "pack").is_err());
        assert!(set(&mut value, "pack..x=1").is_err());
        assert!(set(&mut value, "pack.rotation.x=1").is_err());
        set(&mut value, "box_cutter.max_boundary_length=1.3").unwrap();
        assert_eq!(super::options(&value).unwrap().box_cutter.max_boundary_length, Some(1.3));
        assert!(set(&mut value, "bounded.padding=1").unwrap_err().message.contains("not available"));
    }

    #[test]
    fn recipes_are_names_or_stages() {
        let named = |name: &str| options(&json!({ "recipe": recipe_named(name) }));
        assert_eq!(named("pack").unwrap().recipe, Recipe::Preset("pack".to_owned()));
        assert_eq!(named("pack, pack").unwrap().recipe, Recipe::Stages(vec![Stage::Pack {}, Stage::Pack {}]));
        assert!(named("pak").unwrap_err()[0].message.contains("did you mean `pack`?"));
        assert!(named("optcuts,pack").unwrap_err()[0].message.contains("not available"));
        assert!(named("scan,pack").unwrap_err()[0].message.contains("is a recipe"));
        let defrag = Stage::Defrag(Defrag { retry: false, ..Defrag::default() });
        let listed = options(&json!({ "recipe": recipe_named("defrag,pack"), "defrag": {"retry": false} })).unwrap();
        assert_eq!(listed.stages(), [defrag, Stage::Pack {}]);
        assert!(options(&json!({"recipe": []})).is_err());
        assert!(options(&json!({"recipe": 1})).is_err());
    }
}
