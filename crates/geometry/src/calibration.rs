//! The intrinsics of a camera from several views of a planar target.
//!
//! As Zhang (2000): each view's homography gives two linear constraints on the image of the absolute conic; focal lengths and
//! principal point follow from it, poses from those. Then all of it, with distortion, is refined to the least squared
//! reprojection error, each pose eliminated from the normal equations of the intrinsics.

use nalgebra::{Matrix6, SMatrix, Vector2, Vector3};
use thiserror::Error;

use crate::camera::MAX_PARAMS;
use crate::homography::homography_from_points;
use crate::{Camera, CameraModel, Rigid3};

mod refine;
mod start;
#[cfg(test)]
mod tests;

/// Target planes closer to parallel than this (sine of the angle) in all views leave the intrinsics open. Tilts of use are
/// tens of degrees.
const MIN_TILT: f64 = 0.02;

/// Points of one planar target, and where one photograph shows them.
#[derive(Clone, Copy, Debug)]
pub struct PlanarView<'a> {
    /// Points on the target's plane z = 0, in its unit.
    pub xy_on_target: &'a [Vector2<f64>],
    /// Their pixels, in the same order.
    pub xy_px: &'a [Vector2<f64>],
}

/// A calibrated camera.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibration {
    /// The intrinsics.
    pub camera: Camera,
    /// Pose of each view; translations in the target's unit.
    pub cam_from_target: Vec<Rigid3>,
    /// Root mean square of the reprojection error, over points.
    pub rms_px: f64,
    /// Covariance of the parameters in their order; rows and columns from `num_params()` on are zero. Scaled by the residuals'
    /// variance.
    pub params_covariance: SMatrix<f64, MAX_PARAMS, MAX_PARAMS>,
    /// Covariance of each pose in `(ω, v)` on the left, that of the intrinsics included.
    pub pose_covariances: Vec<Matrix6<f64>>,
}

impl Calibration {
    /// The largest sine of an angle between the target's planes in two views.
    pub fn largest_tilt_sine(&self) -> f64 {
        let normals: Vec<_> = self.cam_from_target.iter().map(|pose| pose.rotation * Vector3::z()).collect();
        largest_sine(&normals)
    }
}

/// Why views give no intrinsics.
#[derive(Clone, Copy, Debug, PartialEq, Error)]
pub enum CalibrationError {
    /// One view leaves the principal point open.
    #[error("two views or more are needed, three or more are better")]
    TooFewViews,
    /// A view's points and pixels differ in number.
    #[error("view {view} has not as many pixels as points")]
    LengthsDiffer {
        /// Index of the view.
        view: usize,
    },
    /// A view's points give no homography: fewer than four, on one line, or not finite.
    #[error("view {view} needs four or more finite points, not on one line")]
    NoHomography {
        /// Index of the view.
        view: usize,
    },
    /// The target's plane kept its direction.
    #[error("the target is parallel to itself in all views; tilt it differently from view to view")]
    ParallelViews,
    /// No positive focal length fits.
    #[error("no camera fits the views; look for wrong correspondences")]
    NoCamera,
    /// Only perspective models have a linear start.
    #[error(
        "{name} can't be calibrated from planar targets yet: choose a model from SIMPLE_PINHOLE to FULL_OPENCV"
    )]
    NotPerspective {
        /// The model's name.
        name: &'static str,
    },
    /// The parameters of the model can't be told apart.
    #[error("the views don't determine all parameters; take more views or a model with fewer")]
    Undetermined,
}

/// The camera of this model and image size that fits all views with the least squared reprojection error; all
/// correspondences must be right.
pub fn calibrate(
    views: &[PlanarView<'_>],
    model: CameraModel,
    (width_px, height_px): (u32, u32),
) -> Result<Calibration, CalibrationError> {
    if !model.is_perspective() {
        return Err(CalibrationError::NotPerspective { name: model.name() });
    }
    let mut homographies = Vec::with_capacity(views.len());
    for (view, points) in views.iter().enumerate() {
        if points.xy_on_target.len() != points.xy_px.len() {
            return Err(CalibrationError::LengthsDiffer { view });
        }
        let h = homography_from_points(points.xy_on_target, points.xy_px);
        homographies.push(h.ok_or(CalibrationError::NoHomography { view })?);
    }
    if views.len() < 2 {
        return Err(CalibrationError::TooFewViews);
    }
    let blank = Camera::centered(model, width_px, height_px, 1.0);
    let start = start::best(views, &homographies, &blank)?;
    let found = refine::refined(views, start)?;
    // Distortion can feign tilts, which refinement takes back.
    if !(found.largest_tilt_sine() > MIN_TILT) {
        return Err(CalibrationError::ParallelViews);
    }
    Ok(found)
}

/// The largest sine of an angle between two lines of these unit directions.
fn largest_sine(directions: &[Vector3<f64>]) -> f64 {
    let mut largest: f64 = 0.0;
    for (i, a) in directions.iter().enumerate() {
        for b in &directions[..i] {
            largest = largest.max(a.cross(b).norm());
        }
    }
    largest
}
