//! Distortions of the radius on the plane z = 1 with an inverse in closed form: FOV, division, EUCM.
//!
//! - FOV (Devernay & Faugeras 2001): `r_d = atan(2 r tan(ω/2)) / ω`, `|ω| < π`; at ω = 0 no distortion.
//! - Division (Fitzgibbon 2001): `r = r_d / (1 + k r_d²)`, as far as `r` grows with `r_d`: `4 k r² < 1`.
//! - EUCM (Khomutenko, Garcia & Martinet 2016): `r_d = r / (α √(β r² + 1) + 1 − α)`, as far as that grows with `r`: everywhere when
//!   `0 ≤ α ≤ 1` and `β > 0`.
//!
//! The domain is z > 0, though rays of division and EUCM go on beyond 90 degrees.

use nalgebra::{Matrix2, SMatrix, Vector2, Vector3};

use super::{CameraModel, Image, point_jacobian};

/// `r_d / r` at a squared radius, with its derivatives in that and in the coefficients.
struct Gain {
    value: f64,
    d_r2: f64,
    d_coefficients: [f64; 2],
}

impl Gain {
    fn at(model: CameraModel, k: &[f64], r2: f64) -> Option<Self> {
        match (model, k) {
            (CameraModel::Fov, &[omega]) => Self::fov(omega, r2),
            (CameraModel::SimpleDivision | CameraModel::Division, &[k]) => Self::division(k, r2),
            (CameraModel::Eucm, &[alpha, beta]) => Self::eucm(alpha, beta, r2),
            _ => None,
        }
    }

    fn fov(omega: f64, r2: f64) -> Option<Self> {
        if !(omega.abs() < std::f64::consts::PI) {
            return None;
        }
        let (a, ratio, d_ratio) = fov_scale(omega);
        let u = a * a * r2;
        // A = atan(√u)/√u and its derivative in u, which cancel near the axis.
        let (arc, d_arc) = if u < 1e-3 {
            let arc = 1.0 + u * (-1.0 / 3.0 + u * (0.2 + u * (-1.0 / 7.0 + u / 9.0)));
            (arc, -1.0 / 3.0 + u * (0.4 + u * (-3.0 / 7.0 + u * (4.0 / 9.0 - u * 5.0 / 11.0))))
        } else {
            let arc = u.sqrt().atan() / u.sqrt();
            (arc, (1.0 / (1.0 + u) - arc) / (2.0 * u))
        };
        let d_a = 1.0 + 0.25 * a * a;
        Some(Self {
            value: ratio * arc,
            d_r2: ratio * d_arc * a * a,
            d_coefficients: [d_ratio * arc + ratio * d_arc * 2.0 * a * d_a * r2, 0.0],
        })
    }

    fn division(k: f64, r2: f64) -> Option<Self> {
        let root = (1.0 - 4.0 * k * r2).sqrt();
        if !(root > 0.0) {
            return None;
        }
        let value = 2.0 / (1.0 + root);
        let slope = value * value / root;
        Some(Self { value, d_r2: k * slope, d_coefficients: [r2 * slope, 0.0] })
    }

    fn eucm(alpha: f64, beta: f64, r2: f64) -> Option<Self> {
        let d = (beta * r2 + 1.0).sqrt();
        let denominator = alpha * d + 1.0 - alpha;
        if !(d > 0.0 && denominator > 0.0 && alpha / d + 1.0 - alpha > 0.0) {
            return None;
        }
        let value = 1.0 / denominator;
        let square = value * value;
        Some(Self {
            value,
            d_r2: -0.5 * square * alpha * beta / d,
            d_coefficients: [-square * (d - 1.0), -0.5 * square * alpha * r2 / d],
        })
    }
}

/// `a = 2 tan(ω/2)`, `a/ω`, and the derivative of that in ω.
fn fov_scale(omega: f64) -> (f64, f64, f64) {
    let a = 2.0 * (0.5 * omega).tan();
    if omega.abs() < 0.02 {
        let s = omega * omega;
        let ratio = 1.0 + s * (1.0 / 12.0 + s * (1.0 / 120.0 + s * 17.0 / 20160.0));
        return (a, ratio, omega * (1.0 / 6.0 + s * (1.0 / 30.0 + s * 17.0 / 3360.0)));
    }
    let ratio = a / omega;
    (a, ratio, (1.0 + 0.25 * a * a - ratio) / omega)
}

/// The image of a point, for a focal length of one about the principal point.
pub(super) fn project(model: CameraModel, k: &[f64], x: &Vector3<f64>) -> Option<Vector2<f64>> {
    if !(x.z > f64::EPSILON) {
        return None;
    }
    let xy = x.xy() / x.z;
    Some(xy * Gain::at(model, k, xy.norm_squared())?.value)
}

/// [`project`] with derivatives.
pub(super) fn project_with_jacobian(model: CameraModel, k: &[f64], x: &Vector3<f64>) -> Option<Image> {
    if !(x.z > f64::EPSILON) {
        return None;
    }
    let xy = x.xy() / x.z;
    let gain = Gain::at(model, k, xy.norm_squared())?;
    let d_xy = Matrix2::identity() * gain.value + xy * xy.transpose() * (2.0 * gain.d_r2);
    let mut d_coefficients = SMatrix::<f64, 2, 12>::zeros();
    for (column, d) in gain.d_coefficients.iter().enumerate() {
        d_coefficients.set_column(column, &(xy * *d));
    }
    let d_point = point_jacobian(&Vector2::repeat(1.0), &d_xy, &xy, 1.0 / x.z);
    Some(Image { xy: xy * gain.value, d_point, d_coefficients })
}

/// The ray of a distorted point, of length one.
pub(super) fn ray(model: CameraModel, k: &[f64], distorted: &Vector2<f64>) -> Option<Vector3<f64>> {
    let r2 = distorted.norm_squared();
    let ray = match (model, k) {
        (CameraModel::Fov, &[omega]) => {
            let angle = r2.sqrt() * omega.abs();
            if !(angle < std::f64::consts::FRAC_PI_2 && omega.abs() < std::f64::consts::PI) {
                return None;
            }
            let (_, ratio, _) = fov_scale(omega);
            let tangent_over_angle = if angle > 1e-9 { angle.tan() / angle } else { 1.0 };
            // r / r_d = tan(r_d ω) / (2 tan(ω/2) r_d).
            (distorted * (tangent_over_angle / ratio)).push(1.0)
        }
        // Beyond k r_d² = 1 radii shrink again.
        (CameraModel::SimpleDivision | CameraModel::Division, &[k]) if k * r2 < 1.0 => {
            distorted.push(1.0 + k * r2)
        }
        (CameraModel::Eucm, &[alpha, beta]) => {
            let root = (1.0 - (2.0 * alpha - 1.0) * beta * r2).sqrt();
            distorted.push((1.0 - alpha * alpha * beta * r2) / (alpha * root + 1.0 - alpha))
        }
        _ => return None,
    };
    ray.try_normalize(0.0).filter(|ray| ray.iter().all(|value| value.is_finite()))
}
