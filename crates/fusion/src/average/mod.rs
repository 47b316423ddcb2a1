//! Placing submaps, then cameras, by joint robust solves.

mod cameras;
mod fuse;
mod place;
mod placement;
#[cfg(test)]
mod tests;
mod tree;

pub use cameras::{CameraAverageOptions, CameraAverageReport, CameraAverages, average_cameras};
pub use place::place;
pub use placement::{PlaceOptions, PlacedComponent, PlacedSeam, Placement};
