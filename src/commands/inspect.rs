//! `intarsia inspect`: the figures of every atlas in a model.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use intarsia::config::Inspect;
use intarsia::context::Context;
use intarsia::error::{Code, Failure, Result};
use intarsia::refine::parse::nearest;
use intarsia::refine::run::inspect;
use serde_json::Value;

use super::progress::Teller;
use super::table::{self, Column};

/// Measures and tells; exit code 4 where a bound is not met.
pub fn run(arguments: &Inspect) -> Result<()> {
    let bounds = arguments.require.iter().map(|text| Bound::parse(text)).collect::<Result<Vec<_>>>()?;
    let options = super::read_options(&arguments.options, None)?;
    let input = super::read_input(&arguments.input)?;
    let context = Context::new(Arc::new(Teller::Quiet), Arc::new(AtomicBool::new(false)), options.seed);
    let pool = intarsia::jobs::pool(arguments.threads)?;
    let report = pool.install(|| inspect(&input, &options, &context))?;
    let columns = table::columns(&report, "before");
    let text = if arguments.json { super::pretty(&report) } else { table::render(&columns) };
    super::print(&text)?;
    let mut missed = Vec::new();
    for bound in &bounds {
        missed.extend(bound.missed(&report, &columns)?);
    }
    if missed.is_empty() {
        return Ok(());
    }
    Err(Failure::new(Code::RequirementNotMet, missed.join("; ")))
}

/// A bound on a figure: `PATH>=N` or `PATH<=N`. `atlas.` holds for every atlas, `model.` for the model.
struct Bound<'a> {
    of_model: bool,
    figure: &'a str,
    at_least: bool,
    value: f64,
    text: &'a str,
}

impl<'a> Bound<'a> {
    fn parse(text: &'a str) -> Result<Self> {
        let wrong = || {
            let message =
                format!("`{text}` is no bound such as atlas.packing_efficiency>=0.8 or model.texture_pixels<=1e6");
            Failure::new(Code::InvalidRequest, message)
        };
        let parts = text.split_once(">=").map(|p| (p, true)).or_else(|| text.split_once("<=").map(|p| (p, false)));
        let ((path, number), at_least) = parts.ok_or_else(wrong)?;
        let value: f64 = number.trim().parse().ok().filter(|n: &f64| n.is_finite()).ok_or_else(wrong)?;
        let (scope, figure) = path.trim().split_once('.').ok_or_else(wrong)?;
        if !matches!(scope, "atlas" | "model") {
            return Err(wrong());
        }
        Ok(Bound { of_model: scope == "model", figure, at_least, value, text })
    }

    /// Where it is not met, in words. A figure that is not defined does not meet it.
    fn missed(&self, report: &Value, columns: &[Column]) -> Result<Vec<String>> {
        let atlases = report.get("atlases").and_then(Value::as_array).map_or(0, Vec::len).min(columns.len());
        let (of_atlas, of_model) = columns.split_at(atlases);
        let scope = if self.of_model { of_model } else { of_atlas };
        let known: Vec<&str> = scope.iter().flat_map(|c| c.figures.keys().map(String::as_str)).collect();
        if !scope.is_empty() && !known.contains(&self.figure) {
            let hint = nearest(self.figure, &known).map(|n| format!("; did you mean `{n}`?")).unwrap_or_default();
            return Err(Failure::new(Code::InvalidRequest, format!("no figure is called `{}`{hint}", self.figure)));
        }
        let met = |got: f64| if self.at_least { got >= self.value } else { got <= self.value };
        let misses = scope.iter().filter_map(|column| {
            let value = column.figures.get(self.figure).unwrap_or(&Value::Null);
            let missed = !value.as_f64().is_some_and(met);
            missed.then(|| format!("{}: {} is {}", self.text, column.name.trim(), table::figure(value)))
        });
        Ok(misses.collect())
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn bounds_hold_for_every_atlas_and_undefined_figures_fail() {
        let report = json!({
            "atlases": [{"id": 0, "name": "a", "before": {"x": 0.5, "y": null}}, {"id": 1, "name": "b", "before": {"x": 0.9, "y": null}}],
            "model": {"before": {"pixels": 100}},
        });
        let columns = table::columns(&report, "before");
        let missed = |text: &str| Bound::parse(text).and_then(|b| b.missed(&report, &columns)).map(|m| m.len());
        assert_eq!(missed("atlas.x>=0.5"), Ok(0));
        assert_eq!(missed("atlas.x>=0.6"), Ok(1));
        assert_eq!(missed("atlas.x <= 0.1"), Ok(2));
        assert_eq!(missed("atlas.y>=0"), Ok(2));
        assert_eq!(missed("model.pixels<=1e2"), Ok(0));
        for wrong in ["atlas.z>=1", "x>=1", "atlas.x=1", "atlas.x>=nan", "texture.x>=1"] {
            assert_eq!(missed(wrong).unwrap_err().code, Code::InvalidRequest, "{wrong}");
        }
    }
}
