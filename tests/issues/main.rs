//! Crashes and wrong results that were found once, each with what happened.

mod compressed_streams;
mod extensions;
mod layouts;
mod tangents;
