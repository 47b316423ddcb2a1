//! Verified pairs of a block. Summaries are one section, the matches of each pair another, so that the view graph reads
//! no matches and a cluster reads only its own.

use std::collections::BTreeMap;

use bytemuck::{Pod, Zeroable};
use nalgebra::Vector3;
use terrane_geometry::Rigid3;

use super::reconstruction::{quaternion_from_wxyz, wxyz_from_quaternion};
use super::{Archive, ArchiveWriter, Kind, Packing, Source, Tag};
use crate::{ImageId, ImagePair, MatchedPair, PairKind, PairSummary, SceneError};

const SUMMARIES: Tag = Tag(*b"SUMM");
const MATCHES: Tag = Tag(*b"MTCH");
const REFUSED: Tag = Tag(*b"REFU");

/// What matching made of a block of candidate pairs.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MatchBlock {
    /// Verified pairs, ascending.
    pub pairs: Vec<MatchedPair>,
    /// How many candidates were refused, by reason.
    pub refused: BTreeMap<String, u64>,
}

#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct SummaryRow {
    first: u32,
    second: u32,
    kind: u32,
    num_inliers: u32,
    has_pose: u32,
    zero: u32,
    wxyz: [f64; 4],
    translation: [f64; 3],
    median_angle_rad: f64,
}

const KINDS: [PairKind; 5] = [
    PairKind::Calibrated,
    PairKind::Uncalibrated,
    PairKind::Planar,
    PairKind::Panoramic,
    PairKind::Watermark,
];

fn row_from_summary(summary: &PairSummary) -> SummaryRow {
    let pose = summary.second_from_first.unwrap_or_default();
    SummaryRow {
        first: summary.pair.first().0,
        second: summary.pair.second().0,
        kind: KINDS.iter().position(|kind| *kind == summary.kind).unwrap_or_default() as u32,
        num_inliers: summary.num_inliers,
        has_pose: u32::from(summary.second_from_first.is_some()),
        zero: 0,
        wxyz: wxyz_from_quaternion(&pose.rotation),
        translation: pose.translation.into(),
        median_angle_rad: summary.median_angle_rad,
    }
}

fn summary_from_row(row: &SummaryRow) -> Result<PairSummary, SceneError> {
    let bad = || SceneError::corrupt("a pair's summary makes no sense");
    let pair = ImagePair::new(ImageId(row.first), ImageId(row.second)).ok_or_else(bad)?;
    let kind = *KINDS.get(row.kind as usize).ok_or_else(bad)?;
    let pose = Rigid3::new(quaternion_from_wxyz(row.wxyz)?, Vector3::from(row.translation));
    Ok(PairSummary {
        pair,
        kind,
        num_inliers: row.num_inliers,
        second_from_first: (row.has_pose != 0).then_some(pose),
        median_angle_rad: row.median_angle_rad,
    })
}

/// The bytes of a block.
///
/// # Errors
/// As [`ArchiveWriter::column`].
pub fn encode_match_block(block: &MatchBlock) -> Result<Vec<u8>, SceneError> {
    let mut archive = ArchiveWriter::new(Kind::Matches);
    let rows: Vec<SummaryRow> = block.pairs.iter().map(|pair| row_from_summary(&pair.summary)).collect();
    archive.column(SUMMARIES, 0, &rows, Packing::Raw)?;
    for (place, pair) in block.pairs.iter().enumerate() {
        archive.column(MATCHES, place as u32, &pair.matches, Packing::Zstd)?;
    }
    archive.json(REFUSED, 0, &block.refused)?;
    Ok(archive.finish())
}

/// The summaries of a block, and how many candidates were refused, by reason. Reads no matches.
///
/// # Errors
/// As [`Archive::open`].
pub fn read_pair_summaries(
    source: impl Source,
) -> Result<(Vec<PairSummary>, BTreeMap<String, u64>), SceneError> {
    let archive = Archive::open(source, Kind::Matches)?;
    let rows = archive.column::<SummaryRow>(SUMMARIES, 0)?;
    let summaries = rows.iter().map(summary_from_row).collect::<Result<_, _>>()?;
    Ok((summaries, archive.json(REFUSED, 0)?))
}

/// The pairs of a block that `wanted` accepts, with their matches; no others are read.
///
/// # Errors
/// As [`Archive::open`].
pub fn read_matches(
    source: impl Source,
    wanted: impl Fn(ImagePair) -> bool,
) -> Result<Vec<MatchedPair>, SceneError> {
    let archive = Archive::open(source, Kind::Matches)?;
    let rows = archive.column::<SummaryRow>(SUMMARIES, 0)?;
    let mut summaries = Vec::new();
    let mut sections = Vec::new();
    for (place, row) in rows.iter().enumerate() {
        let summary = summary_from_row(row)?;
        if wanted(summary.pair) {
            summaries.push(summary);
            sections.push((MATCHES, place as u32));
        }
    }
    let columns = archive.columns::<[u32; 2]>(&sections)?;
    Ok(summaries
        .into_iter()
        .zip(columns)
        .map(|(summary, matches)| MatchedPair { summary, matches })
        .collect())
}
