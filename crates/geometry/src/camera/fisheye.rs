//! Fisheyes: a polynomial in the angle to the optical axis (Kannala & Brandt 2006), with tangential and thin prism terms.
//!
//! The equidistant point is `e = θ (x, y)/|(x, y)|`. The polynomial moves it to `m = e (1 + k₁θ² + k₂θ⁴ + …)`; tangential and
//! prism terms are added, those of a point `p` of squared length `s` being
//! `(a (s + 2 p_x²) + 2 b p_x p_y + t₀ s + t₁ s², b (s + 2 p_y²) + 2 a p_x p_y + u₀ s + u₁ s²)`. THIN_PRISM_FISHEYE takes them at
//! `e` (Weng, Cohen & Herniou 1992), RAD_TAN_THIN_PRISM_FISHEYE at `m`.
//!
//! The domain is z > 0, up to where `|m|` stops growing with θ. Rays go on beyond 90 degrees, to 180 at most. A fold that
//! tangential and prism terms alone would make is not looked for.

use std::f64::consts::PI;

use nalgebra::{Matrix2, SMatrix, Vector2, Vector3};

use super::distortion::growing_root;
use super::{CameraModel, Image};

/// The most radial coefficients of a fisheye.
const MAX_RADIAL: usize = 6;

/// What moves the equidistant point.
#[derive(Default)]
struct Terms {
    radial: [f64; MAX_RADIAL],
    /// `a` and `b` of the tangential terms.
    tangential: [f64; 2],
    /// `t` and `u` of the thin prism.
    prism: [[f64; 2]; 2],
    /// Tangential and prism terms are those of the point that the polynomial has moved.
    of_moved: bool,
}

impl Terms {
    fn new(model: CameraModel, k: &[f64]) -> Self {
        match (model, k) {
            (CameraModel::ThinPrismFisheye, &[k1, k2, p1, p2, k3, k4, sx, sy]) => Self {
                radial: [k1, k2, k3, k4, 0.0, 0.0],
                tangential: [p2, p1],
                prism: [[sx, 0.0], [sy, 0.0]],
                of_moved: false,
            },
            (CameraModel::RadTanThinPrismFisheye, &[k0, k1, k2, k3, k4, k5, p0, p1, s0, s1, s2, s3]) => {
                Self {
                    radial: [k0, k1, k2, k3, k4, k5],
                    tangential: [p0, p1],
                    prism: [[s0, s1], [s2, s3]],
                    of_moved: true,
                }
            }
            _ => {
                let mut terms = Self::default();
                terms.radial.iter_mut().zip(k).for_each(|(term, k)| *term = *k);
                terms
            }
        }
    }

    fn is_radial(&self) -> bool {
        self.tangential == [0.0; 2] && self.prism == [[0.0; 2]; 2]
    }

    /// The polynomial's gain at a squared angle, and its derivative in that.
    fn gain(&self, s: f64) -> (f64, f64) {
        let (mut gain, mut d_gain) = (0.0, 0.0);
        for k in self.radial.iter().rev() {
            d_gain = d_gain * s + gain;
            gain = gain * s + k;
        }
        (1.0 + s * gain, gain + s * d_gain)
    }

    /// Tangential and prism terms of a point, with their derivative.
    fn planar(&self, p: &Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
        let ([a, b], [t, u]) = (self.tangential, self.prism);
        let (x, y, s) = (p.x, p.y, p.norm_squared());
        let (along_x, along_y) = (2.0 * (t[0] + 2.0 * t[1] * s), 2.0 * (u[0] + 2.0 * u[1] * s));
        let moved = Vector2::new(
            a * (s + 2.0 * x * x) + 2.0 * b * x * y + s * (t[0] + t[1] * s),
            b * (s + 2.0 * y * y) + 2.0 * a * x * y + s * (u[0] + u[1] * s),
        );
        let d = Matrix2::new(
            6.0 * a * x + 2.0 * b * y + along_x * x,
            2.0 * a * y + 2.0 * b * x + along_x * y,
            2.0 * b * x + 2.0 * a * y + along_y * x,
            6.0 * b * y + 2.0 * a * x + along_y * y,
        );
        (moved, d)
    }

    /// The distorted point of an equidistant one.
    fn distort(&self, e: &Vector2<f64>) -> Vector2<f64> {
        let moved = e * self.gain(e.norm_squared()).0;
        if self.is_radial() {
            return moved;
        }
        moved + self.planar(if self.of_moved { &moved } else { e }).0
    }

