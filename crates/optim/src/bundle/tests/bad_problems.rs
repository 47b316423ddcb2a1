//! Problems that are wrong, or that hold nothing to solve.

use super::*;

fn small() -> (BundleProblem, BundleShard) {
    Scene::new(SceneOptions { points: 60, ..Default::default() }).disturbed(3)
}

/// Solves after a change; the error's message.
fn refused(change: impl FnOnce(&mut BundleProblem, &mut BundleShard, &mut BundleOptions)) -> String {
    let (mut problem, mut shard) = small();
    let mut options = BundleOptions::default();
    change(&mut problem, &mut shard, &mut options);
    let before = problem.clone();
    let error = solve(&mut problem, &mut InMemoryShards(vec![shard]), &options).unwrap_err();
    assert!(error.is_invalid_input());
    // Nothing moved; NaN never equals itself.
    assert_eq!(format!("{before:?}"), format!("{problem:?}"));
    error.to_string()
}

#[test]
fn wrong_problems_are_refused_with_the_object_named() {
    let nan = f64::NAN;
    let prior = PositionPrior {
        pose: 3,
        center_in_world: Vector3::zeros(),
        sigma_m: Vector3::new(1.0, 0.0, 1.0),
        bias: None,
    };
    let good = PositionPrior { sigma_m: Vector3::repeat(1.0), ..prior };
    let mark = Mark { pose: 1, landmark: 0, xy_px: [1.0, 1.0], sigma_px: 1.0 };
    let cases = [
        (refused(|p, _, _| p.poses[3].translation.x = nan), "pose 3"),
        (refused(|p, _, _| p.fixed_poses.truncate(1)), "fixed_poses"),
        (refused(|p, _, _| p.refine.clear()), "refine"),
        (refused(|p, _, _| p.intrinsics_of_pose[2] = 9), "pose 2 names intrinsics 9"),
        (refused(|p, _, _| p.intrinsics[0].params_mut()[0] = -1.0), "intrinsics 0"),
        (refused(|p, _, _| p.intrinsics[0].params_mut()[3] = nan), "intrinsics 0"),
        (refused(|p, _, _| p.priors.positions.push(prior)), "position prior 0"),
        (refused(|p, _, _| p.priors.positions.push(PositionPrior { pose: 99, ..prior })), "position prior 0"),
        (
            refused(|p, _, _| {
                p.priors.parameters.push(ParameterPrior { intrinsics: 0, param: 0, value: 1.0, sigma: 0.0 })
            }),
            "parameter prior 0",
        ),
        (
            refused(|p, _, _| p.priors.positions.push(PositionPrior { bias: Some(2), ..good })),
            "position prior 0 names position bias 2",
        ),
        (refused(|p, _, _| p.marks.push(mark)), "mark 0 names landmark 0"),
        (
            refused(|p, _, _| {
                p.landmarks.push(Landmark { x_in_world: Vector3::new(0.0, nan, 0.0), fixed: false })
            }),
            "landmark 0 must be finite",
        ),
        (
            refused(|p, _, _| {
                let (from, to) = (Anchor::Pose(1), Anchor::Pose(1));
                p.priors.distances.push(DistancePrior { from, to, length_m: 1.0, sigma_m: 0.1 })
            }),
            "distance prior 0 joins a thing to itself",
        ),
        (
            refused(|p, _, _| {
                let (down_in_cam, down_in_world) = (2.0 * Vector3::z(), Vector3::z());
                p.priors.gravities.push(GravityPrior { pose: 1, down_in_cam, down_in_world, sigma_rad: 0.1 })
            }),
            "gravity prior 0 must have directions of unit length",
        ),
        (refused(|_, s, _| s.points[7].y = f64::INFINITY), "point 7"),
        (refused(|_, s, _| s.observations[5].pose = 1000), "observation 5"),
        (refused(|_, s, _| s.observations.last_mut().unwrap().point = 60), "observation"),
        (refused(|_, s, _| s.observations.reverse()), "sort observations"),
        (refused(|_, s, _| s.observations[4].xy_px[1] = f32::NAN), "observation 4"),
        (refused(|_, _, o| o.loss_scale_px = 0.0), "loss_scale_px"),
        (refused(|_, _, o| o.cost_tolerance = nan), "cost_tolerance"),
    ];
    for (message, expected) in cases {
        assert!(message.contains(expected), "{message:?} does not name {expected:?}");
    }
}

