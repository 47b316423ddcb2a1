//! Camera models: pixels from rays and back, with analytic Jacobians.
//!
//! Names, order of parameters and pixel convention are COLMAP's: the centre of the top left pixel is (0.5, 0.5).

mod closed_radial;
mod distortion;
mod fisheye;
mod model;
mod spherical;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod wide_tests;

use nalgebra::{Matrix2, SMatrix, Vector2, Vector3};
use serde::{Deserialize, Serialize};

pub use model::CameraModel;
use model::Family;

/// The most parameters that a model has; Jacobians in parameters have as many columns.
pub const MAX_PARAMS: usize = 16;

/// The intrinsics of a camera: model, image size in pixels, parameters.
///
/// Parameters are (focal lengths, principal point, distortion), as documented on each [`CameraModel`]; those beyond
/// `model.num_params()` are zero.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// How a ray becomes a pixel.
    pub model: CameraModel,
    /// Width of the image in pixels.
    pub width_px: u32,
    /// Height of the image in pixels.
    pub height_px: u32,
    values: [f64; MAX_PARAMS],
}

/// A projection with its derivatives.
#[derive(Clone, Copy, Debug)]
pub struct Projection {
    /// The image point in pixels.
    pub xy_px: Vector2<f64>,
    /// Derivative in the point in the camera's frame.
    pub d_point: SMatrix<f64, 2, 3>,
    /// Derivative in the parameters; columns from `num_params()` on are zero.
    pub d_params: SMatrix<f64, 2, MAX_PARAMS>,
}

/// A projection for a focal length of one about the principal point, with derivatives.
struct Image {
    xy: Vector2<f64>,
    d_point: SMatrix<f64, 2, 3>,
    d_coefficients: SMatrix<f64, 2, 12>,
}

impl Camera {
    /// A camera from its parameters, or `None` when their number does not fit the model.
    pub fn new(model: CameraModel, width_px: u32, height_px: u32, params: &[f64]) -> Option<Self> {
        if params.len() != model.num_params() {
            return None;
        }
        let mut values = [0.0; MAX_PARAMS];
        values[..params.len()].copy_from_slice(params);
        Some(Self { model, width_px, height_px, values })
    }

    /// A camera without distortion whose principal point is the image's centre; a panorama of this size, whatever the focal
    /// length.
    ///
    /// FOV's ω and EUCM's α are 0.01 and its β is 1: at zero their effects vanish to first order, and nothing could refine them.
    pub fn centered(model: CameraModel, width_px: u32, height_px: u32, focal_px: f64) -> Self {
        let mut values = [0.0; MAX_PARAMS];
        if model.family() == Family::Spherical {
            (values[0], values[1]) = (f64::from(width_px), f64::from(height_px));
            return Self { model, width_px, height_px, values };
        }
        let num_focal = model.num_focal();
        match model {
            CameraModel::Fov => values[num_focal + 2] = 0.01,
            CameraModel::Eucm => (values[num_focal + 2], values[num_focal + 3]) = (0.01, 1.0),
            _ => {}
        }
        values[..num_focal].fill(focal_px);
        values[num_focal] = f64::from(width_px) / 2.0;
        values[num_focal + 1] = f64::from(height_px) / 2.0;
        Self { model, width_px, height_px, values }
    }

    /// The parameters in the model's order.
    pub fn params(&self) -> &[f64] {
        &self.values[..self.model.num_params()]
    }

    /// The parameters in the model's order, to change.
    pub fn params_mut(&mut self) -> &mut [f64] {
        &mut self.values[..self.model.num_params()]
    }

    /// Focal lengths in x and y, in pixels; for a panorama the pixels of a radian, `(w / 2π, h / π)`.
    pub fn focal_px(&self) -> Vector2<f64> {
        match self.model.family() {
            Family::Spherical => {
                Vector2::new(self.values[0] / std::f64::consts::TAU, self.values[1] / std::f64::consts::PI)
            }
            _ => self.scale_px(),
        }
    }

    /// [`Self::focal_px`] of models that have one.
    #[inline]
    fn scale_px(&self) -> Vector2<f64> {
        Vector2::new(self.values[0], self.values[self.model.num_focal().max(1) - 1])
    }

    /// [`Self::principal_point_px`] of models that have one.
    #[inline]
    fn offset_px(&self) -> Vector2<f64> {
        let first = self.model.num_focal();
        Vector2::new(self.values[first], self.values[first + 1])
    }

    /// The mean of the two focal lengths, in pixels.
    pub fn mean_focal_px(&self) -> f64 {
        self.focal_px().mean()
    }

    /// The principal point in pixels; a panorama's middle.
    pub fn principal_point_px(&self) -> Vector2<f64> {
        match self.model.family() {
            Family::Spherical => Vector2::new(0.5 * self.values[0], 0.5 * self.values[1]),
            _ => self.offset_px(),
        }
    }

