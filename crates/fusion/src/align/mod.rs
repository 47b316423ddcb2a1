//! Aligning two overlapping submaps: a similarity, its certainty and the evidence, or the reason there is none.
//!
//! Shared tracks (points that own the same feature of the same image in both) give the similarity by LO-RANSAC;
//! shared cameras check it; ICP on the overlapping points refines it, or rescues a seam with few shared tracks.

mod cameras;
pub mod icp;
#[cfg(test)]
mod tests;
pub(crate) mod tracks;

use nalgebra::{SMatrix, Vector3};
use serde::{Deserialize, Serialize};
use terrane_geometry::ransac::{self, RansacOptions};
use terrane_geometry::{Seed, Sim3};
use terrane_scene::{ImageId, Reconstruction};

use self::tracks::{Correspondence, SharedCamera, SimilarityEstimator};
use crate::SubmapSummary;

/// Standard deviation of a camera's centre within its submap, as a fraction of the median depth.
const CENTER_SIGMA: f64 = 0.005;
/// Independent measurements that the points around one shared camera are worth.
const POINTS_PER_CAMERA: f64 = 4.0;

/// How two submaps are aligned. Lengths are relative, so that they mean the same in any submap's unit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AlignOptions {
    /// Largest distance of a shared point's two places, as a fraction of its distance to the nearest shared camera.
    /// Range: above 0. Default 0.02: at 1,000 px focal length and a 5° angle, 2 px of error are 2 % of depth.
    pub max_relative_distance: f64,
    /// Shared points that a seam needs to stand on tracks alone. Range: at least 4. Default 30.
    pub min_shared_points: u32,
    /// Part of the shared points that must agree. Range: 0 to 1. Default 0.3: below it, wrong is as likely as right.
    pub min_inlier_ratio: f64,
    /// Shared cameras that must confirm the similarity (or all of them, when fewer are shared). Default 3.
    pub min_shared_cameras: u32,
    /// Largest median rotation disagreement of the shared cameras, in degrees. Default 3.
    pub max_camera_rotation_deg: f64,
    /// Largest median disagreement of the shared cameras' centres, as a fraction of the median scene depth.
    /// Default 0.05.
    pub max_camera_distance: f64,
    /// Most RANSAC iterations. Default 2,000.
    pub max_iterations: u32,
    /// Refinement by ICP on the overlapping points.
    pub icp: icp::IcpOptions,
}

impl Default for AlignOptions {
    fn default() -> Self {
        Self {
            max_relative_distance: 0.02,
            min_shared_points: 30,
            min_inlier_ratio: 0.3,
            min_shared_cameras: 3,
            max_camera_rotation_deg: 3.0,
            max_camera_distance: 0.05,
            max_iterations: 2000,
            icp: icp::IcpOptions::default(),
        }
    }
}

/// The numbers that a verdict stands on. Lengths are in units of submap b unless they are said to be relative.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SeamEvidence {
    /// Images registered in both.
    pub num_shared_cameras: u32,
    /// Pairs of points that own a common observation.
    pub num_shared_points: u32,
    /// Those that agree with the similarity.
    pub num_inliers: u32,
    /// RMS distance of the agreeing points after alignment.
    pub point_rms: f64,
    /// Median rotation disagreement of the shared cameras, in degrees.
    pub camera_rotation_deg: f64,
    /// Median disagreement of the shared cameras' centres.
    pub camera_distance: f64,
    /// Median depth of b's points, to judge the lengths by.
    pub median_depth: f64,
    /// Shared cameras within both bounds.
    pub num_agreeing_cameras: u32,
    /// What ICP did; `None` when it was not run.
    pub icp: Option<icp::IcpReport>,
}

/// What became of a seam.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "verdict")]
#[expect(clippy::large_enum_variant, reason = "a run has few seams, and most are accepted")]
pub enum SeamVerdict {
    /// The submaps fit.
    Accepted {
        /// The similarity from a's frame to b's.
        b_from_a: Sim3,
        /// Information (inverse covariance) of the left perturbation `(ω, v, λ)` of `b_from_a`.
        information: SMatrix<f64, 7, 7>,
    },
    /// They don't, or it can't be told.
    Refused {
        /// Why, in words.
        reason: String,
    },
}

