//! What the service promises, over real HTTP against the running program.

mod batches;
mod errors;
mod events;
mod faults;
mod jobs;
mod roles;
mod server;
mod service;
mod survival;
mod tenants;
mod traces;
mod uploads;
mod waiting;
