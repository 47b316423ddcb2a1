//! Adding an image to the model: which one next, and its pose from points that it sees.

use nalgebra::{Vector2, Vector3};
use terrane_geometry::absolute_pose::{estimate_absolute_pose, estimate_absolute_pose_and_focal};
use terrane_geometry::ransac::RansacOptions;
use terrane_geometry::{Camera, Rigid3, Seed};

use crate::RegistrationOptions;
use crate::model::{Model, PointId};

/// Why an image could not be added.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Refusal {
    /// It sees too few points.
    TooFewPoints { visible: u32 },
    /// Too few of the points that it seems to see agree on a pose.
    TooFewInliers { inliers: usize, of: usize },
    /// It was in the model, and filtering took nearly all of its observations.
    LostSupport { min_observed: u32 },
    /// Adjustment gave its camera intrinsics that no camera has.
    InsaneCamera,
}

impl Refusal {
    /// In words.
    pub fn reason(&self, options: &RegistrationOptions) -> String {
        match self {
            Self::TooFewPoints { visible: 0 } => "it sees no point of a submap".to_owned(),
            Self::TooFewPoints { visible } => {
                format!("it sees {visible} points of a submap, {} are needed", options.min_inliers)
            }
            Self::TooFewInliers { inliers, of } => {
                format!("only {inliers} of its {of} matches to points agree on a pose")
            }
            Self::InsaneCamera => {
                "its camera fits the other images only with a focal length or distortion that no camera has"
                    .to_owned()
            }
            Self::LostSupport { min_observed } => {
                format!("fewer than {min_observed} of its observations held against the other images")
            }
        }
    }
}

/// An image's matches with points.
struct Correspondences {
    features: Vec<u32>,
    points: Vec<PointId>,
    x_in_world: Vec<Vector3<f64>>,
    xy_px: Vec<Vector2<f64>>,
}

/// Images that could be added, best first: those that see enough points, by how well these cover the image.
///
/// `score` of Schönberger & Frahm 2016, section 4.2; ties go to the lower image.
pub(crate) fn next_images(model: &Model<'_>, min_visible: u32) -> Vec<usize> {
    let mut images: Vec<usize> = (0..model.cluster.num_images())
        .filter(|&image| !model.is_registered(image) && model.visibility.num_visible(image) >= min_visible)
        .collect();
    images.sort_by_key(|&image| std::cmp::Reverse(model.visibility.score(image)));
    images
}

/// Estimates the pose of an image and adds it with those of its features that agree.
pub(crate) fn register(
    model: &mut Model<'_>,
    image: usize,
    options: &RegistrationOptions,
    seed: Seed,
) -> Result<(), Refusal> {
    let matched = correspondences(model, image);
    let of = matched.features.len();
    if of < options.min_inliers {
        return Err(Refusal::TooFewPoints { visible: of as u32 });
    }
    let (pose, camera, inliers) =
        estimate(model, image, &matched, options, seed).ok_or(Refusal::TooFewInliers { inliers: 0, of })?;
    // A feature may match several points; it counts once.
    let mut agreeing: Vec<u32> = inliers.iter().map(|&at| matched.features[at as usize]).collect();
    agreeing.dedup();
    let mut all = matched.features.clone();
    all.dedup();
    let enough = agreeing.len() >= options.min_inliers
        && agreeing.len() as f64 >= options.min_inlier_ratio * all.len() as f64;
    if !enough {
        return Err(Refusal::TooFewInliers { inliers: agreeing.len(), of: all.len() });
    }
    model.set_pose(image, pose);
    model.cameras[model.cluster.camera_of[image]] = camera;
    for at in inliers {
        model.add_observation(matched.points[at as usize], matched.features[at as usize]);
    }
    Ok(())
}

/// The points that each feature's matches belong to, ascending by feature.
fn correspondences(model: &Model<'_>, image: usize) -> Correspondences {
    let mut found = Correspondences {
        features: Vec::new(),
        points: Vec::new(),
        x_in_world: Vec::new(),
        xy_px: Vec::new(),
    };
    let mut ids: Vec<PointId> = Vec::new();
    for feature in model.cluster.features_of(image).filter(|&feature| model.visibility.is_visible(feature)) {
        ids.clear();
        ids.extend(model.cluster.neighbours(feature).iter().filter_map(|&other| model.point_of(other)));
        ids.sort_unstable();
        ids.dedup();
        for &id in &ids {
            if let Some(point) = model.point(id) {
                found.features.push(feature);
                found.points.push(id);
                found.x_in_world.push(point.x_in_world);
                found.xy_px.push(model.cluster.xy_px(feature));
            }
        }
    }
    found
}

fn estimate(
    model: &Model<'_>,
    image: usize,
    matched: &Correspondences,
    options: &RegistrationOptions,
    seed: Seed,
) -> Option<(Rigid3, Camera, Vec<u32>)> {
    let camera = *model.camera_of(image);
    let ransac = RansacOptions {
        max_iterations: options.max_iterations,
        confidence: options.confidence,
        ..RansacOptions::default()
    };
    let (points, xy_px) = (&matched.x_in_world, &matched.xy_px);
    if model.guessed[model.cluster.camera_of[image]] {
        let max_error_px = options.max_error_px;
        let found = estimate_absolute_pose_and_focal(points, xy_px, &camera, max_error_px, &ransac, seed)?;
        let (pose, camera) = found.model;
        return Some((pose, camera, found.inliers));
    }
    let found = estimate_absolute_pose(points, xy_px, &camera, options.max_error_px, &ransac, seed)?;
    Some((found.model, camera, found.inliers))
}
