//! Retrieval with positions hidden: which part of the pairs that COLMAP verifies is among 30 candidates an image.

use std::fmt::Write as _;
use std::process::Command;

use terrane_benches::table::{Bar, Row};
use terrane_benches::{Request, process, root};

use crate::peer;
use crate::sets::Set;

/// COLMAP's least number of inliers of a verified pair.
const MIN_INLIERS: u64 = 15;

pub fn rows(request: &Request) -> anyhow::Result<Vec<Row>> {
    let figure = "seneca-half: verified pairs found with 30 candidates, GPS hidden";
    let row = |got| Row::new(figure, got, "", Bar::AtLeast(0.95));
    if request.quick {
        return Ok(Vec::new());
    }
    let set = Set::named("seneca-half");
    let Some(answer) = peer::frontend(set, &[]) else {
        return Ok(vec![row(None).note("COLMAP did not run")]);
    };
    let folder = tempfile::tempdir()?;
    let truth = folder.path().join("pairs.txt");
    std::fs::write(&truth, list(&answer.value))?;
    let mut command = Command::new(env!("CARGO"));
    command.args([
        "run",
        "--release",
        "--package",
        "terrane-frontend",
        "--example",
        "retrieval",
        "--",
        "--truth",
    ]);
    command.arg(&truth).arg(set.path()).current_dir(root());
    let (_, text) = process::run(&mut command)?;
    Ok(vec![row(text.lines().next_back().and_then(recall_at_30)).note(answer.note)])
}

/// Two names and a number of inliers a line.
fn list(value: &serde_json::Value) -> String {
    let mut text = String::new();
    for row in value["pairs"].as_array().into_iter().flatten() {
        if let (Some(a), Some(b), Some(inliers)) = (row[0].as_str(), row[1].as_str(), row[2].as_u64())
            && inliers >= MIN_INLIERS
        {
            let _ = writeln!(text, "{a}\t{b}\t{inliers}");
        }
    }
    text
}

/// The figure that a line gives for 30 candidates, as `@30 0.97`.
fn recall_at_30(line: &str) -> Option<f64> {
    line.split("@30 ").nth(1)?.split_whitespace().next()?.parse().ok()
}
