//! Bundle adjustment: poses, intrinsics and points from reprojection errors, by Levenberg–Marquardt with a Schur complement.
//!
//! Points are eliminated shard by shard (Brown 1958; Triggs et al. 1999); what remains is a block-sparse system over
//! poses (six unknowns on the left of `cam_from_world`) and refined intrinsics, solved by a sparse or dense Cholesky
//! factorisation. Robust losses act by re-weighting.
//!
//! Observations whose point starts behind the camera take no part in the solve, unless [`BehindCamera::Mirror`] says
//! so. A step that would carry a point behind a camera is shortened for this point; if that does not help it counts as no
//! descent.

mod explicit;
pub mod implicit;
mod layout;
mod levenberg_marquardt;
mod linearisation;
mod options;
mod pattern;
mod plan;
mod priors;
mod problem;
mod projection;
mod reduced;
mod report;
mod schur;
mod shards;
mod solver;
mod step;
mod terms;

pub use options::{BehindCamera, BundleOptions, BundleSolver, Gauge, Precision, Preconditioner};
pub use priors::{
    Anchor, DistancePrior, GravityPrior, Landmark, LandmarkPrior, Mark, ParameterPrior, PositionBias,
    PositionPrior, Priors, RotationPrior,
};
pub use problem::{AdjustedCameras, BundleProblem, RefineIntrinsics};
pub use report::{BundleReport, Termination};
pub use shards::{BundleObservation, BundleShard, InMemoryShards, ShardError, Shards};
pub use solver::solve;

/// A problem that can't be solved as given; says what to change.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
pub struct BundleError(#[from] BundleErrorKind);

#[derive(Debug, thiserror::Error)]
enum BundleErrorKind {
    #[error("bundle adjustment: {0}")]
    Invalid(String),
    #[error("bundle adjustment")]
    Shard(#[from] ShardError),
    #[error("bundle adjustment: reduced camera system: {0}")]
    Linear(crate::linear::LinearError),
    #[error("bundle adjustment: {0}")]
    Lost(String),
}

impl BundleError {
    fn invalid(message: String) -> Self {
        BundleErrorKind::Invalid(message).into()
    }

    /// Nobody holds the parts of a problem any more; says why and what to do.
    pub fn lost(message: String) -> Self {
        BundleErrorKind::Lost(message).into()
    }

    /// Whether the problem or the options were wrong, rather than a shard's store or the machine's memory.
    pub fn is_invalid_input(&self) -> bool {
        matches!(self.0, BundleErrorKind::Invalid(_))
    }
}

impl From<ShardError> for BundleError {
    fn from(error: ShardError) -> Self {
        BundleErrorKind::Shard(error).into()
    }
}

impl From<crate::linear::LinearError> for BundleError {
    fn from(error: crate::linear::LinearError) -> Self {
        BundleErrorKind::Linear(error).into()
    }
}

#[cfg(test)]
mod tests;
