//! The stages, from Atlas to Atlas, and the recipe that runs them in order.

pub mod options;
pub mod parse;
pub mod run;
