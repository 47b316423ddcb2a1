//! AVX2: tiles of four rows by sixty-four columns.
//!
//! Bits are counted by table (Muła et al. 2018), four at a time: for each value of four bits of a row there is a table of
//! how many differ from each value of four bits of a column, so that one shuffle and one addition count them in
//! thirty-two columns. Sums are bytes that stop at 255; the distances 255 and 256 are told apart where one is offered.

use std::arch::x86_64::*;

use super::best::State;
use super::{Bits, distance};
use crate::matching::Nearest;

/// Rows of a tile.
const ROWS: usize = 4;
/// Columns of a block: the bytes of a register.
const WIDTH: usize = 32;
/// Blocks of columns in a tile.
const GROUP: usize = 2;
/// Groups of four bits in a descriptor.
const NIBBLES: usize = 64;
/// Blocks of columns that stay in the first-level cache while all rows pass: 16 KiB.
const CACHED_BLOCKS: usize = 8;

/// Four bits of each descriptor of a block side by side.
#[derive(Clone)]
#[repr(C, align(64))]
struct Block([[u8; WIDTH]; NIBBLES]);

#[repr(C, align(64))]
struct Tables([[u8; WIDTH]; 16]);

/// Entry `[a][b]`: bits in which `a` and `b % 16` differ, twice sixteen of them for both halves of a register.
static TABLES: Tables = {
    let mut tables = [[0; WIDTH]; 16];
    let mut a = 0;
    while a < 16 {
        let mut b = 0;
        while b < WIDTH {
            tables[a][b] = (a ^ (b % 16)).count_ones() as u8;
            b += 1;
        }
        a += 1;
    }
    Tables(tables)
};

/// Whether this processor can run this path.
pub(super) fn is_available() -> bool {
    is_x86_feature_detected!("avx2")
}

/// Nearest neighbours in both directions. Falls back to the scalar path where AVX2 is missing.
pub(super) fn nearest(first: &[Bits], second: &[Bits]) -> Nearest {
    if !is_available() {
        return super::nearest_scalar(first, second);
    }
    let mut sweep = Sweep {
        first,
        second,
        rows: first.iter().map(nibbles).collect(),
        blocks: blocks(second),
        row_limits: vec![u8::MAX; first.len().next_multiple_of(ROWS)],
        column_limits: vec![[u8::MAX; WIDTH]; second.len().div_ceil(WIDTH).next_multiple_of(GROUP)],
        state: State::new(first.len(), second.len()),
    };
    sweep.rows.resize(first.len().next_multiple_of(ROWS), [0; NIBBLES]);
    // SAFETY: the processor has AVX2, as `is_available` has just found.
    unsafe { sweep.run() };
    sweep.state.nearest()
}

fn nibbles(bits: &Bits) -> [u8; NIBBLES] {
    std::array::from_fn(|k| (bits[k / 2] >> (4 * (k % 2))) & 15)
}

fn blocks(descriptors: &[Bits]) -> Vec<Block> {
    let of_chunk = |chunk: &[Bits]| {
        let mut block = Block([[0; WIDTH]; NIBBLES]);
        for (lane, bits) in chunk.iter().enumerate() {
            for (plane, nibble) in block.0.iter_mut().zip(nibbles(bits)) {
                plane[lane] = nibble;
            }
        }
        block
    };
    let mut blocks: Vec<Block> = descriptors.chunks(WIDTH).map(of_chunk).collect();
    blocks.resize(blocks.len().next_multiple_of(GROUP), Block([[0; WIDTH]; NIBBLES]));
    blocks
}

struct Sweep<'a> {
    first: &'a [Bits],
    second: &'a [Bits],
    rows: Vec<[u8; NIBBLES]>,
    blocks: Vec<Block>,
    /// The greatest distance that would still be among the two least.
    row_limits: Vec<u8>,
    column_limits: Vec<[u8; WIDTH]>,
    state: State,
}

