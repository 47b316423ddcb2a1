//! Which photographs look alike: retrieval's parts, fed from the store an image at a time.

use rayon::prelude::*;
use terrane_frontend::retrieval::{self, CompactDescriptors, Projection, Similar, Sketch, Vocabulary};
use terrane_geometry::Seed;
use terrane_scene::{DESCRIPTOR_LEN, ImageId};

use super::ExecutionContext;
use super::read;
use crate::task::FeatureSet;
use crate::{PipelineError, Stage, Store};

/// What the descriptors that a projection is learnt from may take.
const TRAINING_BYTES: usize = 64 << 20;
/// Images whose descriptors are computed together.
const CHUNK: usize = 256;

/// The most similar images of those wanted. Features are read once for the images that are learnt from, once for all, and
/// once more for each look at local features; never more than some hundred images at a time.
pub(super) fn similar_images(
    store: &Store,
    context: &ExecutionContext,
    features: &FeatureSet,
    wanted: &[bool],
) -> Result<Vec<Vec<Similar>>, PipelineError> {
    let seed = context.config.stage_seed(Stage::Pairs);
    let options = &context.config.pairs;
    let load = |image: ImageId| {
        context.cancel.check()?;
        read::features(store, features, image)
    };
    let training = training_images(wanted.len(), options.retrieval.training_images as usize, seed);
    let vocabulary = match options.vocabulary.given().map_err(PipelineError::invalid_input)? {
        Some(given) => given,
        None => {
            let per_image = (options.vocabulary.num_samples as usize).div_ceil(training.len().max(1));
            let mut sampled = Vec::new();
            for image in &training {
                let seed = seed.item(&[u64::from(image.0)]);
                sampled.extend(retrieval::sample(&load(*image)?, per_image, seed));
            }
            Vocabulary::train(&sampled, &options.vocabulary, seed.derive("vocabulary"))
        }
    };
    let affordable = TRAINING_BYTES / (vocabulary.num_words() * DESCRIPTOR_LEN * size_of::<f32>()).max(1);
    let learnt_from = &training[..training.len().min(affordable.max(2))];
    let encoded: Vec<Vec<f32>> = learnt_from
        .par_iter()
        .map(|image| Ok(vocabulary.encode(&load(*image)?)))
        .collect::<Result<_, PipelineError>>()?;
    let projection =
        Projection::train(&encoded, options.retrieval.dimensions as usize, seed.derive("projection"));
    drop(encoded);
    let mut descriptors = CompactDescriptors::new(projection.dimensions());
    let images: Vec<ImageId> = (0..wanted.len()).map(ImageId::from_index).collect();
    for chunk in images.chunks(CHUNK) {
        let projected: Vec<Vec<f32>> = chunk
            .par_iter()
            .map(|image| Ok(projection.project(&vocabulary.encode(&load(*image)?))))
            .collect::<Result<_, PipelineError>>()?;
        projected.iter().for_each(|numbers| descriptors.push(numbers));
    }
    let looked_at = options.retrieval.candidates as usize;
    let count = looked_at.max(options.select.retrieval_neighbours as usize);
    let similar = retrieval::nearest(&descriptors, |image| wanted[image], count, seed.derive("nearest"));
    if looked_at == 0 {
        return Ok(similar);
    }
    let local_features = options.retrieval.local_features as usize;
    retrieval::refine(similar, count, &options.retrieval, |image| {
        Ok(Sketch::new(&load(ImageId::from_index(image))?, local_features))
    })
}

/// Images to learn from, in a random order, so that any first part of them is a fair sample.
fn training_images(num_images: usize, count: usize, seed: Seed) -> Vec<ImageId> {
    let key = |image: &ImageId| (seed.derive("training").item(&[u64::from(image.0)]).0, image.0);
    let mut images: Vec<ImageId> = (0..num_images).map(ImageId::from_index).collect();
    images.sort_by_cached_key(key);
    images.truncate(count);
    images
}
