//! A job computed in a process of its own, which does nothing else: when it dies, it takes nobody with it.
//!
//! The service starts its own program with `attempt`. The child reads one [`Request`] as a line of JSON from stdin, writes [`Event`]s as
//! lines of JSON to stdout, and leaves the files of the result in a folder. While the service lives, it holds the other end of stdin open:
//! a child whose stdin ends has lost its parent, and ends as well.

use std::fs;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, ExitStatus, Stdio};
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, PoisonError};

use serde::{Deserialize, Serialize};
use serde_json::Value;
use tokio::runtime::Handle;

use super::files::{Files, Manifest, disk};
use super::hub::{Reporter, STEP};
use super::worker::{Computed, Finished, refine};
use super::{slots, system};
use crate::asset::Limits;
use crate::context::{Listener, Progress, Timing};
use crate::error::{Code, Failure, Result, Warning};
use crate::refine::run::Artifact;

/// Bytes of stderr of a child that are told in the log.
const MOST_WORDS: u64 = 4096;

/// What the child computes.
#[derive(Serialize, Deserialize)]
pub(super) struct Request {
    /// Options, as stored.
    pub(super) options: Value,
    /// What was uploaded.
    pub(super) inputs: Manifest,
    /// Where it lies.
    pub(super) uploads: PathBuf,
    /// Where the files of the result go.
    pub(super) results: PathBuf,
    /// What is refused as too large.
    pub(super) limits: Limits,
    /// Threads that compute.
    pub(super) threads: usize,
}

/// What the child tells.
#[derive(Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Event {
    Progress(Progress),
    Warning(Warning),
    /// The end of the attempt, whatever came of it.
    Ended {
        result: std::result::Result<Finished<ResultFile>, Failure>,
        warnings: Vec<Warning>,
        timings: Vec<Timing>,
    },
}

/// A file of a result; they lie as `0`, `1`, … in the folder of the results.
#[derive(Serialize, Deserialize)]
struct ResultFile {
    name: String,
    role: String,
    media_type: String,
}

/// Computes in a child. `None` when the child died of itself.
///
/// # Errors
/// The machine's: the child could not be started, or its files not be read. What the job failed with is in [`Computed`].
pub(super) fn compute(job: &str, request: &Request, reporter: &Reporter, runtime: &Handle) -> Result<Option<Computed>> {
    fs::create_dir_all(&request.results).map_err(|e| disk(&request.results, &e))?;
    let done = run(job, request, reporter, runtime);
    let _ = fs::remove_dir_all(&request.results);
    done
}

fn run(job: &str, request: &Request, reporter: &Reporter, runtime: &Handle) -> Result<Option<Computed>> {
    let failed = |e: io::Error| Failure::new(Code::Unavailable, format!("no process for this job: {}", e.kind()));
    let (child, pipes) = start(job, request).map_err(failed)?;
    let child = Arc::new(Mutex::new(child));
    let killer = runtime.spawn({
        let (child, stop) = (child.clone(), reporter.stop.token.clone());
        async move {
            stop.cancelled().await;
            let _ = child.lock().unwrap_or_else(PoisonError::into_inner).kill();
        }
    });
    let ended = follow(pipes.stdout, reporter);
    killer.abort();
    drop(pipes.stdin);
    let status = {
        let mut child = child.lock().unwrap_or_else(PoisonError::into_inner);
        // One that has closed its stdout has nothing more to say.
        let _ = child.kill();
        child.wait().map_err(failed)?
    };
    let words = pipes.stderr.join().unwrap_or_default();
    if !words.trim().is_empty() {
        tracing::warn!(job, words = words.trim(), "the process of the job wrote");
    }
    let Some((result, warnings, timings)) = ended else {
        if reporter.stop.token.is_cancelled() {
            return Ok(Some(Computed::failed(Failure::new(Code::Canceled, "the job was cancelled"))));
        }
        tracing::error!(job, how = how(status), "the process of the job died, and nothing else");
        return Ok(None);
    };
    let result = match result {
        Ok(finished) => Ok(finished.with(|files| read(&request.results, files))?),
        Err(failure) => Err(failure),
    };
    Ok(Some(Computed { result, warnings, timings }))
}

struct Pipes {
    stdin: ChildStdin,
    stdout: std::process::ChildStdout,
    stderr: std::thread::JoinHandle<String>,
}

