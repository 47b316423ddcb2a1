//! Which two-view geometry explains the matches.

use nalgebra::{Matrix3, UnitQuaternion, Vector2, Vector3};
use terrane_geometry::ransac::RansacOptions;
use terrane_geometry::two_view;
use terrane_geometry::{Camera, Rigid3, Seed};
use terrane_scene::PairKind;

use super::VerificationOptions;
use super::correspondences::Correspondences;
use super::pose::{self, PoseEstimate};

/// Most samples of a model that matters only when nearly all of the inliers agree with it.
const MAX_SAMPLES_OF_INLIERS: u32 = 100;

/// Sampling looks at no more than this many matches, evenly spread over their order of quality. Inliers are then taken from
/// all of them.
const MAX_SAMPLED_MATCHES: usize = 1500;

/// What was found. Indices into the correspondences.
pub(super) struct Geometry {
    pub(super) kind: PairKind,
    pub(super) inliers: Vec<u32>,
    pub(super) second_from_first: Option<Rigid3>,
    pub(super) median_angle_rad: f64,
}

/// The most that agrees with an epipolar geometry. Matrices are on the plane z = 1.
struct Epipolar {
    essential: Option<Matrix3<f64>>,
    /// Of rank two; an essential matrix only as far as the intrinsics hold.
    fundamental: Option<Matrix3<f64>>,
    inliers: Vec<u32>,
    /// Whether the inliers are those of the essential matrix.
    by_essential: bool,
}

/// Chooses among essential matrix, fundamental matrix, homography, rotation and watermark. Never fails: without a geometry
/// there are few inliers.
pub(super) fn choose(points: &Correspondences, options: &VerificationOptions, seed: Seed) -> Geometry {
    let epipolar = epipolar(points, options, seed);
    let inner = Subset::new(points, epipolar.inliers.clone());
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
    with_pose(points, kind, epipolar, planar)
}

/// The better of essential and fundamental matrix. With trusted intrinsics the fundamental matrix must explain clearly more;
/// guessed ones may be far off, so the one that explains more counts.
fn epipolar(points: &Correspondences, options: &VerificationOptions, seed: Seed) -> Epipolar {
    let sampled = points.spread(MAX_SAMPLED_MATCHES);
    let sample = Subset::new(points, sampled);
    let essential = sample.essential(points, options, seed);
    let by_essential = essential.map(|e| points.within(&e)).unwrap_or_default();
    let share = if points.is_calibrated { options.min_essential_share } else { 1.0 };
    let is_clear = points.is_calibrated && by_essential.len() as f64 >= share * points.len() as f64;
    let fundamental = if is_clear { None } else { sample.fundamental(points, options, seed) };
    let by_fundamental = fundamental.map(|f| points.within_px(&f)).unwrap_or_default();
    let [first, second] = points.cameras.map(|camera| intrinsic_matrix(&camera));
    let fundamental = fundamental.map(|f| second.transpose() * f * first);
    if by_essential.len() as f64 >= share * by_fundamental.len() as f64 {
        Epipolar { essential, fundamental, inliers: by_essential, by_essential: true }
    } else {
        Epipolar { essential, fundamental, inliers: by_fundamental, by_essential: false }
    }
}

/// The matrix that takes points of the plane z = 1 to pixels, without distortion.
fn intrinsic_matrix(camera: &Camera) -> Matrix3<f64> {
    let (focal, center) = (camera.focal_px(), camera.principal_point_px());
    Matrix3::new(focal.x, 0.0, center.x, 0.0, focal.y, center.y, 0.0, 0.0, 1.0)
}

/// Some of the correspondences as points of their own.
struct Subset {
    indices: Vec<u32>,
    first: Vec<Vector2<f64>>,
    second: Vec<Vector2<f64>>,
}

impl Subset {
    fn new(points: &Correspondences, indices: Vec<u32>) -> Self {
        let pick = |from: &[Vector2<f64>]| indices.iter().map(|&i| from[i as usize]).collect();
        let (first, second) = (pick(&points.first), pick(&points.second));
        Self { indices, first, second }
    }

    fn ransac(&self, options: &VerificationOptions) -> RansacOptions {
        let max_iterations = options.ransac.max_iterations.min(MAX_SAMPLES_OF_INLIERS);
        RansacOptions { max_iterations, ..options.ransac }
    }

    /// Indices into the correspondences of indices into this subset.
    fn outer(&self, indices: &[u32]) -> Vec<u32> {
        indices.iter().map(|&i| self.indices[i as usize]).collect()
    }

    fn essential(
        &self,
        points: &Correspondences,
        options: &VerificationOptions,
        seed: Seed,
    ) -> Option<Matrix3<f64>> {
        let (limit, seed) = (points.threshold, seed.derive("essential"));
        let found = two_view::estimate_essential(&self.first, &self.second, limit, &options.ransac, seed)?;
        Some(found.model)
    }

    /// In pixels.
    fn fundamental(
        &self,
        points: &Correspondences,
        options: &VerificationOptions,
        seed: Seed,
    ) -> Option<Matrix3<f64>> {
        let pick = |from: &[Vector2<f64>]| self.indices.iter().map(|&i| from[i as usize]).collect::<Vec<_>>();
        let (first, second) = (pick(&points.first_px), pick(&points.second_px));
        let (limit, seed) = (points.threshold_px, seed.derive("fundamental"));
        let found = two_view::estimate_fundamental(&first, &second, limit, &options.ransac, seed)?;
        Some(found.model)
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

/// Adds the pose. Where the essential matrix holds, inliers are then taken anew, and matches whose rays meet behind a camera
/// are left out.
fn with_pose(
    points: &Correspondences,
    kind: PairKind,
    epipolar: Epipolar,
    planar: Option<(Matrix3<f64>, Vec<u32>)>,
) -> Geometry {
    let estimate = PoseEstimate {
        points,
        inliers: &epipolar.inliers,
        essential: epipolar.essential,
        fundamental: epipolar.fundamental,
        homography: planar.as_ref().map(|(homography, agreeing)| (homography, agreeing.as_slice())),
    };
    let Some(found) = pose::best(&estimate) else {
        return without_baseline(kind, epipolar.inliers, None);
    };
    let is_metric = points.is_calibrated && epipolar.by_essential;
    let inliers = if is_metric { found.agreeing(points) } else { epipolar.inliers };
    let median_angle_rad = found.median_angle_rad(points, &inliers);
    Geometry { kind, inliers, second_from_first: Some(found.second_from_first), median_angle_rad }
}
