//! The container of every artefact.
//!
//! Little-endian throughout. A header of 64 bytes, a table of 48 bytes a section, then the sections, each beginning at a
//! multiple of 64 bytes and padded with zeros to the next:
//!
//! | header | bytes | | section entry | bytes |
//! |---|---|---|---|---|
//! | magic `terrane\n` | 8 | | tag | 4 |
//! | format version | 2 | | item | 4 |
//! | kind | 2 | | packing: 0 as it is, 1 zstd | 4 |
//! | number of sections | 4 | | bytes of one element | 4 |
//! | length of the artefact | 8 | | offset | 8 |
//! | XXH3 of the table | 8 | | stored length without padding | 8 |
//! | zeros | 24 | | length once unpacked | 8 |
//! | XXH3 of the 56 bytes before | 8 | | XXH3 of the stored bytes and their padding | 8 |
//!
//! Every byte is under one of the three checksums, so a flipped bit anywhere is found by whoever reads it.

use std::io::Read;
use std::ops::Range;

use bytemuck::{NoUninit, Pod, Zeroable};
use serde::Serialize;
use serde::de::DeserializeOwned;
use xxhash_rust::xxh3::xxh3_64;

use crate::SceneError;

const _: () = assert!(cfg!(target_endian = "little"), "artefacts are written by casting columns");

const MAGIC: [u8; 8] = *b"terrane\n";
const FORMAT_VERSION: u16 = 1;
const HEADER_LEN: u64 = 64;
const ENTRY_LEN: u64 = 48;
const ALIGNMENT: u64 = 64;
/// Sections of an artefact at most; a table beyond that is refused before it is read.
const MAX_SECTIONS: u32 = 1 << 22;
/// A section that shrinks more than this is stored as it is, so that a reader may refuse greater claims.
const MAX_RATIO: u64 = 1024;
const ZSTD_LEVEL: i32 = 1;

/// What an artefact is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u16)]
pub enum Kind {
    /// Small records as JSON.
    Record = 1,
    /// Features of a batch of images.
    Features = 2,
    /// Candidate pairs in blocks.
    Pairs = 3,
    /// Verified pairs of a block.
    Matches = 4,
    /// What a cluster became.
    Submap = 5,
    /// Cameras, points and tracks in one frame.
    Reconstruction = 6,
    /// Points of one cluster of cameras with their observations, while they are adjusted.
    AdjustmentPart = 7,
    /// What the two ends of a distributed adjustment say to each other.
    AdjustmentMessage = 8,
}

/// Names a kind of section: four bytes, readable in a hex dump.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Tag(pub [u8; 4]);

impl std::fmt::Display for Tag {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}", self.0.escape_ascii())
    }
}

/// How a section is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Packing {
    /// As it is.
    Raw,
    /// By zstd, unless that gains nothing.
    Zstd,
}

#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct Header {
    magic: [u8; 8],
    version: u16,
    kind: u16,
    num_sections: u32,
    len: u64,
    table_checksum: u64,
    zeros: [u64; 3],
    checksum: u64,
}

#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
struct Entry {
    tag: [u8; 4],
    item: u32,
    packing: u32,
    element_len: u32,
    offset: u64,
    stored_len: u64,
    len: u64,
    checksum: u64,
}

impl Entry {
    fn range(&self) -> Range<u64> {
        self.offset..self.offset + pad(self.stored_len)
    }

    fn name(&self) -> String {
        format!("section {}/{}", Tag(self.tag), self.item)
    }
}

fn pad(len: u64) -> u64 {
    len.next_multiple_of(ALIGNMENT)
}

/// Builds an artefact in memory.
pub struct ArchiveWriter {
    kind: Kind,
    entries: Vec<Entry>,
    body: Vec<u8>,
}

impl ArchiveWriter {
    /// Begins an artefact of a kind.
    pub fn new(kind: Kind) -> Self {
        Self { kind, entries: Vec::new(), body: Vec::new() }
    }

