//! Shards of points between stages, and on the local disk while they are adjusted.

use std::borrow::Cow;
use std::path::PathBuf;

use terrane_fusion::FusionError;
use terrane_fusion::adjust::MergedShards;
use terrane_fusion::merge::{MergedCameras, MergedShard};
use terrane_scene::Reconstruction;
use terrane_scene::codec::{self, ArchiveWriter, Tag};

use super::read::Sharded;
use super::{Made, encode_error};
use crate::PipelineError;

/// How many shards the artefact has.
pub(super) const NUM_SHARDS: Tag = Tag(*b"NUMS");

/// Finishes an artefact of cameras (item 0) and shards (items 1 and on).
pub(super) fn write_sharded(
    mut archive: ArchiveWriter,
    cameras: &MergedCameras,
    shards: &[MergedShard],
    counts: Vec<(&'static str, u64)>,
) -> Result<Made, PipelineError> {
    let part = Reconstruction {
        cameras: cameras.cameras.clone(),
        images: cameras.images.clone(),
        ..Default::default()
    };
    codec::write_reconstruction(&mut archive, 0, &part).map_err(encode_error)?;
    for (place, shard) in shards.iter().enumerate() {
        let part = reconstruction_of(shard.clone());
        codec::write_reconstruction(&mut archive, place as u32 + 1, &part).map_err(encode_error)?;
    }
    archive.json(NUM_SHARDS, 0, &(shards.len() as u32)).map_err(encode_error)?;
    Ok(Made { bytes: archive.finish(), counts })
}

pub(super) fn merged_shard(part: Reconstruction) -> MergedShard {
    MergedShard { points: part.points, observations: part.observations }
}

fn reconstruction_of(shard: MergedShard) -> Reconstruction {
    Reconstruction { points: shard.points, observations: shard.observations, ..Default::default() }
}

/// Shards that are adjusted: a single one stays in memory, several lie in a folder of their own on the local disk, so that
/// one at a time is in memory. The folder goes with the value.
pub(super) enum ShardFolder {
    One(Box<MergedShard>),
    Disk { folder: tempfile::TempDir, count: usize },
}

impl ShardFolder {
    /// The shards of an artefact.
    pub fn load(sharded: &Sharded<'_>) -> Result<Self, PipelineError> {
        if sharded.num_shards() == 1 {
            return Ok(Self::One(Box::new(merged_shard(sharded.shard(0)?))));
        }
        let folder = tempfile::Builder::new()
            .prefix("terrane-shards-")
            .tempdir()
            .map_err(|error| PipelineError::io("can't make a temporary folder for shards", &error))?;
        let count = sharded.num_shards();
        let mut shards = Self::Disk { folder, count };
        for shard in 0..count {
            let loaded = merged_shard(sharded.shard(shard)?);
            shards.store(shard, loaded).map_err(|error| PipelineError::storage(error.to_string()))?;
        }
        Ok(shards)
    }

    /// Every shard, to be written.
    pub fn into_shards(self) -> Result<Vec<MergedShard>, PipelineError> {
        (0..self.len())
            .map(|shard| {
                let loaded =
                    self.load_shard(shard).map_err(|error| PipelineError::storage(error.to_string()))?;
                Ok(loaded.into_owned())
            })
            .collect()
    }

    fn file(&self, shard: usize) -> Option<PathBuf> {
        match self {
            Self::One(_) => None,
            Self::Disk { folder, .. } => Some(folder.path().join(format!("{shard}.shard"))),
        }
    }

    fn load_shard(&self, shard: usize) -> Result<Cow<'_, MergedShard>, FusionError> {
        let failed = |reason: &dyn std::fmt::Display| FusionError::shard(shard, "read", reason);
        match self {
            Self::One(only) if shard == 0 => Ok(Cow::Borrowed(only)),
            _ => {
                let file = self.file(shard).ok_or_else(|| failed(&"there is no such shard"))?;
                let bytes = std::fs::read(file).map_err(|error| failed(&error))?;
                let part = codec::decode_reconstruction(bytes.as_slice()).map_err(|error| failed(&error))?;
                Ok(Cow::Owned(merged_shard(part)))
            }
        }
    }
}

impl MergedShards for ShardFolder {
    fn len(&self) -> usize {
        match self {
            Self::One(_) => 1,
            Self::Disk { count, .. } => *count,
        }
    }

    fn load(&self, shard: usize) -> Result<Cow<'_, MergedShard>, FusionError> {
        self.load_shard(shard)
    }

    fn store(&mut self, shard: usize, value: MergedShard) -> Result<(), FusionError> {
        let failed = |reason: &dyn std::fmt::Display| FusionError::shard(shard, "written", reason);
        let file = self.file(shard);
        match (self, file) {
            (Self::One(only), _) if shard == 0 => **only = value,
            (_, Some(file)) => {
                let bytes = codec::encode_reconstruction(&reconstruction_of(value))
                    .map_err(|error| failed(&error))?;
                std::fs::write(file, bytes).map_err(|error| failed(&error))?;
            }
            _ => return Err(failed(&"there is no such shard")),
        }
        Ok(())
    }
}
