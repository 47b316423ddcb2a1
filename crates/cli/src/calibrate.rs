//! `terrane calibrate`: a camera's intrinsics from photographs of a planar target.

use std::path::PathBuf;

use terrane_geometry::{Camera, CameraModel};
use terrane_pipeline::calibrate::{CalibrationReport, calibrate_photographs};
use terrane_pipeline::is_photograph;

use crate::args::CalibrateFlags;
use crate::exit::Failure;

/// Finds corners, calibrates, writes, prints.
pub fn calibrate(flags: &CalibrateFlags, json: bool) -> Result<(), Failure> {
    let model = CameraModel::from_name(&flags.model.to_ascii_uppercase()).ok_or_else(|| {
        Failure::input(format!("--model {}: use one of {}", flags.model, CameraModel::names()))
    })?;
    let paths = photographs(&flags.photos)?;
    let report = calibrate_photographs(&paths, &flags.target, model)
        .map_err(|error| Failure::input(error.to_string()))?;
    if let (Some(camera), Some(out)) = (&report.camera, &flags.out) {
        // What `--config` reads.
        let options = serde_json::json!({
            "camera": { "model": camera.model, "params": camera.params() }
        });
        std::fs::write(out, format!("{options:#}\n"))
            .map_err(|error| Failure::system(format!("{}: {error}", out.display())))?;
    }
    if json {
        let flag = report.camera.as_ref().map(flag);
        println!("{}", serde_json::json!({ "event": "calibration", "report": report, "camera_flag": flag }));
    } else {
        print(&report);
    }
    match &report.failure {
        None => Ok(()),
        Some(why) => {
            let used = report.photographs.iter().filter(|photograph| photograph.unused.is_none()).count();
            let of = report.photographs.len();
            Err(Failure::short(format!(
                "no camera from {used} of {of} photographs that show the target: {why}"
            )))
        }
    }
}

/// Files as named, and those of folders, in the order of their names.
fn photographs(named: &[PathBuf]) -> Result<Vec<PathBuf>, Failure> {
    let mut paths = Vec::new();
    for path in named {
        if !path.is_dir() {
            paths.push(path.clone());
            continue;
        }
        let failed = |error: std::io::Error| Failure::input(format!("{}: {error}", path.display()));
        let mut within = Vec::new();
        for entry in std::fs::read_dir(path).map_err(failed)? {
            let file = entry.map_err(failed)?.path();
            if file.file_name().and_then(|name| name.to_str()).is_some_and(is_photograph) {
                within.push(file);
            }
        }
        within.sort();
        paths.extend(within);
    }
    Ok(paths)
}

/// The camera as `--camera` takes it.
fn flag(camera: &Camera) -> String {
    let params: Vec<String> = camera.params().iter().map(f64::to_string).collect();
    format!("{}:{}", camera.model.name(), params.join(","))
}

fn print(report: &CalibrationReport) {
    println!("{:<40} {:>8} {:>9}", "photograph", "corners", "rms px");
    for photograph in &report.photographs {
        let rms = photograph.rms_px.map_or_else(|| "-".into(), |rms| format!("{rms:.3}"));
        let why = photograph.unused.as_deref().unwrap_or("");
        println!("{:<40} {:>8} {rms:>9}  {why}", photograph.path.display(), photograph.corners);
    }
    if let Some(camera) = &report.camera {
        println!("\n{:<10} {:>14} {:>12}", camera.model.name(), "value", "sigma");
        for (name, (value, sigma)) in
            names(camera.model).iter().zip(camera.params().iter().zip(&report.params_sigma))
        {
            println!("{name:<10} {value:>14.6} {sigma:>12.6}");
        }
        println!(
            "rms {:.3} px, pictures of {} x {}",
            report.rms_px.unwrap_or(f64::NAN),
            camera.width_px,
            camera.height_px
        );
        println!("\n--camera {}", flag(camera));
    }
    for warning in &report.warnings {
        println!("warning: {warning}");
    }
}

/// Names of a model's parameters, in COLMAP's order.
fn names(model: CameraModel) -> Vec<String> {
    let focal: &[&str] = if model.num_focal() == 1 { &["f"] } else { &["fx", "fy"] };
    let distortion: &[&str] = match model.num_distortion() {
        count @ 0..=2 => &["k1", "k2"][..count],
        _ => &["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"],
    };
    let center = ["cx", "cy"];
    focal.iter().chain(&center).chain(distortion).map(|&name| name.to_owned()).collect()
}