/// A verdict with its evidence.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SeamOutcome {
    /// What became of the seam.
    pub verdict: SeamVerdict,
    /// What it stands on.
    pub evidence: SeamEvidence,
}

impl SeamOutcome {
    /// The similarity and its information, when accepted.
    pub fn accepted(&self) -> Option<(&Sim3, &SMatrix<f64, 7, 7>)> {
        match &self.verdict {
            SeamVerdict::Accepted { b_from_a, information } => Some((b_from_a, information)),
            SeamVerdict::Refused { .. } => None,
        }
    }
}

/// A seam between two submaps, by their numbers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Seam {
    /// The submap that `b_from_a` takes points from.
    pub a: u32,
    /// The submap that it takes them to.
    pub b: u32,
    /// What became of it.
    pub outcome: SeamOutcome,
}

/// Aligns submap a to submap b.
///
/// The similarity comes from the shared points and the centres of the shared cameras by LO-RANSAC with thresholds of
/// each point's own uncertainty (Chum, Matas & Kittler 2003; Umeyama 1991); where points are too few, from the poses
/// of the shared cameras. ICP on the points that shared cameras see refines it where that does not contradict the
/// shared tracks, and carries it where there are none.
pub fn align(a: &Reconstruction, b: &Reconstruction, options: &AlignOptions, seed: Seed) -> SeamOutcome {
    let cameras = tracks::shared_cameras(a, b);
    let points = tracks::shared_points(a, b);
    let data = tracks::correspondences(a, b, &cameras, &points, options.max_relative_distance);
    let mut evidence = SeamEvidence {
        num_shared_cameras: cameras.len() as u32,
        num_shared_points: data.len() as u32,
        median_depth: SubmapSummary::of(b, 0).median_depth,
        ..Default::default()
    };
    let refused =
        |reason: String, evidence| SeamOutcome { verdict: SeamVerdict::Refused { reason }, evidence };
    if cameras.is_empty() {
        return refused("no image is registered in both submaps".to_owned(), evidence);
    }
    let on_tracks = from_tracks(&data, options, seed);
    let Some(start) = on_tracks.or_else(|| cameras::similarity(&cameras)) else {
        let reason = format!(
            "{} shared points give no similarity, and neither does {} shared camera(s)",
            data.len(),
            cameras.len()
        );
        return refused(reason, evidence);
    };
    let (b_from_a, icp) = refine_by_icp(a, b, start, &data, (&cameras, on_tracks.is_some()), options);
    evidence.icp = icp;
    (evidence.point_rms, evidence.num_inliers) = tracks::fit(&data, &b_from_a);
    let max_distance = options.max_camera_distance * evidence.median_depth;
    let agreement = cameras::agreement(&cameras, &b_from_a, options.max_camera_rotation_deg, max_distance);
    evidence.camera_rotation_deg = agreement.rotation_deg;
    evidence.camera_distance = agreement.distance;
    evidence.num_agreeing_cameras = agreement.num_agreeing;
    if let Some(reason) = objection(&evidence, on_tracks.is_some(), options) {
        return refused(reason, evidence);
    }
    let information = seam_information(&data, &cameras, &b_from_a, evidence.median_depth);
    SeamOutcome { verdict: SeamVerdict::Accepted { b_from_a, information }, evidence }
}

/// The similarity that enough shared points agree with.
fn from_tracks(data: &[Correspondence], options: &AlignOptions, seed: Seed) -> Option<Sim3> {
    let ransac_options = RansacOptions {
        max_iterations: options.max_iterations.max(1),
        min_iterations: 50,
        ..Default::default()
    };
    let robust = ransac::run(&SimilarityEstimator { data }, &ransac_options, seed)?;
    let enough = robust.inliers.len() >= options.min_shared_points.max(4) as usize
        && robust.inliers.len() as f64 >= options.min_inlier_ratio * data.len() as f64;
    enough.then(|| (0..5).fold(robust.model, |model, _| tracks::refine(data, &model).unwrap_or(model)))
}

