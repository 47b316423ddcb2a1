//! Helpers shared by the whole-system tests: the binary under test, the photographs with known answers, the judge.

pub mod judge;
pub mod processes;

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

/// The `terrane` binary as it is released: optimised, with all features of its own and none of the tests'.
pub fn binary() -> &'static Path {
    static BINARY: OnceLock<PathBuf> = OnceLock::new();
    BINARY.get_or_init(|| {
        let mut build = Command::new(env!("CARGO"));
        build.args([
            "build",
            "--release",
            "--package",
            "terrane-cli",
            "--bin",
            "terrane",
            "--features",
            "full",
            "--message-format=json",
        ]);
        let output = build.current_dir(root()).output().expect("cargo runs");
        assert!(
            output.status.success(),
            "building terrane failed:\n{}",
            String::from_utf8_lossy(&output.stderr)
        );
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        let mut executables = text.lines().filter_map(|line| {
            let message: serde_json::Value = serde_json::from_str(line).ok()?;
            message["executable"].as_str().map(PathBuf::from)
        });
        executables.next_back().expect("cargo names the executable")
    })
}

/// A command that runs `terrane`.
pub fn terrane() -> Command {
    Command::new(binary())
}

/// The root of the workspace.
pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// A set of photographs with known answers, or `None` where there are none.
///
/// They lie in `TERRANE_DATA`, by default `../shared/data` beside the checkout.
///
/// # Panics
/// With `CI=true` their absence is a failure.
pub fn data(set: &str) -> Option<PathBuf> {
    let folder =
        std::env::var_os("TERRANE_DATA").map_or_else(|| root().join("../shared/data"), PathBuf::from);
    let path = folder.join(set);
    if path.is_dir() {
        return Some(path);
    }
    let in_ci = std::env::var("CI").is_ok_and(|value| value == "true");
    assert!(!in_ci, "{} is missing and CI=true: set TERRANE_DATA", path.display());
    println!("{} is missing: this test was not run; set TERRANE_DATA to run it", path.display());
    None
}

/// The files of a folder and below with their bytes, by path, to compare two results.
pub fn contents(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut found = Vec::new();
    collect(folder, folder, &mut found);
    found.sort();
    found
}

fn collect(root: &Path, folder: &Path, found: &mut Vec<(PathBuf, Vec<u8>)>) {
    let entries = std::fs::read_dir(folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display()));
    for path in entries.flatten().map(|entry| entry.path()) {
        if path.is_dir() {
            collect(root, &path, found);
        } else {
            let bytes = std::fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
            found.push((path.strip_prefix(root).unwrap_or(&path).to_owned(), bytes));
        }
    }
}
