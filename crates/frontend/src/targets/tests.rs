//! Rendered targets with known corners, at all poses; pictures without any.

use nalgebra::Vector3;
use terrane_geometry::{Camera, CameraModel, Rigid3, so3};
use terrane_testkit::targets::{Pattern, RenderOptions, random_pose, render};

use super::*;

fn camera() -> Camera {
    let params = [620.0, 625.0, 325.0, 238.0, -0.15, 0.04, 0.0005, -0.0005];
    Camera::new(CameraModel::OpenCv, 640, 480, &params).unwrap()
}

fn picture(pixels: Vec<u8>, camera: &Camera) -> GrayImage {
    GrayImage { width: camera.width_px as usize, height: camera.height_px as usize, data: pixels }
}

/// Root mean square distance from the truth.
fn error_px(view: &TargetView, camera: &Camera, pose: &Rigid3) -> f64 {
    let errors = view.xy_on_target_m.iter().zip(&view.xy_px).map(|(xy, px)| {
        let truth = camera.project(&pose.transform_point(&xy.push(0.0)));
        truth.map_or(f64::INFINITY, |truth| (truth - px).norm_squared())
    });
    (errors.sum::<f64>() / view.xy_px.len() as f64).sqrt()
}

/// How many of `count` views of a pattern are found whole, and the worst error.
fn rate(target: &str, pattern: &Pattern, options: &RenderOptions, count: u64) -> (usize, f64) {
    let (camera, target) = (camera(), target.parse::<Target>().unwrap());
    let (mut found, mut worst) = (0, 0.0f64);
    for index in 0..count {
        let pose = random_pose(pattern, &camera, 0.6, index);
        let image =
            picture(render(pattern, &camera, &pose, &RenderOptions { seed: index, ..*options }), &camera);
        if let Ok(view) = detect(&target, &image) {
            found += 1;
            worst = worst.max(error_px(&view, &camera, &pose));
        }
    }
    (found, worst)
}

fn board() -> Pattern {
    Pattern::checkerboard(9, 6, 0.03)
}

fn grid() -> Pattern {
    Pattern::aprilgrid(4, 3, 0.06, 0.3, &tag36h11::CODES)
}

/// A condition, how it is rendered, the fewest views to be found, and the worst error allowed.
type Case = (&'static str, RenderOptions, usize, f64);

fn found_and_placed(target: &str, pattern: &Pattern, count: u64, cases: &[Case]) {
    for (name, options, least, bound_px) in cases {
        let (found, worst_px) = rate(target, pattern, options, count);
        println!("{target}, {name}: {found} of {count}, worst {worst_px:.3} px");
        assert!(found >= *least && worst_px < *bound_px, "{name}: {found} of {count}, {worst_px} px");
    }
}

#[test]
fn checkerboards_are_found_and_placed() {
    let clean = RenderOptions::default();
    let cases = [
        ("clean", clean, 10, 0.06),
        ("noise", RenderOptions { noise_greys: 6.0, ..clean }, 10, 0.12),
        ("blur", RenderOptions { blur_px: 1.5, ..clean }, 10, 0.1),
        ("vignette", RenderOptions { vignette: 0.5, noise_greys: 3.0, ..clean }, 10, 0.12),
        ("clutter", RenderOptions { clutter: true, ..clean }, 10, 0.06),
    ];
    found_and_placed("checkerboard:9x6:0.03", &board(), 10, &cases);
}

#[test]
fn april_grids_are_found_and_placed() {
    let clean = RenderOptions::default();
    let cases = [
        ("clean", clean, 5, 0.1),
        ("noise", RenderOptions { noise_greys: 4.0, ..clean }, 5, 0.2),
        ("clutter", RenderOptions { clutter: true, ..clean }, 5, 0.1),
    ];
    found_and_placed("aprilgrid:4x3:0.06:0.3", &grid(), 5, &cases);
}

#[test]
fn nothing_is_seen_where_nothing_is() {
    let camera = camera();
    for seed in 0..6 {
        let away = Rigid3::new(so3::exp(&Vector3::zeros()), Vector3::new(0.0, 0.0, -1.0));
        let options = RenderOptions { clutter: true, noise_greys: 10.0, seed, ..Default::default() };
        let image = picture(render(&board(), &camera, &away, &options), &camera);
        for target in ["checkerboard:9x6", "checkerboard:7x4", "aprilgrid:6x6"] {
            assert!(detect(&target.parse().unwrap(), &image).is_err(), "{target} {seed}");
        }
    }
    for (width, height, length) in [(0, 0, 0), (1, 1, 1), (300, 2, 600), (40, 40, 3)] {
        let image = GrayImage { width, height, data: vec![7; length] };
        for target in ["checkerboard:9x6", "aprilgrid:6x6"] {
            assert_eq!(detect(&target.parse().unwrap(), &image), Err(NotFound::Nothing));
        }
    }
}

#[test]
fn another_board_is_named() {
    let camera = camera();
    let pose = random_pose(&board(), &camera, 0.2, 1);
    let image = picture(render(&board(), &camera, &pose, &RenderOptions::default()), &camera);
    let refused = detect(&"checkerboard:9x7".parse().unwrap(), &image).unwrap_err();
    assert!(matches!(refused, NotFound::OtherBoard { .. }), "{refused}");
}

#[test]
fn targets_are_read_and_written() {
    for text in ["checkerboard:9x6:0.025", "aprilgrid:6x6:0.088:0.3"] {
        assert_eq!(text.parse::<Target>().unwrap().to_string(), text);
    }
    for text in
        ["", "checkerboard", "checkerboard:9", "checkerboard:9x6:-1", "checkerboard:2x6", "aprilgrid:6x6:1"]
    {
        assert!(text.parse::<Target>().unwrap_err().is_invalid_option(), "{text}");
    }
    assert!("aprilgrid:99x99".parse::<Target>().is_err());
}
