//! Truth with and without distortion, noise against the covariance, degenerate motion by name.

use nalgebra::Vector3;

use super::*;
use crate::so3;
use crate::test_support::{Random, radial_camera};

struct Scene {
    camera: Camera,
    poses: Vec<Rigid3>,
    target: Vec<Vector2<f64>>,
    pixels: Vec<Vec<Vector2<f64>>>,
}

/// A grid of 9 × 7 points at 0.1 apart, seen from about 1.2 away, tilted by up to `tilt_rad` each way.
fn scene(random: &mut Random, camera: Camera, count: usize, tilt_rad: f64, noise_px: f64) -> Scene {
    let target: Vec<Vector2<f64>> =
        (0..63).map(|i| Vector2::new(f64::from(i % 9) - 4.0, f64::from(i / 9) - 3.0) * 0.1).collect();
    let mut scene = Scene { camera, poses: vec![], target, pixels: vec![] };
    for _ in 0..count {
        let tilt =
            Vector3::new(random.uniform(-tilt_rad, tilt_rad), random.uniform(-tilt_rad, tilt_rad), 0.0);
        let spin = Vector3::z() * random.uniform(-3.0, 3.0);
        let shift =
            Vector3::new(random.uniform(-0.2, 0.2), random.uniform(-0.2, 0.2), random.uniform(1.1, 1.6));
        let pose = Rigid3::new(so3::exp(&tilt) * so3::exp(&spin), shift);
        let seen =
            scene.target.iter().map(|xy| camera.project(&pose.transform_point(&xy.push(0.0))).unwrap());
        let pixels = seen.map(|pixel| pixel + random.gaussian2(noise_px)).collect();
        scene.pixels.push(pixels);
        scene.poses.push(pose);
    }
    scene
}

impl Scene {
    fn calibrated(&self) -> Result<Calibration, CalibrationError> {
        let views: Vec<PlanarView<'_>> = self
            .pixels
            .iter()
            .map(|pixels| PlanarView { xy_on_target: &self.target, xy_px: pixels })
            .collect();
        calibrate(&views, self.camera.model, (self.camera.width_px, self.camera.height_px))
    }
}

fn opencv_camera() -> Camera {
    let params = [1290.0, 1310.0, 820.0, 585.0, -0.1, 0.03, 0.001, -0.0005];
    Camera::new(CameraModel::OpenCv, 1600, 1200, &params).unwrap()
}

#[test]
fn the_truth_is_found() {
    let mut random = Random::new("calibrate");
    let pinhole = Camera::new(CameraModel::Pinhole, 1600, 1200, &[1400.0, 1200.0, 900.0, 500.0]).unwrap();
    for camera in [pinhole, radial_camera(), opencv_camera()] {
        let mut good = 0;
        for case in 0..60 {
            let scene = scene(&mut random, camera, 4 + case % 5, 0.6, 0.0);
            let Ok(found) = scene.calibrated() else { continue };
            let off = found.camera.params().iter().zip(camera.params());
            let off = off.map(|(a, b)| (a - b).abs() / (1.0 + b.abs())).fold(0.0, f64::max);
            let poses = found.cam_from_target.iter().zip(&scene.poses);
            let poses_off = poses.map(|(a, b)| a.local_left(b).norm()).fold(0.0, f64::max);
            good += usize::from(off < 1e-5 && poses_off < 1e-5 && found.rms_px < 1e-4);
        }
        assert!(good >= 58, "{:?} {good}", camera.model);
    }
}

