//! What two submaps share: points that own the same feature of the same image, and cameras.

use nalgebra::{Matrix3, SMatrix, Vector3};
use terrane_geometry::alignment::umeyama;
use terrane_geometry::ransac::{self, Estimator, Score};
use terrane_geometry::{Rigid3, Sim3, so3};
use terrane_scene::{ImageId, Observation, Reconstruction, ScenePoint};

/// Error of a feature in pixels, for the uncertainty of points.
const FEATURE_SIGMA_PX: f64 = 1.0;
/// Submaps bend: even the best point is uncertain by this fraction of its depth.
const BENDING: f64 = 0.002;
/// A threshold in standard deviations.
const THRESHOLD_SIGMAS: f64 = 4.0;

/// An image that both submaps registered.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SharedCamera {
    pub(crate) image: ImageId,
    pub(crate) cam_from_a: Rigid3,
    pub(crate) cam_from_b: Rigid3,
}

/// One place in both submaps.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Correspondence {
    pub(crate) x_in_a: Vector3<f64>,
    pub(crate) x_in_b: Vector3<f64>,
    /// Standard deviation of their difference, in units of b.
    pub(crate) sigma: f64,
    /// Largest difference of an inlier, in units of b.
    pub(crate) threshold: f64,
}

/// Images registered in both, ascending.
pub(crate) fn shared_cameras(a: &Reconstruction, b: &Reconstruction) -> Vec<SharedCamera> {
    a.images
        .iter()
        .filter_map(|image| {
            let other = b.image(image.image)?;
            let (cam_from_a, cam_from_b) = (image.cam_from_world, other.cam_from_world);
            Some(SharedCamera { image: image.image, cam_from_a, cam_from_b })
        })
        .collect()
}

/// Pairs of points (places in `a.points` and `b.points`) that own common observations, each point in one pair: the
/// one with most observations in common.
pub(crate) fn shared_points(a: &Reconstruction, b: &Reconstruction) -> Vec<(u32, u32)> {
    let (owners_a, owners_b) = (owners(a, b), owners(b, a));
    let mut pairs = Vec::new();
    let mut at = 0;
    for (key, point_a) in owners_a {
        while at < owners_b.len() && owners_b[at].0 < key {
            at += 1;
        }
        if at < owners_b.len() && owners_b[at].0 == key {
            pairs.push((point_a, owners_b[at].1));
        }
    }
    pairs.sort_unstable();
    let mut counted: Vec<(u32, (u32, u32))> = Vec::new();
    for pair in pairs {
        match counted.last_mut() {
            Some((count, last)) if *last == pair => *count += 1,
            _ => counted.push((1, pair)),
        }
    }
    counted.sort_by_key(|(count, pair)| (std::cmp::Reverse(*count), *pair));
    let (mut taken_a, mut taken_b) = (vec![false; a.points.len()], vec![false; b.points.len()]);
    let mut best: Vec<(u32, u32)> = Vec::new();
    for (_, (point_a, point_b)) in counted {
        if !taken_a[point_a as usize] && !taken_b[point_b as usize] {
            taken_a[point_a as usize] = true;
            taken_b[point_b as usize] = true;
            best.push((point_a, point_b));
        }
    }
    best.sort_unstable();
    best
}

/// (image, feature) and the point that owns it, for images that `other` has too; ascending.
fn owners(reconstruction: &Reconstruction, other: &Reconstruction) -> Vec<((ImageId, u32), u32)> {
    let mut owners = Vec::new();
    for (at, point) in reconstruction.points.iter().enumerate() {
        for seen in reconstruction.track(point) {
            if other.position_of(seen.image).is_some() {
                owners.push(((seen.image, seen.feature), at as u32));
            }
        }
    }
    owners.sort_unstable();
    owners.dedup_by_key(|owner| owner.0);
    owners
}

