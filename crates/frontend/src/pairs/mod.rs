//! Which photographs to match with which: few enough to afford, enough to hold the scene together.
//!
//! Near each other by GPS, near each other in the sequence, alike by their global descriptors, given as a list, or every
//! pair there is. [`select`] combines them; [`blocks`] cuts the result into tasks that share images.

mod blocks;
mod sequence;
mod spatial;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use terrane_scene::{ImageId, ImagePair, ImageTable};

pub use blocks::{BlockOptions, blocks};

use crate::retrieval;

/// How pairs are chosen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PairMode {
    /// Every pair of a small run; else spatial neighbours where there is GPS, and retrieval with sequence where not.
    #[default]
    Auto,
    /// Every pair there is.
    Exhaustive,
    /// Spatial neighbours; images without GPS by retrieval, or by sequence when there are no global descriptors.
    Gps,
    /// Neighbours in the sequence only.
    Sequential,
    /// The most similar by global descriptor only.
    Retrieval,
    /// [`PairOptions::list`] only.
    List,
}

/// How many pairs, and by what.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PairOptions {
    /// How pairs are chosen. Default `auto`.
    pub mode: PairMode,
    /// Up to this many images, `auto` takes every pair. Default 60: with 30 neighbours an image, a larger run costs no
    /// more pairs than every pair of 60 images would.
    pub exhaustive_limit: u32,
    /// Spatial neighbours of an image. Default 30; 25 to 40 hold an aerial block together.
    pub spatial_neighbours: u32,
    /// Spatial neighbours farther than this many metres are left out; `None` leaves out those beyond four times the
    /// median over all images of the distance to their last neighbour. Default `None`.
    pub max_distance_m: Option<f64>,
    /// Neighbours on each side in the sequence: by time of exposure within a folder where every image has one, else
    /// by path. Default 5 (with retrieval); 10 where the sequence is all there is (COLMAP).
    pub sequence_overlap: Option<u32>,
    /// Most similar images of an image. Default 30.
    pub retrieval_neighbours: u32,
    /// Pairs of paths as they stand in the image table, for mode `list`. Default empty.
    pub list: Vec<[String; 2]>,
}

impl Default for PairOptions {
    fn default() -> Self {
        Self {
            mode: PairMode::Auto,
            exhaustive_limit: 60,
            spatial_neighbours: 30,
            max_distance_m: None,
            sequence_overlap: None,
            retrieval_neighbours: 30,
            list: Vec::new(),
        }
    }
}

/// Neighbours on each side of the sequence when it only adds to retrieval.
const SEQUENCE_BESIDE_RETRIEVAL: u32 = 5;
/// Neighbours on each side of the sequence when nothing else is known.
const SEQUENCE_ALONE: u32 = 10;

/// Where the pairs came from. A pair that several sources gave is counted by each.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PairReport {
    /// Images in the table.
    pub num_images: u32,
    /// Different pairs chosen.
    pub num_pairs: u64,
    /// Pairs taken because every pair was.
    pub from_exhaustive: u64,
    /// Pairs of spatial neighbours.
    pub from_gps: u64,
    /// Pairs of neighbours in the sequence.
    pub from_sequence: u64,
    /// Pairs of similar images.
    pub from_retrieval: u64,
    /// Pairs of the list.
    pub from_list: u64,
    /// Images without a usable GPS position, when positions were used.
    pub without_gps: u32,
    /// Distance in metres beyond which spatial neighbours were left out.
    pub max_distance_m: Option<f64>,
    /// Retrieval was asked for and there were no global descriptors: the sequence was used instead.
    pub retrieval_missing: bool,
    /// Entries of the list that name no image, or one image twice.
    pub unusable_list_entries: Vec<[String; 2]>,
    /// Images in no pair, ascending.
    pub images_without_pair: Vec<ImageId>,
}

/// The pairs to match, and where they came from.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PairSelection {
    /// Ascending, each once.
    pub pairs: Vec<ImagePair>,
    /// Where they came from.
    pub report: PairReport,
}

/// Chooses the pairs to match.
///
/// `global` holds one descriptor an image, in the order of the table (empty for an image without features); `None` when
/// there are none yet. See [`needs_global_descriptors`].
pub fn select(table: &ImageTable, global: Option<&[Vec<f32>]>, options: &PairOptions) -> PairSelection {
    let mut chosen = Chosen { table, options, global, pairs: Vec::new(), report: PairReport::default() };
    match resolve(table, options) {
        PairMode::Exhaustive => chosen.exhaustive(),
        PairMode::Gps => chosen.gps(),
        PairMode::Sequential => chosen.sequence(SEQUENCE_ALONE, |_| true),
        PairMode::List => chosen.list(),
        PairMode::Retrieval => chosen.retrieval(|_| true),
        PairMode::Auto => {
            chosen.retrieval(|_| true);
            chosen.sequence(SEQUENCE_BESIDE_RETRIEVAL, |_| true);
        }
    }
    chosen.finish()
}

