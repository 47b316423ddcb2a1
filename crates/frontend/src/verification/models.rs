//! Which two-view geometry explains the matches.

use nalgebra::{Matrix3, UnitQuaternion, Vector2, Vector3};
use terrane_geometry::homography::squared_transfer_error;
use terrane_geometry::ransac::{self, RansacOptions};
use terrane_geometry::two_view::{self, essential_from_pose};
use terrane_geometry::{Rigid3, Seed};
use terrane_scene::PairKind;

use super::VerificationOptions;
use super::correspondences::{Correspondences, spread};
use super::pose::{self, FoundPose, PoseEstimate};

/// Most samples of a homography, which matters only when most of the inliers agree with it.
const MAX_PLANAR_SAMPLES: u32 = 40;

/// A homography is looked for in no more than this many inliers, evenly spread.
const MAX_PLANAR_SAMPLED: usize = 300;

/// With this share of the matches an essential matrix is settled, unless a fundamental matrix near it explains clearly more.
const SETTLED_SHARE: f64 = 0.4;

/// Mean squared error of inliers, as a share of the squared threshold, up to which it is that of noise; spread evenly over the
/// range it is a third.
const NOISE_SHARE: f64 = 0.12;

/// Trusted intrinsics are not given up for a fundamental matrix with less than this share of the matches.
const MIN_FUNDAMENTAL_SHARE: f64 = 0.5;

/// Most samples where no more matches turn and grow alike than by chance: enough where half of the matches are right. The whole
/// number of samples found no pair more in 171 of a flight, in twice the time.
const MAX_HOPELESS_SAMPLES: u32 = 500;

/// Sampling looks at no more than this many matches, evenly spread over their order of quality. Inliers are then taken from
/// all of them.
const MAX_SAMPLED_MATCHES: usize = 1500;

/// What was found. Indices into the correspondences.
pub(super) struct Geometry {
    pub(super) kind: PairKind,
    pub(super) inliers: Vec<u32>,
    pub(super) second_from_first: Option<Rigid3>,
    pub(super) median_angle_rad: f64,
    pub(super) guide: Option<Guiding>,
}

/// The model that the inliers are those of, by which more can be found.
#[derive(Clone, Copy)]
pub(super) enum Guiding {
    /// The pose: calibrated views.
    Pose(FoundPose),
    /// A fundamental matrix in pixels.
    Fundamental(Matrix3<f64>),
    /// A turn on the spot.
    Rotation(UnitQuaternion<f64>),
}

/// The most that agrees with an epipolar geometry. Matrices are on the plane z = 1.
struct Epipolar {
    essential: Option<Matrix3<f64>>,
    /// Of rank two; an essential matrix only as far as the intrinsics hold.
    fundamental: Option<Matrix3<f64>>,
    /// The same in pixels.
    fundamental_px: Option<Matrix3<f64>>,
    inliers: Vec<u32>,
    /// Whether the inliers are those of the essential matrix.
    by_essential: bool,
}

/// Chooses among essential matrix, fundamental matrix, homography, rotation and watermark. Never fails: without a geometry
/// there are few inliers.
pub(super) fn choose(points: &Correspondences, options: &VerificationOptions, seed: Seed) -> Geometry {
    let most = if points.many_agree { u32::MAX } else { MAX_HOPELESS_SAMPLES };
    let ransac = RansacOptions { max_iterations: options.ransac.max_iterations.min(most), ..options.ransac };
    let options = &VerificationOptions { ransac, ..options.clone() };
    let epipolar = epipolar(points, options, seed);
    let inner = Subset::new(points, epipolar.inliers.clone());
    let share = |count: usize, of: usize, share: f64| of > 0 && count as f64 >= share * of as f64;
    let num_inliers = epipolar.inliers.len();

    if share(points.num_static(&epipolar.inliers), num_inliers, options.min_watermark_share) {
        return without_pose(PairKind::Watermark, epipolar.inliers);
    }
    if let Some((rotation, agreeing)) = inner.rotation(points, options) {
        let turn = Rigid3::new(rotation, Vector3::zeros());
        let found = without_pose(PairKind::Panoramic, agreeing);
        return Geometry { second_from_first: Some(turn), guide: Some(Guiding::Rotation(rotation)), ..found };
    }
    let planar = planar(points, &epipolar.inliers, options, seed);
    let kind = match (&planar, points.is_calibrated && epipolar.by_essential) {
        (Some(_), _) => PairKind::Planar,
        (None, true) => PairKind::Calibrated,
        (None, false) => PairKind::Uncalibrated,
    };
    with_pose(points, kind, epipolar, planar)
}

