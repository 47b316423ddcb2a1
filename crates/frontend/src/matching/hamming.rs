//! Binary features that look alike: exact nearest neighbours by Hamming distance in both directions.
//!
//! Distances are whole numbers from 0 to 256, so every kernel gives the same answer. Ratio and mutual tests are those of
//! vectors, with the Hamming distance in place of the Euclidean one; of bits its root is the Euclidean distance, so that a
//! ratio here is the square of one there.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod best;
#[cfg(test)]
mod tests;

use serde::{Deserialize, Serialize};
use terrane_scene::BINARY_DESCRIPTOR_LEN;

use super::{Match, MatchOptions, Nearest, Neighbour};
use best::Best;

/// 256 bits.
type Bits = [u8; BINARY_DESCRIPTOR_LEN];

/// Limits of the tests for binary descriptors.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BinaryMatchOptions {
    /// Greatest Hamming distance to a match over that to the runner-up, in (0, 1]. Default 0.8. A tie is never a match.
    pub max_ratio: f64,
    /// Greatest Hamming distance of a match, 0 to 256. Default 80: of unrelated descriptors a pair in a thousand million
    /// is that near.
    pub max_distance: u32,
}

impl Default for BinaryMatchOptions {
    fn default() -> Self {
        Self { max_ratio: 0.8, max_distance: 80 }
    }
}

/// One way to find nearest neighbours by Hamming distance; all give the same answer.
#[derive(Clone, Copy, Debug)]
pub struct HammingKernel {
    name: &'static str,
    nearest: fn(&[Bits], &[Bits]) -> Nearest,
}

impl HammingKernel {
    const SCALAR: Self = Self { name: "scalar", nearest: nearest_scalar };

    /// The kernels that this processor can run, slowest first. The first is the oracle.
    pub fn available() -> Vec<Self> {
        #[allow(unused_mut)]
        let mut kernels = vec![Self::SCALAR];
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("popcnt") {
                kernels.push(Self { name: "popcnt", nearest: nearest_popcnt });
            }
            if avx2::is_available() {
                kernels.push(Self { name: "avx2", nearest: avx2::nearest });
            }
            if avx512::is_available() {
                kernels.push(Self { name: "avx512-vpopcntdq", nearest: avx512::nearest });
            }
        }
        kernels
    }

    /// The fastest kernel that this processor can run.
    pub fn fastest() -> Self {
        Self::available().pop().unwrap_or(Self::SCALAR)
    }

    /// Which path this is: `scalar`, `popcnt`, `avx2` or `avx512-vpopcntdq`.
    pub fn name(&self) -> &'static str {
        self.name
    }

    /// Nearest neighbours in both directions; squared distances are Hamming distances. At most 2³² − 1 descriptors a
    /// side.
    pub fn nearest(&self, first: &[Bits], second: &[Bits]) -> Nearest {
        (self.nearest)(first, second)
    }
}

/// Bits in which two descriptors differ.
#[inline(always)]
fn distance(a: &Bits, b: &Bits) -> u16 {
    let words = |bits: &Bits| -> [u64; 4] { bytemuck::must_cast(*bits) };
    let (a, b) = (words(a), words(b));
    (0..4).map(|k| (a[k] ^ b[k]).count_ones() as u16).sum()
}

/// The oracle: one pair after another.
fn nearest_scalar(first: &[Bits], second: &[Bits]) -> Nearest {
    nearest_body(first, second)
}

/// The same with the processor's instruction for counting bits. Falls back to the scalar path where it is missing.
#[cfg(target_arch = "x86_64")]
fn nearest_popcnt(first: &[Bits], second: &[Bits]) -> Nearest {
    #[target_feature(enable = "popcnt")]
    fn with_popcnt(first: &[Bits], second: &[Bits]) -> Nearest {
        nearest_body(first, second)
    }
    if !is_x86_feature_detected!("popcnt") {
        return nearest_scalar(first, second);
    }
    // SAFETY: the processor has just been seen to have the instruction.
    unsafe { with_popcnt(first, second) }
}

#[inline(always)]
fn nearest_body(first: &[Bits], second: &[Bits]) -> Nearest {
    let (mut rows, mut columns) = (Best::new(first.len()), Best::new(second.len()));
    for (row, a) in first.iter().enumerate() {
        for (column, b) in second.iter().enumerate() {
            let distance = distance(a, b);
            rows.offer(row, column, distance);
            columns.offer(column, row, distance);
        }
    }
    Nearest { rows: rows.neighbours(), columns: columns.neighbours() }
}

/// Matches binary features with the fastest kernel. Ascending in `first`; one thread.
pub(super) fn match_bits(first: &[Bits], second: &[Bits], options: &MatchOptions) -> Vec<Match> {
    let nearest = HammingKernel::fastest().nearest(first, second);
    let limits = &options.binary;
    let of_row = |(row, neighbour): (usize, &Neighbour)| {
        let column = neighbour.index?;
        let mut ratio = passing_ratio(neighbour, limits)?;
        if options.mutual {
            let back = nearest.columns.get(column as usize)?;
            if back.index != Some(row as u32) {
                return None;
            }
            ratio = ratio.max(passing_ratio(back, limits)?);
        }
        Some(Match { first: row as u32, second: column, ratio: ratio as f32 })
    };
    nearest.rows.iter().enumerate().filter_map(of_row).collect()
}

/// The ratio of a neighbour, or `None` when it or the distance is above its limit.
fn passing_ratio(neighbour: &Neighbour, limits: &BinaryMatchOptions) -> Option<f64> {
    if neighbour.distance_squared > limits.max_distance {
        return None;
    }
    if neighbour.second_squared == u32::MAX {
        return Some(0.0);
    }
    let ratio = f64::from(neighbour.distance_squared) / f64::from(neighbour.second_squared);
    (ratio <= limits.max_ratio).then_some(ratio)
}
