//! Options as users write them: JSON, `--set PATH=VALUE`, a recipe's name. Every problem is found, not only the first.

mod json;
mod ranges;
mod recipe;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use serde_json::{Map, Value};

use super::options::{Container, Options, OutputOptions};
use crate::config::OptionFlags;
use crate::error::{Code, Failure, WARNINGS};
use crate::metrics::Requirement;
pub use crate::params::{Problem, near_or_all};
use crate::params::{child, keys, kind, section, short, typed, unknown};
pub use json::json;
pub use recipe::recipe_named;

/// Largest `metadata`, in bytes of JSON.
pub const MAX_METADATA_BYTES: usize = 64 << 10;

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
    let mut out = Options { recipe: Options::default().recipe, ..Options::preset(preset) };
    let known = keys(&out);
    let mut plain = Map::new();
    for (key, value) in map {
        let pointer = child("", key);
        match key.as_str() {
            "recipe" => out.recipe = recipe::recipe(value, &pointer, map, &mut problems),
            "pack" => out.pack = section(&out.pack, value, &pointer, &mut problems),
            "texture" => out.texture = section(&out.texture, value, &pointer, &mut problems),
            "atlas" => out.atlas = section(&out.atlas, value, &pointer, &mut problems),
            "fabrication" if value.is_null() => out.fabrication = None,
            "fabrication" => {
                let base = out.fabrication.clone().unwrap_or_default();
                out.fabrication = Some(section(&base, value, &pointer, &mut problems));
            }
            "output" if value.is_object() => {
                out.output = section(&OutputOptions::default(), value, &pointer, &mut problems).into();
            }
            "strict" => out.strict = strict(value, &pointer, &mut problems),
            "require" => out.require = requirements(value, &pointer, &mut problems),
            _ if !known.contains(key) => problems.push(unknown_option(&pointer, key, &known)),
            _ => match out.stages.find(key).map(|own| own.over(value, &pointer, &mut problems)) {
                Some(stage) => out.stages.replace(stage),
                None => {
                    let one = Value::Object(Map::from_iter([(key.clone(), value.clone())]));
                    match typed::<Options>(&one, "") {
                        Ok(_) => drop(plain.insert(key.clone(), value.clone())),
                        Err(problem) => problems.push(problem),
                    }
                }
            },
        }
    }
    let Options { recipe, pack, stages, texture, atlas, fabrication, output, require, strict, .. } = out;
    let plain: Options = typed(&Value::Object(plain), "").unwrap_or_default();
    let output = if value.get("output").is_some_and(Value::is_object) { output } else { plain.output };
    let out = Options { recipe, pack, stages, texture, atlas, fabrication, output, require, strict, ..plain };
    problems.extend(ranges::ranges(&out));
    if problems.is_empty() { Ok(out) } else { Err(problems) }
}

/// The problem of an option that there is not: it may stand in a section.
fn unknown_option(pointer: &str, key: &str, known: &[String]) -> Problem {
    let all = serde_json::to_value(Options { fabrication: Some(Default::default()), ..Options::default() });
    let sections = all.as_ref().ok().and_then(Value::as_object).into_iter().flatten();
    let holds = |section: &Value| section.as_object().is_some_and(|s| s.contains_key(key));
    let places: Vec<String> =
        sections.filter(|(_, section)| holds(section)).map(|(name, _)| format!("`{name}.{key}`")).collect();
    if places.is_empty() {
        return unknown(pointer, key, known);
    }
    let text = format!("unknown option `{}`; it stands in a section: {}", short(key), places.join(", "));
    Problem::unknown_key(pointer, text)
}

/// The options of a command line: those of its file, then its recipe and the output's container, then each `--set`.
///
/// # Errors
/// All problems.
pub fn command_line(
    mut value: Value,
    flags: &OptionFlags,
    container: Option<Container>,
) -> Result<Options, Vec<Problem>> {
    let recipe = flags.recipe.as_deref().map(recipe_named);
    let container = container.map(|container| serde_json::to_value(container).unwrap_or_default());
    if let Some(map) = value.as_object_mut() {
        map.extend(recipe.map(|recipe| ("recipe".to_owned(), recipe)));
        if let Some(container) = container {
            // What the file says of compression stays.
            let mut output = map.get("output").and_then(Value::as_object).cloned().unwrap_or_default();
            output.insert("container".to_owned(), container);
            map.insert("output".to_owned(), Value::Object(output));
        }
    }
    let mut problems: Vec<Problem> = flags.set.iter().filter_map(|text| set(&mut value, text).err()).collect();
    match options(&value) {
        Ok(options) if problems.is_empty() => return Ok(options),
        Ok(_) => {}
        Err(more) => problems.extend(more),
    }
    Err(problems)
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

/// Codes of warnings, each once.
fn strict(value: &Value, pointer: &str, problems: &mut Vec<Problem>) -> Vec<String> {
    let Some(list) = value.as_array() else {
        let text = format!("`strict` is a list of codes of warnings, such as [\"missing_image\"], not {}", kind(value));
        problems.push(Problem::new(pointer, text));
        return Vec::new();
    };
    let known: Vec<&str> = WARNINGS.iter().map(|w| w.0).collect();
    let mut out: Vec<String> = Vec::new();
    for (i, code) in list.iter().enumerate() {
        let at = child(pointer, &i.to_string());
        match code.as_str() {
            Some(code) if out.iter().any(|c| c == code) => {}
            Some(code) if known.contains(&code) => out.push(code.to_owned()),
            Some(code) => {
                let text = format!("no warning has the code `{}`; {}", short(code), near_or_all(code, &known));
                problems.push(Problem::new(at, text));
            }
            None => problems.push(Problem::new(at, format!("the code of a warning is a string, not {}", kind(code)))),
        }
    }
    out
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
        let requirement: Requirement = section(&Requirement::default(), bounds, &at, problems);
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
