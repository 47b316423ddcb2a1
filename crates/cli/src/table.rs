//! The main figures of a report, as a table for people.

use serde_json::Value;

/// Prints seams, satellite positions, stages and processes of `report.json`.
pub fn print(report: &Value) {
    result(report);
    seams(report);
    costs(&report["costs"]);
}

fn rows(value: &Value) -> &[Value] {
    value.as_array().map_or(&[], Vec::as_slice)
}

fn number(value: &Value) -> String {
    value.as_f64().map_or_else(|| "-".into(), |number| format!("{number:.3}"))
}

fn result(report: &Value) {
    let frame = report["frame"]["kind"].as_str().unwrap_or("arbitrary");
    println!(
        "\n{:<12} {:>8} {:>9} {:>13} {:>12} {:>12} {:>12}",
        "component", "images", "points", "reprojection", "track", "GPS median", "GPS RMSE"
    );
    for (index, component) in rows(&report["components"]).iter().enumerate() {
        println!(
            "{index:<12} {:>8} {:>9} {:>10} px {:>12} {:>10} m {:>10} m",
            component["images"].as_u64().unwrap_or(0),
            component["points"].as_u64().unwrap_or(0),
            number(&component["mean_reprojection_error_px"]),
            number(&component["mean_track_length"]),
            number(&component["gps"]["median_m"]),
            number(&component["gps"]["rmse_m"]),
        );
    }
    println!("clusters: {}; frame: {frame}", rows(&report["clusters"]).len());
}

fn seams(report: &Value) {
    let seams = rows(&report["seams"]);
    if seams.is_empty() {
        return;
    }
    println!("\n{:<16} {:>16} {:>16}   verdict", "seam", "cameras apart", "points apart");
    for seam in seams {
        let end = |key: &str| seam[key]["cluster"].as_u64().or_else(|| seam[key][0].as_u64()).unwrap_or(0);
        let figures = &seam["figures"];
        let verdict =
            seam["refused"].as_str().map_or_else(|| "used".into(), |reason| format!("refused: {reason}"));
        println!(
            "{:<16} {:>14} m {:>14} m   {verdict}",
            format!("{} - {}", end("a"), end("b")),
            number(&figures["camera_distance_rms"]),
            number(&figures["point_distance_median"]),
        );
    }
}

fn costs(costs: &Value) {
    println!("\n{:<12} {:>9} {:>9} {:>7} {:>7}", "stage", "wall s", "CPU s", "tasks", "reused");
    for stage in rows(&costs["stages"]) {
        let count = |key: &str| stage[key].as_u64().unwrap_or(0);
        println!(
            "{:<12} {:>9} {:>9} {:>7} {:>7}",
            stage["stage"].as_str().unwrap_or("?"),
            seconds(&stage["wall_seconds"]),
            seconds(&stage["cpu_seconds"]),
            count("tasks_run"),
            count("tasks_reused")
        );
    }
    println!("{:<12} {:>9}", "whole run", seconds(&costs["wall_seconds"]));
    if let Some(peaks) = costs["peak_bytes"].as_object() {
        for (process, bytes) in peaks {
            println!(
                "peak memory of {process}: {:.0} MiB",
                bytes.as_f64().unwrap_or(0.0) / f64::from(1 << 20)
            );
        }
    }
}

fn seconds(value: &Value) -> String {
    value.as_f64().map_or_else(|| "-".into(), |number| format!("{number:.1}"))
}
