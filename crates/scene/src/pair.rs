//! Pairs of photographs that see the same thing.

use serde::{Deserialize, Serialize};
use terrane_geometry::Rigid3;

use crate::ImageId;

/// Two different images, the lower id first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct ImagePair {
    first: ImageId,
    second: ImageId,
}

impl ImagePair {
    /// The pair of two images in either order, or `None` for an image and itself.
    pub fn new(a: ImageId, b: ImageId) -> Option<Self> {
        (a != b).then(|| Self { first: a.min(b), second: a.max(b) })
    }

    /// The image with the lower id.
    pub fn first(self) -> ImageId {
        self.first
    }

    /// The image with the higher id.
    pub fn second(self) -> ImageId {
        self.second
    }

    /// The other image of the pair, or `None` when `image` is not in it.
    pub fn other(self, image: ImageId) -> Option<ImageId> {
        if image == self.first {
            Some(self.second)
        } else if image == self.second {
            Some(self.first)
        } else {
            None
        }
    }
}

/// What a pair's matches show.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PairKind {
    /// A scene with depth seen from two places, intrinsics trusted: an essential matrix.
    Calibrated,
    /// The same, with intrinsics that can't be trusted yet: a fundamental matrix.
    Uncalibrated,
    /// A plane seen from two places: a homography, whose decomposition gave the pose.
    Planar,
    /// Two views from one place: a homography of pure rotation. No depth can come of it.
    Panoramic,
    /// The matches stay where they are in the image: a watermark, a time stamp, or dirt on the lens.
    Watermark,
}

impl PairKind {
    /// Whether such a pair may position cameras and points.
    pub fn has_baseline(self) -> bool {
        matches!(self, Self::Calibrated | Self::Uncalibrated | Self::Planar)
    }
}

/// A verified pair without its matches: what the view graph reads.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PairSummary {
    /// The images.
    pub pair: ImagePair,
    /// What the matches show.
    pub kind: PairKind,
    /// Matches that agree with the two-view geometry.
    pub num_inliers: u32,
    /// `second_from_first` with a translation of length one (zero when panoramic); `None` when it could not be had.
    pub second_from_first: Option<Rigid3>,
    /// Median angle between the rays of the inliers, in radians.
    pub median_angle_rad: f64,
}

/// A verified pair with its inlier matches.
#[derive(Clone, Debug, PartialEq)]
pub struct MatchedPair {
    /// What is known without the matches.
    pub summary: PairSummary,
    /// Feature of the first image, feature of the second; ascending in the first.
    pub matches: Vec<[u32; 2]>,
}
