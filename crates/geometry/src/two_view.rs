//! The geometry of two views among outliers: essential and fundamental matrices, homographies, pure rotations, and the
//! relative poses that they imply.
//!
//! All are LO-RANSAC over minimal solvers with a non-linear local step. Points are on the plane z = 1 for essential matrices,
//! rotations and poses; in any unit, as pixels, for fundamental matrices and homographies. Thresholds have the points' unit.
//! Slices of one pair have equal length, and may arrive in falling order of quality (see [`ransac::SampleOrder`]).

mod columns;
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

/// A fundamental matrix improved on the correspondences that agree with it, with those that then do.
///
/// As the last step of [`estimate_fundamental`], from a matrix that is known already, as that of an essential matrix. `None` when
/// fewer than eight agree.
pub fn improve_fundamental(
    start: &Matrix3<f64>,
    first: &[Vector2<f64>],
    second: &[Vector2<f64>],
    threshold: f64,
) -> Option<Robust<Matrix3<f64>>> {
    let none = RansacOptions { max_iterations: 0, ..RansacOptions::default() };
    estimate_fundamental_from(Some(start), first, second, threshold, &none, Seed(0))
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
    estimate_fundamental_from(None, first, second, threshold, options, seed)
}

/// [`estimate_fundamental`] with a matrix that is known beforehand, as that of an essential matrix: samples must do better, and
/// fewer are drawn when it is good.
pub fn estimate_fundamental_from(
    start: Option<&Matrix3<f64>>,
    first: &[Vector2<f64>],
    second: &[Vector2<f64>],
    threshold: f64,
    options: &RansacOptions,
    seed: Seed,
) -> Option<Robust<Matrix3<f64>>> {
    let normalized = Normalized::new(first, second)?;
    let (to_first, to_second) = (normalized.first_transform(), normalized.second_transform());
    let start = start.and_then(|matrix| {
        let moved = normalized.second_inverse().transpose() * matrix * normalized.first_inverse();
        moved.iter().all(|value| value.is_finite()).then(|| moved.normalize())
    });
    let found = ransac::run_from(&Fundamentals::new(&normalized, threshold), start, options, seed)?;
    let matrix = to_second.transpose() * found.model * to_first;
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
    homography_with(first, second, threshold, 0.0, options, seed)
}

fn homography_with(
    first: &[Vector2<f64>],
    second: &[Vector2<f64>],
    threshold: f64,
    min_share: f64,
    options: &RansacOptions,
    seed: Seed,
) -> Option<Robust<Matrix3<f64>>> {
    let normalized = Normalized::new(first, second)?;
    let found = ransac::run(&Homographies::new(&normalized, threshold, min_share), options, seed)?;
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

/// The rotation that nearly all correspondences agree with, and those that do; no sampling.
///
/// Least squares over directions (Horn 1987), then over the `share` of them that fits best, again and again (least trimmed
/// squares by concentration, Rousseeuw & Van Driessen 2006). `None` when fewer than `share` of the correspondences agree.
pub fn dominant_rotation(
    first: &[Vector2<f64>],
    second: &[Vector2<f64>],
    threshold: f64,
    share: f64,
) -> Option<(UnitQuaternion<f64>, Vec<u32>)> {
    Rotations::new(first, second, threshold)?.dominant(share)
}

/// The homography that nearly all correspondences agree with, as [`estimate_homography`]: models of samples that fewer than
/// half of `share` of the correspondences agree with are not looked at further. `None` when there is none.
pub fn dominant_homography(
    first: &[Vector2<f64>],
    second: &[Vector2<f64>],
    threshold: f64,
    share: f64,
    options: &RansacOptions,
    seed: Seed,
) -> Option<Robust<Matrix3<f64>>> {
    homography_with(first, second, threshold, 0.5 * share, options, seed)
}

/// A result of normalised points in the caller's unit.
fn in_unit(found: Robust<Matrix3<f64>>, model: Matrix3<f64>, scale: f64) -> Robust<Matrix3<f64>> {
    Robust { model, inliers: found.inliers, cost: found.cost / (scale * scale), iterations: found.iterations }
}
