//! Observations and points that adjustment can't explain.

use nalgebra::Vector3;
use rayon::prelude::*;
use terrane_scene::{ImageId, Observation, ScenePoint};

use super::{AdjustOptions, MergedShards, problem::PoseIndex};
use crate::FusionError;
use crate::merge::{MergedCameras, MergedShard};

/// What a filter took and left.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct FilterCounts {
    pub(super) dropped_observations: u64,
    pub(super) dropped_points: u64,
    pub(super) points: u64,
    pub(super) observations: u64,
    pub(super) sum_error_px: f64,
}

impl FilterCounts {
    pub(super) fn mean_error_px(&self) -> f64 {
        if self.observations == 0 { 0.0 } else { self.sum_error_px / self.observations as f64 }
    }
}

/// Drops observations with too large a reprojection error, then points that two cameras or a wide enough angle no
/// longer hold.
pub(super) fn filter(
    cameras: &MergedCameras,
    shards: &mut dyn MergedShards,
    options: &AdjustOptions,
) -> Result<FilterCounts, FusionError> {
    let view = Views::new(cameras);
    let mut total = FilterCounts::default();
    for shard in 0..shards.len() {
        let (kept, counts) = filter_shard(&view, shards.load(shard)?.as_ref(), options);
        if counts.dropped_observations > 0 || counts.dropped_points > 0 {
            shards.store(shard, kept)?;
        }
        total = add(total, counts);
    }
    Ok(total)
}

fn add(a: FilterCounts, b: FilterCounts) -> FilterCounts {
    FilterCounts {
        dropped_observations: a.dropped_observations + b.dropped_observations,
        dropped_points: a.dropped_points + b.dropped_points,
        points: a.points + b.points,
        observations: a.observations + b.observations,
        sum_error_px: a.sum_error_px + b.sum_error_px,
    }
}

/// Figures without dropping anything; observations behind their camera are not counted.
pub(super) fn measure(
    cameras: &MergedCameras,
    shards: &dyn MergedShards,
) -> Result<FilterCounts, FusionError> {
    let view = Views::new(cameras);
    let mut total = FilterCounts::default();
    for shard in 0..shards.len() {
        let merged = shards.load(shard)?;
        let errors: Vec<(f64, u64)> = merged
            .points
            .par_iter()
            .map(|point| {
                let errors =
                    merged.track(point).iter().filter_map(|seen| view.error_px(&point.x_in_world, seen));
                errors.fold((0.0, 0), |(sum, count), error| (sum + error, count + 1))
            })
            .collect();
        total.points += merged.points.len() as u64;
        for (sum, count) in errors {
            total.sum_error_px += sum;
            total.observations += count;
        }
    }
    Ok(total)
}

/// How many observations each image owns, in the order of `cameras.images`.
pub(super) fn support(cameras: &MergedCameras, shards: &dyn MergedShards) -> Result<Vec<u64>, FusionError> {
    let index = PoseIndex::new(&cameras.images);
    let mut support = vec![0; cameras.images.len()];
    for shard in 0..shards.len() {
        for seen in &shards.load(shard)?.observations {
            if let Some(place) = index.of(seen.image) {
                support[place as usize] += 1;
            }
        }
    }
    Ok(support)
}

/// Cameras ready to project into.
struct Views<'a> {
    cameras: &'a MergedCameras,
    index: PoseIndex,
}

impl<'a> Views<'a> {
    fn new(cameras: &'a MergedCameras) -> Self {
        Self { cameras, index: PoseIndex::new(&cameras.images) }
    }

    fn error_px(&self, x_in_world: &Vector3<f64>, seen: &Observation) -> Option<f64> {
        let image = &self.cameras.images[self.index.of(seen.image)? as usize];
        let place = self.cameras.cameras.binary_search_by_key(&image.camera, |entry| entry.0).ok()?;
        let xy_px =
            self.cameras.cameras[place].1.project(&image.cam_from_world.transform_point(x_in_world))?;
        Some((xy_px - seen.xy_px()).norm()).filter(|error| error.is_finite())
    }

    fn center(&self, image: ImageId) -> Option<Vector3<f64>> {
        self.index.of(image).map(|place| self.cameras.images[place as usize].cam_from_world.center())
    }
}

fn filter_shard(
    view: &Views<'_>,
    merged: &MergedShard,
    options: &AdjustOptions,
) -> (MergedShard, FilterCounts) {
    let kept: Vec<(Vec<Observation>, f64)> = merged
        .points
        .par_iter()
        .map(|point| kept_track(view, &point.x_in_world, merged.track(point), options))
        .collect();
    let mut counts = FilterCounts::default();
    let mut result = MergedShard::default();
    for (point, (track, sum_error_px)) in merged.points.iter().zip(kept) {
        counts.dropped_observations += u64::from(point.num_observations) - track.len() as u64;
        if track.is_empty() {
            counts.dropped_points += 1;
            continue;
        }
        counts.points += 1;
        counts.observations += track.len() as u64;
        counts.sum_error_px += sum_error_px;
        result.points.push(ScenePoint {
            first_observation: result.observations.len() as u64,
            num_observations: track.len() as u32,
            ..*point
        });
        result.observations.extend(track);
    }
    (result, counts)
}

/// The observations that a point keeps, none when it goes; and the sum of their errors in pixels.
fn kept_track(
    view: &Views<'_>,
    x_in_world: &Vector3<f64>,
    track: &[Observation],
    options: &AdjustOptions,
) -> (Vec<Observation>, f64) {
    let mut kept = Vec::with_capacity(track.len());
    let mut sum = 0.0;
    for seen in track {
        if let Some(error_px) = view.error_px(x_in_world, seen)
            && error_px <= options.max_error_px
        {
            kept.push(*seen);
            sum += error_px;
        }
    }
    let rays: Vec<Vector3<f64>> =
        kept.iter().filter_map(|seen| view.center(seen.image)).map(|center| center - x_in_world).collect();
    let wide = kept.len() >= 2 && is_wide(&rays, options.min_angle_deg.to_radians());
    if wide { (kept, sum) } else { (Vec::new(), 0.0) }
}

/// Whether two of the rays are at least so far apart.
fn is_wide(rays: &[Vector3<f64>], min_angle_rad: f64) -> bool {
    rays.iter()
        .enumerate()
        .any(|(at, first)| rays[at + 1..].iter().any(|second| first.angle(second) >= min_angle_rad))
}
