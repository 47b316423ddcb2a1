//! Between the model and the solver: which poses, intrinsics and points an adjustment moves, as arrays and back.

use std::collections::BTreeMap;

use terrane_geometry::{Camera, CameraModel};
use terrane_optim::bundle::{
    self, BundleObservation, BundleOptions, BundleProblem, BundleReport, BundleShard, InMemoryShards,
    RefineIntrinsics,
};
use terrane_scene::FocalSource;

use crate::error::Kind;
use crate::model::{Model, PointId};
use crate::{AdjustmentOptions, MappingError};

/// Points of one shard: the solver is parallel within a shard, and a cluster has few.
const SHARD_POINTS: usize = 32_768;

/// What an adjustment moves.
pub(crate) struct Scope {
    /// Images whose poses move, ascending.
    pub images: Vec<usize>,
    /// Points that move, with all their observations; poses that see them and are not in `images` are held.
    pub points: Vec<PointId>,
    /// Points that are held, seen from the images that move: they tie these to the rest of the model.
    pub anchors: Vec<PointId>,
    /// Which parameters of cameras move, where the user did not give them and they are not frozen.
    pub refine: RefineIntrinsics,
}

impl Scope {
    /// Everything.
    pub fn whole(model: &Model<'_>, refine: RefineIntrinsics) -> Self {
        Self { images: model.registered(), points: model.point_ids(), anchors: Vec::new(), refine }
    }

    /// The neighbourhood of an image: those that share most points with it move, with the points that it sees.
    pub fn around(model: &Model<'_>, image: usize, num_images: usize) -> Self {
        let points = model.points_of_image(image);
        let mut shared: BTreeMap<usize, u32> = BTreeMap::new();
        for point in points.iter().filter_map(|&id| model.point(id)) {
            for &feature in &point.track {
                *shared.entry(model.cluster.image_of(feature)).or_default() += 1;
            }
        }
        shared.remove(&image);
        let mut neighbours: Vec<(usize, u32)> = shared.into_iter().collect();
        neighbours.sort_by_key(|entry| std::cmp::Reverse(entry.1));
        let mut images = vec![image];
        images.extend(neighbours.iter().take(num_images.saturating_sub(1)).map(|entry| entry.0));
        images.sort_unstable();
        let mut anchors: Vec<PointId> = images
            .iter()
            .filter(|&&other| other != image)
            .flat_map(|&other| model.points_of_image(other))
            .collect();
        anchors.sort_unstable();
        anchors.dedup();
        anchors.retain(|id| points.binary_search(id).is_err());
        Self { images, points, anchors, refine: RefineIntrinsics::NONE }
    }
}

/// Adjusts the part of the model that the scope names.
pub(crate) fn adjust(
    model: &mut Model<'_>,
    scope: &Scope,
    options: &BundleOptions,
) -> Result<BundleReport, MappingError> {
    let mut arrays = Arrays::new(model, scope);
    let report = bundle::solve(&mut arrays.problem, &mut arrays.shards, options)
        .map_err(|error| Kind::Adjustment { cluster: model.cluster.id, message: error.to_string() })?;
    arrays.write_back(model, scope);
    Ok(report)
}

/// The scope as the solver sees it.
struct Arrays {
    problem: BundleProblem,
    shards: InMemoryShards,
    /// Image of each pose.
    image_of_pose: Vec<usize>,
    /// Camera of each of the intrinsics.
    camera_of_intrinsics: Vec<usize>,
    /// Place of each image among the poses.
    pose_of_image: Vec<Option<u32>>,
    /// Place of each camera among the intrinsics.
    intrinsics_of_camera: Vec<Option<u32>>,
}

