//! The robust similarity from camera centres to satellite positions.

use nalgebra::{Matrix3, Vector3};
use terrane_geometry::alignment::umeyama;
use terrane_geometry::ransac::{self, Estimator, RansacOptions, Score};
use terrane_geometry::{Seed, Sim3};
use terrane_scene::RegisteredImage;

use super::{GeoOptions, GeoOutcome, GeoReport, GeoResidual, LocalPosition, frame};
use crate::statistics::{SIGMA_FROM_MAD, median, rms};

/// A height with a larger standard deviation has no say, in metres.
const USELESS_HEIGHT_SIGMA_M: f64 = 1000.0;

/// A camera with its satellite position.
#[derive(Clone, Copy)]
pub(super) struct Located {
    pub(super) center: Vector3<f64>,
    pub(super) position: LocalPosition,
}

/// Brings a reconstruction into the local frame, or says why that can't be done.
///
/// The similarity is found by LO-RANSAC over camera centres (Umeyama 1991) with thresholds in standard deviations,
/// widened when the receivers are worse than they say, then refined by iteratively reweighted least squares. A
/// constant error of all heights is absorbed.
pub fn register(
    images: &[RegisteredImage],
    positions: &[LocalPosition],
    options: &GeoOptions,
    seed: Seed,
) -> GeoOutcome {
    let located: Vec<(usize, Located)> = images
        .iter()
        .enumerate()
        .filter_map(|(at, image)| {
            let found = positions.binary_search_by_key(&image.image, |position| position.image).ok()?;
            Some((at, Located { center: image.cam_from_world.center(), position: positions[found] }))
        })
        .collect();
    let data: Vec<Located> = located.iter().map(|(_, located)| *located).collect();
    let not_registered = |reason: String| GeoOutcome::NotRegistered {
        reason,
        frame_from_local: frame::sensible(images, &data),
    };
    if let Some(reason) = degenerate(&data, options) {
        return not_registered(reason);
    }
    let Some((enu_from_local, inlier)) = fit(&data, options, seed) else {
        return not_registered("no similarity brings the cameras to their satellite positions".to_owned());
    };
    let num_inliers = inlier.iter().filter(|inlier| **inlier).count();
    let needed = (options.min_inlier_ratio * data.len() as f64).ceil() as usize;
    if num_inliers < needed.max(options.min_positions.max(3) as usize) {
        return not_registered(format!(
            "only {num_inliers} of {} satellite positions agree with the cameras",
            data.len()
        ));
    }
    let kept: Vec<Located> =
        data.iter().zip(&inlier).filter(|(_, inlier)| **inlier).map(|(d, _)| *d).collect();
    if let Some(reason) = degenerate(&kept, options) {
        return not_registered(format!("among the satellite positions that agree, {reason}"));
    }
    GeoOutcome::Registered { enu_from_local, report: residual_report(&data, &inlier, &enu_from_local) }
}

/// Residuals of a reconstruction that is in the local frame already; which positions take part is told by a robust
/// threshold. For reports after adjustment.
pub fn residuals(images: &[RegisteredImage], positions: &[LocalPosition], options: &GeoOptions) -> GeoReport {
    let data: Vec<Located> = images
        .iter()
        .filter_map(|image| {
            let found = positions.binary_search_by_key(&image.image, |position| position.image).ok()?;
            Some(Located { center: image.cam_from_world.center(), position: positions[found] })
        })
        .collect();
    let inlier = inliers(&data, &Sim3::identity(), options);
    residual_report(&data, &inlier, &Sim3::identity())
}

fn residual_report(data: &[Located], inlier: &[bool], enu_from_local: &Sim3) -> GeoReport {
    let residuals: Vec<GeoResidual> = data
        .iter()
        .zip(inlier)
        .map(|(located, inlier)| GeoResidual {
            image: located.position.image,
            residual_m: enu_from_local.transform_point(&located.center) - located.position.x_in_enu,
            inlier: *inlier,
        })
        .collect();
    let mut all: Vec<f64> = residuals.iter().map(|residual| residual.residual_m.norm()).collect();
    let of_inliers: Vec<f64> = residuals
        .iter()
        .filter(|residual| residual.inlier)
        .map(|residual| residual.residual_m.norm())
        .collect();
    GeoReport {
        num_positions: residuals.len() as u32,
        num_inliers: of_inliers.len() as u32,
        median_m: median(&mut all).unwrap_or(0.0),
        rmse_m: rms(&of_inliers),
        residuals,
    }
}

/// Why these positions can't carry a geo-reference, if they can't.
fn degenerate(data: &[Located], options: &GeoOptions) -> Option<String> {
    let needed = options.min_positions.max(3) as usize;
    if data.len() < needed {
        return Some(format!(
            "{} registered photographs have a satellite position, {needed} are needed",
            data.len()
        ));
    }
    let count = data.len() as f64;
    let sigma = data.iter().map(|d| d.position.sigma_m.x).sum::<f64>() / count;
    let (along, across) = spread(data.iter().map(|d| horizontal(&d.position.x_in_enu)), count);
    if along < sigma.min(0.5) {
        return Some("the satellite positions are all equal".to_owned());
    }
    if across < options.min_spread_deviations * sigma {
        return Some(format!(
            "the satellite positions lie on a line ({across:.2} m across, their standard deviation is {sigma:.2} m)"
        ));
    }
    let (long, wide) = spread(data.iter().map(|d| d.center), count);
    if wide < 1e-3 * long {
        return Some("the cameras lie on a line".to_owned());
    }
    None
}

fn horizontal(x: &Vector3<f64>) -> Vector3<f64> {
    Vector3::new(x.x, x.y, 0.0)
}

