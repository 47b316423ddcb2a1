//! Which photographs look alike, learnt from the run itself.
//!
//! [`sample`] draws descriptors from some images, [`Vocabulary::train`] clusters them, [`Vocabulary::encode`] sums each
//! image's residuals (VLAD, Jégou et al. 2010), and a [`Projection`] makes them short enough that a hundred thousand fit
//! into some tens of megabytes ([`CompactDescriptors`]). [`nearest`] finds the most similar images without comparing all
//! with all, and [`refine`] looks at these candidates' largest features.

mod compact;
mod dot;
mod eigen;
mod kmeans;
mod local;
mod projection;
mod refine;
mod similarity;
#[cfg(test)]
mod tests;
mod vlad;

use rand::RngExt;
use serde::{Deserialize, Serialize};
use terrane_geometry::Seed;
use terrane_scene::{DESCRIPTOR_LEN, Features};

pub use compact::CompactDescriptors;
pub use dot::DotKernel;
pub use local::Sketch;
pub use projection::Projection;
pub use refine::{RetrievalOptions, refine};
pub use similarity::{Similar, nearest};

/// How the vocabulary is trained.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct VocabularyOptions {
    /// Words, from 1 to 4096. Default 64: a global descriptor then holds 8192 numbers (Arandjelović & Zisserman 2013
    /// use up to 256).
    pub num_words: u32,
    /// Rounds of k-means at most; it stops when nothing moves. Default 20.
    pub max_iterations: u32,
    /// Descriptors to train from, over the whole run. Default 100,000: some 1,500 a word.
    pub num_samples: u32,
    /// Words that were learnt elsewhere, in hexadecimal, [`DESCRIPTOR_LEN`] bytes each; nothing is then trained. Default
    /// none.
    pub words: Option<String>,
}

impl Default for VocabularyOptions {
    fn default() -> Self {
        Self { num_words: 64, max_iterations: 20, num_samples: 100_000, words: None }
    }
}

impl VocabularyOptions {
    /// The words that were given: `None` without any, an error text when they are no words.
    ///
    /// # Errors
    /// A sentence for the user.
    pub fn given(&self) -> Result<Option<Vocabulary>, String> {
        let Some(hex) = &self.words else { return Ok(None) };
        let digit = |at: usize| hex.as_bytes().get(at).and_then(|&digit| char::from(digit).to_digit(16));
        let byte = |at: usize| Some((digit(2 * at)? * 16 + digit(2 * at + 1)?) as u8);
        let bytes: Option<Vec<u8>> = (0..hex.len().div_ceil(2)).map(byte).collect();
        let vocabulary = bytes.as_deref().and_then(Vocabulary::from_words);
        vocabulary
            .map(Some)
            .ok_or_else(|| format!("must be 1 to 4,096 words of {DESCRIPTOR_LEN} bytes in hexadecimal"))
    }
}

/// Typical descriptors of a run. Words are bytes as the descriptors are, so that assignment is exact in integers and the
/// same on every processor.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Vocabulary {
    /// [`DESCRIPTOR_LEN`] bytes a word, row after row.
    words: Vec<u8>,
}

impl Vocabulary {
    /// Clusters descriptors ([`DESCRIPTOR_LEN`] bytes each, row after row) by k-means (Lloyd 1982) from a k-means++ start
    /// (Arthur & Vassilvitskii 2007). Has fewer words than asked for when there are fewer different descriptors, and
    /// none without descriptors.
    pub fn train(descriptors: &[u8], options: &VocabularyOptions, seed: Seed) -> Self {
        let descriptors = descriptors.as_chunks::<DESCRIPTOR_LEN>().0;
        let words = kmeans::cluster(descriptors, options, seed);
        Self { words: words.into_flattened() }
    }

    /// A vocabulary of words that were learnt elsewhere, [`DESCRIPTOR_LEN`] bytes each, row after row; `None` when they are
    /// no whole number of words from 1 to 4096. Words that stand twice count once.
    pub fn from_words(bytes: &[u8]) -> Option<Self> {
        let (words, rest) = bytes.as_chunks::<DESCRIPTOR_LEN>();
        if !rest.is_empty() || !(1..=4096).contains(&words.len()) {
            return None;
        }
        let mut words = words.to_vec();
        words.sort_unstable();
        words.dedup();
        Some(Self { words: words.into_flattened() })
    }

    /// How many words there are.
    pub fn num_words(&self) -> usize {
        self.words.len() / DESCRIPTOR_LEN
    }

    /// Words, row after row.
    pub fn words(&self) -> &[[u8; DESCRIPTOR_LEN]] {
        self.words.as_chunks::<DESCRIPTOR_LEN>().0
    }

    /// The global descriptor of an image: `num_words() * DESCRIPTOR_LEN` numbers of length one, or empty for an image
    /// without features.
    pub fn encode(&self, features: &Features) -> Vec<f32> {
        vlad::encode(self.words(), &features.vectors())
    }
}

/// Draws at most `count` of an image's descriptors for training, without repetition, in the order of the features.
/// [`Features::vectors`] of them, row after row. The seed should be that of the image.
pub fn sample(features: &Features, count: usize, seed: Seed) -> Vec<u8> {
    let descriptors = features.vectors();
    let mut rng = seed.rng();
    let mut wanted = count.min(descriptors.len());
    let mut sampled = Vec::with_capacity(wanted * DESCRIPTOR_LEN);
    for (at, descriptor) in descriptors.iter().enumerate() {
        // Selection sampling (Knuth, volume 2, algorithm S).
        if rng.random_range(0..descriptors.len() - at) < wanted {
            sampled.extend_from_slice(descriptor);
            wanted -= 1;
        }
    }
    sampled
}
