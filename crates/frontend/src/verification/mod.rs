//! Which matches of a pair agree with one two-view geometry, and what kind it is.
//!
//! An essential matrix is looked for with the intrinsics at hand, and a fundamental matrix where it might explain more;
//! a homography and a pure rotation are tried on what agrees. The kind follows from the shares of inliers, as in COLMAP
//! (Schönberger & Frahm 2016). Matches that stay at one place near the border are a watermark, not a scene.

mod agreement;
mod correspondences;
mod guided;
mod models;
mod pose;
#[cfg(test)]
mod tests;

use serde::{Deserialize, Serialize};
use terrane_geometry::Seed;
use terrane_geometry::ransac::{RansacOptions, SampleOrder};
use terrane_scene::{CameraRecord, ImagePair, Keypoint, MatchedPair};

use crate::matching::Match;
use correspondences::Correspondences;
pub use guided::{GuidedMatching, Photograph, STRONGEST, match_and_verify};
use models::Geometry;

/// One image of a pair.
#[derive(Clone, Copy, Debug)]
pub struct View<'a> {
    /// The camera that took it.
    pub camera: &'a CameraRecord,
    /// Its keypoints, in pixels.
    pub keypoints: &'a [Keypoint],
}

/// A pair to verify.
#[derive(Clone, Copy, Debug)]
pub struct Candidate<'a> {
    /// The images.
    pub pair: ImagePair,
    /// The image with the lower id.
    pub first: View<'a>,
    /// The image with the higher id.
    pub second: View<'a>,
    /// What looks alike; any order.
    pub matches: &'a [Match],
}

/// How pairs are verified.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct VerificationOptions {
    /// Greatest distance of an inlier from the geometry in pixels, above 0: Sampson error for epipolar geometry, transfer
    /// error for homographies and rotations. Default 4 (COLMAP).
    pub max_error_px: f64,
    /// Fewest inliers of a verified pair, at least 8. Default 15 (COLMAP).
    pub min_inliers: u32,
    /// The essential matrix is preferred when it has at least this share of the fundamental matrix's inliers. Default
    /// 0.95 (COLMAP).
    pub min_essential_share: f64,
    /// The pair is planar when a homography has at least this share of the inliers. Default 0.8 (COLMAP).
    pub min_planar_share: f64,
    /// The pair has no baseline when a rotation alone has at least this share of the inliers. Default 0.9.
    pub min_rotation_share: f64,
    /// Width of the border in which a watermark is looked for, as a share of the image's diagonal. Default 0.1 (COLMAP).
    pub watermark_border: f64,
    /// The pair is a watermark when at least this share of its inliers stays at its place in the border. Default 0.7
    /// (COLMAP).
    pub min_watermark_share: f64,
    /// Whether [`match_and_verify`] looks for more matches along epipolar lines. Default: see [`GuidedMatching`].
    pub guided: GuidedMatching,
    /// Sampling. Matches come in falling order of quality, so progressive sampling finds what there is early. Default: 30
    /// to 3000 samples with confidence 0.9999, progressive.
    pub ransac: RansacOptions,
}

impl Default for VerificationOptions {
    fn default() -> Self {
        Self {
            max_error_px: 4.0,
            min_inliers: 15,
            min_essential_share: 0.95,
            min_planar_share: 0.8,
            min_rotation_share: 0.9,
            watermark_border: 0.1,
            min_watermark_share: 0.7,
            guided: GuidedMatching::default(),
            ransac: RansacOptions {
                max_iterations: 3000,
                min_iterations: 30,
                confidence: 0.9999,
                order: SampleOrder::FallingQuality,
            },
        }
    }
}

/// Why a pair was not verified.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, thiserror::Error)]
#[serde(rename_all = "snake_case", tag = "reason")]
pub enum NotVerified {
    /// Fewer matches than inliers are asked for.
    #[error("{found} usable matches are fewer than the {needed} inliers asked for")]
    TooFewMatches {
        /// Matches of existing keypoints within the cameras' domains.
        found: u32,
        /// Inliers asked for.
        needed: u32,
    },
    /// No geometry has enough inliers.
    #[error("at most {found} of {matches} matches agree on a geometry, {needed} are asked for")]
    TooFewInliers {
        /// Most inliers of any geometry.
        found: u32,
        /// Usable matches.
        matches: u32,
        /// Inliers asked for.
        needed: u32,
    },
}

/// Verifies a pair: its kind, its inliers, and the best estimate of the relative pose.
///
/// The seed is the stage's; the pair's own is derived from it. Same input, options and seed give the same result. Intrinsics
/// that are guessed still give a pose, the best there is, but the pair is then `Uncalibrated` unless it is planar or has no
/// baseline.
pub fn verify(
    candidate: &Candidate<'_>,
    options: &VerificationOptions,
    seed: Seed,
) -> Result<MatchedPair, NotVerified> {
    let (points, geometry) = geometry(candidate, options, seed)?;
    Ok(points.matched_pair(candidate.pair, &geometry))
}

fn geometry(
    candidate: &Candidate<'_>,
    options: &VerificationOptions,
    seed: Seed,
) -> Result<(Correspondences, Geometry), NotVerified> {
    let needed = options.min_inliers.max(8);
    let points = Correspondences::new(candidate, options);
    if points.len() < needed as usize {
        return Err(NotVerified::TooFewMatches { found: points.len() as u32, needed });
    }
    let seed = seed.item(&[u64::from(candidate.pair.first().0), u64::from(candidate.pair.second().0)]);
    let geometry = models::choose(&points, options, seed);
    if geometry.inliers.len() < needed as usize {
        let found = geometry.inliers.len() as u32;
        return Err(NotVerified::TooFewInliers { found, matches: points.len() as u32, needed });
    }
    Ok((points, geometry))
}
