//! Aligning two overlapping submaps: a similarity, its certainty and the evidence, or the reason there is none.
//!
//! Shared tracks (points that own the same feature of the same image in both) give the similarity by LO-RANSAC;
//! shared cameras check it; ICP on the overlapping points refines it, or rescues a seam with few shared tracks.

pub mod icp;

use nalgebra::SMatrix;
use serde::{Deserialize, Serialize};
use terrane_geometry::Sim3;

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
