//! AVX-512 VNNI: the closest columns, tiles of four rows by 32 columns.
//!
//! Sums are taken in 32 bits, as in the sweep of this path, and cut to 16 once a tile: scores are defined modulo 2¹⁶. Even lanes
//! lie in one register and odd ones in the other, so that cutting them is one shift and one blend and keeps their order.

use std::arch::x86_64::*;

use super::avx512::load;
use super::closest::{LANES, NOBODY};
use crate::matching::sketch::{Code, SKETCH_LEN};

const ROWS: usize = 4;
/// The i32 lanes of a register.
const WIDTH: usize = 16;
const QUADS: usize = SKETCH_LEN / 4;
/// What is added to the entries of rows, which `vpdpbusd` wants unsigned.
const OFFSET: i8 = 64;
/// The odd ones of 32 lanes.
const ODD: u32 = 0xaaaa_aaaa;

/// A word for each of 32 columns: the even ones, then the odd ones.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
struct Words([[i32; WIDTH]; 2]);

type Row = [i32; QUADS];

/// Four entries of 32 columns side by side.
type Block = [Words; QUADS];

pub(in crate::matching) struct Columns {
    blocks: Vec<Block>,
    /// What the rows' offset adds to each column's scores, negated.
    starts: Vec<Words>,
    len: usize,
}

pub(super) fn is_available() -> bool {
    super::avx512::is_available() && is_x86_feature_detected!("avx512bw") && is_x86_feature_detected!("avx2")
}

impl Columns {
    pub(super) fn new(codes: &[Code]) -> Self {
        let num_blocks = codes.len().div_ceil(LANES);
        let mut blocks = vec![[Words([[0; WIDTH]; 2]); QUADS]; num_blocks];
        let mut starts = vec![Words([[0; WIDTH]; 2]); num_blocks];
        for (at, code) in codes.iter().enumerate() {
            let (block, parity, lane) = (at / LANES, at % 2, at % LANES / 2);
            for (quad, entries) in code.as_chunks::<4>().0.iter().enumerate() {
                blocks[block][quad].0[parity][lane] = i32::from_le_bytes(entries.map(|entry| entry as u8));
            }
            let sum: i32 = code.iter().map(|&entry| i32::from(entry)).sum();
            starts[block].0[parity][lane] = -i32::from(OFFSET) * sum;
        }
        Self { blocks, starts, len: codes.len() }
    }

    /// Where the sums of each column begin. An absent column's score is never better than none.
    fn starts_at(&self, bases: &[i16]) -> Vec<Words> {
        let mut starts = vec![Words([[i32::from(i16::MIN); WIDTH]; 2]); self.starts.len()];
        for (at, base) in bases.iter().enumerate() {
            let (block, parity, lane) = (at / LANES, at % 2, at % LANES / 2);
            starts[block].0[parity][lane] = self.starts[block].0[parity][lane] - i32::from(*base);
        }
        starts
    }
}

/// See [`closest`](super::closest).
pub(super) fn closest<const N: usize>(rows: &[Code], columns: &Columns, bases: &[i16]) -> Vec<[u32; N]> {
    assert!(is_available(), "this path needs AVX-512 BW and VNNI");
    assert!(bases.len() == columns.len);
    let starts = columns.starts_at(bases);
    let mut found = vec![[0; N]; rows.len()];
    for (rows, found) in rows.chunks(ROWS).zip(found.chunks_mut(ROWS)) {
        let mut unsigned = [[0; QUADS]; ROWS];
        for (unsigned, row) in unsigned.iter_mut().zip(rows) {
            *unsigned = bytemuck::must_cast(row.map(|entry| entry.wrapping_add(OFFSET)));
        }
        // SAFETY: the processor has AVX2, AVX-512 F, BW and VNNI (asserted).
        unsafe { best_of_lanes(&unsigned, &columns.blocks, &starts, found) };
    }
    found
}

/// Of each row the columns of the best lanes; of each lane its best column counts.
#[target_feature(enable = "avx2,avx512f,avx512bw,avx512vnni")]
fn best_of_lanes<const N: usize>(
    rows: &[Row; ROWS],
    blocks: &[Block],
    starts: &[Words],
    found: &mut [[u32; N]],
) {
    let mut best = [_mm512_set1_epi16(i16::MIN); ROWS];
    let mut at = [_mm512_set1_epi16(-1); ROWS];
    for (group, (block, start)) in blocks.iter().zip(starts).enumerate() {
        let sums = sums(rows, block, start);
        let group = _mm512_set1_epi16(group as i16);
        for r in 0..ROWS {
            let scores = _mm512_mask_blend_epi16(ODD, sums[r][0], _mm512_slli_epi32::<16>(sums[r][1]));
            let better = _mm512_cmpgt_epi16_mask(scores, best[r]);
            best[r] = _mm512_max_epi16(scores, best[r]);
            at[r] = _mm512_mask_mov_epi16(at[r], better, group);
        }
    }
    for ((found, best), at) in found.iter_mut().zip(best).zip(at) {
        *found = best_columns(best, at);
    }
}

#[target_feature(enable = "avx512f,avx512vnni")]
#[inline]
fn sums(rows: &[Row; ROWS], block: &Block, start: &Words) -> [[__m512i; 2]; ROWS] {
    let mut sums = [[load(&start.0[0]), load(&start.0[1])]; ROWS];
    for quad in 0..QUADS {
        let columns = [load(&block[quad].0[0]), load(&block[quad].0[1])];
        for r in 0..ROWS {
            let row = _mm512_set1_epi32(rows[r][quad]);
            sums[r][0] = _mm512_dpbusd_epi32(sums[r][0], row, columns[0]);
            sums[r][1] = _mm512_dpbusd_epi32(sums[r][1], row, columns[1]);
        }
    }
    sums
}

/// The columns of the best lanes, the first of equals.
#[target_feature(enable = "avx2,avx512f,avx512bw")]
#[inline]
fn best_columns<const N: usize>(best: __m512i, at: __m512i) -> [u32; N] {
    let mut group_of = [0_i16; LANES];
    // SAFETY: `group_of` is 64 bytes long, and the store needs no alignment.
    unsafe { _mm512_storeu_si512(group_of.as_mut_ptr().cast(), at) };
    // Turns the order of signed numbers round into that of unsigned ones, of which the least can be asked for.
    let mut left = _mm512_xor_si512(best, _mm512_set1_epi16(i16::MAX));
    // Lanes that hold no column are out from the first.
    let mut lanes = !_mm512_movepi16_mask(at);
    let mut columns = [NOBODY; N];
    for column in &mut columns {
        let half = _mm256_min_epu16(_mm512_castsi512_si256(left), _mm512_extracti64x4_epi64::<1>(left));
        let quarter = _mm_min_epu16(_mm256_castsi256_si128(half), _mm256_extracti128_si256::<1>(half));
        let least = _mm512_broadcastw_epi16(_mm_minpos_epu16(quarter));
        let equal = _mm512_cmpeq_epi16_mask(left, least) & lanes;
        if equal == 0 {
            break;
        }
        let lane = equal.trailing_zeros();
        *column = group_of[lane as usize] as u32 * LANES as u32 + lane;
        lanes &= !(1 << lane);
        left = _mm512_mask_mov_epi16(left, 1 << lane, _mm512_set1_epi16(-1));
    }
    columns
}
