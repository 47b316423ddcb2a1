//! K-means over byte descriptors, exact in integers: the same on any processor and any number of threads.

use rand::RngExt;
use rayon::prelude::*;
use terrane_geometry::Seed;
use terrane_scene::DESCRIPTOR_LEN;

use super::VocabularyOptions;
use crate::matching::MatchKernel;

type Descriptor = [u8; DESCRIPTOR_LEN];

/// Descriptors that one task assigns.
const CHUNK: usize = 4096;

/// Centres of at most `num_words` clusters, rounded to bytes.
pub(super) fn cluster(
    descriptors: &[Descriptor],
    options: &VocabularyOptions,
    seed: Seed,
) -> Vec<Descriptor> {
    let mut words = start(descriptors, options.num_words.clamp(1, 4096) as usize, seed);
    if words.is_empty() {
        return words;
    }
    for _ in 0..options.max_iterations {
        let moved = step(descriptors, &words);
        if moved == words {
            break;
        }
        words = moved;
    }
    words.sort_unstable();
    words.dedup();
    words
}

/// The word nearest to each descriptor and the squared distance to it; of equally near words the first.
pub(super) fn assign(descriptors: &[Descriptor], words: &[Descriptor]) -> Vec<(u32, u32)> {
    let kernel = MatchKernel::fastest();
    let of_chunk = |chunk: &[Descriptor]| {
        let neighbours = kernel.nearest(chunk, words).rows;
        let resolve = |(descriptor, neighbour): (&Descriptor, &crate::matching::Neighbour)| {
            let word =
                neighbour.index.unwrap_or_else(|| first_at(descriptor, words, neighbour.distance_squared));
            (word, neighbour.distance_squared)
        };
        chunk.iter().zip(&neighbours).map(resolve).collect::<Vec<_>>()
    };
    descriptors.par_chunks(CHUNK).map(of_chunk).collect::<Vec<_>>().concat()
}

/// The first word at a distance.
fn first_at(descriptor: &Descriptor, words: &[Descriptor], distance: u32) -> u32 {
    words.iter().position(|word| distance_squared(descriptor, word) == distance).unwrap_or(0) as u32
}

fn distance_squared(a: &Descriptor, b: &Descriptor) -> u32 {
    a.iter().zip(b).map(|(&a, &b)| u32::from(a.abs_diff(b)).pow(2)).sum()
}

/// The k-means++ start: each word is drawn with the squared distance to the words so far as its weight.
fn start(descriptors: &[Descriptor], count: usize, seed: Seed) -> Vec<Descriptor> {
    if descriptors.is_empty() {
        return Vec::new();
    }
    let mut rng = seed.derive("kmeans").rng();
    let mut words = vec![descriptors[rng.random_range(0..descriptors.len())]];
    let mut nearest: Vec<u32> = vec![u32::MAX; descriptors.len()];
    while words.len() < count {
        let newest = words[words.len() - 1];
        nearest.par_iter_mut().zip(descriptors).for_each(|(nearest, descriptor)| {
            *nearest = (*nearest).min(distance_squared(descriptor, &newest));
        });
        let total: u64 = nearest.iter().map(|&distance| u64::from(distance)).sum();
        if total == 0 {
            break;
        }
        let mut left = rng.random_range(0..total);
        let drawn = nearest.iter().position(|&distance| {
            let hit = left < u64::from(distance);
            left = left.saturating_sub(u64::from(distance));
            hit
        });
        words.extend(drawn.map(|at| descriptors[at]));
    }
    words
}

/// One round: every word moves to the mean of its descriptors; one without any moves to the farthest descriptor.
fn step(descriptors: &[Descriptor], words: &[Descriptor]) -> Vec<Descriptor> {
    let assigned = assign(descriptors, words);
    let mut sums = vec![[0u64; DESCRIPTOR_LEN]; words.len()];
    let mut counts = vec![0u64; words.len()];
    for (descriptor, &(word, _)) in descriptors.iter().zip(&assigned) {
        let sum = &mut sums[word as usize];
        (0..DESCRIPTOR_LEN).for_each(|k| sum[k] += u64::from(descriptor[k]));
        counts[word as usize] += 1;
    }
    let mut by_distance: Vec<usize> = Vec::new();
    if counts.contains(&0) {
        by_distance.extend(0..descriptors.len());
        by_distance.sort_by_key(|&at| (std::cmp::Reverse(assigned[at].1), at));
    }
    let mut farthest = by_distance.into_iter();
    let mean = |(sum, &count): (&[u64; DESCRIPTOR_LEN], &u64)| match count {
        0 => farthest.next().map(|at| descriptors[at]).unwrap_or([0; DESCRIPTOR_LEN]),
        // Rounded to the nearest; a mean of bytes is a byte.
        _ => sum.map(|sum| ((2 * sum + count) / (2 * count)) as u8),
    };
    sums.iter().zip(&counts).map(mean).collect()
}
