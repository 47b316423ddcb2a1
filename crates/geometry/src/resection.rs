//! The whole pinhole camera, intrinsics and pose, from six points and more.
//!
//! The direct linear transform with normalised points (Hartley & Zisserman 2004, algorithm 7.1), then the projection matrix
//! is taken apart into an upper triangular matrix and a rotation (section 6.2.4).

use nalgebra::{Matrix3, Matrix3x4, Rotation3, SMatrix, SVector, UnitQuaternion, Vector2, Vector3};
use thiserror::Error;

use crate::Rigid3;
use crate::linear::symmetric_eigen;

/// Points this flat, by the ratio of their least to their largest standard deviation, leave the camera open.
const MIN_THICKNESS: f64 = 1e-5;

/// A camera with five intrinsics and no distortion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Resected {
    /// Upper triangular, its diagonal positive, its last entry one: pixels from the plane z = 1.
    pub px_from_normalized: Matrix3<f64>,
    /// Pose of the camera.
    pub cam_from_world: Rigid3,
}

impl Resected {
    /// Pixels from homogeneous points of the world, of any scale.
    pub fn px_from_world(&self) -> Matrix3x4<f64> {
        self.px_from_normalized * self.cam_from_world.matrix3x4()
    }
}

/// Why points give no camera.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum ResectionError {
    /// Eleven unknowns need six points.
    #[error("six points or more, with a pixel each, are needed")]
    TooFew,
    /// The numbers of points and pixels differ.
    #[error("there are not as many pixels as points")]
    LengthsDiffer,
    /// A coordinate is not a finite number.
    #[error("a coordinate is not finite")]
    NotFinite,
    /// The points lie on one plane.
    #[error("all points lie on one plane; use calibration from planar targets, or points off the plane")]
    Planar,
    /// Several projections fit: the points and the camera lie on a twisted cubic, or pixels on a line.
    #[error("the points leave more than one camera possible; add points in other places")]
    Ambiguous,
    /// The projection that fits is no camera with all points ahead.
    #[error("no camera sees all points ahead of it at these pixels; look for wrong correspondences")]
    NoCamera,
}

/// The camera that fits six or more points and their pixels linearly; all correspondences must be right.
pub fn resect(x_in_world: &[Vector3<f64>], xy_px: &[Vector2<f64>]) -> Result<Resected, ResectionError> {
    if x_in_world.len() != xy_px.len() {
        return Err(ResectionError::LengthsDiffer);
    }
    if x_in_world.len() < 6 {
        return Err(ResectionError::TooFew);
    }
    let (x_mean, x_scale, xs) = normalized(x_in_world).ok_or(ResectionError::NotFinite)?;
    let (px_mean, px_scale, pixels) = normalized(xy_px).ok_or(ResectionError::NotFinite)?;
    let scatter: Matrix3<f64> = xs.iter().map(|x| x * x.transpose()).sum();
    let (spreads, _) = symmetric_eigen(scatter);
    if !(spreads[0] > MIN_THICKNESS * MIN_THICKNESS * spreads[2]) {
        return Err(ResectionError::Planar);
    }
    let p = fitted(&xs, &pixels)?;
    let px_from = Matrix3::new(1.0 / px_scale, 0.0, px_mean.x, 0.0, 1.0 / px_scale, px_mean.y, 0.0, 0.0, 1.0);
    let p = px_from * p;
    let left = p.fixed_view::<3, 3>(0, 0) * x_scale;
    let last = p.column(3) - left * x_mean;
    let (k, camera) = taken_apart(&left, &last).ok_or(ResectionError::NoCamera)?;
    let ahead = |x: &Vector3<f64>| camera.transform_point(x).z > 0.0;
    if !x_in_world.iter().all(ahead) {
        return Err(ResectionError::NoCamera);
    }
    Ok(Resected { px_from_normalized: k, cam_from_world: camera })
}

/// Mean and scale that make the root mean square distance one, with the points moved; `None` when not finite.
fn normalized<const N: usize>(
    points: &[SVector<f64, N>],
) -> Option<(SVector<f64, N>, f64, Vec<SVector<f64, N>>)> {
    let count = points.len() as f64;
    let mean = points.iter().sum::<SVector<f64, N>>() / count;
    let squared = points.iter().map(|p| (p - mean).norm_squared()).sum::<f64>() / count;
    // Points that are all one stay so, and are refused by name later.
    let scale = if squared > 0.0 { 1.0 / squared.sqrt() } else { 1.0 };
    (squared.is_finite() && scale.is_finite())
        .then(|| (mean, scale, points.iter().map(|p| (p - mean) * scale).collect()))
}

/// The projection of norm one with the least algebraic error.
fn fitted(xs: &[Vector3<f64>], pixels: &[Vector2<f64>]) -> Result<Matrix3x4<f64>, ResectionError> {
    let mut sums = SMatrix::<f64, 12, 12>::zeros();
    for (x, pixel) in xs.iter().zip(pixels) {
        let h = x.push(1.0);
        for axis in 0..2 {
            let mut row = SVector::<f64, 12>::zeros();
            row.fixed_rows_mut::<4>(4 * axis).copy_from(&h);
            row.fixed_rows_mut::<4>(8).copy_from(&(h * -pixel[axis]));
            sums += row * row.transpose();
        }
    }
    let (values, vectors) = symmetric_eigen(sums);
    if !(values[1] > 1e-13 * values[11]) || !values[11].is_finite() {
        return Err(ResectionError::Ambiguous);
    }
    Ok(Matrix3x4::from_row_iterator(vectors.column(0).iter().copied()))
}