    /// The distortion coefficients in the model's order.
    pub fn distortion(&self) -> &[f64] {
        &self.params()[(self.model.num_focal() + 2).min(self.model.num_params())..]
    }

    /// The image of a point in the camera's frame, or `None` beyond the model's domain: for all but panoramas that is behind
    /// the camera, and beyond the fold where the distorted radius stops growing.
    #[inline]
    pub fn project(&self, x_in_cam: &Vector3<f64>) -> Option<Vector2<f64>> {
        if !self.model.is_perspective() {
            return self.project_wide(x_in_cam);
        }
        if !(x_in_cam.z > f64::EPSILON) {
            return None;
        }
        let inverse_z = 1.0 / x_in_cam.z;
        let normalized = Vector2::new(x_in_cam.x * inverse_z, x_in_cam.y * inverse_z);
        let distorted = distortion::distort_in_domain(self.model, self.distortion(), &normalized)?;
        Some(self.offset_px() + self.scale_px().component_mul(&distorted))
    }

    /// The pixel of a point on the plane z = 1 of the camera's frame, by the model's formula even beyond
    /// its domain where the model is perspective; NaN beyond that of others.
    pub fn pixel_from_normalized(&self, normalized: &Vector2<f64>) -> Vector2<f64> {
        if !self.model.is_perspective() {
            let nowhere = Vector2::repeat(f64::NAN);
            return self.project_wide(&normalized.push(1.0)).unwrap_or(nowhere);
        }
        let distorted = distortion::distort(self.model, self.distortion(), normalized);
        self.offset_px() + self.scale_px().component_mul(&distorted)
    }

    /// [`Camera::project`] with derivatives.
    pub fn project_with_jacobian(&self, x_in_cam: &Vector3<f64>) -> Option<Projection> {
        if !self.model.is_perspective() {
            return self.project_wide_with_jacobian(x_in_cam);
        }
        if !(x_in_cam.z > f64::EPSILON) {
            return None;
        }
        let inverse_z = 1.0 / x_in_cam.z;
        let normalized = Vector2::new(x_in_cam.x * inverse_z, x_in_cam.y * inverse_z);
        let distorted = distortion::distort_with_jacobian(self.model, self.distortion(), &normalized)?;
        let focal = self.scale_px();
        let d_point = point_jacobian(&focal, &distorted.d_xy, &normalized, inverse_z);
        let d_params = self.d_params(&focal, &distorted.xy, &distorted.d_coefficients);
        let xy_px = self.offset_px() + focal.component_mul(&distorted.xy);
        Some(Projection { xy_px, d_point, d_params })
    }

    /// [`Camera::project`] with the derivative in the point alone, for hot loops with fixed intrinsics.
    #[inline]
    pub fn project_with_point_jacobian(
        &self,
        x_in_cam: &Vector3<f64>,
    ) -> Option<(Vector2<f64>, SMatrix<f64, 2, 3>)> {
        if !self.model.is_perspective() {
            return self.project_wide_with_jacobian(x_in_cam).map(|seen| (seen.xy_px, seen.d_point));
        }
        if !(x_in_cam.z > f64::EPSILON) {
            return None;
        }
        let inverse_z = 1.0 / x_in_cam.z;
        let normalized = Vector2::new(x_in_cam.x * inverse_z, x_in_cam.y * inverse_z);
        let (distorted, d_xy) =
            distortion::distort_with_point_jacobian(self.model, self.distortion(), &normalized)?;
        let focal = self.scale_px();
        let xy_px = self.offset_px() + focal.component_mul(&distorted);
        Some((xy_px, point_jacobian(&focal, &d_xy, &normalized, inverse_z)))
    }

    /// The point on the plane z = 1 that a pixel sees, or `None` when the distortion can't be inverted there or the ray does
    /// not go ahead.
    pub fn unproject(&self, xy_px: &Vector2<f64>) -> Option<Vector2<f64>> {
        if !self.model.is_perspective() {
            let ray = self.ray(xy_px)?;
            return (ray.z > f64::EPSILON).then(|| ray.xy() / ray.z);
        }
        let distorted = (xy_px - self.offset_px()).component_div(&self.scale_px());
        distortion::undistort(self.model, self.distortion(), &distorted)
    }

    /// The unit ray that a pixel sees, in the camera's frame. Those of wide models may have no z above zero: all around for
    /// panoramas, and beyond the domain of [`Self::project`] for fisheyes, division and EUCM.
    pub fn ray(&self, xy_px: &Vector2<f64>) -> Option<Vector3<f64>> {
        let distorted = || (xy_px - self.principal_point_px()).component_div(&self.focal_px());
        match self.model.family() {
            Family::Perspective => self.unproject(xy_px).map(|normalized| normalized.push(1.0).normalize()),
            Family::Fisheye => fisheye::ray(self.model, self.distortion(), &distorted()),
            Family::ClosedRadial => closed_radial::ray(self.model, self.distortion(), &distorted()),
            Family::Spherical => spherical::ray(&distorted()),
        }
    }

