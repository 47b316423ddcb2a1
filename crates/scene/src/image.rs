//! The image table: what is known of each photograph before its pixels are looked at.

use serde::{Deserialize, Serialize};
use terrane_geometry::Camera;

use crate::{CameraId, ImageId};

/// How the camera was held, as EXIF numbers it (1 to 8). Pixels are never turned: coordinates are those of the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Orientation(pub u8);

impl Default for Orientation {
    fn default() -> Self {
        Self(1)
    }
}

/// A position from a satellite receiver, on WGS 84, as the file states it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct GpsPrior {
    /// Latitude in degrees, north positive.
    pub latitude_deg: f64,
    /// Longitude in degrees, east positive.
    pub longitude_deg: f64,
    /// Height in metres in the datum of the file, often unknown; `None` when the file gives none.
    pub altitude_m: Option<f64>,
    /// Standard deviation of the horizontal position in metres, per axis.
    pub sigma_horizontal_m: f64,
    /// Standard deviation of the height in metres.
    pub sigma_vertical_m: f64,
}

/// What the angles of an [`AttitudePrior`] turn. Angles are applied as yaw, then pitch, then roll, about axes that turn
/// with the body: yaw clockwise from north seen from above, pitch nose up, roll right side down.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AttitudeOf {
    /// A camera that looks ahead: at pitch 0 to the horizon, at -90 straight down (DJI, Autel's newer files, Parrot, Skydio).
    Gimbal,
    /// A craft whose camera looks down through its floor, the top of the image ahead: at pitch 0 straight down, at 90 to
    /// the horizon ahead (the `Camera` schema of Pix4D: senseFly, Parrot Sequoia, MicaSense, Autel's older files).
    Craft,
}

/// How a camera was held, as the file's flight data state it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct AttitudePrior {
    /// What the angles turn.
    pub of: AttitudeOf,
    /// Degrees clockwise from north; `None` when the file gives none.
    pub yaw_deg: Option<f64>,
    /// Degrees upwards.
    pub pitch_deg: f64,
    /// Degrees, right side down.
    pub roll_deg: f64,
}

/// What a drone knows of its flight beside its position.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FlightPrior {
    /// Height in metres above where it took off, or above the ground where the file says so.
    pub height_above_ground_m: Option<f64>,
    /// How the camera was held.
    pub attitude: Option<AttitudePrior>,
}

/// Where a camera's focal length comes from, best first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FocalSource {
    /// Given by the user: intrinsics stay as they are.
    Given,
    /// From EXIF: 35 mm equivalent, focal-plane resolution, or a known sensor.
    Exif,
    /// Guessed from the image's size.
    Guess,
}

/// A camera and what its photographs share.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CameraRecord {
    /// Intrinsics to start from.
    pub camera: Camera,
    /// How far they can be trusted.
    pub focal_source: FocalSource,
    /// Maker, model and lens, or why these photographs form one camera.
    pub name: String,
}

/// A photograph that can be used.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ImageRecord {
    /// Path relative to the run's folder, with `/` between parts.
    pub path: String,
    /// Hash of the file's bytes, in hexadecimal.
    pub content_hash: String,
    /// The camera that took it.
    pub camera: CameraId,
    /// Size of the file's pixel grid.
    pub width_px: u32,
    /// Size of the file's pixel grid.
    pub height_px: u32,
    /// How the camera was held.
    pub orientation: Orientation,
    /// Position, if the file has one.
    pub gps: Option<GpsPrior>,
    /// Height above ground and attitude, if the file has any.
    #[serde(default)]
    pub flight: Option<FlightPrior>,
    /// Time of exposure in seconds of an unstated zone, for order only.
    pub captured_s: Option<f64>,
}

/// A file that was offered and can't be used.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RejectedImage {
    /// Path relative to the run's folder.
    pub path: String,
    /// What is wrong with it and what would help.
    pub reason: String,
}

/// All photographs of a run. `images[id.index()]` is the image of that id; sorted by path.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ImageTable {
    /// Cameras, by [`CameraId`].
    pub cameras: Vec<CameraRecord>,
    /// Photographs, by [`ImageId`].
    pub images: Vec<ImageRecord>,
    /// Files that can't be used, by path.
    pub rejected: Vec<RejectedImage>,
}

impl ImageTable {
    /// The photograph of an id.
    ///
    /// # Panics
    /// When the id is not of this table.
    pub fn image(&self, id: ImageId) -> &ImageRecord {
        &self.images[id.index()]
    }

    /// The camera that took a photograph.
    ///
    /// # Panics
    /// When the id is not of this table.
    pub fn camera_of(&self, id: ImageId) -> &CameraRecord {
        &self.cameras[self.image(id).camera.index()]
    }

    /// Every image id, in order.
    pub fn ids(&self) -> impl Iterator<Item = ImageId> + use<> {
        (0..self.images.len()).map(ImageId::from_index)
    }
}
