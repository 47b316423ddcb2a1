//! Submaps in, one geo-referenced reconstruction out.
//!
//! The stages, in the order of a run; each is a pure function of its inputs, its options and a seed:
//!
//! ```text
//! align::align(a: &Reconstruction, b: &Reconstruction, &AlignOptions, Seed) -> SeamOutcome
//! georegister::local_positions(&ImageTable) -> Option<LocalPositions>
//! average::place(&[SubmapSummary], &[align::Seam], &[LocalPosition], &PlaceOptions, Seed) -> Placement
//! average::average_cameras(&[SubmapSummary], &Placement, component: usize, &CameraAverageOptions)
//!     -> CameraAverages
//! merge::merge(&[&Reconstruction], &Placement, &CameraAverages, component: usize, &MergeOptions) -> MergedComponent
//! adjust::adjust(&mut MergedCameras, &mut dyn MergedShards, &AdjustInput, &AdjustOptions)
//!     -> Result<AdjustReport, FusionError>
//! georegister::register(&[RegisteredImage], &[LocalPosition], &GeoOptions, Seed) -> GeoOutcome
//! seams::measure(a: &Reconstruction, b: &Reconstruction, world_from_a: &Sim3, world_from_b: &Sim3) -> SeamFigures
//! ```
//!
//! Submaps are numbered `0..n` by the caller, in one fixed order; everything here speaks of them by that number.
//! This crate does no I/O and knows no network.

pub mod adjust;
pub mod align;
pub mod average;
mod error;
pub mod georegister;
pub mod merge;
pub mod seams;
mod statistics;
mod summary;
#[cfg(test)]
mod test_support;

pub use error::FusionError;
pub use summary::{CameraLink, SubmapSummary};
