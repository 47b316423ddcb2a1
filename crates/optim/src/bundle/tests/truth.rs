//! The truth is found, as well as the noise allows and no better.

use super::*;

/// The expected cost of least squares: (residuals − unknowns) σ² / 2, with seven unknowns free.
fn expected_cost(report: &BundleReport, noise_px: f64) -> f64 {
    let freedom =
        2.0 * report.observations as f64 - 3.0 * report.points as f64 - report.reduced_unknowns as f64 + 7.0;
    0.5 * freedom * noise_px * noise_px
}

#[test]
fn noisy_scene_reaches_the_cost_that_the_noise_predicts() {
    for (model, num_intrinsics) in [
        (CameraModel::SimplePinhole, 1),
        (CameraModel::SimpleRadial, 1),
        (CameraModel::Radial, 0),
        (CameraModel::OpenCv, 2),
    ] {
        let scene = Scene::new(SceneOptions { model, num_intrinsics, ..Default::default() });
        let (mut problem, shard) = scene.disturbed(3);
        let mut shards = InMemoryShards(vec![shard]);
        let report = solve(&mut problem, &mut shards, &BundleOptions::default()).unwrap();
        assert!(report.termination.converged(), "{model:?}: {report:?}");
        let expected = expected_cost(&report, 0.5);
        assert!(
            (report.final_cost / expected - 1.0).abs() < 0.1,
            "{model:?}: {} for {expected}",
            report.final_cost
        );
        let rmse = center_rmse(&problem.poses, &scene.truth.poses);
        assert!((0.001..0.06).contains(&rmse), "{model:?}: {rmse}");
    }
}

#[test]
fn perfect_scene_is_recovered_to_the_precision_of_pixels() {
    let scene = Scene::new(SceneOptions { noise_px: 0.0, ..Default::default() });
    let (mut problem, shard) = scene.disturbed(3);
    let mut shards = InMemoryShards(vec![shard]);
    let options = BundleOptions { cost_tolerance: 1e-12, ..Default::default() };
    let report = solve(&mut problem, &mut shards, &options).unwrap();
    // Pixels are stored as f32: about 3e-5 px each.
    assert!(report.final_cost < 1e-6, "{report:?}");
    assert!(center_rmse(&problem.poses, &scene.truth.poses) < 1e-5);
    assert!((problem.intrinsics[0].mean_focal_px() - 900.0).abs() < 1e-2);
}

#[test]
fn outliers_under_a_robust_loss_hardly_move_the_result() {
    let scene = Scene::new(SceneOptions { points: 600, ..Default::default() });
    let solve_with = |outliers: bool, loss: Loss| {
        let (mut problem, mut shard) = scene.disturbed(3);
        let mut noise = Noise::new(11);
        for observation in shard.observations.iter_mut().step_by(10) {
            let xy = [noise.uniform(0.0..1000.0) as f32, noise.uniform(0.0..800.0) as f32];
            if outliers {
                observation.xy_px = xy;
            }
        }
        let mut shards = InMemoryShards(vec![shard]);
        let options = BundleOptions { loss, max_iterations: 100, ..Default::default() };
        solve(&mut problem, &mut shards, &options).unwrap();
        center_rmse(&problem.poses, &scene.truth.poses)
    };
    let clean = solve_with(false, Loss::Squared);
    let robust = solve_with(true, Loss::Cauchy);
    let fooled = solve_with(true, Loss::Squared);
    assert!(robust < 1.5 * clean, "{robust} against {clean}");
    assert!(fooled > 3.0 * clean, "{fooled} against {clean}");
}

#[test]
fn position_priors_place_the_scene() {
    let scene = Scene::new(SceneOptions::default());
    let (mut problem, shard) = scene.disturbed(5);
    let mut noise = Noise::new(2);
    for (pose, truth) in scene.truth.poses.iter().enumerate() {
        problem.priors.positions.push(PositionPrior {
            pose: pose as u32,
            center_in_world: truth.center() + 0.02 * noise.vector(),
            sigma_m: Vector3::repeat(0.02),
            bias: None,
        });
    }
    // One receiver was lost: the robust prior forgets it.
    problem.priors.positions[4].center_in_world.x += 30.0;
    let mut shards = InMemoryShards(vec![shard]);
    let options = BundleOptions { prior_loss: Loss::Cauchy, ..Default::default() };
    let report = solve(&mut problem, &mut shards, &options).unwrap();
    assert!(report.termination.converged());
    let squared: f64 = problem
        .poses
        .iter()
        .zip(&scene.truth.poses)
        .map(|(found, truth)| (found.center() - truth.center()).norm_squared())
        .sum();
    let rmse = (squared / problem.poses.len() as f64).sqrt();
    assert!((0.002..0.05).contains(&rmse), "{rmse}");
}

