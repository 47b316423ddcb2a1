//! What each seam shows: how far its two submaps disagree about what they share.

use serde::{Deserialize, Serialize};

/// Figures of one seam. Lengths are in units of the placed frame: metres when geo-referenced.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SeamFigures {
    /// One submap.
    pub a: u32,
    /// The other.
    pub b: u32,
    /// Images of both.
    pub num_shared_cameras: u32,
    /// RMS distance between the two centres of a shared camera.
    pub camera_distance_rms: f64,
    /// RMS rotation between the two poses of a shared camera, in degrees.
    pub camera_rotation_rms_deg: f64,
    /// Pairs of points that own a common observation.
    pub num_shared_points: u32,
    /// Median distance between the two places of a shared point.
    pub point_distance_median: f64,
    /// RMS distance between the two places of a shared point, the farthest tenth left out.
    pub point_distance_rms: f64,
}
