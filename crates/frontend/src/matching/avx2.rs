//! AVX2: tiles of four rows by sixteen columns, exact in integers.
//!
//! `vpmaddubsw` multiplies unsigned by signed bytes and adds neighbours, but saturates in i16. Columns are stored less
//! an offset: 64 when no byte exceeds 127, so that a row byte (at most 127) times a column byte (-64 to 63) is at most
//! 8,128 in size and *four* products still fit; two multiplications then share one widening. Tiles with a greater byte
//! widen bytes to i16 first (`vpmaddwd`). The offset's share, `offset · Σ row`, is added at the end.

use std::arch::x86_64::*;

use terrane_scene::DESCRIPTOR_LEN;

use super::nearest::{Best, Nearest};
use super::pack::{Block, Form, Lanes, Packed, QUADS};

/// Rows of a tile.
pub(super) const ROWS: usize = 4;
/// Columns of a block: the i32 lanes of a register.
pub(super) const WIDTH: usize = 8;
/// Blocks of columns in a tile.
pub(super) const GROUP: usize = 2;
/// Blocks of columns that stay in the first-level cache while all rows pass: 16 KiB.
const CACHED_BLOCKS: usize = 16;

pub(super) type Tile = [[__m256i; GROUP]; ROWS];

/// Rows of this path.
pub(super) type Rows = Packed<ROWS>;
/// Columns of this path.
pub(super) type Columns = Packed<WIDTH>;

