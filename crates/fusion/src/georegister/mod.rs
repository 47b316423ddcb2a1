//! Satellite positions to a local frame, and reconstructions into it.

mod fit;
mod frame;
mod positions;
#[cfg(test)]
mod tests;

pub use fit::{register, residuals};
pub use positions::local_positions;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use terrane_geometry::Sim3;
use terrane_scene::ImageId;

/// The origin of a local east-north-up frame, on WGS 84.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct EnuOrigin {
    /// Latitude in degrees, north positive.
    pub latitude_deg: f64,
    /// Longitude in degrees, east positive.
    pub longitude_deg: f64,
    /// Height in metres, in the datum that the photographs' altitudes have (often unknown).
    pub height_m: f64,
}

/// Where a photograph was taken, as its satellite receiver says, in the local frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct LocalPosition {
    /// Which photograph.
    pub image: ImageId,
    /// East, north, up in metres from the origin. Up is the other photographs' median when the file gives no height.
    pub x_in_enu: Vector3<f64>,
    /// Standard deviation per axis in metres; very large for a height that is not given.
    pub sigma_m: Vector3<f64>,
}

/// All positions of a run in one frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LocalPositions {
    /// The origin of the frame: the median of the positions.
    pub origin: EnuOrigin,
    /// Positions, ascending by image.
    pub positions: Vec<LocalPosition>,
    /// Photographs whose position has no height.
    pub num_without_altitude: u32,
    /// Photographs whose position can't be true (out of range, not finite, 0°/0°), ascending.
    pub rejected: Vec<ImageId>,
}

/// How a reconstruction is brought into the local frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GeoOptions {
    /// Positions that a geo-reference needs. Range: at least 3. Default 3.
    pub min_positions: u32,
    /// RANSAC's threshold, in standard deviations of a position. Default 3.
    pub max_deviations: f64,
    /// Least spread of the positions across their main direction, in standard deviations of a position; below it
    /// they are collinear and the turn about that line is not theirs to tell. Default 1.5: noise alone shows 1.
    pub min_spread_deviations: f64,
    /// Part of the positions that must agree. Range: 0 to 1. Default 0.3.
    pub min_inlier_ratio: f64,
    /// Most RANSAC iterations. Default 2,000.
    pub max_iterations: u32,
}

impl Default for GeoOptions {
    fn default() -> Self {
        Self {
            min_positions: 3,
            max_deviations: 3.0,
            min_spread_deviations: 1.5,
            min_inlier_ratio: 0.3,
            max_iterations: 2000,
        }
    }
}

/// How far a camera lies from its photograph's satellite position.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct GeoResidual {
    /// Which photograph.
    pub image: ImageId,
    /// Camera minus satellite position: east, north, up in metres.
    pub residual_m: Vector3<f64>,
    /// Whether it took part in the fit.
    pub inlier: bool,
}

/// Figures of a geo-reference.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct GeoReport {
    /// Cameras with a satellite position.
    pub num_positions: u32,
    /// Those that took part in the fit.
    pub num_inliers: u32,
    /// Median length of all residuals in metres.
    pub median_m: f64,
    /// RMS length of the inliers' residuals in metres.
    pub rmse_m: f64,
    /// Every residual, ascending by image.
    pub residuals: Vec<GeoResidual>,
}

/// Whether a reconstruction could be geo-referenced.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "outcome")]
pub enum GeoOutcome {
    /// In metres, in the local east-north-up frame.
    Registered {
        /// The similarity that brings the reconstruction into the frame.
        enu_from_local: Sim3,
        /// How well it fits.
        report: GeoReport,
    },
    /// In a frame of its own.
    NotRegistered {
        /// Why, in words.
        reason: String,
        /// A similarity to a frame that is pleasant to look at: up is up as far as the cameras tell, centred; in
        /// metres when two or more positions give the scale.
        frame_from_local: Sim3,
    },
}
