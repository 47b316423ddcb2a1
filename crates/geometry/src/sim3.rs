//! Similarity transforms of space.

use std::ops::Mul;

use nalgebra::{SVector, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::{Rigid3, so3};

/// A similarity `b_from_a`: `x_in_b = scale * rotation * x_in_a + translation`, with a positive scale.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sim3 {
    /// Length in b of a unit length in a.
    pub scale: f64,
    /// Rotation of frame a into frame b.
    pub rotation: UnitQuaternion<f64>,
    /// Origin of frame a, in frame b.
    pub translation: Vector3<f64>,
}

impl Default for Sim3 {
    fn default() -> Self {
        Self::identity()
    }
}

impl Sim3 {
    /// A similarity from its parts.
    pub fn new(scale: f64, rotation: UnitQuaternion<f64>, translation: Vector3<f64>) -> Self {
        Self { scale, rotation, translation }
    }

    /// The similarity that moves nothing.
    pub fn identity() -> Self {
        Self::new(1.0, UnitQuaternion::identity(), Vector3::zeros())
    }

    /// The similarity of scale one with this rigid part.
    pub fn from_rigid(rigid: &Rigid3) -> Self {
        Self::new(1.0, rigid.rotation, rigid.translation)
    }

    /// `a_from_b` of a `b_from_a`.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.inverse();
        Self::new(1.0 / self.scale, rotation, -(rotation * self.translation) / self.scale)
    }

    /// `x_in_b` of `x_in_a`.
    pub fn transform_point(&self, x_in_a: &Vector3<f64>) -> Vector3<f64> {
        self.scale * (self.rotation * x_in_a) + self.translation
    }

    /// `cam_from_b` of a `cam_from_a`, where `self` is `b_from_a`.
    ///
    /// The camera's own frame takes on b's unit of length, so the result is rigid and images stay the same.
    pub fn transform_camera(&self, cam_from_a: &Rigid3) -> Rigid3 {
        let rotation = cam_from_a.rotation * self.rotation.inverse();
        Rigid3::from_rotation_and_center(rotation, &self.transform_point(&cam_from_a.center()))
    }

    /// The perturbation on the left, `(ω, v, λ)` in frame b: `x_in_b` becomes `exp(λ) exp(ω) x_in_b + v`.
    pub fn retract_left(&self, delta: &SVector<f64, 7>) -> Self {
        let turn = so3::exp(&delta.fixed_rows::<3>(0).into_owned());
        let stretch = delta[6].exp();
        let mut rotation = turn * self.rotation;
        rotation.renormalize();
        let translation = stretch * (turn * self.translation) + delta.fixed_rows::<3>(3);
        Self::new(stretch * self.scale, rotation, translation)
    }

    /// The `(ω, v, λ)` with `from.retract_left(..) == self`.
    pub fn local_left(&self, from: &Self) -> SVector<f64, 7> {
        let step = *self * from.inverse();
        let omega = so3::log(&step.rotation);
        let t = step.translation;
        SVector::from([omega.x, omega.y, omega.z, t.x, t.y, t.z, step.scale.ln()])
    }
}

impl Mul for Sim3 {
    type Output = Sim3;

    /// `c_from_b * b_from_a = c_from_a`.
    fn mul(self, b_from_a: Sim3) -> Sim3 {
        Sim3::new(
            self.scale * b_from_a.scale,
            self.rotation * b_from_a.rotation,
            self.transform_point(&b_from_a.translation),
        )
    }
}
