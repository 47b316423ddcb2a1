//! Which photographs to match with which: few enough to afford, enough to hold the scene together.
//!
//! Seeing the same ground or near each other by GPS, near each other in the sequence, alike in their looks, given as a
//! list, or every pair there is. [`select`] combines them; [`blocks`] cuts the result into tasks that share images.

mod blocks;
mod footprint;
#[cfg(test)]
mod footprint_tests;
mod overlap;
mod places;
mod sequence;
mod spatial;
#[cfg(test)]
mod tests;
mod views;

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use terrane_scene::{ImageId, ImagePair, ImageTable};

pub use blocks::{BlockOptions, blocks};

use crate::retrieval::Similar;

/// How pairs are chosen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PairMode {
    /// Every pair of a small run; else spatial neighbours where there is GPS, and retrieval with sequence where not.
    #[default]
    Auto,
    /// Every pair there is.
    Exhaustive,
    /// Spatial neighbours; images without GPS by retrieval, or by sequence when retrieval is not to be had.
    Gps,
    /// Spatial neighbours and the most similar images, for every image: where positions are too coarse to trust alone.
    GpsAndRetrieval,
    /// Neighbours in the sequence, and loops that retrieval closes.
    Sequential,
    /// The most similar images only.
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
    /// Whether spatial neighbours are those that see the same ground, where height, field of view and attitude are known;
    /// else they are the nearest. Default true.
    pub footprints: bool,
    /// Least part of the ground that either of two photographs sees that both must see, 0 to 1. Default 0.08: 15 % of each
    /// of two equal ones, of which about as much is lost at borders as is left to match.
    pub min_overlap: f64,
    /// Neighbours on each side in the sequence: by time of exposure within a folder where every image has one, else
    /// by path. Default 5 (with retrieval); 10 where the sequence is all there is (COLMAP).
    pub sequence_overlap: Option<u32>,
    /// Similar images beyond its neighbours that each image of mode `sequential` is paired with, to close loops; 0 does
    /// without. Default 5.
    pub loop_closures: u32,
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
            footprints: true,
            min_overlap: 0.08,
            sequence_overlap: None,
            loop_closures: 5,
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
    /// Pairs of images with overlapping footprints among them.
    pub from_footprints: u64,
    /// Pairs of neighbours in the sequence.
    pub from_sequence: u64,
    /// Pairs of similar images.
    pub from_retrieval: u64,
    /// Pairs of images far apart in the sequence that look alike.
    pub from_loops: u64,
    /// Pairs of the list.
    pub from_list: u64,
    /// Images without a usable GPS position, when positions were used.
    pub without_gps: u32,
    /// Images whose footprint on the ground was used.
    pub with_footprint: u32,
    /// Distance in metres beyond which spatial neighbours were left out.
    pub max_distance_m: Option<f64>,
    /// Retrieval was asked for and was not to be had: the sequence was used instead.
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
/// `similar` holds the most similar images of each image of the table, best first, at least for those that
/// [`wanted_similar`] names; `None` when that is not to be had.
pub fn select(table: &ImageTable, similar: Option<&[Vec<Similar>]>, options: &PairOptions) -> PairSelection {
    let similar = similar.filter(|similar| similar.len() == table.images.len());
    let mut chosen = Chosen { table, options, similar, pairs: Vec::new(), report: PairReport::default() };
    match resolve(table, options) {
        PairMode::Exhaustive => chosen.exhaustive(),
        PairMode::Gps => chosen.gps(|_| false),
        PairMode::GpsAndRetrieval => chosen.gps(|_| true),
        PairMode::Sequential => {
            chosen.sequence(SEQUENCE_ALONE, |_| true);
            chosen.loops();
        }
        PairMode::List => chosen.list(),
        PairMode::Retrieval => chosen.retrieval(|_| true),
        PairMode::Auto => {
            chosen.retrieval(|_| true);
            chosen.sequence(SEQUENCE_BESIDE_RETRIEVAL, |_| true);
        }
    }
    chosen.finish()
}

