//! What a mapping reads: the images of one cluster, their cameras, and the verified pairs among them.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use terrane_scene::{CameraId, CameraRecord, ClusterId, ImageId, MatchedPair};

/// Where a camera is said to be, in a local east-north-up frame in metres.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PositionPrior {
    /// Position of the camera centre in metres.
    pub x_in_enu: Vector3<f64>,
    /// Standard deviation per axis in metres.
    pub sigma_m: Vector3<f64>,
}

/// One image of the cluster.
#[derive(Clone, Debug, PartialEq)]
pub struct ClusterImage {
    /// Which image.
    pub image: ImageId,
    /// The camera that took it, one of [`ClusterInput::cameras`].
    pub camera: CameraId,
    /// Position of each feature in pixels; the centre of the first pixel is (0.5, 0.5).
    pub keypoints_px: Vec<[f32; 2]>,
    /// Red, green and blue of each feature: as many as keypoints, or none (points are then grey).
    pub colors: Vec<[u8; 3]>,
    /// Position from a receiver, if the image has one.
    pub position_prior: Option<PositionPrior>,
}

/// One cluster: what [`crate::reconstruct`] reads. The order of images, cameras and pairs does not matter.
#[derive(Clone, Debug, PartialEq)]
pub struct ClusterInput {
    /// Which cluster.
    pub cluster: ClusterId,
    /// Its images, each once.
    pub images: Vec<ClusterImage>,
    /// The cameras of these images, each once.
    pub cameras: Vec<(CameraId, CameraRecord)>,
    /// Verified pairs with their inlier matches, each pair once, both images in the cluster.
    pub pairs: Vec<MatchedPair>,
}
