//! Columns whose sketches are closest to a row's: guesses at neighbours, the same on every path.
//!
//! A column's *score* with a row is `code_a · code_b − base`, with the base half the squared length of the column's
//! sketch, all modulo 2¹⁶: guesses may be wrong, and whoever uses them computes distances. Columns are dealt to 32 lanes
//! in turn. Of each lane the best column counts, the first of equals; of the lanes the best few, the first of equals.

use crate::matching::sketch::{Code, SKETCH_LEN};

#[cfg(target_arch = "x86_64")]
use super::avx2;

/// Lanes that columns are dealt to.
pub(super) const LANES: usize = 32;
/// Guesses at a row's neighbours.
pub(in crate::matching) const GUESSES: usize = 3;
/// No column.
pub(in crate::matching) const NOBODY: u32 = u32::MAX;

/// Columns to be guessed at.
pub(in crate::matching) enum Guessed {
    Scalar(Vec<Code>),
    #[cfg(target_arch = "x86_64")]
    Avx2(avx2::Columns),
}

impl Guessed {
    pub(in crate::matching) fn new(fine: &[Code], with_avx2: bool) -> Self {
        #[cfg(target_arch = "x86_64")]
        if with_avx2 {
            return Guessed::Avx2(avx2::Columns::new(fine));
        }
        let _ = with_avx2;
        Guessed::Scalar(fine.to_vec())
    }
}

/// The best columns of each row, best first. There are as many bases as columns.
pub(in crate::matching) fn closest(rows: &[Code], columns: &Guessed, bases: &[i16]) -> Vec<[u32; GUESSES]> {
    match columns {
        Guessed::Scalar(columns) => rows.iter().map(|row| of_row(row, columns, bases)).collect(),
        #[cfg(target_arch = "x86_64")]
        Guessed::Avx2(columns) => avx2::closest(rows, columns, bases),
    }
}

fn of_row(row: &Code, columns: &[Code], bases: &[i16]) -> [u32; GUESSES] {
    let mut best = [i16::MIN; LANES];
    let mut at = [-1; LANES];
    for (column, (code, base)) in columns.iter().zip(bases).enumerate() {
        let products = (0..SKETCH_LEN).map(|k| i16::from(row[k]) * i16::from(code[k]));
        let score = products.fold(0_i16, i16::wrapping_add).wrapping_sub(*base);
        if score > best[column % LANES] {
            best[column % LANES] = score;
            at[column % LANES] = (column / LANES) as i16;
        }
    }
    best_lanes(&best, &at)
}

/// The best of each lane's best, as columns.
pub(super) fn best_lanes(best: &[i16; LANES], at: &[i16; LANES]) -> [u32; GUESSES] {
    // A score above its lane, counted from the end: one comparison orders both, and none of them branches.
    let mut keys = [i32::MIN; GUESSES];
    for lane in 0..LANES {
        let mut key = (i32::from(best[lane]) << 16) | (LANES - 1 - lane) as i32;
        for place in &mut keys {
            (*place, key) = ((*place).max(key), (*place).min(key));
        }
    }
    keys.map(|key| {
        let lane = LANES - 1 - (key & 0xffff) as usize % LANES;
        if at[lane] < 0 { NOBODY } else { at[lane] as u32 * LANES as u32 + lane as u32 }
    })
}