/// Standard deviations of points along their main and their second direction.
fn spread(points: impl Iterator<Item = Vector3<f64>> + Clone, count: f64) -> (f64, f64) {
    let mean = points.clone().sum::<Vector3<f64>>() / count;
    let covariance: Matrix3<f64> = points.map(|x| (x - mean) * (x - mean).transpose() / count).sum();
    let mut values: Vec<f64> =
        covariance.symmetric_eigenvalues().iter().map(|value| value.max(0.0)).collect();
    values.sort_by(f64::total_cmp);
    (values[2].sqrt(), values[1].sqrt())
}

/// The similarity, and which positions agree with it.
fn fit(data: &[Located], options: &GeoOptions, seed: Seed) -> Option<(Sim3, Vec<bool>)> {
    let ransac_options = RansacOptions {
        max_iterations: options.max_iterations.max(1),
        min_iterations: 100,
        ..Default::default()
    };
    let mut best: Option<(Sim3, Vec<bool>)> = None;
    // Receivers are often worse than they say: widen until most agree.
    for widening in [1.0, 2.0, 4.0] {
        let estimator = PositionEstimator { data, max_deviations: options.max_deviations * widening };
        let Some(robust) = ransac::run(&estimator, &ransac_options, seed) else { continue };
        let refined = reweighted(data, &robust.model);
        let inlier = inliers(data, &refined, options);
        let most = inlier.iter().filter(|inlier| **inlier).count() * 2 > data.len();
        let more = best.as_ref().is_none_or(|(_, other)| {
            inlier.iter().filter(|x| **x).count() > other.iter().filter(|x| **x).count()
        });
        if more {
            best = Some((refined, inlier));
        }
        if most {
            break;
        }
    }
    best
}

/// Length of a residual in standard deviations.
fn deviations(located: &Located, enu_from_local: &Sim3) -> f64 {
    let residual = enu_from_local.transform_point(&located.center) - located.position.x_in_enu;
    let mut weighted = residual.component_div(&located.position.sigma_m);
    if located.position.sigma_m.z > USELESS_HEIGHT_SIGMA_M {
        weighted.z = 0.0;
    }
    weighted.norm()
}

/// Positions within the threshold, which follows the spread of the residuals where that is larger than stated.
fn inliers(data: &[Located], enu_from_local: &Sim3, options: &GeoOptions) -> Vec<bool> {
    let all: Vec<f64> = data.iter().map(|located| deviations(located, enu_from_local)).collect();
    // The median length of three unit normals is 1.54.
    let spread = median(&mut all.clone()).unwrap_or(0.0) / 1.54;
    let threshold = options.max_deviations * spread.clamp(1.0, 10.0) * 1.25;
    all.iter().map(|deviation| *deviation <= threshold).collect()
}

/// Iteratively reweighted least squares with a Cauchy kernel at the spread of the residuals (Holland & Welsch 1977).
fn reweighted(data: &[Located], start: &Sim3) -> Sim3 {
    let from: Vec<_> = data.iter().map(|located| located.center).collect();
    let mut model = *start;
    for _ in 0..20 {
        let all: Vec<f64> = data.iter().map(|located| deviations(located, &model)).collect();
        let spread = (SIGMA_FROM_MAD * median(&mut all.clone()).unwrap_or(0.0)).max(1e-6);
        let weights: Vec<f64> = data
            .iter()
            .zip(&all)
            .map(|(located, deviation)| {
                let sigma = located.position.sigma_m.x;
                1.0 / (sigma * sigma * (1.0 + (deviation / spread).powi(2)))
            })
            .collect();
        let to: Vec<_> = data.iter().map(|located| target(located, &model)).collect();
        match umeyama(&from, &to, Some(&weights)) {
            Some(next) => model = next,
            None => break,
        }
    }
    model
}

/// Where a camera should go: its satellite position, at the height it has where none is given.
fn target(located: &Located, enu_from_local: &Sim3) -> Vector3<f64> {
    let mut x = located.position.x_in_enu;
    if located.position.sigma_m.z > USELESS_HEIGHT_SIGMA_M {
        // Half way to the common height keeps the cameras upright where no photograph has a height.
        x.z = 0.5 * (x.z + enu_from_local.transform_point(&located.center).z);
    }
    x
}

/// Similarities from three positions; errors in standard deviations.
struct PositionEstimator<'a> {
    data: &'a [Located],
    max_deviations: f64,
}

impl Estimator for PositionEstimator<'_> {
    type Model = Sim3;

    fn sample_len(&self) -> usize {
        3
    }

    fn data_len(&self) -> usize {
        self.data.len()
    }

    fn propose(&self, sample: &[usize], models: &mut Vec<Sim3>) {
        let from: Vec<_> = sample.iter().map(|i| self.data[*i].center).collect();
        let to: Vec<_> = sample.iter().map(|i| self.data[*i].position.x_in_enu).collect();
        models.extend(umeyama(&from, &to, None));
    }

    fn score(&self, model: &Sim3, stop_at: f64) -> Score {
        ransac::msac(self.data.len(), self.max_deviations.powi(2), stop_at, |i| {
            deviations(&self.data[i], model).powi(2)
        })
    }

    fn refine(&self, model: &Sim3) -> Option<Sim3> {
        let inliers = self.inliers(model);
        let from: Vec<_> = inliers.iter().map(|i| self.data[*i as usize].center).collect();
        let to: Vec<_> = inliers.iter().map(|i| target(&self.data[*i as usize], model)).collect();
        umeyama(&from, &to, None)
    }

    fn inliers(&self, model: &Sim3) -> Vec<u32> {
        ransac::indices_within(self.data.len(), self.max_deviations.powi(2), |i| {
            deviations(&self.data[i], model).powi(2)
        })
    }
}
