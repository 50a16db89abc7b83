//! Where the files of a job come from, when a submission names them instead of holding them.

use serde_json::Value;

use crate::jobs::resumable::PREFIX;
use crate::params::Problem as OptionProblem;

/// The id of the upload that a text stands for.
pub(super) fn reference(text: &str) -> Option<&str> {
    let id = text.strip_prefix(PREFIX)?;
    let whole = id.len() == 32 && id.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b));
    whole.then_some(id)
}

/// A file of a job: what it is called, where that is said, and where it comes from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Source {
    /// Its path in the job.
    pub(super) path: Option<String>,
    /// `upload:` and an id, or the name of a part of the form.
    pub(super) from: String,
    /// Where the request says so.
    pub(super) pointer: String,
}

/// The files of one job.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Sources {
    /// The models, in order.
    pub(super) models: Vec<Source>,
    /// The files that they name.
    pub(super) files: Vec<Source>,
}

impl Sources {
    /// From `model` (a name, or a list of names) and `files` (a list of names, or an object from paths to names) of the object at `pointer`;
    /// null is nothing.
    ///
    /// # Errors
    /// Where it is neither.
    pub(super) fn read(model: &Value, files: &Value, pointer: &str) -> Result<Self, OptionProblem> {
        let at = format!("{pointer}/model");
        let models = match model {
            Value::String(_) => vec![named(None, model, at)?],
            Value::Array(all) if !all.is_empty() => list(all, &at)?,
            _ => return Err(OptionProblem::new(at, "`model` is the name of a file, or a list of such names")),
        };
        let at = format!("{pointer}/files");
        let files = match files {
            Value::Null => Vec::new(),
            Value::Array(all) => list(all, &at)?,
            Value::Object(all) => {
                let named = |(path, from): (&String, &Value)| {
                    named(Some(path.clone()), from, format!("{at}/{}", path.replace('~', "~0").replace('/', "~1")))
                };
                all.iter().map(named).collect::<Result<_, _>>()?
            }
            _ => {
                let message = "`files` is a list of names of files, or an object from their paths to such names";
                return Err(OptionProblem::new(at, message));
            }
        };
        Ok(Sources { models, files })
    }

    /// All of them, each with whether it is a model.
    pub(super) fn iter(&self) -> impl Iterator<Item = (&Source, bool)> {
        self.models.iter().map(|model| (model, true)).chain(self.files.iter().map(|file| (file, false)))
    }
}

fn list(all: &[Value], pointer: &str) -> Result<Vec<Source>, OptionProblem> {
    all.iter().enumerate().map(|(n, from)| named(None, from, format!("{pointer}/{n}"))).collect()
}

fn named(path: Option<String>, from: &Value, pointer: String) -> Result<Source, OptionProblem> {
    match from {
        Value::String(from) => Ok(Source { path, from: from.clone(), pointer }),
        _ => Err(OptionProblem::new(pointer, "the name of a file is a text")),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn uploads_are_told_from_names() {
        let id = "0123456789abcdef0123456789abcdef";
        assert_eq!(reference(&format!("upload:{id}")), Some(id));
        for other in [id, "upload:", "upload:0123", &format!("upload:{id}0"), &format!("upload:{}", id.to_uppercase())]
        {
            assert_eq!(reference(other), None, "{other}");
        }
    }

    #[test]
    fn sources_are_read_in_every_form() {
        let read = |model: Value, files: Value| Sources::read(&model, &files, "/items/0");
        let sources = read(json!("a.glb"), json!({"tex/a.png": "upload:1"})).unwrap();
        assert_eq!((sources.models[0].from.as_str(), sources.models[0].pointer.as_str()), ("a.glb", "/items/0/model"));
        assert_eq!(sources.files[0].path.as_deref(), Some("tex/a.png"));
        assert_eq!(sources.files[0].pointer, "/items/0/files/tex~1a.png");
        let sources = read(json!(["a", "b"]), json!(["c"])).unwrap();
        assert_eq!(
            sources.iter().map(|(s, _)| s.pointer.as_str()).collect::<Vec<_>>(),
            ["/items/0/model/0", "/items/0/model/1", "/items/0/files/0"]
        );
        for (model, files, pointer) in [
            (json!(null), json!(null), "/items/0/model"),
            (json!([]), json!(null), "/items/0/model"),
            (json!([1]), json!(null), "/items/0/model/0"),
            (json!("a"), json!("b"), "/items/0/files"),
            (json!("a"), json!({"a/b~": 1}), "/items/0/files/a~1b~0"),
        ] {
            assert_eq!(read(model, files).unwrap_err().pointer, pointer);
        }
    }
}
