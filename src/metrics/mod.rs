//! metrics.

pub mod report;
