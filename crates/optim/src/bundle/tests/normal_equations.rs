//! Jacobians against differences, and the Schur complement against the dense normal equations of everything.

use nalgebra::{DMatrix, DVector, Vector6};

use super::super::layout::{Cameras, Layout};
use super::super::linearisation::{Context, Linearisation, Terms, linearise};
use super::super::pattern::Covisibility;
use super::super::plan::{Dropped, ShardPlan};
use super::super::reduced::Reduced;
use super::super::step::{CameraStep, try_step};
use super::super::terms::{terms, ties};
use super::*;

struct Setup {
    problem: BundleProblem,
    shard: BundleShard,
    layout: Layout,
    cameras: Cameras,
    plan: ShardPlan,
}

fn setup(model: CameraModel, num_intrinsics: usize, columns: usize) -> Setup {
    let options = SceneOptions {
        columns,
        rows: 2,
        points: 40 + 2 * columns,
        model,
        num_intrinsics,
        ..Default::default()
    };
    let scene = Scene::new(options);
    let (mut problem, mut shard) = scene.disturbed(3);
    problem.fixed_poses[2] = true;
    add_priors(&mut problem);
    // A point that a pose sees twice.
    let twice = shard.observations[0];
    shard
        .observations
        .insert(0, BundleObservation { xy_px: [twice.xy_px[0] + 2.0, twice.xy_px[1] - 1.0], ..twice });
    let cameras = Cameras::of(&problem);
    let plan =
        ShardPlan::new(&shard, &Dropped::find(&shard, &problem, &cameras, BehindCamera::LeaveOut), &problem);
    let observed: Vec<bool> = (0..problem.poses.len()).map(|pose| !plan.of_pose(pose).is_empty()).collect();
    let layout = Layout::new(&problem, &observed, None, BehindCamera::LeaveOut);
    Setup { problem, shard, layout, cameras, plan }
}

/// Every kind of prior, a landmark with marks, and a bias.
fn add_priors(problem: &mut BundleProblem) {
    let position = |pose: u32, bias| PositionPrior {
        pose,
        center_in_world: Vector3::new(3.0 * f64::from(pose), 2.0, 9.0),
        sigma_m: Vector3::new(0.5, 0.6, 0.7),
        bias,
    };
    problem.position_biases =
        vec![PositionBias { bias_m: Vector3::new(0.1, -0.2, 0.3), sigma_m: Vector3::new(0.4, 0.5, 0.6) }];
    let down_in_cam = Vector3::new(0.1, 0.05, 1.0).normalize();
    let between = (problem.poses[0].center() - problem.poses[4].center()).norm();
    problem.priors = Priors {
        positions: vec![position(1, None), position(2, Some(0)), position(3, Some(0))],
        gravities: vec![GravityPrior { pose: 0, down_in_cam, down_in_world: -Vector3::z(), sigma_rad: 0.01 }],
        rotations: vec![RotationPrior {
            pose: 3,
            cam_from_world: UnitQuaternion::from_scaled_axis(Vector3::new(0.1, 0.2, -0.1))
                * problem.poses[3].rotation,
            sigma_rad: Vector3::new(0.02, 0.03, 0.04),
        }],
        parameters: ParameterPrior::focal(0, problem.intrinsics[0].model, 870.0, 3.0).collect(),
        landmarks: vec![LandmarkPrior {
            landmark: 0,
            x_in_world: Vector3::new(1.1, 1.4, 0.2),
            sigma_m: Vector3::new(0.02, 0.03, 0.04),
        }],
        distances: vec![
            DistancePrior {
                from: Anchor::Pose(0),
                to: Anchor::Pose(4),
                length_m: between + 0.05,
                sigma_m: 0.02,
            },
            DistancePrior { from: Anchor::Landmark(1), to: Anchor::Pose(2), length_m: 9.5, sigma_m: 0.1 },
        ],
    };
    let landmark = |x, y| Landmark { x_in_world: Vector3::new(x, y, 0.1), fixed: false };
    problem.landmarks = vec![landmark(1.0, 1.5), landmark(3.0, 2.0)];
    for (number, landmark) in [0, 1, 0, 1, 0].into_iter().enumerate() {
        let pose = number as u32;
        let x_in_cam = problem.poses[number].transform_point(&problem.landmarks[landmark].x_in_world);
        let camera = &problem.intrinsics[problem.intrinsics_of_pose[number] as usize];
        let xy = camera.project(&x_in_cam).unwrap();
        let xy_px = [xy.x + 0.3, xy.y - 0.6];
        problem.marks.push(Mark { pose, landmark: landmark as u32, xy_px, sigma_px: 0.5 });
    }
}

