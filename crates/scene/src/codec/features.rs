//! Features of a batch of images. Keypoints, colours and descriptors of each image are sections of their own, so that
//! matching reads descriptors of a few images and mapping reads no descriptors at all. Features that were imported with their
//! matches have no descriptors.
//!
//! `INFO` is a record: what the descriptors of the batch are, and what became of each image. All images of a batch have
//! descriptors of one kind.

use serde::{Deserialize, Serialize};

use super::{Archive, ArchiveWriter, Kind, Packing, Source, Tag};
use crate::{DescriptorKind, Features, Keypoint, SceneError};

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

/// What a batch says of itself.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct BatchInfo {
    /// Of all images; that of an empty batch does not matter.
    descriptors: DescriptorKind,
    outcomes: Vec<FeatureOutcome>,
}

/// Collects the features of a batch, image by image.
pub struct FeatureBatchWriter {
    archive: ArchiveWriter,
    info: BatchInfo,
}

impl Default for FeatureBatchWriter {
    fn default() -> Self {
        Self { archive: ArchiveWriter::new(Kind::Features), info: BatchInfo::default() }
    }
}

impl FeatureBatchWriter {
    /// Adds the next image: its features, or the reason why it has none.
    ///
    /// # Errors
    /// When the columns are not of equal length, or the descriptors are not of the kind of the images before.
    pub fn push(&mut self, features: &Result<Features, String>) -> Result<(), SceneError> {
        let item = self.info.outcomes.len() as u32;
        match features {
            Err(reason) => {
                self.info.outcomes.push(FeatureOutcome { num_features: 0, rejected: Some(reason.clone()) })
            }
            Ok(features) => {
                let count = features.len();
                let num_bytes = features.descriptors.len();
                let fits = num_bytes == count * features.kind.num_bytes() || num_bytes == 0;
                if features.colors.len() != count || !fits {
                    return Err(SceneError::invalid(format!(
                        "features of image {item} have columns of unequal length"
                    )));
                }
                self.agree_on_kind(item, features)?;
                self.archive.column(KEYPOINTS, item, &features.keypoints, Packing::Raw)?;
                self.archive.column(COLORS, item, &features.colors, Packing::Raw)?;
                self.archive.column(DESCRIPTORS, item, &features.descriptors, Packing::Raw)?;
                self.info.outcomes.push(FeatureOutcome { num_features: count as u32, rejected: None });
            }
        }
        Ok(())
    }

    /// The first image with features decides what the descriptors of the batch are.
    fn agree_on_kind(&mut self, item: u32, features: &Features) -> Result<(), SceneError> {
        let is_decided = self.info.outcomes.iter().any(|outcome| outcome.num_features > 0);
        if !features.is_empty() && !is_decided {
            self.info.descriptors = features.kind;
        }
        if !features.is_empty() && features.kind != self.info.descriptors {
            return Err(SceneError::invalid(format!(
                "features of image {item} have descriptors of {}, those of the images before {}",
                features.kind.name(),
                self.info.descriptors.name()
            )));
        }
        Ok(())
    }

    /// The bytes of the batch.
    ///
    /// # Errors
    /// As [`ArchiveWriter::json`].
    pub fn finish(mut self) -> Result<Vec<u8>, SceneError> {
        self.archive.json(INFO, 0, &self.info)?;
        Ok(self.archive.finish())
    }
}

/// Reads a batch in part.
pub struct FeatureBatchReader<S> {
    archive: Archive<S>,
    info: BatchInfo,
}

impl<S: Source> FeatureBatchReader<S> {
    /// Reads what became of each image, and no features yet.
    ///
    /// # Errors
    /// As [`Archive::open`].
    pub fn open(source: S) -> Result<Self, SceneError> {
        let archive = Archive::open(source, Kind::Features)?;
        let info = archive.json(INFO, 0)?;
        Ok(Self { archive, info })
    }

    /// What the descriptors of the batch are.
    pub fn kind(&self) -> DescriptorKind {
        self.info.descriptors
    }

    /// What became of each image, in the order of the batch.
    pub fn outcomes(&self) -> &[FeatureOutcome] {
        &self.info.outcomes
    }

    /// Everything about the image at a place of the batch; empty for a rejected one.
    ///
    /// # Errors
    /// Corrupt when there is no such image or its sections do not hold.
    pub fn features(&self, place: usize) -> Result<Features, SceneError> {
        let kind = self.kind();
        if self.is_absent(place)? {
            return Ok(Features { kind, ..Features::default() });
        }
        let (keypoints, colors) = self.keypoints_and_colors(place)?;
        let descriptors = self.archive.column(DESCRIPTORS, place as u32)?;
        let fits = descriptors.len() == keypoints.len() * kind.num_bytes() || descriptors.is_empty();
        if !fits {
            return Err(SceneError::corrupt(format!(
                "image {place} of the batch has columns of unequal length"
            )));
        }
        Ok(Features { keypoints, kind, descriptors, colors })
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
        match self.info.outcomes.get(place) {
            Some(outcome) => Ok(outcome.rejected.is_some()),
            None => Err(SceneError::corrupt(format!("the batch has no image {place}"))),
        }
    }
}
