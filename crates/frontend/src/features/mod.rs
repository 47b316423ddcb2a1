//! Features of a photograph by any of the detectors, behind one function.
//!
//! | name | detector | descriptor |
//! |---|---|---|
//! | `sift` | differences of Gaussians | gradients, 128 bytes |
//! | `sift-upright` | the same | the same, not turned |
//! | `sift-affine` | the same | the same, of surroundings that are made round |
//! | `harris` | Harris' measure on a pyramid | gradients, 128 bytes |
//! | `fast` | segment test on a pyramid | gradients, 128 bytes |
//! | `orb` | segment test on a pyramid | rotated BRIEF, 256 bits |
//! | `surf` | determinant of the Hessian by boxes | Haar wavelets, 64 bytes |
//! | `surf-upright` | the same | the same, not turned |

#[cfg(test)]
pub(crate) mod scenes;
#[cfg(test)]
mod tests;

use std::str::FromStr;

use serde::{Deserialize, Serialize};
use terrane_scene::{DescriptorKind, Features};

use crate::corners::{self, CornerDescriptor, CornerDetector, CornerOptions};
use crate::image::{GrayImage, RgbImage};
use crate::sift::{self, SiftOptions};
use crate::surf::{self, SurfOptions};
use crate::{FrontendError, Mask};

/// Which features are found, and how they are described.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FeatureMethod {
    /// SIFT.
    #[default]
    Sift,
    /// SIFT that takes the photograph's own axes.
    SiftUpright,
    /// SIFT with the affine shape of each blob.
    SiftAffine,
    /// Harris corners described by gradients.
    Harris,
    /// FAST corners described by gradients.
    Fast,
    /// FAST corners described by rotated BRIEF.
    Orb,
    /// SURF.
    Surf,
    /// SURF that takes the photograph's own axes.
    SurfUpright,
}

impl FeatureMethod {
    /// Every method.
    pub const ALL: [Self; 8] = [
        Self::Sift,
        Self::SiftUpright,
        Self::SiftAffine,
        Self::Harris,
        Self::Fast,
        Self::Orb,
        Self::Surf,
        Self::SurfUpright,
    ];

    /// The name in options and flags.
    pub fn name(self) -> &'static str {
        match self {
            Self::Sift => "sift",
            Self::SiftUpright => "sift-upright",
            Self::SiftAffine => "sift-affine",
            Self::Harris => "harris",
            Self::Fast => "fast",
            Self::Orb => "orb",
            Self::Surf => "surf",
            Self::SurfUpright => "surf-upright",
        }
    }

    /// What its descriptors are.
    pub fn descriptors(self) -> DescriptorKind {
        match self {
            Self::Orb => DescriptorKind::Bits256,
            _ => DescriptorKind::Bytes128,
        }
    }
}

impl std::fmt::Display for FeatureMethod {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for FeatureMethod {
    type Err = FrontendError;

    fn from_str(name: &str) -> Result<Self, FrontendError> {
        Self::ALL.into_iter().find(|method| method.name() == name).ok_or_else(|| {
            let names = Self::ALL.map(Self::name).join(", ");
            FrontendError::invalid_option(format!("features `{name}` are unknown: use one of {names}"))
        })
    }
}

/// The method, and the options of all of them.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FeatureOptions {
    /// Which features.
    pub method: FeatureMethod,
    /// Of SIFT.
    pub sift: SiftOptions,
    /// Of Harris, FAST and ORB.
    pub corners: CornerOptions,
    /// Of SURF.
    pub surf: SurfOptions,
}

impl FeatureOptions {
    /// Checks the ranges of all fields of the options that the method reads.
    ///
    /// # Errors
    /// Names every field that is out of its range.
    pub fn validate(&self) -> Result<(), FrontendError> {
        match self.method {
            FeatureMethod::Sift | FeatureMethod::SiftUpright | FeatureMethod::SiftAffine => {
                self.sift.validate()
            }
            FeatureMethod::Harris | FeatureMethod::Fast | FeatureMethod::Orb => self.corners.validate(),
            FeatureMethod::Surf | FeatureMethod::SurfUpright => self.surf.validate(),
        }
    }

    /// SIFT's options, and what the method's name says of them.
    fn named_sift(&self) -> SiftOptions {
        let mut options = self.sift.clone();
        options.upright |= self.method == FeatureMethod::SiftUpright;
        options.affine |= self.method == FeatureMethod::SiftAffine;
        options
    }

    /// The most features of a photograph.
    pub fn most_features(&self) -> usize {
        match self.method {
            FeatureMethod::Sift | FeatureMethod::SiftUpright | FeatureMethod::SiftAffine => {
                self.named_sift().most_features()
            }
            FeatureMethod::Harris | FeatureMethod::Fast | FeatureMethod::Orb => {
                self.corners.max_features as usize
            }
            FeatureMethod::Surf | FeatureMethod::SurfUpright => self.surf.max_features as usize,
        }
    }

    /// These options with the defaults in place of those that the method does not read: equal for equal results.
    pub fn that_matter(&self) -> Self {
        let mut options = Self { method: self.method, ..Self::default() };
        match self.method {
            FeatureMethod::Sift | FeatureMethod::SiftUpright | FeatureMethod::SiftAffine => {
                options.sift = self.sift.clone();
            }
            FeatureMethod::Harris | FeatureMethod::Fast | FeatureMethod::Orb => {
                options.corners = self.corners.clone();
            }
            FeatureMethod::Surf | FeatureMethod::SurfUpright => options.surf = self.surf.clone(),
        }
        options
    }
}

/// Finds and describes the features of a photograph, in falling strength.
///
/// Colours are looked up in `rgb`, or are the grey of `luma` when there is none. A photograph that is too small or
/// without texture has no features; that is no error.
pub fn extract(luma: &GrayImage, rgb: Option<&RgbImage>, options: &FeatureOptions) -> Features {
    extract_masked(luma, rgb, None, options)
}

/// [`extract`] with features only where a mask lets them be. What it keeps out does not count towards the most features.
pub fn extract_masked(
    luma: &GrayImage,
    rgb: Option<&RgbImage>,
    mask: Option<&Mask>,
    options: &FeatureOptions,
) -> Features {
    let corners = |detector, descriptor| {
        corners::extract_masked((luma, rgb), mask, (detector, descriptor), &options.corners)
    };
    match options.method {
        FeatureMethod::Sift | FeatureMethod::SiftUpright | FeatureMethod::SiftAffine => {
            sift::extract_masked(luma, rgb, mask, &options.named_sift())
        }
        FeatureMethod::Harris => corners(CornerDetector::Harris, CornerDescriptor::Gradients),
        FeatureMethod::Fast => corners(CornerDetector::Fast, CornerDescriptor::Gradients),
        FeatureMethod::Orb => corners(CornerDetector::Fast, CornerDescriptor::Brief),
        FeatureMethod::Surf => surf::extract_masked((luma, rgb), mask, &options.surf),
        FeatureMethod::SurfUpright => {
            let options = SurfOptions { upright: true, ..options.surf.clone() };
            surf::extract_masked((luma, rgb), mask, &options)
        }
    }
}
