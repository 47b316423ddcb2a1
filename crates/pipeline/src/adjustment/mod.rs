//! A large adjustment cut into parts: the parts on a store, and what solver and holders say to each other.

mod store;
mod wire;

pub use store::StoredParts;
pub use terrane_fusion::problems::{self, ResidualFigures, WholeProblem};
pub use terrane_optim::Loss;
pub use terrane_optim::bundle::implicit::{
    CameraSide, LocalHost, Part, PartHost, PartRequest, PartStore, PartWorker, Partition, partition,
    solve_parts,
};
pub use terrane_optim::bundle::{
    BundleError, BundleOptions, BundleReport, BundleSolver, Precision, Preconditioner, RefineIntrinsics,
    Termination, solve,
};

use nalgebra::Vector3;
use rayon::prelude::*;

use crate::PipelineError;

/// A problem whose parts lie in a store.
pub struct Stored {
    /// The camera side.
    pub side: std::sync::Arc<CameraSide>,
    /// The poses that see each part.
    pub poses: Vec<Vec<u32>>,
    /// Observations of each part.
    pub weights: Vec<u64>,
    /// What takes part and what is left out.
    pub report: BundleReport,
    /// Shard and index of each point of each part.
    origins: Vec<Vec<(u32, u32)>>,
}

/// Cuts a problem into parts and writes them to a store.
///
/// # Errors
/// When the problem is not valid or the store can't be written.
pub fn store_parts(
    whole: &WholeProblem,
    options: &BundleOptions,
    store: &StoredParts,
) -> Result<Stored, PipelineError> {
    let Partition { side, parts, origins, report } = partition(&whole.problem, &whole.shards, options)
        .map_err(|error| PipelineError::invalid_input(error.to_string()))?;
    let written: Vec<(Vec<u32>, u64)> = parts
        .into_par_iter()
        .enumerate()
        .map(|(index, part)| {
            store.put(index as u32, &part)?;
            let weight = part.num_observations() as u64;
            Ok((part.poses, weight))
        })
        .collect::<Result<_, PipelineError>>()?;
    let (poses, weights) = written.into_iter().unzip();
    Ok(Stored { side: side.into(), poses, weights, report, origins })
}

impl Stored {
    /// Solves with whoever holds the parts, and takes cameras and points over.
    ///
    /// # Errors
    /// When a part can't be reached.
    pub fn solve(
        self,
        host: &mut dyn PartHost,
        whole: &mut WholeProblem,
    ) -> Result<BundleReport, BundleError> {
        let Self { side, poses, mut report, origins, .. } = self;
        let cameras = solve_parts(side, host, poses, &mut report)?;
        for (origins, answer) in origins.iter().zip(host.ask(&PartRequest::Points)?) {
            for ((shard, point), x) in origins.iter().zip(answer.as_chunks::<3>().0) {
                whole.shards.0[*shard as usize].points[*point as usize] = Vector3::from(*x);
            }
        }
        cameras.put_into(&mut whole.problem);
        Ok(report)
    }
}
pub use wire::{FromHolder, FromSolver};