    /// Adds a column. `(tag, item)` must not repeat.
    ///
    /// # Errors
    /// When zstd fails, which it does only without memory.
    pub fn column<T: NoUninit>(
        &mut self,
        tag: Tag,
        item: u32,
        column: &[T],
        packing: Packing,
    ) -> Result<(), SceneError> {
        let bytes: &[u8] = bytemuck::cast_slice(column);
        let packed = match packing {
            Packing::Raw => None,
            Packing::Zstd => Some(
                zstd::bulk::compress(bytes, ZSTD_LEVEL)
                    .map_err(|error| SceneError::source_failed("zstd", error))?,
            ),
        };
        let packed =
            packed.filter(|p| p.len() < bytes.len() && (bytes.len() as u64) <= MAX_RATIO * (p.len() as u64));
        let stored = packed.as_deref().unwrap_or(bytes);
        let start = self.body.len();
        self.body.extend_from_slice(stored);
        self.body.resize(start + pad(stored.len() as u64) as usize, 0);
        self.entries.push(Entry {
            tag: tag.0,
            item,
            packing: u32::from(packed.is_some()),
            element_len: size_of::<T>() as u32,
            offset: start as u64,
            stored_len: stored.len() as u64,
            len: bytes.len() as u64,
            checksum: xxh3_64(&self.body[start..]),
        });
        Ok(())
    }

    /// Adds a record as JSON.
    ///
    /// # Errors
    /// When the value can't be written as JSON.
    pub fn json<T: Serialize + ?Sized>(&mut self, tag: Tag, item: u32, value: &T) -> Result<(), SceneError> {
        let bytes = serde_json::to_vec(value).map_err(|error| {
            SceneError::invalid(format!("section {tag} can't be written as JSON: {error}"))
        })?;
        self.column(tag, item, &bytes, Packing::Zstd)
    }

    /// The bytes of the artefact. Equal sections give equal bytes.
    pub fn finish(mut self) -> Vec<u8> {
        self.entries.sort_by_key(|entry| (entry.tag, entry.item));
        debug_assert!(self.entries.windows(2).all(|w| (w[0].tag, w[0].item) != (w[1].tag, w[1].item)));
        let table_len = self.entries.len() as u64 * ENTRY_LEN;
        let body_at = pad(HEADER_LEN + table_len);
        for entry in &mut self.entries {
            entry.offset += body_at;
        }
        let mut table: Vec<u8> = bytemuck::cast_slice(&self.entries).to_vec();
        table.resize((body_at - HEADER_LEN) as usize, 0);
        let mut header = Header {
            magic: MAGIC,
            version: FORMAT_VERSION,
            kind: self.kind as u16,
            num_sections: self.entries.len() as u32,
            len: body_at + self.body.len() as u64,
            table_checksum: xxh3_64(&table),
            zeros: [0; 3],
            checksum: 0,
        };
        header.checksum = xxh3_64(&bytemuck::bytes_of(&header)[..56]);
        let mut bytes = bytemuck::bytes_of(&header).to_vec();
        bytes.reserve_exact(table.len() + self.body.len());
        bytes.extend_from_slice(&table);
        bytes.extend_from_slice(&self.body);
        bytes
    }
}

/// Where an artefact's bytes are.
pub trait Source {
    /// How many bytes there are.
    fn len(&self) -> u64;

    /// True when there are none.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Parts of the bytes, in the order asked. Every range lies within [`Source::len`].
    ///
    /// # Errors
    /// When the place can't be read.
    fn read(
        &self,
        ranges: &[Range<u64>],
    ) -> Result<Vec<Box<dyn AsRef<[u8]> + '_>>, Box<dyn std::error::Error + Send + Sync>>;
}

impl Source for &[u8] {
    fn len(&self) -> u64 {
        <[u8]>::len(self) as u64
    }

    fn read(
        &self,
        ranges: &[Range<u64>],
    ) -> Result<Vec<Box<dyn AsRef<[u8]> + '_>>, Box<dyn std::error::Error + Send + Sync>> {
        let part = |range: &Range<u64>| Box::new(&self[range.start as usize..range.end as usize]) as Box<_>;
        Ok(ranges.iter().map(part).collect())
    }
}

/// An artefact whose header and table have been read and found whole.
pub struct Archive<S> {
    source: S,
    entries: Vec<Entry>,
}

