//! The view graph as a value, and the report of how it came to be.

use nalgebra::UnitQuaternion;
use serde::{Deserialize, Serialize};
use terrane_scene::{ImagePair, PairKind};

/// A verified pair that may position cameras.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewEdge {
    /// The images.
    pub pair: ImagePair,
    /// What the matches show.
    pub kind: PairKind,
    /// Matches that agree with the two-view geometry.
    pub num_inliers: u32,
    /// Median angle between the rays of the inliers, in radians.
    pub median_angle_rad: f64,
    /// Strength for cutting and overlap: inliers, less for narrow angles. Above zero.
    pub weight: f64,
}

/// Photographs and the verified pairs between them that agree with each other.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ViewGraph {
    /// How many images the run has; every id is below it.
    pub num_images: u32,
    /// Edges, ascending by pair.
    pub edges: Vec<ViewEdge>,
    /// Averaged `cam_from_world` rotation of each image, in the gauge of its component; `None` for an image that no
    /// rotation reaches.
    pub rotations: Vec<Option<UnitQuaternion<f64>>>,
}

/// Why a verified pair is not an edge.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "reason")]
pub enum DropReason {
    /// Its matches stay where they are in the image.
    Watermark,
    /// The two views were taken from one place: rotation is known, depth is not. Used for rotations only.
    NoBaseline,
    /// Fewer inliers than `min_inliers`.
    FewInliers {
        /// How many there are.
        num_inliers: u32,
    },
    /// Its rotation disagrees with the rest of the graph.
    RotationDisagrees {
        /// By how much, in degrees.
        error_deg: f64,
    },
    /// It names an image that the run does not have, or comes twice, or holds numbers that are not finite.
    Invalid,
}

/// A verified pair that is not an edge.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DroppedEdge {
    /// The images.
    pub pair: ImagePair,
    /// Why not.
    #[serde(flatten)]
    pub reason: DropReason,
}

/// What building the view graph did.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ViewGraphReport {
    /// Verified pairs that came in.
    pub num_pairs: u32,
    /// Edges that were kept.
    pub num_edges: u32,
    /// Edges kept whose rotation could not be checked, as the pair has none.
    pub num_unchecked: u32,
    /// Median disagreement of the kept edges' rotations with the averaged ones, in degrees.
    pub median_rotation_error_deg: f64,
    /// Images of each connected component of the kept edges, largest first; single images are not counted.
    pub component_sizes: Vec<u32>,
    /// Images without an edge.
    pub num_isolated: u32,
    /// Pairs that are not edges, by pair.
    pub dropped: Vec<DroppedEdge>,
}
