//! Measured positions with biases, gravity, rotations, landmarks and lengths: what they hold, and that both solvers agree.

use super::*;

/// A scene of which nothing but priors and marks says where it is in the world.
struct Surveyed {
    scene: Scene,
    problem: BundleProblem,
    shard: BundleShard,
}

/// Ground points that are marked in every photograph that shows them.
fn mark_landmarks(problem: &mut BundleProblem, truth: &BundleProblem, sigma_px: f64, noise: &mut Noise) {
    for at in 0..6 {
        let x = Vector3::new(f64::from(at % 3) * 4.0, f64::from(at / 3) * 5.0, 0.3 * f64::from(at % 2));
        let landmark = problem.landmarks.len() as u32;
        for seen in observe(truth, 0, &x, 0.0, noise) {
            let xy_px = seen.xy_px.map(|v| f64::from(v) + sigma_px * noise.next());
            problem.marks.push(Mark { pose: seen.pose, landmark, xy_px, sigma_px });
        }
        let start = x + 0.1 * noise.vector();
        problem.landmarks.push(Landmark { x_in_world: start, fixed: false });
    }
}

fn surveyed(num_intrinsics: usize) -> Surveyed {
    let options =
        SceneOptions { columns: 6, rows: 4, points: 700, num_intrinsics, ..SceneOptions::default() };
    let scene = Scene::new(options);
    let (mut problem, shard) = scene.disturbed(5);
    let mut noise = Noise::new(8);
    mark_landmarks(&mut problem, &scene.truth, 0.5, &mut noise);
    Surveyed { scene, problem, shard }
}

/// The place of a landmark of [`mark_landmarks`].
fn true_landmark(at: usize) -> Vector3<f64> {
    Vector3::new((at % 3) as f64 * 4.0, (at / 3) as f64 * 5.0, 0.3 * (at % 2) as f64)
}

fn solved(
    problem: &BundleProblem,
    shard: &BundleShard,
    options: &BundleOptions,
) -> (BundleReport, BundleProblem) {
    let mut problem = problem.clone();
    let report = solve(&mut problem, &mut InMemoryShards(vec![shard.clone()]), options).unwrap();
    (report, problem)
}

/// Root mean square of the distance of centres from truth, in the world.
fn rmse_in_world(found: &BundleProblem, truth: &BundleProblem) -> f64 {
    let squares = found.poses.iter().zip(&truth.poses).map(|(a, b)| (a.center() - b.center()).norm_squared());
    (squares.sum::<f64>() / found.poses.len() as f64).sqrt()
}

#[test]
fn control_points_place_the_scene_and_check_points_follow() {
    let Surveyed { scene, mut problem, shard } = surveyed(1);
    let mut noise = Noise::new(4);
    for landmark in 0..4 {
        problem.priors.landmarks.push(LandmarkPrior {
            landmark: landmark as u32,
            x_in_world: true_landmark(landmark) + 0.005 * noise.vector(),
            sigma_m: Vector3::repeat(0.005),
        });
    }
    let (report, found) = solved(&problem, &shard, &BundleOptions::default());
    assert!(report.termination.converged(), "{report:?}");
    let error = rmse_in_world(&found, &scene.truth);
    assert!((5e-4..0.05).contains(&error), "{error}");
    for check in 4..6 {
        let error = (found.landmarks[check].x_in_world - true_landmark(check)).norm();
        assert!((1e-5..0.03).contains(&error), "check point {check}: {error}");
    }
}

#[test]
fn the_bias_of_a_flight_is_found() {
    let Surveyed { scene, mut problem, shard } = surveyed(1);
    let mut noise = Noise::new(6);
    let bias = Vector3::new(0.3, -0.2, 0.5);
    let free = PositionBias { bias_m: Vector3::zeros(), sigma_m: Vector3::repeat(1.0) };
    problem.position_biases = vec![free];
    for (pose, truth) in scene.truth.poses.iter().enumerate() {
        let second = pose >= 12;
        let shift = if second { bias } else { Vector3::zeros() };
        problem.priors.positions.push(PositionPrior {
            pose: pose as u32,
            center_in_world: truth.center() + shift + 0.02 * noise.vector(),
            sigma_m: Vector3::repeat(0.02),
            bias: second.then_some(0),
        });
    }
    let (report, found) = solved(&problem, &shard, &BundleOptions::default());
    assert!(report.termination.converged(), "{report:?}");
    let error = (found.position_biases[0].bias_m - bias).norm();
    assert!((1e-4..0.03).contains(&error), "{error}");
    let centers = rmse_in_world(&found, &scene.truth);
    assert!((1e-3..0.03).contains(&centers), "{centers}");
}

