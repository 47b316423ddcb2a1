//! What must hold of any solve: shards, threads, solvers and gauges do not change the minimum; what is held stays.

use super::*;
use crate::linear::LinearSolver;

fn options() -> BundleOptions {
    BundleOptions { cost_tolerance: 1e-12, loss: Loss::Huber, ..Default::default() }
}

#[test]
fn number_of_shards_does_not_change_the_minimum() {
    let scene = Scene::new(SceneOptions { num_intrinsics: 2, ..Default::default() });
    let costs: Vec<f64> = [1, 3, 10]
        .into_iter()
        .map(|parts| {
            let (mut problem, shard) = scene.disturbed(3);
            let mut shards = cut(&shard, parts);
            solve(&mut problem, &mut shards, &options()).unwrap().final_cost
        })
        .collect();
    for cost in &costs {
        assert!((cost / costs[0] - 1.0).abs() < 1e-8, "{costs:?}");
    }
}

#[test]
fn streamed_shards_give_the_same_bytes_as_kept_ones() {
    let scene = Scene::new(SceneOptions::default());
    let solve_with = |linearisation_memory_bytes| {
        let (mut problem, shard) = scene.disturbed(3);
        let mut shards = cut(&shard, 4);
        let options = BundleOptions { linearisation_memory_bytes, ..options() };
        let report = solve(&mut problem, &mut shards, &options).unwrap();
        (problem, shards, report)
    };
    assert_eq!(solve_with(0), solve_with(1 << 30));
}

#[test]
fn number_of_threads_does_not_change_a_byte() {
    for (columns, num_intrinsics) in [(4, 0), (22, 3)] {
        let scene = Scene::new(SceneOptions { columns, points: 2000, num_intrinsics, ..Default::default() });
        let solve_with = |threads| {
            let (mut problem, shard) = scene.disturbed(3);
            let mut shards = cut(&shard, 2);
            let options = BundleOptions { max_iterations: 4, ..options() };
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let report = pool.install(|| solve(&mut problem, &mut shards, &options).unwrap());
            (problem, shards, report)
        };
        let one = solve_with(1);
        assert_eq!(one, solve_with(2));
        assert_eq!(one, solve_with(3));
    }
}

#[test]
fn dense_and_sparse_reach_the_same_minimum() {
    for num_intrinsics in [0, 1] {
        let scene = Scene::new(SceneOptions {
            columns: 16,
            rows: 5,
            points: 1500,
            num_intrinsics,
            ..Default::default()
        });
        let solve_with = |linear_solver| {
            let (mut problem, shard) = scene.disturbed(3);
            let options = BundleOptions { linear_solver, ..options() };
            solve(&mut problem, &mut InMemoryShards(vec![shard]), &options).unwrap().final_cost
        };
        let (dense, sparse) = (solve_with(LinearSolver::Dense), solve_with(LinearSolver::Sparse));
        assert!((dense / sparse - 1.0).abs() < 1e-8, "{dense} {sparse}");
    }
}

#[test]
fn gauges_reach_the_same_minimum_and_hold_what_they_say() {
    let scene = Scene::new(SceneOptions::default());
    let solve_with = |gauge| {
        let (mut problem, shard) = scene.disturbed(3);
        let before = problem.poses.clone();
        let options = BundleOptions { gauge, ..options() };
        let report = solve(&mut problem, &mut InMemoryShards(vec![shard]), &options).unwrap();
        (report.final_cost, before, problem.poses)
    };
    let (damped, ..) = solve_with(Gauge::Damped);
    let (held, before, after) = solve_with(Gauge::TwoPoses);
    assert!((damped / held - 1.0).abs() < 1e-8, "{damped} {held}");
    assert_eq!(before[0], after[0]);
    let length = |poses: &[Rigid3]| (poses[11].center() - poses[0].center()).norm();
    assert!((length(&before) / length(&after) - 1.0).abs() < 2e-3, "{} {}", length(&before), length(&after));
}

#[test]
fn held_poses_intrinsics_and_points_do_not_move() {
    let scene = Scene::new(SceneOptions { num_intrinsics: 2, ..Default::default() });
    let (mut problem, mut shard) = scene.disturbed(3);
    problem.fixed_poses[..5].fill(true);
    problem.refine[1] = RefineIntrinsics::NONE;
    let before = problem.clone();
    let mut shards = InMemoryShards(vec![shard.clone()]);
    let report = solve(&mut problem, &mut shards, &options()).unwrap();
    assert!(report.final_cost < report.initial_cost);
    assert_eq!(before.poses[..5], problem.poses[..5]);
    assert_ne!(before.poses[5..], problem.poses[5..]);
    assert_eq!(before.intrinsics[1], problem.intrinsics[1]);
    assert_ne!(before.intrinsics[0], problem.intrinsics[0]);

    shard.fixed_points = true;
    shard.points = scene.shard.points.clone();
    let mut problem = BundleProblem { intrinsics: scene.truth.intrinsics.clone(), ..before.clone() };
    problem.refine.fill(RefineIntrinsics::NONE);
    let mut shards = InMemoryShards(vec![shard.clone()]);
    let report = solve(&mut problem, &mut shards, &options()).unwrap();
    assert_eq!(shards.0[0].points, shard.points);
    // Every free pose is resected on its own.
    assert!((problem.poses[7].center() - scene.truth.poses[7].center()).norm() < 0.05, "{report:?}");
}

#[test]
fn each_group_of_parameters_can_be_held() {
    let scene = Scene::new(SceneOptions { model: CameraModel::OpenCv, ..Default::default() });
    for refine in [
        RefineIntrinsics { focal: true, ..RefineIntrinsics::NONE },
        RefineIntrinsics { principal_point: true, ..RefineIntrinsics::NONE },
        RefineIntrinsics { distortion: true, ..RefineIntrinsics::NONE },
        RefineIntrinsics::ALL,
    ] {
        let (mut problem, shard) = scene.disturbed(3);
        problem.refine = vec![refine];
        let before = problem.intrinsics[0];
        let report = solve(&mut problem, &mut InMemoryShards(vec![shard]), &options()).unwrap();
        assert!(report.final_cost < report.initial_cost);
        let refined = refine.params(&before);
        for (i, (a, b)) in before.params().iter().zip(problem.intrinsics[0].params()).enumerate() {
            assert_eq!(a != b, refined.contains(&i), "parameter {i} with {refine:?}");
        }
    }
}