/// The shared points and the centres of the shared cameras, with how far they may be trusted.
pub(crate) fn correspondences(
    a: &Reconstruction,
    b: &Reconstruction,
    cameras: &[SharedCamera],
    points: &[(u32, u32)],
    max_relative_distance: f64,
) -> Vec<Correspondence> {
    // A unit of a in units of b, for the uncertainty only.
    let scale = crate::statistics::median(&mut scale_samples(cameras)).unwrap_or(1.0);
    let mut result = Vec::with_capacity(points.len());
    for (in_a, in_b) in points {
        let (point_a, point_b) = (&a.points[*in_a as usize], &b.points[*in_b as usize]);
        let (Some(from_a), Some(from_b)) = (Reach::of(a, point_a), Reach::of(b, point_b)) else { continue };
        let bending = BENDING * from_b.depth;
        let sigma = (scale * from_a.sigma).hypot(from_b.sigma).hypot(bending);
        let threshold = (THRESHOLD_SIGMAS * sigma).min(max_relative_distance * from_b.depth);
        if sigma.is_finite() && threshold > 0.0 {
            let (x_in_a, x_in_b) = (point_a.x_in_world, point_b.x_in_world);
            result.push(Correspondence { x_in_a, x_in_b, sigma, threshold });
        }
    }
    result
}

/// How well a point is determined by its track.
struct Reach {
    /// Distance to the nearest camera that sees it.
    depth: f64,
    /// Standard deviation along the worst direction.
    sigma: f64,
}

impl Reach {
    fn of(reconstruction: &Reconstruction, point: &ScenePoint) -> Option<Self> {
        let track = reconstruction.track(point);
        let rays: Vec<Vector3<f64>> = track
            .iter()
            .filter_map(|seen| reconstruction.image(seen.image))
            .map(|image| point.x_in_world - image.cam_from_world.center())
            .collect();
        let depth = rays.iter().map(|ray| ray.norm()).fold(f64::INFINITY, f64::min);
        let focal_px = focal_px(reconstruction, track.first()?)?;
        let across = depth * FEATURE_SIGMA_PX / focal_px;
        let mut sine: f64 = 0.0;
        for ray in &rays[1..] {
            sine = sine.max(rays[0].cross(ray).norm() / (rays[0].norm() * ray.norm()));
        }
        let sigma = across / sine;
        (depth > 0.0 && sigma.is_finite()).then_some(Self { depth, sigma })
    }
}

fn focal_px(reconstruction: &Reconstruction, seen: &Observation) -> Option<f64> {
    let image = reconstruction.image(seen.image)?;
    reconstruction
        .camera(image.camera)
        .map(|camera| camera.mean_focal_px())
        .filter(|focal_px| *focal_px > 0.0)
}

/// Ratios of the shared cameras' distances, b to a, from one camera to the next few.
fn scale_samples(cameras: &[SharedCamera]) -> Vec<f64> {
    let mut ratios = Vec::new();
    for (at, first) in cameras.iter().enumerate() {
        for second in cameras[at + 1..].iter().take(8) {
            let in_a = (first.cam_from_a.center() - second.cam_from_a.center()).norm();
            let in_b = (first.cam_from_b.center() - second.cam_from_b.center()).norm();
            if in_a > 0.0 && in_b > 0.0 {
                ratios.push(in_b / in_a);
            }
        }
    }
    ratios
}

/// Similarities from correspondences, each with a threshold of its own. Errors are in thresholds.
pub(crate) struct SimilarityEstimator<'a> {
    pub(crate) data: &'a [Correspondence],
}

impl SimilarityEstimator<'_> {
    fn squared_error(&self, model: &Sim3) -> impl Fn(usize) -> f64 {
        let matrix: Matrix3<f64> = model.scale * model.rotation.to_rotation_matrix().into_inner();
        let translation = model.translation;
        move |i| {
            let datum = &self.data[i];
            (matrix * datum.x_in_a + translation - datum.x_in_b).norm_squared() / datum.threshold.powi(2)
        }
    }
}

