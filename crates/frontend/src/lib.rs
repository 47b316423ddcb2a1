//! Photographs in; features, retrieval, pair selection, matching and verification out.
//!
//! Everything takes bytes or values, never paths: reading files is the caller's. Every function is pure: the same input
//! and options give the same bytes on any number of threads.

mod error;
pub mod matching;
pub mod pairs;
pub mod retrieval;

pub use error::FrontendError;
