//! Scenes at the level of features: cameras, points, keypoints and matches, with noise and faults asked for.
//!
//! The truth is kept beside what a mapper is given, so that a test can bound errors from both sides: below what the
//! noise allows, and above what no noise would give.

mod layout;
mod observe;

use nalgebra::Vector3;
use terrane_geometry::{Camera, CameraModel, Rigid3, Seed};
use terrane_scene::{CameraId, CameraRecord, FocalSource, ImageId, MatchedPair, Reconstruction};

pub use layout::Layout;
pub(crate) use layout::{look, normal, uniform};

/// What to make. Lengths are metres.
#[derive(Clone, Debug)]
pub struct SceneOptions {
    /// Where cameras and points are.
    pub layout: Layout,
    /// How many photographs.
    pub num_images: usize,
    /// How many points, over the whole scene.
    pub num_points: usize,
    /// The camera that takes every photograph.
    pub camera: Camera,
    /// How the mapper is told about its focal length.
    pub focal_source: FocalSource,
    /// Factor on the focal length that the mapper is told; 1 tells the truth.
    pub told_focal_factor: f64,
    /// Standard deviation of keypoints in pixels, per axis.
    pub noise_px: f64,
    /// Share of a pair's matches that are wrong, within [0, 1).
    pub outlier_fraction: f64,
    /// Chance that a point that is in view is not detected.
    pub miss_fraction: f64,
    /// Fewest matches that make a pair.
    pub min_matches: usize,
    /// Standard deviation of the relative rotation in a pair's summary, in radians.
    pub pair_rotation_sigma_rad: f64,
    /// Everything random comes from here.
    pub seed: Seed,
}

impl Default for SceneOptions {
    fn default() -> Self {
        Self {
            layout: Layout::Orbit { radius_m: 12.0 },
            num_images: 12,
            num_points: 1500,
            camera: Camera::centered(CameraModel::SimpleRadial, 1200, 900, 1000.0),
            focal_source: FocalSource::Exif,
            told_focal_factor: 1.0,
            noise_px: 0.5,
            outlier_fraction: 0.0,
            miss_fraction: 0.1,
            min_matches: 20,
            pair_rotation_sigma_rad: 0.0,
            seed: Seed(1),
        }
    }
}

/// One photograph as the mapper sees it.
#[derive(Clone, Debug)]
pub struct SyntheticImage {
    /// Its id.
    pub image: ImageId,
    /// The camera that took it.
    pub camera: CameraId,
    /// Keypoints in pixels.
    pub keypoints_px: Vec<[f32; 2]>,
    /// Their colours.
    pub colors: Vec<[u8; 3]>,
    /// Which true point each keypoint shows.
    pub point_of_keypoint: Vec<u32>,
}

/// A scene: what a mapper is given, and the truth.
#[derive(Clone, Debug)]
pub struct SyntheticScene {
    /// Cameras as the mapper is told.
    pub cameras: Vec<(CameraId, CameraRecord)>,
    /// Photographs, by id.
    pub images: Vec<SyntheticImage>,
    /// Verified pairs, ascending.
    pub pairs: Vec<MatchedPair>,
    /// True poses, intrinsics and points; its observations carry the noisy coordinates of true detections.
    pub truth: Reconstruction,
}

impl SyntheticScene {
    /// Makes a scene.
    pub fn new(options: &SceneOptions) -> Self {
        let poses = layout::poses(options);
        let points = layout::points(options);
        let images = observe::images(options, &poses, &points);
        let pairs = observe::pairs(options, &poses, &points, &images);
        let truth = observe::truth(options, &poses, &points, &images);
        Self { cameras: vec![(CameraId(0), told_camera(options))], images, pairs, truth }
    }

    /// True camera centres, by image id.
    pub fn centers(&self) -> Vec<Vector3<f64>> {
        self.truth.images.iter().map(|image| image.cam_from_world.center()).collect()
    }

    /// True pose of an image.
    pub fn pose(&self, image: ImageId) -> Option<Rigid3> {
        self.truth.image(image).map(|registered| registered.cam_from_world)
    }
}

fn told_camera(options: &SceneOptions) -> CameraRecord {
    let mut camera = options.camera;
    let num_focal = camera.model.num_focal();
    for focal_px in &mut camera.params_mut()[..num_focal] {
        *focal_px *= options.told_focal_factor;
    }
    if options.focal_source != FocalSource::Given {
        let first = num_focal + 2;
        camera.params_mut()[first..].fill(0.0);
    }
    CameraRecord { camera, focal_source: options.focal_source, name: "synthetic".into() }
}

#[cfg(test)]
mod tests;
