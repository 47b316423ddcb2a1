//! One cluster of matched images in, submaps out.
//!
//! Incremental structure from motion after Schönberger & Frahm, "Structure-from-Motion Revisited" (CVPR 2016): an initial
//! pair, then image after image by absolute pose, points by robust triangulation of tracks, local and full bundle
//! adjustment, filtering. [`reconstruct`] is a pure function of input, options and seed; its bytes do not depend on the
//! number of threads. A cluster of which nothing can be rebuilt is an outcome with reasons.

mod assemble;
mod bundle;
mod cluster;
mod error;
mod focal;
mod grow;
mod initial;
mod input;
mod model;
mod options;
mod points;
mod reconstruct;
mod registration;
mod report;
mod visibility;

pub use error::MappingError;
pub use input::{ClusterImage, ClusterInput, PositionPrior};
pub use options::{
    AdjustmentOptions, InitialPairOptions, MappingOptions, RegistrationOptions, TriangulationOptions,
};
pub use reconstruct::reconstruct;
pub use report::{InitialTrial, MappingReport, SubmapReport, TrialVerdict};

#[cfg(test)]
mod tests;
