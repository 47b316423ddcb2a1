//! `terrane inspect`: what a finished result holds.

use terrane_scene::ImageId;
use terrane_scene::colmap::ColmapModel;

use crate::args::InspectFlags;
use crate::exit::Failure;
use crate::{models, summary};

/// Prints the components of a result and, when there is one, its report in short.
pub fn inspect(flags: &InspectFlags, json: bool) -> Result<(), Failure> {
    let mut rows = Vec::new();
    for folder in models::folders(&flags.out)? {
        let row = row(&models::read(&folder)?);
        if !json {
            println!("{}", folder.display());
            println!(
                "  {} images, {} cameras, {} points, {} observations",
                row["images"], row["cameras"], row["points"], row["observations"]
            );
            println!(
                "  mean reprojection error {:.3} px, mean track length {:.2}",
                number(&row["mean_reprojection_error_px"]),
                number(&row["mean_track_length"])
            );
        }
        rows.push(row);
    }
    if json {
        println!("{}", serde_json::json!({ "event": "inspect", "components": rows }));
        return Ok(());
    }
    if flags.out.join("report.json").is_file() {
        summary::print(&flags.out, false)?;
    }
    Ok(())
}

fn number(value: &serde_json::Value) -> f64 {
    value.as_f64().unwrap_or(f64::NAN)
}

fn row(model: &ColmapModel) -> serde_json::Value {
    let scene = &model.reconstruction;
    let unnamed: Vec<ImageId> =
        scene.images.iter().map(|image| image.image).filter(|image| model.name(*image).is_none()).collect();
    serde_json::json!({
        "images": scene.images.len(),
        "unnamed_images": unnamed.len(),
        "cameras": scene.cameras.len(),
        "points": scene.points.len(),
        "observations": scene.observations.len(),
        "mean_reprojection_error_px": scene.mean_reprojection_error_px(),
        "mean_track_length": scene.mean_track_length(),
    })
}
