//! What can go wrong with the input of a mapping, as opposed to a scene that can't be rebuilt.

use terrane_scene::{CameraId, ImageId, ImagePair};

/// Broken input or a failed solver. A cluster that can't be rebuilt is an outcome, not an error.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
pub struct MappingError(#[from] Kind);

/// The kinds, private so that they may change.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Kind {
    #[error("image {0} occurs twice in the cluster: list every image once")]
    DuplicateImage(ImageId),
    #[error("camera {0} occurs twice in the cluster: list every camera once")]
    DuplicateCamera(CameraId),
    #[error("image {image} names camera {camera}, which the cluster lacks: add its record")]
    UnknownCamera { image: ImageId, camera: CameraId },
    #[error(
        "image {image} has {keypoints} keypoints and {colors} colours: give as many colours as keypoints"
    )]
    ColorCount { image: ImageId, keypoints: usize, colors: usize },
    #[error("image {0} has a keypoint that is not finite: extract its features again")]
    NotFinite(ImageId),
    #[error(
        "camera {0} has parameters that are not finite or a focal length that is not positive: state its intrinsics"
    )]
    BadCamera(CameraId),
    #[error("pair {}-{} names an image that the cluster lacks: drop it or add the image", .0.first(), .0.second())]
    UnknownImage(ImagePair),
    #[error("pair {}-{} occurs twice in the cluster: list every pair once", .0.first(), .0.second())]
    DuplicatePair(ImagePair),
    #[error("pair {}-{} matches feature {feature}, which image {image} lacks: match it again", .pair.first(), .pair.second())]
    UnknownFeature { pair: ImagePair, image: ImageId, feature: u32 },
    #[error("the cluster has {0} keypoints, more than 2^31: make it smaller")]
    TooManyFeatures(usize),
    #[error("options: {0}")]
    Options(String),
    #[error("the adjustment of cluster {cluster} failed: {message}")]
    Adjustment { cluster: terrane_scene::ClusterId, message: String },
}

impl MappingError {
    /// Whether the caller's input is at fault, so that trying again can't help.
    pub fn is_invalid_input(&self) -> bool {
        !matches!(self.0, Kind::Adjustment { .. })
    }
}
