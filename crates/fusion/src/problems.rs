//! Whole problems that people bring, as the arrays of bundle adjustment, and back: BAL files and sparse models.

use nalgebra::{Rotation3, UnitQuaternion, Vector2, Vector3};
use terrane_geometry::{Camera, CameraModel, Rigid3};
use terrane_optim::bundle::{
    BehindCamera, BundleObservation, BundleProblem, BundleShard, InMemoryShards, RefineIntrinsics,
};
use terrane_scene::Reconstruction;
use terrane_scene::bal::BalProblem;

use crate::FusionError;

/// A problem with all its points in one shard.
pub struct WholeProblem {
    /// The camera side.
    pub problem: BundleProblem,
    /// One shard, its points in the order of the source.
    pub shards: InMemoryShards,
    /// Whether the source's cost counts points behind their cameras.
    pub behind_camera: BehindCamera,
}

/// Half a turn about x: from a camera that looks down −z with y up to one that looks down z with y down.
fn half_turn() -> UnitQuaternion<f64> {
    UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI)
}

/// Reads a BAL file; see [`from_bal`].
///
/// # Errors
/// When the file is broken ([`terrane_scene::bal::read`]) or a focal length is not positive.
pub fn read_bal(file: impl std::io::BufRead) -> Result<WholeProblem, FusionError> {
    from_bal(terrane_scene::bal::read(file).map_err(|error| FusionError::invalid("the BAL problem", error))?)
}

/// A BAL problem: each camera its own RADIAL intrinsics, of which the principal point is held at the origin. Image points
/// have y down. The format's cost does not look at the sign of depths, and so points behind cameras count.
///
/// # Errors
/// When a focal length is not positive.
pub fn from_bal(bal: BalProblem) -> Result<WholeProblem, FusionError> {
    let BalProblem { cameras, points, observations } = bal;
    let turn = half_turn();
    let mut poses = Vec::with_capacity(cameras.len());
    let mut intrinsics = Vec::with_capacity(cameras.len());
    for (index, c) in cameras.iter().enumerate() {
        let rotation = turn * UnitQuaternion::from_scaled_axis(Vector3::new(c[0], c[1], c[2]));
        poses.push(Rigid3::new(rotation, Vector3::new(c[3], -c[4], -c[5])));
        let camera = Camera::new(CameraModel::Radial, 1, 1, &[c[6], 0.0, 0.0, c[7], c[8]]);
        let camera = camera.filter(|_| c[6] > 0.0).ok_or_else(|| {
            let reason = format!("camera {index} has a focal length of {}: it must be positive", c[6]);
            FusionError::invalid("the BAL problem", reason)
        })?;
        intrinsics.push(camera);
    }
    let of_pose = (0..cameras.len() as u32).collect();
    let problem = BundleProblem::new(poses, intrinsics, of_pose, RefineIntrinsics::FOCAL_AND_DISTORTION);
    let mut shard = BundleShard {
        points: points.into_iter().map(Vector3::from).collect(),
        fixed_points: false,
        observations: observations
            .into_iter()
            .map(|o| BundleObservation { pose: o.camera, point: o.point, xy_px: [o.xy_px[0], -o.xy_px[1]] })
            .collect(),
    };
    shard.observations.sort_unstable_by_key(|o| (o.point, o.pose, o.xy_px.map(f32::to_bits)));
    Ok(WholeProblem { problem, shards: InMemoryShards(vec![shard]), behind_camera: BehindCamera::Mirror })
}

/// The parameters of a BAL file after an adjustment.
pub fn to_bal(whole: &WholeProblem) -> (Vec<[f64; 9]>, Vec<[f64; 3]>) {
    let turn = half_turn().inverse();
    let cameras = whole.problem.poses.iter().zip(&whole.problem.intrinsics).map(|(pose, camera)| {
        let rotation = (turn * pose.rotation).scaled_axis();
        let (t, k) = (pose.translation, camera.distortion());
        [rotation.x, rotation.y, rotation.z, t.x, -t.y, -t.z, camera.mean_focal_px(), k[0], k[1]]
    });
    let points = whole.shards.0.iter().flat_map(|shard| &shard.points);
    (cameras.collect(), points.map(|x| [x.x, x.y, x.z]).collect())
}

