//! The options of a job as its row holds them: another version of Intarsia may have stored them.

use serde_json::Value;

use crate::error::{Failure, Result, Warning};
use crate::refine::options::Options;
use crate::refine::parse;

/// Reads stored options. What they lack has its default; keys that this version does not know are left out, each with a warning. A value
/// that it does not know is a failure: the result would not be the one that was asked for.
///
/// # Errors
/// `internal` with what cannot be read.
pub(super) fn read(stored: &Value) -> Result<(Options, Vec<Warning>)> {
    let mut value = stored.clone();
    let mut ignored = Vec::new();
    loop {
        let problems = match parse::options(&value) {
            Ok(options) => return Ok((options, ignored)),
            Err(problems) => problems,
        };
        let before = ignored.len();
        for problem in problems.iter().filter(|p| p.unknown_key) {
            if remove(&mut value, &problem.pointer) {
                let message = format!("another version of Intarsia stored this job; {}", problem.message);
                ignored.push(Warning::new("option_ignored", message).at(problem.pointer.clone()));
            }
        }
        if ignored.len() == before {
            let why = parse::failure(&problems).message;
            return Err(Failure::internal(format!("the stored options cannot be read: {why}")));
        }
    }
}

/// Removes what the JSON pointer names; false where there is no such key.
fn remove(value: &mut Value, pointer: &str) -> bool {
    let Some((parent, key)) = pointer.rsplit_once('/') else { return false };
    let key = key.replace("~1", "/").replace("~0", "~");
    value.pointer_mut(parent).and_then(Value::as_object_mut).is_some_and(|map| map.remove(&key).is_some())
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn what_is_stored_is_read_as_it_was() {
        let stages =
            json!({"recipe": [{"stage": "defrag", "max_resampled": 0.3}, {"stage": "box_cutter"}, {"stage": "pack"}]});
        let rich = json!({"fabrication": {"numbers": true}, "require": {"atlas.charts": {"max": 1}}, "metadata": {"a": {"b": 1}},
            "importance": {"materials": {"m": 2.0}}, "texture": {"size": [64, 32]}, "pack": {"gutter": 3}});
        let named = crate::refine::recipe::recipes().map(|r| json!({ "recipe": r.0 }));
        for given in named.chain([stages, rich]) {
            let options = parse::options(&given).unwrap();
            assert_eq!(read(&serde_json::to_value(&options).unwrap()), Ok((options, Vec::new())), "{given}");
        }
    }

    #[test]
    fn keys_of_another_version_are_left_out_with_a_warning_and_missing_ones_have_their_defaults() {
        let mut stored = serde_json::to_value(Options::preset("scan")).unwrap();
        let map = stored.as_object_mut().unwrap();
        map.remove("atlas");
        map.insert("a/b".into(), json!(1));
        map["pack"].as_object_mut().unwrap().insert("later".into(), json!({"deep": 1}));
        map["require"] = json!({"atlas.charts": {"max": 1.0, "later": 2}});
        let (options, ignored) = read(&stored).unwrap();
        assert_eq!(options.atlas, Options::preset("scan").atlas, "defaults are those of the recipe");
        assert_eq!(options.require["atlas.charts"].max, Some(1.0));
        let mut pointers: Vec<&str> = ignored.iter().filter_map(|w| w.pointer.as_deref()).collect();
        pointers.sort_unstable();
        assert_eq!(pointers, ["/a~1b", "/pack/later", "/require/atlas.charts/later"]);
        let stages = json!({"recipe": [{"stage": "pack", "later": 1}, {"stage": "defrag", "later": 1}]});
        assert_eq!(read(&stages).unwrap().1.len(), 2);
    }

    #[test]
    fn values_of_another_version_are_a_failure_that_names_them() {
        for (stored, part) in [
            (json!({"recipe": "later"}), "later"),
            (json!({"pack": {"rotation": "eighth", "later": 1}}), "eighth"),
            (json!([]), "object"),
        ] {
            let failure = read(&stored).unwrap_err();
            assert_eq!(failure.code, crate::error::Code::Internal);
            assert!(failure.message.contains(part), "{failure}");
        }
    }
}
