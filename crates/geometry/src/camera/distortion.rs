//! Distortion on the plane z = 1: polynomial and rational radial, with tangential terms (Brown 1971).
//!
//! The domain of a model is where the distorted radius grows with the undistorted one; beyond it the image folds over.

use nalgebra::{Matrix2, SMatrix, Vector2};

use super::CameraModel;

/// A distorted point with its derivatives.
pub(super) struct Distorted {
    pub xy: Vector2<f64>,
    pub d_xy: Matrix2<f64>,
    pub d_coefficients: SMatrix<f64, 2, 8>,
}

/// The radial gain at a squared radius, with its derivative in that, and the denominator of rational models.
struct Radial {
    gain: f64,
    d_gain: f64,
    denominator: f64,
}

impl Radial {
    #[inline]
    fn at(model: CameraModel, k: &[f64], r2: f64) -> Self {
        match (model, k) {
            (CameraModel::SimpleRadial, &[k1, ..]) => Self::polynomial(k1, 0.0, r2),
            (CameraModel::Radial | CameraModel::OpenCv, &[k1, k2, ..]) => Self::polynomial(k1, k2, r2),
            (CameraModel::FullOpenCv, &[k1, k2, _, _, k3, k4, k5, k6, ..]) => {
                let numerator = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
                let denominator = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
                let d_numerator = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3);
                let d_denominator = k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6);
                let gain = numerator / denominator;
                Self { gain, d_gain: (d_numerator - gain * d_denominator) / denominator, denominator }
            }
            _ => Self { gain: 1.0, d_gain: 0.0, denominator: 1.0 },
        }
    }

    #[inline]
    fn polynomial(k1: f64, k2: f64, r2: f64) -> Self {
        Self { gain: 1.0 + r2 * (k1 + r2 * k2), d_gain: k1 + 2.0 * k2 * r2, denominator: 1.0 }
    }

    /// The distorted radius grows here with the undistorted one.
    #[inline]
    fn grows(&self, r2: f64) -> bool {
        self.gain > 0.0 && self.gain + 2.0 * r2 * self.d_gain > 0.0
    }
}

/// The tangential coefficients p1, p2.
#[inline]
fn tangential(model: CameraModel, k: &[f64]) -> [f64; 2] {
    match (model, k) {
        (CameraModel::OpenCv | CameraModel::FullOpenCv, &[_, _, p1, p2, ..]) => [p1, p2],
        _ => [0.0, 0.0],
    }
}

#[inline]
fn apply(gain: f64, [p1, p2]: [f64; 2], xy: &Vector2<f64>, r2: f64) -> Vector2<f64> {
    let (x, y) = (xy.x, xy.y);
    Vector2::new(
        x * gain + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * gain + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y),
    )
}

#[inline]
fn jacobian(radial: &Radial, [p1, p2]: [f64; 2], xy: &Vector2<f64>) -> Matrix2<f64> {
    let (x, y) = (xy.x, xy.y);
    let (gain, d_gain) = (radial.gain, radial.d_gain);
    let mixed = 2.0 * x * y * d_gain + 2.0 * p1 * x + 2.0 * p2 * y;
    Matrix2::new(
        gain + 2.0 * x * x * d_gain + 2.0 * p1 * y + 6.0 * p2 * x,
        mixed,
        mixed,
        gain + 2.0 * y * y * d_gain + 2.0 * p2 * x + 6.0 * p1 * y,
    )
}

/// The distorted point of an undistorted one, by the formula alone, inside the domain or not.
#[inline]
pub(super) fn distort(model: CameraModel, k: &[f64], xy: &Vector2<f64>) -> Vector2<f64> {
    if k.is_empty() {
        return *xy;
    }
    let r2 = xy.norm_squared();
    apply(Radial::at(model, k, r2).gain, tangential(model, k), xy, r2)
}

/// [`distort`], or `None` where the image folds over.
#[inline]
pub(super) fn distort_in_domain(model: CameraModel, k: &[f64], xy: &Vector2<f64>) -> Option<Vector2<f64>> {
    if k.is_empty() {
        return Some(*xy);
    }
    let r2 = xy.norm_squared();
    let radial = Radial::at(model, k, r2);
    radial.grows(r2).then(|| apply(radial.gain, tangential(model, k), xy, r2))
}

/// [`distort_in_domain`] with the derivative in the point.
#[inline]
pub(super) fn distort_with_point_jacobian(
    model: CameraModel,
    k: &[f64],
    xy: &Vector2<f64>,
) -> Option<(Vector2<f64>, Matrix2<f64>)> {
    if k.is_empty() {
        return Some((*xy, Matrix2::identity()));
    }
    let r2 = xy.norm_squared();
    let radial = Radial::at(model, k, r2);
    let p = tangential(model, k);
    radial.grows(r2).then(|| (apply(radial.gain, p, xy, r2), jacobian(&radial, p, xy)))
}

