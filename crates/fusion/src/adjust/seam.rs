//! Adjusting the cameras of one seam while all others hold still.

use std::collections::BTreeMap;

use nalgebra::Vector3;
use terrane_optim::bundle::{
    self, BundleObservation, BundleOptions, BundleReport, BundleShard, InMemoryShards, RefineIntrinsics,
};
use terrane_scene::ImageId;

use super::{MergedShards, problem};
use crate::FusionError;
use crate::merge::MergedCameras;

/// The points that a seam's images see, and where they come from.
struct SeamPoints {
    shard: BundleShard,
    /// Shard and place of each point.
    origin: Vec<(u32, u32)>,
    /// Images that see any of them, ascending: the poses of the problem.
    images: Vec<ImageId>,
}

/// Adjusts the poses of `free` and every point that they see. `None` when they see none.
pub(super) fn adjust_seam(
    cameras: &mut MergedCameras,
    shards: &mut dyn MergedShards,
    free: &[ImageId],
    options: &BundleOptions,
) -> Result<Option<BundleReport>, FusionError> {
    let Some(points) = gather(cameras, shards, free)? else { return Ok(None) };
    let place = |image: &ImageId| cameras.images.binary_search_by_key(image, |entry| entry.image).ok();
    let involved = MergedCameras {
        cameras: cameras.cameras.clone(),
        images: points.images.iter().filter_map(place).map(|at| cameras.images[at]).collect(),
    };
    let mut problem = problem::camera_problem(&involved, &[]);
    problem.refine.fill(RefineIntrinsics::NONE);
    problem.fixed_poses = points.images.iter().map(|image| free.binary_search(image).is_err()).collect();
    let mut in_memory = InMemoryShards(vec![points.shard]);
    let report = bundle::solve(&mut problem, &mut in_memory, options).map_err(FusionError::adjustment)?;
    for (image, pose) in points.images.iter().zip(&problem.poses) {
        if let Ok(at) = cameras.images.binary_search_by_key(image, |entry| entry.image) {
            cameras.images[at].cam_from_world = *pose;
        }
    }
    let moved = in_memory.0.pop().map_or(Vec::new(), |shard| shard.points);
    scatter(shards, &points.origin, &moved)?;
    Ok(Some(report))
}

/// Every point with an observation in a free image, from all shards.
fn gather(
    cameras: &MergedCameras,
    shards: &dyn MergedShards,
    free: &[ImageId],
) -> Result<Option<SeamPoints>, FusionError> {
    let registered = problem::PoseIndex::new(&cameras.images);
    let (mut points, mut origin, mut seen_by) = (Vec::new(), Vec::new(), Vec::new());
    for shard in 0..shards.len() {
        let merged = shards.load(shard)?;
        for (at, point) in merged.points.iter().enumerate() {
            let track = merged.track(point);
            if track.iter().any(|seen| free.binary_search(&seen.image).is_ok()) {
                let number = points.len() as u32;
                points.push(point.x_in_world);
                origin.push((shard as u32, at as u32));
                seen_by.extend(track.iter().map(|seen| (number, *seen)));
            }
        }
    }
    seen_by.retain(|(_, seen)| registered.of(seen.image).is_some());
    let mut images: Vec<ImageId> = seen_by.iter().map(|(_, seen)| seen.image).collect();
    images.sort_unstable();
    images.dedup();
    if images.is_empty() {
        return Ok(None);
    }
    let pose_of: BTreeMap<ImageId, u32> =
        images.iter().enumerate().map(|(at, image)| (*image, at as u32)).collect();
    let observations = seen_by
        .iter()
        .map(|(point, seen)| BundleObservation {
            pose: pose_of[&seen.image],
            point: *point,
            xy_px: [seen.x_px, seen.y_px],
        })
        .collect();
    Ok(Some(SeamPoints { shard: BundleShard { points, fixed_points: false, observations }, origin, images }))
}

/// Writes moved points back to their shards; `origin` ascends.
fn scatter(
    shards: &mut dyn MergedShards,
    origin: &[(u32, u32)],
    moved: &[Vector3<f64>],
) -> Result<(), FusionError> {
    let mut at = 0;
    while at < origin.len() {
        let shard = origin[at].0 as usize;
        let mut merged = shards.load(shard)?.into_owned();
        while at < origin.len() && origin[at].0 as usize == shard {
            if let (Some(point), Some(x)) = (merged.points.get_mut(origin[at].1 as usize), moved.get(at)) {
                point.x_in_world = *x;
            }
            at += 1;
        }
        shards.store(shard, merged)?;
    }
    Ok(())
}
