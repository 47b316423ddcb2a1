//! One long solve on many processes: holders keep parts of an adjustment, the solver asks them.
//!
//! Parts lie in a store that all can read. Whoever loses a holder loses no step: its parts are taken over at the accepted
//! step, and the questions that led to where the solve is are asked again of these parts alone.

mod holder;
mod remote;
#[cfg(test)]
mod tests;

pub use holder::{HolderOptions, hold};
pub use remote::{RemoteHost, RemoteOptions};
