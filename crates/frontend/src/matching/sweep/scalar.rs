//! The oracle of the sweeps, and the small problem on which each path must agree with it.

use std::ops::Range;

use super::{ANY_REACH, Limits, MOST_SURVIVORS, NO_REACH, SweepPath};
use crate::matching::sketch::{Code, SKETCH_LEN};

pub(super) fn sweep(
    (rows, row_limits): (&[Code], &Limits),
    (columns, column_limits): (&[Code], &Limits),
    range: Range<usize>,
    survivors: &mut Vec<(u32, u32)>,
) {
    for (row, a) in rows.iter().enumerate() {
        if survivors.len() > MOST_SURVIVORS {
            return;
        }
        for column in range.clone() {
            let lone = row_limits.lone[row].max(column_limits.lone[column]);
            let reach = row_limits.reach[row].min(column_limits.reach[column]).max(lone);
            let least = i64::from(row_limits.base[row]) + i64::from(column_limits.base[column]);
            if reach == ANY_REACH || i64::from(dot(a, &columns[column])) >= least - i64::from(reach) {
                survivors.push((row as u32, column as u32));
            }
        }
    }
}

fn dot(a: &Code, b: &Code) -> i32 {
    a.iter().zip(b).map(|(&a, &b)| i32::from(a) * i32::from(b)).sum()
}

/// Whether a path lets survive what the oracle does, on limits that fit 16 bits and sizes that fill no tile.
pub(super) fn is_matched_by(path: SweepPath) -> bool {
    let mut state = 7_u32;
    let mut next = |limit: i32| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 16) as i32 % limit
    };
    let mut side = |count: usize, any: usize| {
        let codes: Vec<Code> = (0..count).map(|_| [(); SKETCH_LEN].map(|()| (next(61) - 30) as i8)).collect();
        let base = codes.iter().map(|code| dot(code, code) / 2).collect();
        let lone = (0..count).map(|at| if at % 13 == any { 6000 } else { NO_REACH }).collect();
        let reach = (0..count).map(|at| if at % 11 == any { ANY_REACH } else { 5000 + next(3000) }).collect();
        (codes, Limits { base, reach, lone })
    };
    let ((rows, row_limits), (mut columns, column_limits)) = (side(39, 3), side(75, 11));
    columns[74] = rows[38];
    let survivors = |path: SweepPath| {
        let mut survivors = Vec::new();
        let (rows, columns) = (path.rows(&rows), path.columns(&columns));
        super::sweep((&rows, &row_limits), (&columns, &column_limits), 0..75, &mut survivors);
        survivors.sort_unstable();
        survivors
    };
    survivors(path) == survivors(SweepPath::Scalar)
}
