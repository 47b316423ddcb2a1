//! Projection of points on either side of a camera.

use nalgebra::{Vector2, Vector3};
use terrane_geometry::Camera;
use terrane_geometry::camera::Projection;

use super::BehindCamera;

/// Where a point is seen, or `None` where that has no meaning.
#[inline(always)]
pub(super) fn project(
    camera: &Camera,
    x_in_cam: &Vector3<f64>,
    behind: BehindCamera,
) -> Option<Vector2<f64>> {
    if behind.mirrors(camera, x_in_cam) { camera.project(&-x_in_cam) } else { camera.project(x_in_cam) }
}

/// The same, with derivatives.
#[inline(always)]
pub(super) fn project_with_jacobian(
    camera: &Camera,
    x_in_cam: &Vector3<f64>,
    behind: BehindCamera,
) -> Option<Projection> {
    if !behind.mirrors(camera, x_in_cam) {
        return camera.project_with_jacobian(x_in_cam);
    }
    let mut projection = camera.project_with_jacobian(&-x_in_cam)?;
    projection.d_point = -projection.d_point;
    Some(projection)
}

/// What a projection differs from an observation by, in pixels; across the seam of a panorama the short way round.
#[inline(always)]
pub(super) fn residual_px(camera: &Camera, xy_px: &Vector2<f64>, observed_px: [f32; 2]) -> [f64; 2] {
    camera.residual_px(xy_px, &Vector2::new(f64::from(observed_px[0]), f64::from(observed_px[1]))).into()
}
