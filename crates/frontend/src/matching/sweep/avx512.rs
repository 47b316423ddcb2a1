//! AVX-512 VNNI: tiles of eight rows by 32 columns, sums in 32 bits.
//!
//! `vpdpbusd` wants unsigned rows, so 64 is added to each of their entries; its share, `−64 · Σ column`, is where a
//! column's sums begin.

use std::arch::x86_64::*;
use std::ops::Range;

use super::{CHUNK, Limits, MOST_SURVIVORS};
use crate::matching::sketch::{Code, SKETCH_LEN};

const ROWS: usize = 8;
/// The i32 lanes of a register.
const WIDTH: usize = 16;
/// Registers of columns in a tile.
const GROUP: usize = 2;
const QUADS: usize = SKETCH_LEN / 4;
/// What is added to the entries of rows.
const OFFSET: i32 = 64;
/// Above every product and below every overflow.
const FAR: i32 = 1 << 28;

/// Four entries of eight rows side by side.
pub(in crate::matching) struct Rows {
    strips: Vec<[[i32; ROWS]; QUADS]>,
    len: usize,
}

/// Four entries of sixteen columns side by side.
#[derive(Clone)]
#[repr(C, align(64))]
struct Block([[i32; WIDTH]; QUADS]);

pub(in crate::matching) struct Columns {
    blocks: Vec<Block>,
    starts: Vec<[i32; WIDTH]>,
    len: usize,
}

pub(super) fn is_available() -> bool {
    is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512vnni")
}

impl Rows {
    pub(super) fn new(codes: &[Code]) -> Self {
        let strip_of = |codes: &[Code]| {
            let mut strip = [[0; ROWS]; QUADS];
            for (row, code) in codes.iter().enumerate() {
                for (quad, entries) in code.as_chunks::<4>().0.iter().enumerate() {
                    let unsigned = entries.map(|entry| (i32::from(entry) + OFFSET) as u8);
                    strip[quad][row] = i32::from_le_bytes(unsigned);
                }
            }
            strip
        };
        Self { strips: codes.chunks(ROWS).map(strip_of).collect(), len: codes.len() }
    }
}

impl Columns {
    pub(super) fn new(codes: &[Code]) -> Self {
        let num_blocks = codes.len().div_ceil(WIDTH).next_multiple_of(GROUP);
        let mut blocks = vec![Block([[0; WIDTH]; QUADS]); num_blocks];
        let mut starts = vec![[0; WIDTH]; num_blocks];
        for (at, code) in codes.iter().enumerate() {
            let (block, lane) = (at / WIDTH, at % WIDTH);
            for (quad, entries) in code.as_chunks::<4>().0.iter().enumerate() {
                blocks[block].0[quad][lane] = i32::from_le_bytes(entries.map(|entry| entry as u8));
            }
            starts[block][lane] = -OFFSET * code.iter().map(|&entry| i32::from(entry)).sum::<i32>();
        }
        Self { blocks, starts, len: codes.len() }
    }
}

/// Limits of `N` codes, whose differences can't overflow. Absent codes never survive: their base is too great.
struct Near<const N: usize> {
    base: [i32; N],
    reach: [i32; N],
    lone: [i32; N],
}

fn near<const N: usize>(limits: &Limits, block: usize) -> Near<N> {
    let mut near = Near { base: [2 * FAR; N], reach: [0; N], lone: [0; N] };
    for (lane, at) in (block * N..limits.base.len()).take(N).enumerate() {
        near.base[lane] = limits.base[at].clamp(-FAR / 4, FAR / 4);
        near.reach[lane] = limits.reach[at].min(FAR);
        near.lone[lane] = limits.lone[at].min(FAR);
    }
    near
}

pub(super) fn sweep(
    (rows, row_limits): (&Rows, &Limits),
    (columns, column_limits): (&Columns, &Limits),
    range: Range<usize>,
    survivors: &mut Vec<(u32, u32)>,
) {
    assert!(is_available(), "this path needs AVX-512 VNNI");
    assert!(rows.len == row_limits.base.len() && columns.len == column_limits.base.len());
    assert!(range.start.is_multiple_of(CHUNK) && range.end <= columns.len);
    for start in range.clone().step_by(CHUNK) {
        let end = range.end.min(start + CHUNK);
        let blocks = start / WIDTH..end.div_ceil(WIDTH).next_multiple_of(GROUP);
        let limits: Vec<_> = blocks.clone().map(|block| near(column_limits, block)).collect();
        let chunk = Chunk {
            blocks: &columns.blocks[blocks.clone()],
            starts: &columns.starts[blocks],
            limits: &limits,
            start,
        };
        for (strip, rows) in rows.strips.iter().enumerate() {
            if survivors.len() > MOST_SURVIVORS {
                return;
            }
            let row_limits = near(row_limits, strip);
            // SAFETY: the processor has AVX-512 F and VNNI (asserted).
            unsafe { pass(rows, &row_limits, strip * ROWS, &chunk, survivors) };
        }
    }
}

/// Columns that stay in cache.
struct Chunk<'a> {
    blocks: &'a [Block],
    starts: &'a [[i32; WIDTH]],
    limits: &'a [Near<WIDTH>],
    /// The first column.
    start: usize,
}

/// One strip of rows against a chunk.
#[target_feature(enable = "avx512f,avx512vnni")]
fn pass(
    rows: &[[i32; ROWS]; QUADS],
    row_limits: &Near<ROWS>,
    first_row: usize,
    chunk: &Chunk<'_>,
    survivors: &mut Vec<(u32, u32)>,
) {
    for (at, block) in chunk.blocks.iter().enumerate() {
        let start = load(&chunk.starts[at]);
        let mut dots = [start; ROWS];
        for quad in 0..QUADS {
            let column = load(&block.0[quad]);
            for r in 0..ROWS {
                dots[r] = _mm512_dpbusd_epi32(dots[r], _mm512_set1_epi32(rows[quad][r]), column);
            }
        }
        let (base, reach) = (load(&chunk.limits[at].base), load(&chunk.limits[at].reach));
        let lone = load(&chunk.limits[at].lone);
        let mut masks = [0; ROWS];
        let mut any = 0;
        for r in 0..ROWS {
            let reach = _mm512_min_epi32(reach, _mm512_set1_epi32(row_limits.reach[r]));
            let lone = _mm512_max_epi32(lone, _mm512_set1_epi32(row_limits.lone[r]));
            let reach = _mm512_max_epi32(reach, lone);
            let least =
                _mm512_sub_epi32(_mm512_add_epi32(base, _mm512_set1_epi32(row_limits.base[r])), reach);
            masks[r] = _mm512_cmpge_epi32_mask(dots[r], least);
            any |= masks[r];
        }
        if any != 0 {
            collect(&masks, (first_row, chunk.start + at * WIDTH), survivors);
        }
    }
}

#[inline(never)]
fn collect(masks: &[u16; ROWS], (first_row, first_column): (usize, usize), survivors: &mut Vec<(u32, u32)>) {
    for (r, &mask) in masks.iter().enumerate() {
        let mut mask = mask;
        while mask != 0 {
            let lane = mask.trailing_zeros() as usize;
            mask &= mask - 1;
            survivors.push(((first_row + r) as u32, (first_column + lane) as u32));
        }
    }
}

#[target_feature(enable = "avx512f")]
#[inline]
pub(super) fn load(words: &[i32; WIDTH]) -> __m512i {
    // SAFETY: the reference covers 64 bytes, and the load needs no alignment.
    unsafe { _mm512_loadu_si512(words.as_ptr().cast()) }
}
