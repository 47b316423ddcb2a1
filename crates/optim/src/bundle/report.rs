//! What a bundle adjustment did and why it stopped.

use serde::{Deserialize, Serialize};

use super::BundleSolver;

/// Why a solve stopped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Termination {
    /// The gradient vanished.
    Gradient,
    /// A step was too short to matter.
    Step,
    /// An accepted step hardly lowered the cost.
    Cost,
    /// The iterations ran out; the result is the best so far.
    MaxIterations,
    /// No damping gave a descent; the result is the best so far.
    NoDescent,
    /// Nothing to adjust: no free parameter, or no usable observation or prior.
    NothingToAdjust,
}

impl Termination {
    /// Whether a minimum was reached within the tolerances.
    pub fn converged(self) -> bool {
        matches!(self, Self::Gradient | Self::Step | Self::Cost)
    }
}

/// Figures of one bundle adjustment. Costs are sums of `ρ / 2`, in square pixels (priors in square sigmas).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BundleReport {
    /// Cost before.
    pub initial_cost: f64,
    /// Cost after.
    pub final_cost: f64,
    /// What solved for the steps.
    pub solver: BundleSolver,
    /// Iterations of conjugate gradients, all steps together; none where the system was factorised.
    pub linear_iterations: u64,
    /// Clusters of cameras that the solve was cut into; none where the system was factorised.
    pub clusters: u32,
    /// Linear solves, accepted or not.
    pub iterations: u32,
    /// Steps that lowered the cost.
    pub accepted_steps: u32,
    /// Why it stopped.
    pub termination: Termination,
    /// Observations that took part.
    pub observations: u64,
    /// Observations left out because their point starts behind the camera (or outside the model's domain).
    pub behind_camera: u64,
    /// Observations left out because their point is seen fewer than twice.
    pub seen_once: u64,
    /// Points that took part.
    pub points: u64,
    /// Free poses without any observation or prior; they stay where they are.
    pub unconstrained_poses: Vec<u32>,
    /// Number of unknowns of the reduced camera system.
    pub reduced_unknowns: u64,
}

impl BundleReport {
    pub(super) fn empty() -> Self {
        Self {
            initial_cost: 0.0,
            final_cost: 0.0,
            solver: BundleSolver::Auto,
            linear_iterations: 0,
            clusters: 0,
            iterations: 0,
            accepted_steps: 0,
            termination: Termination::NothingToAdjust,
            observations: 0,
            behind_camera: 0,
            seen_once: 0,
            points: 0,
            unconstrained_poses: Vec::new(),
            reduced_unknowns: 0,
        }
    }
}
