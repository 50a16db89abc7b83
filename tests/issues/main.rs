//! Crashes and wrong results that were found once, each with what happened.

mod compressed_streams;
mod extensions;
mod fidelity;
mod layouts;
mod messages;
mod names;
mod numbers;
mod outcomes;
mod scans;
mod tangents;
mod tiles;
