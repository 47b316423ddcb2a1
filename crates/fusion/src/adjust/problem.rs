//! Scenes as the arrays that bundle adjustment works on.

use std::borrow::Cow;

use nalgebra::Vector3;
use terrane_geometry::Rigid3;
use terrane_optim::bundle::{
    BundleObservation, BundleProblem, BundleShard, PositionPrior, RefineIntrinsics, ShardError, Shards,
};
use terrane_scene::{CameraId, ImageId, RegisteredImage};

use super::{AdjustInput, MergedShards};
use crate::georegister::{GeoOptions, LocalPosition, residuals};
use crate::merge::{MergedCameras, MergedShard};
use crate::statistics::median;

/// A camera with fewer images keeps its intrinsics: one view can't tell focal length from distance.
const MIN_IMAGES_TO_REFINE: usize = 3;

/// Places of images in the pose array, by image id.
pub(super) struct PoseIndex(Vec<Option<u32>>);

impl PoseIndex {
    pub(super) fn new(images: &[RegisteredImage]) -> Self {
        let len = images.last().map_or(0, |image| image.image.index() + 1);
        let mut places = vec![None; len];
        for (at, image) in images.iter().enumerate() {
            places[image.image.index()] = Some(at as u32);
        }
        Self(places)
    }

    pub(super) fn of(&self, image: ImageId) -> Option<u32> {
        self.0.get(image.index()).copied().flatten()
    }
}

/// The cameras as a problem: poses in the order of `images`, intrinsics in the order of `cameras`; images whose
/// camera is not there are held at the first intrinsics and must own no observations.
pub(super) fn camera_problem(cameras: &MergedCameras, fixed_intrinsics: &[CameraId]) -> BundleProblem {
    let poses: Vec<Rigid3> = cameras.images.iter().map(|image| image.cam_from_world).collect();
    let place =
        |camera: CameraId| cameras.cameras.binary_search_by_key(&camera, |entry| entry.0).unwrap_or(0);
    let intrinsics_of_pose: Vec<u32> =
        cameras.images.iter().map(|image| place(image.camera) as u32).collect();
    let intrinsics = cameras.cameras.iter().map(|entry| entry.1).collect();
    let mut problem =
        BundleProblem::new(poses, intrinsics, intrinsics_of_pose, RefineIntrinsics::FOCAL_AND_DISTORTION);
    let mut uses = vec![0; cameras.cameras.len()];
    problem.intrinsics_of_pose.iter().for_each(|at| uses[*at as usize] += 1);
    for (at, (id, _)) in cameras.cameras.iter().enumerate() {
        if uses[at] < MIN_IMAGES_TO_REFINE || fixed_intrinsics.binary_search(id).is_ok() {
            problem.refine[at] = RefineIntrinsics::NONE;
        }
    }
    problem
}

/// Takes the adjusted poses and intrinsics over.
pub(super) fn take_over(problem: &BundleProblem, cameras: &mut MergedCameras) {
    for (image, pose) in cameras.images.iter_mut().zip(&problem.poses) {
        image.cam_from_world = *pose;
    }
    for (entry, camera) in cameras.cameras.iter_mut().zip(&problem.intrinsics) {
        entry.1 = *camera;
    }
}

/// Satellite positions as weak priors in units of reprojection error: outliers left out, standard deviations no
/// smaller than the residuals show, and divided by that of a feature, as observations count in pixels.
pub(super) fn position_priors(
    images: &[RegisteredImage],
    positions: &[LocalPosition],
    feature_sigma_px: f64,
) -> Vec<PositionPrior> {
    let report = residuals(images, positions, &GeoOptions::default());
    if report.num_inliers < 3 {
        return Vec::new();
    }
    let mut lengths: Vec<f64> = report
        .residuals
        .iter()
        .filter(|residual| residual.inlier)
        .filter_map(|residual| {
            let at = positions.binary_search_by_key(&residual.image, |position| position.image).ok()?;
            Some(residual.residual_m.component_div(&positions[at].sigma_m).norm())
        })
        .collect();
    // The median length of three unit normals is 1.54.
    let widening = (median(&mut lengths).unwrap_or(0.0) / 1.54).max(1.0) / feature_sigma_px;
    let index = PoseIndex::new(images);
    let prior = |residual: &crate::georegister::GeoResidual| {
        let at = positions.binary_search_by_key(&residual.image, |position| position.image).ok()?;
        Some(PositionPrior {
            pose: index.of(residual.image)?,
            center_in_world: positions[at].x_in_enu,
            sigma_m: widening * positions[at].sigma_m,
            bias: None,
        })
    };
    report.residuals.iter().filter(|residual| residual.inlier).filter_map(prior).collect()
}

/// The positions that take part, as priors for a problem of the whole.
pub(super) fn priors_for(
    cameras: &MergedCameras,
    input: &AdjustInput<'_>,
    mean_error_px: f64,
) -> Vec<PositionPrior> {
    // The mean length of a two-dimensional normal vector is 1.25 standard deviations.
    let feature_sigma_px = (mean_error_px / 1.25).clamp(0.1, 2.0);
    position_priors(&cameras.images, input.positions, feature_sigma_px)
}

/// The caller's shards in the form that bundle adjustment loads.
pub(super) struct AdjustShards<'a> {
    pub(super) inner: &'a mut dyn MergedShards,
    pub(super) index: &'a PoseIndex,
}

impl Shards for AdjustShards<'_> {
    fn len(&self) -> usize {
        self.inner.len()
    }

    fn load(&self, shard: usize) -> Result<Cow<'_, BundleShard>, ShardError> {
        let merged = self.inner.load(shard).map_err(|error| failed(shard, error))?;
        let mut observations = Vec::with_capacity(merged.observations.len());
        for (at, point) in merged.points.iter().enumerate() {
            for seen in merged.track(point) {
                if let Some(pose) = self.index.of(seen.image) {
                    let (point, xy_px) = (at as u32, [seen.x_px, seen.y_px]);
                    observations.push(BundleObservation { pose, point, xy_px });
                }
            }
        }
        let points = merged.points.iter().map(|point| point.x_in_world).collect();
        Ok(Cow::Owned(BundleShard { points, fixed_points: false, observations }))
    }

    fn store_points(&mut self, shard: usize, points: &[Vector3<f64>]) -> Result<(), ShardError> {
        let mut merged: MergedShard =
            self.inner.load(shard).map_err(|error| failed(shard, error))?.into_owned();
        for (point, x_in_world) in merged.points.iter_mut().zip(points) {
            point.x_in_world = *x_in_world;
        }
        self.inner.store(shard, merged).map_err(|error| failed(shard, error))
    }
}

fn failed(shard: usize, error: crate::FusionError) -> ShardError {
    ShardError { shard, reason: error.to_string(), source: Some(Box::new(error)) }
}
