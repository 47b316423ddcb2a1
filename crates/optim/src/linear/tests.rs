//! Sparse solves against dense ones.

use nalgebra::{DMatrix, DVector};
use rand::RngExt;
use terrane_geometry::Seed;

use super::*;

/// A random positive definite system on a ring of blocks with one block that touches all, and its dense twin.
fn ring(dims: &[usize], solver: LinearSolver) -> (BlockSystem, DMatrix<f64>, DVector<f64>) {
    let n = dims.len();
    let mut rng = Seed(7).rng();
    let mut above: Vec<Vec<u32>> = (0..n as u32).map(|c| if c > 0 { vec![c - 1] } else { vec![] }).collect();
    above[n - 1] = (0..n as u32 - 1).collect();
    let mut system = BlockSystem::new(BlockPattern::new(dims, above.clone()), solver).unwrap();
    let size = system.pattern().num_unknowns();
    let mut dense = DMatrix::zeros(size, size);
    let offset = |b: usize| dims[..b].iter().sum::<usize>();
    for column in 0..n {
        let mut rows = above[column].clone();
        rows.push(column as u32);
        rows.dedup();
        for row in rows.into_iter().map(|r| r as usize) {
            let mut block = DMatrix::from_fn(dims[row], dims[column], |_, _| rng.random_range(-1.0..1.0));
            if row == column {
                block = &block * block.transpose() + DMatrix::identity(dims[row], dims[row]) * 40.0;
            }
            system.add(row, column, block.as_slice(), dims[row]);
            dense.view_mut((offset(row), offset(column)), block.shape()).copy_from(&block);
            dense
                .view_mut((offset(column), offset(row)), (block.ncols(), block.nrows()))
                .copy_from(&block.transpose());
        }
    }
    (system, dense, DVector::from_fn(size, |i, _| (i as f64).sin()))
}

#[test]
fn dense_and_sparse_agree_with_a_plain_solve() {
    let dims: Vec<usize> = (0..30).map(|i| 1 + i % 7).collect();
    for solver in [LinearSolver::Dense, LinearSolver::Sparse, LinearSolver::Simplicial, LinearSolver::Auto] {
        let (mut system, dense, right) = ring(&dims, solver);
        let expected = dense.clone().cholesky().unwrap().solve(&right);
        for _ in 0..2 {
            assert!(system.factorize());
            let mut got = right.clone();
            system.solve_in_place(got.as_mut_slice());
            assert!((&got - &expected).amax() < 1e-12, "{solver:?}");
        }
        let sparse = matches!(solver, LinearSolver::Sparse | LinearSolver::Simplicial);
        assert_eq!(system.is_dense(), !sparse);
    }
}

#[test]
fn indefinite_and_non_finite_matrices_are_refused() {
    for solver in [LinearSolver::Dense, LinearSolver::Sparse, LinearSolver::Simplicial] {
        let mut system = BlockSystem::new(BlockPattern::full(&[2, 2]), solver).unwrap();
        assert!(!system.factorize(), "zero matrix");
        for block in 0..2 {
            for c in 0..2 {
                system.add_to_diagonal(block, c, 1.0);
            }
        }
        assert!(system.factorize());
        system.add(0, 1, &[2.0, 0.0, 0.0, 0.0], 2);
        assert!(!system.factorize(), "indefinite");
        system.add_to_diagonal(0, 0, f64::NAN);
        assert!(!system.factorize(), "not a number");
    }
}

#[test]
fn empty_system_is_solved() {
    let mut system = BlockSystem::new(BlockPattern::full(&[]), LinearSolver::Auto).unwrap();
    assert!(system.factorize());
    system.solve_in_place(&mut []);
}
