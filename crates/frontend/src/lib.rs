//! Photographs in; features, retrieval, pair selection, matching and verification out.
//!
//! Everything takes bytes or values, never paths: reading files is the caller's. Every function is pure: the same input
//! and options give the same bytes on any number of threads.

pub mod cameras;
pub mod corners;
mod error;
pub mod features;
pub mod image;
mod mask;
pub mod matching;
pub mod metadata;
pub mod pairs;
pub mod retrieval;
pub mod sift;
mod simd;
pub mod surf;
pub mod targets;
pub mod verification;

pub use error::FrontendError;
pub use mask::Mask;
