//! The growing model: poses, intrinsics, points and which feature belongs to which point.

use std::num::NonZeroU32;

use nalgebra::Vector3;
use smallvec::SmallVec;
use terrane_geometry::{Camera, Rigid3, Sim3};

use crate::cluster::Cluster;
use crate::visibility::Visibility;

/// A point's slot in the model: its place plus one, so that an absent point costs no room.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct PointId(NonZeroU32);

impl PointId {
    fn new(slot: usize) -> Option<Self> {
        u32::try_from(slot + 1).ok().and_then(NonZeroU32::new).map(Self)
    }

    fn slot(self) -> usize {
        self.0.get() as usize - 1
    }
}

/// The features of one point, ascending, at most one of an image.
pub(crate) type Track = SmallVec<[u32; 6]>;

/// A point of the model.
#[derive(Clone, Debug)]
pub(crate) struct Point {
    /// Position.
    pub x_in_world: Vector3<f64>,
    /// Its features.
    pub track: Track,
}

/// Where everything of a model is.
pub(crate) struct Geometry {
    cameras: Vec<Camera>,
    poses: Vec<Option<Rigid3>>,
    positions: Vec<(PointId, Vector3<f64>)>,
}

/// One submap as it grows.
#[derive(Clone)]
pub(crate) struct Model<'a> {
    /// What it grows from.
    pub cluster: &'a Cluster<'a>,
    /// Intrinsics by camera ordinal.
    pub cameras: Vec<Camera>,
    /// Cameras whose intrinsics are not refined any more.
    pub frozen: Vec<bool>,
    /// Cameras whose focal length is a mere guess.
    pub guessed: Vec<bool>,
    /// `cam_from_world` of each image that is registered.
    pub poses: Vec<Option<Rigid3>>,
    /// What each image sees of it.
    pub visibility: Visibility,
    points: Vec<Option<Point>>,
    point_of: Vec<Option<PointId>>,
    observations_of: Vec<u32>,
    num_points: usize,
    num_observations: usize,
    touched: Vec<PointId>,
}

impl<'a> Model<'a> {
    /// An empty model with these intrinsics.
    pub fn new(cluster: &'a Cluster<'a>, cameras: Vec<Camera>, guessed: Vec<bool>) -> Self {
        let num_images = cluster.num_images();
        Self {
            cluster,
            frozen: vec![false; cameras.len()],
            cameras,
            guessed,
            poses: vec![None; num_images],
            visibility: Visibility::new(cluster),
            points: Vec::new(),
            point_of: vec![None; cluster.num_features()],
            observations_of: vec![0; num_images],
            num_points: 0,
            num_observations: 0,
            touched: Vec::new(),
        }
    }

    /// Whether an image is registered.
    pub fn is_registered(&self, image: usize) -> bool {
        self.poses[image].is_some()
    }

    /// Registered images, ascending.
    pub fn registered(&self) -> Vec<usize> {
        (0..self.poses.len()).filter(|&image| self.is_registered(image)).collect()
    }

    /// How many images are registered.
    pub fn num_registered(&self) -> usize {
        self.poses.iter().flatten().count()
    }

    /// How many points there are.
    pub fn num_points(&self) -> usize {
        self.num_points
    }

    /// How many observations all points have.
    pub fn num_observations(&self) -> usize {
        self.num_observations
    }

    /// How many points an image observes.
    pub fn num_observed(&self, image: usize) -> u32 {
        self.observations_of[image]
    }

    /// The camera of an image.
    pub fn camera_of(&self, image: usize) -> &Camera {
        &self.cameras[self.cluster.camera_of[image]]
    }

    /// The point of a feature.
    pub fn point_of(&self, feature: u32) -> Option<PointId> {
        self.point_of[feature as usize]
    }

    /// A point, or `None` when it was removed.
    pub fn point(&self, id: PointId) -> Option<&Point> {
        self.points[id.slot()].as_ref()
    }

    /// Every point, in order of creation.
    pub fn points(&self) -> impl Iterator<Item = (PointId, &Point)> {
        self.points
            .iter()
            .enumerate()
            .filter_map(|(slot, point)| Some((PointId::new(slot)?, point.as_ref()?)))
    }

    /// The ids of all points.
    pub fn point_ids(&self) -> Vec<PointId> {
        self.points().map(|(id, _)| id).collect()
    }

    /// The points that an image observes, without repetition, ascending.
    pub fn points_of_image(&self, image: usize) -> Vec<PointId> {
        let mut ids: Vec<_> =
            self.cluster.features_of(image).filter_map(|feature| self.point_of(feature)).collect();
        ids.sort_unstable();
        ids
    }

    /// Whether a point has an observation in an image.
    pub fn observes(&self, id: PointId, image: usize) -> bool {
        let features = self.cluster.features_of(image);
        self.point(id).is_some_and(|point| {
            let at = point.track.partition_point(|&feature| feature < features.start);
            point.track.get(at).is_some_and(|&feature| feature < features.end)
        })
    }

