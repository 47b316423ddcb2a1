//! What a cluster became: its submaps and the fate of each image.

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::{Archive, ArchiveWriter, Kind, Source, Tag, read_reconstruction, write_reconstruction};
use crate::{ClusterId, ImageFate, ImageId, SceneError, Submap, SubmapOutcome};

const CLUSTER: Tag = Tag(*b"CLUS");
const FATES: Tag = Tag(*b"FATE");
const REPORT: Tag = Tag(*b"REPT");

/// The bytes of an outcome, with a report of how it came to be.
///
/// # Errors
/// As [`write_reconstruction`].
pub fn encode_submap<T: Serialize>(outcome: &SubmapOutcome, report: &T) -> Result<Vec<u8>, SceneError> {
    let mut archive = ArchiveWriter::new(Kind::Submap);
    archive.json(CLUSTER, 0, &(outcome.cluster, outcome.submaps.len() as u32))?;
    archive.json(FATES, 0, &outcome.fates)?;
    archive.json(REPORT, 0, report)?;
    for (item, submap) in outcome.submaps.iter().enumerate() {
        write_reconstruction(&mut archive, item as u32, &submap.reconstruction)?;
    }
    Ok(archive.finish())
}

/// The outcome of an artefact.
///
/// # Errors
/// As [`Archive::open`] and [`read_reconstruction`].
pub fn decode_submap(source: impl Source) -> Result<SubmapOutcome, SceneError> {
    let archive = Archive::open(source, Kind::Submap)?;
    let (cluster, count): (ClusterId, u32) = archive.json(CLUSTER, 0)?;
    let fates: Vec<(ImageId, ImageFate)> = archive.json(FATES, 0)?;
    let mut submaps = Vec::new();
    for item in 0..count {
        submaps.push(Submap { reconstruction: read_reconstruction(&archive, item)? });
    }
    Ok(SubmapOutcome { cluster, submaps, fates })
}

/// The fate of each image of the cluster and the report, without cameras and points.
///
/// # Errors
/// As [`Archive::open`].
pub fn read_submap_report<T: DeserializeOwned>(
    source: impl Source,
) -> Result<(Vec<(ImageId, ImageFate)>, T), SceneError> {
    let archive = Archive::open(source, Kind::Submap)?;
    Ok((archive.json(FATES, 0)?, archive.json(REPORT, 0)?))
}
