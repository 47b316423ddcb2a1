//! COLMAP's databases: cameras, images, features, matches and two-view geometries in one SQLite file.
//!
//! Read so that features and matches of any program that writes such files can be reconstructed, learned ones above all;
//! written so that COLMAP's mappers can work on ours. Format as documented by COLMAP ("Database Format") and as versions
//! 3.6 to 4.2 write it: older files lack some tables and columns, which are then not asked for.
//!
//! Ids are the database's own, at least 1 as a rule. Pixels follow `docs/conventions.md`, which is COLMAP's convention.
//! A database comes from elsewhere: sizes are checked against the bytes that are there before anything is allocated, and
//! everything that is wrong is an error that names the row.

mod blob;
mod read;
mod schema;
#[cfg(test)]
mod tests;
mod write;

use nalgebra::Matrix3;
use terrane_geometry::{Camera, Rigid3};

pub use read::Database;
pub use write::DatabaseWriter;

use crate::{PairKind, SceneError};

/// Ids of images lie below; it is also what pairs of them are numbered by.
pub const MAX_IMAGE_ID: i64 = 2_147_483_647;

/// COLMAP's number for descriptors as SIFT's, in the column `type` that databases have since version 4.
pub const SIFT_DESCRIPTORS: i64 = 0;

/// The number of a pair of images.
///
/// # Errors
/// Invalid when an id is out of range or both are the same.
pub fn pair_id(a: i64, b: i64) -> Result<i64, SceneError> {
    let (first, second) = (a.min(b), a.max(b));
    if first < 0 || second >= MAX_IMAGE_ID || first == second {
        return Err(SceneError::invalid(format!("images {a} and {b} can't be a pair of a COLMAP database")));
    }
    Ok(first * MAX_IMAGE_ID + second)
}

/// The images of a pair's number as it stands, whichever is lower; `None` when it can't be one.
fn images_of(pair_id: i64) -> Option<(i64, i64)> {
    let (first, second) = (pair_id.div_euclid(MAX_IMAGE_ID), pair_id.rem_euclid(MAX_IMAGE_ID));
    (pair_id >= 0 && first < MAX_IMAGE_ID && first != second).then_some((first, second))
}

/// A camera of a database.
#[derive(Clone, Debug, PartialEq)]
pub struct DatabaseCamera {
    /// Its number.
    pub id: i64,
    /// Its intrinsics, or why terrane can't use them: a model that it does not have.
    pub camera: Result<Camera, String>,
    /// Whether the focal length is known from somewhere, as EXIF or a calibration, and not guessed.
    pub has_prior_focal: bool,
}

/// An image of a database.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DatabaseImage {
    /// Its number.
    pub id: i64,
    /// Its path relative to the folder of the images. Different for each image.
    pub name: String,
    /// The number of its camera, which exists.
    pub camera: i64,
}

/// What is known of an image's descriptors before they are read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DescriptorLayout {
    /// How many.
    pub rows: usize,
    /// Bytes of one.
    pub row_bytes: usize,
    /// COLMAP's number of their kind; [`SIFT_DESCRIPTORS`] where the database does not say.
    pub kind: i64,
}

impl DescriptorLayout {
    /// Whether they are of SIFT's shape: 128 bytes under the Euclidean distance.
    pub fn is_sift(&self) -> bool {
        self.kind == SIFT_DESCRIPTORS && self.row_bytes == crate::DESCRIPTOR_LEN
    }
}

/// A pair of images of a database that has matches.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct DatabasePair {
    /// The image with the lower number.
    pub first: i64,
    /// The image with the higher number.
    pub second: i64,
    /// How many matches, at least one: raw ones, or the inliers of the two-view geometry where there are no raw ones.
    pub num_matches: usize,
}

/// A verified pair as a database holds it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DatabaseGeometry<'a> {
    /// What it is, see [`config_of`].
    pub config: i64,
    /// Feature of the first image, feature of the second.
    pub matches: &'a [[u32; 2]],
    /// `second ᵀ F first = 0` in pixels.
    pub fundamental: Option<Matrix3<f64>>,
    /// `second ᵀ E first = 0` on the plane z = 1.
    pub essential: Option<Matrix3<f64>>,
    /// `second ∝ H first` in pixels.
    pub homography: Option<Matrix3<f64>>,
    /// The relative pose, with a translation of length one or zero.
    pub second_from_first: Option<Rigid3>,
}

/// COLMAP's number of what a pair shows.
pub fn config_of(kind: PairKind) -> i64 {
    match kind {
        PairKind::Calibrated => 2,
        PairKind::Uncalibrated => 3,
        PairKind::Planar => 4,
        PairKind::Panoramic => 5,
        PairKind::Watermark => 7,
    }
}