    /// The same with its derivative in the equidistant point, and that in the moved one.
    fn distort_with_jacobian(&self, e: &Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>, Matrix2<f64>) {
        let (gain, d_gain) = self.gain(e.norm_squared());
        let moved = e * gain;
        let d_moved = Matrix2::identity() * gain + e * e.transpose() * (2.0 * d_gain);
        if self.of_moved {
            let (planar, d_planar) = self.planar(&moved);
            let through = Matrix2::identity() + d_planar;
            (moved + planar, through * d_moved, through)
        } else {
            let (planar, d_planar) = self.planar(e);
            (moved + planar, d_moved + d_planar, Matrix2::identity())
        }
    }

    /// The distorted angle grows all the way to this squared angle.
    fn grows_to(&self, s: f64) -> bool {
        let mut terms = [1.0; MAX_RADIAL + 1];
        let (mut power, mut least) = (1.0, 1.0);
        for (j, k) in self.radial.iter().enumerate() {
            power *= s;
            terms[j + 1] = (2 * j + 3) as f64 * k * power;
            least += terms[j + 1].min(0.0);
        }
        // Negative terms only grow with s: what they leave at the end they leave everywhere.
        least > 0.0 || is_positive(&bernstein(&terms), 40)
    }

    /// The angle at which the distorted one stops growing, 180 degrees at most.
    fn fold_rad(&self) -> f64 {
        let (mut low, mut high) = (0.0, PI * PI);
        if self.grows_to(high) {
            return PI;
        }
        for _ in 0..52 {
            let middle = 0.5 * (low + high);
            if self.grows_to(middle) { low = middle } else { high = middle }
        }
        low.sqrt()
    }

    /// The angle of a distorted one, by Newton's method inside a bracket.
    fn angle_rad(&self, distorted_rad: f64) -> Option<f64> {
        let high = self.fold_rad();
        let value = |theta: f64| theta * self.gain(theta * theta).0 - distorted_rad;
        if !(value(high) >= 0.0) {
            return None;
        }
        Some(growing_root(distorted_rad.min(0.5 * high), high, |theta| {
            let s = theta * theta;
            let (gain, d_gain) = self.gain(s);
            (theta * gain - distorted_rad, gain + 2.0 * s * d_gain)
        }))
    }

    /// The equidistant point of a distorted one.
    fn undistort(&self, distorted: &Vector2<f64>) -> Option<Vector2<f64>> {
        const MAX_ITERATIONS: usize = 50;
        let length = distorted.norm();
        if !length.is_finite() {
            return None;
        }
        if self.is_radial() {
            let angle = self.angle_rad(length)?;
            return Some(if length > 0.0 { distorted * (angle / length) } else { *distorted });
        }
        let start = self.angle_rad(length).unwrap_or_else(|| 0.9 * self.fold_rad());
        let mut e = if length > 0.0 { distorted * (start / length) } else { *distorted };
        for _ in 0..MAX_ITERATIONS {
            let (at, d, _) = self.distort_with_jacobian(&e);
            let step = d.try_inverse()? * (at - distorted);
            e -= step;
            if step.norm_squared() < 1e-28 * (1.0 + e.norm_squared()) {
                let s = e.norm_squared();
                return (s <= PI * PI && self.grows_to(s)).then_some(e);
            }
        }
        None
    }
}

/// Bernstein's form, on [0, 1], of a polynomial given from the constant term up.
fn bernstein(terms: &[f64; MAX_RADIAL + 1]) -> [f64; MAX_RADIAL + 1] {
    let mut form = *terms;
    let mut binomial = 1.0;
    for (j, value) in form.iter_mut().enumerate() {
        *value /= binomial;
        binomial *= (MAX_RADIAL - j) as f64 / (j + 1) as f64;
    }
    for round in 1..=MAX_RADIAL {
        for i in (round..=MAX_RADIAL).rev() {
            form[i] += form[i - 1];
        }
    }
    form
}

/// Whether a polynomial in Bernstein's form is positive on all of [0, 1]: its coefficients enclose it, ever closer on halves.
fn is_positive(form: &[f64; MAX_RADIAL + 1], halvings: u32) -> bool {
    if form.iter().all(|value| *value > 0.0) {
        return true;
    }
    if !(form[0] > 0.0 && form[MAX_RADIAL] > 0.0) || halvings == 0 {
        return false;
    }
    let (mut left, mut right) = (*form, *form);
    for round in 1..=MAX_RADIAL {
        for i in 0..=MAX_RADIAL - round {
            right[i] = 0.5 * (right[i] + right[i + 1]);
        }
        left[round] = right[0];
    }
    is_positive(&left, halvings - 1) && is_positive(&right, halvings - 1)
}

