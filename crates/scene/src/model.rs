//! A result as exporters see it: cameras at hand, points shard by shard.

use std::borrow::Cow;

use terrane_geometry::Camera;

use crate::{CameraId, ImageId, Reconstruction, RegisteredImage, SceneError};

/// Cameras and poses in memory, points in shards that may lie elsewhere: one shard is in memory at a time.
pub trait Model {
    /// Intrinsics, ascending by id.
    fn cameras(&self) -> &[(CameraId, Camera)];

    /// Poses, ascending by image.
    fn images(&self) -> &[RegisteredImage];

    /// How many shards of points there are.
    fn num_shards(&self) -> usize;

    /// The points and tracks of a shard; its cameras and images are not looked at.
    ///
    /// # Errors
    /// When the shard can't be read.
    fn shard(&self, shard: usize) -> Result<Cow<'_, Reconstruction>, SceneError>;

    /// The pose and intrinsics of an image.
    fn view(&self, image: ImageId) -> Option<(&RegisteredImage, &Camera)> {
        let at = self.images().binary_search_by_key(&image, |entry| entry.image).ok()?;
        let pose = &self.images()[at];
        let camera = self.cameras().binary_search_by_key(&pose.camera, |entry| entry.0).ok()?;
        Some((pose, &self.cameras()[camera].1))
    }
}

impl Model for Reconstruction {
    fn cameras(&self) -> &[(CameraId, Camera)] {
        &self.cameras
    }

    fn images(&self) -> &[RegisteredImage] {
        &self.images
    }

    fn num_shards(&self) -> usize {
        1
    }

    fn shard(&self, _: usize) -> Result<Cow<'_, Reconstruction>, SceneError> {
        Ok(Cow::Borrowed(self))
    }
}
