//! The stages, from Atlas to Atlas, and the recipe that runs them in order.

pub mod bounded;
pub mod box_cutter;
mod check;
pub mod defrag;
mod deliver;
pub mod erased;
pub mod fabrication;
mod formats;
mod give_back;
mod group;
pub mod importance;
mod load;
pub mod optcuts;
pub mod options;
mod output;
mod pack;
pub mod parse;
mod preview;
pub mod recipe;
mod refinement;
mod report;
pub mod run;
pub mod stage;
pub mod table;
#[cfg(test)]
mod tests;
mod textures;
mod write;

pub use run::{Artifact, Input, Outcome, inspect, inspect_and_judge, refine};
