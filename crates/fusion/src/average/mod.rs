//! Placing submaps, then cameras, by joint robust solves.

mod cameras;
mod placement;

pub use cameras::{CameraAverageOptions, CameraAverageReport, CameraAverages};
pub use placement::{PlaceOptions, PlacedComponent, PlacedSeam, Placement};
