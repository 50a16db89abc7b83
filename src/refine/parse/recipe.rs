//! Recipes as users write them.

use serde_json::{Map, Value, json};

use crate::params::{Problem, child, keys, kind, near_or_all, short};
use crate::refine::erased::ErasedStage;
use crate::refine::recipe::{MAX_STAGES, Recipe, preset, recipes};
use crate::refine::table;

/// A recipe as people name it: a preset or a stage, or stages joined by commas, as the option's JSON.
pub fn recipe_named(name: &str) -> Value {
    if !name.contains(',') {
        return Value::String(name.trim().to_owned());
    }
    name.split(',').map(|stage| json!({ "stage": stage.trim() })).collect()
}

/// `job` is what the job's options say beside the recipe: stages start from the parameters there.
pub(super) fn recipe(value: &Value, pointer: &str, job: &Map<String, Value>, problems: &mut Vec<Problem>) -> Recipe {
    match value {
        Value::String(name) if name.contains(',') => recipe(&recipe_named(name), pointer, job, problems),
        Value::String(name) => {
            problems.extend(unknown_name(pointer, name));
            Recipe::Preset(name.clone())
        }
        Value::Array(list) => {
            if list.is_empty() || list.len() > MAX_STAGES {
                problems.push(Problem::new(pointer, format!("a recipe has 1 to {MAX_STAGES} stages")));
            }
            let each = list.iter().take(MAX_STAGES).enumerate();
            // A stage that cannot be read keeps its place, so that the others' pointers are right.
            let unread = ErasedStage::of::<crate::packing::Pack>;
            let read = |(i, v)| stage(v, &format!("{pointer}/{i}"), job, problems).unwrap_or_else(unread);
            Recipe::Stages(each.map(read).collect())
        }
        other => {
            problems
                .push(Problem::new(pointer, format!("a recipe is a name or a list of stages, not {}", kind(other))));
            Recipe::Preset("pack".to_owned())
        }
    }
}

fn stage(value: &Value, pointer: &str, job: &Map<String, Value>, problems: &mut Vec<Problem>) -> Option<ErasedStage> {
    let own = value.as_object();
    let Some((own, name)) = own.and_then(|own| Some((own, own.get("stage")?.as_str()?))) else {
        problems.push(Problem::new(pointer, "a stage is an object that names itself: {\"stage\": \"pack\"}"));
        return None;
    };
    let at = child(pointer, "stage");
    let Some(stage) = table::find(name) else {
        let is_recipe = || Problem::new(&at, format!("`{name}` is a recipe, not a stage"));
        problems.extend(preset(name).map(|_| is_recipe()).or_else(|| unknown_name(&at, name)));
        return None;
    };
    let before = problems.len();
    let known = keys(&stage.to_value());
    let mut own = own.clone();
    own.shift_remove("stage");
    if stage.is_shared() {
        for key in own.keys() {
            let hint = match known.contains(key) {
                true => format!("; its parameters stand in `{name}`, beside the recipe"),
                false => String::new(),
            };
            let text = format!("stage `{name}` has no parameter `{key}`{hint}");
            problems.push(Problem::unknown_key(child(pointer, key), text));
        }
        return (problems.len() == before).then_some(stage);
    }
    // The stage's own parameters over those of its section. Known keys only: what else is wrong there is told there.
    let section = job.get(name).and_then(Value::as_object).into_iter().flatten();
    for (key, value) in section.filter(|(key, _)| known.contains(key)) {
        own.entry(key.clone()).or_insert_with(|| value.clone());
    }
    let read = stage.over(&Value::Object(own), pointer, problems);
    (problems.len() == before).then_some(read)
}

/// What is wrong with a name that is neither a stage's nor a preset's.
fn unknown_name(pointer: &str, name: &str) -> Option<Problem> {
    let names: Vec<&str> = recipes().map(|(name, _)| name).collect();
    if names.contains(&name) {
        return None;
    }
    let text = format!("no recipe or stage is called `{}`; {}", short(name), near_or_all(name, &names));
    Some(Problem::new(pointer, text))
}
