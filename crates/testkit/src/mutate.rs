//! Mutations of files for fuzzing: seeded, structure-aware where the caller names hot ranges and words of the format.
//!
//! The same seed gives the same bytes, so that a finding is named by its number.

use std::ops::Range;

use rand::{Rng, RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// A valid file to start from.
#[derive(Clone, Debug)]
pub struct Specimen {
    /// What it is, for reports.
    pub name: String,
    /// The file.
    pub bytes: Vec<u8>,
    /// Where its structure lies (headers, tables, directories), as first and past the last byte: half of all mutations
    /// fall here. May be empty.
    pub hot: Vec<(usize, usize)>,
}

impl Specimen {
    /// A file whose first `head` bytes are its structure.
    pub fn new(name: impl Into<String>, bytes: Vec<u8>, head: usize) -> Self {
        let hot = vec![(0, head.min(bytes.len()))];
        Self { name: name.into(), bytes, hot }
    }
}

/// Numbers at which readers break: ends of ranges, signs, small powers of two and their neighbours.
const INTERESTING: [u64; 18] = [
    0,
    1,
    2,
    3,
    7,
    8,
    15,
    16,
    64,
    127,
    128,
    255,
    256,
    0x7fff,
    0xffff,
    0x7fff_ffff,
    0xffff_ffff,
    0x7fff_ffff_ffff_ffff,
];

/// Makes variants of specimens.
#[derive(Clone, Debug)]
pub struct Mutator<'a> {
    specimens: &'a [Specimen],
    words: &'a [&'a [u8]],
    max_len: usize,
}

impl<'a> Mutator<'a> {
    /// For these specimens. `words` are byte strings that mean something in the format; results are at most `max_len`
    /// bytes long, or as long as the specimen.
    pub fn new(specimens: &'a [Specimen], words: &'a [&'a [u8]], max_len: usize) -> Self {
        Self { specimens, words, max_len }
    }

    /// The variant of a number: a specimen's index and bytes, empty when there is no specimen.
    pub fn variant(&self, seed: u64) -> (usize, Vec<u8>) {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        if self.specimens.is_empty() {
            return (0, Vec::new());
        }
        let index = rng.random_range(0..self.specimens.len());
        let specimen = &self.specimens[index];
        let mut bytes = specimen.bytes.clone();
        // Mostly few changes: many of them only meet the first check.
        let count = 1 + (rng.next_u32().leading_zeros() as usize).min(8);
        for _ in 0..count {
            self.mutate(&mut rng, specimen, &mut bytes);
        }
        bytes.truncate(self.max_len.max(specimen.bytes.len()));
        (index, bytes)
    }

    fn mutate(&self, rng: &mut Pcg64Mcg, specimen: &Specimen, bytes: &mut Vec<u8>) {
        if bytes.is_empty() {
            bytes.extend(random_bytes(rng, 8));
            return;
        }
        let at = place(rng, specimen, bytes.len());
        match rng.random_range(0..16) {
            0..3 => bytes[at] ^= 1 << rng.random_range(0..8),
            3 => bytes[at] = rng.random_range(0..=255),
            4..7 => write_number(rng, bytes, at),
            7..9 => add_to_number(rng, bytes, at),
            9 => {
                let end = (at + rng.random_range(1..=32)).min(bytes.len());
                let value = [0, 0xff, bytes[at]][rng.random_range(0..3)];
                bytes[at..end].fill(value);
            }
            10 => {
                let end = (at + rng.random_range(1..=64)).min(bytes.len());
                bytes.drain(at..end);
            }
            11 => {
                let len = rng.random_range(1..=8);
                let inserted = random_bytes(rng, len);
                bytes.splice(at..at, inserted);
            }
            12 => {
                let end = (at + rng.random_range(1..=64)).min(bytes.len());
                let copy = bytes[at..end].to_vec();
                let times = rng.random_range(1..=4);
                (0..times).for_each(|_| drop(bytes.splice(at..at, copy.iter().copied())));
            }
            13 => {
                let donor = &self.specimens[rng.random_range(0..self.specimens.len())].bytes;
                if !donor.is_empty() {
                    let from = rng.random_range(0..donor.len());
                    let piece = &donor[from..(from + rng.random_range(1..=128)).min(donor.len())];
                    let end = (at + piece.len()).min(bytes.len());
                    bytes.splice(at..end, piece.iter().copied());
                }
            }
            14 => bytes.truncate(at),
            _ => {
                let Some(word) = self.words.get(rng.random_range(0..self.words.len().max(1))) else { return };
                let end = if rng.random() { at } else { (at + word.len()).min(bytes.len()) };
                bytes.splice(at..end, word.iter().copied());
            }
        }
    }
}

fn place(rng: &mut Pcg64Mcg, specimen: &Specimen, len: usize) -> usize {
    if !specimen.hot.is_empty() && rng.random() {
        let (start, end) = specimen.hot[rng.random_range(0..specimen.hot.len())];
        if start < end.min(len) {
            return rng.random_range(start..end.min(len));
        }
    }
    rng.random_range(0..len)
}

fn random_bytes(rng: &mut Pcg64Mcg, len: usize) -> Vec<u8> {
    let mut bytes = vec![0; len];
    rng.fill_bytes(&mut bytes);
    bytes
}

/// The place of a number of 1, 2, 4 or 8 bytes; the sizes that files use most come most often.
fn number(rng: &mut Pcg64Mcg, bytes: &[u8], at: usize) -> Range<usize> {
    let size = [1, 2, 2, 4, 4, 8][rng.random_range(0..6)];
    at..(at + size).min(bytes.len())
}

fn write_number(rng: &mut Pcg64Mcg, bytes: &mut [u8], at: usize) {
    let place = number(rng, bytes, at);
    let value = INTERESTING[rng.random_range(0..INTERESTING.len())];
    let value = if rng.random_range(0..4) == 0 { value.wrapping_neg() } else { value };
    put(rng, &mut bytes[place], value);
}

fn add_to_number(rng: &mut Pcg64Mcg, bytes: &mut [u8], at: usize) {
    let place = number(rng, bytes, at);
    let big_endian: bool = rng.random();
    let field = &mut bytes[place];
    let fold = |value: u64, byte: &u8| value << 8 | u64::from(*byte);
    let old = if big_endian { field.iter().fold(0, fold) } else { field.iter().rev().fold(0, fold) };
    let new = old.wrapping_add(rng.random_range(1..=16)).wrapping_sub(8);
    store(field, new, big_endian);
}

fn put(rng: &mut Pcg64Mcg, field: &mut [u8], value: u64) {
    let big_endian = rng.random();
    store(field, value, big_endian);
}

fn store(field: &mut [u8], value: u64, big_endian: bool) {
    let len = field.len();
    for (k, byte) in field.iter_mut().enumerate() {
        let shift = 8 * if big_endian { len - 1 - k } else { k };
        *byte = (value >> shift) as u8;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn variants_are_repeatable_bounded_and_different() {
        let specimens = [Specimen::new("zeros", vec![0; 200], 20), Specimen::new("empty", Vec::new(), 0)];
        let mutator = Mutator::new(&specimens, &[b"word"], 300);
        let mut changed = 0;
        for seed in 0..2000 {
            let (index, bytes) = mutator.variant(seed);
            assert_eq!(mutator.variant(seed), (index, bytes.clone()));
            assert!(bytes.len() <= 300);
            changed += usize::from(bytes != specimens[index].bytes);
        }
        assert!(changed > 1500, "{changed}");
        assert_eq!(Mutator::new(&[], &[], 10).variant(1), (0, Vec::new()));
    }
}
