//! What one cluster became.

use serde::{Deserialize, Serialize};

use crate::{ClusterId, ImageId, Reconstruction};

/// A part of the scene, rebuilt from one cluster in a frame and scale of its own.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Submap {
    /// Cameras and points.
    pub reconstruction: Reconstruction,
}

/// Why an image of a cluster is or is not in a submap.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "fate")]
pub enum ImageFate {
    /// In the submap of this place in [`SubmapOutcome::submaps`].
    Registered {
        /// Which submap.
        submap: u32,
    },
    /// Left out.
    LeftOut {
        /// Why, in words.
        reason: String,
    },
}

/// The result of mapping a cluster. No submap at all is an outcome, not an error.
#[derive(Clone, Debug, PartialEq)]
pub struct SubmapOutcome {
    /// Which cluster.
    pub cluster: ClusterId,
    /// Submaps, largest first; empty when nothing could be rebuilt.
    pub submaps: Vec<Submap>,
    /// Every image of the cluster, ascending.
    pub fates: Vec<(ImageId, ImageFate)>,
}
