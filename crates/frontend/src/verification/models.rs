//! Which two-view geometry explains the matches, and the pose that follows.

use nalgebra::{Matrix3, UnitQuaternion, Vector2, Vector3};
use terrane_geometry::ransac::RansacOptions;
use terrane_geometry::two_view::{self, essential_from_pose, parallax_angle_rad, squared_sampson_error};
use terrane_geometry::{Camera, Rigid3, Seed};
use terrane_scene::PairKind;

use super::VerificationOptions;
use super::correspondences::Correspondences;

/// Most samples of a model that matters only when nearly all of the inliers agree with it.
const MAX_SAMPLES_OF_INLIERS: u32 = 100;

/// What was found. Indices into the correspondences.
pub(super) struct Geometry {
    pub(super) kind: PairKind,
    pub(super) inliers: Vec<u32>,
    pub(super) second_from_first: Option<Rigid3>,
    pub(super) median_angle_rad: f64,
}

/// The most that agrees with an epipolar geometry.
struct Epipolar {
    /// On the plane z = 1: of rank two, near an essential matrix.
    essential: Option<Matrix3<f64>>,
    inliers: Vec<u32>,
    /// Whether the inliers are those of the essential matrix.
    by_essential: bool,
}

/// Chooses among essential matrix, fundamental matrix, homography, rotation and watermark. Never fails: without a geometry
/// there are few inliers.
pub(super) fn choose(points: &Correspondences, options: &VerificationOptions, seed: Seed) -> Geometry {
    let epipolar = epipolar(points, options, seed);
    let inner = Subset::new(points, &epipolar.inliers);
    let share = |count: usize, of: usize, share: f64| of > 0 && count as f64 >= share * of as f64;
    let num_inliers = epipolar.inliers.len();

    if share(points.num_static(&epipolar.inliers), num_inliers, options.min_watermark_share) {
        return without_baseline(PairKind::Watermark, epipolar.inliers, None);
    }
    if let Some((rotation, agreeing)) = inner.rotation(points, options, seed)
        && share(agreeing.len(), num_inliers, options.min_rotation_share)
    {
        let turn = Rigid3::new(rotation, Vector3::zeros());
        return without_baseline(PairKind::Panoramic, agreeing, Some(turn));
    }
    let homography = inner.homography(points, options, seed);
    let planar =
        homography.filter(|(_, agreeing)| share(agreeing.len(), num_inliers, options.min_planar_share));
    let kind = match (&planar, points.is_calibrated && epipolar.by_essential) {
        (Some(_), _) => PairKind::Planar,
        (None, true) => PairKind::Calibrated,
        (None, false) => PairKind::Uncalibrated,
    };
    with_pose(points, kind, &epipolar, planar)
}

/// The better of essential and fundamental matrix. Guessed intrinsics may be far off, so the fundamental matrix then counts
/// as soon as it explains more.
fn epipolar(points: &Correspondences, options: &VerificationOptions, seed: Seed) -> Epipolar {
    let essential = two_view::estimate_essential(
        &points.first,
        &points.second,
        points.threshold,
        &options.ransac,
        seed.derive("essential"),
    );
    let num_essential = essential.as_ref().map_or(0, |found| found.inliers.len());
    let is_clear = num_essential as f64 >= options.min_essential_share * points.len() as f64;
    let fundamental = if is_clear { None } else { fundamental(points, options, seed) };
    match (essential, fundamental) {
        (Some(essential), Some((fundamental, inliers))) => {
            let enough = options.min_essential_share * inliers.len() as f64;
            if num_essential as f64 >= enough {
                Epipolar { essential: Some(essential.model), inliers: essential.inliers, by_essential: true }
            } else {
                // Intrinsics that do not fit still make the better pose when they are all that was fitted.
                Epipolar { essential: Some(fundamental), inliers, by_essential: false }
            }
        }
        (Some(essential), None) => {
            Epipolar { essential: Some(essential.model), inliers: essential.inliers, by_essential: true }
        }
        (None, Some((fundamental, inliers))) => {
            Epipolar { essential: Some(fundamental), inliers, by_essential: false }
        }
        (None, None) => Epipolar { essential: None, inliers: Vec::new(), by_essential: false },
    }
}

/// The fundamental matrix in pixels, carried to the plane z = 1, and its inliers.
fn fundamental(
    points: &Correspondences,
    options: &VerificationOptions,
    seed: Seed,
) -> Option<(Matrix3<f64>, Vec<u32>)> {
    let found = two_view::estimate_fundamental(
        &points.first_px,
        &points.second_px,
        points.threshold_px,
        &options.ransac,
        seed.derive("fundamental"),
    )?;
    let [first, second] = points.cameras.map(|camera| intrinsic_matrix(&camera));
    Some((second.transpose() * found.model * first, found.inliers))
}

/// The matrix that takes points of the plane z = 1 to pixels, without distortion.
fn intrinsic_matrix(camera: &Camera) -> Matrix3<f64> {
    let (focal, center) = (camera.focal_px(), camera.principal_point_px());
    Matrix3::new(focal.x, 0.0, center.x, 0.0, focal.y, center.y, 0.0, 0.0, 1.0)
}

