//! Progress on stderr: a bar on a terminal, a line a stage elsewhere.

use std::io::IsTerminal;
use std::sync::Mutex;

use indicatif::{ProgressBar, ProgressStyle};
use intarsia::context::{Listener, Progress};
use intarsia::error::Warning;

/// Tells people how far it is.
pub enum Teller {
    /// Warnings only.
    Quiet,
    /// A bar.
    Bar(ProgressBar),
    /// A line for each stage; holds the stage that was told last.
    Lines(Mutex<String>),
}

impl Teller {
    /// What suits stderr.
    pub fn new(quiet: bool) -> Self {
        if quiet {
            return Teller::Quiet;
        }
        if !std::io::stderr().is_terminal() {
            return Teller::Lines(Mutex::default());
        }
        let bar = ProgressBar::new(1000);
        if let Ok(style) = ProgressStyle::with_template("{prefix:>10} {bar:32} {percent:>3}%  {wide_msg}") {
            bar.set_style(style.progress_chars("━╸─"));
        }
        Teller::Bar(bar)
    }

    /// Takes the bar away.
    pub fn end(&self) {
        if let Teller::Bar(bar) = self {
            bar.finish_and_clear();
        }
    }
}

impl Listener for Teller {
    fn progress(&self, progress: &Progress) {
        match self {
            Teller::Quiet => {}
            Teller::Bar(bar) => {
                bar.set_position((progress.fraction * 1000.0) as u64);
                if bar.prefix() != progress.stage {
                    bar.set_prefix(progress.stage.clone());
                }
                bar.set_message(progress.message.clone());
            }
            Teller::Lines(last) => {
                let mut last = last.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
                if *last != progress.stage && !progress.stage.is_empty() {
                    let (number, count) = (progress.stage_index + 1, progress.stage_count);
                    eprintln!("[{number}/{count}] {} {:3.0}%", progress.stage, progress.fraction * 100.0);
                    last.clone_from(&progress.stage);
                }
            }
        }
    }

    fn warning(&self, warning: &Warning) {
        let line = match &warning.pointer {
            Some(pointer) => format!("warning: {}: {} (at {pointer})", warning.code, warning.message),
            None => format!("warning: {}: {}", warning.code, warning.message),
        };
        match self {
            Teller::Bar(bar) => bar.suspend(|| eprintln!("{line}")),
            _ => eprintln!("{line}"),
        }
    }
}
