//! Tests of bundle adjustment on synthetic scenes with known truth.

mod bad_problems;
mod normal_equations;
mod priors;
mod properties;
mod truth;

use nalgebra::{Rotation3, UnitQuaternion, Vector3};
use rand::RngExt;
use terrane_geometry::{Camera, CameraModel, Rigid3, Seed};

use super::*;
use crate::Loss;

/// A block of photographs from above over bumpy ground, with truth.
pub(super) struct Scene {
    pub truth: BundleProblem,
    pub shard: BundleShard,
}

/// What a scene is made of.
#[derive(Clone, Copy)]
pub(super) struct SceneOptions {
    pub columns: usize,
    pub rows: usize,
    pub points: usize,
    pub model: CameraModel,
    /// Poses share this many intrinsics in turn; 0: each has its own.
    pub num_intrinsics: usize,
    pub noise_px: f64,
    pub seed: u64,
}

impl Default for SceneOptions {
    fn default() -> Self {
        Self {
            columns: 4,
            rows: 3,
            points: 400,
            model: CameraModel::SimpleRadial,
            num_intrinsics: 1,
            noise_px: 0.5,
            seed: 1,
        }
    }
}

/// About normally distributed numbers of unit variance.
pub(super) struct Noise(rand_pcg::Pcg64Mcg);

impl Noise {
    pub fn new(seed: u64) -> Self {
        Self(Seed(seed).rng())
    }

    pub fn next(&mut self) -> f64 {
        (0..12).map(|_| self.0.random_range(-0.5..0.5)).sum()
    }

    pub fn vector(&mut self) -> Vector3<f64> {
        Vector3::new(self.next(), self.next(), self.next())
    }

    pub fn uniform(&mut self, range: std::ops::Range<f64>) -> f64 {
        self.0.random_range(range)
    }
}

fn camera(model: CameraModel) -> Camera {
    let mut camera = Camera::centered(model, 1000, 800, 900.0);
    let k = [0.04, -0.02, 1e-3, -8e-4, 3e-3, 1e-3, 2e-3, 1e-3];
    let first = model.num_focal() + 2;
    let n = model.num_params();
    camera.params_mut()[first..n].copy_from_slice(&k[..n - first]);
    camera
}

impl Scene {
    pub fn new(options: SceneOptions) -> Self {
        let mut noise = Noise::new(options.seed);
        let down =
            Rotation3::from_matrix_unchecked(nalgebra::Matrix3::new(1., 0., 0., 0., -1., 0., 0., 0., -1.));
        let mut poses = Vec::new();
        for row in 0..options.rows {
            for column in 0..options.columns {
                let center = Vector3::new(column as f64 * 3.0, row as f64 * 3.0, 10.0) + noise.vector() * 0.3;
                let tilt = UnitQuaternion::from_scaled_axis(noise.vector() * 0.15);
                let rotation = tilt * UnitQuaternion::from_rotation_matrix(&down);
                poses.push(Rigid3::from_rotation_and_center(rotation, &center));
            }
        }
        let n = poses.len();
        let count = if options.num_intrinsics == 0 { n } else { options.num_intrinsics };
        let intrinsics_of_pose = (0..n).map(|i| (i % count) as u32).collect();
        let refine = RefineIntrinsics::FOCAL_AND_DISTORTION;
        let truth = BundleProblem::new(poses, vec![camera(options.model); count], intrinsics_of_pose, refine);
        let mut shard = BundleShard::default();
        let (width, depth) = (3.0 * options.columns as f64, 3.0 * options.rows as f64);
        while shard.points.len() < options.points {
            let x = noise.uniform(-3.0..width);
            let point = Vector3::new(x, noise.uniform(-3.0..depth), noise.uniform(-1.5..1.5));
            let seen = observe(&truth, shard.points.len() as u32, &point, options.noise_px, &mut noise);
            if seen.len() >= 2 {
                shard.observations.extend(seen);
                shard.points.push(point);
            }
        }
        Self { truth, shard }
    }

    /// The scene with everything moved from the truth by a few pixels' worth.
    pub fn disturbed(&self, seed: u64) -> (BundleProblem, BundleShard) {
        let mut noise = Noise::new(seed);
        let (mut problem, mut shard) = (self.truth.clone(), self.shard.clone());
        for pose in &mut problem.poses {
            let (turn, shift) = (noise.vector() * 0.01, noise.vector() * 0.1);
            *pose =
                pose.retract_left(&nalgebra::Vector6::new(turn.x, turn.y, turn.z, shift.x, shift.y, shift.z));
        }
        for camera in &mut problem.intrinsics {
            let num_focal = camera.model.num_focal();
            let focal = camera.mean_focal_px() + 10.0 * noise.next();
            camera.params_mut()[..num_focal].fill(focal);
        }
        for point in &mut shard.points {
            *point += noise.vector() * 0.1;
        }
        (problem, shard)
    }
}