impl Estimator for SimilarityEstimator<'_> {
    type Model = Sim3;

    fn sample_len(&self) -> usize {
        3
    }

    fn data_len(&self) -> usize {
        self.data.len()
    }

    fn propose(&self, sample: &[usize], models: &mut Vec<Sim3>) {
        let from: Vec<_> = sample.iter().map(|i| self.data[*i].x_in_a).collect();
        let to: Vec<_> = sample.iter().map(|i| self.data[*i].x_in_b).collect();
        models.extend(umeyama(&from, &to, None));
    }

    fn score(&self, model: &Sim3, stop_at: f64) -> Score {
        ransac::msac(self.data.len(), 1.0, stop_at, self.squared_error(model))
    }

    fn refine(&self, model: &Sim3) -> Option<Sim3> {
        refine(self.data, model)
    }

    fn inliers(&self, model: &Sim3) -> Vec<u32> {
        ransac::indices_within(self.data.len(), 1.0, self.squared_error(model))
    }
}

/// The weighted least-squares similarity near `model`: weights by uncertainty, cut down by a Cauchy kernel.
pub(crate) fn refine(data: &[Correspondence], model: &Sim3) -> Option<Sim3> {
    let from: Vec<_> = data.iter().map(|datum| datum.x_in_a).collect();
    let to: Vec<_> = data.iter().map(|datum| datum.x_in_b).collect();
    let weights: Vec<f64> = data.iter().map(|datum| weight(datum, model)).collect();
    umeyama(&from, &to, Some(&weights))
}

/// Robust weight of a correspondence: zero beyond its threshold.
fn weight(datum: &Correspondence, model: &Sim3) -> f64 {
    let distance = (model.transform_point(&datum.x_in_a) - datum.x_in_b).norm();
    if distance > datum.threshold {
        return 0.0;
    }
    let in_sigmas = distance / datum.sigma;
    1.0 / (datum.sigma.powi(2) * (1.0 + (in_sigmas / 2.0).powi(2)))
}

/// The information of `model` about its left perturbation, as if `effective` of the data were independent:
/// neighbours share the bending of their submaps, so thousands of points don't make thousands of measurements.
/// Lowered where the data spread more than their standard deviations say.
pub(crate) fn information(data: &[Correspondence], model: &Sim3, effective: f64) -> SMatrix<f64, 7, 7> {
    let mut sum = SMatrix::<f64, 7, 7>::zeros();
    let (mut count, mut squared_sigmas) = (0.0, 0.0);
    for datum in data {
        let x = model.transform_point(&datum.x_in_a);
        let distance = (x - datum.x_in_b).norm();
        if distance > datum.threshold {
            continue;
        }
        let mut jacobian = SMatrix::<f64, 3, 7>::zeros();
        jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(&-so3::skew(&x));
        jacobian.fixed_view_mut::<3, 3>(0, 3).copy_from(&Matrix3::identity());
        jacobian.set_column(6, &x);
        sum += jacobian.transpose() * jacobian / datum.sigma.powi(2);
        count += 1.0;
        squared_sigmas += (distance / datum.sigma).powi(2);
    }
    // Three residuals to a datum.
    let spread = if count > 0.0 { (squared_sigmas / (3.0 * count)).max(1.0) } else { 1.0 };
    let part = if count > effective { effective / count } else { 1.0 };
    sum * (part / spread)
}

/// RMS distance of the correspondences within their thresholds, and how many there are.
pub(crate) fn fit(data: &[Correspondence], model: &Sim3) -> (f64, u32) {
    let distances: Vec<f64> = data
        .iter()
        .map(|datum| ((model.transform_point(&datum.x_in_a) - datum.x_in_b).norm(), datum.threshold))
        .filter(|(distance, threshold)| distance <= threshold)
        .map(|(distance, _)| distance)
        .collect();
    (crate::statistics::rms(&distances), distances.len() as u32)
}

/// A robust cost of a model over all data, lower is better.
pub(crate) fn cost(data: &[Correspondence], model: &Sim3) -> f64 {
    data.iter()
        .map(|datum| {
            let distance = (model.transform_point(&datum.x_in_a) - datum.x_in_b).norm();
            (1.0 + (distance / datum.sigma / 2.0).powi(2)).ln()
        })
        .sum()
}
