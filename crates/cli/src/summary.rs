//! The main figures of a finished run, from its report.

use std::path::Path;

use serde_json::Value;

use crate::exit::Failure;

/// Prints the main figures of `OUT/report.json`.
pub fn print(out: &Path, json: bool) -> Result<(), Failure> {
    let path = out.join("report.json");
    let text = std::fs::read_to_string(&path)
        .map_err(|error| Failure::system(format!("{}: {error}", path.display())))?;
    let report: Value = serde_json::from_str(&text)
        .map_err(|error| Failure::system(format!("{}: {error}", path.display())))?;
    if json {
        println!("{}", serde_json::json!({ "event": "done", "out": out, "report": report }));
    } else {
        print!("{}", as_text(&report));
        println!("result      {}", out.display());
    }
    Ok(())
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or(f64::NAN)
}

fn as_text(report: &Value) -> String {
    let mut text = String::new();
    let none = Vec::new();
    let list = |value: &'static str| report[value].as_array().unwrap_or(&none);
    let images = &report["images"];
    text.push_str(&format!("images      {} of {} registered\n", images["registered"], images["offered"]));
    let refused = list("seams").iter().filter(|seam| !seam["refused"].is_null()).count();
    text.push_str(&format!(
        "structure   {} clusters, {} seams ({refused} refused), {} components\n",
        list("clusters").len(),
        list("seams").len(),
        list("components").len()
    ));
    for (at, component) in list("components").iter().enumerate() {
        text.push_str(&format!(
            "component {at} {} images, {} points, reprojection error {:.3} px, track length {:.2}\n",
            component["images"],
            component["points"],
            number(&component["mean_reprojection_error_px"]),
            number(&component["mean_track_length"])
        ));
        if let Some(gps) = component["gps"].as_object() {
            let figure = |name| number(gps.get(name).unwrap_or(&Value::Null));
            text.push_str(&format!(
                "            GPS residuals: median {:.3} m, RMSE {:.3} m\n",
                figure("median_m"),
                figure("rmse_m")
            ));
        }
    }
    text.push_str(&format!("frame       {}", report["frame"]["kind"].as_str().unwrap_or("unknown")));
    if let Some(origin) = report["frame"]["origin"].as_object() {
        let degrees = |name| number(origin.get(name).unwrap_or(&Value::Null));
        text.push_str(&format!(" at {:.7}, {:.7}", degrees("latitude_deg"), degrees("longitude_deg")));
    }
    text.push('\n');
    text.push_str(&costs(&report["costs"]));
    text
}

/// Stages that took time, then the processes.
fn costs(costs: &Value) -> String {
    let mut text = String::from("stage        wall s    CPU s  tasks  reused  peak MiB\n");
    for stage in costs["stages"].as_array().unwrap_or(&Vec::new()) {
        if stage["tasks_run"].as_u64() == Some(0) && stage["tasks_reused"].as_u64() == Some(0) {
            continue;
        }
        text.push_str(&format!(
            "{:<12}{:>7.1}  {:>7.1}  {:>5}  {:>6}  {:>8}\n",
            stage["stage"].as_str().unwrap_or(""),
            number(&stage["wall_seconds"]),
            number(&stage["cpu_seconds"]),
            stage["tasks_run"],
            stage["tasks_reused"],
            stage["peak_bytes"].as_u64().unwrap_or(0) >> 20
        ));
    }
    for (name, bytes) in costs["peak_bytes"].as_object().into_iter().flatten() {
        text.push_str(&format!("peak memory {name}: {} MiB\n", bytes.as_u64().unwrap_or(0) >> 20));
    }
    text.push_str(&format!("time        {:.1} s\n", number(&costs["wall_seconds"])));
    text
}

#[cfg(test)]
mod tests {
    #[test]
    fn figures_are_told_and_missing_ones_do_not_matter() {
        let report = serde_json::json!({
            "images": { "registered": 11, "offered": 12 },
            "components": [{ "images": 11, "points": 5, "mean_reprojection_error_px": 0.5, "mean_track_length": 3.0,
                "gps": { "median_m": 0.25, "rmse_m": 0.5 } }],
            "seams": [{ "refused": "loop" }, { "refused": null }],
            "frame": { "kind": "local east-north-up", "origin": { "latitude_deg": 1.5, "longitude_deg": 2.0 } },
            "costs": { "wall_seconds": 3.0, "peak_bytes": { "local-0": 1048576 }, "stages": [
                { "stage": "match", "wall_seconds": 1.0, "cpu_seconds": 2.0, "tasks_run": 4, "tasks_reused": 0, "peak_bytes": 0 },
                { "stage": "submap", "tasks_run": 0, "tasks_reused": 0 } ] },
        });
        let text = super::as_text(&report);
        for part in [
            "11 of 12",
            "2 seams (1 refused)",
            "0.500 px",
            "RMSE 0.500 m",
            "1.5000000",
            "local-0: 1 MiB",
            "match",
        ] {
            assert!(text.contains(part), "{part} in\n{text}");
        }
        assert!(!text.contains("submap"));
        assert!(super::as_text(&serde_json::json!({})).contains("frame       unknown"));
    }
}
