//! What others read glTF with, run by Node.js: the Khronos validator, three.js, glTF Transform.

use std::collections::BTreeSet;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use serde_json::Value;

const FILES: [&str; 6] =
    ["package.json", "package-lock.json", "validate.cjs", "three.mjs", "transform.mjs", "basis.mjs"];

/// The folder with the programs, installed on first use; `None`, aloud, where there is no npm.
fn folder() -> Option<&'static Path> {
    static FOLDER: OnceLock<Option<PathBuf>> = OnceLock::new();
    FOLDER
        .get_or_init(|| {
            let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/readers");
            let target = Path::new(env!("CARGO_TARGET_TMPDIR")).join("readers");
            std::fs::create_dir_all(&target).ok()?;
            let lock = |folder: &Path| std::fs::read(folder.join("package-lock.json")).ok();
            let installed = lock(&target) == lock(&source) && target.join("node_modules/three").is_dir();
            for file in FILES {
                std::fs::copy(source.join(file), target.join(file)).ok()?;
            }
            let ready = installed
                || Command::new("npm")
                    .args(["ci", "--no-audit", "--no-fund", "--silent"])
                    .current_dir(&target)
                    .status()
                    .is_ok_and(|s| s.success());
            if !ready {
                // Past the capture of a test's output: a test that passes is not heard otherwise.
                let told = "skipped: the validator and other readers are not at hand (npm is missing or failed)";
                writeln!(std::io::stderr(), "{told}").expect("stderr");
            }
            ready.then_some(target)
        })
        .as_deref()
}

/// What a program says of a file; `None` where it is not at hand.
fn run(program: &str, file: &Path) -> Option<Value> {
    let output = Command::new("node").arg(folder()?.join(program)).arg(file).output().ok()?;
    // What is missing is missing in whichever folder.
    let folder = file.parent().map(|f| format!("{}/", f.display())).unwrap_or_default();
    let text = String::from_utf8_lossy(&output.stdout).replace(&folder, "");
    let line = text.lines().next().unwrap_or_default();
    Some(serde_json::from_str(line).unwrap_or_else(|e| {
        panic!("{program} fails on {}: {e}: {}", file.display(), String::from_utf8_lossy(&output.stderr))
    }))
}

/// The validator's errors, each once; `None` where there is no validator.
pub fn errors(file: &Path) -> Option<BTreeSet<String>> {
    let report = run("validate.cjs", file)?;
    let errors = report["errors"].as_array().expect("a list of errors");
    // A file that is missing is named with its folder, or without.
    let text = |e: &Value| {
        let message = e["message"].as_str().unwrap_or_default();
        let file = message.rsplit(['/', '\'']).find(|part| !part.is_empty()).filter(|_| e["code"] == "IO_ERROR");
        format!("{}: {}", e["code"], file.unwrap_or(message))
    };
    Some(errors.iter().map(text).collect())
}

/// What three.js makes of a file.
pub fn three(file: &Path) -> Option<Value> {
    run("three.mjs", file)
}

/// What glTF Transform makes of a file.
pub fn transform(file: &Path) -> Option<Value> {
    run("transform.mjs", file)
}

/// What Binomial's transcoder shows of a KTX2 file.
pub fn basis(file: &Path) -> Option<Value> {
    run("basis.mjs", file)
}
