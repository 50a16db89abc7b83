//! The stages, from Atlas to Atlas, and the recipe that runs them in order.

pub mod box_cutter;
mod check;
pub mod defrag;
mod deliver;
pub mod fabrication;
mod formats;
mod group;
pub mod importance;
mod load;
pub mod options;
mod pack;
pub mod parse;
mod report;
pub mod run;
mod stage;
#[cfg(test)]
mod tests;
mod textures;

pub use run::{Artifact, Input, Outcome, inspect, inspect_and_judge, refine};
