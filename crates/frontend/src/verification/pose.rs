//! The relative pose that agrees best with the inliers, also when the focal length is only a guess.

use nalgebra::{Matrix3, Vector2};
use terrane_geometry::Rigid3;
use terrane_geometry::two_view::{self, essential_from_pose, parallax_angle_rad, squared_sampson_error};

use super::correspondences::{Correspondences, spread};

/// Poses are refined and compared on no more than this many inliers, evenly spread.
const MAX_COMPARED: usize = 400;

/// Factors on a guessed focal length are looked for from one over this to this.
const MAX_FOCAL_FACTOR: f64 = 2.5;
/// From one factor that is tried to the next.
const FOCAL_STEP: f64 = 1.047;
/// Another focal length must lower the cost to this share: near-degenerate views fit any.
const NEEDED_GAIN: f64 = 0.9;

/// What the pose is looked for with. Matrices are on the plane z = 1.
pub(super) struct PoseEstimate<'a> {
    pub(super) points: &'a Correspondences,
    pub(super) inliers: &'a [u32],
    pub(super) essential: Option<Matrix3<f64>>,
    pub(super) fundamental: Option<Matrix3<f64>>,
    /// A homography and those that agree with it, when the scene is planar.
    pub(super) homography: Option<(&'a Matrix3<f64>, &'a [u32])>,
}

/// A pose, with the focal length that it holds for.
#[derive(Clone, Copy)]
pub(super) struct FoundPose {
    pub(super) second_from_first: Rigid3,
    /// Factor on guessed focal lengths.
    focal_factor: f64,
    /// Sum of squared errors in pixels, cut off at the threshold.
    cost: f64,
}

/// The pose with the least cost; `None` when the models allow none.
///
/// A plane leaves two poses, and an essential matrix fitted to a plane may be either or neither: all are refined on the same
/// inliers and compared. Where a focal length is guessed, the fundamental matrix says which one would make it an essential
/// matrix (equal singular values, Mendonça & Cipolla 1999); the pose for that one is taken when it fits clearly better.
pub(super) fn best(estimate: &PoseEstimate<'_>) -> Option<FoundPose> {
    let (points, inliers) = (estimate.points, estimate.inliers);
    let as_given = Scaled::new(points, inliers, 1.0);
    let mut starts: Vec<Rigid3> = Vec::new();
    // Of two matrices the essential one is the better start, unless the intrinsics do not fit.
    if let Some(matrix) = estimate.essential.or(estimate.fundamental) {
        starts.extend(as_given.pose_of(&matrix));
    }
    if let Some((homography, agreeing)) = estimate.homography {
        let poses = two_view::poses_from_homography(homography, &points.first, &points.second, agreeing);
        starts.extend(poses.iter().map(|pose| pose.second_from_first));
    }
    let refined = starts.iter().map(|start| as_given.refined(start));
    let found = refined.min_by(|a, b| a.cost.total_cmp(&b.cost));
    let other = estimate.fundamental.filter(|_| !points.is_calibrated).and_then(|matrix| {
        let factor = focal_factor(&matrix, points.is_guessed)?;
        let scaled = Scaled::new(points, inliers, factor);
        let start = scaled.pose_of(&scaled.matrix_for(&matrix))?;
        Some(scaled.refined(&start))
    });
    match (found, other) {
        (Some(found), Some(other)) if other.cost < NEEDED_GAIN * found.cost => Some(other),
        (None, other) => other,
        (found, _) => found,
    }
}

impl FoundPose {
    /// The pose after a refinement on these correspondences.
    pub(super) fn refined_on(&self, points: &Correspondences, indices: &[u32]) -> Self {
        Scaled::new(points, indices, self.focal_factor).refined(&self.second_from_first)
    }

    /// Correspondences that agree with the pose at the focal lengths given, ascending.
    ///
    /// With `near`, a fundamental matrix in pixels that was fitted from this pose, also those that agree with it: lenses bend
    /// lines a little more than their models say, above all far from the centre.
    pub(super) fn agreeing(&self, points: &Correspondences, near: Option<&Matrix3<f64>>) -> Vec<u32> {
        let pose = &self.second_from_first;
        let ahead = |&i: &u32| {
            !is_behind(pose, &points.first[i as usize], &points.second[i as usize], points.threshold)
        };
        let mut agreeing = points.within(&essential_from_pose(pose));
        if let Some(near) = near {
            agreeing.extend(points.within_px(near));
            agreeing.sort_unstable();
            agreeing.dedup();
        }
        agreeing.retain(ahead);
        agreeing
    }

    /// Median angle of the rays of correspondences.
    pub(super) fn median_angle_rad(&self, points: &Correspondences, indices: &[u32]) -> f64 {
        let scaled = Scaled::new(points, indices, self.focal_factor);
        let rotation = &self.second_from_first.rotation;
        let pairs = scaled.first.iter().zip(&scaled.second);
        let mut angles: Vec<f64> = pairs.map(|(a, b)| parallax_angle_rad(rotation, a, b)).collect();
        angles.sort_by(f64::total_cmp);
        angles.get(angles.len() / 2).copied().unwrap_or(0.0)
    }
}

