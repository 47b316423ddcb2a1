//! The pose of a camera from points in the world and the pixels that see them, among outliers.
//!
//! P3P inside LO-RANSAC. Errors are distances in pixels under the camera's full model; refinement minimises them by
//! Levenberg–Marquardt under a Cauchy loss. For cameras of which the focal length is only guessed, it can be searched for.

use nalgebra::{Matrix3, SVector, Vector2, Vector3, Vector6};

use crate::p3p::p3p;
use crate::ransac::{self, Estimator, RansacOptions, Robust, Score};
use crate::small_lm::{self, LeastSquares, LmOptions, NormalEquations, cauchy};
use crate::{Camera, Rigid3, Seed};

#[cfg(test)]
mod tests;

/// `cam_from_world` of the pose that most correspondences agree with to within `threshold_px`; refined on them.
///
/// `None` when the lengths differ, or no three points give a pose that three agree with. Three always agree with
/// themselves: judge the result by its inliers.
pub fn estimate_absolute_pose(
    x_in_world: &[Vector3<f64>],
    xy_px: &[Vector2<f64>],
    camera: &Camera,
    threshold_px: f64,
    options: &RansacOptions,
    seed: Seed,
) -> Option<Robust<Rigid3>> {
    let poses = Poses::new(x_in_world, xy_px, camera, threshold_px)?;
    ransac::run(&poses, options, seed)
}

/// [`estimate_absolute_pose`] for a camera of which the focal length is a guess that may be off by a factor of two.
///
/// Tries focal lengths in steps of 10 %, each with a share of the samples, then refines pose and focal length (both axes by
/// one factor) together. The camera returned differs from the one given in its focal length only.
pub fn estimate_absolute_pose_and_focal(
    x_in_world: &[Vector3<f64>],
    xy_px: &[Vector2<f64>],
    camera: &Camera,
    threshold_px: f64,
    options: &RansacOptions,
    seed: Seed,
) -> Option<Robust<(Rigid3, Camera)>> {
    const STEPS: i32 = 7;
    const STEP: f64 = 1.1;
    let shorter = RansacOptions {
        max_iterations: (options.max_iterations / 8).max(1),
        min_iterations: options.min_iterations / 4,
        ..*options
    };
    let mut best: Option<(Robust<Rigid3>, Camera)> = None;
    let mut iterations = 0;
    for step in 0..=2 * STEPS {
        // From the guess outwards, so that it wins ties.
        let power = if step % 2 == 0 { step / 2 } else { -(step + 1) / 2 };
        let scaled = with_focal_factor(camera, STEP.powi(power));
        let part = seed.item(&[step as u64]);
        let Some(found) = estimate_absolute_pose(x_in_world, xy_px, &scaled, threshold_px, &shorter, part)
        else {
            continue;
        };
        iterations += found.iterations;
        if best.as_ref().is_none_or(|(robust, _)| found.cost < robust.cost) {
            best = Some((found, scaled));
        }
    }
    let (start, scaled) = best?;
    let mut robust = refined_with_focal(x_in_world, xy_px, threshold_px, (start, scaled))?;
    robust.iterations = iterations;
    Some(robust)
}

/// The pose near `start` that minimises the reprojection error in pixels of the correspondences at `indices`, under a
/// Cauchy loss of this scale. Not worse than the start.
pub fn refine_absolute_pose(
    x_in_world: &[Vector3<f64>],
    xy_px: &[Vector2<f64>],
    camera: &Camera,
    (start, indices): (&Rigid3, &[u32]),
    loss_scale_px: f64,
) -> Rigid3 {
    let problem = PoseProblem { x_in_world, xy_px, camera, indices, loss_scale_px };
    small_lm::minimize(&problem, *start, &LmOptions::default()).0
}

fn with_focal_factor(camera: &Camera, factor: f64) -> Camera {
    let mut scaled = *camera;
    let count = scaled.model.num_focal();
    scaled.params_mut()[..count].iter_mut().for_each(|focal| *focal *= factor);
    scaled
}