/// A sparse model: intrinsics shared as in the model, refined as asked.
///
/// # Errors
/// When an observation names an image that has no pose.
pub fn from_model(model: &Reconstruction, refine: RefineIntrinsics) -> Result<WholeProblem, FusionError> {
    let poses = model.images.iter().map(|image| image.cam_from_world).collect();
    let place = |id| model.cameras.binary_search_by_key(&id, |entry: &(_, Camera)| entry.0);
    let mut of_pose = Vec::with_capacity(model.images.len());
    for image in &model.images {
        let at = place(image.camera).map_err(|_| {
            let reason =
                format!("image {} was taken by camera {}, which is not there", image.image, image.camera);
            FusionError::invalid("the model", reason)
        })?;
        of_pose.push(at as u32);
    }
    let intrinsics = model.cameras.iter().map(|entry| entry.1).collect();
    let mut observations = Vec::with_capacity(model.observations.len());
    for (index, point) in model.points.iter().enumerate() {
        let first = point.first_observation as usize;
        for seen in &model.observations[first..first + point.num_observations as usize] {
            let pose = model.position_of(seen.image).ok_or_else(|| {
                let reason =
                    format!("point {} is seen by image {}, which has no pose", index + 1, seen.image);
                FusionError::invalid("the model", reason)
            })?;
            let xy_px = [seen.x_px, seen.y_px];
            observations.push(BundleObservation { pose: pose as u32, point: index as u32, xy_px });
        }
    }
    let points = model.points.iter().map(|point| point.x_in_world).collect();
    let shard = BundleShard { points, fixed_points: false, observations };
    let problem = BundleProblem::new(poses, intrinsics, of_pose, refine);
    Ok(WholeProblem { problem, shards: InMemoryShards(vec![shard]), behind_camera: BehindCamera::LeaveOut })
}

/// Takes adjusted cameras and points over into the model that they came from.
pub fn into_model(whole: &WholeProblem, model: &mut Reconstruction) {
    for (image, pose) in model.images.iter_mut().zip(&whole.problem.poses) {
        image.cam_from_world = *pose;
    }
    for (entry, camera) in model.cameras.iter_mut().zip(&whole.problem.intrinsics) {
        entry.1 = *camera;
    }
    let points = whole.shards.0.iter().flat_map(|shard| &shard.points);
    for (point, x_in_world) in model.points.iter_mut().zip(points) {
        point.x_in_world = *x_in_world;
    }
}

/// Sums over the observations that can be projected.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ResidualFigures {
    /// Observations in front of their camera.
    pub observations: u64,
    /// Observations that can't be projected: behind the camera or outside its domain.
    pub not_projected: u64,
    /// Half the sum of squared reprojection errors, square pixels.
    pub squared_cost: f64,
    /// Sum of reprojection errors, pixels.
    pub sum_error_px: f64,
}

impl ResidualFigures {
    /// Over all observations of a problem.
    pub fn of(whole: &WholeProblem) -> Self {
        let mut figures = Self::default();
        let problem = &whole.problem;
        let rotations: Vec<Rotation3<f64>> =
            problem.poses.iter().map(|p| p.rotation.to_rotation_matrix()).collect();
        for shard in &whole.shards.0 {
            for o in &shard.observations {
                let pose = o.pose as usize;
                let x = rotations[pose] * shard.points[o.point as usize] + problem.poses[pose].translation;
                let camera = &problem.intrinsics[problem.intrinsics_of_pose[pose] as usize];
                let x = if whole.behind_camera.mirrors(camera, &x) { -x } else { x };
                let Some(xy) = camera.project(&x).filter(|xy| xy.iter().all(|v| v.is_finite())) else {
                    figures.not_projected += 1;
                    continue;
                };
                let observed = Vector2::new(f64::from(o.xy_px[0]), f64::from(o.xy_px[1]));
                let error = camera.residual_px(&xy, &observed).norm();
                figures.observations += 1;
                figures.squared_cost += 0.5 * error * error;
                figures.sum_error_px += error;
            }
        }
        figures
    }

    /// Mean reprojection error in pixels.
    pub fn mean_error_px(&self) -> f64 {
        if self.observations == 0 { 0.0 } else { self.sum_error_px / self.observations as f64 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use terrane_scene::bal::BalObservation;

    #[test]
    fn bal_cameras_turn_round_and_back() {
        let c = [0.3, -1.2, 0.4, 1.0, -2.0, -9.0, 500.0, -0.05, 0.01];
        let x = Vector3::new(0.4, 0.3, -0.7);
        // The format's own projection, with y up.
        let p = Rotation3::new(Vector3::new(c[0], c[1], c[2])) * x + Vector3::new(c[3], c[4], c[5]);
        let (u, v) = (-p.x / p.z, -p.y / p.z);
        let r2 = u * u + v * v;
        let scale = c[6] * (1.0 + c[7] * r2 + c[8] * r2 * r2);
        let observation =
            BalObservation { camera: 0, point: 0, xy_px: [(scale * u) as f32, (scale * v) as f32] };
        let bal = BalProblem { cameras: vec![c], points: vec![x.into()], observations: vec![observation] };
        let whole = from_bal(bal).unwrap();
        let figures = ResidualFigures::of(&whole);
        assert_eq!((figures.observations, figures.not_projected), (1, 0));
        assert!(figures.sum_error_px < 1e-4, "{figures:?}");
        let (cameras, points) = to_bal(&whole);
        for (got, expected) in cameras[0].iter().zip(&c) {
            assert!((got - expected).abs() < 1e-12 * (1.0 + expected.abs()), "{got} {expected}");
        }
        assert_eq!(points, [[0.4, 0.3, -0.7]]);
    }
}
