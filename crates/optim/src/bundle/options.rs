//! Options of a bundle adjustment.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use terrane_geometry::Camera;

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
    /// three positions of cameras and landmarks are measured.
    TwoPoses,
}

/// What becomes of observations whose point lies behind the camera.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BehindCamera {
    /// They take no part when the point starts there, and no step leads there.
    #[default]
    LeaveOut,
    /// They count as the formula of a perspective camera says, which does not look at the sign of the depth: what problems
    /// of the literature (BAL) mean by their cost.
    Mirror,
}

impl BehindCamera {
    /// Whether a point in the camera's frame counts as the point on the other side of the centre: a perspective formula
    /// divides by z, whatever its sign, and shows both at one pixel.
    #[inline(always)]
    pub fn mirrors(self, camera: &Camera, x_in_cam: &Vector3<f64>) -> bool {
        self == Self::Mirror && x_in_cam.z < 0.0 && camera.model.is_perspective()
    }
}

/// How the linear systems of an adjustment are solved.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BundleSolver {
    /// By the number of unknowns.
    #[default]
    Auto,
    /// The reduced camera system is formed and factorised.
    Explicit,
    /// The reduced camera system is only multiplied with: preconditioned conjugate gradients (Hestenes & Stiefel 1952;
    /// Agarwal et al. 2010).
    Implicit,
}

/// What speeds up conjugate gradients.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Preconditioner {
    /// Two-level.
    #[default]
    Auto,
    /// The diagonal blocks of the reduced system: one a camera.
    BlockJacobi,
    /// One block for each cluster of cameras.
    ClusterBlocks,
    /// The inverse of the cameras' normal equations, corrected by a truncated power series (Weber et al. 2023). Needs
    /// intrinsics that no two poses share, or that are held.
    PowerSeries,
    /// Cluster blocks, and a coarse system of one similarity for each cluster.
    TwoLevel,
}

/// What the kernels of conjugate gradients compute in. Costs and gradients are always `f64`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Precision {
    /// Jacobians in `f32`; sums over cameras in `f64`.
    #[default]
    Single,
    /// `f64` throughout.
    Double,
}

/// Options of [`super::solve`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BundleOptions {
    /// Loss of reprojection errors. Default: squared.
    pub loss: Loss,
    /// Scale of that loss in pixels. Range: above 0. Default 1.
    pub loss_scale_px: f64,
    /// What becomes of observations whose point lies behind the camera. Default: left out.
    pub behind_camera: BehindCamera,
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
    /// How steps are solved for. Default: by the number of unknowns.
    pub solver: BundleSolver,
    /// The preconditioner of the implicit solver. Default: two-level.
    pub preconditioner: Preconditioner,
    /// What the implicit solver computes products in. Default: `f32` with `f64` sums.
    pub precision: Precision,
    /// Conjugate gradients stop when the residual, in the preconditioner's norm, is below this part of the first.
    /// Range: above 0 to below 1. Default 0.1 (Ceres).
    pub linear_tolerance: f64,
    /// Most iterations of conjugate gradients for a step. Default 500.
    pub max_linear_iterations: u32,
    /// Most poses of a cluster of the implicit solver. Range: at least 1. Default 64: a cluster's block then fits into the
    /// second cache, and its factor costs no more than the products that it saves.
    pub cluster_poses: u32,
    /// How the explicit reduced camera system is factorised. Default: by size and fill.
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
            behind_camera: BehindCamera::LeaveOut,
            prior_loss: Loss::Squared,
            prior_loss_scale_sigma: 3.0,
            max_iterations: 50,
            cost_tolerance: 1e-6,
            gradient_tolerance: 1e-10,
            step_tolerance: 1e-10,
            initial_damping: 1e-4,
            gauge: Gauge::Damped,
            solver: BundleSolver::Auto,
            preconditioner: Preconditioner::Auto,
            precision: Precision::Single,
            linear_tolerance: 0.1,
            max_linear_iterations: 500,
            cluster_poses: 64,
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
            ("linear_tolerance", self.linear_tolerance),
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
            ("linear_tolerance", self.linear_tolerance),
        ];
        for (name, value) in tolerances {
            if !(0.0..1.0).contains(&value) {
                return Err(BundleError::invalid(format!(
                    "option {name} must be within [0, 1), not {value}"
                )));
            }
        }
        if self.cluster_poses == 0 {
            return Err(BundleError::invalid("option cluster_poses must be at least 1".to_owned()));
        }
        Ok(())
    }
}
