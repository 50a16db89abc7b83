//! The Khronos glTF validator, run by Node.js.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

/// The folder with the validator, installed on first use; `None`, aloud, where there is no npm.
fn folder() -> Option<&'static Path> {
    static FOLDER: OnceLock<Option<PathBuf>> = OnceLock::new();
    FOLDER
        .get_or_init(|| {
            let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/validator");
            let target = Path::new(env!("CARGO_TARGET_TMPDIR")).join("validator");
            std::fs::create_dir_all(&target).ok()?;
            for file in ["package.json", "validate.cjs"] {
                std::fs::copy(source.join(file), target.join(file)).ok()?;
            }
            let ready = target.join("node_modules/gltf-validator").is_dir()
                || Command::new("npm")
                    .args(["install", "--no-audit", "--no-fund", "--no-package-lock", "--silent"])
                    .current_dir(&target)
                    .status()
                    .is_ok_and(|s| s.success());
            if !ready {
                println!("skipped: the glTF validator is not at hand (npm is missing or failed)");
            }
            ready.then_some(target)
        })
        .as_deref()
}

/// The validator's errors as (code, message), each once; `None` where there is no validator.
pub fn errors(file: &Path) -> Option<BTreeSet<String>> {
    let folder = folder()?;
    let output = Command::new("node").arg(folder.join("validate.cjs")).arg(file).output().ok()?;
    let text = String::from_utf8_lossy(&output.stdout);
    let report: serde_json::Value =
        serde_json::from_str(text.lines().next().unwrap_or_default()).expect("the validator prints JSON");
    let errors = report["errors"].as_array().expect("a list of errors");
    Some(errors.iter().map(|e| format!("{}: {}", e["code"], e["message"])).collect())
}
