//! Candidates looked at closely: those whose local features agree come first, and their own candidates are tried too.
//!
//! What two photographs of one place share, their neighbours often share with each other: trying the neighbours of the
//! neighbours that agree finds pairs that no global descriptor would (nearest-neighbour descent, Dong et al. 2011).

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use terrane_scene::{ImageId, ImagePair};

use super::{Similar, Sketch};
use crate::pairs::{BlockOptions, blocks};

/// How retrieval finds similar images.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RetrievalOptions {
    /// Numbers of a global descriptor after projection, 1 to 512. Default 128.
    pub dimensions: u32,
    /// Images that vocabulary and projection are learnt from, at least 2. Default 1,024.
    pub training_images: u32,
    /// Most similar images by global descriptor that are looked at closely, for each image; 0 leaves it at the global
    /// descriptors. Default 60.
    pub candidates: u32,
    /// Features of largest scale that are compared for that, at least 8. Default 512: a
    /// millisecond a pair.
    pub local_features: u32,
    /// Rounds in which the neighbours of neighbours are tried. Default 2.
    pub rounds: u32,
}

impl Default for RetrievalOptions {
    fn default() -> Self {
        Self { dimensions: 128, training_images: 1024, candidates: 60, local_features: 512, rounds: 2 }
    }
}

/// Matches that agree by chance; more are evidence.
const VOTES_BY_CHANCE: u32 = 3;
/// Neighbours of an image, the best first, that propose their own.
const PROPOSERS: usize = 16;
/// What a vote between two images counts, in votes by way of a third.
const OWN_VOTE: u32 = 4;
/// New candidates of an image in a round.
const MAX_PROPOSED: usize = 30;
/// Images whose sketches are in memory together: some 70 MiB.
const IMAGES_AT_ONCE: u32 = 1024;

/// Orders candidates by local agreement, with further ones found on the way. `initial` are the most similar images of each
/// image, best first; `load` gives an image's sketch and may be called several times. Lists hold at most `count`, those
/// with votes first.
///
/// # Errors
/// The first of `load`'s, by image.
pub fn refine<E: Send>(
    initial: Vec<Vec<Similar>>,
    count: usize,
    options: &RetrievalOptions,
    load: impl Fn(usize) -> Result<Sketch, E> + Sync,
) -> Result<Vec<Vec<Similar>>, E> {
    let mut graph = Graph { lists: vec![Vec::new(); initial.len()] };
    let candidates = options.candidates as usize;
    let mut pairs: Vec<ImagePair> = Vec::new();
    for (image, list) in initial.iter().enumerate() {
        pairs.extend(list.iter().take(candidates).filter_map(|similar| pair(image, similar.index as usize)));
    }
    for round in 0..=options.rounds {
        pairs.sort_unstable();
        pairs.dedup();
        graph.add(vote(&pairs, &load)?);
        if round < options.rounds {
            pairs = graph.proposals();
        }
    }
    Ok(graph.ranked(initial, count))
}

fn pair(a: usize, b: usize) -> Option<ImagePair> {
    ImagePair::new(ImageId::from_index(a), ImageId::from_index(b))
}

/// Votes of each pair, in no particular order. Sketches are loaded block by block.
fn vote<E: Send>(
    pairs: &[ImagePair],
    load: &(impl Fn(usize) -> Result<Sketch, E> + Sync),
) -> Result<Vec<(ImagePair, u32)>, E> {
    let limits = BlockOptions { max_pairs: u32::MAX, max_images: IMAGES_AT_ONCE };
    let mut voted = Vec::with_capacity(pairs.len());
    for block in blocks(pairs, &limits) {
        let mut images: Vec<ImageId> = block.iter().flat_map(|pair| [pair.first(), pair.second()]).collect();
        images.sort_unstable();
        images.dedup();
        let loaded: Vec<Result<Sketch, E>> = images.par_iter().map(|image| load(image.index())).collect();
        let sketches = loaded.into_iter().collect::<Result<Vec<Sketch>, E>>()?;
        let sketch = |image: ImageId| images.binary_search(&image).ok().and_then(|at| sketches.get(at));
        let votes = |&pair: &ImagePair| match (sketch(pair.first()), sketch(pair.second())) {
            (Some(first), Some(second)) => (pair, first.votes(second)),
            _ => (pair, 0),
        };
        let block_votes: Vec<(ImagePair, u32)> = block.par_iter().map(votes).collect();
        voted.extend(block_votes);
    }
    Ok(voted)
}

