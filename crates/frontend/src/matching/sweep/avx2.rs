//! AVX2: tiles of four rows by 32 columns, sums in 16 bits.
//!
//! A sum begins at 18,700 less the two bases. It may wrap on its way, but ends at most at 32,767; where it ends below
//! −32,768 and wraps, a pair survives that need not. So nothing is ever widened. `vpmaddubsw` wants unsigned rows, so 64 is added
//! to each of their entries; its share, `−64 · Σ column`, is taken off at the beginning too. Two products fit: 2 · 127 · 64.

use std::arch::x86_64::*;
use std::ops::Range;

use super::closest::{LANES, NOBODY};
use super::{CHUNK, Limits, MOST_SURVIVORS};
use crate::matching::sketch::{Code, SKETCH_LEN};

const ROWS: usize = 4;
/// The i16 lanes of a register.
const WIDTH: usize = 16;
/// Registers of columns in a tile.
const GROUP: usize = 2;
const PAIRS: usize = SKETCH_LEN / 2;
/// What is added to the entries of rows.
const OFFSET: i16 = 64;
/// What is added to every sum: most lie far below zero.
const SHIFT: i32 = 18_700;
const _: () = assert!(SHIFT + super::MAX_EXCESS <= i16::MAX as i32);

/// Pairs of entries of four rows, each twice, so that one load fills a register with them.
pub(in crate::matching) struct Rows {
    strips: Vec<[[u32; ROWS]; PAIRS]>,
    len: usize,
}

/// Pairs of entries of sixteen columns side by side.
#[derive(Clone)]
#[repr(C, align(64))]
struct Block([[[i8; 2]; WIDTH]; PAIRS]);

pub(in crate::matching) struct Columns {
    blocks: Vec<Block>,
    starts: Vec<[i16; WIDTH]>,
    len: usize,
}

pub(super) fn is_available() -> bool {
    is_x86_feature_detected!("avx2")
}

impl Rows {
    pub(super) fn new(codes: &[Code]) -> Self {
        Self { strips: codes.chunks(ROWS).map(strip_of).collect(), len: codes.len() }
    }
}

fn strip_of(codes: &[Code]) -> [[u32; ROWS]; PAIRS] {
    let mut strip = [[0; ROWS]; PAIRS];
    for (row, code) in codes.iter().enumerate() {
        for (pair, entries) in code.as_chunks::<2>().0.iter().enumerate() {
            let [a, b] = entries.map(|entry| (i16::from(entry) + OFFSET) as u8);
            strip[pair][row] = u32::from_le_bytes([a, b, a, b]);
        }
    }
    strip
}

impl Columns {
    pub(super) fn new(codes: &[Code]) -> Self {
        let num_blocks = codes.len().div_ceil(WIDTH).next_multiple_of(GROUP);
        let mut blocks = vec![Block([[[0; 2]; WIDTH]; PAIRS]); num_blocks];
        let mut starts = vec![[0; WIDTH]; num_blocks];
        for (at, code) in codes.iter().enumerate() {
            let (block, lane) = (at / WIDTH, at % WIDTH);
            for (pair, entries) in code.as_chunks::<2>().0.iter().enumerate() {
                blocks[block].0[pair][lane] = *entries;
            }
            let sum: i16 = code.iter().map(|&entry| i16::from(entry)).sum();
            starts[block][lane] = sum.wrapping_mul(-OFFSET).wrapping_add(SHIFT as i16);
        }
        Self { blocks, starts, len: codes.len() }
    }
}

/// Limits of `N` codes in 16 bits.
struct Narrow<const N: usize> {
    /// Only its last 16 bits count in sums that may wrap.
    base: [i16; N],
    /// The least sum within reach.
    least: [i16; N],
    /// The least sum within the lone reach.
    lone: [i16; N],
}

fn least(reach: i32) -> i16 {
    (SHIFT - reach).clamp(i32::from(i16::MIN), i32::from(i16::MAX)) as i16
}

