//! Artefacts from the store as values. Every error names the artefact, so that a corrupt one can be computed again.

use std::ops::Range;

use bytes::Bytes;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use terrane_frontend::pairs::PairReport;
use terrane_fusion::align::SeamOutcome;
use terrane_fusion::average::Placement;
use terrane_scene::codec::{self, Archive, FeatureBatchReader, Kind, Source, Tag};
use terrane_scene::{
    Features, ImageId, ImagePair, ImageTable, Keypoint, MatchedPair, PairSummary, Reconstruction, SceneError,
    SubmapOutcome,
};
use terrane_viewgraph::{Partition, ViewGraph};

use super::Inputs;
use crate::plan::RunFigures;
use crate::task::FeatureSet;
use crate::{ArtefactKey, PipelineError, Store};

pub(crate) const TABLE: Tag = Tag(*b"TABL");
pub(crate) const INPUTS: Tag = Tag(*b"INPT");
pub(crate) const GRAPH: Tag = Tag(*b"GRPH");
pub(crate) const PARTITION: Tag = Tag(*b"PART");
pub(crate) const SEAMS: Tag = Tag(*b"SEAM");
pub(crate) const PLACEMENT: Tag = Tag(*b"PLAC");
pub(crate) const SHARED: Tag = Tag(*b"SHRD");
pub(crate) const REPORT: Tag = Tag(*b"REPT");
pub(crate) const FIGURES: Tag = Tag(*b"FIGS");
pub(crate) const FINISHED: Tag = Tag(*b"FINI");

/// An artefact in the store, read by ranges.
pub(crate) struct StoredArtefact<'a> {
    store: &'a Store,
    path: String,
    len: u64,
}

impl<'a> StoredArtefact<'a> {
    pub fn new(store: &'a Store, key: &ArtefactKey) -> Result<Self, PipelineError> {
        let path = key.path();
        let len = store.head(&path)?.ok_or_else(|| PipelineError::missing(*key))?;
        Ok(Self { store, path, len })
    }
}

impl Source for StoredArtefact<'_> {
    fn len(&self) -> u64 {
        self.len
    }

    fn read(
        &self,
        ranges: &[Range<u64>],
    ) -> Result<Vec<Box<dyn AsRef<[u8]> + '_>>, Box<dyn std::error::Error + Send + Sync>> {
        let parts = self.store.get_ranges(&self.path, ranges)?;
        let parts = parts.ok_or_else(|| PipelineError::storage(format!("{} is gone", self.path)))?;
        Ok(parts.into_iter().map(|part| Box::new(part) as Box<dyn AsRef<[u8]>>).collect())
    }
}

/// The codec's error as ours: the store's own error when that is what failed.
pub(crate) fn scene_error(key: ArtefactKey) -> impl Fn(SceneError) -> PipelineError {
    move |error| match error.into_source() {
        Ok(source) => match source.downcast::<PipelineError>() {
            Ok(ours) => *ours,
            Err(other) => PipelineError::storage(format!("artefact {key} can't be read: {other}")),
        },
        Err(error) => PipelineError::codec(key, &error),
    }
}

fn whole(store: &Store, key: &ArtefactKey) -> Result<Bytes, PipelineError> {
    store.get(&key.path())?.ok_or_else(|| PipelineError::missing(*key))
}

/// One record of an artefact.
pub(crate) fn record<T: DeserializeOwned>(
    store: &Store,
    key: &ArtefactKey,
    kind: Kind,
    tag: Tag,
) -> Result<T, PipelineError> {
    let archive = Archive::open(StoredArtefact::new(store, key)?, kind).map_err(scene_error(*key))?;
    archive.json(tag, 0).map_err(scene_error(*key))
}

/// The image table with what keys are made of.
pub(crate) struct TableArtefact {
    pub table: ImageTable,
    /// Hash of the table.
    pub digest: [u8; 32],
    /// Hash of each image's id and camera: what matching reads of it beside its features.
    pub image_digests: Vec<[u8; 32]>,
    /// What is read beside photographs.
    pub inputs: Inputs,
}

pub(crate) fn table(store: &Store, key: &ArtefactKey) -> Result<TableArtefact, PipelineError> {
    let failed = scene_error(*key);
    let archive = Archive::open(StoredArtefact::new(store, key)?, Kind::Record).map_err(&failed)?;
    let table: ImageTable = archive.json(TABLE, 0).map_err(&failed)?;
    let inputs = match archive.has(INPUTS, 0) {
        true => archive.json(INPUTS, 0).map_err(&failed)?,
        false => Inputs::default(),
    };
    let encode =
        |value: serde_json::Result<Vec<u8>>| value.map_err(|error| PipelineError::bug(error.to_string()));
    let digest = *blake3::hash(&encode(serde_json::to_vec(&table))?).as_bytes();
    let mut cameras = Vec::with_capacity(table.cameras.len());
    for camera in &table.cameras {
        cameras.push(*blake3::hash(&encode(serde_json::to_vec(camera))?).as_bytes());
    }
    let mut image_digests = Vec::with_capacity(table.images.len());
    for (at, image) in table.images.iter().enumerate() {
        let camera = cameras.get(image.camera.index()).ok_or_else(|| {
            PipelineError::codec(*key, &SceneError::from(std::io::Error::other("an image has no camera")))
        })?;
        let mut hasher = blake3::Hasher::new();
        hasher.update(&(at as u64).to_le_bytes());
        hasher.update(camera);
        image_digests.push(*hasher.finalize().as_bytes());
    }
    Ok(TableArtefact { table, digest, image_digests, inputs })
}