    /// `projected - observed`, the short way round a panorama.
    #[inline]
    pub fn residual_px(&self, projected_px: &Vector2<f64>, observed_px: &Vector2<f64>) -> Vector2<f64> {
        let mut residual = projected_px - observed_px;
        if self.model.family() == Family::Spherical {
            residual.x -= self.values[0] * (residual.x / self.values[0]).round();
        }
        residual
    }

    /// A length in pixels as a length on the plane z = 1, for thresholds.
    pub fn normalized_from_px(&self, length_px: f64) -> f64 {
        length_px / self.mean_focal_px()
    }

    #[inline(never)]
    fn project_wide(&self, x_in_cam: &Vector3<f64>) -> Option<Vector2<f64>> {
        let xy = match self.model.family() {
            Family::Fisheye => fisheye::project(self.model, self.distortion(), x_in_cam),
            Family::ClosedRadial => closed_radial::project(self.model, self.distortion(), x_in_cam),
            Family::Perspective | Family::Spherical => spherical::project(x_in_cam),
        }?;
        Some(self.principal_point_px() + self.focal_px().component_mul(&xy))
    }

    #[inline(never)]
    fn project_wide_with_jacobian(&self, x_in_cam: &Vector3<f64>) -> Option<Projection> {
        let focal = self.focal_px();
        let image = match self.model.family() {
            Family::Fisheye => fisheye::project_with_jacobian(self.model, self.distortion(), x_in_cam),
            Family::ClosedRadial => {
                closed_radial::project_with_jacobian(self.model, self.distortion(), x_in_cam)
            }
            Family::Perspective | Family::Spherical => {
                let (xy, d_point) = spherical::project_with_jacobian(x_in_cam)?;
                let mut d_params = SMatrix::<f64, 2, MAX_PARAMS>::zeros();
                d_params[(0, 0)] = 0.5 + xy.x / std::f64::consts::TAU;
                d_params[(1, 1)] = 0.5 + xy.y / std::f64::consts::PI;
                let xy_px = self.principal_point_px() + focal.component_mul(&xy);
                return Some(Projection { xy_px, d_point: scaled_rows(&focal, &d_point), d_params });
            }
        }?;
        let d_params = self.d_params(&focal, &image.xy, &image.d_coefficients);
        let xy_px = self.principal_point_px() + focal.component_mul(&image.xy);
        Some(Projection { xy_px, d_point: scaled_rows(&focal, &image.d_point), d_params })
    }

    /// The derivative in the parameters from the image for a focal length of one and its derivative in the distortion.
    #[inline(always)]
    fn d_params<const N: usize>(
        &self,
        focal_px: &Vector2<f64>,
        xy: &Vector2<f64>,
        d_coefficients: &SMatrix<f64, 2, N>,
    ) -> SMatrix<f64, 2, MAX_PARAMS> {
        let num_focal = self.model.num_focal();
        let mut d_params = SMatrix::<f64, 2, MAX_PARAMS>::zeros();
        d_params[(0, 0)] = xy.x;
        d_params[(1, num_focal - 1)] = xy.y;
        d_params[(0, num_focal)] = 1.0;
        d_params[(1, num_focal + 1)] = 1.0;
        for k in 0..self.model.num_distortion() {
            d_params[(0, num_focal + 2 + k)] = focal_px.x * d_coefficients[(0, k)];
            d_params[(1, num_focal + 2 + k)] = focal_px.y * d_coefficients[(1, k)];
        }
        d_params
    }
}

fn scaled_rows(focal_px: &Vector2<f64>, d: &SMatrix<f64, 2, 3>) -> SMatrix<f64, 2, 3> {
    SMatrix::from_diagonal(focal_px) * d
}

/// The derivative of a pixel in the point in the camera's frame, by the chain rule through z = 1 and the distortion.
#[inline]
fn point_jacobian(
    focal_px: &Vector2<f64>,
    d_xy: &Matrix2<f64>,
    normalized: &Vector2<f64>,
    inverse_z: f64,
) -> SMatrix<f64, 2, 3> {
    let (row_x, row_y) = (focal_px.x * inverse_z, focal_px.y * inverse_z);
    let along = d_xy * normalized;
    SMatrix::<f64, 2, 3>::new(
        row_x * d_xy.m11,
        row_x * d_xy.m12,
        -row_x * along.x,
        row_y * d_xy.m21,
        row_y * d_xy.m22,
        -row_y * along.y,
    )
}
