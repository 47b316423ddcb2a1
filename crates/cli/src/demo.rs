//! `terrane demo`: renders a town with known truth, reconstructs it as any other set, and tells how far off the result is.

use std::fs::File;
use std::io::BufWriter;
use std::num::NonZeroU32;
use std::path::Path;

use rayon::prelude::*;
use serde_json::{Value, json};
use terrane_cluster::types::RunPhase;
use terrane_geometry::geodesy::{EnuFrame, Geodetic};
use terrane_geometry::{Rigid3, Sim3};
use terrane_scene::colmap::{ModelFiles, write_binary};
use terrane_scene::{ImageId, Reconstruction};
use terrane_testkit::compare::{self, Comparison};
use terrane_testkit::town::{Town, TownOptions};

use crate::args::{DemoFlags, OptionFlags, RunFlags};
use crate::exit::Failure;
use crate::{models, run, table};

/// Small enough that the town falls into several clusters.
const CLUSTER_SIZE: u32 = 28;

/// What the demo found out.
struct Verdict {
    /// Where cameras are, in the frame of the result, against the truth in the same frame.
    absolute: Option<Comparison>,
    /// The same after the similarity that takes the receiver's errors out.
    fitted: Option<Comparison>,
    /// Photographs of the town.
    offered: usize,
    /// `report.json`.
    report: Value,
}

/// Renders, reconstructs, compares and prints. The photographs stay in `OUT/photos`, the truth in `OUT/truth`.
pub async fn demo(flags: DemoFlags, json: bool) -> Result<(), Failure> {
    let out = flags.out;
    let photos = out.join("photos");
    let town = TownOptions::default();
    if !json {
        println!("rendering {} photographs of a town into {}", town.rows * town.columns, photos.display());
    }
    let truth = tokio::task::spawn_blocking({
        let out = out.clone();
        move || render(&town, &out)
    });
    let truth =
        truth.await.map_err(|error| Failure::system(format!("rendering the town failed: {error}")))??;
    let run_flags = RunFlags {
        photos,
        out: out.clone(),
        workers: NonZeroU32::new(2),
        threads: None,
        memory: None,
        port: 0,
        options: OptionFlags { cluster_size: Some(CLUSTER_SIZE), ..OptionFlags::default() },
    };
    let plan = run::Plan::resolve(&run_flags)?;
    let phase = run::reconstruct(&plan, json).await?;
    if phase != RunPhase::Done {
        return run::finish(&out, &phase, json);
    }
    let verdict = verdict(&out, &truth)?;
    print(&verdict, &out, json);
    Ok(())
}

/// Writes the photographs that are not there yet, and the truth as a COLMAP model.
fn render(options: &TownOptions, out: &Path) -> Result<Reconstruction, Failure> {
    let unwritable = |path: &Path, error: std::io::Error| {
        Failure::system(format!("{} can't be written: {error}", path.display()))
    };
    let photos = out.join("photos");
    std::fs::create_dir_all(&photos).map_err(|error| unwritable(&photos, error))?;
    let town = Town::new(options);
    let missing: Vec<usize> =
        (0..town.num_photographs()).filter(|index| !photos.join(town.name(*index)).is_file()).collect();
    missing.into_par_iter().try_for_each(|index| {
        let photograph = town.photograph(index);
        // Under another name first: an interrupted demo leaves no half photograph behind.
        let (path, part) = (photos.join(&photograph.name), photos.join(format!(".{index}.part")));
        std::fs::write(&part, &photograph.jpeg)
            .and_then(|()| std::fs::rename(&part, &path))
            .map_err(|error| unwritable(&path, error))
    })?;
    let truth = town.truth();
    write_truth(&town, &truth, &out.join("truth"))?;
    Ok(truth)
}

