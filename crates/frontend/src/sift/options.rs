//! Options of feature extraction.

use serde::{Deserialize, Serialize};

use crate::FrontendError;

/// Where the scale space starts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FirstOctave {
    /// Octave 0, and octave −1 too where it is cheap and of use: in photographs of at most [`SMALL_PIXELS`] whose octave 0
    /// gives fewer blobs than asked for.
    Auto,
    /// Octave −1: at twice the photograph's resolution. Finds the finest blobs, at about four times the work.
    Doubled,
    /// Octave 0: at the photograph's resolution.
    Original,
}

/// Photographs up to this size get octave −1 when they need it: it costs as much as one four times as large. Most larger ones
/// are not sharp to the pixel, so that it finds little more: of 6 MP ones of three cameras it gave as many blobs as octave 0
/// or fewer in two, of 2.3 MP ones two to five times as many.
pub const SMALL_PIXELS: usize = 4_000_000;

/// Options of [`super::extract`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SiftOptions {
    /// The most blobs of a photograph; those with several orientations give several features, all together at most half as
    /// many again. Range: above 0. Default 10,240: about the features that COLMAP keeps when it is asked for 8,192, for it
    /// counts neither orientations nor the rest of the last level that it begins.
    pub max_features: u32,
    /// Where the scale space starts.
    pub first_octave: FirstOctave,
    /// The most octaves, without one that `Auto` adds. Range: 1 to 12. Default 5.
    pub num_octaves: u32,
    /// The least height of an extremum of the differences of Gaussians, as a part of white. Range: 0 to 1. Default
    /// 0.02 / 3: COLMAP's.
    pub contrast_threshold: f64,
    /// The largest ratio of principal curvatures of an extremum; beyond it lies on an edge. Range: above 1. Default 10
    /// (Lowe 2004).
    pub edge_threshold: f64,
    /// The most orientations of a blob. Range: 1 to 4. Default 2: COLMAP's.
    pub max_orientations: u32,
    /// Whether features take the photograph's own axes instead of dominant gradients. Default: no.
    pub upright: bool,
    /// Whether each blob's affine shape is found, so that it is described as if it were seen from the front. Keeps more
    /// matches between views that are far aslant of each other, at about three times the time of a whole run. Default: no.
    pub affine: bool,
    /// The part of `max_features` that is spread evenly over the photograph; the rest goes to the strongest. Range: 0 to
    /// 1. Default 0.5.
    pub spread: f64,
}

impl Default for SiftOptions {
    fn default() -> Self {
        Self {
            max_features: 10_240,
            first_octave: FirstOctave::Auto,
            num_octaves: 5,
            contrast_threshold: 0.02 / 3.0,
            edge_threshold: 10.0,
            max_orientations: 2,
            upright: false,
            affine: false,
            spread: 0.5,
        }
    }
}

impl SiftOptions {
    /// The most features of a photograph, all orientations counted.
    pub fn most_features(&self) -> usize {
        let blobs = self.max_features as usize;
        if self.upright || self.max_orientations == 1 { blobs } else { blobs + blobs / 2 }
    }

    /// Checks the ranges of all fields.
    ///
    /// # Errors
    /// Names every field that is out of its range.
    pub fn validate(&self) -> Result<(), FrontendError> {
        let checks = [
            (self.max_features > 0, "max_features must be above 0"),
            ((1..=12).contains(&self.num_octaves), "num_octaves must be 1 to 12"),
            ((0.0..=1.0).contains(&self.contrast_threshold), "contrast_threshold must be 0 to 1"),
            (self.edge_threshold > 1.0, "edge_threshold must be above 1"),
            ((1..=4).contains(&self.max_orientations), "max_orientations must be 1 to 4"),
            ((0.0..=1.0).contains(&self.spread), "spread must be 0 to 1"),
        ];
        let problems: Vec<&str> =
            checks.into_iter().filter(|(holds, _)| !holds).map(|(_, what)| what).collect();
        match problems.is_empty() {
            true => Ok(()),
            false => Err(FrontendError::invalid_option(format!("sift: {}", problems.join("; ")))),
        }
    }
}