/// What was looked at: for each image the others with their votes, most votes first, then by number.
struct Graph {
    lists: Vec<Vec<(u32, u32)>>,
}

impl Graph {
    fn add(&mut self, voted: Vec<(ImagePair, u32)>) {
        for (pair, votes) in voted {
            let (a, b) = (pair.first(), pair.second());
            self.lists[a.index()].push((votes, b.0));
            self.lists[b.index()].push((votes, a.0));
        }
        let by_votes = |entry: &(u32, u32)| (std::cmp::Reverse(entry.0), entry.1);
        self.lists.par_iter_mut().for_each(|list| list.sort_unstable_by_key(by_votes));
    }

    /// The neighbours of an image that agree with it, best first.
    fn proposers(&self, image: usize) -> impl Iterator<Item = (u32, u32)> + '_ {
        self.lists[image].iter().copied().take_while(|entry| entry.0 > VOTES_BY_CHANCE).take(PROPOSERS)
    }

    /// Images that have an agreeing neighbour in common with an image: the votes of the weaker step of each way, summed,
    /// and the other image. Ascending by image.
    fn by_way_of_others(&self, image: usize) -> Vec<(u32, u32)> {
        let mut ways: Vec<(u32, u32)> = Vec::new();
        for (votes, middle) in self.proposers(image) {
            let next = self.proposers(middle as usize).filter(|&(_, other)| other as usize != image);
            ways.extend(next.map(|(further, other)| (other, votes.min(further))));
        }
        ways.sort_unstable();
        let sum = |ways: &[(u32, u32)]| (ways.iter().map(|way| way.1).sum(), ways[0].0);
        ways.chunk_by(|a, b| a.0 == b.0).map(sum).collect()
    }

    /// Pairs of images that have an agreeing neighbour in common and were not looked at, for each image those with the
    /// most votes on the way.
    fn proposals(&self) -> Vec<ImagePair> {
        let of_image = |image: usize| -> Vec<ImagePair> {
            let mut known: Vec<u32> = self.lists[image].iter().map(|entry| entry.1).collect();
            known.sort_unstable();
            let mut found = self.by_way_of_others(image);
            found.retain(|(_, other)| known.binary_search(other).is_err());
            found.sort_unstable_by_key(|&(sum, other)| (std::cmp::Reverse(sum), other));
            found.iter().take(MAX_PROPOSED).filter_map(|&(_, other)| pair(image, other as usize)).collect()
        };
        (0..self.lists.len()).into_par_iter().map(of_image).collect::<Vec<_>>().concat()
    }

    /// Lists of at most `count`: those with evidence first, then the others as global descriptors ordered them. Evidence
    /// is an image's own votes and a part of those by way of common neighbours: of two photographs that share a border
    /// too narrow for votes, the ones between them know.
    fn ranked(&self, initial: Vec<Vec<Similar>>, count: usize) -> Vec<Vec<Similar>> {
        let of_image = |(image, initial): (usize, Vec<Similar>)| {
            let mut evidence: Vec<(u32, u32)> = Vec::new();
            let own = self.lists[image].iter().take_while(|entry| entry.0 > VOTES_BY_CHANCE);
            evidence.extend(own.map(|&(votes, other)| (other, OWN_VOTE * votes)));
            evidence.extend(self.by_way_of_others(image).into_iter().map(|(sum, other)| (other, sum)));
            evidence.sort_unstable();
            let sum = |parts: &[(u32, u32)]| (parts.iter().map(|part| part.1).sum::<u32>(), parts[0].0);
            let mut sums: Vec<(u32, u32)> = evidence.chunk_by(|a, b| a.0 == b.0).map(sum).collect();
            sums.sort_unstable_by_key(|&(sum, other)| (std::cmp::Reverse(sum), other));
            let similarity = |other: u32| {
                initial
                    .iter()
                    .find(|similar| similar.index == other)
                    .map_or(0.0, |similar| similar.similarity)
            };
            let votes = |sum: u32| sum.div_ceil(OWN_VOTE);
            let known = sums.iter().take(count).map(|&(sum, index)| Similar {
                index,
                similarity: similarity(index),
                votes: votes(sum),
            });
            let mut list: Vec<Similar> = known.collect();
            for similar in initial.iter() {
                if list.len() >= count {
                    break;
                }
                if !list.iter().any(|taken| taken.index == similar.index) {
                    list.push(*similar);
                }
            }
            list
        };
        initial.into_par_iter().enumerate().map(of_image).collect()
    }
}
