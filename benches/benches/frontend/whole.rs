//! The whole front end on two cores: `terrane run` up to its verified pairs, and COLMAP's extraction and matching.

use std::process::Command;

use serde_json::Value;
use terrane_benches::table::{Bar, Row};
use terrane_benches::{Request, process};

use crate::peer;
use crate::sets::SETS;

/// The stages that COLMAP's extraction and matching cover.
const STAGES: [&str; 4] = ["ingest", "features", "pairs", "match"];

pub fn rows(request: &Request) -> anyhow::Result<Vec<Row>> {
    let terrane = process::terrane()?;
    let mut rows = Vec::new();
    for set in SETS.iter().filter(|set| request.wants_set(set.name, set.quick)) {
        let out = tempfile::tempdir()?;
        let mut run = Command::new(&terrane);
        run.arg("run").arg(set.path()).arg("-o").arg(out.path());
        run.args(set.camera.iter().flat_map(|camera| ["--camera", camera]));
        process::run(&mut run)?;
        let report: Value = serde_json::from_slice(&std::fs::read(out.path().join("report.json"))?)?;
        let (wall_s, cpu_s) = (of_stages(&report, "wall_seconds"), of_stages(&report, "cpu_seconds"));
        let answer = peer::frontend(set, &[]);
        let theirs = |key| {
            let value = &answer.as_ref()?.value;
            Some(peer::number(value, &["extract", key])? + peer::number(value, &["match", key])?)
        };
        let note = answer.as_ref().map_or("COLMAP did not run", |answer| answer.note);
        let figure = |what: &str| format!("{}, front end: {what}", set.name);
        rows.push(Row::new(figure("wall"), Some(wall_s), "s", Bar::None));
        rows.push(Row::new(figure("COLMAP's wall"), theirs("wall_s"), "s", Bar::None).note(note));
        rows.push(Row::new(
            figure("share of wall"),
            theirs("wall_s").map(|s| wall_s / s),
            "",
            Bar::AtMost(0.125),
        ));
        rows.push(Row::new(figure("share of CPU"), theirs("cpu_s").map(|s| cpu_s / s), "", Bar::None));
    }
    Ok(rows)
}

/// A figure of the front end's stages, added up.
fn of_stages(report: &Value, key: &str) -> f64 {
    let stages = report["costs"]["stages"].as_array().map(Vec::as_slice).unwrap_or_default();
    let wanted = stages.iter().filter(|stage| STAGES.iter().any(|name| stage["stage"] == *name));
    wanted.filter_map(|stage| stage[key].as_f64()).sum()
}
