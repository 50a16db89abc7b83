//! What a user's requirements, and `strict`, make of a result.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::Value;
use utoipa::ToSchema;

use super::{Measures, Report};
use crate::error::{Code, Failure, Result};
use crate::metrics::Requirement;
use crate::params::{listed, nearest};

/// A requirement that is not met.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[schema(as = UnmetRequirement)]
pub struct Unmet {
    /// Dotted path into the report.
    pub path: String,
    /// What was asked.
    pub wanted: String,
    /// What was reached; null where the figure is not defined.
    pub got: Option<f64>,
    /// Which atlas it was found in, or why it is undefined: for the command line; the contract does not have it.
    #[serde(skip)]
    pub detail: Option<String>,
}

/// What a result that is there fails its job for.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Verdict {
    /// Requirements that are not met.
    pub unmet: Vec<Unmet>,
    /// Warnings that `strict` names: how many there are of each code.
    pub strict: BTreeMap<String, u64>,
}

impl Verdict {
    /// The failure, where there is one. A warning comes first: it may be why a figure is missed.
    pub fn failure(&self) -> Option<Failure> {
        let paths: Vec<&str> = self.unmet.iter().map(|f| f.path.as_str()).collect();
        let unmet = (!paths.is_empty()).then(|| format!("not met: {}", paths.join(", ")));
        let count = |(code, n): (&String, &u64)| if *n > 1 { format!("{code} ({n} times)") } else { code.clone() };
        let strict: Vec<String> = self.strict.iter().map(count).collect();
        if strict.is_empty() {
            return unmet.map(|text| Failure::new(Code::RequirementNotMet, text).at("/require"));
        }
        let more = unmet.map(|text| format!("; {text}")).unwrap_or_default();
        let text = format!("there are warnings that `strict` names: {}{more}", strict.join(", "));
        Some(Failure::new(Code::StrictWarning, text).at("/strict"))
    }
}

/// Judges a report by what the user requires, and the warnings, counted by code, by those that `strict` names.
///
/// # Errors
/// `invalid_options` for an unknown path in `require`.
pub fn judge(
    report: &Report,
    require: &BTreeMap<String, Requirement>,
    strict: &[String],
    warnings: BTreeMap<String, u64>,
) -> Result<Verdict> {
    let strict = warnings.into_iter().filter(|(code, _)| strict.contains(code)).collect();
    Ok(Verdict { unmet: unmet(report, require)?, strict })
}

/// Every path that `require` may name.
pub fn paths() -> Vec<String> {
    let mut figures = Vec::new();
    if let Ok(Value::Object(measures)) = serde_json::to_value(Measures::default()) {
        for (name, value) in measures {
            match value {
                Value::Object(_) if name == "undefined" => {}
                Value::Object(parts) => figures.extend(parts.keys().map(|part| format!("{name}.{part}"))),
                _ => figures.push(name),
            }
        }
    }
    ["atlas", "model"].iter().flat_map(|scope| figures.iter().map(move |f| format!("{scope}.{f}"))).collect()
}

/// Checks that `path` names a figure; else the failure names the nearest one that does.
pub fn check_path(path: &str) -> Result<()> {
    let known = paths();
    if known.iter().any(|k| k == path) {
        return Ok(());
    }
    let figures: Vec<&str> = known.iter().filter_map(|path| path.strip_prefix("atlas.")).collect();
    // What all paths begin with makes none of them a neighbour.
    let scoped = path.split_once('.').filter(|(scope, _)| nearest(scope, &["atlas", "model"]).is_some());
    let (scope, figure) = scoped.unwrap_or(("atlas", path));
    let scope = nearest(scope, &["atlas", "model"]).unwrap_or("atlas");
    let hint = match nearest(figure, &figures) {
        Some(near) => format!("did you mean `{scope}.{near}`?"),
        None => format!("a path is `atlas.` (every atlas) or `model.` and a figure; {}", listed(&figures)),
    };
    let text = format!("`{path}` is not a figure of the report; {hint}");
    Err(Failure::new(Code::InvalidOptions, text).at(format!("/require/{}", path.replace('~', "~0").replace('/', "~1"))))
}

