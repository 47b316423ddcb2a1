//! AVX-VNNI: tiles of four rows by sixteen columns with `vpdpbusd` on 256 bits, for processors without AVX-512.
//!
//! As in the AVX-512 path, columns are stored less an offset, whose share, `offset · Σ row`, is added at the end.

use std::arch::x86_64::*;

use super::avx2::{GROUP, ROWS, State, Tile, WIDTH, load, settle};
use super::nearest::{Best, Nearest};
use super::pack::{Block, QUADS};

/// Blocks of columns that stay in the first-level cache while all rows pass: 16 KiB.
const CACHED_BLOCKS: usize = 16;

pub(super) use super::avx2::{Columns, Rows};

/// Whether this processor can run this path.
pub(super) fn is_available() -> bool {
    is_x86_feature_detected!("avx2") && is_x86_feature_detected!("avxvnni")
}

/// Nearest neighbours in both directions.
///
/// # Panics
/// On a processor without AVX-VNNI.
pub(super) fn nearest(rows: &Rows, columns: &Columns) -> Nearest {
    assert!(is_available(), "this path needs AVX-VNNI");
    let mut state =
        State { row_best: Best::new(rows.num_lanes()), column_best: Best::new(columns.num_lanes()) };
    // SAFETY: the processor has AVX2 and AVX-VNNI, as `is_available` has just found.
    unsafe { sweep(rows, columns, &mut state) };
    Nearest {
        rows: state.row_best.neighbours(&rows.order, &columns.order),
        columns: state.column_best.neighbours(&columns.order, &rows.order),
    }
}

#[target_feature(enable = "avx2,avxvnni")]
fn sweep(rows: &Rows, columns: &Columns, state: &mut State) {
    for cached in (0..columns.blocks.len()).step_by(CACHED_BLOCKS) {
        let end = (cached + CACHED_BLOCKS).min(columns.blocks.len());
        for strip in 0..rows.blocks.len() {
            for group in (cached..end).step_by(GROUP) {
                let blocks = [&columns.blocks[group], &columns.blocks[group + 1]];
                let column_lanes = [&columns.lanes[group], &columns.lanes[group + 1]];
                let dots = dots(&rows.blocks[strip], blocks);
                settle(&dots, &rows.lanes[strip], column_lanes, (strip, group), state);
            }
        }
    }
}

#[target_feature(enable = "avx2,avxvnni")]
#[inline]
fn dots(rows: &Block<ROWS>, columns: [&Block<WIDTH>; GROUP]) -> Tile {
    let mut dots = [[_mm256_setzero_si256(); GROUP]; ROWS];
    for quad in 0..QUADS {
        for c in 0..GROUP {
            let column = load(&columns[c].0[quad]);
            for r in 0..ROWS {
                let row = _mm256_set1_epi32(rows.0[quad][r]);
                dots[r][c] = _mm256_dpbusd_avx_epi32(dots[r][c], row, column);
            }
        }
    }
    dots
}
