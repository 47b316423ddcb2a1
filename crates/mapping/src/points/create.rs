//! New observations and new points from the matches of an image.

use nalgebra::Vector3;
use rayon::prelude::*;
use terrane_geometry::Seed;
use terrane_geometry::triangulation::{self, View, triangulate_robust};

use super::{Limits, view};
use crate::model::{Model, PointId, Track};

/// Features of one point that are looked at together; a feature with more matches than this is a repeated texture.
const MAX_VIEWS: usize = 40;

/// What a feature without a point can become.
enum Proposal {
    /// An observation of this point.
    Continue { feature: u32, point: PointId },
    /// A point of its own with these features.
    Create { x_in_world: Vector3<f64>, features: Track },
}

/// Gives the features of an image points: those of their matches, or new ones. Returns how many features got one.
pub(crate) fn triangulate_image(model: &mut Model<'_>, image: usize, limits: Limits, seed: Seed) -> usize {
    let features: Vec<u32> =
        model.cluster.features_of(image).filter(|&feature| is_open(model, feature)).collect();
    let proposals: Vec<Option<Proposal>> =
        features.par_iter().with_min_len(32).map(|&feature| propose(model, feature, limits, seed)).collect();
    proposals.into_iter().flatten().map(|proposal| apply(model, proposal)).sum()
}

/// Whether a feature could get a point.
fn is_open(model: &Model<'_>, feature: u32) -> bool {
    let cluster = model.cluster;
    model.point_of(feature).is_none() && !cluster.neighbours(feature).is_empty() && !cluster.is_lone(feature)
}

fn apply(model: &mut Model<'_>, proposal: Proposal) -> usize {
    match proposal {
        Proposal::Continue { feature, point } => usize::from(model.add_observation(point, feature)),
        Proposal::Create { x_in_world, features } => {
            usize::from(model.add_point(x_in_world, &features).is_some())
        }
    }
}

fn propose(model: &Model<'_>, feature: u32, limits: Limits, seed: Seed) -> Option<Proposal> {
    continue_track(model, feature, limits.max_error_px)
        .map(|point| Proposal::Continue { feature, point })
        .or_else(|| create(model, feature, limits, seed))
}

/// The point of a match that the feature sees best within the error, if its image does not see that point already.
fn continue_track(model: &Model<'_>, feature: u32, max_error_px: f64) -> Option<PointId> {
    let image = model.cluster.image_of(feature);
    let mut best: Option<(f64, PointId)> = None;
    for &neighbour in model.cluster.neighbours(feature) {
        let Some(id) = model.point_of(neighbour) else { continue };
        if best.is_some_and(|(_, known)| known == id) || model.observes(id, image) {
            continue;
        }
        let Some(point) = model.point(id) else { continue };
        let Some(error_px) = model.error_px(&point.x_in_world, feature) else { continue };
        if error_px <= max_error_px && best.is_none_or(|(least, _)| error_px < least) {
            best = Some((error_px, id));
        }
    }
    best.map(|(_, id)| id)
}

/// A new point of the feature and those of its matches that agree.
fn create(model: &Model<'_>, feature: u32, limits: Limits, seed: Seed) -> Option<Proposal> {
    let mut features: Track = Track::new();
    features.push(feature);
    let free = |other: &&u32| model.point_of(**other).is_none();
    features.extend(model.cluster.neighbours(feature).iter().filter(free).take(MAX_VIEWS).copied());
    let mut views: Vec<View> = Vec::with_capacity(features.len());
    features.retain(|feature| match view(model, *feature) {
        Some(view) => {
            views.push(view);
            true
        }
        None => false,
    });
    if features.len() < 2 {
        return None;
    }
    let options = triangulation::TriangulationOptions {
        max_error_px: limits.max_error_px,
        min_angle_rad: limits.min_angle_rad,
        ..Default::default()
    };
    let found = triangulate_robust(&views, &options, seed.item(&[u64::from(feature)]))?;
    // Of several features in one image the model keeps the first: the better one comes first here.
    let mut agreeing: Vec<(f64, u32)> = Vec::with_capacity(found.inliers.len());
    for &at in &found.inliers {
        let feature = *features.get(at as usize)?;
        agreeing.push((model.error_px(&found.x_in_world, feature)?, feature));
    }
    agreeing.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let mut track = Track::new();
    for (_, feature) in agreeing {
        let image = model.cluster.image_of(feature);
        if track.iter().all(|other| model.cluster.image_of(*other) != image) {
            track.push(feature);
        }
    }
    let keeps = track.contains(&feature) && track.len() >= 2;
    keeps.then_some(Proposal::Create { x_in_world: found.x_in_world, features: track })
}

/// Tries again the matches of pairs that share few points, which drift or early bad poses have cost them. `attempts` counts
/// the tries of each pair. Returns how many features got a point.
pub(crate) fn retriangulate(
    model: &mut Model<'_>,
    attempts: &mut [u8],
    (min_ratio, max_attempts): (f64, u8),
    limits: Limits,
    seed: Seed,
) -> usize {
    let cluster = model.cluster;
    let candidates: Vec<usize> = (0..cluster.pairs.len())
        .into_par_iter()
        .filter(|&at| attempts[at] < max_attempts && is_under_reconstructed(model, at, min_ratio))
        .collect();
    let mut gained = 0;
    for at in candidates {
        attempts[at] += 1;
        let features: Vec<u32> = cluster
            .matches(&cluster.pairs[at])
            .filter(|&(a, b)| model.point_of(a).is_none() || model.point_of(b).is_none())
            .flat_map(|(a, b)| [a, b])
            .filter(|&feature| is_open(model, feature))
            .collect();
        let proposals: Vec<Option<Proposal>> = features
            .par_iter()
            .with_min_len(32)
            .map(|&feature| propose(model, feature, limits, seed))
            .collect();
        for proposal in proposals.into_iter().flatten() {
            gained += apply(model, proposal);
        }
    }
    gained
}

fn is_under_reconstructed(model: &Model<'_>, pair: usize, min_ratio: f64) -> bool {
    let pair = &model.cluster.pairs[pair];
    if !model.is_registered(pair.first) || !model.is_registered(pair.second) {
        return false;
    }
    let shares = |(a, b): (u32, u32)| model.point_of(a).is_some() && model.point_of(a) == model.point_of(b);
    let shared = model.cluster.matches(pair).filter(|&matched| shares(matched)).count();
    (shared as f64) < min_ratio * pair.source.matches.len() as f64
}
