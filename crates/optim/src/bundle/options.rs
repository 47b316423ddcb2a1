//! Options of a bundle adjustment.

use serde::{Deserialize, Serialize};

use super::BundleError;
use crate::Loss;
use crate::linear::LinearSolver;

/// What holds the seven free directions (position, rotation, scale) of an adjustment that nothing else fixes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Gauge {
    /// The damping of Levenberg–Marquardt: the scene stays near where it starts but may drift; the usual choice, and
    /// the one that converges fastest.
    #[default]
    Damped,
    /// The first free pose is held, and of the pose farthest from it the motion of its centre along the line between
    /// both (to first order). Acts only where fewer than two poses are fixed, no points are fixed, and fewer than
    /// three position priors exist.
    TwoPoses,
}

/// Options of [`super::solve`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BundleOptions {
    /// Loss of reprojection errors. Default: squared.
    pub loss: Loss,
    /// Scale of that loss in pixels. Range: above 0. Default 1.
    pub loss_scale_px: f64,
    /// Loss of position priors. Default: squared.
    pub prior_loss: Loss,
    /// Scale of the priors' loss in standard deviations. Range: above 0. Default 3.
    pub prior_loss_scale_sigma: f64,
    /// Most linear solves, accepted or not. Default 50 (Ceres).
    pub max_iterations: u32,
    /// Stop when an accepted step lowers the cost by less than this part. Range: 0 to below 1. Default 1e-6 (Ceres).
    pub cost_tolerance: f64,
    /// Stop when no parameter's gradient has a cosine with the residuals above this. Range: at least 0. Default
    /// 1e-10 (as MINPACK's `gtol`, Moré 1978).
    pub gradient_tolerance: f64,
    /// Stop when a step is shorter than this part of the parameters' norm. Range: at least 0. Default 1e-10.
    pub step_tolerance: f64,
    /// First damping, relative to the diagonal of the normal equations. Range: above 0. Default 1e-4 (Ceres).
    pub initial_damping: f64,
    /// What fixes the free directions. Default: damped.
    pub gauge: Gauge,
    /// How the reduced camera system is solved. Default: by size and fill.
    pub linear_solver: LinearSolver,
    /// Memory for shards' linearisations that are kept between passes, in bytes; shards beyond it are linearised again
    /// in each pass, with the same result. Default 1 GiB.
    pub linearisation_memory_bytes: u64,
}

impl Default for BundleOptions {
    fn default() -> Self {
        Self {
            loss: Loss::Squared,
            loss_scale_px: 1.0,
            prior_loss: Loss::Squared,
            prior_loss_scale_sigma: 3.0,
            max_iterations: 50,
            cost_tolerance: 1e-6,
            gradient_tolerance: 1e-10,
            step_tolerance: 1e-10,
            initial_damping: 1e-4,
            gauge: Gauge::Damped,
            linear_solver: LinearSolver::Auto,
            linearisation_memory_bytes: 1 << 30,
        }
    }
}

impl BundleOptions {
    /// Checks every range.
    pub fn validate(&self) -> Result<(), BundleError> {
        let positive = [
            ("loss_scale_px", self.loss_scale_px),
            ("prior_loss_scale_sigma", self.prior_loss_scale_sigma),
            ("initial_damping", self.initial_damping),
        ];
        for (name, value) in positive {
            if !(value.is_finite() && value > 0.0) {
                return Err(BundleError::invalid(format!("option {name} must be positive, not {value}")));
            }
        }
        let tolerances = [
            ("cost_tolerance", self.cost_tolerance),
            ("gradient_tolerance", self.gradient_tolerance),
            ("step_tolerance", self.step_tolerance),
        ];
        for (name, value) in tolerances {
            if !(0.0..1.0).contains(&value) {
                return Err(BundleError::invalid(format!(
                    "option {name} must be within [0, 1), not {value}"
                )));
            }
        }
        Ok(())
    }
}