impl<S: Source> Archive<S> {
    /// Reads header and table.
    ///
    /// # Errors
    /// Corrupt when checksums or lengths do not hold; unsupported when the version or kind is another one.
    pub fn open(source: S, kind: Kind) -> Result<Self, SceneError> {
        let len = source.len();
        if len < HEADER_LEN {
            return Err(SceneError::corrupt(format!("{len} bytes are too few for an artefact")));
        }
        let header: Header =
            bytemuck::pod_read_unaligned(read_one(&source, 0..HEADER_LEN)?.as_ref().as_ref());
        check_header(&header, len, kind)?;
        let table_end = pad(HEADER_LEN + u64::from(header.num_sections) * ENTRY_LEN);
        if table_end > len {
            return Err(SceneError::corrupt("the table of sections is cut off"));
        }
        let entries = {
            let table = read_one(&source, HEADER_LEN..table_end)?;
            let table = table.as_ref().as_ref();
            if xxh3_64(table) != header.table_checksum {
                return Err(SceneError::corrupt("the table of sections has a wrong checksum"));
            }
            let used = (u64::from(header.num_sections) * ENTRY_LEN) as usize;
            bytemuck::pod_collect_to_vec::<u8, Entry>(&table[..used])
        };
        for entry in &entries {
            check_entry(entry, table_end, len)?;
        }
        if entries.windows(2).any(|w| (w[0].tag, w[0].item) >= (w[1].tag, w[1].item)) {
            return Err(SceneError::corrupt("the table of sections is out of order"));
        }
        Ok(Self { source, entries })
    }

    /// The items that a tag has, ascending.
    pub fn items(&self, tag: Tag) -> impl Iterator<Item = u32> + '_ {
        self.entries.iter().filter(move |entry| entry.tag == tag.0).map(|entry| entry.item)
    }

    /// Whether there is such a section.
    pub fn has(&self, tag: Tag, item: u32) -> bool {
        self.entry(tag, item).is_some()
    }

    /// How many elements a section has, without reading it.
    ///
    /// # Errors
    /// Corrupt when there is no such section.
    pub fn column_len(&self, tag: Tag, item: u32) -> Result<u64, SceneError> {
        let entry = self.required(tag, item)?;
        Ok(entry.len / u64::from(entry.element_len.max(1)))
    }

    /// Reads a column.
    ///
    /// # Errors
    /// Corrupt when there is no such section, its checksum does not hold, or its elements are of another size.
    pub fn column<T: Pod>(&self, tag: Tag, item: u32) -> Result<Vec<T>, SceneError> {
        let mut columns = self.columns::<T>(&[(tag, item)])?;
        columns.pop().ok_or_else(|| SceneError::corrupt("no column was read"))
    }

    /// Reads several columns of one type with one request, in the order asked.
    ///
    /// # Errors
    /// As [`Archive::column`].
    pub fn columns<T: Pod>(&self, wanted: &[(Tag, u32)]) -> Result<Vec<Vec<T>>, SceneError> {
        let entries =
            wanted.iter().map(|&(tag, item)| self.required(tag, item)).collect::<Result<Vec<_>, _>>()?;
        let ranges: Vec<Range<u64>> = entries.iter().map(|entry| entry.range()).collect();
        let parts = self
            .source
            .read(&ranges)
            .map_err(|error| SceneError::source_failed("reading sections", error))?;
        entries
            .into_iter()
            .zip(&parts)
            .map(|(entry, stored)| unpack::<T>(entry, stored.as_ref().as_ref()))
            .collect()
    }

    /// Reads a record.
    ///
    /// # Errors
    /// As [`Archive::column`], and when the JSON is not of this type.
    pub fn json<T: DeserializeOwned>(&self, tag: Tag, item: u32) -> Result<T, SceneError> {
        let bytes = self.column::<u8>(tag, item)?;
        serde_json::from_slice(&bytes).map_err(|error| {
            SceneError::corrupt(format!("section {tag}/{item} is not what it should be: {error}"))
        })
    }

    fn entry(&self, tag: Tag, item: u32) -> Option<&Entry> {
        let at = self.entries.binary_search_by_key(&(tag.0, item), |entry| (entry.tag, entry.item)).ok()?;
        Some(&self.entries[at])
    }

    fn required(&self, tag: Tag, item: u32) -> Result<&Entry, SceneError> {
        self.entry(tag, item).ok_or_else(|| SceneError::corrupt(format!("section {tag}/{item} is not there")))
    }
}

