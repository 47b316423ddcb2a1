//! Scenes that must be rebuilt whole, with errors that fit their noise from both sides.

use terrane_geometry::{Camera, CameraModel};
use terrane_scene::FocalSource;
use terrane_testkit::scene::{Layout, SceneOptions};

use super::map_whole;

/// Reprojection errors of two noisy coordinates are Rayleigh distributed, with mean `σ √(π/2)`; fitting takes a part.
fn check_reprojection(mean_px: f64, noise_px: f64) {
    let expected_px = noise_px * (std::f64::consts::PI / 2.0).sqrt();
    assert!(mean_px < 1.05 * expected_px, "{mean_px} px of {expected_px} px");
    assert!(mean_px > 0.6 * expected_px, "{mean_px} px of {expected_px} px: the noise is fitted");
}

#[test]
fn orbit() {
    let (result, comparison, report) = map_whole(&SceneOptions::default());
    // 0.5 px at 12 m and 1000 px of focal length are 6 mm a ray; a camera has several hundred.
    assert!(comparison.center_rmse_m < 0.02, "{comparison:?}");
    assert!(comparison.center_rmse_m > 0.0001, "{comparison:?}");
    assert!(comparison.rotation_max_rad < 0.002, "{comparison:?}");
    check_reprojection(report.submaps[0].mean_reprojection_error_px, 0.5);
    assert!(result.points.len() >= 1400, "{} points", result.points.len());
    assert!(result.mean_track_length() > 8.0, "{}", result.mean_track_length());
}

#[test]
fn orbit_without_noise_is_exact() {
    let (_, comparison, report) = map_whole(&SceneOptions { noise_px: 0.0, ..SceneOptions::default() });
    assert!(comparison.center_rmse_m < 1e-4, "{comparison:?}");
    assert!(report.submaps[0].mean_reprojection_error_px < 1e-3);
}

#[test]
fn nadir_block() {
    let layout = Layout::Nadir { height_m: 80.0, spacing_m: 15.0, row_spacing_m: 25.0, relief_m: 8.0 };
    let options = SceneOptions { layout, num_images: 30, num_points: 4000, ..SceneOptions::default() };
    let (_, comparison, report) = map_whole(&options);
    assert!(comparison.center_rmse_m < 0.5, "{comparison:?}");
    assert!(comparison.center_rmse_m > 0.001, "{comparison:?}");
    check_reprojection(report.submaps[0].mean_reprojection_error_px, 0.5);
    assert!(report.submaps[0].local_adjustments > 0, "{report:?}");
}

#[test]
fn street() {
    let layout = Layout::Street { spacing_m: 2.0, half_width_m: 8.0 };
    // Wide enough for cameras that look at one facade to see the other one far ahead.
    let camera = Camera::centered(CameraModel::SimpleRadial, 1200, 900, 600.0);
    let options =
        SceneOptions { layout, camera, num_images: 30, num_points: 6000, ..SceneOptions::default() };
    let (_, comparison, _) = map_whole(&options);
    assert!(comparison.center_rmse_m < 0.3, "{comparison:?}");
    assert!(comparison.center_rmse_m > 0.0005, "{comparison:?}");
}

#[test]
fn a_quarter_of_wrong_matches() {
    let options = SceneOptions { outlier_fraction: 0.25, ..SceneOptions::default() };
    let (_, comparison, report) = map_whole(&options);
    assert!(comparison.center_rmse_m < 0.03, "{comparison:?}");
    check_reprojection(report.submaps[0].mean_reprojection_error_px, 0.5);
}

#[test]
fn distortion_is_found() {
    let params = [1000.0, 600.0, 450.0, -0.08];
    let camera = Camera::new(CameraModel::SimpleRadial, 1200, 900, &params).expect("four parameters");
    let (result, comparison, _) = map_whole(&SceneOptions { camera, ..SceneOptions::default() });
    assert!(comparison.center_rmse_m < 0.03, "{comparison:?}");
    let found = result.cameras[0].1;
    assert!((found.distortion()[0] + 0.08).abs() < 0.01, "{found:?}");
    assert!((found.mean_focal_px() - 1000.0).abs() < 10.0, "{found:?}");
}

#[test]
fn a_focal_length_that_nobody_knows() {
    let options =
        SceneOptions { focal_source: FocalSource::Guess, told_focal_factor: 1.35, ..SceneOptions::default() };
    let (result, comparison, _) = map_whole(&options);
    assert!(comparison.center_rmse_m < 0.03, "{comparison:?}");
    assert!((result.cameras[0].1.mean_focal_px() - 1000.0).abs() < 10.0, "{:?}", result.cameras[0]);
}

#[test]
fn given_intrinsics_stay() {
    let options = SceneOptions { focal_source: FocalSource::Given, ..SceneOptions::default() };
    let (result, comparison, _) = map_whole(&options);
    assert_eq!(result.cameras[0].1, options.camera);
    assert!(comparison.center_rmse_m < 0.02, "{comparison:?}");
}