/// The figure of `path` (`atlas.` and `model.` stripped), or why it is not defined.
fn figure(measures: &Measures, name: &str) -> Figure {
    let value = serde_json::to_value(measures).unwrap_or_default();
    let found = name.split('.').try_fold(&value, |v, key| v.get(key)).and_then(Value::as_f64);
    found.ok_or_else(|| measures.undefined.get(name).cloned().unwrap_or_else(|| "it is not defined".to_owned()))
}

/// A figure, or why it is not defined.
type Figure = std::result::Result<f64, String>;

/// A figure of the model or, where there is an id, of one atlas: before and after.
type Compared = (Option<u64>, Figure, Figure);

/// What a dotted path stands for: a figure of the model, or that of every refined atlas. `invalid_options` where there is no such figure.
fn lookup(report: &Report, path: &str) -> Result<Vec<Compared>> {
    check_path(path)?;
    let (scope, name) = path.split_once('.').unwrap_or((path, ""));
    let compared = |atlas, before, after| (atlas, figure(before, name), figure(after, name));
    Ok(match scope {
        "model" => vec![compared(None, &report.model.before, &report.model.after)],
        _ => {
            let refined = report.atlases.iter().filter(|a| a.refined);
            refined.map(|a| compared(Some(a.id), &a.before, &a.after)).collect()
        }
    })
}

/// The requirements that `report` does not meet, by path; of several atlases the worst is named. An undefined figure
/// fails, and so does `atlas.` when no atlas was refined.
fn unmet(report: &Report, require: &BTreeMap<String, Requirement>) -> Result<Vec<Unmet>> {
    let mut failures = Vec::new();
    for (path, wanted) in require {
        let values = lookup(report, path)?;
        for bound in bounds(wanted) {
            // The worst so far: how far from the bound (infinite where undefined), the figure, and which or why.
            let mut worst: Option<(f64, Option<f64>, Option<String>)> = None;
            if values.is_empty() {
                worst = Some((f64::INFINITY, None, Some("no atlas was refined".to_owned())));
            }
            for (atlas, before, after) in &values {
                let of = atlas.map(|id| format!("atlas {id}"));
                let (miss, got, detail) = match miss(bound, before, after) {
                    Ok((miss, got)) => (miss, Some(got), of),
                    Err(reason) => {
                        let detail = of.map_or_else(|| reason.clone(), |of| format!("{of}: {reason}"));
                        (f64::INFINITY, None, Some(detail))
                    }
                };
                if miss > 0.0 && worst.as_ref().is_none_or(|w| miss > w.0) {
                    worst = Some((miss, got, detail));
                }
            }
            if let Some((_, got, detail)) = worst {
                let wanted = format!("{} {}", bound.0, bound.1);
                failures.push(Unmet { path: path.clone(), wanted, got, detail });
            }
        }
    }
    Ok(failures)
}

fn bounds(r: &Requirement) -> impl Iterator<Item = (&'static str, f64)> {
    let all = [("min", r.min), ("max", r.max), ("min_gain", r.min_gain), ("max_ratio", r.max_ratio)];
    all.into_iter().filter_map(|(name, value)| Some((name, value?)))
}

