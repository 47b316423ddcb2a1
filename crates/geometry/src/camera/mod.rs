//! Camera models: pixels from rays and back, with analytic Jacobians.
//!
//! Names, order of parameters and pixel convention are COLMAP's: the centre of the top left pixel is (0.5, 0.5).

mod distortion;
#[cfg(test)]
mod tests;

use nalgebra::{Matrix2, SMatrix, Vector2, Vector3};
use serde::{Deserialize, Serialize};

/// The most parameters that a model has; Jacobians in parameters have as many columns.
pub const MAX_PARAMS: usize = 16;

/// How a ray becomes a pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
pub enum CameraModel {
    /// f, cx, cy.
    SimplePinhole,
    /// fx, fy, cx, cy.
    Pinhole,
    /// f, cx, cy, k.
    SimpleRadial,
    /// f, cx, cy, k1, k2.
    Radial,
    /// fx, fy, cx, cy, k1, k2, p1, p2.
    #[serde(rename = "OPENCV")]
    OpenCv,
    /// fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6.
    #[serde(rename = "FULL_OPENCV")]
    FullOpenCv,
}

impl CameraModel {
    /// Every model, in the order of their COLMAP ids.
    pub const ALL: [CameraModel; 6] = [
        CameraModel::SimplePinhole,
        CameraModel::Pinhole,
        CameraModel::SimpleRadial,
        CameraModel::Radial,
        CameraModel::OpenCv,
        CameraModel::FullOpenCv,
    ];

    /// COLMAP's number of this model.
    pub fn colmap_id(self) -> i32 {
        match self {
            Self::SimplePinhole => 0,
            Self::Pinhole => 1,
            Self::SimpleRadial => 2,
            Self::Radial => 3,
            Self::OpenCv => 4,
            Self::FullOpenCv => 6,
        }
    }

    /// The model of a COLMAP number, or `None` when terrane does not have it.
    pub fn from_colmap_id(id: i32) -> Option<Self> {
        Self::ALL.into_iter().find(|model| model.colmap_id() == id)
    }

