//! Figures of a report as a table for people.

use serde_json::{Map, Value};

/// Columns that stand side by side.
const COLUMNS: usize = 6;
/// Longest heading.
const HEADING: usize = 22;

/// The figures of one atlas or of the model.
pub struct Column {
    /// Heading.
    pub name: String,
    /// Figures by name; nested ones by a dotted name, undefined ones null.
    pub figures: Map<String, Value>,
}

/// The columns of a report: its atlases, then the model; `when` is "before" or "after".
pub fn columns(report: &Value, when: &str) -> Vec<Column> {
    let mut out = Vec::new();
    for atlas in report.get("atlases").and_then(Value::as_array).into_iter().flatten() {
        let id =
            atlas.get("id").map(|id| id.as_str().map_or_else(|| id.to_string(), str::to_owned)).unwrap_or_default();
        let name = atlas.get("name").and_then(Value::as_str).unwrap_or_default();
        out.push(column(format!("{id} {name}"), atlas.get(when)));
    }
    if let Some(model) = report.get("model").and_then(|m| m.get(when)) {
        out.push(column("model".to_owned(), Some(model)));
    }
    out
}

fn column(name: String, figures: Option<&Value>) -> Column {
    let mut flat = Map::new();
    if let Some(figures) = figures {
        flatten("", figures, &mut flat);
    }
    Column { name, figures: flat }
}

fn flatten(prefix: &str, value: &Value, out: &mut Map<String, Value>) {
    match value {
        // Why a figure is not defined is told in the JSON.
        Value::Object(_) if prefix == "undefined" => {}
        Value::Object(map) => {
            for (key, value) in map {
                let name = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
                flatten(&name, value, out);
            }
        }
        Value::Number(_) | Value::Null | Value::Bool(_) => drop(out.insert(prefix.to_owned(), value.clone())),
        _ => {}
    }
}

/// The table.
pub fn render(columns: &[Column]) -> String {
    let mut out = String::new();
    for block in columns.chunks(COLUMNS) {
        let mut names: Vec<&str> = Vec::new();
        for name in block.iter().flat_map(|c| c.figures.keys()) {
            if !names.contains(&name.as_str()) {
                names.push(name);
            }
        }
        let mut rows = vec![vec![String::new()]];
        rows[0].extend(block.iter().map(|c| c.name.chars().take(HEADING).collect()));
        for name in names {
            let mut row = vec![name.to_owned()];
            row.extend(block.iter().map(|c| c.figures.get(name).map_or(String::new(), figure)));
            rows.push(row);
        }
        let width = |i: usize| rows.iter().filter_map(|r| r.get(i)).map(|c| c.chars().count()).max().unwrap_or(0);
        let widths: Vec<usize> = (0..=block.len()).map(width).collect();
        if !out.is_empty() {
            out.push('\n');
        }
        for row in &rows {
            let cells = row.iter().zip(&widths).enumerate();
            let line: Vec<String> =
                cells.map(|(i, (c, &w))| if i == 0 { format!("{c:<w$}") } else { format!("{c:>w$}") }).collect();
            out.push_str(line.join("  ").trim_end());
            out.push('\n');
        }
    }
    out
}

/// A figure as people read it.
pub fn figure(value: &Value) -> String {
    match value {
        Value::Null => "–".to_owned(),
        Value::Number(n) if n.is_f64() => {
            let x = n.as_f64().unwrap_or(f64::NAN);
            match x.abs() {
                0.0 => "0".to_owned(),
                a if (0.001..1e6).contains(&a) => format!("{x:.4}"),
                _ => format!("{x:.3e}"),
            }
        }
        other => other.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn all_figures_stand_in_their_columns() {
        let measures = json!({"charts": 3, "density": {"min": 0.5, "max": null}, "undefined": {"density.max": "why"}});
        let report = json!({"atlases": [{"id": 0, "name": "skin", "before": measures}], "model": {"before": {"charts": 3, "pixels": 12}}});
        let text = render(&columns(&report, "before"));
        let lines: Vec<Vec<&str>> = text.lines().map(|l| l.split_whitespace().collect()).collect();
        assert_eq!(
            lines,
            [
                vec!["0", "skin", "model"],
                vec!["charts", "3", "3"],
                vec!["density.min", "0.5000"],
                vec!["density.max", "–"],
                vec!["pixels", "12"],
            ]
        );
    }
}
