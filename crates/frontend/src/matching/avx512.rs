//! AVX-512 VNNI: tiles of eight rows by thirty-two columns, exact in integers.
//!
//! `vpdpbusd` adds four products of unsigned and signed bytes into i32 without saturation. Columns are stored less an
//! offset, so that they are signed; the offset's share, `offset · Σ row`, is added at the end.

use std::arch::x86_64::*;

use terrane_scene::DESCRIPTOR_LEN;

use super::nearest::{Best, Nearest};
use super::pack::{Block, Form, Lanes, Packed, QUADS};

/// Rows of a tile.
pub(super) const ROWS: usize = 8;
/// Columns of a block: the i32 lanes of a register.
pub(super) const WIDTH: usize = 16;
/// Blocks of columns in a tile.
pub(super) const GROUP: usize = 2;
/// Blocks of columns that stay in the first-level cache while all rows pass: 16 KiB.
const CACHED_BLOCKS: usize = 8;

pub(super) type Tile = [[__m512i; GROUP]; ROWS];

/// Rows of this path.
pub(super) type Rows = Packed<ROWS>;
/// Columns of this path.
pub(super) type Columns = Packed<WIDTH>;

/// Whether this processor can run this path.
pub(super) fn is_available() -> bool {
    is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512vnni")
}

/// Lays out the first side.
pub(super) fn rows(descriptors: &[[u8; DESCRIPTOR_LEN]]) -> Rows {
    Packed::new(descriptors, Form::Unsigned, 1)
}

/// Lays out the second side.
pub(super) fn columns(descriptors: &[[u8; DESCRIPTOR_LEN]]) -> Columns {
    Packed::new(descriptors, Form::Signed, GROUP)
}

/// Nearest neighbours in both directions.
///
/// # Panics
/// On a processor without AVX-512 VNNI.
pub(super) fn nearest(rows: &Rows, columns: &Columns) -> Nearest {
    assert!(is_available(), "this path needs AVX-512 VNNI");
    let mut state =
        State { row_best: Best::new(rows.num_lanes()), column_best: Best::new(columns.num_lanes()) };
    // SAFETY: the processor has AVX-512 F and VNNI, as `is_available` has just found.
    unsafe { sweep(rows, columns, &mut state) };
    Nearest {
        rows: state.row_best.neighbours(&rows.order, &columns.order),
        columns: state.column_best.neighbours(&columns.order, &rows.order),
    }
}

/// The best so far of both sides.
pub(super) struct State {
    pub(super) row_best: Best,
    pub(super) column_best: Best,
}

#[target_feature(enable = "avx512f,avx512vnni")]
fn sweep(rows: &Rows, columns: &Columns, state: &mut State) {
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
fn tile(rows: &Rows, columns: &Columns, (strip, group): (usize, usize), state: &mut State) {
    let dots = dots(&rows.blocks[strip], [&columns.blocks[group], &columns.blocks[group + 1]]);
    let column_lanes = [&columns.lanes[group], &columns.lanes[group + 1]];
    settle(&dots, &rows.lanes[strip], column_lanes, (strip, group), state);
}

/// Turns a tile of products into scores and keeps those that beat a second best.
#[target_feature(enable = "avx512f")]
#[inline]
pub(super) fn settle(
    dots: &Tile,
    row_lanes: &Lanes<ROWS>,
    column_lanes: [&Lanes<WIDTH>; GROUP],
    (strip, group): (usize, usize),
    state: &mut State,
) {
    let row_second: [i32; ROWS] = *lanes_at(&state.row_best.second, strip);
    let mut scores = *dots;
    let mut better = [[0; GROUP]; ROWS];
    let mut any = 0;
    for c in 0..GROUP {
        let column_second = load(lanes_at(&state.column_best.second, group + c));
        let minus_norm = load(&column_lanes[c].minus_norm);
        for r in 0..ROWS {
            let constant = row_lanes.minus_norm[r] + column_lanes[c].offset * row_lanes.twice_sum[r];
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
pub(super) fn load(words: &[i32; WIDTH]) -> __m512i {
    // SAFETY: the reference covers 64 bytes, and the load needs no alignment.
    unsafe { _mm512_loadu_si512(words.as_ptr().cast()) }
}

/// The `block`-th group of `L` values.
#[inline]
fn lanes_at<const L: usize>(values: &[i32], block: usize) -> &[i32; L] {
    &values.as_chunks::<L>().0[block]
}
