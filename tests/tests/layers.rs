//! The allowed edges between crates, and the crates that may name foreign ones. A new edge is an edit of this table.

use std::collections::{BTreeMap, BTreeSet};
use std::process::Command;

/// What each crate may use of ours, and which of the guarded foreign crates.
const ALLOWED: &[(&str, &[&str])] = &[
    ("geometry", &["nalgebra"]),
    ("optim", &["geometry", "nalgebra", "faer", "rayon"]),
    ("scene", &["geometry", "nalgebra", "rusqlite"]),
    ("viewgraph", &["geometry", "optim", "scene", "nalgebra", "rayon"]),
    ("frontend", &["geometry", "scene", "nalgebra", "rayon", "kiddo"]),
    ("mapping", &["geometry", "optim", "scene", "viewgraph", "nalgebra", "rayon"]),
    ("fusion", &["geometry", "optim", "scene", "viewgraph", "mapping", "nalgebra", "rayon", "kiddo"]),
    (
        "pipeline",
        &[
            "geometry",
            "optim",
            "scene",
            "viewgraph",
            "frontend",
            "mapping",
            "fusion",
            "nalgebra",
            "rayon",
            "tokio",
            "object_store",
        ],
    ),
    ("proto", &["tonic", "prost", "tokio"]),
    ("cluster", &["pipeline", "proto", "tokio"]),
    (
        "cli",
        &[
            "cluster", "pipeline", "fusion", "geometry", "scene", "testkit", "nalgebra", "tokio", "clap",
            "rayon",
        ],
    ),
    ("testkit", &["geometry", "scene", "nalgebra", "rayon"]),
    ("xtask", &[]),
];

/// Foreign crates that must stop at one place.
const GUARDED: &[&str] = &[
    "nalgebra",
    "faer",
    "rayon",
    "kiddo",
    "tokio",
    "tonic",
    "prost",
    "object_store",
    "clap",
    "reqwest",
    "rusqlite",
];

fn edges() -> BTreeMap<String, BTreeSet<String>> {
    let output = Command::new(env!("CARGO"))
        .args(["metadata", "--format-version", "1", "--no-deps", "--offline"])
        .current_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
        .output()
        .expect("cargo metadata runs");
    let metadata: serde_json::Value =
        serde_json::from_slice(&output.stdout).expect("cargo metadata prints JSON");
    let mut edges = BTreeMap::new();
    for package in metadata["packages"].as_array().expect("packages") {
        let name = package["name"].as_str().expect("name").to_owned();
        let normal =
            package["dependencies"].as_array().expect("dependencies").iter().filter(|d| d["kind"].is_null());
        edges.insert(name, normal.map(|d| d["name"].as_str().expect("name").to_owned()).collect());
    }
    edges
}

#[test]
fn crates_depend_only_downwards() {
    let edges = edges();
    let mut wrong = Vec::new();
    for (name, allowed) in ALLOWED {
        let package = format!("terrane-{name}");
        let dependencies = edges.get(&package).unwrap_or_else(|| panic!("{package} is not in the workspace"));
        for dependency in dependencies {
            let ours = dependency.strip_prefix("terrane-");
            let guarded = ours.is_some() || GUARDED.contains(&dependency.as_str());
            if guarded && !allowed.contains(&ours.unwrap_or(dependency)) {
                wrong.push(format!("{package} -> {dependency}"));
            }
        }
    }
    assert!(wrong.is_empty(), "edges that the table in this test does not allow: {wrong:#?}");
}

#[test]
fn the_table_names_every_crate() {
    let known: BTreeSet<String> = ALLOWED.iter().map(|(name, _)| format!("terrane-{name}")).collect();
    let others = ["terrane-tests", "terrane-benches"];
    let unknown: Vec<_> = edges()
        .into_keys()
        .filter(|name| !known.contains(name) && !others.contains(&name.as_str()))
        .collect();
    assert!(unknown.is_empty(), "add these crates to the table: {unknown:?}");
}
