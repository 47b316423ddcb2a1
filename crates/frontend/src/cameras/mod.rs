//! Which photographs share a camera, and the intrinsics to start from.
//!
//! Photographs of one maker, model, serial number, lens, size and focal length form one camera. Photographs whose files
//! do not say what took them form one camera for each folder and size: sets without EXIF usually come from one
//! calibrated camera, and shared intrinsics are far better determined than those of single images.

mod focal;
mod given;
mod sensors;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use terrane_geometry::{Camera, CameraModel};
use terrane_scene::{CameraId, CameraRecord, FocalSource};

use crate::metadata::ImageMetadata;
pub use focal::{FocalEstimate, FocalEvidence, estimate_focal};
pub use given::GivenCamera;

/// The model that cameras start with unless the user gives one: one focal length and one radial coefficient, COLMAP's
/// default for photographs of unknown calibration.
pub const DEFAULT_MODEL: CameraModel = CameraModel::SimpleRadial;

/// Groups photographs by camera.
///
/// `images` are relative path (parts joined by `/`) and metadata, in the order of the image table. With `given`, all
/// photographs of one size form one camera with these intrinsics, as [`FocalSource::Given`].
///
/// Returns the cameras, numbered by first appearance, and the camera of each image.
pub fn group(
    images: &[(String, ImageMetadata)],
    given: Option<&GivenCamera>,
) -> (Vec<CameraRecord>, Vec<CameraId>) {
    let mut ids = BTreeMap::new();
    let mut cameras = Vec::new();
    let mut camera_of_image = Vec::with_capacity(images.len());
    for (path, metadata) in images {
        let key = match given {
            Some(_) => CameraKey {
                width_px: metadata.width_px,
                height_px: metadata.height_px,
                ..CameraKey::default()
            },
            None => CameraKey::of(path, metadata),
        };
        let id = *ids.entry(key).or_insert_with_key(|key| {
            cameras.push(match given {
                Some(given) => given_record(given, metadata),
                None => estimated_record(key, metadata),
            });
            CameraId::from_index(cameras.len() - 1)
        });
        camera_of_image.push(id);
    }
    (cameras, camera_of_image)
}

/// What photographs of one camera have in common. Lengths are rounded: cameras write one setting with more than one
/// last digit.
#[derive(Clone, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
struct CameraKey {
    body: Option<(String, String, String, String)>,
    folder: String,
    width_px: u32,
    height_px: u32,
    focal_tenths_mm: Option<i64>,
    focal_35mm: Option<i64>,
    focal_plane_px_per_10mm: Option<i64>,
}

impl CameraKey {
    fn of(path: &str, metadata: &ImageMetadata) -> Self {
        let text = |value: &Option<String>| value.clone().unwrap_or_default();
        let body = metadata
            .model
            .as_ref()
            .map(|model| (text(&metadata.make), model.clone(), text(&metadata.serial), text(&metadata.lens)));
        let folder = match (&body, path.rsplit_once('/')) {
            (None, Some((folder, _))) => folder.to_owned(),
            _ => String::new(),
        };
        let rounded = |value: Option<f64>, factor: f64| value.map(|v| (v * factor).round() as i64);
        Self {
            body,
            folder,
            width_px: metadata.width_px,
            height_px: metadata.height_px,
            focal_tenths_mm: rounded(metadata.focal_mm, 10.0),
            focal_35mm: rounded(metadata.focal_35mm, 1.0),
            focal_plane_px_per_10mm: rounded(metadata.focal_plane_px_per_mm, 10.0),
        }
    }

    fn name(&self) -> String {
        match &self.body {
            Some((make, model, serial, lens)) => {
                // Many makers repeat themselves in the model.
                let make = if model.starts_with(make.as_str()) { "" } else { make.as_str() };
                let parts: Vec<&str> =
                    [make, model, lens, serial].into_iter().filter(|p| !p.is_empty()).collect();
                parts.join(" ")
            }
            None if self.folder.is_empty() => {
                format!("unnamed camera, {} x {} pixels", self.width_px, self.height_px)
            }
            None => {
                format!("unnamed camera of {}, {} x {} pixels", self.folder, self.width_px, self.height_px)
            }
        }
    }
}

fn estimated_record(key: &CameraKey, metadata: &ImageMetadata) -> CameraRecord {
    let estimate = estimate_focal(metadata);
    let camera = Camera::centered(DEFAULT_MODEL, metadata.width_px, metadata.height_px, estimate.focal_px);
    let focal_source = match estimate.evidence {
        FocalEvidence::ImageSize => FocalSource::Guess,
        _ => FocalSource::Exif,
    };
    CameraRecord { camera, focal_source, name: key.name() }
}

fn given_record(given: &GivenCamera, metadata: &ImageMetadata) -> CameraRecord {
    let camera = given.camera(metadata.width_px, metadata.height_px);
    let name = format!("given camera, {} x {} pixels", metadata.width_px, metadata.height_px);
    CameraRecord { camera, focal_source: FocalSource::Given, name }
}
