//! The implicit solver against the explicit one, its preconditioners, and its bytes.

use std::sync::{Arc, Mutex};

use nalgebra::DMatrix;

use super::super::tests::{Noise, Scene, SceneOptions};
use super::super::{
    BundleProblem, BundleReport, BundleShard, InMemoryShards, PositionPrior, RefineIntrinsics, ShardError,
};
use super::*;
use crate::Loss;
use crate::bundle::{
    Anchor, BundleOptions, BundleSolver, DistancePrior, Landmark, Mark, ParameterPrior, PositionBias,
    Precision, Preconditioner, solve,
};

const BY_CLUSTER: [Preconditioner; 4] = [
    Preconditioner::BlockJacobi,
    Preconditioner::ClusterBlocks,
    Preconditioner::PowerSeries,
    Preconditioner::TwoLevel,
];

fn scene(num_intrinsics: usize) -> (BundleProblem, BundleShard) {
    let options =
        SceneOptions { columns: 6, rows: 5, points: 900, num_intrinsics, ..SceneOptions::default() };
    Scene::new(options).disturbed(5)
}

fn options(solver: BundleSolver) -> BundleOptions {
    BundleOptions {
        solver,
        cluster_poses: 7,
        cost_tolerance: 1e-13,
        linear_tolerance: 1e-3,
        // Re-weighting creeps where the loss bends.
        max_iterations: 200,
        ..Default::default()
    }
}

fn solved(
    start: &(BundleProblem, BundleShard),
    options: &BundleOptions,
) -> (BundleReport, BundleProblem, Vec<BundleShard>) {
    let (mut problem, shard) = start.clone();
    let mut shards = InMemoryShards(vec![shard]);
    let report = solve(&mut problem, &mut shards, options).unwrap();
    (report, problem, shards.0)
}

#[test]
fn explicit_and_implicit_find_the_same_minimum() {
    for num_intrinsics in [0, 1, 3] {
        let mut start = scene(num_intrinsics);
        start.0.fixed_poses[3] = true;
        start.0.priors.positions = (0..30u32)
            .step_by(4)
            .map(|pose| PositionPrior {
                pose,
                center_in_world: start.0.poses[pose as usize].center(),
                sigma_m: nalgebra::Vector3::repeat(0.05),
                bias: None,
            })
            .collect();
        let model = start.0.intrinsics[0].model;
        start.0.priors.parameters = ParameterPrior::focal(0, model, 890.0, 3.0).collect();
        // Under a loss that is not convex, re-weighting creeps, and the two ways may end in neighbouring valleys.
        for loss in [Loss::Squared, Loss::Huber, Loss::SoftL1, Loss::Cauchy] {
            let with = |solver, precision| BundleOptions { loss, precision, ..options(solver) };
            let explicit = solved(&start, &with(BundleSolver::Explicit, Precision::Double)).0;
            for precision in [Precision::Single, Precision::Double] {
                let (implicit, problem, _) = solved(&start, &with(BundleSolver::Implicit, precision));
                assert!((implicit.initial_cost / explicit.initial_cost - 1.0).abs() < 1e-12);
                let difference = (implicit.final_cost / explicit.final_cost - 1.0).abs();
                assert!(difference < 1e-8, "{num_intrinsics} {loss:?} {precision:?}: {difference:e}");
                assert!(implicit.clusters >= 4 && implicit.linear_iterations > 0, "{implicit:?}");
                assert_eq!(problem.poses[3], start.0.poses[3], "a held pose moved");
                assert!(implicit.termination.converged(), "{loss:?} {precision:?}: {implicit:?}");
            }
        }
    }
}

#[test]
fn every_preconditioner_leads_to_the_minimum() {
    let start = scene(0);
    let explicit = solved(&start, &options(BundleSolver::Explicit)).0;
    let mut iterations = Vec::new();
    for preconditioner in BY_CLUSTER {
        let with = BundleOptions { preconditioner, ..options(BundleSolver::Implicit) };
        let report = solved(&start, &with).0;
        assert!((report.final_cost / explicit.final_cost - 1.0).abs() < 1e-8, "{preconditioner:?}");
        iterations.push(report.linear_iterations as f64 / f64::from(report.iterations));
    }
    // More of the system in the preconditioner, fewer iterations.
    assert!(iterations[1] < iterations[0] && iterations[3] < iterations[1], "{iterations:?}");
    assert!(iterations[2] < iterations[0], "{iterations:?}");
}

