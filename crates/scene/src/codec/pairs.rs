//! Candidate pairs in blocks that share images.

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::{Archive, ArchiveWriter, Kind, Packing, Source, Tag};
use crate::{ImageId, ImagePair, SceneError};

const PAIRS: Tag = Tag(*b"PAIR");
const LENGTHS: Tag = Tag(*b"BLKS");
const INFO: Tag = Tag(*b"INFO");

/// The bytes of blocks of pairs with a record about how they were chosen.
///
/// # Errors
/// As [`ArchiveWriter::column`].
pub fn encode_pair_blocks<T: Serialize>(blocks: &[Vec<ImagePair>], info: &T) -> Result<Vec<u8>, SceneError> {
    let mut archive = ArchiveWriter::new(Kind::Pairs);
    let rows: Vec<[u32; 2]> = blocks.iter().flatten().map(|pair| [pair.first().0, pair.second().0]).collect();
    let lengths: Vec<u32> = blocks.iter().map(|block| block.len() as u32).collect();
    archive.column(PAIRS, 0, &rows, Packing::Zstd)?;
    archive.column(LENGTHS, 0, &lengths, Packing::Zstd)?;
    archive.json(INFO, 0, info)?;
    Ok(archive.finish())
}

/// The blocks and the record.
///
/// # Errors
/// As [`Archive::open`].
pub fn decode_pair_blocks<T: DeserializeOwned>(
    source: impl Source,
) -> Result<(Vec<Vec<ImagePair>>, T), SceneError> {
    let archive = Archive::open(source, Kind::Pairs)?;
    let rows = archive.column::<[u32; 2]>(PAIRS, 0)?;
    let lengths = archive.column::<u32>(LENGTHS, 0)?;
    let mut rest = rows.as_slice();
    let mut blocks = Vec::with_capacity(lengths.len());
    for length in lengths {
        let (block, after) = rest
            .split_at_checked(length as usize)
            .ok_or_else(|| SceneError::corrupt("a block claims more pairs than there are"))?;
        rest = after;
        let pair = |row: &[u32; 2]| {
            ImagePair::new(ImageId(row[0]), ImageId(row[1]))
                .ok_or_else(|| SceneError::corrupt(format!("image {} is paired with itself", row[0])))
        };
        blocks.push(block.iter().map(pair).collect::<Result<Vec<_>, _>>()?);
    }
    if !rest.is_empty() {
        return Err(SceneError::corrupt("some pairs belong to no block"));
    }
    Ok((blocks, archive.json(INFO, 0)?))
}
