//! The stages that look at pixels and descriptors: features, pairs, match.

use std::borrow::Cow;
use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};

use rayon::prelude::*;
use terrane_frontend::matching::{Match, PreparedImage, match_prepared};
use terrane_frontend::verification::{Candidate, NotVerified, View, verify};
use terrane_frontend::{features as extraction, image, pairs};
use terrane_geometry::ransac::SampleOrder;
use terrane_scene::codec::{self, FeatureBatchWriter, MatchBlock};
use terrane_scene::{DescriptorKind, Features, ImageId, ImagePair, ImageRecord, ImageTable, MatchedPair};

use super::inputs::{MaskFile, read_mask, read_unchanged};
use super::read::{self, PairsInfo};
use super::{ExecutionContext, Made, appearance, encode_error, import};
use crate::task::FeatureSet;
use crate::{ArtefactKey, PipelineError, Stage, Store};

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

pub(super) fn matching(
    store: &Store,
    context: &ExecutionContext,
    (table_key, pairs_key): (&ArtefactKey, &ArtefactKey),
    block: u32,
    features: &FeatureSet,
) -> Result<Made, PipelineError> {
    let (table, inputs) = context.ingested(store, table_key)?;
    let (blocks, _) = read::pairs(store, pairs_key)?;
    let pairs = blocks
        .get(block as usize)
        .ok_or_else(|| PipelineError::bug(format!("there is no block {block} of {} pairs", blocks.len())))?;
    let mut images: BTreeMap<ImageId, Features> = BTreeMap::new();
    for pair in pairs {
        for image in [pair.first(), pair.second()] {
            if let Entry::Vacant(vacant) = images.entry(image) {
                vacant.insert(read::features(store, features, image)?);
            }
        }
    }
    let imported = inputs.imported_matches();
    let imported = imported.map(|imported| import::matches(context, imported, pairs)).transpose()?;
    let options = &context.config.matching.matching;
    let mut verification = context.config.matching.verification.clone();
    if imported.is_some() {
        // No match is known to be better than another: their order says nothing.
        verification.ransac.order = SampleOrder::Uniform;
    }
    let prepared = match imported {
        Some(_) => BTreeMap::new(),
        None => prepared(context, &images)?,
    };
    let seed = context.config.stage_seed(Stage::Match);
    let verified: Vec<Result<MatchedPair, NotVerified>> = pairs
        .par_iter()
        .enumerate()
        .map(|(at, pair)| {
            context.cancel.check()?;
            let (first, second) = (pair.first(), pair.second());
            let matches = match &imported {
                Some(imported) => Cow::Borrowed(imported[at].as_slice()),
                None => Cow::Owned(match_prepared(&prepared[&first], &prepared[&second], options)),
            };
            let candidate = Candidate {
                pair: *pair,
                first: View { camera: table.camera_of(first), keypoints: &images[&first].keypoints },
                second: View { camera: table.camera_of(second), keypoints: &images[&second].keypoints },
                matches: &matches,
            };
            Ok(verify(&candidate, &verification, seed))
        })
        .collect::<Result<_, PipelineError>>()?;
    let mut made = MatchBlock::default();
    for outcome in verified {
        match outcome {
            Ok(pair) => made.pairs.push(pair),
            Err(reason) => *made.refused.entry(reason_name(&reason).to_owned()).or_default() += 1,
        }
    }
    let counts = vec![
        ("pairs", pairs.len() as u64),
        ("verified", made.pairs.len() as u64),
        ("matches", made.pairs.iter().map(|pair| pair.matches.len() as u64).sum()),
    ];
    Ok(Made { bytes: codec::encode_match_block(&made).map_err(encode_error)?, counts })
}

/// Descriptors as the matcher wants them, once an image of the block.
fn prepared(
    context: &ExecutionContext,
    images: &BTreeMap<ImageId, Features>,
) -> Result<BTreeMap<ImageId, PreparedImage>, PipelineError> {
    let kinds: BTreeSet<DescriptorKind> =
        images.values().filter(|features| !features.is_empty()).map(|features| features.kind).collect();
    if kinds.len() > 1 {
        let names: Vec<_> = kinds.iter().map(|kind| kind.name()).collect();
        return Err(PipelineError::bug(format!("descriptors of {} can't be matched", names.join(" and "))));
    }
    let prepare = |(image, features): (&ImageId, &Features)| {
        context.cancel.check()?;
        Ok((*image, PreparedImage::new(features, &context.config.matching.matching)))
    };
    images.par_iter().map(prepare).collect()
}

/// The reason without its numbers, to count by.
fn reason_name(reason: &NotVerified) -> &'static str {
    match reason {
        NotVerified::TooFewMatches { .. } => "too_few_matches",
        NotVerified::TooFewInliers { .. } => "too_few_inliers",
    }
}
