//! How far a reconstruction is from the truth, after the best similarity between their camera centres.

use nalgebra::{Matrix3, Vector3};
use terrane_geometry::Sim3;
use terrane_scene::{ImageId, Reconstruction};

/// Errors of a result's cameras against the truth.
#[derive(Clone, Debug, PartialEq)]
pub struct Comparison {
    /// Images in both.
    pub num_images: usize,
    /// Median distance of camera centres, in the truth's unit.
    pub center_median_m: f64,
    /// Root of the mean squared distance of camera centres, in the truth's unit.
    pub center_rmse_m: f64,
    /// Median angle between rotations in radians.
    pub rotation_median_rad: f64,
    /// Largest angle between rotations in radians.
    pub rotation_max_rad: f64,
    /// The similarity that was applied to the result.
    pub truth_from_result: Sim3,
}

/// Compares the cameras of `result` with those of `truth`, or `None` with fewer than three images in both.
///
/// With `fit` the result is moved by the least-squares similarity of camera centres (Umeyama 1991) first; without,
/// both are taken to be in one frame.
pub fn cameras(result: &Reconstruction, truth: &Reconstruction, fit: bool) -> Option<Comparison> {
    let both: Vec<ImageId> =
        result.images.iter().map(|image| image.image).filter(|image| truth.image(*image).is_some()).collect();
    if both.len() < 3 {
        return None;
    }
    let centers = |model: &Reconstruction| -> Vec<Vector3<f64>> {
        both.iter()
            .filter_map(|image| model.image(*image))
            .map(|image| image.cam_from_world.center())
            .collect()
    };
    let truth_from_result =
        if fit { similarity(&centers(result), &centers(truth))? } else { Sim3::identity() };
    let mut distances = Vec::with_capacity(both.len());
    let mut angles = Vec::with_capacity(both.len());
    for image in &both {
        let moved = truth_from_result.transform_camera(&result.image(*image)?.cam_from_world);
        let wanted = truth.image(*image)?.cam_from_world;
        distances.push((moved.center() - wanted.center()).norm());
        angles.push(moved.rotation.angle_to(&wanted.rotation));
    }
    let mean_square = distances.iter().map(|d| d * d).sum::<f64>() / distances.len() as f64;
    distances.sort_unstable_by(f64::total_cmp);
    angles.sort_unstable_by(f64::total_cmp);
    Some(Comparison {
        num_images: both.len(),
        center_median_m: distances[distances.len() / 2],
        center_rmse_m: mean_square.sqrt(),
        rotation_median_rad: angles[angles.len() / 2],
        rotation_max_rad: angles[angles.len() - 1],
        truth_from_result,
    })
}

/// The least-squares similarity `to_from_from` (Umeyama 1991), or `None` for coincident points.
///
/// Written apart from the library under test, so that a mistake there can't hide itself here.
fn similarity(from: &[Vector3<f64>], to: &[Vector3<f64>]) -> Option<Sim3> {
    let count = from.len() as f64;
    let mean = |points: &[Vector3<f64>]| points.iter().sum::<Vector3<f64>>() / count;
    let (mean_from, mean_to) = (mean(from), mean(to));
    let mut covariance = Matrix3::zeros();
    let mut variance = 0.0;
    for (a, b) in from.iter().zip(to) {
        covariance += (b - mean_to) * (a - mean_from).transpose() / count;
        variance += (a - mean_from).norm_squared() / count;
    }
    let svd = covariance.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    let mut signs = Vector3::repeat(1.0);
    if u.determinant() * v_t.determinant() < 0.0 {
        signs.z = -1.0;
    }
    let rotation = u * Matrix3::from_diagonal(&signs) * v_t;
    let scale = svd.singular_values.dot(&signs) / variance;
    if !(scale.is_finite() && scale > 0.0) {
        return None;
    }
    let rotation = nalgebra::UnitQuaternion::from_matrix(&rotation);
    Some(Sim3::new(scale, rotation, mean_to - scale * (rotation * mean_from)))
}