#[test]
fn nothing_to_adjust_is_an_outcome() {
    let mut problem = BundleProblem::default();
    let report = solve(&mut problem, &mut InMemoryShards::default(), &BundleOptions::default()).unwrap();
    assert_eq!(report.termination, Termination::NothingToAdjust);
    let (mut problem, shard) = small();
    let empty = BundleShard { points: shard.points, ..Default::default() };
    let report = solve(&mut problem, &mut InMemoryShards(vec![empty]), &BundleOptions::default()).unwrap();
    assert_eq!(report.termination, Termination::NothingToAdjust);
    assert_eq!(report.unconstrained_poses.len(), 12);
    let (mut problem, mut shard) = small();
    problem.fixed_poses.fill(true);
    problem.refine.fill(RefineIntrinsics::NONE);
    shard.fixed_points = true;
    let report = solve(&mut problem, &mut InMemoryShards(vec![shard]), &BundleOptions::default()).unwrap();
    assert_eq!(report.termination, Termination::NothingToAdjust);
}

#[test]
fn points_seen_once_and_cameras_without_points_stay_and_are_counted() {
    let (mut problem, mut shard) = small();
    problem.poses.push(problem.poses[0]);
    problem.fixed_poses.push(false);
    problem.intrinsics_of_pose.push(0);
    let seen_once = shard.points.len() as u32;
    shard.points.push(Vector3::new(1.0, 1.0, 0.0));
    shard.observations.push(BundleObservation { pose: 0, point: seen_once, xy_px: [10.0, 10.0] });
    let (last_pose, last_point) = (problem.poses[12], shard.points[seen_once as usize]);
    let mut shards = InMemoryShards(vec![shard]);
    let report = solve(&mut problem, &mut shards, &BundleOptions::default()).unwrap();
    assert!(report.termination.converged());
    assert_eq!((report.seen_once, report.unconstrained_poses), (1, vec![12]));
    assert_eq!((problem.poses[12], shards.0[0].points[seen_once as usize]), (last_pose, last_point));
}

#[test]
fn points_behind_the_camera_are_left_out() {
    let (mut problem, mut shard) = small();
    shard.points[0] = Vector3::new(3.0, 3.0, 100.0);
    let behind = shard.observations.iter().filter(|o| o.point == 0).count() as u64;
    let mut shards = InMemoryShards(vec![shard]);
    let report = solve(&mut problem, &mut shards, &BundleOptions::default()).unwrap();
    assert_eq!(report.behind_camera, behind);
    assert!(report.termination.converged());
    assert_eq!(shards.0[0].points[0], Vector3::new(3.0, 3.0, 100.0));
}

#[test]
fn flat_scene_two_components_and_points_alone_are_solved() {
    // Two copies of a flat scene that share nothing; the second scene's poses follow the first's.
    let scene = Scene::new(SceneOptions { points: 100, num_intrinsics: 0, ..Default::default() });
    let (mut problem, mut shard) = scene.disturbed(3);
    shard.points.iter_mut().for_each(|x| x.z = 0.0);
    let n = problem.poses.len() as u32;
    problem.poses.extend_from_within(..);
    problem.fixed_poses.extend_from_within(..);
    problem.intrinsics.extend_from_within(..);
    problem.refine.extend_from_within(..);
    let second: Vec<u32> = problem.intrinsics_of_pose.iter().map(|i| i + n).collect();
    problem.intrinsics_of_pose.extend(second);
    let mut other = shard.clone();
    other.observations.iter_mut().for_each(|o| o.pose += n);
    let mut shards = InMemoryShards(vec![shard.clone(), other]);
    let report = solve(&mut problem, &mut shards, &BundleOptions::default()).unwrap();
    assert!(report.termination.converged(), "{report:?}");

    let mut problem = scene.truth.clone();
    problem.fixed_poses.fill(true);
    problem.refine.fill(RefineIntrinsics::NONE);
    let report = solve(&mut problem, &mut InMemoryShards(vec![shard]), &BundleOptions::default()).unwrap();
    assert!(report.termination.converged() && report.final_cost < report.initial_cost);
    assert_eq!(report.reduced_unknowns, 0);
}

/// Shards of which one can't be loaded.
struct Broken;

impl Shards for Broken {
    fn len(&self) -> usize {
        1
    }

    fn load(&self, index: usize) -> Result<std::borrow::Cow<'_, BundleShard>, ShardError> {
        Err(ShardError { shard: index, reason: "the disk is gone".to_owned(), source: None })
    }

    fn store_points(&mut self, _: usize, _: &[Vector3<f64>]) -> Result<(), ShardError> {
        Ok(())
    }
}

#[test]
fn broken_store_is_an_error() {
    let (mut problem, _) = small();
    let error = solve(&mut problem, &mut Broken, &BundleOptions::default()).unwrap_err();
    assert!(!error.is_invalid_input());
    let source = std::error::Error::source(&error).map(ToString::to_string).unwrap_or_default();
    assert!(source.contains("disk is gone"), "{source}");
}