/// How pairs were chosen, and which images have no features.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct PairsInfo {
    /// Where they came from.
    pub report: PairReport,
    /// Pairs of all blocks.
    pub num_pairs: u64,
    /// Images whose pixels could not be used, ascending, with the reason.
    pub rejected: Vec<(ImageId, String)>,
    /// Features of each image.
    pub num_features: Vec<u32>,
}

pub(crate) fn pairs(
    store: &Store,
    key: &ArtefactKey,
) -> Result<(Vec<Vec<ImagePair>>, PairsInfo), PipelineError> {
    codec::decode_pair_blocks(whole(store, key)?.as_ref()).map_err(scene_error(*key))
}

pub(crate) fn batch<'a>(
    store: &'a Store,
    key: &ArtefactKey,
) -> Result<FeatureBatchReader<StoredArtefact<'a>>, PipelineError> {
    FeatureBatchReader::open(StoredArtefact::new(store, key)?).map_err(scene_error(*key))
}

/// All features of an image; empty when its batch is lost.
pub(crate) fn features(store: &Store, set: &FeatureSet, image: ImageId) -> Result<Features, PipelineError> {
    match set.locate(image) {
        Some((key, place)) => batch(store, &key)?.features(place).map_err(scene_error(key)),
        None => Ok(Features::default()),
    }
}

/// Keypoints and colours of an image; empty when its batch is lost.
pub(crate) fn keypoints(
    store: &Store,
    set: &FeatureSet,
    image: ImageId,
) -> Result<(Vec<Keypoint>, Vec<[u8; 3]>), PipelineError> {
    match set.locate(image) {
        Some((key, place)) => batch(store, &key)?.keypoints_and_colors(place).map_err(scene_error(key)),
        None => Ok(Default::default()),
    }
}

pub(crate) fn pair_summaries(
    store: &Store,
    key: &ArtefactKey,
) -> Result<(Vec<PairSummary>, std::collections::BTreeMap<String, u64>), PipelineError> {
    codec::read_pair_summaries(StoredArtefact::new(store, key)?).map_err(scene_error(*key))
}

pub(crate) fn matches(
    store: &Store,
    key: &ArtefactKey,
    wanted: impl Fn(ImagePair) -> bool,
) -> Result<Vec<MatchedPair>, PipelineError> {
    codec::read_matches(StoredArtefact::new(store, key)?, wanted).map_err(scene_error(*key))
}

pub(crate) fn view_graph(store: &Store, key: &ArtefactKey) -> Result<ViewGraph, PipelineError> {
    record(store, key, Kind::Record, GRAPH)
}

pub(crate) fn partition(store: &Store, key: &ArtefactKey) -> Result<Partition, PipelineError> {
    record(store, key, Kind::Record, PARTITION)
}

pub(crate) fn submap(store: &Store, key: &ArtefactKey) -> Result<SubmapOutcome, PipelineError> {
    codec::decode_submap(whole(store, key)?.as_ref()).map_err(scene_error(*key))
}

/// The seams between the submaps of two clusters: place in the one, place in the other, outcome.
pub(crate) fn seams(store: &Store, key: &ArtefactKey) -> Result<Vec<(u32, u32, SeamOutcome)>, PipelineError> {
    record(store, key, Kind::Record, SEAMS)
}

/// Where submaps lie. Submaps are numbered by cluster, then by place in it.
pub(crate) fn placement(store: &Store, key: &ArtefactKey) -> Result<Placement, PipelineError> {
    record(store, key, Kind::Reconstruction, PLACEMENT)
}

/// Images of each component, most first.
pub(crate) fn component_sizes(store: &Store, key: &ArtefactKey) -> Result<Vec<u64>, PipelineError> {
    let placement = placement(store, key)?;
    Ok(placement.components.iter().map(|component| u64::from(component.num_images)).collect())
}

/// An artefact of cameras and shards, read one by one.
pub(crate) struct Sharded<'a> {
    key: ArtefactKey,
    archive: Archive<StoredArtefact<'a>>,
    num_shards: u32,
}

impl<'a> Sharded<'a> {
    pub fn open(store: &'a Store, key: &ArtefactKey) -> Result<Self, PipelineError> {
        let source = StoredArtefact::new(store, key)?;
        let archive = Archive::open(source, Kind::Reconstruction).map_err(scene_error(*key))?;
        let num_shards = archive.json(Tag(*b"NUMS"), 0).map_err(scene_error(*key))?;
        Ok(Self { key: *key, archive, num_shards })
    }

    pub fn num_shards(&self) -> usize {
        self.num_shards as usize
    }

    /// Cameras and images, without points.
    pub fn cameras(&self) -> Result<Reconstruction, PipelineError> {
        codec::read_reconstruction(&self.archive, 0).map_err(scene_error(self.key))
    }

    /// Points and tracks of a shard, without cameras.
    pub fn shard(&self, shard: usize) -> Result<Reconstruction, PipelineError> {
        codec::read_reconstruction(&self.archive, shard as u32 + 1).map_err(scene_error(self.key))
    }

    pub fn record<T: DeserializeOwned>(&self, tag: Tag) -> Result<T, PipelineError> {
        self.archive.json(tag, 0).map_err(scene_error(self.key))
    }
}

pub(crate) fn figures(store: &Store, key: &ArtefactKey) -> Result<RunFigures, PipelineError> {
    record(store, key, Kind::Record, FIGURES)
}