/// By how much a bound is missed (not at all where <= 0), and the value that is compared.
fn miss((name, bound): (&str, f64), before: &Figure, after: &Figure) -> std::result::Result<(f64, f64), String> {
    let after = after.clone()?;
    Ok(match name {
        "min" => (bound - after, after),
        "max" => (after - bound, after),
        "min_gain" => {
            let gain = after - before.clone()?;
            (bound - gain, gain)
        }
        _ => {
            let ratio = match before.clone()? {
                0.0 if after == 0.0 => 1.0,
                0.0 => return Err("it was 0 before".to_owned()),
                before => after / before,
            };
            (ratio - bound, ratio)
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::metrics::{AtlasReport, InputReport, ModelReport};

    fn report(efficiencies: &[Option<f64>]) -> Report {
        let of = |value: Option<f64>| Measures {
            packing_efficiency: value,
            undefined: BTreeMap::from([("packing_efficiency".to_owned(), "no box".to_owned())]),
            ..Measures::default()
        };
        let atlas = |(id, e): (usize, &Option<f64>)| AtlasReport {
            id: id as u64,
            refined: true,
            before: of(Some(0.5)),
            after: of(*e),
            ..AtlasReport::default()
        };
        Report {
            schema: Report::SCHEMA,
            intarsia: String::new(),
            input: InputReport::default(),
            stages: vec![],
            atlases: efficiencies.iter().enumerate().map(atlas).collect(),
            textures: vec![],
            model: ModelReport { before: of(Some(0.5)), after: of(Some(0.75)) },
            outcome: None,
            merged: Vec::new(),
            warnings: vec![],
        }
    }

    fn require(path: &str, requirement: Requirement) -> BTreeMap<String, Requirement> {
        BTreeMap::from([(path.to_owned(), requirement)])
    }

    #[test]
    fn the_worst_atlas_counts_and_undefined_fails() {
        let min = require("atlas.packing_efficiency", Requirement { min: Some(0.7), ..Requirement::default() });
        let failures = unmet(&report(&[Some(0.9), Some(0.6), Some(0.65)]), &min).unwrap_or_default();
        assert_eq!(failures.len(), 1);
        assert_eq!((failures[0].wanted.as_str(), failures[0].got), ("min 0.7", Some(0.6)));
        assert_eq!(failures[0].detail.as_deref(), Some("atlas 1"));
        let failures = unmet(&report(&[Some(0.9), None]), &min).unwrap_or_default();
        assert_eq!((failures[0].got, failures[0].detail.as_deref()), (None, Some("atlas 1: no box")));
        assert_eq!(unmet(&report(&[Some(0.7)]), &min), Ok(vec![]), "a bound that is just met is met");
        assert_eq!(unmet(&report(&[]), &min).map(|f| f.len()), Ok(1), "nothing refined meets nothing");
    }

    #[test]
    fn strict_comes_first_and_tells_of_both() {
        let mut verdict = Verdict::default();
        assert_eq!(verdict.failure(), None);
        verdict.unmet.push(Unmet { path: "atlas.charts".into(), wanted: "max 1".into(), got: None, detail: None });
        let failure = verdict.failure().unwrap();
        assert_eq!((failure.code, failure.message.as_str()), (Code::RequirementNotMet, "not met: atlas.charts"));
        verdict.strict = BTreeMap::from([("invalid_image".to_owned(), 1), ("missing_image".to_owned(), 3)]);
        let failure = verdict.failure().unwrap();
        assert_eq!((failure.code, failure.pointer.as_deref()), (Code::StrictWarning, Some("/strict")));
        assert!(failure.message.contains("invalid_image, missing_image (3 times); not met: atlas.charts"), "{failure}");
    }

    #[test]
    fn gains_and_ratios_compare_with_before() {
        let wanted = Requirement { min_gain: Some(0.3), max_ratio: Some(1.4), ..Requirement::default() };
        let failures = unmet(&report(&[]), &require("model.packing_efficiency", wanted)).unwrap_or_default();
        let words: Vec<_> = failures.iter().map(|f| (f.wanted.as_str(), f.got)).collect();
        assert_eq!(words, [("min_gain 0.3", Some(0.25)), ("max_ratio 1.4", Some(1.5))]);
    }

    #[test]
    fn an_unknown_path_names_its_neighbour() {
        for (path, nearest) in [
            ("atlas.packing_eficiency", "`atlas.packing_efficiency`"),
            ("model.texel_density.medain", "`model.texel_density.median`"),
            ("model.undefined", "`atlas.` (every atlas) or `model.` and a figure; there are: triangles"),
            ("seam_length", "`atlas.seam_length`"),
        ] {
            let failure = unmet(&report(&[]), &require(path, Requirement::default())).err();
            assert!(failure.as_ref().is_some_and(|f| f.code == Code::InvalidOptions), "{path}");
            assert!(failure.is_some_and(|f| f.message.contains(nearest)), "{path}");
        }
    }
}
