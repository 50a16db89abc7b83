//! Stand-in for the report's schema. Replaced at the merge.

/// A requirement that is not met.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Unmet {
    /// Dotted path into the report.
    pub path: String,
    /// What was asked.
    pub wanted: String,
    /// What was reached; null when undefined.
    pub got: Option<f64>,
}
