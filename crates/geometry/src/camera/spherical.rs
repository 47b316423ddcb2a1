//! The equirectangular panorama: pixels are angles.
//!
//! `x_px = w (½ + longitude / 2π)`, `y_px = h (½ + latitude / π)`, with `longitude = atan2(x, z)` and
//! `latitude = atan2(y, √(x² + z²))`, downwards. Points are seen on all sides; the two poles alone, where longitude has no meaning,
//! are left out. Left and right border are the same meridian: see [`super::Camera::residual_px`].

use nalgebra::{SMatrix, Vector2, Vector3};

/// Longitude and latitude of a point.
pub(super) fn project(x: &Vector3<f64>) -> Option<Vector2<f64>> {
    let across = x.x.hypot(x.z);
    let seen = across > f64::EPSILON * x.y.abs() && across.is_finite();
    seen.then(|| Vector2::new(x.x.atan2(x.z), x.y.atan2(across)))
}

/// [`project`] with the derivative in the point.
pub(super) fn project_with_jacobian(x: &Vector3<f64>) -> Option<(Vector2<f64>, SMatrix<f64, 2, 3>)> {
    let angles = project(x)?;
    let across2 = x.x * x.x + x.z * x.z;
    let (across, r2) = (across2.sqrt(), x.norm_squared());
    let shrink = x.y / (across * r2);
    let d = SMatrix::<f64, 2, 3>::new(
        x.z / across2,
        0.0,
        -x.x / across2,
        -x.x * shrink,
        across / r2,
        -x.z * shrink,
    );
    Some((angles, d))
}

/// The ray of a longitude and a latitude, of length one; beyond the poles there is none.
pub(super) fn ray(angles: &Vector2<f64>) -> Option<Vector3<f64>> {
    let ((sin, cos), (down, across)) = (angles.x.sin_cos(), angles.y.sin_cos());
    let exists = angles.x.is_finite() && angles.y.abs() <= std::f64::consts::FRAC_PI_2;
    exists.then(|| Vector3::new(across * sin, down, across * cos))
}
