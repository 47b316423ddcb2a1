//! Shared cameras as a check of a similarity, and as a start where tracks are few.

use nalgebra::Vector3;
use terrane_geometry::{Sim3, so3};

use super::tracks::SharedCamera;
use crate::statistics::median;

/// How far the shared cameras disagree under a similarity.
pub(crate) struct CameraAgreement {
    /// Median rotation, in degrees.
    pub(crate) rotation_deg: f64,
    /// Median distance of centres, in units of b.
    pub(crate) distance: f64,
    /// Cameras within both bounds.
    pub(crate) num_agreeing: u32,
}

/// Compares the shared cameras under `b_from_a`.
pub(crate) fn agreement(
    cameras: &[SharedCamera],
    b_from_a: &Sim3,
    max_rotation_deg: f64,
    max_distance: f64,
) -> CameraAgreement {
    let (mut rotations, mut distances) = (Vec::new(), Vec::new());
    let mut num_agreeing = 0;
    for camera in cameras {
        let moved = b_from_a.transform_camera(&camera.cam_from_a);
        let rotation_deg = so3::angle_between(&moved.rotation, &camera.cam_from_b.rotation).to_degrees();
        let distance = (moved.center() - camera.cam_from_b.center()).norm();
        num_agreeing += u32::from(rotation_deg <= max_rotation_deg && distance <= max_distance);
        rotations.push(rotation_deg);
        distances.push(distance);
    }
    CameraAgreement {
        rotation_deg: median(&mut rotations).unwrap_or(0.0),
        distance: median(&mut distances).unwrap_or(0.0),
        num_agreeing,
    }
}

/// The similarity that the poses of two or more shared cameras give: the rotation that most agree with, then scale
/// and translation of the centres by least squares. `None` when their centres coincide.
pub(crate) fn similarity(cameras: &[SharedCamera]) -> Option<Sim3> {
    if cameras.len() < 2 {
        return None;
    }
    let turns: Vec<_> = cameras
        .iter()
        .map(|camera| camera.cam_from_b.rotation.inverse() * camera.cam_from_a.rotation)
        .collect();
    // The medoid: robust, and no average of rotations is needed.
    let total =
        |turn: &nalgebra::UnitQuaternion<f64>| turns.iter().map(|other| turn.angle_to(other)).sum::<f64>();
    let rotation = *turns.iter().min_by(|x, y| total(x).total_cmp(&total(y)))?;
    let count = cameras.len() as f64;
    let in_a: Vec<Vector3<f64>> =
        cameras.iter().map(|camera| rotation * camera.cam_from_a.center()).collect();
    let in_b: Vec<Vector3<f64>> = cameras.iter().map(|camera| camera.cam_from_b.center()).collect();
    let (mean_a, mean_b) =
        (in_a.iter().sum::<Vector3<f64>>() / count, in_b.iter().sum::<Vector3<f64>>() / count);
    let (mut along, mut spread) = (0.0, 0.0);
    for (a, b) in in_a.iter().zip(&in_b) {
        along += (a - mean_a).dot(&(b - mean_b));
        spread += (a - mean_a).norm_squared();
    }
    let scale = along / spread;
    (scale.is_finite() && scale > 0.0).then(|| Sim3::new(scale, rotation, mean_b - scale * mean_a))
}