impl Setup {
    fn context(&self, loss: Loss) -> Context<'_> {
        Context {
            problem: &self.problem,
            layout: &self.layout,
            cameras: &self.cameras,
            loss,
            loss_scale_px: 2.0,
            behind: BehindCamera::LeaveOut,
            held_direction: None,
            damping: 0.01,
        }
    }

    /// Residuals of observations and priors after a step of cameras and points.
    fn residuals(&self, step: &[f64]) -> Vec<f64> {
        let n = self.layout.num_unknowns();
        let cameras = self.cameras.stepped(&self.layout, &step[..n]).unwrap();
        let mut residuals = Vec::new();
        for o in &self.plan.observations {
            let delta =
                Vector3::from_column_slice(&step[n + 3 * o.point as usize..n + 3 * o.point as usize + 3]);
            let x = self.shard.points[o.point as usize] + delta;
            let camera = &cameras.intrinsics[self.problem.intrinsics_of_pose[o.pose as usize] as usize];
            let xy = camera.project(&cameras.poses[o.pose as usize].transform_point(&x)).unwrap();
            residuals.extend([xy.x - f64::from(o.xy_px[0]), xy.y - f64::from(o.xy_px[1])]);
        }
        let terms = terms(&self.problem, &self.layout, &cameras, &BundleOptions::default());
        residuals.extend(terms.iter().flat_map(|term| &term.residual[..term.rows]));
        residuals
    }

    /// The Jacobian of [`Setup::residuals`] by central differences.
    fn jacobian(&self) -> DMatrix<f64> {
        let n = self.layout.num_unknowns() + 3 * self.shard.points.len();
        let columns: Vec<DVector<f64>> = (0..n)
            .map(|i| {
                let h = 1e-6;
                let at = |value: f64| {
                    let mut step = vec![0.0; n];
                    step[i] = value;
                    DVector::from_vec(self.residuals(&step))
                };
                (at(h) - at(-h)) / (2.0 * h)
            })
            .collect();
        DMatrix::from_columns(&columns)
    }
}

#[test]
fn jacobians_agree_with_differences() {
    for (model, n) in [(CameraModel::Pinhole, 1), (CameraModel::Radial, 0), (CameraModel::FullOpenCv, 2)] {
        let setup = setup(model, n, 3);
        let expected = setup.jacobian();
        let context = setup.context(Loss::Squared);
        let free = 6 * setup.layout.poses.len();
        for (i, o) in setup.plan.observations.iter().enumerate() {
            let mut terms = Terms::default();
            let mut intrinsics = vec![0.0; 2 * setup.layout.stride];
            linearise(&context, o, &setup.shard.points[o.point as usize], &mut terms, &mut intrinsics);
            for row in 0..2 {
                let mut got = DVector::zeros(expected.ncols());
                let variable = setup.layout.pose_variable[o.pose as usize];
                if variable != super::super::layout::NONE {
                    let value = Vector6::from(terms.pose[row]);
                    got.rows_mut(6 * variable as usize, 6).copy_from(&value);
                }
                let own = setup.layout.intrinsics_variable_of_pose[o.pose as usize] as usize;
                let width = setup.layout.params[own].len();
                let offset = free + setup.layout.params[..own].iter().map(Vec::len).sum::<usize>();
                for a in 0..width {
                    got[offset + a] = intrinsics[row * setup.layout.stride + a];
                }
                let at = setup.layout.num_unknowns() + 3 * o.point as usize;
                got.rows_mut(at, 3).copy_from(&Vector3::from(terms.point[row]));
                let expected = expected.row(2 * i + row).transpose();
                let scale = 1.0 + expected.amax();
                assert!((got - expected).amax() < 1e-6 * scale, "{model:?} observation {i}");
            }
        }
    }
}

