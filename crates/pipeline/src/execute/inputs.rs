//! What a run reads beside its photographs: masks, and features of another program. Part of the ingest artefact, so that
//! keys of later stages depend on it and every worker agrees on it.

use std::path::Path;

use serde::{Deserialize, Serialize};
use terrane_frontend::Mask;
use terrane_frontend::image::{self, DecodeOptions};
use terrane_scene::{ImageId, ImageRecord};

use super::ExecutionContext;
use crate::PipelineError;

/// Everything beside photographs; nothing in most runs.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Inputs {
    /// The mask of each image, when masks were asked for.
    pub masks: Option<Vec<Option<MaskFile>>>,
    /// Features that are imported.
    pub imported: Option<Imported>,
}

/// A mask as it was when the run began.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct MaskFile {
    /// Path within the folder of masks.
    pub path: String,
    /// Hash of the file's bytes, in hexadecimal.
    pub content_hash: String,
}

/// A database as it was when the run began.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Imported {
    /// Its size and time of change: it must not have changed.
    pub stamp: String,
    /// What it holds of each image.
    pub images: Vec<ImportedImage>,
    /// Hash of all matches; `None` when there are none, and descriptors are matched instead.
    pub matches_digest: Option<String>,
    /// Pairs with matches.
    pub num_pairs: u64,
}

/// What a database holds of an image.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct ImportedImage {
    /// Its number there.
    pub id: i64,
    /// Hash of keypoints, and of descriptors where they are used.
    pub digest: String,
}

impl Inputs {
    /// The mask of an image, if it has one.
    pub fn mask_of(&self, image: ImageId) -> Option<&MaskFile> {
        self.masks.as_ref()?.get(image.index())?.as_ref()
    }

    /// What is imported, when matches are.
    pub fn imported_matches(&self) -> Option<&Imported> {
        self.imported.as_ref().filter(|imported| imported.matches_digest.is_some())
    }

    /// What the features of an image depend on beside its own bytes and options.
    pub fn digest_of(&self, image: ImageId) -> String {
        let imported = self.imported.as_ref().and_then(|imported| imported.images.get(image.index()));
        match (imported, self.mask_of(image)) {
            (Some(imported), _) => format!("imported {}", imported.digest),
            (None, Some(mask)) => format!("mask {}", mask.content_hash),
            (None, None) => String::new(),
        }
    }

    /// Whether a run has any, so that its keys must tell.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// Photographs with a mask and without, when masks were asked for.
    pub fn count_masks(&self) -> Option<(u64, u64)> {
        let masks = self.masks.as_ref()?;
        let found = masks.iter().flatten().count() as u64;
        Some((found, masks.len() as u64 - found))
    }
}

/// The mask of an image, or why it can't be used.
pub(super) fn read_mask(
    context: &ExecutionContext,
    file: &MaskFile,
    record: &ImageRecord,
) -> Result<Result<Mask, String>, PipelineError> {
    let Some(folder) = &context.config.masks else {
        return Err(PipelineError::bug("an image has a mask in a run without masks"));
    };
    let bytes = read_unchanged(&folder.join(&file.path), &file.content_hash)?;
    let options = DecodeOptions { color: false, ..context.config.features.decode.clone() };
    let mask = image::decode(&bytes, &options)
        .and_then(|decoded| Mask::new(decoded.luma, record.width_px as usize, record.height_px as usize));
    Ok(mask.map_err(|error| format!("mask {}: {error}", file.path)))
}

/// The bytes of a file that must be those that the run began with.
pub(super) fn read_unchanged(path: &Path, content_hash: &str) -> Result<Vec<u8>, PipelineError> {
    let bytes = std::fs::read(path)
        .map_err(|error| PipelineError::io(&format!("can't read {}", path.display()), &error))?;
    if crate::key::hex(blake3::hash(&bytes).as_bytes()) == content_hash {
        return Ok(bytes);
    }
    Err(PipelineError::invalid_input(format!(
        "{} changed during the run: run again to begin with the new file",
        path.display()
    )))
}
