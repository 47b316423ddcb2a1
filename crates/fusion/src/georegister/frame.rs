//! A frame that is pleasant to look at, for reconstructions that can't be geo-referenced.

use nalgebra::{UnitQuaternion, Vector3};
use terrane_geometry::Sim3;
use terrane_scene::RegisteredImage;

use super::fit::Located;
use crate::statistics::median;

/// Cameras whose directions add up to less than this part of their number have no common one.
const MIN_AGREEMENT: f64 = 0.5;

/// A similarity after which z is up as far as the cameras tell, the median camera is the origin, and the unit is
/// that of the satellite positions where two or more give a scale, else the one there is.
pub(super) fn sensible(images: &[RegisteredImage], located: &[Located]) -> Sim3 {
    if images.is_empty() {
        return Sim3::identity();
    }
    let up = up_direction(images);
    let rotation = UnitQuaternion::rotation_between(&up, &Vector3::z())
        .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI));
    let centers: Vec<Vector3<f64>> = images.iter().map(|image| image.cam_from_world.center()).collect();
    let middle =
        |axis: usize| median(&mut centers.iter().map(|x| x[axis]).collect::<Vec<_>>()).unwrap_or(0.0);
    let origin = Vector3::new(middle(0), middle(1), middle(2));
    let scale = scale(located).unwrap_or(1.0);
    Sim3::new(scale, rotation, -(scale * (rotation * origin)))
}

/// The direction that most cameras hold up: against the image's down; for cameras that look straight down and turn
/// about that, against their view.
fn up_direction(images: &[RegisteredImage]) -> Vector3<f64> {
    let count = images.len() as f64;
    let mean = |axis: Vector3<f64>| {
        images.iter().map(|image| image.cam_from_world.rotation.inverse() * axis).sum::<Vector3<f64>>()
            / count
    };
    let (down, forward) = (mean(Vector3::y()), mean(Vector3::z()));
    let best = if down.norm() >= MIN_AGREEMENT || down.norm() >= forward.norm() { -down } else { -forward };
    best.try_normalize(1e-9).unwrap_or_else(Vector3::z)
}

/// Metres per unit by the median ratio of distances, when the positions lie far enough apart to tell.
fn scale(located: &[Located]) -> Option<f64> {
    let mut ratios = Vec::new();
    for (at, first) in located.iter().enumerate() {
        for second in located[at + 1..].iter().take(20) {
            let metres = (first.position.x_in_enu - second.position.x_in_enu).norm();
            let units = (first.center - second.center).norm();
            if metres > 3.0 * first.position.sigma_m.x && units > 0.0 {
                ratios.push(metres / units);
            }
        }
    }
    median(&mut ratios).filter(|scale| scale.is_finite() && *scale > 0.0)
}
