//! Symmetric positive definite systems of small dense blocks, factorised by faer.
//!
//! [`BlockSystem`] keeps its pattern, elimination order and memory between factorisations, so that a Gauss–Newton loop
//! only refills values. Factorisations run on one thread: the same bytes for any number of threads.

mod cholesky;
mod pattern;

use serde::{Deserialize, Serialize};

pub use pattern::BlockPattern;

use cholesky::{DenseCholesky, SparseCholesky};

/// How a block system is factorised.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LinearSolver {
    /// Dense when the system is small or fills up, else sparse.
    #[default]
    Auto,
    /// Dense Cholesky.
    Dense,
    /// Sparse supernodal Cholesky in approximate-minimum-degree order (Amestoy, Davis & Duff 1996).
    Sparse,
    /// Sparse Cholesky column by column, in the same order: slower, but in hardly more memory than the factor.
    Simplicial,
}

/// A system that is too large for this machine.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct LinearError(pub(crate) String);

/// Up to this many unknowns a dense factorisation is the faster one whatever the fill.
const SMALL_DENSE: usize = 384;
/// A factor with more than this part of the dense one's entries gains nothing from being sparse.
const DENSE_FILL: f64 = 0.35;

enum Factor {
    Dense(DenseCholesky),
    Sparse(Box<SparseCholesky>),
}

/// A symmetric system of blocks: its upper triangle by block columns.
pub struct BlockSystem {
    pattern: BlockPattern,
    values: Vec<f64>,
    factor: Factor,
}

impl BlockSystem {
    /// Analyses a pattern. Values start at zero.
    pub fn new(pattern: BlockPattern, solver: LinearSolver) -> Result<Self, LinearError> {
        let n = pattern.num_unknowns();
        let factor = match solver {
            LinearSolver::Dense => Factor::Dense(DenseCholesky::new(n)),
            LinearSolver::Auto if n <= SMALL_DENSE => Factor::Dense(DenseCholesky::new(n)),
            LinearSolver::Simplicial => Factor::Sparse(Box::new(SparseCholesky::new(&pattern, false)?)),
            LinearSolver::Auto | LinearSolver::Sparse => {
                let sparse = SparseCholesky::new(&pattern, true)?;
                let full = 0.5 * n as f64 * n as f64;
                if solver == LinearSolver::Auto && sparse.num_values() as f64 > DENSE_FILL * full {
                    Factor::Dense(DenseCholesky::new(n))
                } else {
                    Factor::Sparse(Box::new(sparse))
                }
            }
        };
        Ok(Self { values: vec![0.0; pattern.num_values()], pattern, factor })
    }

    /// The pattern of blocks.
    pub fn pattern(&self) -> &BlockPattern {
        &self.pattern
    }

    /// Whether the factorisation is dense.
    pub fn is_dense(&self) -> bool {
        matches!(self.factor, Factor::Dense(_))
    }

    /// Sets all values to zero.
    pub fn clear(&mut self) {
        self.values.fill(0.0);
    }

    /// Adds to the block (row, column) with row ≤ column; `block` is column-major with `stride` values per column.
    /// Of a diagonal block only the upper triangle is read. Blocks outside the pattern are ignored.
    #[inline]
    pub fn add(&mut self, row: usize, column: usize, block: &[f64], stride: usize) {
        let Some(position) = self.pattern.find(row, column) else {
            debug_assert!(false, "block ({row}, {column}) is outside the pattern");
            return;
        };
        let (rows, columns) = (self.pattern.dim(row), self.pattern.dim(column));
        for c in 0..columns {
            let start = self.pattern.value_index(position, column, c);
            let height = if row == column { c + 1 } else { rows };
            let target = &mut self.values[start..start + height];
            for (value, add) in target.iter_mut().zip(&block[c * stride..c * stride + height]) {
                *value += add;
            }
        }
    }

    /// Adds to the diagonal of a block.
    #[inline]
    pub fn add_to_diagonal(&mut self, block: usize, component: usize, value: f64) {
        if let Some(position) = self.pattern.find(block, block) {
            let index = self.pattern.value_index(position, block, component) + component;
            self.values[index] += value;
        }
    }

    /// A value of the diagonal.
    pub fn diagonal(&self, block: usize, component: usize) -> f64 {
        let at = self.pattern.find(block, block);
        at.map_or(0.0, |at| self.values[self.pattern.value_index(at, block, component) + component])
    }

    /// Factorises; false when the matrix is not positive definite to rounding.
    pub fn factorize(&mut self) -> bool {
        if self.values.iter().any(|v| !v.is_finite()) {
            return false;
        }
        match &mut self.factor {
            Factor::Dense(dense) => dense.factorize(&self.pattern, &self.values),
            Factor::Sparse(sparse) => sparse.factorize(&self.values),
        }
    }

    /// Solves for one or more right-hand sides, column after column, after a factorisation that held.
    pub fn solve_in_place(&mut self, right: &mut [f64]) {
        match &mut self.factor {
            Factor::Dense(dense) => dense.solve_in_place(right),
            Factor::Sparse(sparse) => sparse.solve_in_place(right),
        }
    }
}

#[cfg(test)]
mod tests;
