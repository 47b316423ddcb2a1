//! The rotation group SO(3): exponential, logarithm and the skew operator.

use nalgebra::{Matrix3, UnitQuaternion, Vector3};

/// The skew-symmetric matrix `[v]ₓ`, so that `skew(v) * w == v.cross(w)`.
pub fn skew(v: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::new(0.0, -v.z, v.y, v.z, 0.0, -v.x, -v.y, v.x, 0.0)
}

/// The rotation by `omega` radians about its own direction; exact at zero.
pub fn exp(omega: &Vector3<f64>) -> UnitQuaternion<f64> {
    UnitQuaternion::from_scaled_axis(*omega)
}

/// The rotation vector of `rotation` in radians, of length at most π.
pub fn log(rotation: &UnitQuaternion<f64>) -> Vector3<f64> {
    rotation.scaled_axis()
}

/// The angle between two rotations in radians, within [0, π].
pub fn angle_between(a: &UnitQuaternion<f64>, b: &UnitQuaternion<f64>) -> f64 {
    a.angle_to(b)
}

/// The `J` with `log(exp(δ) exp(omega)) = omega + J δ` to first order; `omega` shorter than 2π.
pub fn left_jacobian_inverse(omega: &Vector3<f64>) -> Matrix3<f64> {
    let squared = omega.norm_squared();
    let angle = squared.sqrt();
    // 1/θ² − (1 + cos θ) / (2 θ sin θ), by its series where that cancels.
    let second = if angle < 1e-2 {
        1.0 / 12.0 + squared / 720.0
    } else {
        let (sin, cos) = (0.5 * angle).sin_cos();
        1.0 / squared - cos / (2.0 * angle * sin)
    };
    let cross = skew(omega);
    Matrix3::identity() - 0.5 * cross + second * cross * cross
}
