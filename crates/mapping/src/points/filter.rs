//! Observations, points and images that do not hold.

use rayon::prelude::*;

use super::{Limits, has_angle};
use crate::model::{Model, PointId};

/// What remains of a point.
enum Verdict {
    Keep,
    Drop,
    Trim(Vec<u32>),
}

/// Removes observations beyond the error or behind their camera, and points without two views or without angle. Returns how
/// many observations went.
pub(crate) fn filter(model: &mut Model<'_>, ids: &[PointId], limits: Limits) -> usize {
    let verdicts: Vec<Verdict> =
        ids.par_iter().with_min_len(64).map(|&id| judge(model, id, limits)).collect();
    let before = model.num_observations();
    for (&id, verdict) in ids.iter().zip(verdicts) {
        match verdict {
            Verdict::Keep => {}
            Verdict::Drop => model.remove_point(id),
            Verdict::Trim(features) => {
                features.into_iter().for_each(|feature| model.remove_observation(feature))
            }
        }
    }
    before - model.num_observations()
}

fn judge(model: &Model<'_>, id: PointId, limits: Limits) -> Verdict {
    let Some(point) = model.point(id) else { return Verdict::Keep };
    let good = |feature: &u32| {
        model.error_px(&point.x_in_world, *feature).is_some_and(|error_px| error_px <= limits.max_error_px)
    };
    let (kept, removed): (Vec<u32>, Vec<u32>) = point.track.iter().copied().partition(good);
    if kept.len() < 2 || !has_angle(model, &point.x_in_world, &kept, limits.min_angle_rad) {
        Verdict::Drop
    } else if removed.is_empty() {
        Verdict::Keep
    } else {
        Verdict::Trim(removed)
    }
}

/// Takes out images that see fewer points than this; they are held by too little. Returns which.
pub(crate) fn remove_weak_images(model: &mut Model<'_>, min_observed: u32) -> Vec<usize> {
    let weak: Vec<usize> =
        model.registered().into_iter().filter(|&image| model.num_observed(image) < min_observed).collect();
    for &image in &weak {
        model.deregister(image);
    }
    weak
}
