//! The command line: serve, refine, inspect, sample, openapi, keys, backup, health.
//!
//! Exit codes: 0 done; 1 internal; 2 usage; 3 the input is at fault; 4 a requirement is not met, or there is a warning
//! that `strict` names.

mod commands;

use std::process::ExitCode;

use intarsia::config::Command;
use intarsia::error::Code;

fn main() -> ExitCode {
    let command = commands::parse().command;
    // The words of a panic are on stderr already.
    let Ok(done) = std::panic::catch_unwind(|| match command {
        Command::Serve(arguments) => commands::serve::run(&arguments),
        Command::Refine(arguments) => commands::refine::run(&arguments),
        Command::Inspect(arguments) => commands::inspect::run(&arguments),
        Command::Sample(arguments) => commands::sample::run(&arguments),
        Command::Openapi => commands::openapi::run(),
        Command::Keys(arguments) => commands::keys::run(&arguments),
        Command::Backup(arguments) => commands::backup::run(&arguments),
        Command::Attempt { job: _ } => intarsia::jobs::attempt(),
        Command::Health(arguments) => commands::health::run(&arguments),
    }) else {
        return ExitCode::from(1);
    };
    let Err(failure) = done else { return ExitCode::SUCCESS };
    match &failure.pointer {
        Some(pointer) if !pointer.is_empty() => eprintln!("error: {failure} (at {pointer})"),
        _ => eprintln!("error: {failure}"),
    }
    ExitCode::from(match failure.code {
        Code::Internal | Code::Canceled | Code::InsufficientStorage | Code::Unavailable => 1,
        Code::InvalidOptions | Code::InvalidRequest => 2,
        Code::RequirementNotMet | Code::StrictWarning => 4,
        _ => 3,
    })
}