/// The equidistant point, with its derivative in the point in the camera's frame.
fn equidistant(x: &Vector3<f64>) -> (Vector2<f64>, SMatrix<f64, 2, 3>) {
    let (p, z) = (x.xy(), x.z);
    let s = p.norm_squared();
    let inverse_r2 = 1.0 / (s + z * z);
    let t = s / (z * z);
    // h = θ/ρ, and (dθ/dρ − h)/ρ², which cancels near the axis.
    let (h, bend) = if t < 1e-3 {
        let h = (1.0 + t * (-1.0 / 3.0 + t * (0.2 + t * (-1.0 / 7.0 + t / 9.0)))) / z;
        let bend = -2.0 / 3.0 + t * (0.8 + t * (-6.0 / 7.0 + t * (8.0 / 9.0 - t * 10.0 / 11.0)));
        (h, bend / (z * z * z))
    } else {
        let rho = s.sqrt();
        let h = rho.atan2(z) / rho;
        (h, (z * inverse_r2 - h) / s)
    };
    let across = Matrix2::identity() * h + p * p.transpose() * bend;
    let along = -p * inverse_r2;
    let d = SMatrix::<f64, 2, 3>::from_columns(&[across.column(0).into(), across.column(1).into(), along]);
    (p * h, d)
}

/// The image of a point, for a focal length of one about the principal point.
pub(super) fn project(model: CameraModel, k: &[f64], x: &Vector3<f64>) -> Option<Vector2<f64>> {
    if !(x.z > f64::EPSILON) {
        return None;
    }
    let terms = Terms::new(model, k);
    let (e, _) = equidistant(x);
    terms.grows_to(e.norm_squared()).then(|| terms.distort(&e))
}

/// [`project`] with derivatives.
pub(super) fn project_with_jacobian(model: CameraModel, k: &[f64], x: &Vector3<f64>) -> Option<Image> {
    if !(x.z > f64::EPSILON) {
        return None;
    }
    let terms = Terms::new(model, k);
    let (e, d_e) = equidistant(x);
    let s = e.norm_squared();
    if !terms.grows_to(s) {
        return None;
    }
    let (xy, d, through) = terms.distort_with_jacobian(&e);
    let at = if terms.of_moved { e * terms.gain(s).0 } else { e };
    Some(Image { xy, d_point: d * d_e, d_coefficients: d_coefficients(model, &e, &at, &through) })
}

/// The derivative in the coefficients; tangential and prism terms are taken at `at`.
fn d_coefficients(
    model: CameraModel,
    e: &Vector2<f64>,
    at: &Vector2<f64>,
    through: &Matrix2<f64>,
) -> SMatrix<f64, 2, 12> {
    let mut d = SMatrix::<f64, 2, 12>::zeros();
    let s = e.norm_squared();
    let radial: &[usize] = match model {
        CameraModel::SimpleRadialFisheye => &[0],
        CameraModel::RadialFisheye => &[0, 1],
        CameraModel::OpenCvFisheye => &[0, 1, 2, 3],
        CameraModel::ThinPrismFisheye => &[0, 1, 4, 5],
        CameraModel::RadTanThinPrismFisheye => &[0, 1, 2, 3, 4, 5],
        _ => &[],
    };
    let mut moved = through * e;
    for column in radial {
        moved *= s;
        d.set_column(*column, &moved);
    }
    let (r2, twice) = (at.norm_squared(), 2.0 * at.x * at.y);
    let a = Vector2::new(r2 + 2.0 * at.x * at.x, twice);
    let b = Vector2::new(twice, r2 + 2.0 * at.y * at.y);
    let (x, y) = (Vector2::x(), Vector2::y());
    let planar: &[(usize, Vector2<f64>)] = match model {
        CameraModel::ThinPrismFisheye => &[(2, b), (3, a), (6, x * r2), (7, y * r2)],
        CameraModel::RadTanThinPrismFisheye => {
            &[(6, a), (7, b), (8, x * r2), (9, x * r2 * r2), (10, y * r2), (11, y * r2 * r2)]
        }
        _ => &[],
    };
    planar.iter().for_each(|(column, value)| d.set_column(*column, value));
    d
}

/// The ray of a distorted point, of length one.
pub(super) fn ray(model: CameraModel, k: &[f64], distorted: &Vector2<f64>) -> Option<Vector3<f64>> {
    let e = Terms::new(model, k).undistort(distorted)?;
    let angle = e.norm();
    let sine_over_angle = if angle > 0.0 { angle.sin() / angle } else { 1.0 };
    Some((e * sine_over_angle).push(angle.cos()))
}