/// Alternates joint refinement and selection of inliers, while that helps.
fn refined_with_focal(
    x_in_world: &[Vector3<f64>],
    xy_px: &[Vector2<f64>],
    threshold_px: f64,
    (start, scaled): (Robust<Rigid3>, Camera),
) -> Option<Robust<(Rigid3, Camera)>> {
    const MAX_ROUNDS: usize = 10;
    let iterations = start.iterations;
    let mut best =
        Robust { model: (start.model, scaled), inliers: start.inliers, cost: start.cost, iterations };
    for _ in 0..MAX_ROUNDS {
        let problem = FocalProblem { x_in_world, xy_px, indices: &best.inliers, loss_scale_px: threshold_px };
        let (model, _) = small_lm::minimize(&problem, best.model, &LmOptions::default());
        let poses = Poses::new(x_in_world, xy_px, &model.1, threshold_px)?;
        let cost = poses.score(&model.0, f64::INFINITY).cost;
        if !(cost < best.cost * (1.0 - 1e-9)) {
            break;
        }
        best = Robust { inliers: poses.inliers(&model.0), model, cost, iterations };
    }
    (best.inliers.len() >= 4).then_some(best)
}

/// Camera poses from three correspondences each.
struct Poses<'a> {
    x_in_world: &'a [Vector3<f64>],
    xy_px: &'a [Vector2<f64>],
    camera: &'a Camera,
    /// Unit rays of the pixels; zero where the camera's model can't be inverted, which P3P refuses.
    rays: Vec<Vector3<f64>>,
    threshold_px: f64,
}

impl<'a> Poses<'a> {
    fn new(
        x_in_world: &'a [Vector3<f64>],
        xy_px: &'a [Vector2<f64>],
        camera: &'a Camera,
        threshold_px: f64,
    ) -> Option<Self> {
        if x_in_world.len() != xy_px.len() {
            return None;
        }
        let rays = xy_px.iter().map(|pixel| camera.ray(pixel).unwrap_or_default()).collect();
        Some(Self { x_in_world, xy_px, camera, rays, threshold_px })
    }

    /// The squared reprojection error of a datum, infinite behind the camera.
    fn squared_errors(&self, pose: &Rigid3) -> impl Fn(usize) -> f64 {
        let (rotation, translation) = (pose.rotation_matrix(), pose.translation);
        move |i| {
            let x_in_cam = rotation * self.x_in_world[i] + translation;
            self.camera
                .project(&x_in_cam)
                .map_or(f64::INFINITY, |pixel| (pixel - self.xy_px[i]).norm_squared())
        }
    }
}

impl Estimator for Poses<'_> {
    type Model = Rigid3;

    fn sample_len(&self) -> usize {
        3
    }

    fn data_len(&self) -> usize {
        self.x_in_world.len()
    }

    fn propose(&self, sample: &[usize], models: &mut Vec<Rigid3>) {
        let sample: [usize; 3] = [sample[0], sample[1], sample[2]];
        models.extend(p3p(&sample.map(|i| self.rays[i]), &sample.map(|i| self.x_in_world[i])));
    }

    fn score(&self, model: &Rigid3, stop_at: f64) -> Score {
        let max_squared = self.threshold_px * self.threshold_px;
        ransac::msac(self.data_len(), max_squared, stop_at, self.squared_errors(model))
    }

    fn refine(&self, model: &Rigid3) -> Option<Rigid3> {
        let indices = self.inliers(model);
        if indices.len() < 4 {
            return None;
        }
        let problem = PoseProblem {
            x_in_world: self.x_in_world,
            xy_px: self.xy_px,
            camera: self.camera,
            indices: &indices,
            loss_scale_px: self.threshold_px,
        };
        let options = LmOptions { max_iterations: 8, cost_tolerance: 1e-7, ..Default::default() };
        Some(small_lm::minimize(&problem, *model, &options).0)
    }

    fn inliers(&self, model: &Rigid3) -> Vec<u32> {
        let max_squared = self.threshold_px * self.threshold_px;
        ransac::indices_within(self.data_len(), max_squared, self.squared_errors(model))
    }
}