/// A problem in parts, linearised and with its preconditioner built.
fn prepared(start: &(BundleProblem, BundleShard), options: &BundleOptions) -> solver::Prepared {
    let shards = InMemoryShards(vec![start.1.clone()]);
    let Partition { side, parts, .. } = partition(&start.0, &shards, options).unwrap();
    let side = Arc::new(side);
    let poses = parts.iter().map(|part| part.poses.clone()).collect();
    let mut worker = PartWorker::new(side.clone(), None, u64::MAX);
    for (index, part) in parts.into_iter().enumerate() {
        worker.take(index as u32, part).unwrap();
    }
    solver::Prepared::new(side, LocalHost(worker), poses, 1e-3)
}

fn dense(n: usize, mut apply: impl FnMut(&[f64]) -> Vec<f64>) -> DMatrix<f64> {
    let mut matrix = DMatrix::zeros(n, n);
    for column in 0..n {
        let mut unit = vec![0.0; n];
        unit[column] = 1.0;
        matrix.column_mut(column).copy_from_slice(&apply(&unit));
    }
    matrix
}

/// Largest difference to the transposed, relative to the diagonal.
fn asymmetry(matrix: &DMatrix<f64>) -> f64 {
    let n = matrix.nrows();
    let pairs = (0..n).flat_map(|i| (0..i).map(move |j| (i, j)));
    pairs
        .map(|(i, j)| {
            (matrix[(i, j)] - matrix[(j, i)]).abs() / (matrix[(i, i)] * matrix[(j, j)]).abs().sqrt()
        })
        .fold(0.0, f64::max)
}

/// Ties cameras of different clusters by a landmark, a bias and a distance.
fn tie(problem: &mut BundleProblem) {
    let x = nalgebra::Vector3::new(7.0, 6.0, 0.0);
    problem.landmarks = vec![Landmark { x_in_world: x, fixed: false }];
    problem.position_biases =
        vec![PositionBias { bias_m: x * 0.01, sigma_m: nalgebra::Vector3::repeat(0.3) }];
    for pose in 0..problem.poses.len() as u32 {
        let at = &problem.poses[pose as usize];
        let center_in_world = at.center();
        let sigma_m = nalgebra::Vector3::repeat(0.1);
        problem.priors.positions.push(PositionPrior { pose, center_in_world, sigma_m, bias: Some(0) });
        let camera = &problem.intrinsics[problem.intrinsics_of_pose[pose as usize] as usize];
        if let Some(xy) = camera.project(&at.transform_point(&x)) {
            problem.marks.push(Mark { pose, landmark: 0, xy_px: [xy.x + 1.0, xy.y], sigma_px: 0.3 });
        }
    }
    let (from, to) = (Anchor::Pose(0), Anchor::Pose(29));
    problem.priors.distances = vec![DistancePrior { from, to, length_m: 19.0, sigma_m: 0.01 }];
}

#[test]
fn systems_and_preconditioners_are_symmetric_and_positive_definite() {
    for (num_intrinsics, tied) in [(0, false), (2, false), (0, true), (2, true)] {
        let mut start = scene(num_intrinsics);
        if tied {
            tie(&mut start.0);
        }
        for preconditioner in BY_CLUSTER {
            if preconditioner == Preconditioner::PowerSeries && (tied || num_intrinsics > 0) {
                continue;
            }
            let with = BundleOptions {
                preconditioner,
                precision: Precision::Double,
                ..options(BundleSolver::Implicit)
            };
            let mut prepared = prepared(&start, &with);
            let n = prepared.num_unknowns();
            for (what, matrix) in [
                ("S", dense(n, |x| prepared.multiply(x))),
                ("inverse of M", dense(n, |r| prepared.precondition(r))),
            ] {
                assert!(asymmetry(&matrix) < 1e-9, "{what} of {preconditioner:?}: {:e}", asymmetry(&matrix));
                let scale = matrix.diagonal().map(|d| 1.0 / d.sqrt());
                let scaled = DMatrix::from_fn(n, n, |i, j| {
                    0.5 * (matrix[(i, j)] + matrix[(j, i)]) * scale[i] * scale[j]
                });
                let smallest = scaled.symmetric_eigenvalues().min();
                assert!(smallest > 0.0, "{what} of {preconditioner:?}: {smallest:e}");
            }
        }
    }
}

