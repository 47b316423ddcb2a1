//! AVX-512 VNNI: tiles of eight rows by thirty-two columns, exact in integers.
//!
//! `vpdpbusd` adds four products of unsigned and signed bytes into i32 without saturation. Columns are stored less an
//! offset, so that they are signed; the offset's share, `offset · Σ row`, is added at the end.

use std::arch::x86_64::*;

use terrane_scene::DESCRIPTOR_LEN;

use super::nearest::{Best, Nearest};
use super::pack::{Block, Packed, QUADS, Side};

/// Rows of a tile.
const ROWS: usize = 8;
/// Columns of a block: the i32 lanes of a register.
const WIDTH: usize = 16;
/// Blocks of columns in a tile.
const GROUP: usize = 2;
/// Blocks of columns that stay in the first-level cache while all rows pass: 16 KiB.
const CACHED_BLOCKS: usize = 8;

type Tile = [[__m512i; GROUP]; ROWS];

/// Whether this processor can run this path.
pub(super) fn is_available() -> bool {
    is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512vnni")
}

/// Nearest neighbours in both directions. Falls back to the scalar path where AVX-512 VNNI is missing.
pub(super) fn nearest(first: &[[u8; DESCRIPTOR_LEN]], second: &[[u8; DESCRIPTOR_LEN]]) -> Nearest {
    if !is_available() {
        return super::scalar::nearest(first, second);
    }
    let rows = Packed::new(first, Side::Rows, 1);
    let columns = Packed::new(second, Side::Columns, GROUP);
    let mut state =
        State { row_best: Best::new(rows.num_lanes()), column_best: Best::new(columns.num_lanes()) };
    // SAFETY: the processor has AVX-512 F and VNNI, as `is_available` has just found.
    unsafe { sweep(&rows, &columns, &mut state) };
    Nearest {
        rows: state.row_best.neighbours(&rows.order, &columns.order),
        columns: state.column_best.neighbours(&columns.order, &rows.order),
    }
}

struct State {
    row_best: Best,
    column_best: Best,
}

#[target_feature(enable = "avx512f,avx512vnni")]
fn sweep(rows: &Packed<ROWS>, columns: &Packed<WIDTH>, state: &mut State) {
    for cached in (0..columns.blocks.len()).step_by(CACHED_BLOCKS) {
        let end = (cached + CACHED_BLOCKS).min(columns.blocks.len());
        for strip in 0..rows.blocks.len() {
            for group in (cached..end).step_by(GROUP) {
                tile(rows, columns, (strip, group), state);
            }
        }
    }
}

#[target_feature(enable = "avx512f,avx512vnni")]
#[inline]
fn tile(rows: &Packed<ROWS>, columns: &Packed<WIDTH>, (strip, group): (usize, usize), state: &mut State) {
    let row_lanes = &rows.lanes[strip];
    let dots = dots(&rows.blocks[strip], [&columns.blocks[group], &columns.blocks[group + 1]]);
    let row_second: [i32; ROWS] = *lanes_at(&state.row_best.second, strip);
    let mut scores = dots;
    let mut better = [[0; GROUP]; ROWS];
    let mut any = 0;
    for c in 0..GROUP {
        let column_second = load(lanes_at(&state.column_best.second, group + c));
        let column_lanes = &columns.lanes[group + c];
        let minus_norm = load(&column_lanes.minus_norm);
        for r in 0..ROWS {
            let constant = row_lanes.minus_norm[r] + column_lanes.offset * row_lanes.twice_sum[r];
            let constant = _mm512_add_epi32(minus_norm, _mm512_set1_epi32(constant));
            scores[r][c] = _mm512_add_epi32(_mm512_slli_epi32::<1>(dots[r][c]), constant);
            better[r][c] = _mm512_cmpgt_epi32_mask(scores[r][c], _mm512_set1_epi32(row_second[r]))
                | _mm512_cmpgt_epi32_mask(scores[r][c], column_second);
            any |= better[r][c];
        }
    }
    if any != 0 {
        offer(&scores, &better, (strip, group), state);
    }
}

#[target_feature(enable = "avx512f,avx512vnni")]
#[inline]
fn dots(rows: &Block<ROWS>, columns: [&Block<WIDTH>; GROUP]) -> Tile {
    let mut dots = [[_mm512_setzero_si512(); GROUP]; ROWS];
    for quad in 0..QUADS {
        for c in 0..GROUP {
            let column = load(&columns[c].0[quad]);
            for r in 0..ROWS {
                dots[r][c] = _mm512_dpbusd_epi32(dots[r][c], _mm512_set1_epi32(rows.0[quad][r]), column);
            }
        }
    }
    dots
}

/// Offers the few scores of a tile that beat a second best.
#[target_feature(enable = "avx512f")]
#[inline(never)]
fn offer(
    scores: &Tile,
    better: &[[__mmask16; GROUP]; ROWS],
    (strip, group): (usize, usize),
    state: &mut State,
) {
    for r in 0..ROWS {
        for c in 0..GROUP {
            let mut mask = u32::from(better[r][c]);
            if mask == 0 {
                continue;
            }
            let mut values = [0; WIDTH];
            // SAFETY: `values` is 64 bytes long, and the store needs no alignment.
            unsafe { _mm512_storeu_si512(values.as_mut_ptr().cast(), scores[r][c]) };
            while mask != 0 {
                let lane = mask.trailing_zeros() as usize;
                mask &= mask - 1;
                let (row, column) = (strip * ROWS + r, (group + c) * WIDTH + lane);
                state.row_best.offer(row, column, values[lane]);
                state.column_best.offer(column, row, values[lane]);
            }
        }
    }
}

#[target_feature(enable = "avx512f")]
#[inline]
fn load(words: &[i32; WIDTH]) -> __m512i {
    // SAFETY: the reference covers 64 bytes, and the load needs no alignment.
    unsafe { _mm512_loadu_si512(words.as_ptr().cast()) }
}

/// The `block`-th group of `L` values.
#[inline]
fn lanes_at<const L: usize>(values: &[i32], block: usize) -> &[i32; L] {
    &values.as_chunks::<L>().0[block]
}