/// `left = s K R` and `last = s K t`, with `s` of either sign.
fn taken_apart(left: &Matrix3<f64>, last: &Vector3<f64>) -> Option<(Matrix3<f64>, Rigid3)> {
    let sign = if left.determinant() < 0.0 { -1.0 } else { 1.0 };
    let m = left * sign;
    // Gram–Schmidt from the last row up.
    let row = |i: usize| m.row(i).transpose();
    let r3 = row(2).try_normalize(0.0)?;
    let k33 = row(2).norm();
    let (k23, rest) = (row(1).dot(&r3), row(1) - r3 * row(1).dot(&r3));
    let (r2, k22) = (rest.try_normalize(0.0)?, rest.norm());
    let r1 = r2.cross(&r3);
    let (k11, k12, k13) = (row(0).dot(&r1), row(0).dot(&r2), row(0).dot(&r3));
    let k = Matrix3::new(k11, k12, k13, 0.0, k22, k23, 0.0, 0.0, k33) / k33;
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_rows(&[
        r1.transpose(),
        r2.transpose(),
        r3.transpose(),
    ]));
    let translation = k.try_inverse()? * last * (sign / k33);
    let finite = k.iter().chain(translation.iter()).all(|value| value.is_finite());
    (finite && k.m11 > 0.0 && k.m22 > 0.0)
        .then(|| (k, Rigid3::new(UnitQuaternion::from_rotation_matrix(&rotation), translation)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::{Random, Resection, resection};
    use crate::{Camera, CameraModel};

    fn camera() -> Camera {
        Camera::new(CameraModel::Pinhole, 1600, 1200, &[1300.0, 1250.0, 805.0, 590.0]).unwrap()
    }

    /// Relative error of the focal lengths plus the difference of the poses.
    fn error(found: &Resected, scene: &Resection) -> f64 {
        let k = found.px_from_normalized;
        let focal = (k.m11 / 1300.0 - 1.0).abs() + (k.m22 / 1250.0 - 1.0).abs();
        focal + found.cam_from_world.local_left(&scene.cam_from_world).norm()
    }

    #[test]
    fn six_points_and_more_give_the_truth() {
        let mut random = Random::new("resection");
        let mut good = 0;
        for case in 0..2000 {
            let scene = resection(&mut random, &camera(), 6 + case % 20, 0.0);
            let found = resect(&scene.x_in_world, &scene.xy_px);
            good += usize::from(found.is_ok_and(|found| error(&found, &scene) < 1e-4));
        }
        assert!(good >= 1980, "{good}");
    }

    #[test]
    fn the_error_grows_with_the_noise() {
        let mut random = Random::new("resection noise");
        let mut median = |noise_px: f64| {
            let mut errors: Vec<f64> = (0..301)
                .map(|_| {
                    let scene = resection(&mut random, &camera(), 40, noise_px);
                    resect(&scene.x_in_world, &scene.xy_px)
                        .map_or(f64::INFINITY, |found| error(&found, &scene))
                })
                .collect();
            errors.sort_by(f64::total_cmp);
            errors[150]
        };
        let (small, large) = (median(0.05), median(0.5));
        assert!(small > 1e-5 && small < 1e-2, "{small}");
        assert!(large > 5.0 * small && large < 20.0 * small, "{small} {large}");
    }

    #[test]
    fn what_is_wrong_is_named() {
        let mut random = Random::new("resection degenerate");
        let scene = resection(&mut random, &camera(), 12, 0.0);
        let (x, px) = (&scene.x_in_world, &scene.xy_px);
        assert!(resect(x, px).is_ok());
        assert_eq!(resect(&x[..5], &px[..5]), Err(ResectionError::TooFew));
        assert_eq!(resect(x, &px[..11]), Err(ResectionError::LengthsDiffer));
        let on_plane: Vec<_> = x.iter().map(|x| Vector3::new(x.x, x.y, 0.5 * x.x - x.y + 3.0)).collect();
        assert_eq!(resect(&on_plane, px), Err(ResectionError::Planar));
        assert_eq!(resect(&[x[0]; 12], px), Err(ResectionError::Planar));
        assert_eq!(resect(x, &[px[0]; 12]), Err(ResectionError::Ambiguous));
        let mut bad = px.clone();
        bad[3].y = f64::NAN;
        assert_eq!(resect(x, &bad), Err(ResectionError::NotFinite));
        // Half of the points moved to behind the camera keep their pixels.
        let center = scene.cam_from_world.center();
        let behind: Vec<_> =
            x.iter().enumerate().map(|(i, x)| if i % 2 == 0 { *x } else { center * 2.0 - x }).collect();
        assert_eq!(resect(&behind, px), Err(ResectionError::NoCamera));
        let four = [0, 1, 2, 3, 0, 1].map(|i| x[i]);
        let four_px = [0, 1, 2, 3, 0, 1].map(|i| px[i]);
        assert_eq!(resect(&four, &four_px), Err(ResectionError::Ambiguous));
    }
}
