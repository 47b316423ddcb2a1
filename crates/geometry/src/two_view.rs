//! The geometry of two views among outliers: essential and fundamental matrices, homographies, pure rotations, and the
//! relative poses that they imply.
//!
//! All are LO-RANSAC over minimal solvers with a non-linear local step. Points are on the plane z = 1 for essential matrices,
//! rotations and poses; in any unit, as pixels, for fundamental matrices and homographies. Thresholds have the points' unit.
//! Slices of one pair have equal length, and may arrive in falling order of quality (see [`ransac::SampleOrder`]).

mod estimators;
mod pose;
#[cfg(test)]
mod tests;

use nalgebra::{Matrix3, UnitQuaternion, Vector2};

pub use crate::epipolar::{essential_from_pose, squared_sampson_error};
pub use pose::{
    RelativePose, parallax_angle_rad, pose_from_essential, pose_from_homography, poses_from_homography,
    refine_relative_pose,
};

use crate::Seed;
use crate::epipolar::Normalized;
use crate::ransac::{self, RansacOptions, Robust};
use estimators::{Essentials, Fundamentals, Homographies, Rotations};

/// The essential matrix `second ᵀ E first = 0` (Frobenius norm one) that most correspondences agree with.
///
/// Five-point solver (Nistér 2004); Sampson errors, local refinement over rotation and direction. `None` when lengths differ
/// or no sample gives a matrix that five agree with.
pub fn estimate_essential(
    first: &[Vector2<f64>],
    second: &[Vector2<f64>],
    threshold: f64,
    options: &RansacOptions,
    seed: Seed,
) -> Option<Robust<Matrix3<f64>>> {
    ransac::run(&Essentials::new(first, second, threshold)?, options, seed)
}

/// The fundamental matrix `second ᵀ F first = 0` (Frobenius norm one) that most correspondences agree with.
///
/// Seven-point solver on normalised points; Sampson errors, local refinement over matrices of rank two. `None` as for
/// [`estimate_essential`].
pub fn estimate_fundamental(
    first: &[Vector2<f64>],
    second: &[Vector2<f64>],
    threshold: f64,
    options: &RansacOptions,
    seed: Seed,
) -> Option<Robust<Matrix3<f64>>> {
    let normalized = Normalized::new(first, second)?;
    let found = ransac::run(&Fundamentals::new(&normalized, threshold), options, seed)?;
    let matrix = normalized.second_transform().transpose() * found.model * normalized.first_transform();
    Some(in_unit(found, matrix.normalize(), normalized.scale))
}

/// The homography `second ∝ H first` (Frobenius norm one, positive on its points) that most correspondences agree with.
///
/// Four-point solver; transfer errors in the second image, local refinement over all eight unknowns. `None` as for
/// [`estimate_essential`].
pub fn estimate_homography(
    first: &[Vector2<f64>],
    second: &[Vector2<f64>],
    threshold: f64,
    options: &RansacOptions,
    seed: Seed,
) -> Option<Robust<Matrix3<f64>>> {
    let normalized = Normalized::new(first, second)?;
    let found = ransac::run(&Homographies::new(&normalized, threshold), options, seed)?;
    let matrix = normalized.second_inverse() * found.model * normalized.first_transform();
    Some(in_unit(found, matrix.normalize(), normalized.scale))
}

/// The rotation `second_from_first` that alone explains most correspondences: what a camera that only turned would show.
///
/// Two-point solver (Horn 1987); transfer errors on the plane z = 1. A pair of which nearly all inliers of the essential matrix
/// are inliers here has no usable baseline. `None` as for [`estimate_essential`].
pub fn estimate_rotation(
    first: &[Vector2<f64>],
    second: &[Vector2<f64>],
    threshold: f64,
    options: &RansacOptions,
    seed: Seed,
) -> Option<Robust<UnitQuaternion<f64>>> {
    ransac::run(&Rotations::new(first, second, threshold)?, options, seed)
}

/// A result of normalised points in the caller's unit.
fn in_unit(found: Robust<Matrix3<f64>>, model: Matrix3<f64>, scale: f64) -> Robust<Matrix3<f64>> {
    Robust { model, inliers: found.inliers, cost: found.cost / (scale * scale), iterations: found.iterations }
}
