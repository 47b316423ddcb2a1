//! Pairs cut into tasks that share images.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};
use terrane_scene::{ImageId, ImagePair};

/// How large a block may be.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BlockOptions {
    /// Pairs in a block, at least 1. Default 200: some tens of seconds of work on one core.
    pub max_pairs: u32,
    /// Images in a block, at least 2: their features are in memory together. Default 48: some 60 MiB.
    pub max_images: u32,
}

impl Default for BlockOptions {
    fn default() -> Self {
        Self { max_pairs: 200, max_images: 48 }
    }
}

/// Cuts pairs into blocks that share images. Every pair is in one block; pairs ascend within a block.
///
/// Images are put in an order in which those that share pairs are close (breadth-first from an image with few partners,
/// Cuthill & McKee 1969). The pair matrix in that order is walked tile by tile, and a block is closed when the next pair
/// would not fit.
pub fn blocks(pairs: &[ImagePair], options: &BlockOptions) -> Vec<Vec<ImagePair>> {
    let max_pairs = options.max_pairs.max(1) as usize;
    let max_images = options.max_images.max(2) as usize;
    let side = (max_images / 2) as u32;
    let ranks = ranks(pairs);
    let rank =
        |image: ImageId| ranks.binary_search_by_key(&image, |entry| entry.0).map_or(0, |at| ranks[at].1);
    let mut keyed: Vec<([u32; 4], ImagePair)> = pairs
        .iter()
        .map(|&pair| {
            let (a, b) = (rank(pair.first()), rank(pair.second()));
            let (low, high) = (a.min(b), a.max(b));
            ([low / side, high / side, low, high], pair)
        })
        .collect();
    keyed.sort_unstable();
    keyed.dedup();

    let mut blocks = Vec::new();
    let mut block: Vec<ImagePair> = Vec::new();
    let mut images = BTreeSet::new();
    for (_, pair) in keyed {
        let ends = [pair.first(), pair.second()];
        let new = ends.iter().filter(|image| !images.contains(*image)).count();
        if !block.is_empty() && (block.len() == max_pairs || images.len() + new > max_images) {
            blocks.push(std::mem::take(&mut block));
            images.clear();
        }
        block.push(pair);
        images.extend(ends);
    }
    if !block.is_empty() {
        blocks.push(block);
    }
    for block in &mut blocks {
        block.sort_unstable();
    }
    blocks
}

/// Images of the pairs, ascending, with their places in the order.
fn ranks(pairs: &[ImagePair]) -> Vec<(ImageId, u32)> {
    let mut arcs: Vec<(ImageId, ImageId)> = pairs
        .iter()
        .flat_map(|pair| [(pair.first(), pair.second()), (pair.second(), pair.first())])
        .collect();
    arcs.sort_unstable();
    arcs.dedup();
    let nodes: Vec<(ImageId, &[(ImageId, ImageId)])> =
        arcs.chunk_by(|a, b| a.0 == b.0).map(|arcs| (arcs[0].0, arcs)).collect();
    let place = |image: ImageId| nodes.binary_search_by_key(&image, |node| node.0).unwrap_or_default();
    let degree = |at: usize| nodes[at].1.len();

    let mut starts: Vec<usize> = (0..nodes.len()).collect();
    starts.sort_by_key(|&at| (degree(at), at));
    let mut order: Vec<usize> = Vec::with_capacity(nodes.len());
    let mut seen = vec![false; nodes.len()];
    for start in starts {
        if std::mem::replace(&mut seen[start], true) {
            continue;
        }
        let mut head = order.len();
        order.push(start);
        while head < order.len() {
            let mut next: Vec<usize> = nodes[order[head]].1.iter().map(|arc| place(arc.1)).collect();
            next.sort_by_key(|&at| (degree(at), at));
            for at in next {
                if !std::mem::replace(&mut seen[at], true) {
                    order.push(at);
                }
            }
            head += 1;
        }
    }
    let mut ranks: Vec<(ImageId, u32)> =
        order.iter().enumerate().map(|(rank, &at)| (nodes[at].0, rank as u32)).collect();
    ranks.sort_unstable();
    ranks
}
