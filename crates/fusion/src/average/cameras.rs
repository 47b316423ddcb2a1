//! One pose per photograph: rotation averaging, then position averaging with one scale per submap.

use serde::{Deserialize, Serialize};
use terrane_scene::RegisteredImage;

/// How cameras are averaged.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CameraAverageOptions {
    /// Largest turn of a camera away from its submaps' mean, in degrees; beyond it the mean is kept. Default 5.
    pub max_rotation_deg: f64,
    /// Largest move of a camera away from its submaps' mean, as a fraction of the median depth; beyond it the mean
    /// is kept. Default 0.1.
    pub max_relative_move: f64,
}

impl Default for CameraAverageOptions {
    fn default() -> Self {
        Self { max_rotation_deg: 5.0, max_relative_move: 0.1 }
    }
}

/// What averaging a component's cameras did.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CameraAverageReport {
    /// Cameras.
    pub num_cameras: u32,
    /// Cameras in more than one submap.
    pub num_shared: u32,
    /// Relative poses that went in.
    pub num_edges: u32,
    /// Median disagreement of the relative rotations with the averaged ones, in degrees.
    pub median_rotation_error_deg: f64,
    /// Median move of the cameras away from their submaps' mean, in units of the world.
    pub median_move: f64,
    /// Cameras whose averaged pose strayed too far, so that the submaps' mean was kept.
    pub num_kept: u32,
}

/// Cameras of one component, in its world.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CameraAverages {
    /// Poses, ascending by image.
    pub images: Vec<RegisteredImage>,
    /// How it went.
    pub report: CameraAverageReport,
}
