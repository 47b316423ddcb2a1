//! Tracks joined across seams, and points in shards by space.

mod join;
mod shards;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use terrane_geometry::Camera;
use terrane_scene::{CameraId, ImageId, Observation, Reconstruction, RegisteredImage, ScenePoint};

use self::join::{JoinedTracks, WorldPoint};
use self::shards::Track;
use crate::average::{CameraAverages, Placement};

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

/// Merges the submaps of a component: `submaps` are all submaps by number, those of other components may be empty.
///
/// Points that own common observations are joined by union-find, strongest link first, unless they lie too far apart
/// or conflict. A joint point lies at the mean of its places, weighted by track length; adjustment
/// follows the cameras' last moves. Intrinsics of a camera are the mean of its submaps', weighted by observations.
pub fn merge(
    submaps: &[&Reconstruction],
    placement: &Placement,
    averages: &CameraAverages,
    component: usize,
    options: &MergeOptions,
) -> MergedComponent {
    let mut report = MergeReport::default();
    let members: Vec<u32> =
        placement.components.get(component).map_or(Vec::new(), |found| found.submaps.clone());
    let images = averages.images.clone();
    let center_of = |image: ImageId| {
        images
            .binary_search_by_key(&image, |entry| entry.image)
            .ok()
            .map(|at| images[at].cam_from_world.center())
    };
    let mut points = Vec::new();
    for submap in &members {
        let world_from_submap = &placement.world_from_submap[*submap as usize];
        for (at, point) in submaps[*submap as usize].points.iter().enumerate() {
            let x_in_world = world_from_submap.transform_point(&point.x_in_world);
            if x_in_world.iter().all(|value| value.is_finite()) {
                points.push(WorldPoint { submap: *submap, point: at as u32, x_in_world });
            }
        }
    }
    report.num_points_in = points.len() as u64;
    let mut joined = join::join(submaps, &points, &center_of, options, &mut report);
    let mut tracks = fuse(submaps, &points, &mut joined);
    settle_contested(&mut tracks, &mut report);
    tracks.iter_mut().for_each(|track| track.observations.retain(|seen| center_of(seen.image).is_some()));
    tracks.retain(|track| track.observations.len() >= 2);
    report.num_points = tracks.len() as u64;
    report.num_observations = tracks.iter().map(|track| track.observations.len() as u64).sum();
    let cameras = MergedCameras { cameras: fused_intrinsics(submaps, &members), images };
    let shards = shards::by_space(&tracks, options.observations_per_shard);
    MergedComponent { cameras, shards, report }
}

/// One track per set of joined points, in the order of the sets' first points.
fn fuse(submaps: &[&Reconstruction], points: &[WorldPoint], joined: &mut JoinedTracks) -> Vec<Track> {
    const NONE: usize = usize::MAX;
    let mut place = vec![NONE; points.len()];
    let mut tracks: Vec<Track> = Vec::new();
    let mut weights: Vec<f64> = Vec::new();
    let mut longest: Vec<u32> = Vec::new();
    for (at, world_point) in points.iter().enumerate() {
        let source = &submaps[world_point.submap as usize].points[world_point.point as usize];
        let root = joined.root(at as u32) as usize;
        if place[root] == NONE {
            place[root] = tracks.len();
            let observations = joined.take_track(root as u32);
            tracks.push(Track { x_in_world: Vector3::zeros(), color: source.color, observations });
            weights.push(0.0);
            longest.push(0);
        }
        let here = place[root];
        let weight = f64::from(source.num_observations);
        tracks[here].x_in_world += weight * world_point.x_in_world;
        weights[here] += weight;
        if source.num_observations > longest[here] {
            longest[here] = source.num_observations;
            tracks[here].color = source.color;
        }
    }
    for (track, weight) in tracks.iter_mut().zip(weights) {
        track.x_in_world /= weight.max(1.0);
    }
    tracks
}

/// Gives every feature that two tracks claim to the longer one (ties: the earlier).
fn settle_contested(tracks: &mut [Track], report: &mut MergeReport) {
    let mut claims: Vec<(ImageId, u32, std::cmp::Reverse<usize>, u32)> = Vec::new();
    for (at, track) in tracks.iter().enumerate() {
        let length = std::cmp::Reverse(track.observations.len());
        claims.extend(track.observations.iter().map(|seen| (seen.image, seen.feature, length, at as u32)));
    }
    claims.sort_unstable();
    let lost: Vec<(u32, ImageId, u32)> = claims
        .windows(2)
        .filter(|pair| (pair[0].0, pair[0].1) == (pair[1].0, pair[1].1))
        .map(|pair| (pair[1].3, pair[1].0, pair[1].1))
        .collect();
    report.num_contested = lost.len() as u64;
    for (track, image, feature) in lost {
        tracks[track as usize].observations.retain(|seen| (seen.image, seen.feature) != (image, feature));
    }
}

/// The intrinsics of every camera of the members, weighted by the observations of each submap.
fn fused_intrinsics(submaps: &[&Reconstruction], members: &[u32]) -> Vec<(CameraId, Camera)> {
    let mut sums: BTreeMap<CameraId, (Camera, Vec<f64>, f64)> = BTreeMap::new();
    for submap in members {
        let submap = submaps[*submap as usize];
        let mut weight_of: BTreeMap<CameraId, f64> = BTreeMap::new();
        for seen in &submap.observations {
            if let Some(image) = submap.image(seen.image) {
                *weight_of.entry(image.camera).or_insert(0.0) += 1.0;
            }
        }
        for (id, camera) in &submap.cameras {
            let weight = weight_of.get(id).copied().unwrap_or(0.0).max(1e-3);
            let entry =
                sums.entry(*id).or_insert_with(|| (*camera, vec![0.0; camera.model.num_params()], 0.0));
            // A camera whose model was escalated in one submap only keeps the model of the first.
            if entry.0.model == camera.model {
                entry.1.iter_mut().zip(camera.params()).for_each(|(sum, value)| *sum += weight * value);
                entry.2 += weight;
            }
        }
    }
    sums.into_iter()
        .map(|(id, (mut camera, sum, weight))| {
            camera.params_mut().iter_mut().zip(sum).for_each(|(value, sum)| *value = sum / weight);
            (id, camera)
        })
        .collect()
}
