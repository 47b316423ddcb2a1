//! The reduced camera system over all parts, with damping and priors.

use super::super::BundleError;
use super::super::terms::Term;
use super::conjugate_gradients::System;
use super::host::PartHost;
use super::known;
use super::preconditioner::Inverse;
use super::worker::{CameraSide, PartRequest};

/// `S + λ D` with priors and marks, as a product.
pub(super) struct CameraSystem<'a> {
    pub side: &'a CameraSide,
    pub host: &'a mut dyn PartHost,
    /// The poses of each part.
    pub poses: &'a [Vec<u32>],
    /// `λ D` of each unknown.
    pub damping: &'a [f64],
    pub terms: &'a [Term],
}

impl CameraSystem<'_> {
    /// Asks every part.
    pub fn ask(&mut self, request: &PartRequest) -> Result<Vec<Vec<f64>>, BundleError> {
        self.host.ask(request)
    }

    /// The product; parts are added in their order.
    pub fn product(&mut self, x: &[f64]) -> Result<Vec<f64>, BundleError> {
        let answers = self.host.ask(&PartRequest::Multiply(x.to_vec()))?;
        let mut y: Vec<f64> = x.iter().zip(self.damping).map(|(x, d)| x * d).collect();
        let width = self.side.map.width();
        for (poses, answer) in self.poses.iter().zip(&answers) {
            for (pose, local) in poses.iter().zip(answer.chunks_exact(width)) {
                self.side.map.scatter(*pose, local, &mut y);
            }
        }
        known::add_product(self.side, self.terms, x, &mut y);
        Ok(y)
    }
}

/// The system with its preconditioner.
pub(super) struct Preconditioned<'a> {
    pub system: CameraSystem<'a>,
    pub inverse: &'a mut Inverse,
}

impl System for Preconditioned<'_> {
    fn multiply(&mut self, x: &[f64]) -> Result<Vec<f64>, BundleError> {
        self.system.product(x)
    }

    fn precondition(&mut self, r: &[f64]) -> Result<Vec<f64>, BundleError> {
        self.inverse.apply(&mut self.system, r)
    }
}
