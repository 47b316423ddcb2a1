//! Cameras with poses and points with tracks, in one frame.

use bytemuck::{Pod, Zeroable};
use nalgebra::{Vector2, Vector3};
use terrane_geometry::{Camera, Rigid3, Sim3};

use crate::{CameraId, ImageId};

/// A photograph with its pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RegisteredImage {
    /// Which photograph.
    pub image: ImageId,
    /// The camera that took it.
    pub camera: CameraId,
    /// Its pose.
    pub cam_from_world: Rigid3,
}

/// Where a photograph sees a point. Carries the coordinates, so that adjustment needs no features.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Observation {
    /// Which photograph.
    pub image: ImageId,
    /// Which of its features.
    pub feature: u32,
    /// Column in pixels.
    pub x_px: f32,
    /// Row in pixels.
    pub y_px: f32,
}

impl Observation {
    /// The image point in pixels.
    pub fn xy_px(&self) -> Vector2<f64> {
        Vector2::new(f64::from(self.x_px), f64::from(self.y_px))
    }
}

/// A point of the scene, and where its track lies in [`Reconstruction::observations`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScenePoint {
    /// Position.
    pub x_in_world: Vector3<f64>,
    /// Red, green, blue.
    pub color: [u8; 3],
    /// First observation of the track.
    pub first_observation: u64,
    /// Length of the track.
    pub num_observations: u32,
}

/// Cameras, poses, points and tracks in one frame.
///
/// `cameras` ascend by id, `images` by image, the observations of a point by image. Every observation's image is
/// registered, and every registered image's camera is present.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Reconstruction {
    /// Intrinsics.
    pub cameras: Vec<(CameraId, Camera)>,
    /// Poses.
    pub images: Vec<RegisteredImage>,
    /// Points.
    pub points: Vec<ScenePoint>,
    /// The tracks, one after another, in the order of `points`.
    pub observations: Vec<Observation>,
}

impl Reconstruction {
    /// The intrinsics of a camera.
    pub fn camera(&self, id: CameraId) -> Option<&Camera> {
        self.cameras.binary_search_by_key(&id, |entry| entry.0).ok().map(|at| &self.cameras[at].1)
    }

    /// The place of an image in `images`, or `None` when it is not registered.
    pub fn position_of(&self, image: ImageId) -> Option<usize> {
        self.images.binary_search_by_key(&image, |entry| entry.image).ok()
    }

    /// A registered image.
    pub fn image(&self, image: ImageId) -> Option<&RegisteredImage> {
        self.position_of(image).map(|at| &self.images[at])
    }

    /// The track of a point.
    pub fn track(&self, point: &ScenePoint) -> &[Observation] {
        let first = point.first_observation as usize;
        &self.observations[first..first + point.num_observations as usize]
    }

    /// Appends a point with its track.
    pub fn push_point(&mut self, x_in_world: Vector3<f64>, color: [u8; 3], track: &[Observation]) {
        self.points.push(ScenePoint {
            x_in_world,
            color,
            first_observation: self.observations.len() as u64,
            num_observations: track.len() as u32,
        });
        self.observations.extend_from_slice(track);
    }

    /// Moves everything into another frame; images stay as they are.
    pub fn transform(&mut self, new_from_old: &Sim3) {
        for image in &mut self.images {
            image.cam_from_world = new_from_old.transform_camera(&image.cam_from_world);
        }
        for point in &mut self.points {
            point.x_in_world = new_from_old.transform_point(&point.x_in_world);
        }
    }

    /// Reprojection error of an observation in pixels, or `None` when the point is behind the camera.
    pub fn reprojection_error_px(&self, x_in_world: &Vector3<f64>, observation: &Observation) -> Option<f64> {
        let image = self.image(observation.image)?;
        let xy_px = self.camera(image.camera)?.project(&image.cam_from_world.transform_point(x_in_world))?;
        Some((xy_px - observation.xy_px()).norm())
    }

    /// Mean reprojection error over all observations in pixels; zero without observations.
    pub fn mean_reprojection_error_px(&self) -> f64 {
        let mut sum = 0.0;
        let mut count = 0u64;
        for point in &self.points {
            for observation in self.track(point) {
                if let Some(error_px) = self.reprojection_error_px(&point.x_in_world, observation) {
                    sum += error_px;
                    count += 1;
                }
            }
        }
        if count == 0 { 0.0 } else { sum / count as f64 }
    }

    /// Mean number of observations of a point; zero without points.
    pub fn mean_track_length(&self) -> f64 {
        if self.points.is_empty() { 0.0 } else { self.observations.len() as f64 / self.points.len() as f64 }
    }
}
