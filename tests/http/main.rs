//! What the service promises, over real HTTP against the running program.

mod errors;
mod jobs;
mod server;
mod service;
