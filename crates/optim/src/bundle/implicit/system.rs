//! The reduced camera system over all parts, with damping and priors.

use super::super::BundleError;
use super::conjugate_gradients::System;
use super::host::PartHost;
use super::preconditioner::Inverse;
use super::priors::PriorRow;
use super::worker::{CameraSide, PartRequest};

/// `S + λ D` and the priors, as a product.
pub(super) struct CameraSystem<'a> {
    pub side: &'a CameraSide,
    pub host: &'a mut dyn PartHost,
    /// The poses of each part.
    pub poses: &'a [Vec<u32>],
    /// `λ D` of each unknown.
    pub damping: &'a [f64],
    pub priors: &'a [PriorRow],
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
        for row in self.priors {
            let range = row.first..row.first + row.jacobian.len();
            let image: f64 = row.jacobian.iter().zip(&x[range.clone()]).map(|(j, x)| j * x).sum();
            y[range].iter_mut().zip(&row.jacobian).for_each(|(y, j)| *y += row.weight * image * j);
        }
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
