//! Relative poses from essential matrices and homographies: which of the candidates puts the points ahead of both cameras.

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector2};
use smallvec::SmallVec;

use crate::Rigid3;
use crate::elementary::angle_rad;
use crate::epipolar::{Correspondences, PoseProblem, essential_from_pose, squared_sampson_error};
use crate::homography::decompose_homography;
use crate::linear::proper_svd3;
use crate::small_lm::{self, LmOptions};

/// Rays that meet at a smaller angle, in radians, say nothing about depth.
const MIN_PARALLAX_RAD: f64 = 1e-9;

/// The pose of a second camera relative to a first, up to the length of the baseline.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RelativePose {
    /// The pose; its translation has length one.
    pub second_from_first: Rigid3,
    /// How many of the correspondences looked at are ahead of both cameras.
    pub num_in_front: u32,
    /// Median over those of the angle at which their rays meet, in radians.
    pub median_angle_rad: f64,
}

/// The pose of an essential matrix that puts most of the given inliers ahead of both cameras (Hartley & Zisserman 2004, section
/// 9.6). `None` when there is no inlier with parallax ahead of both under any of the four, or the matrix is degenerate.
pub fn pose_from_essential(
    essential: &Matrix3<f64>,
    first: &[Vector2<f64>],
    second: &[Vector2<f64>],
    inliers: &[u32],
) -> Option<RelativePose> {
    best_in_front(&candidates(essential)?, first, second, inliers)
}

/// The first of [`poses_from_homography`].
pub fn pose_from_homography(
    homography: &Matrix3<f64>,
    first: &[Vector2<f64>],
    second: &[Vector2<f64>],
    inliers: &[u32],
) -> Option<RelativePose> {
    poses_from_homography(homography, first, second, inliers).first().copied()
}

/// The poses, at most two, of a homography on the plane z = 1 that put its inliers ahead of both cameras, better one first.
///
/// Points of one plane leave two poses in general. Ordered by how many points are ahead, then by the Sampson error over *all*
/// correspondences: those off the plane decide. Empty for a pure rotation.
pub fn poses_from_homography(
    homography: &Matrix3<f64>,
    first: &[Vector2<f64>],
    second: &[Vector2<f64>],
    inliers: &[u32],
) -> SmallVec<[RelativePose; 2]> {
    let mut found = SmallVec::<[(RelativePose, f64); 4]>::new();
    for plane in decompose_homography(homography) {
        let visible = |&i: &u32| {
            first.get(i as usize).is_some_and(|point| plane.normal_in_first.dot(&point.push(1.0)) > 0.0)
        };
        if 2 * inliers.iter().filter(|i| visible(i)).count() <= inliers.len() {
            continue;
        }
        let pose = plane.second_from_first;
        let Some(direction) = pose.translation.try_normalize(1e-12) else { continue };
        let unit = Rigid3::new(pose.rotation, direction);
        let Some(relative) = best_in_front(&[unit], first, second, inliers) else { continue };
        found.push((relative, mean_error(&unit, first, second)));
    }
    found.sort_by(|(a, error_a), (b, error_b)| {
        b.num_in_front.cmp(&a.num_in_front).then(error_a.total_cmp(error_b))
    });
    found.into_iter().take(2).map(|(pose, _)| pose).collect()
}

/// The relative pose near `start` that minimises the Sampson errors of the correspondences at `indices` under the
/// loss of Geman & McClure (1987) of this scale (in the unit of the plane z = 1). The translation stays of length one. Not worse than the start.
pub fn refine_relative_pose(
    start: &Rigid3,
    first: &[Vector2<f64>],
    second: &[Vector2<f64>],
    indices: &[u32],
    loss_scale: f64,
) -> Rigid3 {
    let Some(direction) = start.translation.try_normalize(0.0) else { return *start };
    let in_range: Vec<u32> =
        indices.iter().copied().filter(|&i| (i as usize) < first.len().min(second.len())).collect();
    let data = Correspondences { first, second, indices: &in_range, loss_scale };
    let unit = Rigid3::new(start.rotation, direction);
    let options = LmOptions { max_iterations: 12, cost_tolerance: 1e-7, ..LmOptions::default() };
    small_lm::minimize(&PoseProblem(data), unit, &options).0
}

/// The angle, in radians, at which the rays of a correspondence on the plane z = 1 meet, given the rotation between views.
pub fn parallax_angle_rad(
    rotation: &UnitQuaternion<f64>,
    first: &Vector2<f64>,
    second: &Vector2<f64>,
) -> f64 {
    let (a, b) = (rotation * first.push(1.0), second.push(1.0));
    angle_rad(a.cross(&b).norm(), a.dot(&b))
}

/// The four poses of an essential matrix, translations of length one.
pub(super) fn candidates(essential: &Matrix3<f64>) -> Option<[Rigid3; 4]> {
    let (u, _, v) = proper_svd3(essential)?;
    let quarter = Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
    let rotation = |matrix: Matrix3<f64>| {
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(matrix))
    };
    let (one, other) =
        (rotation(u * quarter * v.transpose()), rotation(u * quarter.transpose() * v.transpose()));
    let t = u.column(2).into_owned();
    Some([Rigid3::new(one, t), Rigid3::new(one, -t), Rigid3::new(other, t), Rigid3::new(other, -t)])
}

/// The candidate with the most points ahead of both cameras; the first of equals.
fn best_in_front(
    candidates: &[Rigid3],
    first: &[Vector2<f64>],
    second: &[Vector2<f64>],
    inliers: &[u32],
) -> Option<RelativePose> {
    let mut best: Option<RelativePose> = None;
    for pose in candidates {
        let mut angles = Vec::with_capacity(inliers.len());
        for &i in inliers {
            let (Some(a), Some(b)) = (first.get(i as usize), second.get(i as usize)) else { continue };
            angles.extend(angle_if_in_front(pose, a, b));
        }
        let num_in_front = angles.len() as u32;
        if num_in_front > best.map_or(0, |found| found.num_in_front) {
            let middle = angles.len() / 2;
            let median_angle_rad = *angles.select_nth_unstable_by(middle, f64::total_cmp).1;
            best = Some(RelativePose { second_from_first: *pose, num_in_front, median_angle_rad });
        }
    }
    best
}

/// The angle between a correspondence's rays when they meet ahead of both cameras.
fn angle_if_in_front(pose: &Rigid3, first: &Vector2<f64>, second: &Vector2<f64>) -> Option<f64> {
    // `depth_second * b = depth_first * a + t`: crossing with b and a gives each depth's sign.
    let (a, b) = (pose.rotation * first.push(1.0), second.push(1.0));
    let normal = a.cross(&b);
    let depth_first = pose.translation.cross(&b).dot(&-normal);
    let depth_second = pose.translation.cross(&a).dot(&-normal);
    let angle = angle_rad(normal.norm(), a.dot(&b));
    (depth_first > 0.0 && depth_second > 0.0 && angle > MIN_PARALLAX_RAD).then_some(angle)
}

/// Mean Sampson error over all correspondences, finite ones.
fn mean_error(pose: &Rigid3, first: &[Vector2<f64>], second: &[Vector2<f64>]) -> f64 {
    let matrix = essential_from_pose(pose);
    let errors = first.iter().zip(second).map(|(a, b)| squared_sampson_error(&matrix, a, b).sqrt());
    let (sum, count) = errors
        .filter(|error| error.is_finite())
        .fold((0.0, 0.0), |(sum, count), error| (sum + error, count + 1.0));
    sum / f64::max(count, 1.0)
}