fn observe(
    problem: &BundleProblem,
    point: u32,
    x: &Vector3<f64>,
    noise_px: f64,
    noise: &mut Noise,
) -> Vec<BundleObservation> {
    let mut seen = Vec::new();
    for (pose, cam_from_world) in problem.poses.iter().enumerate() {
        let camera = &problem.intrinsics[problem.intrinsics_of_pose[pose] as usize];
        let Some(xy) = camera.project(&cam_from_world.transform_point(x)) else { continue };
        if xy.x > 0.0 && xy.y > 0.0 && xy.x < f64::from(camera.width_px) && xy.y < f64::from(camera.height_px)
        {
            let xy_px = [(xy.x + noise_px * noise.next()) as f32, (xy.y + noise_px * noise.next()) as f32];
            seen.push(BundleObservation { pose: pose as u32, point, xy_px });
        }
    }
    seen
}

/// Cuts a shard into so many.
fn cut(shard: &BundleShard, parts: usize) -> InMemoryShards {
    let size = shard.points.len().div_ceil(parts);
    let mut shards = Vec::new();
    for part in 0..parts {
        let range = (part * size).min(shard.points.len())..((part + 1) * size).min(shard.points.len());
        let observations = shard.observations.iter().filter(|o| range.contains(&(o.point as usize)));
        shards.push(BundleShard {
            points: shard.points[range.clone()].to_vec(),
            fixed_points: shard.fixed_points,
            observations: observations
                .map(|o| BundleObservation { point: o.point - range.start as u32, ..*o })
                .collect(),
        });
    }
    InMemoryShards(shards)
}

/// Root mean square of the distance of centres from truth after the best similarity.
fn center_rmse(found: &[Rigid3], truth: &[Rigid3]) -> f64 {
    let from: Vec<_> = found.iter().map(Rigid3::center).collect();
    let to: Vec<_> = truth.iter().map(Rigid3::center).collect();
    let to_from_found =
        terrane_geometry::alignment::umeyama(&from, &to, None).expect("centres in general position");
    let squared: f64 =
        from.iter().zip(&to).map(|(a, b)| (to_from_found.transform_point(a) - b).norm_squared()).sum();
    (squared / from.len() as f64).sqrt()
}

/// A linearised and eliminated scene whose intrinsics have so many refined parameters.
pub(super) struct LinearisedScene {
    pub layout: super::layout::Layout,
    pub plan: super::plan::ShardPlan,
    pub shard: super::linearisation::Linearisation,
}

pub(super) fn linearised_scene(num_params: usize) -> LinearisedScene {
    let (model, refine) = match num_params {
        0 => (CameraModel::SimplePinhole, RefineIntrinsics::NONE),
        1 => (CameraModel::SimplePinhole, RefineIntrinsics::FOCAL_AND_DISTORTION),
        2 => (CameraModel::SimpleRadial, RefineIntrinsics::FOCAL_AND_DISTORTION),
        4 => (CameraModel::SimpleRadial, RefineIntrinsics::ALL),
        _ => (CameraModel::OpenCv, RefineIntrinsics::ALL),
    };
    let scene = Scene::new(SceneOptions { model, num_intrinsics: 3, ..Default::default() });
    let (mut problem, shard) = scene.disturbed(3);
    problem.refine.fill(refine);
    let cameras = super::layout::Cameras::of(&problem);
    let layout =
        super::layout::Layout::new(&problem, &vec![true; problem.poses.len()], None, BehindCamera::LeaveOut);
    let dropped = super::plan::Dropped::find(&shard, &problem, &cameras, BehindCamera::LeaveOut);
    let plan = super::plan::ShardPlan::new(&shard, &dropped, &problem);
    let context = super::linearisation::Context {
        problem: &problem,
        layout: &layout,
        cameras: &cameras,
        loss: Loss::Huber,
        loss_scale_px: 1.0,
        behind: BehindCamera::LeaveOut,
        held_direction: None,
        damping: 1e-3,
    };
    let mut linearised = super::linearisation::Linearisation::new(&plan, layout.stride);
    linearised.update(&context, &plan, Some(&shard.points));
    LinearisedScene { plan, shard: linearised, layout }
}