/// The inliers of the epipolar geometry as points of their own.
struct Subset<'a> {
    indices: &'a [u32],
    first: Vec<Vector2<f64>>,
    second: Vec<Vector2<f64>>,
}

impl<'a> Subset<'a> {
    fn new(points: &Correspondences, indices: &'a [u32]) -> Self {
        let pick = |from: &[Vector2<f64>]| indices.iter().map(|&i| from[i as usize]).collect();
        Self { indices, first: pick(&points.first), second: pick(&points.second) }
    }

    fn ransac(&self, options: &VerificationOptions) -> RansacOptions {
        let max_iterations = options.ransac.max_iterations.min(MAX_SAMPLES_OF_INLIERS);
        RansacOptions { max_iterations, ..options.ransac }
    }

    /// Indices into the correspondences of indices into this subset.
    fn outer(&self, indices: &[u32]) -> Vec<u32> {
        indices.iter().map(|&i| self.indices[i as usize]).collect()
    }

    fn rotation(
        &self,
        points: &Correspondences,
        options: &VerificationOptions,
        seed: Seed,
    ) -> Option<(UnitQuaternion<f64>, Vec<u32>)> {
        let (ransac, seed) = (self.ransac(options), seed.derive("rotation"));
        let found = two_view::estimate_rotation(&self.first, &self.second, points.threshold, &ransac, seed)?;
        Some((found.model, self.outer(&found.inliers)))
    }

    fn homography(
        &self,
        points: &Correspondences,
        options: &VerificationOptions,
        seed: Seed,
    ) -> Option<(Matrix3<f64>, Vec<u32>)> {
        let (ransac, seed) = (self.ransac(options), seed.derive("homography"));
        let found =
            two_view::estimate_homography(&self.first, &self.second, points.threshold, &ransac, seed)?;
        Some((found.model, self.outer(&found.inliers)))
    }
}

fn without_baseline(kind: PairKind, inliers: Vec<u32>, second_from_first: Option<Rigid3>) -> Geometry {
    Geometry { kind, inliers, second_from_first, median_angle_rad: 0.0 }
}

/// The pose that most inliers agree with, of those that the models allow, refined.
///
/// A plane leaves two poses, and an essential matrix fitted to a plane may be either or neither: all are refined on the same
/// inliers and compared by their truncated Sampson errors. Where the essential matrix holds, inliers are then taken anew, and
/// matches whose rays meet behind a camera are left out.
fn with_pose(
    points: &Correspondences,
    kind: PairKind,
    epipolar: &Epipolar,
    planar: Option<(Matrix3<f64>, Vec<u32>)>,
) -> Geometry {
    let mut starts: Vec<Rigid3> = Vec::new();
    if let Some(essential) = &epipolar.essential {
        let pose = two_view::pose_from_essential(essential, &points.first, &points.second, &epipolar.inliers);
        starts.extend(pose.map(|pose| pose.second_from_first));
    }
    if let Some((homography, agreeing)) = &planar {
        let poses = two_view::poses_from_homography(homography, &points.first, &points.second, agreeing);
        starts.extend(poses.iter().map(|pose| pose.second_from_first));
    }
    let refine = |start: &Rigid3| {
        two_view::refine_relative_pose(
            start,
            &points.first,
            &points.second,
            &epipolar.inliers,
            points.threshold / 2.0,
        )
    };
    let scored = starts.iter().map(refine).map(|pose| (cost(points, &pose, &epipolar.inliers), pose));
    let best = scored.min_by(|a, b| a.0.total_cmp(&b.0)).map(|scored| scored.1);
    let Some(pose) = best else {
        return without_baseline(kind, epipolar.inliers.clone(), None);
    };
    let inliers = if epipolar.by_essential { agreeing(points, &pose) } else { epipolar.inliers.clone() };
    let mut angles: Vec<f64> = inliers
        .iter()
        .map(|&i| parallax_angle_rad(&pose.rotation, &points.first[i as usize], &points.second[i as usize]))
        .collect();
    angles.sort_by(f64::total_cmp);
    let median_angle_rad = angles.get(angles.len() / 2).copied().unwrap_or(0.0);
    Geometry { kind, inliers, second_from_first: Some(pose), median_angle_rad }
}

/// Sum of squared Sampson errors, cut off at the threshold; a match behind a camera costs as much as an outlier.
fn cost(points: &Correspondences, pose: &Rigid3, indices: &[u32]) -> f64 {
    let (essential, limit) = (essential_from_pose(pose), points.threshold * points.threshold);
    let of_match = |&i: &u32| {
        let (a, b) = (&points.first[i as usize], &points.second[i as usize]);
        let error = squared_sampson_error(&essential, a, b);
        if error < limit && !is_behind(pose, a, b, points.threshold) { error } else { limit }
    };
    indices.iter().map(of_match).sum()
}

/// Correspondences that agree with a pose, ascending.
fn agreeing(points: &Correspondences, pose: &Rigid3) -> Vec<u32> {
    let (essential, limit) = (essential_from_pose(pose), points.threshold * points.threshold);
    let agrees = |i: usize| {
        let (a, b) = (&points.first[i], &points.second[i]);
        squared_sampson_error(&essential, a, b) < limit && !is_behind(pose, a, b, points.threshold)
    };
    (0..points.len()).filter(|&i| agrees(i)).map(|i| i as u32).collect()
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
