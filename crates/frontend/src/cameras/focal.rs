//! The focal length in pixels that a photograph's metadata speak for.

use super::sensors;
use crate::metadata::ImageMetadata;

/// What a focal length rests on, best first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FocalEvidence {
    /// Focal length in millimetres and the width of the camera's sensor, from the table of this crate.
    KnownSensor,
    /// Focal length in millimetres and the focal-plane resolution that the file states.
    FocalPlane,
    /// The 35 mm equivalent.
    Equivalent35mm,
    /// Nothing but the image's size.
    ImageSize,
}

/// A focal length to start from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FocalEstimate {
    /// Focal length in pixels of the file.
    pub focal_px: f64,
    /// What it rests on.
    pub evidence: FocalEvidence,
}

/// Diagonal of a 35 mm film frame, 36 mm x 24 mm.
const FILM_DIAGONAL_MM: f64 = 43.266_615_305_567_87;

/// Focal length over the longer side when nothing is known: 45 degrees across, COLMAP's default.
const GUESSED_FOCAL_OVER_SIDE: f64 = 1.2;

/// The best focal length that the metadata support.
///
/// The 35 mm equivalent is read by the diagonal of the picture (CIPA DCG-001), not by its width: for 4:3 pictures the
/// two differ by 4 %. It is rounded to millimetres, and some makers state that of another crop of the sensor, so that it
/// comes after the sensor's own measures. A result outside 0.3 to 30 times the longer side is not believed.
pub fn estimate_focal(metadata: &ImageMetadata) -> FocalEstimate {
    let (width, height) = (f64::from(metadata.width_px), f64::from(metadata.height_px));
    let side = width.max(height);
    let sensor_width_mm = sensors::width_mm(metadata.make.as_deref(), metadata.model.as_deref());
    let known_sensor = metadata.focal_mm.zip(sensor_width_mm).map(|(focal, sensor)| focal / sensor * side);
    let focal_plane = metadata.focal_mm.zip(metadata.focal_plane_px_per_mm).map(|(focal, px)| focal * px);
    let equivalent = metadata.focal_35mm.map(|focal| focal / FILM_DIAGONAL_MM * width.hypot(height));
    [
        (known_sensor, FocalEvidence::KnownSensor),
        (focal_plane, FocalEvidence::FocalPlane),
        (equivalent, FocalEvidence::Equivalent35mm),
    ]
    .into_iter()
    .find_map(|(focal_px, evidence)| {
        focal_px
            .filter(|f| (0.3 * side..=30.0 * side).contains(f))
            .map(|focal_px| FocalEstimate { focal_px, evidence })
    })
    .unwrap_or(FocalEstimate { focal_px: GUESSED_FOCAL_OVER_SIDE * side, evidence: FocalEvidence::ImageSize })
}
