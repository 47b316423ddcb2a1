//! The main job: photographs in, one reconstruction out, against surveyed positions, GPS, and the peer's own figures.

use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;
use terrane_benches::table::{self, Bar, Row};
use terrane_benches::{Request, data, peer, process};

/// A set of photographs, how to run it and what must come out.
struct Set {
    name: &'static str,
    folder: &'static str,
    flags: &'static [&'static str],
    truth: Truth,
    registered: f64,
    quick: bool,
}

enum Truth {
    /// Surveyed centres: root mean square of at most so many metres.
    Surveyed { folder: &'static str, rmse_m: f64 },
    /// Mean reprojection error of at most so many pixels.
    Reprojection { mean_px: f64 },
    /// GPS in the photographs: root mean square, or median, of at most so many metres.
    Gps { rmse_m: Option<f64>, median_m: Option<f64> },
}

const CASTLE_CAMERA: &str = "PINHOLE:2759.48,2764.16,1520.69,1006.81";

const SETS: &[Set] = &[
    Set {
        name: "fountain-P11",
        folder: "strecha/fountain-P11/images",
        flags: &[],
        truth: Truth::Surveyed { folder: "strecha/fountain-P11/gt_dense_cameras", rmse_m: 0.010 },
        registered: 11.0,
        quick: true,
    },
    Set {
        name: "castle-P19",
        folder: "strecha/castle-P19/images",
        flags: &["--camera", CASTLE_CAMERA],
        truth: Truth::Surveyed { folder: "strecha/castle-P19/gt_dense_cameras", rmse_m: 0.047 },
        registered: 19.0,
        quick: false,
    },
    Set {
        name: "sceaux-castle",
        folder: "sceaux-castle/images",
        flags: &[],
        truth: Truth::Reprojection { mean_px: 0.7 },
        registered: 11.0,
        quick: true,
    },
    Set {
        name: "brighton-half",
        folder: "brighton-half/images",
        flags: &[],
        truth: Truth::Gps { rmse_m: Some(0.50), median_m: None },
        registered: 18.0,
        quick: true,
    },
    Set {
        name: "seneca-half",
        folder: "seneca-half/images",
        flags: &["--workers", "2", "--cluster-size", "50"],
        truth: Truth::Gps { rmse_m: None, median_m: Some(2.96) },
        registered: 163.0,
        quick: false,
    },
];

fn main() -> anyhow::Result<()> {
    let request = Request::from_args()?;
    let terrane = process::terrane()?;
    let python = process::python();
    let mut rows = Vec::new();
    for set in SETS.iter().filter(|set| request.wants(set.name) && (set.quick || !request.quick)) {
        for row in measure(set, &terrane, python.as_deref())? {
            table::print(&row);
            rows.push(row);
        }
    }
    if let Some(path) = &request.json {
        table::write_json(path, &rows)?;
    }
    Ok(())
}

fn measure(set: &Set, terrane: &Path, python: Option<&Path>) -> anyhow::Result<Vec<Row>> {
    let photos = data().join(set.folder);
    let command = format!("terrane run {} -o OUT {}", set.folder, set.flags.join(" "));
    if !photos.is_dir() {
        let row = Row::new(format!("{}: photographs", set.name), None, "", Bar::None).command(&command);
        return Ok(vec![row.note(format!("{} is missing: set TERRANE_DATA", photos.display()))]);
    }
    let out = tempfile::tempdir()?;
    let mut run = Command::new(terrane);
    run.arg("run").arg(&photos).arg("-o").arg(out.path()).args(set.flags);
    let (usage, _) = process::run(&mut run)?;
    let report: Value = serde_json::from_slice(&std::fs::read(out.path().join("report.json"))?)?;
    let judged = python.and_then(|python| judge(python, set, &photos, out.path()));
    let mut rows = figures(set, judged.as_ref(), &report);
    rows.push(Row::new(format!("{}: wall", set.name), Some(usage.wall_s), "s", wall_bar(set)));
    rows.push(Row::new(format!("{}: CPU", set.name), Some(usage.cpu_s), "s", Bar::None));
    let peaks = report["costs"]["peak_bytes"].as_object();
    let peak = peaks.and_then(|peaks| peaks.values().filter_map(Value::as_f64).reduce(f64::max));
    let peak_mib = peak.map(|bytes| bytes / f64::from(1 << 20));
    rows.push(Row::new(format!("{}: peak of one process", set.name), peak_mib, "MiB", Bar::None));
    Ok(rows.into_iter().map(|row| row.command(&command)).collect())
}

/// COLMAP's extract + match + incremental on such a machine, for the one set whose bar names it.
fn wall_bar(set: &Set) -> Bar {
    if set.name == "seneca-half" { Bar::AtMost(1356.0) } else { Bar::None }
}

/// The peers' judge on the first component, or `None` when it does not run.
fn judge(python: &Path, set: &Set, photos: &Path, out: &Path) -> Option<Value> {
    let truth: (&str, PathBuf) = match &set.truth {
        Truth::Surveyed { folder, .. } => ("--gt-strecha", data().join(folder)),
        Truth::Gps { .. } => ("--gt-gps", photos.to_owned()),
        Truth::Reprojection { .. } => ("--gt-model", out.join("sparse/0")),
    };
    let mut command = Command::new(python);
    command.arg(peer().join("evaluate.py")).arg(out.join("sparse/0")).arg(truth.0).arg(truth.1);
    let (_, text) = process::run(&mut command).ok()?;
    serde_json::from_str(text.trim()).ok()
}

fn figures(set: &Set, judged: Option<&Value>, report: &Value) -> Vec<Row> {
    let note = if judged.is_some() {
        "judged by evaluate.py"
    } else {
        "no Python with pycolmap: evaluate.py was not run"
    };
    let figure = |key: &str| judged.and_then(|values| values[key].as_f64());
    let row =
        |name: &str, got, unit, bar| Row::new(format!("{}: {name}", set.name), got, unit, bar).note(note);
    let mut rows = vec![row("registered", figure("registered"), "", Bar::AtLeast(set.registered))];
    match &set.truth {
        Truth::Surveyed { rmse_m, .. } => {
            rows.push(row("centre RMSE", figure("centre_rmse"), "m", Bar::AtMost(*rmse_m)));
            rows.push(row("AUC@1", figure("auc@1"), "", Bar::None));
        }
        Truth::Reprojection { mean_px } => {
            rows.push(row("mean reprojection error", figure("reproj"), "px", Bar::AtMost(*mean_px)));
        }
        Truth::Gps { rmse_m, median_m } => {
            let bar = |limit: &Option<f64>| limit.map_or(Bar::None, Bar::AtMost);
            rows.push(row("GPS residual RMSE", figure("centre_rmse"), "m", bar(rmse_m)));
            rows.push(row("GPS residual median", figure("centre_median"), "m", bar(median_m)));
        }
    }
    let count = |key: &str| report[key].as_array().map(|list| list.len() as f64);
    if set.name == "seneca-half" {
        rows.push(row("clusters", count("clusters"), "", Bar::AtLeast(4.0)));
        rows.push(row("components", count("components"), "", Bar::AtMost(1.0)));
    }
    rows
}
