//! Columns whose sketches are closest to a row's: guesses at neighbours, the same on every path.
//!
//! A column's *score* with a row is `code_a · code_b − base`, with the base half the squared length of the column's
//! sketch, all modulo 2¹⁶: guesses may be wrong, and whoever uses them computes distances. Columns are dealt to 32 lanes
//! in turn. Of each lane the best column counts, the first of equals; of the lanes the best few, the first of equals.

use super::SweepPath;
#[cfg(target_arch = "x86_64")]
use super::{avx2, closest_avx512};
use crate::matching::sketch::{Code, SKETCH_LEN};

/// Lanes that columns are dealt to.
pub(super) const LANES: usize = 32;
/// No column.
pub(in crate::matching) const NOBODY: u32 = u32::MAX;

/// Columns to be guessed at.
pub(in crate::matching) enum Guessed {
    Scalar(Vec<Code>),
    #[cfg(target_arch = "x86_64")]
    Avx2(avx2::Columns),
    #[cfg(target_arch = "x86_64")]
    Avx512(closest_avx512::Columns),
}

impl Guessed {
    /// Laid out for the path of a sweep.
    pub(in crate::matching) fn new(fine: &[Code], path: SweepPath) -> Self {
        match path {
            SweepPath::Scalar => Guessed::Scalar(fine.to_vec()),
            #[cfg(target_arch = "x86_64")]
            SweepPath::Avx512 if closest_avx512::is_available() => {
                Guessed::Avx512(closest_avx512::Columns::new(fine))
            }
            #[cfg(target_arch = "x86_64")]
            SweepPath::Avx2 | SweepPath::Avx512 => Guessed::Avx2(avx2::Columns::new(fine)),
        }
    }
}

/// The best `N` columns of each row, best first. There are as many bases as columns.
pub(in crate::matching) fn closest<const N: usize>(
    rows: &[Code],
    columns: &Guessed,
    bases: &[i16],
) -> Vec<[u32; N]> {
    match columns {
        Guessed::Scalar(columns) => rows.iter().map(|row| of_row(row, columns, bases)).collect(),
        #[cfg(target_arch = "x86_64")]
        Guessed::Avx2(columns) => avx2::closest(rows, columns, bases),
        #[cfg(target_arch = "x86_64")]
        Guessed::Avx512(columns) => closest_avx512::closest(rows, columns, bases),
    }
}

fn of_row<const N: usize>(row: &Code, columns: &[Code], bases: &[i16]) -> [u32; N] {
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
    let mut lanes: Vec<usize> = (0..LANES).filter(|&lane| at[lane] >= 0).collect();
    lanes.sort_by_key(|&lane| (std::cmp::Reverse(best[lane]), lane));
    let column = |lane: &usize| at[*lane] as u32 * LANES as u32 + *lane as u32;
    std::array::from_fn(|place| lanes.get(place).map_or(NOBODY, column))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Codes of some values, many of them level or at the ends of their range.
    fn codes(count: usize, (least, greatest): (i8, i8), mut state: u32) -> Vec<Code> {
        let mut value = |kind: usize| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            match kind % 5 {
                0 => least,
                1 => greatest,
                2 => 0,
                _ => ((state >> 16) % 41) as i8 - 20,
            }
        };
        (0..count).map(|k| std::array::from_fn(|i| value(7 * k + i * k % 11))).collect()
    }

    #[test]
    fn every_path_guesses_the_same_columns() {
        let rows = codes(37, (-64, 63), 5);
        for count in [0, 1, 2, 31, 32, 33, 64, 65, 150, 2000] {
            let mut columns = codes(count, (-127, 127), 9);
            // Copies are level in every row.
            if count > 64 {
                columns[40] = columns[3];
                columns[35] = columns[3];
            }
            let bases: Vec<i16> = (0..count).map(|k| [0, 40, -32_768, 32_767, 900][k % 5]).collect();
            let of_path = |path| closest::<5>(&rows, &Guessed::new(&columns, path), &bases);
            let scalar = of_path(SweepPath::Scalar);
            assert!(
                scalar.iter().all(|guesses| guesses.iter().filter(|g| **g != NOBODY).count() == count.min(5))
            );
            for &path in SweepPath::available() {
                assert_eq!(of_path(path), scalar, "{count} by {}", path.name());
            }
        }
    }

    #[test]
    fn columns_without_a_score_are_nobody_on_every_path() {
        let rows = codes(9, (-64, 63), 3);
        let columns = vec![[0; SKETCH_LEN]; 40];
        // A score of i16::MIN is none.
        let bases: Vec<i16> = (0..40).map(|k| if k % 16 == 3 { 5 } else { i16::MIN }).collect();
        for &path in SweepPath::available() {
            for found in closest::<4>(&rows, &Guessed::new(&columns, path), &bases) {
                assert_eq!(found, [3, 19, NOBODY, NOBODY], "{}", path.name());
            }
        }
    }
}
