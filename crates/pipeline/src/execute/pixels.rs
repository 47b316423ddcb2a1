//! The stages that look at pixels and descriptors: features, pairs, match.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

use rayon::prelude::*;
use terrane_frontend::verification::{NotVerified, Photograph, match_and_verify};
use terrane_frontend::{image, matching, pairs, retrieval, sift};
use terrane_geometry::Seed;
use terrane_scene::codec::{self, FeatureBatchWriter, MatchBlock};
use terrane_scene::{Features, ImageId, ImagePair, ImageTable, MatchedPair};

use super::read::{self, PairsInfo};
use super::{ExecutionContext, Made, encode_error};
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
    let table = context.table(store, table_key)?;
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
        let computed: Vec<Result<Result<Features, String>, PipelineError>> =
            chunk.par_iter().map(|image| features_of(context, &table, *image)).collect();
        for outcome in computed {
            let outcome = outcome?;
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
    table: &ImageTable,
    image: ImageId,
) -> Result<Result<Features, String>, PipelineError> {
    let record = table.image(image);
    let path = context.config.photos.join(&record.path);
    let bytes = std::fs::read(&path)
        .map_err(|error| PipelineError::io(&format!("can't read {}", path.display()), &error))?;
    if crate::key::hex(blake3::hash(&bytes).as_bytes()) != record.content_hash {
        return Err(PipelineError::invalid_input(format!(
            "{} changed during the run: run again to begin with the new file",
            path.display()
        )));
    }
    let options = &context.config.features;
    Ok(match image::decode(&bytes, &options.decode) {
        Ok(decoded) => Ok(sift::extract(&decoded.luma, decoded.rgb.as_ref(), &options.sift)),
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
    let table = context.table(store, table_key)?;
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
    let global = match pairs::needs_global_descriptors(&table, &options.select) {
        true => Some(global_descriptors(store, context, features, table.images.len())?),
        false => None,
    };
    let selection = pairs::select(&table, global.as_deref(), &options.select);
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

/// One global descriptor an image, from a vocabulary trained on the run. Batches are read twice, one at a time.
fn global_descriptors(
    store: &Store,
    context: &ExecutionContext,
    features: &FeatureSet,
    num_images: usize,
) -> Result<Vec<Vec<f32>>, PipelineError> {
    let seed = context.config.stage_seed(Stage::Pairs);
    let options = &context.config.pairs.vocabulary;
    let per_image = (options.num_samples as usize).div_ceil(num_images.max(1));
    let images: Vec<ImageId> = (0..num_images).map(ImageId::from_index).collect();
    let mut sampled = Vec::new();
    for image in &images {
        context.cancel.check()?;
        let found = read::features(store, features, *image)?;
        sampled.extend(retrieval::sample(&found, per_image, seed.item(&[u64::from(image.0)])));
    }
    let vocabulary = retrieval::Vocabulary::train(&sampled, options, seed.derive("vocabulary"));
    images
        .par_iter()
        .map(|image| {
            context.cancel.check()?;
            Ok(vocabulary.encode(&read::features(store, features, *image)?))
        })
        .collect()
}

pub(super) fn matching(
    store: &Store,
    context: &ExecutionContext,
    (table_key, pairs_key): (&ArtefactKey, &ArtefactKey),
    block: u32,
    features: &FeatureSet,
) -> Result<Made, PipelineError> {
    let table = context.table(store, table_key)?;
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
    let seed = context.config.stage_seed(Stage::Match);
    let verified: Vec<Result<MatchedPair, NotVerified>> = pairs
        .par_iter()
        .map(|pair| {
            context.cancel.check()?;
            Ok(match_pair(context, &table, &images, *pair, seed))
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

fn match_pair(
    context: &ExecutionContext,
    table: &ImageTable,
    images: &BTreeMap<ImageId, Features>,
    pair: ImagePair,
    seed: Seed,
) -> Result<MatchedPair, NotVerified> {
    let options = &context.config.matching;
    let (first, second) = (&images[&pair.first()], &images[&pair.second()]);
    let side = |image: ImageId| Photograph { camera: table.camera_of(image), features: &images[&image] };
    let both = [&side(pair.first()), &side(pair.second())];
    let match_all = || matching::match_features(first, second, &options.matching);
    match_and_verify(pair, both, match_all, &options.matching, &options.verification, seed)
}

/// The reason without its numbers, to count by.
fn reason_name(reason: &NotVerified) -> &'static str {
    match reason {
        NotVerified::TooFewMatches { .. } => "too_few_matches",
        NotVerified::TooFewInliers { .. } => "too_few_inliers",
    }
}