/// Whether [`select`] would use global descriptors with these options.
pub fn needs_global_descriptors(table: &ImageTable, options: &PairOptions) -> bool {
    match resolve(table, options) {
        PairMode::Exhaustive | PairMode::Sequential | PairMode::List => false,
        PairMode::Auto | PairMode::Retrieval => true,
        PairMode::Gps => table.images.iter().any(|image| spatial::position_m(image).is_none()),
    }
}

/// `Auto` decided as far as the table decides it; what stays `Auto` is retrieval with sequence.
fn resolve(table: &ImageTable, options: &PairOptions) -> PairMode {
    if options.mode != PairMode::Auto {
        return options.mode;
    }
    let num_images = table.images.len();
    let with_gps = table.images.iter().filter(|image| spatial::position_m(image).is_some()).count();
    if num_images <= options.exhaustive_limit as usize {
        PairMode::Exhaustive
    } else if 2 * with_gps >= num_images {
        PairMode::Gps
    } else {
        PairMode::Auto
    }
}

/// Pairs under way.
struct Chosen<'a> {
    table: &'a ImageTable,
    options: &'a PairOptions,
    global: Option<&'a [Vec<f32>]>,
    pairs: Vec<ImagePair>,
    report: PairReport,
}

impl Chosen<'_> {
    /// Adds pairs of positions in the table; returns how many different ones.
    fn add(&mut self, pairs: impl IntoIterator<Item = (usize, usize)>) -> u64 {
        let as_ids = |(a, b)| ImagePair::new(ImageId::from_index(a), ImageId::from_index(b));
        let mut new: Vec<ImagePair> = pairs.into_iter().filter_map(as_ids).collect();
        new.sort_unstable();
        new.dedup();
        self.pairs.extend_from_slice(&new);
        new.len() as u64
    }

    fn exhaustive(&mut self) {
        let num_images = self.table.images.len();
        let all = (0..num_images).flat_map(|a| (a + 1..num_images).map(move |b| (a, b)));
        self.report.from_exhaustive = self.add(all);
    }

    /// Spatial neighbours; images that have no position, or no neighbour within reach, are paired by other means.
    fn gps(&mut self) {
        let found = spatial::neighbours(self.table, self.options);
        self.report.without_gps = found.without_position;
        self.report.max_distance_m = found.max_distance_m;
        self.report.from_gps = self.add(found.pairs);
        let alone = found.alone;
        if alone.iter().any(|&alone| alone) {
            self.retrieval(|image| alone[image]);
            self.sequence(SEQUENCE_BESIDE_RETRIEVAL, |image| alone[image]);
        }
    }

    /// The most similar images of those that `wanted` names.
    fn retrieval(&mut self, wanted: impl Fn(usize) -> bool) {
        let Some(global) = self.global.filter(|global| global.len() == self.table.images.len()) else {
            self.report.retrieval_missing = true;
            self.sequence(SEQUENCE_ALONE, wanted);
            return;
        };
        let similar = retrieval::nearest(global, self.options.retrieval_neighbours as usize);
        let pairs =
            similar.into_iter().enumerate().filter(|(image, _)| wanted(*image)).flat_map(|(image, list)| {
                list.into_iter().map(move |neighbour| (image, neighbour.index as usize))
            });
        self.report.from_retrieval = self.add(pairs);
    }

    /// Neighbours in the sequence of the images that `wanted` names.
    fn sequence(&mut self, default_overlap: u32, wanted: impl Fn(usize) -> bool) {
        let overlap = self.options.sequence_overlap.unwrap_or(default_overlap) as usize;
        let pairs = sequence::neighbours(self.table, overlap);
        let count = self.add(pairs.into_iter().filter(|&(a, b)| wanted(a) || wanted(b)));
        self.report.from_sequence = self.report.from_sequence.max(count);
    }

    fn list(&mut self) {
        let images = self.table.images.iter().enumerate();
        let by_path: BTreeMap<&str, usize> = images.map(|(at, image)| (image.path.as_str(), at)).collect();
        let mut pairs = Vec::new();
        for entry in &self.options.list {
            match (by_path.get(entry[0].as_str()), by_path.get(entry[1].as_str())) {
                (Some(&a), Some(&b)) if a != b => pairs.push((a, b)),
                _ => self.report.unusable_list_entries.push(entry.clone()),
            }
        }
        self.report.from_list = self.add(pairs);
    }

    fn finish(mut self) -> PairSelection {
        self.pairs.sort_unstable();
        self.pairs.dedup();
        let mut paired = vec![false; self.table.images.len()];
        for pair in &self.pairs {
            paired[pair.first().index()] = true;
            paired[pair.second().index()] = true;
        }
        self.report.images_without_pair = self.table.ids().filter(|id| !paired[id.index()]).collect();
        self.report.num_images = self.table.images.len() as u32;
        self.report.num_pairs = self.pairs.len() as u64;
        PairSelection { pairs: self.pairs, report: self.report }
    }
}