/// Reprojection errors over a pose; unknowns `(ω, v)` of [`Rigid3::retract_left`].
struct PoseProblem<'a> {
    x_in_world: &'a [Vector3<f64>],
    xy_px: &'a [Vector2<f64>],
    camera: &'a Camera,
    indices: &'a [u32],
    loss_scale_px: f64,
}

impl LeastSquares<6> for PoseProblem<'_> {
    type State = Rigid3;

    fn cost(&self, pose: &Rigid3) -> f64 {
        let (rotation, translation) = (pose.rotation_matrix(), pose.translation);
        let of_datum = |&i: &u32| {
            let x_in_cam = rotation * self.x_in_world[i as usize] + translation;
            let Some(pixel) = self.camera.project(&x_in_cam) else { return f64::INFINITY };
            cauchy((pixel - self.xy_px[i as usize]).norm_squared(), self.loss_scale_px).0
        };
        self.indices.iter().map(of_datum).sum()
    }

    fn linearize(&self, pose: &Rigid3, into: &mut NormalEquations<6>) {
        let (rotation, translation): (Matrix3<f64>, _) = (pose.rotation_matrix(), pose.translation);
        for &i in self.indices {
            let x = rotation * self.x_in_world[i as usize] + translation;
            let Some((pixel, d_point)) = self.camera.project_with_point_jacobian(&x) else { continue };
            let residual = pixel - self.xy_px[i as usize];
            let weight = cauchy(residual.norm_squared(), self.loss_scale_px).1;
            for axis in 0..2 {
                let row = pose_row(&x, &[d_point[(axis, 0)], d_point[(axis, 1)], d_point[(axis, 2)]]);
                into.add(weight, residual[axis], &row);
            }
        }
    }

    fn retract(&self, pose: &Rigid3, step: &Vector6<f64>) -> Rigid3 {
        pose.retract_left(step)
    }
}

/// The derivative in `(ω, v)` of a function of `x_in_cam` whose derivative is `d`: `d [-[x]ₓ | I]`.
#[inline]
fn pose_row(x: &Vector3<f64>, d: &[f64; 3]) -> [f64; 6] {
    [d[2] * x.y - d[1] * x.z, d[0] * x.z - d[2] * x.x, d[1] * x.x - d[0] * x.y, d[0], d[1], d[2]]
}

/// Reprojection errors over a pose and the logarithm of a factor on the focal length.
struct FocalProblem<'a> {
    x_in_world: &'a [Vector3<f64>],
    xy_px: &'a [Vector2<f64>],
    indices: &'a [u32],
    loss_scale_px: f64,
}

impl LeastSquares<7> for FocalProblem<'_> {
    type State = (Rigid3, Camera);

    fn cost(&self, (pose, camera): &Self::State) -> f64 {
        let Self { x_in_world, xy_px, indices, loss_scale_px } = *self;
        PoseProblem { x_in_world, xy_px, camera, indices, loss_scale_px }.cost(pose)
    }

    fn linearize(&self, (pose, camera): &Self::State, into: &mut NormalEquations<7>) {
        let principal_point = camera.principal_point_px();
        for &i in self.indices {
            let x = pose.transform_point(&self.x_in_world[i as usize]);
            let Some((pixel, d_point)) = camera.project_with_point_jacobian(&x) else { continue };
            let residual = pixel - self.xy_px[i as usize];
            let weight = cauchy(residual.norm_squared(), self.loss_scale_px).1;
            for axis in 0..2 {
                let of_pose = pose_row(&x, &[d_point[(axis, 0)], d_point[(axis, 1)], d_point[(axis, 2)]]);
                let mut row = [0.0; 7];
                row[..6].copy_from_slice(&of_pose);
                row[6] = pixel[axis] - principal_point[axis];
                into.add(weight, residual[axis], &row);
            }
        }
    }

    fn retract(&self, (pose, camera): &Self::State, step: &SVector<f64, 7>) -> Self::State {
        let moved = pose.retract_left(&step.fixed_rows::<6>(0).into_owned());
        (moved, with_focal_factor(camera, step[6].exp()))
    }
}