    /// COLMAP's name of this model.
    pub fn name(self) -> &'static str {
        match self {
            Self::SimplePinhole => "SIMPLE_PINHOLE",
            Self::Pinhole => "PINHOLE",
            Self::SimpleRadial => "SIMPLE_RADIAL",
            Self::Radial => "RADIAL",
            Self::OpenCv => "OPENCV",
            Self::FullOpenCv => "FULL_OPENCV",
        }
    }

    /// The model of a name in COLMAP's spelling.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|model| model.name() == name)
    }

    /// How many parameters the model has.
    pub fn num_params(self) -> usize {
        self.num_focal() + 2 + self.num_distortion()
    }

    /// One focal length for both axes, or two.
    pub fn num_focal(self) -> usize {
        match self {
            Self::SimplePinhole | Self::SimpleRadial | Self::Radial => 1,
            Self::Pinhole | Self::OpenCv | Self::FullOpenCv => 2,
        }
    }

    /// How many distortion coefficients follow the principal point.
    pub fn num_distortion(self) -> usize {
        match self {
            Self::SimplePinhole | Self::Pinhole => 0,
            Self::SimpleRadial => 1,
            Self::Radial => 2,
            Self::OpenCv => 4,
            Self::FullOpenCv => 8,
        }
    }
}

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

    /// A camera without distortion whose principal point is the image's centre.
    pub fn centered(model: CameraModel, width_px: u32, height_px: u32, focal_px: f64) -> Self {
        let mut values = [0.0; MAX_PARAMS];
        let num_focal = model.num_focal();
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

    /// Focal lengths in x and y, in pixels.
    pub fn focal_px(&self) -> Vector2<f64> {
        Vector2::new(self.values[0], self.values[self.model.num_focal() - 1])
    }

    /// The mean of the two focal lengths, in pixels.
    pub fn mean_focal_px(&self) -> f64 {
        self.focal_px().mean()
    }

    /// The principal point in pixels.
    pub fn principal_point_px(&self) -> Vector2<f64> {
        let first = self.model.num_focal();
        Vector2::new(self.values[first], self.values[first + 1])
    }

    /// The distortion coefficients in the model's order.
    pub fn distortion(&self) -> &[f64] {
        &self.params()[self.model.num_focal() + 2..]
    }

    /// The image of a point in the camera's frame, or `None` behind the camera or beyond the model's domain.
    #[inline]
    pub fn project(&self, x_in_cam: &Vector3<f64>) -> Option<Vector2<f64>> {
        if !(x_in_cam.z > f64::EPSILON) {
            return None;
        }
        let inverse_z = 1.0 / x_in_cam.z;
        let normalized = Vector2::new(x_in_cam.x * inverse_z, x_in_cam.y * inverse_z);
        let distorted = distortion::distort_in_domain(self.model, self.distortion(), &normalized)?;
        Some(self.principal_point_px() + self.focal_px().component_mul(&distorted))
    }

    /// The pixel of a point on the plane z = 1 of the camera's frame, by the model's formula even beyond its domain.
    pub fn pixel_from_normalized(&self, normalized: &Vector2<f64>) -> Vector2<f64> {
        let distorted = distortion::distort(self.model, self.distortion(), normalized);
        self.principal_point_px() + self.focal_px().component_mul(&distorted)
    }

    /// [`Camera::project`] with derivatives.
    pub fn project_with_jacobian(&self, x_in_cam: &Vector3<f64>) -> Option<Projection> {
        if !(x_in_cam.z > f64::EPSILON) {
            return None;
        }
        let inverse_z = 1.0 / x_in_cam.z;
        let normalized = Vector2::new(x_in_cam.x * inverse_z, x_in_cam.y * inverse_z);
        let distorted = distortion::distort_with_jacobian(self.model, self.distortion(), &normalized)?;
        let focal = self.focal_px();
        let d_point = point_jacobian(&focal, &distorted.d_xy, &normalized, inverse_z);
        let num_focal = self.model.num_focal();
        let mut d_params = SMatrix::<f64, 2, MAX_PARAMS>::zeros();
        d_params[(0, 0)] = distorted.xy.x;
        d_params[(1, num_focal - 1)] = distorted.xy.y;
        d_params[(0, num_focal)] = 1.0;
        d_params[(1, num_focal + 1)] = 1.0;
        for k in 0..self.model.num_distortion() {
            d_params[(0, num_focal + 2 + k)] = focal.x * distorted.d_coefficients[(0, k)];
            d_params[(1, num_focal + 2 + k)] = focal.y * distorted.d_coefficients[(1, k)];
        }
        let xy_px = self.principal_point_px() + focal.component_mul(&distorted.xy);
        Some(Projection { xy_px, d_point, d_params })
    }

    /// [`Camera::project`] with the derivative in the point alone, for hot loops with fixed intrinsics.
    #[inline]
    pub fn project_with_point_jacobian(
        &self,
        x_in_cam: &Vector3<f64>,
    ) -> Option<(Vector2<f64>, SMatrix<f64, 2, 3>)> {
        if !(x_in_cam.z > f64::EPSILON) {
            return None;
        }
        let inverse_z = 1.0 / x_in_cam.z;
        let normalized = Vector2::new(x_in_cam.x * inverse_z, x_in_cam.y * inverse_z);
        let (distorted, d_xy) =
            distortion::distort_with_point_jacobian(self.model, self.distortion(), &normalized)?;
        let focal = self.focal_px();
        let xy_px = self.principal_point_px() + focal.component_mul(&distorted);
        Some((xy_px, point_jacobian(&focal, &d_xy, &normalized, inverse_z)))
    }

    /// The point on the plane z = 1 that a pixel sees, or `None` when the distortion can't be inverted there.
    pub fn unproject(&self, xy_px: &Vector2<f64>) -> Option<Vector2<f64>> {
        let distorted = (xy_px - self.principal_point_px()).component_div(&self.focal_px());
        distortion::undistort(self.model, self.distortion(), &distorted)
    }

    /// The unit ray that a pixel sees, in the camera's frame.
    pub fn ray(&self, xy_px: &Vector2<f64>) -> Option<Vector3<f64>> {
        self.unproject(xy_px).map(|normalized| normalized.push(1.0).normalize())
    }

    /// A length in pixels as a length on the plane z = 1, for thresholds.
    pub fn normalized_from_px(&self, length_px: f64) -> f64 {
        length_px / self.mean_focal_px()
    }
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