fn narrow<const N: usize>(limits: &Limits, block: usize) -> Narrow<N> {
    let mut narrow = Narrow { base: [0; N], least: [i16::MAX; N], lone: [i16::MAX; N] };
    for (lane, at) in (block * N..limits.base.len()).take(N).enumerate() {
        narrow.base[lane] = limits.base[at] as i16;
        narrow.least[lane] = least(limits.reach[at]);
        narrow.lone[lane] = least(limits.lone[at]);
    }
    narrow
}

pub(super) fn sweep(
    (rows, row_limits): (&Rows, &Limits),
    (columns, column_limits): (&Columns, &Limits),
    range: Range<usize>,
    survivors: &mut Vec<(u32, u32)>,
) {
    assert!(is_available(), "this path needs AVX2");
    assert!(rows.len == row_limits.base.len() && columns.len == column_limits.base.len());
    assert!(range.start.is_multiple_of(CHUNK) && range.end <= columns.len);
    for start in range.clone().step_by(CHUNK) {
        let end = range.end.min(start + CHUNK);
        let blocks = start / WIDTH..end.div_ceil(WIDTH).next_multiple_of(GROUP);
        let limits: Vec<_> = blocks.clone().map(|block| narrow(column_limits, block)).collect();
        let chunk = Chunk {
            blocks: &columns.blocks[blocks.clone()],
            starts: &columns.starts[blocks],
            limits: &limits,
            start,
        };
        let from = survivors.len();
        for (strip, rows) in rows.strips.iter().enumerate() {
            if survivors.len() > MOST_SURVIVORS {
                return;
            }
            let row_limits = narrow(row_limits, strip);
            // SAFETY: the processor has AVX2 (asserted).
            unsafe { pass(rows, &row_limits, strip * ROWS, &chunk, survivors) };
        }
        drop_absent(survivors, from, rows.len, end);
    }
}

/// Drops the pairs of lanes that hold no code.
fn drop_absent(survivors: &mut Vec<(u32, u32)>, from: usize, num_rows: usize, end: usize) {
    let mut kept = from;
    for at in from..survivors.len() {
        let (row, column) = survivors[at];
        if (row as usize) < num_rows && (column as usize) < end {
            survivors[kept] = (row, column);
            kept += 1;
        }
    }
    survivors.truncate(kept);
}

/// Columns that stay in cache.
struct Chunk<'a> {
    blocks: &'a [Block],
    starts: &'a [[i16; WIDTH]],
    limits: &'a [Narrow<WIDTH>],
    /// The first column.
    start: usize,
}

/// One strip of rows against a chunk.
#[target_feature(enable = "avx2")]
fn pass(
    rows: &[[u32; ROWS]; PAIRS],
    row_limits: &Narrow<ROWS>,
    first_row: usize,
    chunk: &Chunk<'_>,
    survivors: &mut Vec<(u32, u32)>,
) {
    let blocks = chunk.blocks.as_chunks::<GROUP>().0;
    let starts = chunk.starts.as_chunks::<GROUP>().0;
    let limits = chunk.limits.as_chunks::<GROUP>().0;
    for (at, ((blocks, starts), limits)) in blocks.iter().zip(starts).zip(limits).enumerate() {
        let start = [
            _mm256_sub_epi16(load(&starts[0]), load(&limits[0].base)),
            _mm256_sub_epi16(load(&starts[1]), load(&limits[1].base)),
        ];
        let sums = sums(
            rows,
            blocks,
            [
                lowered(start, row_limits.base[0]),
                lowered(start, row_limits.base[1]),
                lowered(start, row_limits.base[2]),
                lowered(start, row_limits.base[3]),
            ],
        );
        let rejected = [
            rejected(sums[0], (row_limits.least[0], row_limits.lone[0]), limits),
            rejected(sums[1], (row_limits.least[1], row_limits.lone[1]), limits),
            rejected(sums[2], (row_limits.least[2], row_limits.lone[2]), limits),
            rejected(sums[3], (row_limits.least[3], row_limits.lone[3]), limits),
        ];
        let upper = _mm256_and_si256(rejected[0], rejected[1]);
        let lower = _mm256_and_si256(rejected[2], rejected[3]);
        if _mm256_movemask_epi8(_mm256_and_si256(upper, lower)) != -1 {
            let masks = [
                !_mm256_movemask_epi8(rejected[0]) as u32,
                !_mm256_movemask_epi8(rejected[1]) as u32,
                !_mm256_movemask_epi8(rejected[2]) as u32,
                !_mm256_movemask_epi8(rejected[3]) as u32,
            ];
            collect(masks, (first_row, chunk.start + at * GROUP * WIDTH), survivors);
        }
    }
}

