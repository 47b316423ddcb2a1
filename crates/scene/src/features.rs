//! Keypoints and descriptors of one photograph.

use std::borrow::Cow;

use bytemuck::{Pod, Zeroable};
use serde::{Deserialize, Serialize};

/// Bytes of one descriptor of the kind [`DescriptorKind::Bytes128`].
pub const DESCRIPTOR_LEN: usize = 128;

/// Bytes of one descriptor of the kind [`DescriptorKind::Bits256`].
pub const BINARY_DESCRIPTOR_LEN: usize = 32;

/// What descriptors are made of, and by which distance they are compared.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DescriptorKind {
    /// 128 unsigned bytes under the Euclidean distance. Shorter vectors end in zeros.
    #[default]
    Bytes128,
    /// 256 bits under the Hamming distance; bit k is bit k % 8 of byte k / 8.
    Bits256,
}

impl DescriptorKind {
    /// Bytes of one descriptor.
    pub fn num_bytes(self) -> usize {
        match self {
            Self::Bytes128 => DESCRIPTOR_LEN,
            Self::Bits256 => BINARY_DESCRIPTOR_LEN,
        }
    }

    /// The name in messages and reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Bytes128 => "128 bytes",
            Self::Bits256 => "256 bits",
        }
    }
}

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
    /// What the descriptors are.
    pub kind: DescriptorKind,
    /// [`DescriptorKind::num_bytes`] bytes a keypoint, row after row.
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
        let len = self.kind.num_bytes();
        &self.descriptors[index * len..(index + 1) * len]
    }

    /// The descriptors as vectors whose squared Euclidean distances grow as the kind's own distance does: what clusters
    /// and global descriptors are made from.
    ///
    /// Vectors of bytes are themselves. 256 bits become 128 numbers: bits k and k + 128 count together, 60 each. Where
    /// the two bits are independent, the expected squared distance is 3600 times the Hamming distance.
    pub fn vectors(&self) -> Cow<'_, [[u8; DESCRIPTOR_LEN]]> {
        match self.kind {
            DescriptorKind::Bytes128 => Cow::Borrowed(self.descriptors.as_chunks::<DESCRIPTOR_LEN>().0),
            DescriptorKind::Bits256 => Cow::Owned(self.bits().iter().map(vector_of_bits).collect()),
        }
    }

    /// The descriptors of the kind [`DescriptorKind::Bits256`]; empty for other kinds.
    pub fn bits(&self) -> &[[u8; BINARY_DESCRIPTOR_LEN]] {
        match self.kind {
            DescriptorKind::Bits256 => self.descriptors.as_chunks::<BINARY_DESCRIPTOR_LEN>().0,
            DescriptorKind::Bytes128 => &[],
        }
    }
}

fn vector_of_bits(bits: &[u8; BINARY_DESCRIPTOR_LEN]) -> [u8; DESCRIPTOR_LEN] {
    let bit = |k: usize| (bits[k / 8] >> (k % 8)) & 1;
    std::array::from_fn(|k| 60 * (bit(k) + bit(k + DESCRIPTOR_LEN)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn vectors_of_bits_are_as_far_apart_as_the_bits() {
        let mut state = 1_u64;
        let mut byte = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 56) as u8
        };
        let bits: Vec<u8> = (0..200 * BINARY_DESCRIPTOR_LEN).map(|_| byte()).collect();
        let features = Features { kind: DescriptorKind::Bits256, descriptors: bits, ..Features::default() };
        let vectors = features.vectors();
        assert_eq!((features.bits().len(), vectors.len()), (200, 200));
        let (mut hamming, mut euclidean) = (0.0, 0.0);
        for k in 1..200 {
            let pairs = features.descriptor(k - 1).iter().zip(features.descriptor(k));
            hamming += f64::from(pairs.map(|(a, b)| (a ^ b).count_ones()).sum::<u32>());
            let pairs = vectors[k - 1].iter().zip(&vectors[k]);
            euclidean += pairs.map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2)).sum::<f64>();
        }
        let ratio = euclidean / (3600.0 * hamming);
        assert!((0.97..1.03).contains(&ratio), "{ratio}");
    }
}
