//! A large adjustment cut into parts: the parts on a store, and what solver and holders say to each other.

mod store;
mod wire;

pub use store::StoredParts;
pub use terrane_optim::bundle::implicit::{
    CameraSide, Part, PartHost, PartRequest, PartStore, PartWorker, Partition, partition, solve_parts,
};
pub use terrane_optim::bundle::{BundleError, BundleReport};
pub use wire::{FromHolder, FromSolver};