impl Arrays {
    fn new(model: &Model<'_>, scope: &Scope) -> Self {
        let mut arrays = Self {
            problem: BundleProblem::default(),
            shards: InMemoryShards::default(),
            image_of_pose: Vec::new(),
            camera_of_intrinsics: Vec::new(),
            pose_of_image: vec![None; model.cluster.num_images()],
            intrinsics_of_camera: vec![None; model.cameras.len()],
        };
        for &image in &scope.images {
            arrays.add_pose(model, image, false, scope.refine);
        }
        for ids in scope.points.chunks(SHARD_POINTS) {
            let mut shard = BundleShard::default();
            for point in ids.iter().filter_map(|&id| model.point(id)) {
                for &feature in &point.track {
                    let pose = arrays.add_pose(model, model.cluster.image_of(feature), true, scope.refine);
                    push_observation(&mut shard, model, feature, pose);
                }
                shard.points.push(point.x_in_world);
            }
            arrays.shards.0.push(shard);
        }
        for ids in scope.anchors.chunks(SHARD_POINTS) {
            let mut shard = BundleShard { fixed_points: true, ..BundleShard::default() };
            for point in ids.iter().filter_map(|&id| model.point(id)) {
                for &feature in &point.track {
                    let pose = arrays.pose_of_image[model.cluster.image_of(feature)];
                    let pose = pose.filter(|&pose| !arrays.problem.fixed_poses[pose as usize]);
                    push_observation(&mut shard, model, feature, pose);
                }
                shard.points.push(point.x_in_world);
            }
            arrays.shards.0.push(shard);
        }
        arrays
    }

    /// The place of an image's pose, which is added when it is new.
    fn add_pose(
        &mut self,
        model: &Model<'_>,
        image: usize,
        fixed: bool,
        refine: RefineIntrinsics,
    ) -> Option<u32> {
        if let Some(pose) = self.pose_of_image[image] {
            return Some(pose);
        }
        let cam_from_world = model.poses[image]?;
        let camera = model.cluster.camera_of[image];
        let intrinsics = match self.intrinsics_of_camera[camera] {
            Some(intrinsics) => intrinsics,
            None => {
                let intrinsics = self.problem.intrinsics.len() as u32;
                self.intrinsics_of_camera[camera] = Some(intrinsics);
                self.camera_of_intrinsics.push(camera);
                self.problem.intrinsics.push(model.cameras[camera]);
                let given = model.cluster.cameras[camera].1.focal_source == FocalSource::Given;
                let held = given || model.frozen[camera];
                self.problem.refine.push(if held { RefineIntrinsics::NONE } else { refine });
                intrinsics
            }
        };
        let pose = self.problem.poses.len() as u32;
        self.pose_of_image[image] = Some(pose);
        self.image_of_pose.push(image);
        self.problem.poses.push(cam_from_world);
        self.problem.fixed_poses.push(fixed);
        self.problem.intrinsics_of_pose.push(intrinsics);
        Some(pose)
    }

    fn write_back(self, model: &mut Model<'_>, scope: &Scope) {
        for (pose, &image) in self.image_of_pose.iter().enumerate() {
            if !self.problem.fixed_poses[pose] {
                model.poses[image] = Some(self.problem.poses[pose]);
            }
        }
        for (intrinsics, &camera) in self.camera_of_intrinsics.iter().enumerate() {
            model.cameras[camera] = self.problem.intrinsics[intrinsics];
        }
        let ids = scope.points.iter().copied().filter(|&id| model.point(id).is_some()).collect::<Vec<_>>();
        let positions =
            self.shards.0.iter().filter(|shard| !shard.fixed_points).flat_map(|shard| &shard.points);
        for (id, x_in_world) in ids.into_iter().zip(positions) {
            model.set_position(id, *x_in_world);
        }
    }
}

fn push_observation(shard: &mut BundleShard, model: &Model<'_>, feature: u32, pose: Option<u32>) {
    if let Some(pose) = pose {
        let point = shard.points.len() as u32;
        shard.observations.push(BundleObservation { pose, point, xy_px: model.cluster.xy_px_f32(feature) });
    }
}

/// Whether intrinsics are such as a camera can have.
pub(crate) fn is_sane(camera: &Camera, options: &AdjustmentOptions) -> bool {
    let longer_px = f64::from(camera.width_px.max(camera.height_px));
    let focal_px = camera.focal_px();
    let ratio_holds = focal_px.iter().all(|focal_px| {
        let ratio = focal_px / longer_px;
        ratio >= options.min_focal_ratio && ratio <= options.max_focal_ratio
    });
    let center = camera.principal_point_px();
    let inside = center.x >= 0.0
        && center.y >= 0.0
        && center.x <= f64::from(camera.width_px)
        && center.y <= f64::from(camera.height_px);
    // What follows the principal point of these two is no polynomial's coefficient.
    let free_form = matches!(camera.model, CameraModel::Fov | CameraModel::Eucm);
    let mild = free_form || camera.distortion().iter().all(|k| k.abs() <= options.max_distortion);
    ratio_holds && inside && mild
}