#[test]
fn jacobians_of_priors_and_marks_agree_with_differences() {
    for (model, n) in [(CameraModel::Pinhole, 1), (CameraModel::Radial, 0)] {
        let setup = setup(model, n, 3);
        let expected = setup.jacobian();
        let mut row = 2 * setup.plan.observations.len();
        let terms = terms(&setup.problem, &setup.layout, &setup.cameras, &BundleOptions::default());
        // Three positions and their bias, gravity, rotation, focal lengths, a landmark, two distances, five marks.
        assert_eq!(terms.len(), 14 + model.num_focal());
        for term in &terms {
            for component in 0..term.rows {
                let mut got = DVector::zeros(expected.ncols());
                for block in &term.blocks {
                    let range = block.range(&setup.layout);
                    range.zip(&block.columns).for_each(|(at, column)| got[at] = column[component]);
                }
                let expected = expected.row(row).transpose();
                assert!((got - &expected).amax() < 1e-6 * (1.0 + expected.amax()), "{model:?} row {row}");
                row += 1;
            }
        }
        assert_eq!(row, expected.nrows());
    }
}

#[test]
fn schur_complement_gives_the_step_of_the_dense_normal_equations() {
    for (model, n, columns) in [
        (CameraModel::Pinhole, 1, 3),
        (CameraModel::Radial, 0, 3),
        (CameraModel::FullOpenCv, 2, 3),
        (CameraModel::SimpleRadial, 3, 31),
    ] {
        let setup = setup(model, n, columns);
        let unknowns = setup.layout.num_unknowns();
        // Weights come from the loss; damping from the diagonal.
        let context = setup.context(Loss::Cauchy);
        let options = BundleOptions::default();
        let mut jacobian = setup.jacobian();
        let mut residuals = DVector::from_vec(setup.residuals(&vec![0.0; jacobian.ncols()]));
        for i in 0..setup.plan.observations.len() {
            let squared = residuals[2 * i].powi(2) + residuals[2 * i + 1].powi(2);
            let root = Loss::Cauchy.evaluate(squared, 2.0).1.sqrt();
            jacobian.rows_mut(2 * i, 2).scale_mut(root);
            residuals.rows_mut(2 * i, 2).scale_mut(root);
        }
        let mut normal = jacobian.transpose() * &jacobian;
        let gradient = jacobian.transpose() * &residuals;
        for i in 0..normal.nrows() {
            normal[(i, i)] *= 1.0 + context.damping;
        }
        let expected = normal.clone().cholesky().unwrap().solve(&(-&gradient));

        let mut covisibility = Covisibility::new(setup.problem.poses.len());
        covisibility.add(&setup.plan);
        let ties = ties(&terms(&setup.problem, &setup.layout, &setup.cameras, &options));
        let (mut rows, pattern) = covisibility.rows(&setup.layout, &ties);
        let offsets: Vec<usize> = (0..setup.layout.intrinsics.len())
            .map(|v| pattern.offset(setup.layout.poses.len() + v))
            .collect();
        let mut reduced = Reduced::new(pattern, &options).unwrap();
        let mut shard = Linearisation::new(&setup.plan, setup.layout.stride);
        shard.update(&context, &setup.plan, Some(&setup.shard.points));
        super::super::schur::accumulate(&mut rows, &setup.layout, &setup.plan, &shard);
        reduced.assemble(&context, &rows, &options);
        let step = reduced.solve().unwrap();
        let scale = expected.amax();
        for i in 0..unknowns {
            assert!(
                (step[i] - expected[i]).abs() < 1e-5 * scale,
                "{model:?} unknown {i}: {} {}",
                step[i],
                expected[i]
            );
        }

        let next = setup.cameras.stepped(&setup.layout, &step).unwrap();
        let camera_step = CameraStep { step: &step, cameras: &next, intrinsics_offsets: &offsets };
        let mut trial = setup.shard.points.clone();
        let tried = try_step(&context, &camera_step, (&setup.plan, &shard), &setup.shard.points, &mut trial);
        for (point, (before, after)) in setup.shard.points.iter().zip(&trial).enumerate() {
            let expected = expected.rows(unknowns + 3 * point, 3);
            assert!((after - before - expected).amax() < 1e-5, "{model:?} point {point}");
        }
        let undamped = jacobian.transpose() * &jacobian;
        let model_reduction = -gradient.dot(&expected) - 0.5 * expected.dot(&(undamped * &expected));
        let got = tried.model_reduction + reduced.model_reduction(&step, context.damping);
        assert!((got / model_reduction - 1.0).abs() < 1e-5, "{model:?}: {got} {model_reduction}");
    }
}
