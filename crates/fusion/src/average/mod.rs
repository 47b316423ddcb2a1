//! Placing submaps, then cameras, by joint robust solves.

mod cameras;
mod place;

pub use cameras::{CameraAverageOptions, CameraAverageReport, CameraAverages};
pub use place::{PlaceOptions, PlacedComponent, PlacedSeam, Placement};
