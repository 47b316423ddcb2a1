//! What a mapping did, in numbers.

use serde::{Deserialize, Serialize};
use terrane_scene::{ClusterId, ImagePair};

/// How a cluster was mapped.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MappingReport {
    /// Which cluster.
    pub cluster: ClusterId,
    /// Images of the cluster.
    pub num_images: u32,
    /// Pairs of the cluster.
    pub num_pairs: u32,
    /// Matches of these pairs.
    pub num_matches: u64,
    /// Images in some submap.
    pub num_registered: u32,
    /// Each submap, in the order of the outcome's.
    pub submaps: Vec<SubmapReport>,
    /// The pairs that were tried as a start, in order.
    pub trials: Vec<InitialTrial>,
}

/// How one submap grew.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SubmapReport {
    /// Images.
    pub num_images: u32,
    /// Points.
    pub num_points: u64,
    /// Observations of these points.
    pub num_observations: u64,
    /// Mean reprojection error in pixels.
    pub mean_reprojection_error_px: f64,
    /// Mean number of observations of a point.
    pub mean_track_length: f64,
    /// The pair it started from.
    pub initial_pair: Option<ImagePair>,
    /// Local bundle adjustments.
    pub local_adjustments: u32,
    /// Full bundle adjustments.
    pub full_adjustments: u32,
    /// Iterations of all adjustments together.
    pub adjustment_iterations: u32,
    /// Attempts to add an image that failed.
    pub failed_registrations: u32,
    /// Images that were added and removed again.
    pub removed_images: u32,
    /// Observations that filtering removed.
    pub filtered_observations: u64,
    /// Cameras whose intrinsics left the sane range and were put back to their start.
    pub reset_cameras: u32,
}

/// A pair that was tried as a start.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct InitialTrial {
    /// The images.
    pub pair: ImagePair,
    /// What came of it.
    pub verdict: TrialVerdict,
}

/// What came of an initial pair.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "verdict")]
pub enum TrialVerdict {
    /// A submap grew from it.
    Kept {
        /// Images of that submap.
        images: u32,
    },
    /// A submap grew from it, but another one was larger, or it was too small to keep.
    Outgrown {
        /// Images of that submap.
        images: u32,
    },
    /// It could not start a submap.
    Refused {
        /// Why, in words.
        reason: String,
    },
}
