//! Submaps in, one geo-referenced reconstruction out.
//!
//! The stages, in the order of a run; each is a pure function of its inputs, its options and a seed:
//!
//! 1. [`align::align`]: two overlapping submaps → a similarity with evidence, or the reason there is none.
//! 2. [`georegister::local_positions`]: the GPS of the image table → positions in one local ENU frame.
//! 3. [`average::place`]: all seams and positions → one similarity per submap, solved jointly, wrong seams switched
//!    off; then [`average::average_cameras`]: one pose per photograph.
//! 4. [`merge::merge`]: tracks joined across seams, one [`merge::MergedComponent`] per connected component, its
//!    points in shards by space.
//! 5. [`adjust::adjust`]: seams first, then the whole, over shards that the caller keeps.
//! 6. [`seams::measure`]: what a seam shows under a placement; [`georegister::residuals`]: what positions show.
//!
//! Submaps are numbered `0..n` by the caller, in one fixed order; everything here speaks of them by that number.
//! This crate does no I/O and knows no network.

pub mod adjust;
pub mod align;
pub mod average;
mod error;
pub mod georegister;
pub mod merge;
pub mod problems;
pub mod seams;
mod statistics;
mod summary;
#[cfg(test)]
mod test_support;

pub use error::FusionError;
pub use summary::{CameraLink, SubmapSummary};
