//! What the compiler cannot guard: module docs, file sizes, unfinished work, stray files at the root.

use std::path::{Path, PathBuf};

const MAX_LINES: usize = 500;

/// Everything that may lie at the root of the repository.
const ROOT: &[&str] = &[
    ".ci",
    ".git",
    ".github",
    ".gitignore",
    "ARCHITECTURE.md",
    "CHANGELOG.md",
    "Cargo.lock",
    "Cargo.toml",
    "LICENSE-APACHE",
    "LICENSE-MIT",
    "NOTICE",
    "README.md",
    "benches",
    "clippy.toml",
    "crates",
    "deny.toml",
    "deploy",
    "docs",
    "proto",
    "rustfmt.toml",
    "target",
    "tests",
];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn rust_files(folder: &Path, found: &mut Vec<PathBuf>) {
    let mut entries: Vec<_> = std::fs::read_dir(folder).expect("folder is readable").flatten().collect();
    entries.sort_by_key(|entry| entry.path());
    for entry in entries {
        let path = entry.path();
        let name = entry.file_name();
        if path.is_dir() {
            if name != "target" && name != "generated" && name != ".git" {
                rust_files(&path, found);
            }
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            found.push(path);
        }
    }
}

fn sources() -> Vec<(PathBuf, String)> {
    let mut files = Vec::new();
    for folder in ["crates", "tests", "benches"] {
        rust_files(&root().join(folder), &mut files);
    }
    assert!(files.len() > 20, "only {} sources found: the walk is broken", files.len());
    files
        .into_iter()
        .map(|path| {
            let text = std::fs::read_to_string(&path).expect("sources are UTF-8");
            (path, text)
        })
        .collect()
}

fn check(what: &str, wrong: &[String]) {
    assert!(wrong.is_empty(), "{what}:\n{}", wrong.join("\n"));
}

#[test]
fn every_file_says_what_it_is() {
    let wrong: Vec<_> = sources()
        .iter()
        .filter(|(_, text)| !text.starts_with("//!"))
        .map(|(path, _)| format!("{}: begin with a line of `//!`", path.display()))
        .collect();
    check("files without module documentation", &wrong);
}

#[test]
fn no_file_is_too_long() {
    let wrong: Vec<_> = sources()
        .iter()
        .filter(|(_, text)| text.lines().count() > MAX_LINES)
        .map(|(path, text)| {
            format!(
                "{}: {} lines, at most {MAX_LINES}: split it by idea",
                path.display(),
                text.lines().count()
            )
        })
        .collect();
    check("files that are too long", &wrong);
}

#[test]
fn nothing_is_unfinished_or_switched_off() {
    let marks = [
        concat!("todo", "!("),
        concat!("unimplemented", "!("),
        concat!("FIX", "ME"),
        concat!("TO", "DO"),
        concat!("#[", "ignore"),
    ];
    let mut wrong = Vec::new();
    for (path, text) in sources() {
        for (number, line) in text.lines().enumerate() {
            if let Some(mark) = marks.iter().find(|mark| line.contains(**mark)) {
                wrong.push(format!("{}:{}: {mark}", path.display(), number + 1));
            }
        }
    }
    check("unfinished work", &wrong);
}

#[test]
fn the_root_holds_nothing_else() {
    // What a run leaves there, as the demo does, is git's to ignore.
    let ignored = std::fs::read_to_string(root().join(".gitignore")).expect("there is one");
    let ignored: Vec<&str> = ignored.lines().filter_map(|line| line.strip_prefix('/')).collect();
    let wrong: Vec<_> = std::fs::read_dir(root())
        .expect("the root is readable")
        .flatten()
        .map(|entry| entry.file_name().to_string_lossy().into_owned())
        .filter(|name| !ROOT.contains(&name.as_str()) && !ignored.contains(&name.as_str()))
        .collect();
    check("files at the root that the list in this test does not name", &wrong);
}

#[test]
fn toolchains_are_left_alone() {
    for name in ["rust-toolchain", "rust-toolchain.toml", ".cargo/config.toml"] {
        assert!(
            !root().join(name).exists(),
            "{name} would change the toolchain or flags behind a user's back"
        );
    }
}

#[test]
fn members_take_versions_from_the_root() {
    let mut wrong = Vec::new();
    let crates =
        std::fs::read_dir(root().join("crates")).expect("crates is readable").flatten().map(|e| e.path());
    for folder in crates.chain([root().join("tests"), root().join("benches")]) {
        let manifest = folder.join("Cargo.toml");
        let text = std::fs::read_to_string(&manifest).expect("every crate has a manifest");
        let mut in_dependencies = false;
        for (number, line) in text.lines().enumerate() {
            if line.starts_with('[') {
                in_dependencies = line.contains("dependencies");
            } else if in_dependencies
                && !line.trim().is_empty()
                && !line.starts_with('#')
                && !line.contains("workspace = true")
            {
                wrong.push(format!("{}:{}: {line}", manifest.display(), number + 1));
            }
        }
    }
    check("dependencies with a version outside the root", &wrong);
}
