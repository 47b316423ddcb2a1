//! Features of a batch of images. Keypoints, colours and descriptors of each image are sections of their own, so that
//! matching reads descriptors of a few images and mapping reads no descriptors at all.

use serde::{Deserialize, Serialize};

use super::{Archive, ArchiveWriter, Kind, Packing, Source, Tag};
use crate::{DESCRIPTOR_LEN, Features, Keypoint, SceneError};

const INFO: Tag = Tag(*b"INFO");
const KEYPOINTS: Tag = Tag(*b"KEYP");
const COLORS: Tag = Tag(*b"COLR");
const DESCRIPTORS: Tag = Tag(*b"DESC");

/// What became of an image of the batch.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FeatureOutcome {
    /// How many features were found.
    pub num_features: u32,
    /// Why the image has none, when its pixels could not be read.
    pub rejected: Option<String>,
}

/// Collects the features of a batch, image by image.
pub struct FeatureBatchWriter {
    archive: ArchiveWriter,
    outcomes: Vec<FeatureOutcome>,
}

impl Default for FeatureBatchWriter {
    fn default() -> Self {
        Self { archive: ArchiveWriter::new(Kind::Features), outcomes: Vec::new() }
    }
}

impl FeatureBatchWriter {
    /// Adds the next image: its features, or the reason why it has none.
    ///
    /// # Errors
    /// When the columns are not of equal length.
    pub fn push(&mut self, features: &Result<Features, String>) -> Result<(), SceneError> {
        let item = self.outcomes.len() as u32;
        match features {
            Err(reason) => {
                self.outcomes.push(FeatureOutcome { num_features: 0, rejected: Some(reason.clone()) })
            }
            Ok(features) => {
                let count = features.len();
                if features.colors.len() != count || features.descriptors.len() != count * DESCRIPTOR_LEN {
                    return Err(SceneError::invalid(format!(
                        "features of image {item} have columns of unequal length"
                    )));
                }
                self.archive.column(KEYPOINTS, item, &features.keypoints, Packing::Raw)?;
                self.archive.column(COLORS, item, &features.colors, Packing::Raw)?;
                self.archive.column(DESCRIPTORS, item, &features.descriptors, Packing::Raw)?;
                self.outcomes.push(FeatureOutcome { num_features: count as u32, rejected: None });
            }
        }
        Ok(())
    }

    /// The bytes of the batch.
    ///
    /// # Errors
    /// As [`ArchiveWriter::json`].
    pub fn finish(mut self) -> Result<Vec<u8>, SceneError> {
        self.archive.json(INFO, 0, &self.outcomes)?;
        Ok(self.archive.finish())
    }
}

/// Reads a batch in part.
pub struct FeatureBatchReader<S> {
    archive: Archive<S>,
    outcomes: Vec<FeatureOutcome>,
}

impl<S: Source> FeatureBatchReader<S> {
    /// Reads what became of each image, and no features yet.
    ///
    /// # Errors
    /// As [`Archive::open`].
    pub fn open(source: S) -> Result<Self, SceneError> {
        let archive = Archive::open(source, Kind::Features)?;
        let outcomes = archive.json(INFO, 0)?;
        Ok(Self { archive, outcomes })
    }

    /// What became of each image, in the order of the batch.
    pub fn outcomes(&self) -> &[FeatureOutcome] {
        &self.outcomes
    }

    /// Everything about the image at a place of the batch; empty for a rejected one.
    ///
    /// # Errors
    /// Corrupt when there is no such image or its sections do not hold.
    pub fn features(&self, place: usize) -> Result<Features, SceneError> {
        if self.is_absent(place)? {
            return Ok(Features::default());
        }
        let (keypoints, colors) = self.keypoints_and_colors(place)?;
        let descriptors = self.archive.column(DESCRIPTORS, place as u32)?;
        if descriptors.len() != keypoints.len() * DESCRIPTOR_LEN {
            return Err(SceneError::corrupt(format!(
                "image {place} of the batch has columns of unequal length"
            )));
        }
        Ok(Features { keypoints, descriptors, colors })
    }

    /// Keypoints and colours of the image at a place of the batch; empty for a rejected one.
    ///
    /// # Errors
    /// As [`FeatureBatchReader::features`].
    pub fn keypoints_and_colors(&self, place: usize) -> Result<(Vec<Keypoint>, Vec<[u8; 3]>), SceneError> {
        if self.is_absent(place)? {
            return Ok((Vec::new(), Vec::new()));
        }
        let keypoints: Vec<Keypoint> = self.archive.column(KEYPOINTS, place as u32)?;
        let colors: Vec<[u8; 3]> = self.archive.column(COLORS, place as u32)?;
        if colors.len() != keypoints.len() {
            return Err(SceneError::corrupt(format!(
                "image {place} of the batch has columns of unequal length"
            )));
        }
        Ok((keypoints, colors))
    }

    fn is_absent(&self, place: usize) -> Result<bool, SceneError> {
        match self.outcomes.get(place) {
            Some(outcome) => Ok(outcome.rejected.is_some()),
            None => Err(SceneError::corrupt(format!("the batch has no image {place}"))),
        }
    }
}
