//! Real photographs with known answers, end to end, with real processes. The two larger sets are the bench's.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use nalgebra::Vector3;
use terrane_scene::colmap::{ModelFiles, read_binary};
use terrane_tests::{data, judge, terrane};

/// Runs a set and returns its report and the camera centres of the first component.
fn run(photos: &Path, out: &Path, flags: &[&str]) -> (serde_json::Value, BTreeMap<String, Vector3<f64>>) {
    let output =
        terrane().arg("run").arg(photos).arg("-o").arg(out).args(flags).output().expect("terrane starts");
    assert!(output.status.success(), "terrane run failed:\n{}", String::from_utf8_lossy(&output.stderr));
    let report = std::fs::read(out.join("report.json")).expect("a report is written");
    (serde_json::from_slice(&report).expect("the report is JSON"), centers(&out.join("sparse/0")))
}

/// Camera centres by file name of a model in COLMAP's binary format.
fn centers(model: &Path) -> BTreeMap<String, Vector3<f64>> {
    let open = |name: &str| BufReader::new(File::open(model.join(name)).expect("the model is there"));
    let files =
        ModelFiles { cameras: open("cameras.bin"), images: open("images.bin"), points: open("points3D.bin") };
    let model = read_binary(files).expect("the model is readable");
    let images = model.reconstruction.images.iter();
    images
        .map(|image| {
            let name = model.name(image.image).expect("every image has a name");
            (name.to_owned(), image.cam_from_world.center())
        })
        .collect()
}

#[test]
fn fountain_is_within_ten_millimetres() {
    let Some(folder) = data("strecha/fountain-P11") else { return };
    let out = tempfile::tempdir().expect("a folder for results");
    let (_, centers) = run(&folder.join("images"), out.path(), &[]);
    let truth = judge::strecha_centers(&folder.join("gt_dense_cameras"));
    let judged = judge::judge(&centers, &truth).expect("enough photographs are registered");
    assert_eq!((judged.registered, judged.of), (11, 11), "{judged:?}");
    assert!(judged.rmse_m <= 0.010 && judged.rmse_m > 1e-5, "{judged:?}");
}

#[test]
fn sceaux_castle_fits_its_observations() {
    let Some(folder) = data("sceaux-castle") else { return };
    let out = tempfile::tempdir().expect("a folder for results");
    let (report, centers) = run(&folder.join("images"), out.path(), &[]);
    assert_eq!(centers.len(), 11);
    let error_px =
        report["components"][0]["mean_reprojection_error_px"].as_f64().expect("the report has the error");
    assert!((0.1..=0.7).contains(&error_px), "mean reprojection error {error_px} px");
}

#[test]
fn brighton_agrees_with_its_gps() {
    let Some(folder) = data("brighton-half") else { return };
    let out = tempfile::tempdir().expect("a folder for results");
    let (report, centers) = run(&folder.join("images"), out.path(), &[]);
    // The folder holds a nineteenth picture, which is not of the flight.
    assert_eq!(centers.keys().filter(|name| name.starts_with("DJI_")).count(), 18);
    let rmse_m = report["components"][0]["gps"]["rmse_m"].as_f64().expect("the report has GPS residuals");
    assert!((0.01..=0.50).contains(&rmse_m), "GPS residual RMSE {rmse_m} m");
}
