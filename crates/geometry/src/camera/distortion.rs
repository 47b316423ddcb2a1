//! Distortion on the plane z = 1: polynomial and rational radial, with tangential terms (Brown 1971).

use nalgebra::{Matrix2, SMatrix, Vector2};

use super::CameraModel;

/// A distorted point with its derivatives.
pub(super) struct Distorted {
    pub xy: Vector2<f64>,
    pub d_xy: Matrix2<f64>,
    pub d_coefficients: SMatrix<f64, 2, 8>,
}

/// The coefficients by their roles; absent ones are zero.
struct Coefficients {
    radial: [f64; 3],
    tangential: [f64; 2],
    denominator: [f64; 3],
}

fn coefficients(model: CameraModel, k: &[f64]) -> Coefficients {
    let mut c = Coefficients { radial: [0.0; 3], tangential: [0.0; 2], denominator: [0.0; 3] };
    match model {
        CameraModel::SimplePinhole | CameraModel::Pinhole => {}
        CameraModel::SimpleRadial => c.radial[0] = k[0],
        CameraModel::Radial => c.radial[..2].copy_from_slice(k),
        CameraModel::OpenCv => {
            c.radial[..2].copy_from_slice(&k[..2]);
            c.tangential.copy_from_slice(&k[2..4]);
        }
        CameraModel::FullOpenCv => {
            c.radial.copy_from_slice(&[k[0], k[1], k[4]]);
            c.tangential.copy_from_slice(&k[2..4]);
            c.denominator.copy_from_slice(&k[5..8]);
        }
    }
    c
}

/// The distorted point of an undistorted one.
pub(super) fn distort(model: CameraModel, k: &[f64], xy: &Vector2<f64>) -> Vector2<f64> {
    if k.is_empty() {
        return *xy;
    }
    let c = coefficients(model, k);
    let (x, y) = (xy.x, xy.y);
    let r2 = x * x + y * y;
    let numerator = 1.0 + r2 * (c.radial[0] + r2 * (c.radial[1] + r2 * c.radial[2]));
    let denominator = 1.0 + r2 * (c.denominator[0] + r2 * (c.denominator[1] + r2 * c.denominator[2]));
    let gain = numerator / denominator;
    let [p1, p2] = c.tangential;
    Vector2::new(
        x * gain + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * gain + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y),
    )
}

/// [`distort`] with derivatives in the point and in the coefficients.
pub(super) fn distort_with_jacobian(model: CameraModel, k: &[f64], xy: &Vector2<f64>) -> Distorted {
    let mut d_coefficients = SMatrix::<f64, 2, 8>::zeros();
    if k.is_empty() {
        return Distorted { xy: *xy, d_xy: Matrix2::identity(), d_coefficients };
    }
    let c = coefficients(model, k);
    let (x, y) = (xy.x, xy.y);
    let r2 = x * x + y * y;
    let [k1, k2, k3] = c.radial;
    let [k4, k5, k6] = c.denominator;
    let numerator = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
    let denominator = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
    let gain = numerator / denominator;
    let d_numerator = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3);
    let d_denominator = k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6);
    let d_gain_d_r2 = (d_numerator - gain * d_denominator) / denominator;
    let [p1, p2] = c.tangential;

    let radial = [r2, r2 * r2, r2 * r2 * r2].map(|power| power / denominator);
    let rational = radial.map(|power| -gain * power);
    let tangential =
        [Vector2::new(2.0 * x * y, r2 + 2.0 * y * y), Vector2::new(r2 + 2.0 * x * x, 2.0 * x * y)];
    let mut put = |column: usize, value: Vector2<f64>| d_coefficients.set_column(column, &value);
    match model {
        CameraModel::SimplePinhole | CameraModel::Pinhole => {}
        CameraModel::SimpleRadial => put(0, xy * radial[0]),
        CameraModel::Radial => {
            put(0, xy * radial[0]);
            put(1, xy * radial[1]);
        }
        CameraModel::OpenCv | CameraModel::FullOpenCv => {
            put(0, xy * radial[0]);
            put(1, xy * radial[1]);
            put(2, tangential[0]);
            put(3, tangential[1]);
            if model == CameraModel::FullOpenCv {
                put(4, xy * radial[2]);
                for i in 0..3 {
                    put(5 + i, xy * rational[i]);
                }
            }
        }
    }
    let d_xy = Matrix2::new(
        gain + 2.0 * x * x * d_gain_d_r2 + 2.0 * p1 * y + 6.0 * p2 * x,
        2.0 * x * y * d_gain_d_r2 + 2.0 * p1 * x + 2.0 * p2 * y,
        2.0 * x * y * d_gain_d_r2 + 2.0 * p2 * y + 2.0 * p1 * x,
        gain + 2.0 * y * y * d_gain_d_r2 + 2.0 * p2 * x + 6.0 * p1 * y,
    );
    let xy = Vector2::new(
        x * gain + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * gain + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y),
    );
    Distorted { xy, d_xy, d_coefficients }
}

/// The undistorted point of a distorted one by Newton's method, or `None` where it does not converge.
pub(super) fn undistort(model: CameraModel, k: &[f64], distorted: &Vector2<f64>) -> Option<Vector2<f64>> {
    if k.is_empty() {
        return Some(*distorted);
    }
    const MAX_ITERATIONS: usize = 50;
    let mut xy = *distorted;
    for _ in 0..MAX_ITERATIONS {
        let at = distort_with_jacobian(model, k, &xy);
        let residual = at.xy - distorted;
        let step = at.d_xy.try_inverse()? * residual;
        xy -= step;
        if !(xy.x.is_finite() && xy.y.is_finite()) {
            return None;
        }
        if step.norm_squared() < 1e-24 * (1.0 + xy.norm_squared()) {
            return Some(xy);
        }
    }
    None
}