/// A homography that enough of these correspondences agree with, and those that do.
fn planar(
    points: &Correspondences,
    inliers: &[u32],
    options: &VerificationOptions,
    seed: Seed,
) -> Option<(Matrix3<f64>, Vec<u32>)> {
    let chosen: Vec<u32> = spread(inliers.len(), MAX_PLANAR_SAMPLED).map(|at| inliers[at]).collect();
    let homography = Subset::new(points, chosen).homography(points, options, seed)?;
    let limit = points.threshold * points.threshold;
    let agrees = |&i: &u32| {
        squared_transfer_error(&homography, &points.first[i as usize], &points.second[i as usize]) < limit
    };
    let agreeing: Vec<u32> = inliers.iter().copied().filter(agrees).collect();
    let needed = options.min_planar_share * inliers.len() as f64;
    (agreeing.len() as f64 >= needed).then_some((homography, agreeing))
}

/// The better of essential and fundamental matrix. With trusted intrinsics the fundamental matrix must explain clearly more, and
/// most of the matches; guessed ones may be far off, so the one that explains more counts.
fn epipolar(points: &Correspondences, options: &VerificationOptions, seed: Seed) -> Epipolar {
    if points.is_calibrated {
        by_trusted_cameras(points, options, seed)
    } else {
        by_guessed_cameras(points, options, seed)
    }
}

fn by_trusted_cameras(points: &Correspondences, options: &VerificationOptions, seed: Seed) -> Epipolar {
    let sample = Subset::new(points, points.spread(MAX_SAMPLED_MATCHES));
    let essential = sample.essential(points, &options.ransac, seed);
    let by_essential = essential.map(|e| points.within(&e)).unwrap_or_default();
    let is_settled = |by_fundamental: &[u32]| {
        by_essential.len() as f64 >= options.min_essential_share * by_fundamental.len() as f64
    };
    let start = essential.and_then(|e| points.in_pixels(&e));
    // Near an essential matrix that holds, no fundamental matrix explains clearly more. One for wrong intrinsics leaves errors
    // all over the range, not those of noise, and nothing better may lie near it.
    let is_likely = by_essential.len() as f64 >= SETTLED_SHARE * points.len() as f64
        && essential.is_some_and(|e| points.mean_squared_error(&e, &by_essential) < NOISE_SHARE);
    let near = start.filter(|_| is_likely).and_then(|start| sample.near_fundamental(points, &start));
    let by_near = near.map(|f| points.within_px(&f)).unwrap_or_default();
    if near.is_some() && is_settled(&by_near) {
        return Epipolar::new(points, essential, near, by_essential, true);
    }
    // Seven points fit much by chance where little agrees.
    let needed = MIN_FUNDAMENTAL_SHARE * points.len() as f64;
    let enough = ransac::iterations_needed(MIN_FUNDAMENTAL_SHARE, 7, options.ransac.confidence);
    let max_iterations = options.ransac.max_iterations.min(enough);
    let ransac = RansacOptions { max_iterations, ..options.ransac };
    let other = sample.fundamental(points, start.as_ref(), &ransac, seed);
    let by_other = other.map(|f| points.within_px(&f)).unwrap_or_default();
    if is_settled(&by_other) || (by_other.len() as f64) < needed {
        return Epipolar::new(points, essential, near, by_essential, true);
    }
    Epipolar::new(points, essential, other, by_other, false)
}

fn by_guessed_cameras(points: &Correspondences, options: &VerificationOptions, seed: Seed) -> Epipolar {
    let sample = Subset::new(points, points.spread(MAX_SAMPLED_MATCHES));
    let fundamental = sample.fundamental(points, None, &options.ransac, seed);
    let by_fundamental = fundamental.map(|f| points.within_px(&f)).unwrap_or_default();
    // An essential matrix can't explain more than the best fundamental one: it need not be looked for any longer.
    let share = by_fundamental.len() as f64 / points.len() as f64;
    let enough = ransac::iterations_needed(share, 5, options.ransac.confidence);
    let max_iterations = options.ransac.max_iterations.min(enough.max(options.ransac.min_iterations));
    let ransac = RansacOptions { max_iterations, ..options.ransac };
    let essential = sample.essential(points, &ransac, seed);
    let by_essential = essential.map(|e| points.within(&e)).unwrap_or_default();
    // Where seven points found little, five may have found where to look.
    let start = essential.filter(|_| share < SETTLED_SHARE).and_then(|e| points.in_pixels(&e));
    let other = start.and_then(|start| sample.near_fundamental(points, &start));
    let by_other = other.map(|f| points.within_px(&f)).unwrap_or_default();
    let (fundamental, by_fundamental) =
        if by_other.len() > by_fundamental.len() { (other, by_other) } else { (fundamental, by_fundamental) };
    if by_essential.len() >= by_fundamental.len() {
        Epipolar::new(points, essential, fundamental, by_essential, true)
    } else {
        Epipolar::new(points, essential, fundamental, by_fundamental, false)
    }
}

impl Epipolar {
    fn new(
        points: &Correspondences,
        essential: Option<Matrix3<f64>>,
        fundamental_px: Option<Matrix3<f64>>,
        inliers: Vec<u32>,
        by_essential: bool,
    ) -> Self {
        let fundamental = fundamental_px.map(|f| points.on_planes(&f));
        Self { essential, fundamental, fundamental_px, inliers, by_essential }
    }
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

