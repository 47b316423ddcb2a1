//! Where every submap lies, and how that is asked for.

use serde::{Deserialize, Serialize};
use terrane_geometry::Sim3;

use crate::georegister::{GeoOptions, GeoOutcome};

/// How submaps are placed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PlaceOptions {
    /// A seam that disagrees with the joint solution by more than this is switched off, in degrees. Default 3.
    pub max_seam_rotation_deg: f64,
    /// The same for its scale, as a factor minus one. Default 0.05.
    pub max_seam_scale: f64,
    /// The same for the place where the submaps meet, as a fraction of the median depth. Default 0.1: a seam that
    /// is right leaves a few percent, through the bending of its submaps.
    pub max_seam_distance: f64,
    /// How a component is brought into the local frame.
    pub geo: GeoOptions,
}

impl Default for PlaceOptions {
    fn default() -> Self {
        Self {
            max_seam_rotation_deg: 3.0,
            max_seam_scale: 0.05,
            max_seam_distance: 0.1,
            geo: GeoOptions::default(),
        }
    }
}

/// What the joint solve made of a seam.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PlacedSeam {
    /// One submap.
    pub a: u32,
    /// The other.
    pub b: u32,
    /// Rotation left over, in degrees.
    pub rotation_deg: f64,
    /// Distance left over where the submaps meet, in units of the placed frame.
    pub distance: f64,
    /// That distance as a fraction of the median depth.
    pub relative_distance: f64,
    /// Scale left over, as a factor minus one.
    pub scale: f64,
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

impl Placement {
    /// The place of the component that a submap is in and its similarity.
    pub fn of(&self, submap: u32) -> Option<(u32, &Sim3)> {
        Some((*self.component_of.get(submap as usize)?, self.world_from_submap.get(submap as usize)?))
    }
}