/// Whether this processor can run this path.
pub(super) fn is_available() -> bool {
    is_x86_feature_detected!("avx2")
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
/// On a processor without AVX2.
pub(super) fn nearest(rows: &Rows, columns: &Columns) -> Nearest {
    assert!(is_available(), "this path needs AVX2");
    let mut state =
        State { row_best: Best::new(rows.num_lanes()), column_best: Best::new(columns.num_lanes()) };
    // SAFETY: the processor has AVX2, as `is_available` has just found.
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

#[target_feature(enable = "avx2")]
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

#[target_feature(enable = "avx2")]
#[inline]
fn tile(rows: &Rows, columns: &Columns, (strip, group): (usize, usize), state: &mut State) {
    let row_lanes = &rows.lanes[strip];
    let blocks = [&columns.blocks[group], &columns.blocks[group + 1]];
    let column_lanes = [&columns.lanes[group], &columns.lanes[group + 1]];
    let narrow = row_lanes.narrow && column_lanes[0].narrow && column_lanes[1].narrow;
    let dots = if narrow {
        dots_narrow(&rows.blocks[strip], blocks)
    } else {
        dots_wide(&rows.blocks[strip], blocks)
    };

    settle(&dots, row_lanes, column_lanes, (strip, group), state);
}

/// Turns a tile of products into scores and keeps those that beat a second best.
#[target_feature(enable = "avx2")]
#[inline]
pub(super) fn settle(
    dots: &Tile,
    row_lanes: &Lanes<ROWS>,
    column_lanes: [&Lanes<WIDTH>; GROUP],
    (strip, group): (usize, usize),
    state: &mut State,
) {
    let row_second: &[i32; ROWS] = lanes_at(&state.row_best.second, strip);
    let mut scores = *dots;
    let mut better = *dots;
    let mut any = _mm256_setzero_si256();
    for c in 0..GROUP {
        let column_second = load(lanes_at(&state.column_best.second, group + c));
        let minus_norm = load(&column_lanes[c].minus_norm);
        for r in 0..ROWS {
            let constant = row_lanes.minus_norm[r] + column_lanes[c].offset * row_lanes.twice_sum[r];
            let constant = _mm256_add_epi32(minus_norm, _mm256_set1_epi32(constant));
            scores[r][c] = _mm256_add_epi32(_mm256_slli_epi32::<1>(dots[r][c]), constant);
            better[r][c] = _mm256_or_si256(
                _mm256_cmpgt_epi32(scores[r][c], _mm256_set1_epi32(row_second[r])),
                _mm256_cmpgt_epi32(scores[r][c], column_second),
            );
            any = _mm256_or_si256(any, better[r][c]);
        }
    }
    if _mm256_testz_si256(any, any) == 0 {
        offer(&scores, &better, (strip, group), state);
    }
}

/// Products of bytes that are all at most 127. Rows are written out, so that all sums stay in registers.
#[target_feature(enable = "avx2")]
#[inline]
fn dots_narrow(rows: &Block<ROWS>, columns: [&Block<WIDTH>; GROUP]) -> Tile {
    let zero = [_mm256_setzero_si256(); GROUP];
    let (mut dots_0, mut dots_1, mut dots_2, mut dots_3) = (zero, zero, zero, zero);
    for quad in (0..QUADS).step_by(2) {
        let (row_even, row_odd) = (&rows.0[quad], &rows.0[quad + 1]);
        let even = [load(&columns[0].0[quad]), load(&columns[1].0[quad])];
        let odd = [load(&columns[0].0[quad + 1]), load(&columns[1].0[quad + 1])];
        dots_0 = add_narrow(dots_0, [row_even[0], row_odd[0]], even, odd);
        dots_1 = add_narrow(dots_1, [row_even[1], row_odd[1]], even, odd);
        dots_2 = add_narrow(dots_2, [row_even[2], row_odd[2]], even, odd);
        dots_3 = add_narrow(dots_3, [row_even[3], row_odd[3]], even, odd);
    }
    [dots_0, dots_1, dots_2, dots_3]
}

#[target_feature(enable = "avx2")]
#[inline]
fn add_narrow(
    dots: [__m256i; GROUP],
    row: [i32; 2],
    even: [__m256i; GROUP],
    odd: [__m256i; GROUP],
) -> [__m256i; GROUP] {
    let (row_even, row_odd) = (_mm256_set1_epi32(row[0]), _mm256_set1_epi32(row[1]));
    let ones = _mm256_set1_epi16(1);
    let four_0 =
        _mm256_add_epi16(_mm256_maddubs_epi16(row_even, even[0]), _mm256_maddubs_epi16(row_odd, odd[0]));
    let four_1 =
        _mm256_add_epi16(_mm256_maddubs_epi16(row_even, even[1]), _mm256_maddubs_epi16(row_odd, odd[1]));
    [
        _mm256_add_epi32(dots[0], _mm256_madd_epi16(four_0, ones)),
        _mm256_add_epi32(dots[1], _mm256_madd_epi16(four_1, ones)),
    ]
}

/// Products of any bytes: each is widened to i16 first.
#[target_feature(enable = "avx2")]
#[inline]
fn dots_wide(rows: &Block<ROWS>, columns: [&Block<WIDTH>; GROUP]) -> Tile {
    let zero = [_mm256_setzero_si256(); GROUP];
    let (mut dots_0, mut dots_1, mut dots_2, mut dots_3) = (zero, zero, zero, zero);
    for quad in 0..QUADS {
        let row = &rows.0[quad];
        let bytes = [load(&columns[0].0[quad]), load(&columns[1].0[quad])];
        let even = [
            _mm256_srai_epi16::<8>(_mm256_slli_epi16::<8>(bytes[0])),
            _mm256_srai_epi16::<8>(_mm256_slli_epi16::<8>(bytes[1])),
        ];
        let odd = [_mm256_srai_epi16::<8>(bytes[0]), _mm256_srai_epi16::<8>(bytes[1])];
        dots_0 = add_wide(dots_0, row[0], even, odd);
        dots_1 = add_wide(dots_1, row[1], even, odd);
        dots_2 = add_wide(dots_2, row[2], even, odd);
        dots_3 = add_wide(dots_3, row[3], even, odd);
    }
    [dots_0, dots_1, dots_2, dots_3]
}

#[target_feature(enable = "avx2")]
#[inline]
fn add_wide(
    dots: [__m256i; GROUP],
    row: i32,
    even: [__m256i; GROUP],
    odd: [__m256i; GROUP],
) -> [__m256i; GROUP] {
    let bytes = _mm256_set1_epi32(row);
    let row_even = _mm256_and_si256(bytes, _mm256_set1_epi16(0xff));
    let row_odd = _mm256_srli_epi16::<8>(bytes);
    let two_0 = _mm256_add_epi32(_mm256_madd_epi16(row_even, even[0]), _mm256_madd_epi16(row_odd, odd[0]));
    let two_1 = _mm256_add_epi32(_mm256_madd_epi16(row_even, even[1]), _mm256_madd_epi16(row_odd, odd[1]));
    [_mm256_add_epi32(dots[0], two_0), _mm256_add_epi32(dots[1], two_1)]
}

/// Offers the few scores of a tile that beat a second best.
#[target_feature(enable = "avx2")]
#[inline(never)]
fn offer(scores: &Tile, better: &Tile, (strip, group): (usize, usize), state: &mut State) {
    for r in 0..ROWS {
        for c in 0..GROUP {
            let mut mask = _mm256_movemask_ps(_mm256_castsi256_ps(better[r][c])) as u32;
            if mask == 0 {
                continue;
            }
            let values: [i32; WIDTH] = bytemuck::must_cast(scores[r][c]);
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

#[target_feature(enable = "avx2")]
#[inline]
pub(super) fn load(words: &[i32; WIDTH]) -> __m256i {
    bytemuck::must_cast(*words)
}

/// The `block`-th group of `L` values.
#[inline]
fn lanes_at<const L: usize>(values: &[i32], block: usize) -> &[i32; L] {
    &values.as_chunks::<L>().0[block]
}