    fn essential(
        &self,
        points: &Correspondences,
        ransac: &RansacOptions,
        seed: Seed,
    ) -> Option<Matrix3<f64>> {
        let (limit, seed) = (points.threshold, seed.derive("essential"));
        let found = two_view::estimate_essential(&self.first, &self.second, limit, ransac, seed)?;
        Some(found.model)
    }

    fn in_pixels(&self, points: &Correspondences) -> [Vec<Vector2<f64>>; 2] {
        [&points.first_px, &points.second_px]
            .map(|from| self.indices.iter().map(|&i| from[i as usize]).collect())
    }

    /// In pixels.
    fn near_fundamental(&self, points: &Correspondences, start: &Matrix3<f64>) -> Option<Matrix3<f64>> {
        let [first, second] = self.in_pixels(points);
        Some(two_view::improve_fundamental(start, &first, &second, points.threshold_px)?.model)
    }

    /// In pixels.
    fn fundamental(
        &self,
        points: &Correspondences,
        start: Option<&Matrix3<f64>>,
        ransac: &RansacOptions,
        seed: Seed,
    ) -> Option<Matrix3<f64>> {
        let [first, second] = self.in_pixels(points);
        let (limit, seed) = (points.threshold_px, seed.derive("fundamental"));
        let found = two_view::estimate_fundamental_from(start, &first, &second, limit, ransac, seed)?;
        Some(found.model)
    }

    /// With the correspondences that agree.
    fn rotation(
        &self,
        points: &Correspondences,
        options: &VerificationOptions,
    ) -> Option<(UnitQuaternion<f64>, Vec<u32>)> {
        let (limit, share) = (points.threshold, options.min_rotation_share);
        let (rotation, agreeing) = two_view::dominant_rotation(&self.first, &self.second, limit, share)?;
        Some((rotation, agreeing.iter().map(|&i| self.indices[i as usize]).collect()))
    }

    fn homography(
        &self,
        points: &Correspondences,
        options: &VerificationOptions,
        seed: Seed,
    ) -> Option<Matrix3<f64>> {
        let max_iterations = options.ransac.max_iterations.min(MAX_PLANAR_SAMPLES);
        let ransac = RansacOptions { max_iterations, ..options.ransac };
        let (limit, share) = (points.threshold, options.min_planar_share);
        let seed = seed.derive("homography");
        let found = two_view::dominant_homography(&self.first, &self.second, limit, share, &ransac, seed)?;
        Some(found.model)
    }
}

fn without_pose(kind: PairKind, inliers: Vec<u32>) -> Geometry {
    Geometry { kind, inliers, second_from_first: None, median_angle_rad: 0.0, guide: None }
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
    let by_matrix = epipolar.fundamental_px.map(Guiding::Fundamental);
    let Some(found) = pose::best(&estimate) else {
        return Geometry { guide: by_matrix, ..without_pose(kind, epipolar.inliers) };
    };
    let is_metric = points.is_calibrated && epipolar.by_essential;
    let (inliers, guide) = match is_metric {
        true => (found.agreeing(points, epipolar.fundamental_px.as_ref()), Some(Guiding::Pose(found))),
        false => (epipolar.inliers, by_matrix),
    };
    let median_angle_rad = found.median_angle_rad(points, &inliers);
    Geometry { kind, inliers, second_from_first: Some(found.second_from_first), median_angle_rad, guide }
}

/// The geometry after more matches were found by it: refined on them, with those that agree.
pub(super) fn with_more(points: &Correspondences, known: Geometry) -> Geometry {
    let all: Vec<u32> = (0..points.len() as u32).collect();
    match known.guide {
        Some(Guiding::Pose(pose)) => {
            let pose = pose.refined_on(points, &all);
            let sample = Subset::new(points, points.spread(MAX_SAMPLED_MATCHES));
            let start = points.in_pixels(&essential_from_pose(&pose.second_from_first));
            let near = start.and_then(|start| sample.near_fundamental(points, &start));
            let inliers = pose.agreeing(points, near.as_ref());
            let median_angle_rad = pose.median_angle_rad(points, &inliers);
            let second_from_first = Some(pose.second_from_first);
            Geometry {
                inliers,
                second_from_first,
                median_angle_rad,
                guide: Some(Guiding::Pose(pose)),
                ..known
            }
        }
        Some(Guiding::Fundamental(start)) => {
            let sample = Subset::new(points, points.spread(MAX_SAMPLED_MATCHES));
            let matrix = sample.near_fundamental(points, &start).unwrap_or(start);
            let inliers = points.within_px(&matrix);
            Geometry { inliers, guide: Some(Guiding::Fundamental(matrix)), ..known }
        }
        Some(Guiding::Rotation(rotation)) => {
            let matrix = rotation.to_rotation_matrix().into_inner();
            let limit = points.threshold * points.threshold;
            let agrees = |&i: &u32| {
                squared_transfer_error(&matrix, &points.first[i as usize], &points.second[i as usize]) < limit
            };
            Geometry { inliers: all.into_iter().filter(agrees).collect(), ..known }
        }
        None => known,
    }
}
