//! Dense and sparse Cholesky factorisations whose analysis and memory outlive a factorisation.

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt;
use faer::perm::PermRef;
use faer::sparse::linalg::SupernodalThreshold;
use faer::sparse::linalg::amd;
use faer::sparse::linalg::cholesky::{
    CholeskySymbolicParams, LltRef, SymbolicCholesky, SymmetricOrdering, factorize_symbolic_cholesky,
};
use faer::sparse::{SparseColMatRef, SymbolicSparseColMat, SymbolicSparseColMatRef};
use faer::{Conj, MatMut, MatRef, Par, Side};

use super::{BlockPattern, LinearError};

/// A dense factor, column-major, in the lower triangle.
pub(super) struct DenseCholesky {
    n: usize,
    factor: Vec<f64>,
    scratch: MemBuffer,
}

impl DenseCholesky {
    pub fn new(n: usize) -> Self {
        let scratch = llt::factor::cholesky_in_place_scratch::<f64>(n, Par::Seq, Default::default());
        Self { n, factor: vec![0.0; n * n], scratch: MemBuffer::new(scratch) }
    }

    pub fn factorize(&mut self, pattern: &BlockPattern, values: &[f64]) -> bool {
        let n = self.n;
        self.factor.fill(0.0);
        let mut next = 0;
        for column in 0..pattern.num_blocks() {
            for component in 0..pattern.dim(column) {
                let scalar_column = pattern.offset(column) + component;
                for &row in pattern.rows_of(column) {
                    let row = row as usize;
                    let height = if row == column { component + 1 } else { pattern.dim(row) };
                    let first = pattern.offset(row);
                    for r in first..first + height {
                        self.factor[r * n + scalar_column] = values[next];
                        next += 1;
                    }
                }
            }
        }
        let matrix = MatMut::from_column_major_slice_mut(&mut self.factor, n, n);
        let stack = MemStack::new(&mut self.scratch);
        llt::factor::cholesky_in_place(matrix, Default::default(), Par::Seq, stack, Default::default())
            .is_ok()
    }

    pub fn solve_in_place(&mut self, right: &mut [f64]) {
        let n = self.n;
        if n == 0 {
            return;
        }
        let columns = right.len() / n;
        let factor = MatRef::from_column_major_slice(&self.factor, n, n);
        let right = MatMut::from_column_major_slice_mut(right, n, columns);
        let stack = MemStack::new(&mut self.scratch);
        llt::solve::solve_in_place_with_conj(factor, Conj::No, right, Par::Seq, stack);
    }
}

/// A sparse supernodal factor.
pub(super) struct SparseCholesky {
    n: usize,
    pattern: SymbolicSparseColMat<usize>,
    symbolic: SymbolicCholesky<usize>,
    factor: Vec<f64>,
    scratch: Option<MemBuffer>,
}

impl SparseCholesky {
    /// With or without dense kernels for columns of equal pattern; these take memory by the size of the processor's caches.
    pub fn new(pattern: &BlockPattern, supernodal: bool) -> Result<Self, LinearError> {
        let n = pattern.num_unknowns();
        let failed =
            |e: faer::sparse::FaerError| LinearError(format!("{n} unknowns can't be ordered: {e:?}"));
        let (forward, inverse) = elimination_order(pattern).map_err(failed)?;
        let (starts, indices) = pattern.scalar_columns();
        let columns = SymbolicSparseColMat::new_checked(n, n, starts, None, indices);
        let params = CholeskySymbolicParams {
            supernodal_flop_ratio_threshold: if supernodal {
                SupernodalThreshold::FORCE_SUPERNODAL
            } else {
                SupernodalThreshold::FORCE_SIMPLICIAL
            },
            ..Default::default()
        };
        let order = PermRef::new_checked(&forward, &inverse, n);
        let ordering = SymmetricOrdering::Custom(order);
        let symbolic =
            factorize_symbolic_cholesky(columns.as_ref(), Side::Upper, ordering, params).map_err(failed)?;
        Ok(Self { n, pattern: columns, symbolic, factor: Vec::new(), scratch: None })
    }

    /// Number of values of the factor.
    pub fn num_values(&self) -> usize {
        self.symbolic.len_val()
    }

    pub fn factorize(&mut self, values: &[f64]) -> bool {
        let symbolic = &self.symbolic;
        let scratch = self.scratch.get_or_insert_with(|| {
            let factorize = symbolic.factorize_numeric_llt_scratch::<f64>(Par::Seq, Default::default());
            MemBuffer::new(factorize.or(symbolic.solve_in_place_scratch::<f64>(1, Par::Seq)))
        });
        self.factor.resize(symbolic.len_val(), 0.0);
        let matrix = SparseColMatRef::new(self.pattern.as_ref(), values);
        symbolic
            .factorize_numeric_llt(
                &mut self.factor,
                matrix,
                Side::Upper,
                Default::default(),
                Par::Seq,
                MemStack::new(scratch),
                Default::default(),
            )
            .is_ok()
    }

    pub fn solve_in_place(&mut self, right: &mut [f64]) {
        let n = self.n;
        let Some(scratch) = self.scratch.as_mut() else { return };
        if n == 0 || self.factor.len() != self.symbolic.len_val() {
            return;
        }
        let factor = LltRef::new(&self.symbolic, &self.factor);
        for column in right.chunks_exact_mut(n) {
            let column = MatMut::from_column_major_slice_mut(column, n, 1);
            factor.solve_in_place_with_conj(Conj::No, column, Par::Seq, MemStack::new(scratch));
        }
    }
}

/// Approximate minimum degree on blocks, expanded to unknowns: new → old and old → new.
fn elimination_order(pattern: &BlockPattern) -> Result<(Vec<usize>, Vec<usize>), faer::sparse::FaerError> {
    let num_blocks = pattern.num_blocks();
    let (starts, rows) = pattern.block_columns();
    let blocks = SymbolicSparseColMatRef::new_checked(num_blocks, num_blocks, &starts, None, &rows);
    let (mut order, mut inverse) = (vec![0usize; num_blocks], vec![0usize; num_blocks]);
    let mut memory = MemBuffer::new(amd::order_maybe_unsorted_scratch::<usize>(num_blocks, rows.len()));
    amd::order_maybe_unsorted(
        &mut order,
        &mut inverse,
        blocks,
        Default::default(),
        MemStack::new(&mut memory),
    )?;
    let mut forward = Vec::with_capacity(pattern.num_unknowns());
    for block in order {
        forward.extend(pattern.offset(block)..pattern.offset(block) + pattern.dim(block));
    }
    let mut backward = vec![0; forward.len()];
    for (new, &old) in forward.iter().enumerate() {
        backward[old] = new;
    }
    Ok((forward, backward))
}
