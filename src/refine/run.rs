//! Stand-in for the engine: passes the model through. Replaced at the merge.

use serde_json::{Value, json};

use crate::asset::File;
use crate::asset::limits::Limits;
use crate::context::Context;
use crate::error::{Failure, Result};
use crate::metrics::report::Unmet;
use crate::refine::options::Options;

/// What comes in.
#[derive(Debug, Clone, Default)]
pub struct Input {
    /// Files of each model; usually one.
    pub models: Vec<Vec<File>>,
    /// What is refused as too large.
    pub limits: Limits,
}

/// A file of the result.
#[derive(Debug, Clone)]
pub struct Artifact {
    /// File name.
    pub name: String,
    /// What it is.
    pub role: String,
    /// Media type.
    pub media_type: String,
    /// Contents.
    pub bytes: Vec<u8>,
}

/// What comes out.
#[derive(Debug, Clone)]
pub struct Outcome {
    /// Files.
    pub artifacts: Vec<Artifact>,
    /// The report.
    pub report: Value,
    /// Requirements that are not met.
    pub failures: Vec<Unmet>,
}

/// Refines.
pub fn refine(input: &Input, options: &Options, context: &Context) -> Result<Outcome> {
    context.plan(&[("read", 1.0), ("pack", 1.0), ("write", 1.0)]);
    let report = inspect(input, options, context)?;
    for stage in 0..3 {
        context.enter(stage);
        for i in 0..10 {
            context.step(f64::from(i) / 10.0, "passing through")?;
        }
    }
    let mut artifacts = Vec::new();
    if let Some(file) = input.models.first().and_then(|m| m.first()) {
        artifacts.push(Artifact {
            name: "model.glb".into(),
            role: "model".into(),
            media_type: "model/gltf-binary".into(),
            bytes: file.bytes.clone(),
        });
    }
    artifacts.push(Artifact {
        name: "report.json".into(),
        role: "report".into(),
        media_type: "application/json".into(),
        bytes: serde_json::to_vec_pretty(&report).map_err(|e| Failure::internal(e.to_string()))?,
    });
    context.finish();
    let failures = options
        .require
        .iter()
        .filter(|(_, r)| r.min.is_some_and(|m| m > 0.5))
        .map(|(path, _)| Unmet { path: path.clone(), wanted: "more".into(), got: Some(0.5) })
        .collect();
    Ok(Outcome { artifacts, report, failures })
}

/// Measures.
pub fn inspect(input: &Input, _options: &Options, _context: &Context) -> Result<Value> {
    let bytes = input.models.first().and_then(|m| m.first()).map(|f| f.bytes.as_slice()).unwrap_or_default();
    let length = bytes.get(12..16).and_then(|b| b.try_into().ok()).map_or(0, u32::from_le_bytes) as usize;
    let json = bytes.get(20..20usize.saturating_add(length)).unwrap_or_default();
    let document: Value = serde_json::from_slice(json).map_err(|e| Failure::model(e.to_string()))?;
    if document.get("meshes").is_none() {
        return Err(Failure::new(crate::error::Code::NothingToRefine, "the model has no meshes").at("/meshes"));
    }
    Ok(json!({
        "schema": 1,
        "atlases": [{"id": 0, "name": "stub", "before": {"packing_efficiency": 0.5, "charts": 3}}],
        "model": {"before": {"texture_pixels": 1024}},
        "warnings": []
    }))
}
