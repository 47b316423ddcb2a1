//! Steps by conjugate gradients on the reduced camera system, which is never formed: large problems.
//!
//! Cameras are cut into clusters that look at the same place. Each cluster has a part: the points that it sees most of,
//! with all their observations. Parts are linearised, multiplied with and stepped on their own, wherever they are held;
//! what they answer is the size of their cameras, and is added in the order of parts. So the result is the same to the
//! last bit for any number of threads and holders.

mod blocks;
mod cholesky;
mod clusters;
mod coarse;
mod conjugate_gradients;
mod host;
mod known;
mod local;
mod part;
mod partition;
mod preconditioner;
mod product;
mod real;
mod solver;
mod state;
mod system;
#[cfg(test)]
mod tests;
mod trial;
mod worker;

pub use clusters::Clusters;
pub use host::{LocalHost, PartHost};
pub use part::Part;
pub use partition::{Partition, partition};
pub use solver::solve_parts;
pub use worker::{CameraSide, PartRequest, PartStore, PartWorker};

pub(super) use solver::solve_here;