fn start(job: &str, request: &Request) -> io::Result<(Child, Pipes)> {
    // On Linux also where the program's file has been replaced under the service.
    let program = if cfg!(target_os = "linux") { PathBuf::from("/proc/self/exe") } else { std::env::current_exe()? };
    let mut command = Command::new(program);
    command.args(["attempt", job]).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    // Signals for the service, from a terminal say, are for the service alone.
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(&mut command, 0);
    let mut child = command.spawn()?;
    let missing = || io::Error::other("a pipe is missing");
    let mut stdin = child.stdin.take().ok_or_else(missing)?;
    let stdout = child.stdout.take().ok_or_else(missing)?;
    let errors = child.stderr.take().ok_or_else(missing)?;
    let stderr = std::thread::spawn(move || {
        let (mut words, mut errors) = (Vec::new(), errors);
        let _ = errors.by_ref().take(MOST_WORDS).read_to_end(&mut words);
        let _ = io::copy(&mut errors, &mut io::sink());
        String::from_utf8_lossy(&words).into_owned()
    });
    let mut line = serde_json::to_vec(request)?;
    line.push(b'\n');
    // One that is dead already is found dead by its stdout.
    let _ = stdin.write_all(&line).and_then(|()| stdin.flush());
    Ok((child, Pipes { stdin, stdout, stderr }))
}

type Ended = (std::result::Result<Finished<ResultFile>, Failure>, Vec<Warning>, Vec<Timing>);

/// Passes on what the child tells, until its end.
fn follow(stdout: impl Read, reporter: &Reporter) -> Option<Ended> {
    for line in BufReader::new(stdout).lines() {
        match serde_json::from_str(&line.ok()?).ok()? {
            Event::Progress(progress) => reporter.progress(&progress),
            Event::Warning(warning) => reporter.warning(&warning),
            Event::Ended { result, warnings, timings } => return Some((result, warnings, timings)),
        }
    }
    None
}

fn read(folder: &Path, files: Vec<ResultFile>) -> Result<Vec<Artifact>> {
    let read = |(n, file): (usize, ResultFile)| {
        let path = folder.join(n.to_string());
        let bytes = fs::read(&path).map_err(|e| disk(&path, &e))?;
        Ok(Artifact { name: file.name, role: file.role, media_type: file.media_type, bytes })
    };
    files.into_iter().enumerate().map(read).collect()
}

fn how(status: ExitStatus) -> String {
    #[cfg(unix)]
    if let Some(signal) = std::os::unix::process::ExitStatusExt::signal(&status) {
        return format!("signal {signal}");
    }
    status.to_string()
}

/// The child: reads the request from stdin, computes, tells on stdout.
///
/// # Errors
/// `invalid_request` when nobody speaks to it.
pub fn attempt() -> Result<()> {
    let lost = |why: &dyn std::fmt::Display| {
        Failure::new(Code::InvalidRequest, format!("this is for the service to call, and it says nothing: {why}"))
    };
    let mut line = String::new();
    let mut stdin = BufReader::new(io::stdin());
    stdin.read_line(&mut line).map_err(|e| lost(&e))?;
    let request: Request = serde_json::from_str(&line).map_err(|e| lost(&e))?;
    std::thread::spawn(move || {
        let _ = io::copy(&mut stdin, &mut io::sink());
        // The service is gone: nobody would take the result.
        std::process::exit(1);
    });
    die_first();
    system::lower_thread_priority();
    let teller = Arc::new(Teller { last: Mutex::new(Progress::default()) });
    let computed = slots::pool(request.threads)?.install(|| {
        let load = || Files::load(&request.uploads, &request.inputs);
        refine(&request.options, load, request.limits, teller, Arc::new(AtomicBool::new(false)))
    });
    let write = |(n, artifact): (usize, Artifact)| {
        let path = request.results.join(n.to_string());
        fs::write(&path, &artifact.bytes).map_err(|e| disk(&path, &e))?;
        Ok(ResultFile { name: artifact.name, role: artifact.role, media_type: artifact.media_type })
    };
    let result =
        computed.result.and_then(|finished| finished.with(|all| all.into_iter().enumerate().map(write).collect()));
    tell(&Event::Ended { result, warnings: computed.warnings, timings: computed.timings });
    Ok(())
}

/// Where memory runs out, the system shall end this process and not the service.
fn die_first() {
    if cfg!(target_os = "linux") {
        let _ = fs::write("/proc/self/oom_score_adj", "1000");
    }
}

/// Tells the service on stdout.
struct Teller {
    last: Mutex<Progress>,
}

impl Listener for Teller {
    fn progress(&self, progress: &Progress) {
        let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        let moved = progress.fraction - last.fraction >= STEP || progress.fraction >= 1.0;
        if moved || progress.stage != last.stage || progress.message != last.message {
            last.clone_from(progress);
            tell(&Event::Progress(progress.clone()));
        }
    }

    fn warning(&self, warning: &Warning) {
        tell(&Event::Warning(warning.clone()));
    }
}

fn tell(event: &Event) {
    let Ok(mut line) = serde_json::to_vec(event) else { return };
    line.push(b'\n');
    let mut stdout = io::stdout().lock();
    // A service that is gone hears nothing; the end of stdin ends this process.
    let _ = stdout.write_all(&line).and_then(|()| stdout.flush());
}
