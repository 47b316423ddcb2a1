//! Keypoints and descriptors of one photograph.

use bytemuck::{Pod, Zeroable};

/// Bytes of one descriptor.
pub const DESCRIPTOR_LEN: usize = 128;

/// A place in a photograph that can be found again.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Keypoint {
    /// Column in pixels; the centre of the first pixel is 0.5.
    pub x_px: f32,
    /// Row in pixels; the centre of the first pixel is 0.5.
    pub y_px: f32,
    /// Standard deviation of the blob in pixels.
    pub scale_px: f32,
    /// Direction of the dominant gradient in radians, from x towards y.
    pub orientation_rad: f32,
}

/// Features of one photograph, as columns of equal length.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Features {
    /// Where they are. Ordered by falling strength, so that a prefix is the best subset.
    pub keypoints: Vec<Keypoint>,
    /// [`DESCRIPTOR_LEN`] bytes a keypoint, row after row.
    pub descriptors: Vec<u8>,
    /// Colour (red, green, blue) at each keypoint, so that points have one without looking at pixels again.
    pub colors: Vec<[u8; 3]>,
}

impl Features {
    /// How many features there are.
    pub fn len(&self) -> usize {
        self.keypoints.len()
    }

    /// True for a photograph without any.
    pub fn is_empty(&self) -> bool {
        self.keypoints.is_empty()
    }

    /// The descriptor of a feature.
    ///
    /// # Panics
    /// When there is no such feature.
    pub fn descriptor(&self, index: usize) -> &[u8] {
        &self.descriptors[index * DESCRIPTOR_LEN..(index + 1) * DESCRIPTOR_LEN]
    }
}