#[test]
fn focal_prior_pulls_the_focal_length() {
    let scene = Scene::new(SceneOptions::default());
    let (mut problem, shard) = scene.disturbed(5);
    let model = problem.intrinsics[0].model;
    problem.priors.parameters = ParameterPrior::focal(0, model, 950.0, 1e-3).collect();
    let mut shards = InMemoryShards(vec![shard]);
    solve(&mut problem, &mut shards, &BundleOptions::default()).unwrap();
    assert!((problem.intrinsics[0].mean_focal_px() - 950.0).abs() < 0.1);
}

/// A ring of cameras that look outwards and inwards at a shell of points, so that wide views are used to their borders.
fn ring(camera: Camera, refine: RefineIntrinsics) -> Scene {
    let mut noise = Noise::new(17);
    let poses: Vec<Rigid3> = (0..10)
        .map(|i| {
            let angle = 0.6283 * f64::from(i);
            let center = Vector3::new(3.0 * angle.cos(), 3.0 * angle.sin(), 0.3 * noise.next());
            let rotation = UnitQuaternion::from_scaled_axis(0.2 * noise.vector() + Vector3::z() * angle);
            Rigid3::from_rotation_and_center(rotation, &center)
        })
        .collect();
    let truth = BundleProblem::new(poses, vec![camera], vec![0; 10], refine);
    let mut shard = BundleShard::default();
    while shard.points.len() < 400 {
        let x = noise.vector().normalize() * noise.uniform(5.0..9.0);
        let seen = observe(&truth, shard.points.len() as u32, &x, 0.5, &mut noise);
        if seen.len() >= 3 {
            shard.observations.extend(seen);
            shard.points.push(x);
        }
    }
    Scene { truth, shard }
}

#[test]
fn fisheyes_and_panoramas_reach_the_cost_that_the_noise_predicts() {
    let fisheye = [300.0, 301.0, 500.0, 400.0, 0.03, -0.01, 0.002, -0.0004];
    let fisheye = Camera::new(CameraModel::OpenCvFisheye, 1000, 800, &fisheye).unwrap();
    let panorama = Camera::new(CameraModel::Equirectangular, 2000, 1000, &[2000.0, 1000.0]).unwrap();
    for (camera, refine) in
        [(fisheye, RefineIntrinsics::FOCAL_AND_DISTORTION), (panorama, RefineIntrinsics::ALL)]
    {
        let scene = ring(camera, refine);
        for solver in [BundleSolver::Explicit, BundleSolver::Implicit] {
            let (mut problem, shard) = (scene.truth.clone(), scene.shard.clone());
            let mut noise = Noise::new(3);
            for pose in &mut problem.poses {
                let (turn, shift) = (noise.vector() * 0.01, noise.vector() * 0.05);
                *pose = pose
                    .retract_left(&nalgebra::Vector6::new(turn.x, turn.y, turn.z, shift.x, shift.y, shift.z));
            }
            let mut shards = InMemoryShards(vec![shard]);
            let options = BundleOptions { solver, ..Default::default() };
            let report = solve(&mut problem, &mut shards, &options).unwrap();
            assert!(report.termination.converged(), "{:?}: {report:?}", camera.model);
            let ratio = report.final_cost / expected_cost(&report, 0.5);
            assert!((0.9..1.1).contains(&ratio), "{:?} {solver:?}: {ratio}", camera.model);
            let rmse = center_rmse(&problem.poses, &scene.truth.poses);
            assert!((1e-4..0.02).contains(&rmse), "{:?}: {rmse}", camera.model);
        }
    }
    // Pixels near both borders are of points behind the first camera: the seam is crossed.
    let scene = ring(panorama, RefineIntrinsics::ALL);
    let near_seam = scene.shard.observations.iter().filter(|o| o.xy_px[0] < 20.0 || o.xy_px[0] > 1980.0);
    assert!(near_seam.count() > 30);
}
