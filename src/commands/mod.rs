//! One file a subcommand; here what they share.

pub mod backup;
pub mod health;
pub mod inspect;
pub mod keys;
pub mod openapi;
mod progress;
pub mod refine;
pub mod sample;
pub mod serve;
mod table;

use std::fs::File;
use std::io::{ErrorKind, Read, Write};
use std::path::{Path, PathBuf};

use clap::builder::Resettable;
use clap::{Arg, CommandFactory, FromArgMatches};
use intarsia::asset::{self, read_paths};
use intarsia::config::{Cli, OptionFlags};
use intarsia::error::{Code, Failure, Result};
use intarsia::metrics::Verdict;
use intarsia::refine::options::{Container, ImportanceSource, Options};
use intarsia::refine::run::Input;
use intarsia::refine::{parse, recipe};
use serde_json::{Map, Value};

/// The command line as it was given; its help names the recipes. A variable of the environment that is empty counts as one that is not set: so
/// it comes from compose files and manifests that pass on what they were given.
pub fn parse() -> Cli {
    let recipes = recipe::recipes().map(|(name, description)| format!("\n  {name:<12} {description}"));
    let help = format!("Recipes:{}", recipes.collect::<String>());
    let command = Cli::command().mut_subcommand("refine", |refine| refine.after_help(help));
    let set = |flag: Arg| match flag.get_env() {
        Some(name) if std::env::var_os(name).is_some_and(|value| value.is_empty()) => flag.env(Resettable::Reset),
        _ => flag,
    };
    let command = command.mut_subcommands(|subcommand| subcommand.mut_args(set));
    Cli::from_arg_matches(&command.get_matches()).unwrap_or_else(|error| error.exit())
}

/// Reads the models on the command line, each with the files that it names; inputs that are no model go with all of
/// them, and so does the picture that `importance` names by its path.
fn read_input(paths: &[PathBuf], options: &Options) -> Result<Input> {
    let is_model = |path: &&PathBuf| {
        let is_zip = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("zip"));
        is_zip || path.file_name().is_some_and(|name| asset::is_model_name(&name.to_string_lossy()))
    };
    let models: Vec<&PathBuf> = paths.iter().filter(is_model).collect();
    let side: Vec<PathBuf> = paths.iter().filter(|p| !is_model(p)).cloned().collect();
    for path in paths {
        let failed =
            |why: &dyn std::fmt::Display| Failure::new(Code::MissingFile, format!("{}: {why}", path.display()));
        let found = std::fs::metadata(path).map_err(|e| failed(&e))?;
        if !found.is_file() {
            return Err(failed(&"not a file"));
        }
    }
    if models.is_empty() {
        let told: Vec<String> = paths.iter().map(|path| what(path)).collect();
        let message = format!(
            "no input is a model that is read (.glb, .gltf, .obj, .b3dm, .i3dm, .zip of one): {}",
            told.join(", ")
        );
        return Err(Failure::new(Code::InvalidRequest, message));
    }
    let read = |model: &PathBuf| read_paths(&[std::slice::from_ref(model), side.as_slice()].concat());
    let mut models: Vec<Vec<asset::File>> = models.into_iter().map(read).collect::<Result<_>>()?;
    if let Some(ImportanceSource::Texture(name)) = &options.importance
        && Path::new(name).is_file()
    {
        for files in models.iter_mut().filter(|files| files.iter().all(|f| f.path != *name)) {
            let bytes = std::fs::read(name).map_err(|e| Failure::new(Code::MissingFile, format!("{name}: {e}")))?;
            files.push(asset::File { path: name.clone(), bytes });
        }
    }
    Ok(Input { models, ..Input::default() })
}

/// An input that is no model, with what it is where that is known.
fn what(path: &Path) -> String {
    let mut head = [0; 16];
    let read = File::open(path).and_then(|mut file| file.read(&mut head)).unwrap_or(0);
    let name = path.display().to_string();
    let what = asset::foreign(&name, head.get(..read).unwrap_or_default());
    format!("{name}{}", what.map(|what| format!(" ({what})")).unwrap_or_default())
}

