//! The order of the rooms holds: imports run down, never up.

use std::fs;
use std::path::{Path, PathBuf};

use crate::ROOMS;

fn sources(folder: &Path, out: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, out);
        } else if path.extension().is_some_and(|e| e == "rs") {
            out.push(path);
        }
    }
}

/// The rooms that a line of code names by `crate::`.
fn named(line: &str) -> impl Iterator<Item = &str> {
    let code = line.split("//").next().unwrap_or_default();
    code.split("crate::").skip(1).map(|rest| {
        let end = rest.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(rest.len());
        &rest[..end]
    })
}

#[test]
fn no_arrow_runs_back_up() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let level = |room: &str| ROOMS.iter().position(|r| *r == room);
    let mut files = Vec::new();
    sources(&root, &mut files);
    files.sort();
    let (mut wrong, mut arrows) = (Vec::new(), 0);
    for file in &files {
        let own = file.strip_prefix(&root).unwrap();
        let first = own.components().next().unwrap().as_os_str().to_str().unwrap();
        let room = first.trim_end_matches(".rs");
        // The crate's root and the program stand above all rooms.
        if ["lib", "main", "rooms", "commands"].contains(&room) {
            continue;
        }
        let from = level(room).unwrap_or_else(|| panic!("{room} is no room of lib.rs"));
        for (n, line) in fs::read_to_string(file).unwrap().lines().enumerate() {
            for to in named(line) {
                assert!(!to.is_empty(), "{}:{}: one import a room, so that arrows can be read", own.display(), n + 1);
                arrows += 1;
                if level(to).is_none_or(|to| to < from) {
                    wrong.push(format!("{}:{}: {room} uses {to}", own.display(), n + 1));
                }
            }
        }
    }
    assert!(arrows > 100, "the imports were not found: {arrows}");
    assert!(wrong.is_empty(), "arrows that run back up:\n{}", wrong.join("\n"));
}

#[test]
fn imports_are_read_off_a_line() {
    assert_eq!(named("use crate::atlas::{Atlas, UvId}; // crate::http").collect::<Vec<_>>(), ["atlas"]);
    assert_eq!(named("let a: crate::error::Result<crate::refine::Input>;").collect::<Vec<_>>(), ["error", "refine"]);
    assert_eq!(named("use crate::{atlas, http};").collect::<Vec<_>>(), [""]);
}
