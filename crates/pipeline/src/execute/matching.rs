//! The match stage: a block of pairs, whose images are read and prepared once.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};

use rayon::prelude::*;
use terrane_frontend::matching::{Match, PreparedImage, match_prepared};
use terrane_frontend::verification::{
    GuidedMatching, NotVerified, Photograph, VerificationOptions, match_and_verify,
};
use terrane_geometry::Seed;
use terrane_geometry::ransac::SampleOrder;
use terrane_scene::codec::{self, MatchBlock};
use terrane_scene::{DescriptorKind, Features, ImageId, ImagePair, ImageTable, MatchedPair};

use super::{ExecutionContext, Made, encode_error, import, read};
use crate::task::FeatureSet;
use crate::{ArtefactKey, PipelineError, Stage, Store};

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
    let images = images_of(store, features, pairs)?;
    let imported = inputs.imported_matches();
    let imported = imported.map(|imported| import::matches(context, imported, pairs)).transpose()?;
    let matcher = Matcher::new(context, &table, &images, imported)?;
    let verified: Vec<Result<MatchedPair, NotVerified>> = pairs
        .par_iter()
        .enumerate()
        .map(|(at, pair)| {
            context.cancel.check()?;
            Ok(matcher.verified(at, *pair))
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

/// The features of all images of some pairs.
fn images_of(
    store: &Store,
    features: &FeatureSet,
    pairs: &[ImagePair],
) -> Result<BTreeMap<ImageId, Features>, PipelineError> {
    let mut images = BTreeMap::new();
    for image in pairs.iter().flat_map(|pair| [pair.first(), pair.second()]) {
        if let Entry::Vacant(vacant) = images.entry(image) {
            vacant.insert(read::features(store, features, image)?);
        }
    }
    Ok(images)
}

/// What the pairs of a block have in common.
struct Matcher<'a> {
    context: &'a ExecutionContext,
    table: &'a ImageTable,
    images: &'a BTreeMap<ImageId, Features>,
    /// Empty where matches are imported.
    prepared: BTreeMap<ImageId, PreparedImage>,
    /// By place in the block.
    imported: Option<Vec<Vec<Match>>>,
    verification: VerificationOptions,
    seed: Seed,
}

impl<'a> Matcher<'a> {
    fn new(
        context: &'a ExecutionContext,
        table: &'a ImageTable,
        images: &'a BTreeMap<ImageId, Features>,
        imported: Option<Vec<Vec<Match>>>,
    ) -> Result<Self, PipelineError> {
        let mut verification = context.config.matching.verification.clone();
        if imported.is_some() {
            // No match is known to be better than another: their order says nothing.
            verification.ransac.order = SampleOrder::Uniform;
            verification.guided = GuidedMatching::Off;
        }
        let prepared = match &imported {
            Some(_) => BTreeMap::new(),
            None => prepared(context, images)?,
        };
        let seed = context.config.stage_seed(Stage::Match);
        Ok(Self { context, table, images, prepared, imported, verification, seed })
    }

    /// The pair at a place of the block.
    fn verified(&self, at: usize, pair: ImagePair) -> Result<MatchedPair, NotVerified> {
        let options = &self.context.config.matching.matching;
        let side = |image: ImageId| Photograph {
            camera: self.table.camera_of(image),
            features: &self.images[&image],
        };
        let both = [&side(pair.first()), &side(pair.second())];
        let match_all = || match &self.imported {
            Some(imported) => imported[at].clone(),
            None => match_prepared(&self.prepared[&pair.first()], &self.prepared[&pair.second()], options),
        };
        match_and_verify(pair, both, match_all, options, &self.verification, self.seed)
    }
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
