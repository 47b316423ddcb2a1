//! Tracks joined across seams, and points in shards by space.

use serde::{Deserialize, Serialize};
use terrane_geometry::Camera;
use terrane_scene::{CameraId, Observation, Reconstruction, RegisteredImage, ScenePoint};

/// How submaps are merged.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MergeOptions {
    /// Largest angle, as a shared camera sees it, between two points that are joined, in degrees. Default 1.
    pub max_angle_deg: f64,
    /// Largest ratio of their depths from a shared camera. Range: above 1. Default 1.3.
    pub max_depth_ratio: f64,
    /// Observations that a shard aims at. Default 2,000,000: about 32 MB.
    pub observations_per_shard: u64,
}

impl Default for MergeOptions {
    fn default() -> Self {
        Self { max_angle_deg: 1.0, max_depth_ratio: 1.3, observations_per_shard: 2_000_000 }
    }
}

/// Points of one region with their tracks.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MergedShard {
    /// Points; `first_observation` counts from this shard's first observation.
    pub points: Vec<ScenePoint>,
    /// The tracks, one after another, in the order of `points`; each ascending by image.
    pub observations: Vec<Observation>,
}

impl MergedShard {
    /// The track of a point of this shard.
    pub fn track(&self, point: &ScenePoint) -> &[Observation] {
        let first = point.first_observation as usize;
        &self.observations[first..first + point.num_observations as usize]
    }
}

/// Cameras of a merged component: what adjustment changes beside the points.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MergedCameras {
    /// Intrinsics, ascending by id.
    pub cameras: Vec<(CameraId, Camera)>,
    /// Poses, ascending by image.
    pub images: Vec<RegisteredImage>,
}

/// What merging did.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MergeReport {
    /// Points of the submaps.
    pub num_points_in: u64,
    /// Points after joining.
    pub num_points: u64,
    /// Observations after joining.
    pub num_observations: u64,
    /// Pairs of points joined.
    pub num_joined: u64,
    /// Pairs that share an observation and were kept apart as they lie too far from each other.
    pub num_too_far: u64,
    /// Pairs kept apart as the joint track would own two features of one image.
    pub num_conflicts: u64,
    /// Observations given to one of two tracks that both claim them.
    pub num_contested: u64,
}

/// One component, merged.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MergedComponent {
    /// Cameras and poses.
    pub cameras: MergedCameras,
    /// Points, by region.
    pub shards: Vec<MergedShard>,
    /// How it went.
    pub report: MergeReport,
}

/// A whole reconstruction of cameras and shards.
pub fn assemble<'a>(
    cameras: &MergedCameras,
    shards: impl IntoIterator<Item = &'a MergedShard>,
) -> Reconstruction {
    let mut whole = Reconstruction {
        cameras: cameras.cameras.clone(),
        images: cameras.images.clone(),
        ..Default::default()
    };
    for shard in shards {
        for point in &shard.points {
            whole.push_point(point.x_in_world, point.color, shard.track(point));
        }
    }
    whole
}
