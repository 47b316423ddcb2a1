//! One similarity per submap, from all seams and all satellite positions together.

use serde::{Deserialize, Serialize};
use terrane_geometry::Sim3;

use crate::georegister::{GeoOptions, GeoOutcome};

/// How submaps are placed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PlaceOptions {
    /// A seam whose robust weight falls below this is switched off. Range: 0 to 1. Default 0.1.
    pub min_seam_weight: f64,
    /// How a component is brought into the local frame.
    pub geo: GeoOptions,
}

impl Default for PlaceOptions {
    fn default() -> Self {
        Self { min_seam_weight: 0.1, geo: GeoOptions::default() }
    }
}

/// What the joint solve made of a seam.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlacedSeam {
    /// One submap.
    pub a: u32,
    /// The other.
    pub b: u32,
    /// Rotation left over, in degrees.
    pub rotation_deg: f64,
    /// Distance left over where the submaps meet, in units of the placed frame.
    pub distance: f64,
    /// Scale left over, as a factor minus one.
    pub scale: f64,
    /// Robust weight in the last iteration, 0 to 1; 0 when switched off.
    pub weight: f64,
    /// Why the seam is not used, if it isn't.
    pub refused: Option<String>,
}

/// Submaps that hold together.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlacedComponent {
    /// Its submaps, ascending.
    pub submaps: Vec<u32>,
    /// Different images in them.
    pub num_images: u32,
    /// Whether its frame is the local east-north-up frame.
    pub geo: GeoOutcome,
}

/// Where every submap lies.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Placement {
    /// `world_from_submap` of each submap, in the world of its component.
    pub world_from_submap: Vec<Sim3>,
    /// Component of each submap: a place in `components`.
    pub component_of: Vec<u32>,
    /// Components, most images first.
    pub components: Vec<PlacedComponent>,
    /// Every seam that came in, in its order.
    pub seams: Vec<PlacedSeam>,
}