#[test]
fn noise_shows_in_the_error_and_the_covariance_predicts_it() {
    let mut random = Random::new("calibrate noise");
    let camera = radial_camera();
    let (mut squared, mut rms) = ([0.0; 5], 0.0);
    let count = 150;
    for _ in 0..count {
        let found = scene(&mut random, camera, 6, 0.6, 0.3).calibrated().unwrap();
        for k in 0..5 {
            let off = found.camera.params()[k] - camera.params()[k];
            squared[k] += off * off / found.params_covariance[(k, k)] / f64::from(count);
        }
        rms += found.rms_px / f64::from(count);
    }
    // Two coordinates of 0.3 each, less the share of the unknowns.
    assert!((rms - 0.3 * 2.0_f64.sqrt()).abs() < 0.02, "{rms}");
    for ratio in squared {
        assert!(ratio > 0.6 && ratio < 1.6, "{squared:?}");
    }
}

#[test]
fn pose_covariances_predict_the_scatter() {
    let mut random = Random::new("calibrate pose");
    let clean = scene(&mut random, radial_camera(), 5, 0.6, 0.0);
    let mut total = 0.0;
    let count = 100;
    for _ in 0..count {
        let mut noisy = Scene {
            camera: clean.camera,
            poses: vec![],
            target: clean.target.clone(),
            pixels: clean.pixels.clone(),
        };
        noisy.pixels.iter_mut().flatten().for_each(|pixel| *pixel += random.gaussian2(0.3));
        let found = noisy.calibrated().unwrap();
        let off = found.cam_from_target[2].local_left(&clean.poses[2]);
        total += off.dot(&(found.pose_covariances[2].try_inverse().unwrap() * off)) / f64::from(count);
    }
    // The mean of a chi squared variable of six degrees.
    assert!(total > 4.5 && total < 7.8, "{total}");
}

#[test]
fn what_is_wrong_is_named() {
    let mut random = Random::new("calibrate degenerate");
    let good = scene(&mut random, radial_camera(), 5, 0.6, 0.0);
    assert!(good.calibrated().is_ok());
    for camera in [radial_camera(), Camera::centered(CameraModel::Pinhole, 1600, 1200, 1300.0)] {
        for case in 0..20 {
            let parallel = scene(&mut random, camera, 5, 0.0, if case % 2 == 0 { 0.0 } else { 0.1 });
            let refused = [CalibrationError::ParallelViews, CalibrationError::Undetermined];
            let found = parallel.calibrated();
            assert!(found.as_ref().is_err_and(|error| refused.contains(error)), "{case} {found:?}");
        }
    }
    let view = |k: usize| PlanarView { xy_on_target: &good.target, xy_px: &good.pixels[k] };
    let run = |views: &[PlanarView<'_>]| calibrate(views, CameraModel::Radial, (1600, 1200));
    assert_eq!(run(&[]), Err(CalibrationError::TooFewViews));
    assert_eq!(run(&[view(0)]), Err(CalibrationError::TooFewViews));
    assert_eq!(run(&[view(0), view(0), view(0)]), Err(CalibrationError::ParallelViews));
    let short = PlanarView { xy_on_target: &good.target[..62], ..view(1) };
    assert_eq!(run(&[view(0), short]), Err(CalibrationError::LengthsDiffer { view: 1 }));
    let line = vec![Vector2::zeros(); 63];
    let one_point = PlanarView { xy_on_target: &line, ..view(1) };
    assert_eq!(run(&[view(0), one_point]), Err(CalibrationError::NoHomography { view: 1 }));
    let mut bad = good.pixels[1].clone();
    bad[7].x = f64::NAN;
    let not_finite = PlanarView { xy_px: &bad, ..view(1) };
    assert_eq!(run(&[view(0), not_finite]), Err(CalibrationError::NoHomography { view: 1 }));
    // Four points a view: 8 equations against 6 unknowns of the pose, 2 × 2 left for 5 parameters.
    let few = |k: usize| {
        let at = [0, 8, 54, 62];
        (at.map(|i| good.target[i]), at.map(|i| good.pixels[k][i]))
    };
    let (a, b) = (few(0), few(1));
    let views = [&a, &b].map(|(x, px)| PlanarView { xy_on_target: x, xy_px: px });
    assert_eq!(run(&views), Err(CalibrationError::Undetermined));
}
