//! Cholesky factorisation of one cluster's block: a few hundred unknowns, dense, in `f64`.
//!
//! Its own rather than the library's: the order of operations is the same on every processor, and so are the bits; and it
//! takes no memory beside the matrix.

use super::blocks::widest;
use super::real::LANES;

/// Columns that are factorised before the rest is updated: as many as keep a strip of rows in the first cache.
const BLOCK: usize = 48;
/// Columns of a tile of the update; its rows are [`LANES`].
const TILE: usize = 4;

/// A symmetric matrix, its lower triangle by columns, padded so that every tile is whole.
pub(super) struct Lower {
    pub n: usize,
    /// Values from one column to the next.
    pub stride: usize,
    pub values: Vec<f64>,
}

impl Lower {
    /// All zeros.
    pub fn zeros(n: usize) -> Self {
        let padded = n.next_multiple_of(LANES);
        let stride = padded + LANES;
        Self { n, stride, values: vec![0.0; stride * padded] }
    }

    /// The lower part of a column, the diagonal first.
    pub fn column(&self, column: usize) -> &[f64] {
        &self.values[self.stride * column + column..self.stride * column + self.n]
    }

    /// Factorises in place; false where the matrix is not positive definite to rounding.
    pub fn factorize(&mut self) -> bool {
        let padded = self.n.next_multiple_of(LANES);
        for column in self.n..padded {
            self.values[self.stride * column + column] = 1.0;
        }
        for first in (0..padded).step_by(BLOCK) {
            let end = (first + BLOCK).min(padded);
            let held = widest(
                #[inline(always)]
                || factorize_columns(&mut self.values, self.stride, first, end, padded),
            );
            if !held {
                return false;
            }
            widest(
                #[inline(always)]
                || update(&mut self.values, self.stride, first, end, padded),
            );
        }
        true
    }
}

/// Factorises the columns of a block over all rows below.
#[inline(always)]
fn factorize_columns(values: &mut [f64], stride: usize, first: usize, end: usize, rows: usize) -> bool {
    for column in first..end {
        let (before, rest) = values.split_at_mut(stride * column);
        let target = &mut rest[column..rows];
        for other in first..column {
            let source = &before[stride * other + column..stride * other + rows];
            let factor = -source[0];
            for (value, other) in target.iter_mut().zip(source) {
                *value = other.mul_add(factor, *value);
            }
        }
        let pivot = target[0].sqrt();
        if !(pivot > 0.0 && pivot.is_finite()) {
            return false;
        }
        let inverse = 1.0 / pivot;
        target[0] = pivot;
        target[1..].iter_mut().for_each(|value| *value *= inverse);
    }
    true
}

/// Takes `L Lᵀ` of the columns `first..end` from all columns behind them.
#[inline(always)]
fn update(values: &mut [f64], stride: usize, first: usize, end: usize, rows: usize) {
    for column in (end..rows).step_by(TILE) {
        for row in (column..rows).step_by(LANES) {
            let mut tile = [[0.0f64; LANES]; TILE];
            for k in first..end {
                let source = &values[stride * k..stride * (k + 1)];
                let (across, down) = (&source[column..column + TILE], &source[row..row + LANES]);
                for c in 0..TILE {
                    for r in 0..LANES {
                        tile[c][r] = down[r].mul_add(across[c], tile[c][r]);
                    }
                }
            }
            for c in 0..TILE {
                let start = stride * (column + c) + row;
                for (value, taken) in values[start..start + LANES].iter_mut().zip(&tile[c]) {
                    *value -= taken;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn factors_multiply_back() {
        for n in [0, 1, 3, 8, 47, 48, 53, 130, 200] {
            let noise = |i: usize, j: usize| ((i * 7919 + j * 104_729) as f64).sin();
            let value = |i: usize, j: usize| {
                let sum: f64 = (0..n).map(|k| noise(i, k) * noise(j, k)).sum();
                sum + if i == j { 0.1 } else { 0.0 }
            };
            let mut lower = Lower::zeros(n);
            for j in 0..n {
                for i in j..n {
                    lower.values[lower.stride * j + i] = value(i, j);
                }
            }
            assert!(lower.factorize());
            for j in 0..n {
                for i in j..n {
                    let l = |row: usize, k: usize| lower.values[lower.stride * k + row];
                    let got: f64 = (0..=j).map(|k| l(i, k) * l(j, k)).sum();
                    assert!((got - value(i, j)).abs() < 1e-10 * (n as f64 + 1.0), "{n}: ({i}, {j})");
                }
            }
        }
    }

    #[test]
    fn indefinite_matrices_are_refused() {
        for bad in [-1.0, 0.0, f64::NAN, f64::INFINITY] {
            let mut lower = Lower::zeros(60);
            for j in 0..60 {
                lower.values[lower.stride * j + j] = if j == 51 { bad } else { 2.0 };
            }
            assert!(!lower.factorize(), "{bad}");
        }
    }
}