#[target_feature(enable = "avx2")]
#[inline]
fn lowered(start: [__m256i; GROUP], base: i16) -> [__m256i; GROUP] {
    let base = _mm256_set1_epi16(base);
    [_mm256_sub_epi16(start[0], base), _mm256_sub_epi16(start[1], base)]
}

/// Bytes of ones where a sum is below what survives; eight lanes of either register in turn.
#[target_feature(enable = "avx2")]
#[inline]
fn rejected(
    sums: [__m256i; GROUP],
    (row_least, row_lone): (i16, i16),
    limits: &[Narrow<WIDTH>; GROUP],
) -> __m256i {
    let (row_least, row_lone) = (_mm256_set1_epi16(row_least), _mm256_set1_epi16(row_lone));
    let mut below = sums;
    for c in 0..GROUP {
        let least = _mm256_max_epi16(row_least, load(&limits[c].least));
        let lone = _mm256_min_epi16(row_lone, load(&limits[c].lone));
        below[c] = _mm256_cmpgt_epi16(_mm256_min_epi16(least, lone), sums[c]);
    }
    _mm256_packs_epi16(below[0], below[1])
}

/// See [`closest`](super::closest).
pub(super) fn closest<const N: usize>(rows: &[Code], columns: &Columns, bases: &[i16]) -> Vec<[u32; N]> {
    assert!(is_available(), "this path needs AVX2");
    assert!(bases.len() == columns.len);
    let mut starts = columns.starts.clone();
    for (at, start) in starts.as_flattened_mut().iter_mut().enumerate() {
        // An absent column's score is never better than none.
        *start = bases.get(at).map_or(i16::MIN, |base| start.wrapping_sub(SHIFT as i16).wrapping_sub(*base));
    }
    let mut found = vec![[0; N]; rows.len()];
    for (rows, found) in rows.chunks(ROWS).zip(found.chunks_mut(ROWS)) {
        // SAFETY: the processor has AVX2 (asserted).
        unsafe { best_of_lanes(&strip_of(rows), &columns.blocks, &starts, found) };
    }
    found
}

/// Of each row the columns of the best lanes; of each lane its best column counts.
#[target_feature(enable = "avx2")]
fn best_of_lanes<const N: usize>(
    rows: &[[u32; ROWS]; PAIRS],
    blocks: &[Block],
    starts: &[[i16; WIDTH]],
    found: &mut [[u32; N]],
) {
    let mut best = [[_mm256_set1_epi16(i16::MIN); GROUP]; ROWS];
    let mut at = [[_mm256_set1_epi16(-1); GROUP]; ROWS];
    let groups = blocks.as_chunks::<GROUP>().0.iter().zip(starts.as_chunks::<GROUP>().0);
    for (group, (blocks, starts)) in groups.enumerate() {
        let sums = sums(rows, blocks, [[load(&starts[0]), load(&starts[1])]; ROWS]);
        let group = _mm256_set1_epi16(group as i16);
        for r in 0..ROWS {
            for c in 0..GROUP {
                let better = _mm256_cmpgt_epi16(sums[r][c], best[r][c]);
                best[r][c] = _mm256_max_epi16(sums[r][c], best[r][c]);
                at[r][c] = _mm256_blendv_epi8(at[r][c], group, better);
            }
        }
    }
    for ((found, best), at) in found.iter_mut().zip(best).zip(at) {
        *found = best_columns(best, at);
    }
}

/// Lanes in rising order.
const LANE_NUMBERS: [[i16; WIDTH]; GROUP] = {
    let mut numbers = [[0; WIDTH]; GROUP];
    let mut lane = 0;
    while lane < LANES {
        numbers[lane / WIDTH][lane % WIDTH] = lane as i16;
        lane += 1;
    }
    numbers
};