type Tile = [[__m256i; GROUP]; ROWS];

impl Sweep<'_> {
    #[target_feature(enable = "avx2")]
    fn run(&mut self) {
        for cached in (0..self.blocks.len()).step_by(CACHED_BLOCKS) {
            let end = (cached + CACHED_BLOCKS).min(self.blocks.len());
            for row in (0..self.rows.len()).step_by(ROWS) {
                for group in (cached..end).step_by(GROUP) {
                    self.tile(row, group);
                }
            }
        }
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    fn tile(&mut self, row: usize, group: usize) {
        let Some(rows) = self.rows[row..].first_chunk::<ROWS>() else { return };
        let distances = distances(rows, [&self.blocks[group], &self.blocks[group + 1]]);
        for c in 0..GROUP {
            let column_limits = load(&self.column_limits[group + c]);
            for r in 0..ROWS {
                let limits = _mm256_max_epu8(_mm256_set1_epi8(self.row_limits[row + r] as i8), column_limits);
                let distances = distances[r][c];
                let is_near = _mm256_cmpeq_epi8(_mm256_min_epu8(distances, limits), distances);
                let mask = _mm256_movemask_epi8(is_near) as u32;
                if mask != 0 {
                    self.offer(row + r, group + c, mask, &bytemuck::must_cast(distances));
                }
            }
        }
    }

    /// Offers the few distances that may be among the two least of their row or column.
    #[inline(never)]
    fn offer(&mut self, row: usize, block: usize, mut mask: u32, distances: &[u8; WIDTH]) {
        let Some(a) = self.first.get(row) else { return };
        while mask != 0 {
            let lane = mask.trailing_zeros() as usize;
            mask &= mask - 1;
            let column = block * WIDTH + lane;
            let Some(b) = self.second.get(column) else { return };
            let near = distances[lane];
            let exact = if near == u8::MAX { distance(a, b) } else { u16::from(near) };
            self.state.offer(row, column, exact);
            self.row_limits[row] = limit(self.state.rows.second[row]);
            self.column_limits[block][lane] = limit(self.state.columns.second[column]);
        }
    }
}

/// The greatest distance below the second least one, as a byte that stops at 255. A second least distance of zero, which
/// nothing can beat, gives zero all the same: offers are checked again.
fn limit(second: u16) -> u8 {
    second.saturating_sub(1).min(u16::from(u8::MAX)) as u8
}

/// Distances between four rows and sixty-four columns. Rows are written out, so that all sums stay in registers.
#[target_feature(enable = "avx2")]
#[inline]
fn distances(rows: &[[u8; NIBBLES]; ROWS], blocks: [&Block; GROUP]) -> Tile {
    let zero = [_mm256_setzero_si256(); GROUP];
    let (mut sums_0, mut sums_1, mut sums_2, mut sums_3) = (zero, zero, zero, zero);
    for k in 0..NIBBLES {
        let columns = [load(&blocks[0].0[k]), load(&blocks[1].0[k])];
        sums_0 = add(sums_0, rows[0][k], columns);
        sums_1 = add(sums_1, rows[1][k], columns);
        sums_2 = add(sums_2, rows[2][k], columns);
        sums_3 = add(sums_3, rows[3][k], columns);
    }
    [sums_0, sums_1, sums_2, sums_3]
}

#[target_feature(enable = "avx2")]
#[inline]
fn add(sums: [__m256i; GROUP], row: u8, columns: [__m256i; GROUP]) -> [__m256i; GROUP] {
    let table = load(&TABLES.0[usize::from(row & 15)]);
    [
        _mm256_adds_epu8(sums[0], _mm256_shuffle_epi8(table, columns[0])),
        _mm256_adds_epu8(sums[1], _mm256_shuffle_epi8(table, columns[1])),
    ]
}

#[target_feature(enable = "avx2")]
#[inline]
fn load(bytes: &[u8; WIDTH]) -> __m256i {
    bytemuck::must_cast(*bytes)
}
