//! Transforms, cameras, minimal solvers, robust estimation and geodesy.
//!
//! This crate knows no images, files, threads or ids: numbers in, numbers out. Frames, units and signs follow
//! `docs/conventions.md`.

pub mod absolute_pose;
pub mod alignment;
pub mod calibration;
pub mod camera;
mod elementary;
mod epipolar;
pub mod essential;
pub mod fundamental;
pub mod geodesy;
pub mod homography;
mod linear;
#[cfg(test)]
mod manifold_tests;
pub mod p2p;
pub mod p3p;
pub mod p4pf;
pub mod pnp;
mod polynomial;
mod quadrics;
pub mod ransac;
pub mod resection;
mod rigid3;
mod seed;
mod sim3;
pub mod small_lm;
pub mod so3;
#[cfg(test)]
mod test_support;
pub mod triangulation;
pub mod two_view;

pub use camera::{Camera, CameraModel};
pub use ransac::{RansacOptions, Robust};
pub use rigid3::Rigid3;
pub use seed::Seed;
pub use sim3::Sim3;
