//! Matching and verification of a pair as one step, so that its geometry can guide the search for matches.

use nalgebra::Vector2;
use serde::{Deserialize, Serialize};
use terrane_geometry::Seed;
use terrane_geometry::two_view::essential_from_pose;
use terrane_scene::{
    CameraRecord, DESCRIPTOR_LEN, DescriptorKind, Features, ImagePair, Keypoint, MatchedPair,
};

use super::models::{self, Geometry, Guiding};
use super::{Candidate, Correspondences, NotVerified, VerificationOptions, View};
use crate::matching::guided::{Guide, GuidedSide, match_guided};
use crate::matching::{Match, MatchOptions, match_features};

/// When matches are looked for along epipolar lines.
///
/// Measured with 8,192 features an image on Strecha's fountain (AVX2): guided first, a pair takes half the time of comparing all
/// with all and has a quarter more matches. But along lines that are wrong, some sixty features match by chance, as on pairs of
/// the castle's courtyard that see different walls: hence off by default.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GuidedMatching {
    /// Never: all features are compared with all.
    #[default]
    Off,
    /// After all were compared with all and the pair was verified.
    After,
    /// In place of comparing all with all, where the strongest features ([`STRONGEST`] of each image) verify the pair;
    /// elsewhere after it.
    First,
}

/// How many features of each image give the geometry that guides the others.
pub const STRONGEST: usize = 2048;

/// One image of a pair that is not matched yet.
#[derive(Clone, Copy, Debug)]
pub struct Photograph<'a> {
    /// The camera that took it.
    pub camera: &'a CameraRecord,
    /// Its features.
    pub features: &'a Features,
}

/// Matches and verifies a pair, the image with the lower id first. As [`super::verify`] on the matches of all features, which
/// `match_all` gives, unless `options.guided` says otherwise. Binary descriptors are not guided.
///
/// # Errors
/// As [`super::verify`].
pub fn match_and_verify(
    pair: ImagePair,
    both: [&Photograph<'_>; 2],
    match_all: impl FnOnce() -> Vec<Match>,
    matching: &MatchOptions,
    options: &VerificationOptions,
    seed: Seed,
) -> Result<MatchedPair, NotVerified> {
    let guided = match both.iter().all(|side| side.features.kind == DescriptorKind::Bytes128) {
        true => options.guided,
        false => GuidedMatching::Off,
    };
    if guided == GuidedMatching::First
        && both.iter().all(|side| side.features.len() > STRONGEST)
        && let Some(found) = guided_by_strongest(pair, both, matching, options, seed)
    {
        return Ok(found);
    }
    let matches = match_all();
    let candidate = candidate(pair, both, &matches);
    if guided == GuidedMatching::Off {
        return super::verify(&candidate, options, seed);
    }
    let (points, geometry) = super::geometry(&candidate, options, seed)?;
    let before = points.matched_pair(pair, &geometry);
    let after = extended(pair, both, geometry, matching, options);
    Ok(after.filter(|after| after.matches.len() > before.matches.len()).unwrap_or(before))
}

fn candidate<'a>(pair: ImagePair, both: [&Photograph<'a>; 2], matches: &'a [Match]) -> Candidate<'a> {
    let [first, second] = both.map(|side| View { camera: side.camera, keypoints: &side.features.keypoints });
    Candidate { pair, first, second, matches }
}

/// `None` when the strongest features do not verify the pair.
fn guided_by_strongest(
    pair: ImagePair,
    both: [&Photograph<'_>; 2],
    matching: &MatchOptions,
    options: &VerificationOptions,
    seed: Seed,
) -> Option<MatchedPair> {
    let [first, second] = both.map(|side| Features {
        keypoints: side.features.keypoints[..STRONGEST].to_vec(),
        descriptors: side.features.descriptors[..STRONGEST * DESCRIPTOR_LEN].to_vec(),
        ..Features::default()
    });
    let matches = match_features(&first, &second, matching);
    let (_, geometry) = super::geometry(&candidate(pair, both, &matches), options, seed).ok()?;
    extended(pair, both, geometry, matching, options)
}

/// The pair with the matches that its geometry guides to; `None` when it guides to none, or too few agree in the end.
fn extended(
    pair: ImagePair,
    both: [&Photograph<'_>; 2],
    geometry: Geometry,
    matching: &MatchOptions,
    options: &VerificationOptions,
) -> Option<MatchedPair> {
    let in_pixels = matches!(geometry.guide?, Guiding::Fundamental(_));
    let guide = match geometry.guide? {
        Guiding::Pose(pose) => Guide::Epipolar(essential_from_pose(&pose.second_from_first)),
        Guiding::Fundamental(matrix) => Guide::Epipolar(matrix),
        Guiding::Rotation(rotation) => Guide::Homography(rotation.to_rotation_matrix().into_inner()),
    };
    let cameras = both.map(|side| side.camera.camera);
    let mean_unit = cameras.iter().map(|camera| camera.normalized_from_px(1.0)).sum::<f64>() / 2.0;
    let max_error = options.max_error_px * if in_pixels { 1.0 } else { mean_unit };
    let positions = both.map(|side| {
        let pixel = |keypoint: &Keypoint| Vector2::new(f64::from(keypoint.x_px), f64::from(keypoint.y_px));
        let pixels = side.features.keypoints.iter().map(pixel);
        let normalized =
            |pixel: Vector2<f64>| side.camera.camera.unproject(&pixel).unwrap_or(Vector2::repeat(f64::NAN));
        if in_pixels { pixels.collect::<Vec<_>>() } else { pixels.map(normalized).collect() }
    });
    let side = |k: usize| GuidedSide { positions: &positions[k], descriptors: &both[k].features.descriptors };
    let matches = match_guided(&side(0), &side(1), &guide, max_error, matching);
    let points = Correspondences::new(&candidate(pair, both, &matches), options);
    let geometry = models::with_more(&points, geometry);
    let enough = geometry.inliers.len() >= options.min_inliers.max(8) as usize;
    enough.then(|| points.matched_pair(pair, &geometry))
}
