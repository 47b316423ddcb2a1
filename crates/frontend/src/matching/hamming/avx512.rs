//! AVX-512 VPOPCNTDQ: tiles of four rows by eight columns, sixty-four bits of each column at a time.
//!
//! The path proves itself once a process on a small problem against the scalar one, and is not used where it differs.

use std::arch::x86_64::*;
use std::sync::OnceLock;

use super::Bits;
use super::best::State;
use crate::matching::Nearest;

/// Rows of a tile.
const ROWS: usize = 4;
/// Columns of a block: the 64-bit lanes of a register.
const WIDTH: usize = 8;
/// Words of a descriptor.
const WORDS: usize = 4;
/// Blocks of columns that stay in the first-level cache while all rows pass: 16 KiB.
const CACHED_BLOCKS: usize = 64;

/// A word of each descriptor of a block side by side.
type Block = [[u64; WIDTH]; WORDS];

/// Whether this processor can run this path, and runs it right.
pub(super) fn is_available() -> bool {
    static IS_TRUSTED: OnceLock<bool> = OnceLock::new();
    has_instructions() && *IS_TRUSTED.get_or_init(is_right)
}

fn has_instructions() -> bool {
    is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512vpopcntdq")
}

fn is_right() -> bool {
    let descriptor =
        |k: usize| -> Bits { std::array::from_fn(|byte| ((k * 67 + byte * 29 + k * byte) % 251) as u8) };
    let first: Vec<Bits> = (0..13).map(descriptor).collect();
    let second: Vec<Bits> = (5..28).map(descriptor).collect();
    nearest(&first, &second) == super::nearest_scalar(&first, &second)
}

/// Nearest neighbours in both directions. Falls back to the scalar path where the instructions are missing.
pub(super) fn nearest(first: &[Bits], second: &[Bits]) -> Nearest {
    if !has_instructions() {
        return super::nearest_scalar(first, second);
    }
    let mut sweep = Sweep {
        num_rows: first.len(),
        num_columns: second.len(),
        rows: first.iter().map(words).collect(),
        blocks: blocks(second),
        state: State::new(first.len(), second.len()),
    };
    sweep.rows.resize(first.len().next_multiple_of(ROWS), [0; WORDS]);
    // SAFETY: the processor has AVX-512 F and VPOPCNTDQ, as `has_instructions` has just found.
    unsafe { sweep.run() };
    sweep.state.nearest()
}

fn words(bits: &Bits) -> [u64; WORDS] {
    bytemuck::must_cast(*bits)
}

fn blocks(descriptors: &[Bits]) -> Vec<Block> {
    let of_chunk = |chunk: &[Bits]| {
        let mut block = [[0; WIDTH]; WORDS];
        for (lane, bits) in chunk.iter().enumerate() {
            words(bits).into_iter().enumerate().for_each(|(k, word)| block[k][lane] = word);
        }
        block
    };
    descriptors.chunks(WIDTH).map(of_chunk).collect()
}

struct Sweep {
    num_rows: usize,
    num_columns: usize,
    rows: Vec<[u64; WORDS]>,
    blocks: Vec<Block>,
    state: State,
}

impl Sweep {
    #[target_feature(enable = "avx512f,avx512vpopcntdq")]
    fn run(&mut self) {
        for cached in (0..self.blocks.len()).step_by(CACHED_BLOCKS) {
            let end = (cached + CACHED_BLOCKS).min(self.blocks.len());
            for row in (0..self.rows.len()).step_by(ROWS) {
                for block in cached..end {
                    self.tile(row, block);
                }
            }
        }
    }

    #[target_feature(enable = "avx512f,avx512vpopcntdq")]
    #[inline]
    fn tile(&mut self, row: usize, block: usize) {
        let mut sums = [_mm512_setzero_si512(); ROWS];
        for k in 0..WORDS {
            let column = load(&self.blocks[block][k]);
            for r in 0..ROWS {
                let differing = _mm512_xor_si512(column, _mm512_set1_epi64(self.rows[row + r][k] as i64));
                sums[r] = _mm512_add_epi64(sums[r], _mm512_popcnt_epi64(differing));
            }
        }
        let first_column = block * WIDTH;
        let second =
            |at: usize| self.state.columns.second.get(first_column + at).map_or(0, |&d| u64::from(d));
        let column_limits = load(&std::array::from_fn(second));
        for r in 0..ROWS {
            let row_limit = self.state.rows.second.get(row + r).map_or(0, |&d| i64::from(d));
            let mask = _mm512_cmplt_epi64_mask(sums[r], _mm512_set1_epi64(row_limit))
                | _mm512_cmplt_epi64_mask(sums[r], column_limits);
            if mask != 0 {
                let mut distances = [0_u64; WIDTH];
                // SAFETY: `distances` is 64 bytes long, and the store needs no alignment.
                unsafe { _mm512_storeu_si512(distances.as_mut_ptr().cast(), sums[r]) };
                self.offer(row + r, first_column, u32::from(mask), &distances);
            }
        }
    }

    /// Offers the few distances that may be among the two least of their row or column.
    #[inline(never)]
    fn offer(&mut self, row: usize, first_column: usize, mut mask: u32, distances: &[u64; WIDTH]) {
        while mask != 0 {
            let lane = mask.trailing_zeros() as usize;
            mask &= mask - 1;
            if row < self.num_rows && first_column + lane < self.num_columns {
                self.state.offer(row, first_column + lane, distances[lane] as u16);
            }
        }
    }
}

#[target_feature(enable = "avx512f")]
#[inline]
fn load(words: &[u64; WIDTH]) -> __m512i {
    // SAFETY: the reference covers 64 bytes, and the load needs no alignment.
    unsafe { _mm512_loadu_si512(words.as_ptr().cast()) }
}
