//! Ingest: every file once, for its hash and its metadata.

use rayon::prelude::*;
use terrane_frontend::cameras;
use terrane_frontend::metadata::{self, ImageMetadata};
use terrane_scene::codec::{ArchiveWriter, Kind};
use terrane_scene::{ImageRecord, ImageTable, RejectedImage};

use super::inputs::MaskFile;
use super::{ExecutionContext, Inputs, Made, import, read};
use crate::listing::Listing;
use crate::masks::MaskNames;
use crate::{CameraOverride, PipelineError};

/// Files that are in memory together at most, whatever the number of threads: they are read in runs of this length.
const FILES_AT_ONCE: usize = 16;

/// A photograph that can be used.
pub(super) struct Usable {
    pub path: String,
    pub content_hash: String,
    pub metadata: ImageMetadata,
}

pub(super) fn ingest(context: &ExecutionContext, digest: &str) -> Result<Made, PipelineError> {
    let listing = Listing::scan(&context.config)?;
    if listing.digest != digest {
        return Err(PipelineError::storage(
            "the photographs changed while the run began: it is planned again",
        ));
    }
    let mut usable = Vec::new();
    let mut rejected = Vec::new();
    for paths in listing.paths.chunks(FILES_AT_ONCE) {
        context.cancel.check()?;
        let read: Vec<Result<Usable, RejectedImage>> =
            paths.par_iter().map(|path| read_file(context, path)).collect();
        for outcome in read {
            match outcome {
                Ok(file) => usable.push(file),
                Err(reason) => rejected.push(reason),
            }
        }
    }
    let (table, inputs) = match context.config.import {
        Some(_) => {
            let (table, imported) = import::table(context, usable, rejected)?;
            (table, Inputs { imported: Some(imported), ..Inputs::default() })
        }
        None => {
            let table = table(context, usable, rejected)?;
            let masks = masks(context, &listing, &table)?;
            (table, Inputs { masks, ..Inputs::default() })
        }
    };
    let mut counts = vec![("images", table.images.len() as u64), ("rejected", table.rejected.len() as u64)];
    if let Some((found, missing)) = inputs.count_masks() {
        tracing::info!(found, missing, "masks; photographs without one are used whole");
        counts.extend([("masks", found), ("without_mask", missing)]);
    }
    let mut archive = ArchiveWriter::new(Kind::Record);
    archive.json(read::TABLE, 0, &table).map_err(super::encode_error)?;
    // Not there in runs that read photographs only, whose artefacts then are what they always were.
    if !inputs.is_empty() {
        archive.json(read::INPUTS, 0, &inputs).map_err(super::encode_error)?;
    }
    Ok(Made { bytes: archive.finish(), counts })
}

fn read_file(context: &ExecutionContext, path: &str) -> Result<Usable, RejectedImage> {
    let reject = |reason: String| RejectedImage { path: path.to_owned(), reason };
    let bytes = std::fs::read(context.config.photos.join(path))
        .map_err(|error| reject(format!("the file can't be read ({error})")))?;
    let metadata = metadata::read(&bytes).map_err(|error| reject(error.to_string()))?;
    let content_hash = crate::key::hex(blake3::hash(&bytes).as_bytes());
    Ok(Usable { path: path.to_owned(), content_hash, metadata })
}

/// The mask of each image, when masks were asked for. Files that are listed but can't be used count for what names of
/// masks are ambiguous.
fn masks(
    context: &ExecutionContext,
    listing: &Listing,
    table: &ImageTable,
) -> Result<Option<Vec<Option<MaskFile>>>, PipelineError> {
    let Some(folder) = &context.config.masks else { return Ok(None) };
    let names = MaskNames::new(listing.paths.iter().map(String::as_str));
    let mask = |record: &ImageRecord| {
        context.cancel.check()?;
        let Some(path) = names.find(folder, &record.path) else { return Ok(None) };
        let bytes = std::fs::read(folder.join(&path))
            .map_err(|error| PipelineError::io(&format!("can't read mask {path}"), &error))?;
        let content_hash = crate::key::hex(blake3::hash(&bytes).as_bytes());
        Ok(Some(MaskFile { path, content_hash }))
    };
    table.images.par_iter().map(mask).collect::<Result<Vec<_>, _>>().map(Some)
}

fn table(
    context: &ExecutionContext,
    usable: Vec<Usable>,
    rejected: Vec<RejectedImage>,
) -> Result<ImageTable, PipelineError> {
    let given = context.config.camera.as_ref().map(CameraOverride::given).transpose()?;
    let (hashes, described): (Vec<String>, Vec<(String, ImageMetadata)>) =
        usable.into_iter().map(|file| (file.content_hash, (file.path, file.metadata))).unzip();
    let (cameras, camera_of) = cameras::group(&described, given.as_ref());
    let images = described
        .into_iter()
        .zip(hashes)
        .zip(camera_of)
        .map(|(((path, metadata), content_hash), camera)| ImageRecord {
            path,
            content_hash,
            camera,
            width_px: metadata.width_px,
            height_px: metadata.height_px,
            orientation: metadata.orientation,
            gps: metadata.gps,
            flight: metadata.flight,
            captured_s: metadata.captured_s,
        })
        .collect();
    Ok(ImageTable { cameras, images, rejected })
}
