//! Longer tracks: further observations of a point, and points that are one and the same.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::Limits;
use crate::model::{Model, PointId, Track};

/// Adds to each point the features that its own are matched to, directly or over up to `depth` matches, where they see it
/// within the error. Returns how many observations were added.
pub(crate) fn complete(model: &mut Model<'_>, ids: &[PointId], depth: u32, limits: Limits) -> usize {
    let proposals: Vec<Vec<u32>> = ids
        .par_iter()
        .with_min_len(64)
        .map(|&id| further_observations(model, id, depth, limits.max_error_px))
        .collect();
    let mut added = 0;
    for (&id, features) in ids.iter().zip(proposals) {
        added += features.into_iter().filter(|&feature| model.add_observation(id, feature)).count();
    }
    added
}

/// Features that may be added to a point, nearest in matches first; of one image that with the least error.
fn further_observations(model: &Model<'_>, id: PointId, depth: u32, max_error_px: f64) -> Vec<u32> {
    let Some(point) = model.point(id) else { return Vec::new() };
    let mut found: Vec<u32> = Vec::new();
    let mut frontier: Vec<u32> = point.track.to_vec();
    for _ in 0..depth {
        let mut candidates: Vec<(usize, f64, u32)> = Vec::new();
        for &neighbour in frontier.iter().flat_map(|&feature| model.cluster.neighbours(feature)) {
            let image = model.cluster.image_of(neighbour);
            let known = found.iter().any(|&other| model.cluster.image_of(other) == image);
            if model.point_of(neighbour).is_some() || known || model.observes(id, image) {
                continue;
            }
            match model.error_px(&point.x_in_world, neighbour) {
                Some(error_px) if error_px <= max_error_px => candidates.push((image, error_px, neighbour)),
                _ => {}
            }
        }
        candidates.sort_unstable_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.2.cmp(&b.2)));
        candidates.dedup_by_key(|candidate| candidate.0);
        frontier = candidates.into_iter().map(|candidate| candidate.2).collect();
        if frontier.is_empty() {
            break;
        }
        found.extend_from_slice(&frontier);
    }
    found
}

/// Joins points whose features are matched to each other and which fit one position. Returns how many points went away.
pub(crate) fn merge(model: &mut Model<'_>, ids: &[PointId], limits: Limits) -> usize {
    // Most points have no such neighbour; finding that out is the expensive part and needs no order.
    let candidates: Vec<PointId> = ids
        .par_iter()
        .with_min_len(64)
        .copied()
        .filter(|&id| other_point(model, id, &[]).is_some())
        .collect();
    let mut merged = 0;
    for id in candidates {
        let mut refused: Vec<PointId> = Vec::new();
        let mut id = id;
        while let Some(other) = other_point(model, id, &refused) {
            match merge_two(model, id, other, limits.max_error_px) {
                Some(joined) => {
                    merged += 1;
                    id = joined;
                }
                None => refused.push(other),
            }
        }
    }
    merged
}

/// The first point other than these that a feature of the point is matched to.
fn other_point(model: &Model<'_>, id: PointId, refused: &[PointId]) -> Option<PointId> {
    let track = &model.point(id)?.track;
    track
        .iter()
        .flat_map(|&feature| model.cluster.neighbours(feature))
        .filter_map(|&neighbour| model.point_of(neighbour))
        .find(|other| *other != id && !refused.contains(other))
}

/// The joined point, when every feature of both sees it within the error.
fn merge_two(model: &mut Model<'_>, a: PointId, b: PointId, max_error_px: f64) -> Option<PointId> {
    let (first, second) = (model.point(a)?, model.point(b)?);
    let (n, m) = (first.track.len() as f64, second.track.len() as f64);
    let x_in_world: Vector3<f64> = (first.x_in_world * n + second.x_in_world * m) / (n + m);
    let mut features: Vec<(usize, f64, u32)> = Vec::with_capacity(first.track.len() + second.track.len());
    for &feature in first.track.iter().chain(&second.track) {
        let error_px = model.error_px(&x_in_world, feature)?;
        if error_px > max_error_px {
            return None;
        }
        features.push((model.cluster.image_of(feature), error_px, feature));
    }
    // Where both have a feature in one image, the one that fits better stays.
    features.sort_unstable_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.2.cmp(&b.2)));
    features.dedup_by_key(|feature| feature.0);
    let track: Track = features.into_iter().map(|feature| feature.2).collect();
    model.remove_point(a);
    model.remove_point(b);
    model.add_point(x_in_world, &track)
}
