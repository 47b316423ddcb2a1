//! Rigid transforms of space.

use std::ops::Mul;

use nalgebra::{Matrix3, Matrix3x4, UnitQuaternion, Vector3, Vector6};
use serde::{Deserialize, Serialize};

use crate::so3;

/// A rigid transform `b_from_a`: `x_in_b = rotation * x_in_a + translation`.
///
/// Used as `cam_from_world` for camera poses. Transforms chain visibly: `c_from_a = c_from_b * b_from_a`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Rigid3 {
    /// Rotation of frame a into frame b.
    pub rotation: UnitQuaternion<f64>,
    /// Origin of frame a, in frame b.
    pub translation: Vector3<f64>,
}

impl Default for Rigid3 {
    fn default() -> Self {
        Self::identity()
    }
}

impl Rigid3 {
    /// A transform from its parts.
    pub fn new(rotation: UnitQuaternion<f64>, translation: Vector3<f64>) -> Self {
        Self { rotation, translation }
    }

    /// The transform that moves nothing.
    pub fn identity() -> Self {
        Self::new(UnitQuaternion::identity(), Vector3::zeros())
    }

    /// `cam_from_world` of a camera at `center_in_world` with the given rotation.
    pub fn from_rotation_and_center(rotation: UnitQuaternion<f64>, center_in_world: &Vector3<f64>) -> Self {
        Self::new(rotation, -(rotation * center_in_world))
    }

    /// `a_from_b` of a `b_from_a`.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.inverse();
        Self::new(rotation, -(rotation * self.translation))
    }

    /// `x_in_b` of `x_in_a`.
    pub fn transform_point(&self, x_in_a: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * x_in_a + self.translation
    }

    /// The origin of frame b in frame a: the camera centre in the world when this is a `cam_from_world`.
    pub fn center(&self) -> Vector3<f64> {
        -(self.rotation.inverse() * self.translation)
    }

    /// The rotation as a matrix.
    pub fn rotation_matrix(&self) -> Matrix3<f64> {
        self.rotation.to_rotation_matrix().into_inner()
    }

    /// The 3×4 matrix `[R | t]`.
    pub fn matrix3x4(&self) -> Matrix3x4<f64> {
        let mut matrix = Matrix3x4::zeros();
        matrix.fixed_view_mut::<3, 3>(0, 0).copy_from(&self.rotation_matrix());
        matrix.set_column(3, &self.translation);
        matrix
    }

    /// The perturbation on the left, `(ω, v)` in frame b: `x_in_b` becomes `exp(ω) x_in_b + v`.
    ///
    /// Its derivative at zero is `[-[x_in_b]ₓ | I]`.
    pub fn retract_left(&self, delta: &Vector6<f64>) -> Self {
        let turn = so3::exp(&delta.fixed_rows::<3>(0).into_owned());
        let mut rotation = turn * self.rotation;
        rotation.renormalize();
        Self::new(rotation, turn * self.translation + delta.fixed_rows::<3>(3))
    }

    /// The `(ω, v)` with `from.retract_left(..) == self`.
    pub fn local_left(&self, from: &Self) -> Vector6<f64> {
        let turn = self.rotation * from.rotation.inverse();
        let shift = self.translation - turn * from.translation;
        let omega = so3::log(&turn);
        Vector6::new(omega.x, omega.y, omega.z, shift.x, shift.y, shift.z)
    }
}

impl Mul for Rigid3 {
    type Output = Rigid3;

    /// `c_from_b * b_from_a = c_from_a`.
    fn mul(self, b_from_a: Rigid3) -> Rigid3 {
        Rigid3::new(self.rotation * b_from_a.rotation, self.transform_point(&b_from_a.translation))
    }
}