/// Some correspondences on the plane z = 1 of cameras whose guessed focal lengths are `factor` times as long.
struct Scaled {
    first: Vec<Vector2<f64>>,
    second: Vec<Vector2<f64>>,
    all: Vec<u32>,
    /// What each side is divided by.
    factors: [f64; 2],
    factor: f64,
    threshold: f64,
    px_per_unit: f64,
}

impl Scaled {
    fn new(points: &Correspondences, inliers: &[u32], factor: f64) -> Self {
        let factors = points.is_guessed.map(|guessed| if guessed { factor } else { 1.0 });
        let chosen: Vec<usize> = spread(inliers.len(), MAX_COMPARED).map(|at| inliers[at] as usize).collect();
        let mean = (factors[0] + factors[1]) / 2.0;
        Self {
            first: chosen.iter().map(|&i| points.first[i] / factors[0]).collect(),
            second: chosen.iter().map(|&i| points.second[i] / factors[1]).collect(),
            all: (0..chosen.len() as u32).collect(),
            factors,
            factor,
            threshold: points.threshold / mean,
            px_per_unit: points.threshold_px / points.threshold * mean,
        }
    }

    /// A matrix over the points as given, as one over these.
    fn matrix_for(&self, matrix: &Matrix3<f64>) -> Matrix3<f64> {
        rescaled(matrix, self.factors)
    }

    fn pose_of(&self, matrix: &Matrix3<f64>) -> Option<Rigid3> {
        let pose = two_view::pose_from_essential(matrix, &self.first, &self.second, &self.all)?;
        Some(pose.second_from_first)
    }

    fn refined(&self, start: &Rigid3) -> FoundPose {
        let (first, second) = (&self.first, &self.second);
        let pose = two_view::refine_relative_pose(start, first, second, &self.all, self.threshold / 2.0);
        FoundPose { second_from_first: pose, focal_factor: self.factor, cost: self.cost(&pose) }
    }

    /// A match behind a camera costs as much as an outlier.
    fn cost(&self, pose: &Rigid3) -> f64 {
        let (essential, limit) = (essential_from_pose(pose), self.threshold * self.threshold);
        let of_pair = |(a, b): (&Vector2<f64>, &Vector2<f64>)| {
            let error = squared_sampson_error(&essential, a, b);
            if error < limit && !is_behind(pose, a, b, self.threshold) { error } else { limit }
        };
        let sum: f64 = self.first.iter().zip(&self.second).map(of_pair).sum();
        sum * self.px_per_unit * self.px_per_unit
    }
}

/// `second ᵀ M first = 0` for points divided by these factors.
fn rescaled(matrix: &Matrix3<f64>, factors: [f64; 2]) -> Matrix3<f64> {
    let [first, second] = factors.map(|factor| Matrix3::from_diagonal(&[factor, factor, 1.0].into()));
    second * matrix * first
}

/// The factor on guessed focal lengths that brings the singular values of a matrix closest to each other; `None` when that
/// is at an end of the range, where the views do not tell.
fn focal_factor(matrix: &Matrix3<f64>, is_guessed: [bool; 2]) -> Option<f64> {
    let inequality = |factor: f64| {
        let factors = is_guessed.map(|guessed| if guessed { factor } else { 1.0 });
        // Of a matrix of rank two: ((σ₁² − σ₂²) / (σ₁² + σ₂²))², from the invariants of MᵀM.
        let scaled = rescaled(matrix, factors);
        let squared = scaled.tr_mul(&scaled);
        let (sum, sum_of_squares) = (squared.trace(), (squared * squared).trace());
        (2.0 * sum_of_squares - sum * sum) / (sum * sum)
    };
    let mut factors = vec![1.0 / MAX_FOCAL_FACTOR];
    while let Some(&last) = factors.last().filter(|last| **last < MAX_FOCAL_FACTOR) {
        factors.push(last * FOCAL_STEP);
    }
    let last = factors.len() - 1;
    let best = (0..=last).min_by(|&a, &b| inequality(factors[a]).total_cmp(&inequality(factors[b])))?;
    if best == 0 || best == last {
        return None;
    }
    // Thirds of the interval are dropped until it is narrow enough.
    let (mut low, mut high) = (factors[best - 1], factors[best + 1]);
    for _ in 0..12 {
        let third = (high - low) / 3.0;
        if inequality(low + third) < inequality(high - third) { high -= third } else { low += third }
    }
    Some((low + high) / 2.0)
}

/// Whether the rays of a correspondence surely meet behind a camera: rays that are parallel within the noise may meet anywhere.
fn is_behind(pose: &Rigid3, first: &Vector2<f64>, second: &Vector2<f64>, noise: f64) -> bool {
    // λ_second b = λ_first a + t; crossing with b and with a leaves each depth times |a × b|².
    let (a, b) = (pose.rotation * first.push(1.0), second.push(1.0));
    let normal = a.cross(&b);
    let depth_first = -pose.translation.cross(&b).dot(&normal);
    let depth_second = -pose.translation.cross(&a).dot(&normal);
    let is_parallel = normal.norm_squared() <= noise * noise * a.norm_squared() * b.norm_squared();
    !is_parallel && (depth_first < 0.0 || depth_second < 0.0)
}