#[test]
fn power_series_refuses_shared_intrinsics() {
    let (mut problem, shard) = scene(1);
    let with =
        BundleOptions { preconditioner: Preconditioner::PowerSeries, ..options(BundleSolver::Implicit) };
    let error = solve(&mut problem, &mut InMemoryShards(vec![shard.clone()]), &with).unwrap_err();
    assert!(error.is_invalid_input() && error.to_string().contains("power series"), "{error}");
    problem.refine = vec![RefineIntrinsics::NONE];
    assert!(solve(&mut problem, &mut InMemoryShards(vec![shard]), &with).is_ok());
}

#[test]
fn threads_do_not_change_a_bit() {
    let start = scene(2);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| solved(&start, &options(BundleSolver::Implicit)))
    };
    let one = run(1);
    for threads in [2, 5] {
        assert!(one == run(threads), "{threads} threads");
    }
}

/// Parts and points in memory.
#[derive(Default)]
struct MemoryStore {
    parts: Vec<Part>,
    points: Mutex<std::collections::BTreeMap<(u32, u64), Vec<nalgebra::Vector3<f64>>>>,
}

impl PartStore for MemoryStore {
    fn load(&self, part: u32) -> Result<Part, ShardError> {
        Ok(self.parts[part as usize].clone())
    }

    fn load_points(&self, part: u32, step: u64) -> Result<Vec<nalgebra::Vector3<f64>>, ShardError> {
        Ok(self.points.lock().unwrap()[&(part, step)].clone())
    }

    fn store_points(
        &self,
        part: u32,
        step: u64,
        points: &[nalgebra::Vector3<f64>],
    ) -> Result<(), ShardError> {
        self.points.lock().unwrap().insert((part, step), points.to_vec());
        Ok(())
    }
}

#[test]
fn parts_that_are_read_again_change_no_bit() {
    for precision in [Precision::Single, Precision::Double] {
        let start = scene(0);
        let with = BundleOptions { precision, ..options(BundleSolver::Implicit) };
        let (_, problem, shards) = solved(&start, &with);
        let in_memory = InMemoryShards(vec![start.1.clone()]);
        for memory_bytes in [0, 300_000, u64::MAX] {
            let Partition { side, parts, origins, mut report } =
                partition(&start.0, &in_memory, &with).unwrap();
            let side = Arc::new(side);
            let poses = parts.iter().map(|part| part.poses.clone()).collect();
            let store = Arc::new(MemoryStore { parts, ..Default::default() });
            let mut worker = PartWorker::new(side.clone(), Some(store), memory_bytes);
            (0..origins.len() as u32).for_each(|part| worker.take_stored(part).unwrap());
            let resident = worker.held().filter(|(_, resident)| *resident).count();
            match memory_bytes {
                0 => assert_eq!(resident, 0),
                u64::MAX => assert_eq!(resident, origins.len()),
                _ => assert!(resident > 0 && resident < origins.len(), "{resident}"),
            }
            let mut host = LocalHost(worker);
            let got = solve_parts(side, &mut host, poses, &mut report).unwrap();
            assert!(
                got.poses == problem.poses && got.intrinsics == problem.intrinsics,
                "{memory_bytes} bytes"
            );
            let points = host.ask(&PartRequest::Points).unwrap();
            for (origins, points) in origins.iter().zip(points) {
                for ((_, point), x) in origins.iter().zip(points.chunks_exact(3)) {
                    assert_eq!(shards[0].points[*point as usize].as_slice(), x);
                }
            }
        }
    }
}

