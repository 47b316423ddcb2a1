//! `terrane calibrate` on rendered targets: the camera is found, and what can't serve is said.

use std::path::Path;
use std::process::Output;

use serde_json::Value;
use terrane_geometry::{Camera, CameraModel};
use terrane_testkit::targets::{Pattern, RenderOptions, photograph, random_pose};
use terrane_tests::terrane;

fn camera() -> Camera {
    let params = [620.0, 625.0, 325.0, 238.0, -0.15, 0.04, 0.0005, -0.0005];
    Camera::new(CameraModel::OpenCv, 640, 480, &params).expect("eight parameters")
}

/// Writes so many photographs of a checkerboard of 9 x 6 inner corners.
fn photograph_board(folder: &Path, count: u64) {
    let (pattern, camera) = (Pattern::checkerboard(9, 6, 0.03), camera());
    for index in 0..count {
        let options = RenderOptions { noise_greys: 2.0, blur_px: 0.6, seed: index, ..Default::default() };
        let pose = random_pose(&pattern, &camera, 0.6, index);
        let file = photograph(&pattern, &camera, &pose, &options);
        std::fs::write(folder.join(format!("board{index:02}.jpg")), file).expect("a photograph is written");
    }
}

fn calibrate(folder: &Path, flags: &[&str]) -> Output {
    let mut command = terrane();
    command.arg("calibrate").arg(folder).args(flags);
    command.output().expect("terrane runs")
}

#[test]
fn the_camera_is_found_as_well_as_its_sigmas_say() {
    let folder = tempfile::tempdir().expect("a folder for the test");
    photograph_board(folder.path(), 10);
    // One picture of the clutter beside the board.
    let away = terrane_geometry::Rigid3::new(
        terrane_geometry::so3::exp(&nalgebra::Vector3::zeros()),
        nalgebra::Vector3::new(0.0, 0.0, -1.0),
    );
    let options = RenderOptions { clutter: true, ..Default::default() };
    let nothing = photograph(&Pattern::checkerboard(9, 6, 0.03), &camera(), &away, &options);
    std::fs::write(folder.path().join("nothing.jpg"), nothing).expect("a photograph is written");
    let file = folder.path().join("camera.json");
    let output = calibrate(
        folder.path(),
        &["--target", "checkerboard:9x6:0.03", "--json", "-o", file.to_str().expect("a plain path")],
    );
    let text = String::from_utf8_lossy(&output.stdout);
    assert_eq!(output.status.code(), Some(0), "{text} {}", String::from_utf8_lossy(&output.stderr));
    let line = text.lines().find(|line| line.contains("calibration")).expect("a line of JSON");
    let told: Value = serde_json::from_str(line).expect("JSON");
    let report = &told["report"];
    let found: Vec<f64> = serde_json::from_value(report["camera"]["values"].clone()).expect("parameters");
    let sigmas: Vec<f64> = serde_json::from_value(report["params_sigma"].clone()).expect("sigmas");
    let off: Vec<f64> =
        camera().params().iter().zip(&found).zip(&sigmas).map(|((t, f), s)| (f - t) / s).collect();
    assert!(off.iter().all(|off| off.abs() < 6.0), "{off:?} sigmas off: {found:?}, {sigmas:?}");
    // Neither blind nor boastful: a focal length is known to a pixel or better, and not to a thousandth of one.
    assert!((1e-3..1.0).contains(&sigmas[0]), "{sigmas:?}");
    let text = line.to_owned();
    assert!(text.contains("nothing.jpg") && text.contains("no target"), "{text}");
    let written: Value =
        serde_json::from_slice(&std::fs::read(&file).expect("the camera's file")).expect("JSON");
    assert_eq!(written["camera"]["model"], "OPENCV");
    assert_eq!(written["camera"]["params"][0].as_f64(), Some(found[0]));
}

#[test]
fn photographs_that_give_no_camera_say_why() {
    let folder = tempfile::tempdir().expect("a folder for the test");
    photograph_board(folder.path(), 1);
    let output = calibrate(folder.path(), &["--target", "checkerboard:9x6"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains("two views or more"));
    let output = calibrate(folder.path(), &["--target", "checkerboard:8x5"]);
    assert_eq!(output.status.code(), Some(1));
    let output = calibrate(folder.path(), &["--target", "checkers:8x5"]);
    assert_eq!(output.status.code(), Some(2));
}