    /// Adds a point. Features that already have a point, or share an image with an earlier one, are passed over; with
    /// fewer than two left nothing is added.
    pub fn add_point(&mut self, x_in_world: Vector3<f64>, features: &[u32]) -> Option<PointId> {
        let mut track: Track = features.iter().copied().filter(|&f| self.point_of(f).is_none()).collect();
        track.sort_unstable();
        track.dedup_by_key(|feature| self.cluster.image_of(*feature));
        if track.len() < 2 {
            return None;
        }
        let id = PointId::new(self.points.len())?;
        for &feature in &track {
            self.link(feature, id);
        }
        self.points.push(Some(Point { x_in_world, track }));
        self.num_points += 1;
        self.touched.push(id);
        Some(id)
    }

    /// Adds an observation to a point, unless the feature has a point or the point's image has another feature.
    pub fn add_observation(&mut self, id: PointId, feature: u32) -> bool {
        if self.point_of(feature).is_some() || self.observes(id, self.cluster.image_of(feature)) {
            return false;
        }
        let Some(point) = self.points[id.slot()].as_mut() else { return false };
        let at = point.track.partition_point(|&other| other < feature);
        point.track.insert(at, feature);
        self.link(feature, id);
        self.touched.push(id);
        true
    }

    /// Removes a feature from its point; a point with a single observation goes with it.
    pub fn remove_observation(&mut self, feature: u32) {
        let Some(id) = self.point_of(feature) else { return };
        let Some(point) = self.points[id.slot()].as_mut() else { return };
        if point.track.len() <= 2 {
            self.remove_point(id);
        } else {
            point.track.retain(|other| *other != feature);
            self.unlink(feature);
        }
    }

    /// Removes a point with all its observations.
    pub fn remove_point(&mut self, id: PointId) {
        if let Some(point) = self.points[id.slot()].take() {
            self.num_points -= 1;
            for feature in point.track {
                self.unlink(feature);
            }
        }
    }

    /// Moves a point.
    pub fn set_position(&mut self, id: PointId, x_in_world: Vector3<f64>) {
        if let Some(point) = self.points[id.slot()].as_mut() {
            point.x_in_world = x_in_world;
        }
    }

    /// Registers an image.
    pub fn set_pose(&mut self, image: usize, cam_from_world: Rigid3) {
        self.poses[image] = Some(cam_from_world);
        self.guessed[self.cluster.camera_of[image]] = false;
    }

    /// Removes an image and its observations.
    pub fn deregister(&mut self, image: usize) {
        for feature in self.cluster.features_of(image) {
            self.remove_observation(feature);
        }
        self.poses[image] = None;
    }

    /// Points that were added or got an observation since the last call, ascending, those that are gone left out.
    pub fn take_touched(&mut self) -> Vec<PointId> {
        let mut touched = std::mem::take(&mut self.touched);
        touched.sort_unstable();
        touched.dedup();
        touched.retain(|id| self.point(*id).is_some());
        touched
    }

    /// Reprojection error of a feature for a position, in pixels; `None` behind the camera or for an unregistered image.
    pub fn error_px(&self, x_in_world: &Vector3<f64>, feature: u32) -> Option<f64> {
        let image = self.cluster.image_of(feature);
        let pose = self.poses[image].as_ref()?;
        let xy_px = self.camera_of(image).project(&pose.transform_point(x_in_world))?;
        let error_px = (xy_px - self.cluster.xy_px(feature)).norm();
        error_px.is_finite().then_some(error_px)
    }

    /// Moves the model so that its camera centres have their centroid at the origin and extent of ten: numbers near one
    /// keep solvers well conditioned however far the model has grown.
    pub fn normalise(&mut self) {
        let centers: Vec<_> = self.poses.iter().flatten().map(Rigid3::center).collect();
        if centers.len() < 2 {
            return;
        }
        let centroid = centers.iter().sum::<Vector3<f64>>() / centers.len() as f64;
        let extent = centers.iter().map(|center| (center - centroid).norm()).fold(0.0, f64::max);
        if !(extent.is_finite() && extent > 0.0) {
            return;
        }
        let scale = 10.0 / (2.0 * extent);
        let new_from_old = Sim3::new(scale, nalgebra::UnitQuaternion::identity(), -scale * centroid);
        for pose in self.poses.iter_mut().flatten() {
            *pose = new_from_old.transform_camera(pose);
        }
        for point in self.points.iter_mut().flatten() {
            point.x_in_world = new_from_old.transform_point(&point.x_in_world);
        }
    }

    /// Intrinsics, poses and positions, to go back to while the same points are there.
    pub fn clone_geometry(&self) -> Geometry {
        let positions = self.points().map(|(id, point)| (id, point.x_in_world)).collect();
        Geometry { cameras: self.cameras.clone(), poses: self.poses.clone(), positions }
    }

    /// Goes back to earlier intrinsics, poses and positions.
    pub fn restore_geometry(&mut self, geometry: &Geometry) {
        self.cameras.clone_from(&geometry.cameras);
        self.poses.clone_from(&geometry.poses);
        for (id, x_in_world) in &geometry.positions {
            self.set_position(*id, *x_in_world);
        }
    }

    fn link(&mut self, feature: u32, id: PointId) {
        self.point_of[feature as usize] = Some(id);
        self.observations_of[self.cluster.image_of(feature)] += 1;
        self.num_observations += 1;
        self.visibility.add(self.cluster, feature);
    }

    fn unlink(&mut self, feature: u32) {
        self.point_of[feature as usize] = None;
        self.observations_of[self.cluster.image_of(feature)] -= 1;
        self.num_observations -= 1;
        self.visibility.remove(self.cluster, feature);
    }
}
