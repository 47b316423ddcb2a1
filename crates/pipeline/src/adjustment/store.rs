//! Parts of an adjustment as artefacts of a store.

use bytes::Bytes;
use nalgebra::Vector3;
use terrane_optim::bundle::ShardError;
use terrane_optim::bundle::implicit::{Part, PartStore};
use terrane_scene::codec::{Archive, ArchiveWriter, Kind, Packing, Tag};

use crate::{PipelineError, Store};

const POSES: Tag = Tag(*b"pose");
const FIRST: Tag = Tag(*b"frst");
const POINT_OF: Tag = Tag(*b"pnof");
const XY: Tag = Tag(*b"xypx");
const POINTS: Tag = Tag(*b"pnts");
const FIXED: Tag = Tag(*b"fixd");

/// The parts of one adjustment in a folder of a store. Points of a step that is tried are written beside those of the
/// accepted one, so that whoever takes a part over finds it as it was accepted.
#[derive(Clone, Debug)]
pub struct StoredParts {
    store: Store,
    folder: String,
}

impl StoredParts {
    /// Parts in a folder of a store, which need not exist.
    pub fn new(store: Store, folder: impl Into<String>) -> Self {
        Self { store, folder: folder.into() }
    }

    /// Writes a part as it is at the start.
    ///
    /// # Errors
    /// When the store can't be written.
    pub fn put(&self, index: u32, part: &Part) -> Result<(), PipelineError> {
        let bytes = encode_part(part).map_err(|error| PipelineError::invalid_input(error.to_string()))?;
        self.store.put(&self.part_name(index), bytes)
    }

    /// Deletes everything that was written for these parts.
    ///
    /// # Errors
    /// When the store refuses.
    pub fn clear(&self) -> Result<(), PipelineError> {
        for (name, _) in self.store.list(&self.folder)? {
            self.store.delete(&name)?;
        }
        Ok(())
    }

    fn part_name(&self, index: u32) -> String {
        format!("{}/part-{index:06}", self.folder)
    }

    fn points_name(&self, index: u32, step: u64) -> String {
        format!("{}/points-{index:06}-{step}", self.folder)
    }

    fn read(&self, index: u32, name: &str) -> Result<Bytes, ShardError> {
        let found = self.store.get(name).map_err(|error| failed(index, error))?;
        found.ok_or_else(|| ShardError {
            shard: index as usize,
            reason: format!(
                "{name} is not in store {}: the adjustment must be started again",
                self.store.place()
            ),
            source: None,
        })
    }
}

impl PartStore for StoredParts {
    fn load(&self, part: u32) -> Result<Part, ShardError> {
        let bytes = self.read(part, &self.part_name(part))?;
        decode_part(&bytes).map_err(|error| failed(part, error))
    }

    fn load_points(&self, part: u32, step: u64) -> Result<Vec<Vector3<f64>>, ShardError> {
        let bytes = self.read(part, &self.points_name(part, step))?;
        let archive = Archive::open(&bytes[..], Kind::AdjustmentPart).map_err(|error| failed(part, error))?;
        archive.column::<Vector3<f64>>(POINTS, 0).map_err(|error| failed(part, error))
    }

    fn store_points(&self, part: u32, step: u64, points: &[Vector3<f64>]) -> Result<(), ShardError> {
        let mut archive = ArchiveWriter::new(Kind::AdjustmentPart);
        archive.column(POINTS, 0, points, Packing::Raw).map_err(|error| failed(part, error))?;
        self.store
            .put(&self.points_name(part, step), archive.finish())
            .map_err(|error| failed(part, error))?;
        if let Some(before) = step.checked_sub(2).filter(|before| *before > 0) {
            // Neither accepted any more nor tried.
            self.store.delete(&self.points_name(part, before)).map_err(|error| failed(part, error))?;
        }
        Ok(())
    }
}

fn failed(part: u32, error: impl std::error::Error + Send + Sync + 'static) -> ShardError {
    ShardError { shard: part as usize, reason: error.to_string(), source: Some(Box::new(error)) }
}

fn encode_part(part: &Part) -> Result<Vec<u8>, terrane_scene::SceneError> {
    let mut archive = ArchiveWriter::new(Kind::AdjustmentPart);
    archive.column(POSES, 0, &part.poses, Packing::Raw)?;
    archive.column(FIRST, 0, &part.first_observation, Packing::Raw)?;
    archive.column(POINT_OF, 0, &part.point_of, Packing::Raw)?;
    archive.column(XY, 0, &part.xy_px, Packing::Raw)?;
    archive.column(POINTS, 0, &part.points, Packing::Raw)?;
    archive.column(FIXED, 0, &[part.first_fixed_point], Packing::Raw)?;
    Ok(archive.finish())
}

/// Sizes and indices are checked by whoever takes the part ([`Part::validate`]).
fn decode_part(bytes: &[u8]) -> Result<Part, terrane_scene::SceneError> {
    let archive = Archive::open(bytes, Kind::AdjustmentPart)?;
    let fixed: Vec<u32> = archive.column(FIXED, 0)?;
    Ok(Part {
        poses: archive.column(POSES, 0)?,
        first_observation: archive.column(FIRST, 0)?,
        point_of: archive.column(POINT_OF, 0)?,
        xy_px: archive.column(XY, 0)?,
        points: archive.column(POINTS, 0)?,
        first_fixed_point: fixed.first().copied().unwrap_or(0),
    })
}