fn write_truth(town: &Town, truth: &Reconstruction, folder: &Path) -> Result<(), Failure> {
    let unwritable =
        |error: String| Failure::system(format!("{} can't be written: {error}", folder.display()));
    std::fs::create_dir_all(folder).map_err(|error| unwritable(error.to_string()))?;
    let create = |name: &str| {
        File::create(folder.join(name)).map(BufWriter::new).map_err(|error| unwritable(error.to_string()))
    };
    let files = ModelFiles {
        cameras: create("cameras.bin")?,
        images: create("images.bin")?,
        points: create("points3D.bin")?,
    };
    let name = |image: ImageId| town.name(image.index());
    write_binary(truth, &name, files).map_err(|error| unwritable(error.to_string()))
}

fn verdict(out: &Path, truth: &Reconstruction) -> Result<Verdict, Failure> {
    let path = out.join("report.json");
    let unreadable = |error: String| Failure::system(format!("{}: {error}", path.display()));
    let text = std::fs::read_to_string(&path).map_err(|error| unreadable(error.to_string()))?;
    let report: Value = serde_json::from_str(&text).map_err(|error| unreadable(error.to_string()))?;
    // Photographs are all there is in the folder and are named in order, so that ids are the town's own numbers.
    let mut result = models::read(&models::folder(out, 0)?)?.reconstruction;
    let fitted = compare::cameras(&result, truth, true);
    let absolute = town_from_result(&report["frame"]["origin"]).and_then(|town_from_result| {
        result.transform(&Sim3::from_rigid(&town_from_result));
        compare::cameras(&result, truth, false)
    });
    Ok(Verdict { absolute, fitted, offered: truth.images.len(), report })
}

/// The town's frame from the result's, from the origins of both; `None` when the result is not geo-referenced.
fn town_from_result(origin: &Value) -> Option<Rigid3> {
    let number = |key: &str| origin[key].as_f64();
    let position =
        Geodetic::from_degrees(number("latitude_deg")?, number("longitude_deg")?, number("height_m")?);
    let (result, town) = (EnuFrame::new(position), EnuFrame::new(Town::origin()));
    let map = |x: nalgebra::Vector3<f64>| town.enu_from_ecef(&result.ecef_from_enu(&x));
    let shift = map(nalgebra::Vector3::zeros());
    let axes = [nalgebra::Vector3::x(), nalgebra::Vector3::y(), nalgebra::Vector3::z()]
        .map(|axis| map(axis) - shift);
    let rotation = nalgebra::UnitQuaternion::from_matrix(&nalgebra::Matrix3::from_columns(&axes));
    Some(Rigid3::new(rotation, shift))
}

fn print(verdict: &Verdict, out: &Path, json: bool) {
    let registered = verdict.report["images"]["registered"].as_u64().unwrap_or(0);
    if json {
        let errors = |comparison: &Option<Comparison>| {
            comparison.as_ref().map(|c| {
                json!({
                    "center_median_m": c.center_median_m,
                    "center_rmse_m": c.center_rmse_m,
                    "rotation_median_deg": c.rotation_median_rad.to_degrees(),
                })
            })
        };
        println!(
            "{}",
            json!({ "event": "demo", "offered": verdict.offered, "registered": registered,
                    "absolute": errors(&verdict.absolute), "fitted": errors(&verdict.fitted) })
        );
        return;
    }
    println!("\nThe town, {} photographs, {registered} registered\n", verdict.offered);
    println!("{:<44} {:>10} {:>10} {:>12}", "cameras against truth", "median m", "RMSE m", "median deg");
    let rows =
        [("as geo-referenced by noisy GPS", &verdict.absolute), ("after a similarity fit", &verdict.fitted)];
    for (name, comparison) in rows {
        match comparison {
            Some(c) => println!(
                "{name:<44} {:>10.3} {:>10.3} {:>12.4}",
                c.center_median_m,
                c.center_rmse_m,
                c.rotation_median_rad.to_degrees()
            ),
            None => println!("{name:<44} {:>10}", "not to be had"),
        }
    }
    table::print(&verdict.report);
    println!("\nresult: {}   truth: {}", out.display(), out.join("truth").display());
    println!("look closer: terrane inspect {}", out.display());
}
