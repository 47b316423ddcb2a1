//! The stages that look at pixels and at whole images: features and pairs.

use rayon::prelude::*;
use terrane_frontend::{features as extraction, image, pairs};
use terrane_scene::codec::{self, FeatureBatchWriter};
use terrane_scene::{Features, ImageId, ImagePair, ImageRecord};

use super::inputs::{MaskFile, read_mask, read_unchanged};
use super::read::{self, PairsInfo};
use super::{ExecutionContext, Made, appearance, encode_error, import};
use crate::task::FeatureSet;
use crate::{ArtefactKey, PipelineError, Store};

/// What an image needs while its features are computed, in bytes a pixel; see `plan::predict`.
const BYTES_PER_PIXEL: u64 = 48;

pub(super) fn features(
    store: &Store,
    context: &ExecutionContext,
    table_key: &ArtefactKey,
    first: ImageId,
    count: u32,
) -> Result<Made, PipelineError> {
    let (table, inputs) = context.ingested(store, table_key)?;
    let images: Vec<ImageId> = (first.0..first.0 + count).map(ImageId).collect();
    if images.iter().any(|image| image.index() >= table.images.len()) {
        return Err(PipelineError::bug(format!("images from {first} are not in the table")));
    }
    let largest = images.iter().map(|image| table.image(*image)).map(pixels_of).max().unwrap_or(1);
    let affordable = context.config.workers.memory_bytes / 2 / (largest * BYTES_PER_PIXEL).max(1);
    let at_once = (affordable.max(1) as usize).min(context.config.workers.threads as usize).max(1);
    let mut writer = FeatureBatchWriter::default();
    let (mut num_features, mut num_rejected) = (0, 0);
    for chunk in images.chunks(at_once) {
        context.cancel.check()?;
        let computed: Vec<Result<Features, String>> = match &inputs.imported {
            Some(imported) => import::features(context, &table, imported, chunk)?,
            None => chunk
                .par_iter()
                .map(|image| features_of(context, table.image(*image), inputs.mask_of(*image)))
                .collect::<Result<_, PipelineError>>()?,
        };
        for outcome in computed {
            match &outcome {
                Ok(features) => num_features += features.len() as u64,
                Err(_) => num_rejected += 1,
            }
            writer.push(&outcome).map_err(encode_error)?;
        }
    }
    let counts = vec![("images", u64::from(count)), ("features", num_features), ("rejected", num_rejected)];
    Ok(Made { bytes: writer.finish().map_err(encode_error)?, counts })
}

fn pixels_of(record: &terrane_scene::ImageRecord) -> u64 {
    u64::from(record.width_px) * u64::from(record.height_px)
}

/// The features of an image, or why its pixels can't be used.
fn features_of(
    context: &ExecutionContext,
    record: &ImageRecord,
    mask: Option<&MaskFile>,
) -> Result<Result<Features, String>, PipelineError> {
    let bytes = read_unchanged(&context.config.photos.join(&record.path), &record.content_hash)?;
    let options = &context.config.features;
    let mask = match mask.map(|file| read_mask(context, file, record)).transpose()?.transpose() {
        Ok(mask) => mask,
        Err(reason) => return Ok(Err(reason)),
    };
    let decoded = image::decode(&bytes, &options.decode);
    // The file is not needed beside the scale space.
    drop(bytes);
    Ok(match decoded {
        Ok(decoded) => {
            let (luma, rgb) = (&decoded.luma, decoded.rgb.as_ref());
            Ok(extraction::extract_masked(luma, rgb, mask.as_ref(), &options.extraction()))
        }
        Err(error) => Err(error.to_string()),
    })
}

pub(super) fn pairs(
    store: &Store,
    context: &ExecutionContext,
    table_key: &ArtefactKey,
    features: &FeatureSet,
    lost: &[(ImageId, u32, String)],
) -> Result<Made, PipelineError> {
    let (table, inputs) = context.ingested(store, table_key)?;
    let options = &context.config.pairs;
    let mut info = PairsInfo { num_features: vec![0; table.images.len()], ..Default::default() };
    for (first, count, reason) in lost {
        let images = (first.0..first.0 + count).map(ImageId);
        info.rejected
            .extend(images.map(|image| (image, format!("its features could not be computed: {reason}"))));
    }
    for (batch, key) in &features.batches {
        let reader = read::batch(store, key)?;
        for (place, outcome) in reader.outcomes().iter().enumerate() {
            let image = ImageId(batch * features.images_per_batch + place as u32);
            if let Some(count) = info.num_features.get_mut(image.index()) {
                *count = outcome.num_features;
            }
            info.rejected.extend(outcome.rejected.iter().map(|reason| (image, reason.clone())));
        }
    }
    info.rejected.sort();
    let selection = match inputs.imported_matches() {
        Some(imported) => import::pairs(context, &table, imported)?,
        None => {
            let similar = match pairs::wanted_similar(&table, &options.select) {
                Some(wanted) => Some(appearance::similar_images(store, context, features, &wanted)?),
                None => None,
            };
            pairs::select(&table, similar.as_deref(), &options.select)
        }
    };
    let has_features = |image: ImageId| info.num_features[image.index()] > 0;
    let chosen: Vec<ImagePair> = selection
        .pairs
        .into_iter()
        .filter(|pair| has_features(pair.first()) && has_features(pair.second()))
        .collect();
    info.num_pairs = chosen.len() as u64;
    info.report = selection.report;
    let blocks = pairs::blocks(&chosen, &options.blocks);
    let counts = vec![("pairs", info.num_pairs), ("blocks", blocks.len() as u64)];
    Ok(Made { bytes: codec::encode_pair_blocks(&blocks, &info).map_err(encode_error)?, counts })
}
