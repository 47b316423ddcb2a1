//! Ids, images, features, pairs, tracks, submaps and reconstructions, with their codecs, importers and exporters.
//!
//! This crate knows what things are and how they are written down. It solves nothing and schedules nothing.

pub mod bal;
pub mod codec;
pub mod colmap;
mod error;
mod features;
mod ids;
mod image;
mod model;
mod pair;
pub mod ply;
pub mod positions;
mod reconstruction;
mod submap;

pub use error::SceneError;
pub use features::{BINARY_DESCRIPTOR_LEN, DESCRIPTOR_LEN, DescriptorKind, Features, Keypoint};
pub use ids::{CameraId, ClusterId, ComponentId, ImageId, PointIndex};
pub use image::{
    AttitudeOf, AttitudePrior, CameraRecord, FlightPrior, FocalSource, GpsPrior, ImageRecord, ImageTable,
    Orientation, RejectedImage,
};
pub use model::Model;
pub use pair::{ImagePair, MatchedPair, PairKind, PairSummary};
pub use reconstruction::{Observation, Reconstruction, RegisteredImage, ScenePoint};
pub use submap::{ImageFate, Submap, SubmapOutcome};