/// Fails where a file that is to be written later cannot be: its folder is not there or cannot be written to, or there is a folder of
/// its name.
fn check_output(path: &Path) -> Result<()> {
    let bad =
        |text: String| Err(Failure::new(Code::InvalidRequest, format!("cannot write {}: {text}", path.display())));
    if path.is_dir() {
        return bad("it is a folder; name a file in it".to_owned());
    }
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    if !folder.is_dir() {
        return bad(format!("the folder {} does not exist; make it first", folder.display()));
    }
    match tempfile::Builder::new().prefix(".intarsia-").suffix(".tmp").tempfile_in(folder) {
        Ok(_) => Ok(()),
        Err(e) => bad(format!("the folder {} takes no file: {e}", folder.display())),
    }
}

/// The same of a folder that is made where it is not there.
fn check_output_folder(path: &Path) -> Result<()> {
    let there = path.ancestors().find(|a| a.as_os_str().is_empty() || a.exists()).unwrap_or(Path::new(""));
    if there.as_os_str().is_empty() || there.is_dir() {
        return check_output(&there.join("file"));
    }
    let text = format!("cannot write into {}: {} is a file, not a folder", path.display(), there.display());
    Err(Failure::new(Code::InvalidRequest, text))
}

/// Tells the requirements that are not met, if any, and fails for what the result fails for; `note` ends the message.
fn judge(verdict: &Verdict, note: &str) -> Result<()> {
    for failure in &verdict.unmet {
        let got = failure.got.map_or("undefined".to_owned(), |g| g.to_string());
        let detail = failure.detail.as_ref().map(|d| format!(" ({d})")).unwrap_or_default();
        eprintln!("not met: {} wanted {}, got {got}{detail}", failure.path, failure.wanted);
    }
    match verdict.failure() {
        Some(failure) => Err(Failure { message: format!("{}{note}", failure.message), ..failure }),
        None => Ok(()),
    }
}

/// The options of the flags: the file, then the recipe, then each `--set`. Every problem is told.
fn read_options(flags: &OptionFlags, output: Option<Container>) -> Result<Options> {
    let mut value = Value::Object(Map::new());
    if let Some(path) = &flags.options {
        let failed =
            |why: &dyn std::fmt::Display| Failure::new(Code::InvalidOptions, format!("{}: {why}", path.display()));
        let text = std::fs::read(path).map_err(|e| failed(&e))?;
        value = parse::json(&text).map_err(|e| failed(&e))?;
    }
    let mut problems = match parse::command_line(value, flags, output) {
        Ok(options) => return Ok(options),
        Err(problems) => problems,
    };
    for problem in problems.iter().skip(1) {
        eprintln!("error: {} (at {})", problem.message, problem.pointer);
    }
    problems.truncate(1);
    Err(parse::failure(&problems))
}

/// Writes a file so that it is there whole or not at all: beside its place first, then renamed.
fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    let failed = |e: std::io::Error| match e.kind() {
        ErrorKind::NotFound => Failure::new(
            Code::InvalidRequest,
            format!("cannot write {}: its folder does not exist; make it first", path.display()),
        ),
        _ => Failure::internal(format!("{}: {e}", path.display())),
    };
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut file = tempfile::Builder::new().prefix(".intarsia-").suffix(".tmp").tempfile_in(folder).map_err(failed)?;
    file.write_all(bytes).map_err(failed)?;
    file.as_file().sync_all().map_err(failed)?;
    share(file.as_file()).map_err(failed)?;
    file.persist(path).map_err(|e| failed(e.error))?;
    Ok(())
}

/// Temporary files are their owner's only; a result is readable as any new file.
#[cfg(unix)]
fn share(file: &File) -> std::io::Result<()> {
    use std::os::unix::fs::PermissionsExt;
    file.set_permissions(std::fs::Permissions::from_mode(0o644))
}

#[cfg(not(unix))]
fn share(_: &File) -> std::io::Result<()> {
    Ok(())
}

/// Prints to stdout; a reader that has gone away is no error.
fn print(text: &str) -> Result<()> {
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(e) if e.kind() != ErrorKind::BrokenPipe => Err(Failure::internal(format!("stdout: {e}"))),
        _ => Ok(()),
    }
}

/// JSON as people read it, with a line end.
fn pretty(value: &Value) -> String {
    let mut text = serde_json::to_string_pretty(value).unwrap_or_default();
    text.push('\n');
    text
}