#[test]
fn clusters_are_balanced_and_every_point_has_one_part() {
    let start = scene(0);
    let shards = InMemoryShards(vec![start.1.clone()]);
    let found = partition(&start.0, &shards, &options(BundleSolver::Implicit)).unwrap();
    let sizes: Vec<usize> = found.side.clusters().members.iter().map(Vec::len).collect();
    assert!(sizes.iter().all(|n| (5..=7).contains(n)), "{sizes:?}");
    let mut origins: Vec<(u32, u32)> = found.origins.iter().flatten().copied().collect();
    origins.sort_unstable();
    assert!(origins.windows(2).all(|w| w[0] < w[1]), "a point is in two parts");
    assert_eq!(origins.len() as u64, found.report.points);
    let observations: usize = found.parts.iter().map(Part::num_observations).sum();
    assert_eq!(observations as u64, found.report.observations);
    for (index, part) in found.parts.iter().enumerate() {
        part.validate(index, start.0.poses.len()).unwrap();
    }
}

#[test]
fn parts_that_contradict_themselves_are_refused() {
    let start = scene(0);
    let shards = InMemoryShards(vec![start.1.clone()]);
    let part = partition(&start.0, &shards, &options(BundleSolver::Implicit)).unwrap().parts.swap_remove(0);
    let spoil: [fn(&mut Part); 6] = [
        |part| part.poses[0] = 9999,
        |part| part.poses.swap(0, 1),
        |part| part.point_of[0] = u32::MAX,
        |part| part.first_observation[0] = 1,
        |part| part.xy_px.truncate(1),
        |part| part.points[0].x = f64::NAN,
    ];
    for spoil in spoil {
        let mut bad = part.clone();
        spoil(&mut bad);
        let error = bad.validate(4, start.0.poses.len()).unwrap_err();
        assert!(error.to_string().contains("part 4"), "{error}");
    }
}

#[test]
fn outliers_with_a_robust_loss_leave_centres_where_they_were() {
    let make = |outliers: bool| {
        let (problem, mut shard) = scene(1);
        let mut noise = Noise::new(11);
        if outliers {
            for (i, observation) in shard.observations.iter_mut().enumerate().filter(|(i, _)| i % 10 == 3) {
                let _ = i;
                observation.xy_px[0] += (80.0 * noise.next()) as f32;
                observation.xy_px[1] += (80.0 * noise.next()) as f32;
            }
        }
        (problem, shard)
    };
    let truth =
        Scene::new(SceneOptions { columns: 6, rows: 5, points: 900, ..SceneOptions::default() }).truth;
    let error = |outliers: bool| {
        let with = BundleOptions { loss: Loss::Cauchy, ..options(BundleSolver::Implicit) };
        let (_, problem, _) = solved(&make(outliers), &with);
        let from: Vec<_> = problem.poses.iter().map(|pose| pose.center()).collect();
        let to: Vec<_> = truth.poses.iter().map(|pose| pose.center()).collect();
        let fit = terrane_geometry::alignment::umeyama(&from, &to, None).unwrap();
        let squares = from.iter().zip(&to).map(|(a, b)| (fit.transform_point(a) - b).norm_squared());
        (squares.sum::<f64>() / from.len() as f64).sqrt()
    };
    let (clean, spoiled) = (error(false), error(true));
    assert!(clean > 1e-5 && clean < 0.02 && spoiled < 1.5 * clean, "{clean} {spoiled}");
}

#[test]
fn questions_that_do_not_fit_are_errors() {
    let start = scene(0);
    let shards = InMemoryShards(vec![start.1.clone()]);
    let Partition { side, mut parts, .. } =
        partition(&start.0, &shards, &options(BundleSolver::Implicit)).unwrap();
    let (part, count) = (parts.swap_remove(0), parts.len() as u32 + 1);
    let mut worker = PartWorker::new(Arc::new(side), None, u64::MAX);
    assert!(worker.take(count, part.clone()).unwrap_err().to_string().contains("no cluster"));
    worker.take(0, part).unwrap();
    for request in [
        PartRequest::Multiply(vec![1.0; 5]),
        PartRequest::Solve(Vec::new()),
        PartRequest::Try { damping: 1e-4, step: vec![0.0; 3] },
        PartRequest::Prepare { diagonal: vec![1.0; 7], coarse: false },
    ] {
        let error = worker.begin(&request).unwrap_err();
        assert!(error.is_invalid_input() && error.to_string().contains("numbers"), "{request:?}: {error}");
    }
}