/// Refines by ICP; keeps the result unless shared tracks fit worse with it.
fn refine_by_icp(
    a: &Reconstruction,
    b: &Reconstruction,
    start: Sim3,
    data: &[Correspondence],
    (cameras, on_tracks): (&[SharedCamera], bool),
    options: &AlignOptions,
) -> (Sim3, Option<icp::IcpReport>) {
    if !options.icp.enabled {
        return (start, None);
    }
    let source = overlap_points(a, cameras, options.icp.max_points);
    let target = overlap_points(b, cameras, options.icp.max_points);
    let Some((refined, mut report)) = icp::align_points(&source, &target, &start, &options.icp) else {
        return (start, None);
    };
    report.used = match on_tracks {
        true => tracks::cost(data, &refined) < tracks::cost(data, &start),
        false => report.final_rms < report.initial_rms,
    };
    (if report.used { refined } else { start }, Some(report))
}

/// Points that shared cameras see, at most `max_points`, evenly by index.
fn overlap_points(submap: &Reconstruction, cameras: &[SharedCamera], max_points: u32) -> Vec<Vector3<f64>> {
    let is_shared = |image: ImageId| cameras.binary_search_by_key(&image, |camera| camera.image).is_ok();
    let all: Vec<Vector3<f64>> = submap
        .points
        .iter()
        .filter(|point| submap.track(point).iter().any(|seen| is_shared(seen.image)))
        .map(|point| point.x_in_world)
        .filter(|x| x.iter().all(|value| value.is_finite()))
        .collect();
    let step = all.len().div_ceil(max_points.max(1) as usize).max(1);
    all.into_iter().step_by(step).collect()
}

/// Why the evidence does not carry the seam, if it doesn't.
fn objection(evidence: &SeamEvidence, on_tracks: bool, options: &AlignOptions) -> Option<String> {
    let cameras = evidence.num_shared_cameras;
    let needed = options.min_shared_cameras.min(cameras);
    if evidence.num_agreeing_cameras < needed {
        return Some(format!(
            "{} of {cameras} shared cameras agree, {needed} are needed (median {:.2} degrees, {:.3} of the depth)",
            evidence.num_agreeing_cameras,
            evidence.camera_rotation_deg,
            evidence.camera_distance / evidence.median_depth
        ));
    }
    if 2 * evidence.num_agreeing_cameras < cameras {
        return Some(format!(
            "only {} of {cameras} shared cameras agree with the shared points",
            evidence.num_agreeing_cameras
        ));
    }
    if !on_tracks {
        if cameras < options.min_shared_cameras {
            return Some(format!(
                "{} shared points agree, {} are needed, and {cameras} shared camera(s) are too few without them",
                evidence.num_inliers, options.min_shared_points
            ));
        }
        let carried =
            evidence.icp.as_ref().is_some_and(|icp| icp.used && icp.num_matches >= options.min_shared_points);
        let confirmed = evidence.num_inliers * 2 >= evidence.num_shared_points && evidence.num_inliers >= 4;
        if !carried && !confirmed {
            return Some(format!(
                "{} of {} shared points agree, and the clouds of the overlap do not confirm the shared cameras",
                evidence.num_inliers, evidence.num_shared_points
            ));
        }
    }
    None
}

/// Information from points and camera centres. Each shared camera's surroundings count as a few measurements.
fn seam_information(
    data: &[Correspondence],
    cameras: &[SharedCamera],
    b_from_a: &Sim3,
    median_depth: f64,
) -> SMatrix<f64, 7, 7> {
    let centers: Vec<Correspondence> = cameras
        .iter()
        .map(|camera| Correspondence {
            x_in_a: camera.cam_from_a.center(),
            x_in_b: camera.cam_from_b.center(),
            sigma: CENTER_SIGMA * median_depth,
            threshold: f64::INFINITY,
        })
        .collect();
    let effective = POINTS_PER_CAMERA * cameras.len() as f64;
    tracks::information(data, b_from_a, effective) + tracks::information(&centers, b_from_a, f64::INFINITY)
}