#[test]
fn a_scale_bar_and_gravity_fix_scale_and_upright() {
    let Surveyed { scene, mut problem, shard } = surveyed(1);
    // Two fifths too large and turned by a tenth: nothing in the images says so.
    let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.1, -0.05, 0.0));
    let wrong = |x: &Vector3<f64>| 1.4 * (turn * x);
    let mut shard = shard;
    shard.points.iter_mut().for_each(|x| *x = wrong(x));
    problem.landmarks.iter_mut().for_each(|landmark| landmark.x_in_world = wrong(&landmark.x_in_world));
    for pose in &mut problem.poses {
        *pose = Rigid3::from_rotation_and_center(pose.rotation * turn.inverse(), &wrong(&pose.center()));
    }
    let length_m = (true_landmark(0) - true_landmark(2)).norm();
    let bar = DistancePrior { from: Anchor::Landmark(0), to: Anchor::Landmark(2), length_m, sigma_m: 0.002 };
    problem.priors.distances = vec![bar];
    for (pose, truth) in scene.truth.poses.iter().enumerate() {
        problem.priors.gravities.push(GravityPrior {
            pose: pose as u32,
            down_in_cam: truth.rotation * -Vector3::z(),
            down_in_world: -Vector3::z(),
            sigma_rad: 1e-3,
        });
    }
    let options = BundleOptions { cost_tolerance: 1e-10, max_iterations: 200, ..Default::default() };
    let (report, found) = solved(&problem, &shard, &options);
    assert!(report.termination.converged(), "{report:?}");
    let length = (found.landmarks[0].x_in_world - found.landmarks[2].x_in_world).norm();
    assert!((length - length_m).abs() < 0.004, "{length} for {length_m}");
    let span = |problem: &BundleProblem| (problem.poses[0].center() - problem.poses[23].center()).norm();
    assert!((span(&found) / span(&scene.truth) - 1.0).abs() < 5e-3);
    for (found, truth) in found.poses.iter().zip(&scene.truth.poses) {
        let tilt = (found.rotation * Vector3::z()).angle(&(truth.rotation * Vector3::z()));
        assert!(tilt < 5e-3, "{tilt}");
    }
}

#[test]
fn explicit_and_implicit_agree_with_every_kind_of_prior() {
    for num_intrinsics in [0, 1, 3] {
        let Surveyed { scene, mut problem, shard } = surveyed(num_intrinsics);
        let truth = &scene.truth;
        problem.position_biases =
            vec![PositionBias { bias_m: Vector3::zeros(), sigma_m: Vector3::repeat(0.2) }];
        for pose in (0..24u32).step_by(3) {
            problem.priors.positions.push(PositionPrior {
                pose,
                center_in_world: truth.poses[pose as usize].center() + Vector3::new(0.1, 0.0, 0.0),
                sigma_m: Vector3::repeat(0.05),
                bias: (pose % 2 == 0).then_some(0),
            });
            let rotation = truth.poses[pose as usize].rotation;
            let sigma_rad = Vector3::repeat(0.01);
            problem.priors.rotations.push(RotationPrior { pose, cam_from_world: rotation, sigma_rad });
        }
        problem.priors.landmarks.push(LandmarkPrior {
            landmark: 1,
            x_in_world: true_landmark(1),
            sigma_m: Vector3::repeat(0.01),
        });
        let between = (truth.poses[0].center() - truth.poses[20].center()).norm();
        problem.priors.distances = vec![
            DistancePrior { from: Anchor::Pose(0), to: Anchor::Pose(20), length_m: between, sigma_m: 0.01 },
            DistancePrior { from: Anchor::Landmark(2), to: Anchor::Pose(7), length_m: 9.0, sigma_m: 0.5 },
        ];
        let with = |solver| BundleOptions {
            solver,
            loss: Loss::Huber,
            prior_loss: Loss::Huber,
            cluster_poses: 7,
            cost_tolerance: 1e-13,
            linear_tolerance: 1e-3,
            max_iterations: 200,
            ..Default::default()
        };
        let (explicit, found) = solved(&problem, &shard, &with(BundleSolver::Explicit));
        let (implicit, other) = solved(&problem, &shard, &with(BundleSolver::Implicit));
        assert!((implicit.initial_cost / explicit.initial_cost - 1.0).abs() < 1e-12);
        let difference = (implicit.final_cost / explicit.final_cost - 1.0).abs();
        assert!(difference < 1e-8, "{num_intrinsics}: {difference:e} {explicit:?} {implicit:?}");
        let apart = found.landmarks.iter().zip(&other.landmarks);
        apart.for_each(|(a, b)| assert!((a.x_in_world - b.x_in_world).norm() < 1e-4));
        assert!((found.position_biases[0].bias_m - other.position_biases[0].bias_m).norm() < 1e-4);
    }
}

#[test]
fn a_mark_that_starts_behind_its_camera_takes_no_part() {
    let Surveyed { mut problem, shard, .. } = surveyed(1);
    let fine = solved(&problem, &shard, &BundleOptions::default()).0;
    problem.landmarks.push(Landmark { x_in_world: Vector3::new(0.0, 0.0, 50.0), fixed: true });
    problem.marks.push(Mark { pose: 0, landmark: 6, xy_px: [500.0, 400.0], sigma_px: 1.0 });
    let report = solved(&problem, &shard, &BundleOptions::default()).0;
    assert_eq!(report.final_cost, fine.final_cost);
}