fn read_one<'a, S: Source>(
    source: &'a S,
    range: Range<u64>,
) -> Result<Box<dyn AsRef<[u8]> + 'a>, SceneError> {
    let wanted = range.end - range.start;
    let mut parts = source
        .read(&[range])
        .map_err(|error| SceneError::source_failed("reading an artefact's header", error))?;
    match parts.pop() {
        Some(part) if part.as_ref().as_ref().len() as u64 == wanted => Ok(part),
        _ => Err(SceneError::corrupt("fewer bytes were read than the artefact has")),
    }
}

fn check_header(header: &Header, len: u64, kind: Kind) -> Result<(), SceneError> {
    if header.magic != MAGIC {
        return Err(SceneError::corrupt("this is no artefact: its first bytes are others"));
    }
    if xxh3_64(&bytemuck::bytes_of(header)[..56]) != header.checksum {
        return Err(SceneError::corrupt("the header has a wrong checksum"));
    }
    if header.version != FORMAT_VERSION {
        return Err(SceneError::unsupported(format!(
            "the artefact is of format {}; this program reads format {FORMAT_VERSION}",
            header.version
        )));
    }
    if header.kind != kind as u16 {
        return Err(SceneError::unsupported(format!(
            "the artefact is of kind {}, not {kind:?}",
            header.kind
        )));
    }
    if header.len != len {
        return Err(SceneError::corrupt(format!(
            "the artefact has {len} bytes and should have {}",
            header.len
        )));
    }
    if header.num_sections > MAX_SECTIONS {
        return Err(SceneError::corrupt(format!("{} sections are too many", header.num_sections)));
    }
    Ok(())
}

fn check_entry(entry: &Entry, table_end: u64, len: u64) -> Result<(), SceneError> {
    let fits = entry.offset >= table_end
        && entry.offset.is_multiple_of(ALIGNMENT)
        && entry.offset <= len
        && entry.stored_len <= len - entry.offset
        && pad(entry.stored_len) <= len - entry.offset;
    let plausible = match entry.packing {
        0 => entry.len == entry.stored_len,
        1 => entry.len <= entry.stored_len.saturating_mul(MAX_RATIO),
        _ => false,
    };
    let whole = entry.element_len > 0 && entry.len.is_multiple_of(u64::from(entry.element_len));
    if fits && plausible && whole {
        Ok(())
    } else {
        Err(SceneError::corrupt(format!("{} has impossible lengths", entry.name())))
    }
}

fn unpack<T: Pod>(entry: &Entry, stored: &[u8]) -> Result<Vec<T>, SceneError> {
    if entry.element_len as usize != size_of::<T>() {
        return Err(SceneError::corrupt(format!("{} has elements of another size", entry.name())));
    }
    if stored.len() as u64 != pad(entry.stored_len) || xxh3_64(stored) != entry.checksum {
        return Err(SceneError::corrupt(format!("{} has a wrong checksum", entry.name())));
    }
    let stored = &stored[..entry.stored_len as usize];
    if entry.packing == 0 {
        return Ok(bytemuck::pod_collect_to_vec(stored));
    }
    let bytes = unpack_zstd(stored, entry.len)
        .ok_or_else(|| SceneError::corrupt(format!("{} can't be unpacked", entry.name())))?;
    Ok(bytemuck::pod_collect_to_vec(&bytes))
}

/// Grows with what comes out, never by what is claimed.
fn unpack_zstd(stored: &[u8], len: u64) -> Option<Vec<u8>> {
    let mut bytes = Vec::new();
    let decoder = zstd::stream::read::Decoder::new(stored).ok()?;
    decoder.take(len.checked_add(1)?).read_to_end(&mut bytes).ok()?;
    (bytes.len() as u64 == len).then_some(bytes)
}

#[cfg(test)]
mod tests;