/// The columns of the best lanes, the first of equals.
#[target_feature(enable = "avx2")]
#[inline]
fn best_columns<const N: usize>(mut best: [__m256i; GROUP], at: [__m256i; GROUP]) -> [u32; N] {
    let group_of: [i16; LANES] = bytemuck::must_cast(at);
    // Turns the order of signed numbers round into that of unsigned ones, of which the least can be asked for.
    let turn = _mm_set1_epi16(i16::MAX);
    let mut left = u32::MAX;
    let mut columns = [NOBODY; N];
    for column in &mut columns {
        let of_both = _mm256_max_epi16(best[0], best[1]);
        let of_eight = _mm_max_epi16(_mm256_castsi256_si128(of_both), _mm256_extracti128_si256::<1>(of_both));
        let greatest = _mm_xor_si128(_mm_minpos_epu16(_mm_xor_si128(of_eight, turn)), turn);
        let greatest = _mm256_broadcastw_epi16(greatest);
        let (low, high) = (_mm256_cmpeq_epi16(best[0], greatest), _mm256_cmpeq_epi16(best[1], greatest));
        // Packing takes eight lanes of either in turn.
        let equal = _mm256_permute4x64_epi64::<0b11_01_10_00>(_mm256_packs_epi16(low, high));
        let equal = _mm256_movemask_epi8(equal) as u32 & left;
        let lane = (equal | 1 << (LANES - 1)).trailing_zeros() as usize;
        let group = group_of[lane];
        if equal == 0 || group < 0 {
            break;
        }
        *column = group as u32 * LANES as u32 + lane as u32;
        left &= !(1 << lane);
        let taken = _mm256_set1_epi16(lane as i16);
        for (best, numbers) in best.iter_mut().zip(&LANE_NUMBERS) {
            let is_taken = _mm256_cmpeq_epi16(load(numbers), taken);
            *best = _mm256_blendv_epi8(*best, _mm256_set1_epi16(i16::MIN), is_taken);
        }
    }
    columns
}

/// Products added to where their sums begin. Rows are written out, so that all sums stay in registers.
#[target_feature(enable = "avx2")]
#[inline]
fn sums(
    rows: &[[u32; ROWS]; PAIRS],
    blocks: &[Block; GROUP],
    [mut sums_0, mut sums_1, mut sums_2, mut sums_3]: [[__m256i; GROUP]; ROWS],
) -> [[__m256i; GROUP]; ROWS] {
    for pair in 0..PAIRS {
        let columns = [bytemuck::must_cast(blocks[0].0[pair]), bytemuck::must_cast(blocks[1].0[pair])];
        let row = &rows[pair];
        sums_0 = add(sums_0, row[0], columns);
        sums_1 = add(sums_1, row[1], columns);
        sums_2 = add(sums_2, row[2], columns);
        sums_3 = add(sums_3, row[3], columns);
    }
    [sums_0, sums_1, sums_2, sums_3]
}

#[target_feature(enable = "avx2")]
#[inline]
fn add(sums: [__m256i; GROUP], row: u32, columns: [__m256i; GROUP]) -> [__m256i; GROUP] {
    let row = _mm256_set1_epi32(row as i32);
    [
        _mm256_add_epi16(sums[0], _mm256_maddubs_epi16(row, columns[0])),
        _mm256_add_epi16(sums[1], _mm256_maddubs_epi16(row, columns[1])),
    ]
}

/// Appends the pairs whose bits are set.
#[inline]
fn collect(masks: [u32; ROWS], (first_row, first_column): (usize, usize), survivors: &mut Vec<(u32, u32)>) {
    for (r, mut mask) in masks.into_iter().enumerate() {
        while mask != 0 {
            let bit = mask.trailing_zeros();
            mask &= mask - 1;
            // As `rejected` packs them.
            let lane = (bit & 7) | ((bit & 8) << 1) | ((bit & 16) >> 1);
            survivors.push(((first_row + r) as u32, first_column as u32 + lane));
        }
    }
}

#[target_feature(enable = "avx2")]
#[inline]
fn load(words: &[i16; WIDTH]) -> __m256i {
    bytemuck::must_cast(*words)
}