/// For each image whether [`select`] would use its similar images with these options, and `None` when it needs nobody's.
/// The similar images themselves may be any of the table.
pub fn wanted_similar(table: &ImageTable, options: &PairOptions) -> Option<Vec<bool>> {
    let wanted = match resolve(table, options) {
        PairMode::Exhaustive | PairMode::List => return None,
        PairMode::Sequential if options.loop_closures == 0 => return None,
        PairMode::Gps => spatial::neighbours(table, options).alone,
        PairMode::Auto | PairMode::Retrieval | PairMode::GpsAndRetrieval | PairMode::Sequential => {
            vec![true; table.images.len()]
        }
    };
    wanted.contains(&true).then_some(wanted)
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
    similar: Option<&'a [Vec<Similar>]>,
    pairs: Vec<ImagePair>,
    report: PairReport,
}

impl Chosen<'_> {
    /// Adds pairs of positions in the table; returns how many different ones.
    fn add(&mut self, pairs: impl IntoIterator<Item = (usize, usize)>) -> u64 {
        let num_images = self.table.images.len();
        let as_ids = |(a, b): (usize, usize)| {
            let is_known = a < num_images && b < num_images;
            is_known.then(|| ImagePair::new(ImageId::from_index(a), ImageId::from_index(b))).flatten()
        };
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

    /// Spatial neighbours. Images that have no position, or hardly a neighbour within reach, and those that `also` names,
    /// are paired by looks as well.
    fn gps(&mut self, also: impl Fn(usize) -> bool) {
        let found = spatial::neighbours(self.table, self.options);
        self.report.without_gps = found.without_position;
        self.report.with_footprint = found.num_footprints;
        self.report.max_distance_m = found.max_distance_m;
        self.report.from_footprints = self.add(found.by_footprint);
        self.report.from_gps = self.add(found.pairs);
        let alone = found.alone;
        if (0..alone.len()).any(|image| alone[image] || also(image)) {
            self.retrieval(|image| alone[image] || also(image));
            self.sequence(SEQUENCE_BESIDE_RETRIEVAL, |image| alone[image]);
        }
    }

    /// The most similar images of those that `wanted` names.
    fn retrieval(&mut self, wanted: impl Fn(usize) -> bool) {
        let Some(similar) = self.similar else {
            self.report.retrieval_missing = true;
            self.sequence(SEQUENCE_ALONE, wanted);
            return;
        };
        let count = self.options.retrieval_neighbours as usize;
        let of_image = |image: usize| {
            similar[image].iter().take(count).map(move |neighbour| (image, neighbour.index as usize))
        };
        let pairs: Vec<(usize, usize)> =
            (0..similar.len()).filter(|&image| wanted(image)).flat_map(of_image).collect();
        self.report.from_retrieval = self.add(pairs);
    }

    /// The most similar images of each image that are not near it in the sequence.
    fn loops(&mut self) {
        if self.options.loop_closures == 0 {
            return;
        }
        let Some(similar) = self.similar else {
            self.report.retrieval_missing = true;
            return;
        };
        let overlap = self.options.sequence_overlap.unwrap_or(SEQUENCE_ALONE) as usize;
        let places = sequence::places(self.table);
        let of_image = |image: usize| {
            let is_far = |other: &usize| {
                places.get(*other).is_some_and(|place| place.abs_diff(places[image]) > overlap)
            };
            let others = similar[image].iter().map(|neighbour| neighbour.index as usize);
            let far = others.filter(is_far).take(self.options.loop_closures as usize);
            far.map(|other| (image, other)).collect::<Vec<_>>()
        };
        let pairs: Vec<(usize, usize)> = (0..similar.len()).flat_map(of_image).collect();
        self.report.from_loops = self.add(pairs);
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