/// [`distort_in_domain`] with derivatives in the point and in the coefficients.
pub(super) fn distort_with_jacobian(model: CameraModel, k: &[f64], xy: &Vector2<f64>) -> Option<Distorted> {
    let mut d_coefficients = SMatrix::<f64, 2, 8>::zeros();
    if k.is_empty() {
        return Some(Distorted { xy: *xy, d_xy: Matrix2::identity(), d_coefficients });
    }
    let r2 = xy.norm_squared();
    let radial = Radial::at(model, k, r2);
    if !radial.grows(r2) {
        return None;
    }
    let p = tangential(model, k);
    let powers = [r2, r2 * r2, r2 * r2 * r2].map(|power| power / radial.denominator);
    let mut put = |column: usize, value: Vector2<f64>| d_coefficients.set_column(column, &value);
    put(0, xy * powers[0]);
    if model != CameraModel::SimpleRadial {
        put(1, xy * powers[1]);
    }
    if matches!(model, CameraModel::OpenCv | CameraModel::FullOpenCv) {
        let twice = 2.0 * xy.x * xy.y;
        put(2, Vector2::new(twice, r2 + 2.0 * xy.y * xy.y));
        put(3, Vector2::new(r2 + 2.0 * xy.x * xy.x, twice));
    }
    if model == CameraModel::FullOpenCv {
        put(4, xy * powers[2]);
        for i in 0..3 {
            put(5 + i, xy * (-radial.gain * powers[i]));
        }
    }
    Some(Distorted { xy: apply(radial.gain, p, xy, r2), d_xy: jacobian(&radial, p, xy), d_coefficients })
}

/// The undistorted point of a distorted one, or `None` where there is none in the domain.
pub(super) fn undistort(model: CameraModel, k: &[f64], distorted: &Vector2<f64>) -> Option<Vector2<f64>> {
    match (model, k) {
        (_, []) => Some(*distorted),
        (CameraModel::SimpleRadial, &[k1, ..]) => undistort_radial(k1, 0.0, distorted),
        (CameraModel::Radial, &[k1, k2, ..]) => undistort_radial(k1, k2, distorted),
        _ => undistort_newton(model, k, distorted),
    }
}

/// The first squared radius at which `r (1 + k1 r² + k2 r⁴)` stops growing; infinite when it never does.
fn fold_r2(k1: f64, k2: f64) -> f64 {
    let folds = crate::polynomial::quadratic_roots([1.0, 3.0 * k1, 5.0 * k2]);
    folds.into_iter().filter(|r2| *r2 > 0.0).fold(f64::INFINITY, f64::min)
}

/// Polynomial models shrink to one equation in the radius, which grows up to the fold: Newton's method inside a bracket.
fn undistort_radial(k1: f64, k2: f64, distorted: &Vector2<f64>) -> Option<Vector2<f64>> {
    let target = distorted.norm();
    if target < f64::EPSILON || k1 == 0.0 && k2 == 0.0 {
        return target.is_finite().then_some(*distorted);
    }
    let high = fold_r2(k1, k2).sqrt();
    let value = |r: f64| r * (1.0 + r * r * (k1 + r * r * k2)) - target;
    if high.is_finite() && !(value(high) > 0.0) || !target.is_finite() {
        return None;
    }
    let start = if target < high { target } else { 0.5 * high };
    let r = growing_root(start, high, |r| {
        let r2 = r * r;
        (value(r), 1.0 + r2 * (3.0 * k1 + 5.0 * k2 * r2))
    });
    Some(distorted * (r / target))
}

/// Where a function that grows from zero to `high`, which may be infinite, vanishes: Newton's method inside a bracket. The
/// function gives its value and its slope.
pub(super) fn growing_root(start: f64, high: f64, function: impl Fn(f64) -> (f64, f64)) -> f64 {
    const MAX_ITERATIONS: usize = 60;
    let (mut at, mut low, mut high) = (start, 0.0, high);
    for _ in 0..MAX_ITERATIONS {
        let (value, slope) = function(at);
        if value == 0.0 {
            break;
        }
        if value > 0.0 {
            high = at
        } else {
            low = at
        }
        let newton = at - value / slope;
        let inside = newton > low && newton < high;
        let next = match (inside, high.is_finite()) {
            (true, _) => newton,
            (false, true) => 0.5 * (low + high),
            (false, false) => 2.0 * at,
        };
        let step = (next - at).abs();
        at = next;
        if step <= 1e-15 * at {
            break;
        }
    }
    at
}

/// Newton's method in the plane.
fn undistort_newton(model: CameraModel, k: &[f64], distorted: &Vector2<f64>) -> Option<Vector2<f64>> {
    const MAX_ITERATIONS: usize = 50;
    let mut xy = *distorted;
    // A start beyond the fold is drawn in until it is inside.
    while distort_in_domain(model, k, &xy).is_none() {
        xy *= 0.7;
        if !(xy.norm_squared() > 1e-6) {
            return None;
        }
    }
    for _ in 0..MAX_ITERATIONS {
        let (at, d_xy) = distort_with_point_jacobian(model, k, &xy)?;
        let step = d_xy.try_inverse()? * (at - distorted);
        xy -= step;
        if step.norm_squared() < 1e-28 * (1.0 + xy.norm_squared()) {
            // A root beyond the fold is none of ours.
            return distort_in_domain(model, k, &xy).map(|_| xy);
        }
    }
    None
}
