//! Truth among outliers, noise on both sides, gradients, wrong focal lengths, degenerate input.

use super::*;
use crate::CameraModel;
use crate::small_lm::tests::assert_gradient;
use crate::test_support::{Random, Resection, radial_camera, resection};

/// A scene of 200 points, every `period`-th pixel replaced by a random one (0: none).
fn scene(random: &mut Random, noise_px: f64, period: usize) -> Resection {
    let mut scene = resection(random, &radial_camera(), 200, noise_px);
    for i in (0..200).filter(|i| period > 0 && i % period == 0) {
        scene.xy_px[i] = Vector2::new(random.uniform(0.0, 1600.0), random.uniform(0.0, 1200.0));
    }
    scene
}

fn center_error(found: &Rigid3, truth: &Rigid3) -> f64 {
    (found.center() - truth.center()).norm() + found.rotation.angle_to(&truth.rotation)
}

#[test]
fn truth_is_found_among_outliers() {
    let mut random = Random::new("resection");
    for case in 0..100 {
        let scene = scene(&mut random, 0.0, 2);
        let found = estimate_absolute_pose(
            &scene.x_in_world,
            &scene.xy_px,
            &radial_camera(),
            4.0,
            &RansacOptions::default(),
            Seed(case),
        )
        .unwrap();
        assert!(center_error(&found.model, &scene.cam_from_world) < 1e-7);
        assert!((100..105).contains(&found.inliers.len()));
    }
}

#[test]
fn noise_shows_and_stays_small() {
    let mut random = Random::new("resection noise");
    let mut sum = 0.0;
    for case in 0..30 {
        let scene = scene(&mut random, 1.0, 3);
        let options = RansacOptions::default();
        let found = estimate_absolute_pose(
            &scene.x_in_world,
            &scene.xy_px,
            &radial_camera(),
            4.0,
            &options,
            Seed(case),
        )
        .unwrap();
        assert!(found.inliers.len() >= 125, "{}", found.inliers.len());
        sum += center_error(&found.model, &scene.cam_from_world);
    }
    assert!(sum / 30.0 > 1e-4 && sum / 30.0 < 5e-3, "{}", sum / 30.0);
}

#[test]
fn gradients_match_differences() {
    let mut random = Random::new("resection gradient");
    let scene = scene(&mut random, 2.0, 0);
    let camera = radial_camera();
    let indices: Vec<u32> = (0..50).collect();
    let problem = PoseProblem {
        x_in_world: &scene.x_in_world,
        xy_px: &scene.xy_px,
        camera: &camera,
        indices: &indices,
        loss_scale_px: 3.0,
    };
    let near = scene.cam_from_world.retract_left(&Vector6::new(1e-3, -2e-3, 1e-3, 0.01, 0.0, -0.01));
    assert_gradient(&problem, &near, 1e-5);
    let joint = FocalProblem {
        x_in_world: &scene.x_in_world,
        xy_px: &scene.xy_px,
        indices: &indices,
        loss_scale_px: 3.0,
    };
    assert_gradient(&joint, &(near, with_focal_factor(&camera, 1.01)), 1e-5);
    let refined = refine_absolute_pose(&scene.x_in_world, &scene.xy_px, &camera, (&near, &indices), 3.0);
    assert!(problem.cost(&refined) < problem.cost(&near));
}

#[test]
fn a_wrong_focal_length_is_found() {
    let mut random = Random::new("focal");
    let truth = Camera::centered(CameraModel::SimplePinhole, 1600, 1200, 1300.0);
    for (case, factor) in [0.62, 0.8, 1.0, 1.27, 1.7].into_iter().enumerate() {
        let mut scene = resection(&mut random, &truth, 200, 0.5);
        for i in (0..200).step_by(4) {
            scene.xy_px[i] = Vector2::new(random.uniform(0.0, 1600.0), random.uniform(0.0, 1200.0));
        }
        let guess = with_focal_factor(&truth, factor);
        let found = estimate_absolute_pose_and_focal(
            &scene.x_in_world,
            &scene.xy_px,
            &guess,
            4.0,
            &RansacOptions::default(),
            Seed(case as u64),
        )
        .unwrap();
        let (pose, camera) = found.model;
        assert!((camera.mean_focal_px() - 1300.0).abs() < 13.0, "{factor} {camera:?}");
        assert!(center_error(&pose, &scene.cam_from_world) < 0.05);
        assert!(found.inliers.len() > 140);
    }
}

#[test]
fn degenerate_input_gives_none() {
    let camera = radial_camera();
    let options = RansacOptions { max_iterations: 50, ..Default::default() };
    let run = |x: &[Vector3<f64>], p: &[Vector2<f64>]| {
        estimate_absolute_pose(x, p, &camera, 4.0, &options, Seed(1))
    };
    let pixels: Vec<_> =
        (0..10).map(|i| Vector2::new(100.0 * f64::from(i), 50.0 + f64::from(i * i))).collect();
    let line: Vec<_> = (0..10).map(|i| Vector3::new(1.0, 2.0, 3.0) * f64::from(i)).collect();
    assert!(run(&line, &pixels).is_none());
    assert!(run(&line[..2], &pixels[..2]).is_none());
    assert!(run(&line, &pixels[..9]).is_none());
    assert!(run(&[Vector3::x(); 10], &pixels).is_none());
    assert!(run(&[Vector3::repeat(f64::NAN); 10], &pixels).is_none());
    let solid: Vec<_> =
        (0..10).map(|i| Vector3::new(f64::from(i % 3), f64::from(i % 4), f64::from(i))).collect();
    assert!(run(&solid, &[Vector2::repeat(f64::NAN); 10]).is_none());
    assert!(run(&solid, &[Vector2::new(3.0, 4.0); 10]).is_none());
    assert!(estimate_absolute_pose_and_focal(&line, &pixels, &camera, 4.0, &options, Seed(1)).is_none());
}
