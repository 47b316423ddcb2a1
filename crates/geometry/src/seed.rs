//! Seeds that are hashed, never drawn.

use rand_pcg::Pcg64Mcg;
use serde::{Deserialize, Serialize};
use xxhash_rust::xxh3::xxh3_64_with_seed;

/// The seed of one random stream, derived from (run, stage, item) so that order, threads and neighbours do not matter.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Seed(pub u64);

impl Seed {
    /// The seed of a part: a stage's name, or an item's number as bytes.
    pub fn derive(self, part: impl AsRef<[u8]>) -> Seed {
        Seed(xxh3_64_with_seed(part.as_ref(), self.0))
    }

    /// The seed of the item with these numbers, as (image, image) of a pair.
    pub fn item(self, numbers: &[u64]) -> Seed {
        numbers.iter().fold(self, |seed, number| seed.derive(number.to_le_bytes()))
    }

    /// A generator for this seed: small, fast, and stable between versions.
    pub fn rng(self) -> Pcg64Mcg {
        Pcg64Mcg::new(u128::from(self.0) << 64 | u128::from(self.derive(b"stream").0))
    }
}
