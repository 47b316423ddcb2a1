//! Long global descriptors made short: their principal components, learnt on the run itself.
//!
//! Principal components of VLAD (Jégou & Chum 2012) keep what tells a run's images apart. They are found from the products
//! of a sample of images, not from the covariance of eight thousand dimensions. Everything is sums and products in a
//! fixed order, so that the result doesn't hang on threads or on the processor.

use rand::RngExt;
use rayon::prelude::*;
use terrane_geometry::Seed;

use super::eigen::{orthonormalize, symmetric_eigen};

/// Directions beyond those wanted, which help the wanted ones to converge (Halko, Martinsson & Tropp 2011).
const OVERSAMPLED: usize = 8;
/// Rounds of subspace iteration.
const ROUNDS: usize = 12;
/// Components below this share of the first are noise and are left out.
const LEAST_VARIANCE: f64 = 1e-6;

/// Projects global descriptors to fewer dimensions.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Projection {
    mean: Vec<f32>,
    /// Directions of the mean's length, one after another.
    directions: Vec<f32>,
}

impl Projection {
    /// Learns at most `dimensions` directions from a sample of descriptors of one length; empty ones are left out. Has
    /// fewer when the sample has. A thousand are enough; the work grows with their square.
    pub fn train(sample: &[Vec<f32>], dimensions: usize, seed: Seed) -> Self {
        let len = sample.iter().map(Vec::len).find(|&len| len > 0).unwrap_or(0);
        let rows: Vec<&[f32]> = sample
            .iter()
            .filter(|row| row.len() == len && row.iter().all(|v| v.is_finite()))
            .map(Vec::as_slice)
            .collect();
        if rows.len() < 2 || len == 0 || dimensions == 0 {
            return Self::default();
        }
        let mean = mean(&rows, len);
        let centered: Vec<Vec<f32>> =
            rows.par_iter().map(|row| row.iter().zip(&mean).map(|(a, b)| a - b).collect()).collect();
        let products = products(&centered);
        let count = dimensions.min(rows.len() - 1);
        let (values, vectors) = leading(&products, rows.len(), count, seed);
        let largest = values.first().copied().unwrap_or(0.0);
        let kept = values.iter().take_while(|&&value| value > LEAST_VARIANCE * largest).count();
        let direction = |k: usize| -> Vec<f32> {
            let mut sum = vec![0.0_f64; len];
            for (row, weight) in centered.iter().zip(&vectors[k]) {
                sum.iter_mut().zip(row).for_each(|(sum, &value)| *sum += weight * f64::from(value));
            }
            let scale = 1.0 / values[k].sqrt();
            sum.iter().map(|value| (value * scale) as f32).collect()
        };
        let directions: Vec<Vec<f32>> = (0..kept).into_par_iter().map(direction).collect();
        Self { mean, directions: directions.concat() }
    }

    /// How many numbers a projected descriptor has.
    pub fn dimensions(&self) -> usize {
        if self.mean.is_empty() { 0 } else { self.directions.len() / self.mean.len() }
    }

    /// The components of a descriptor; empty for one of another length.
    pub fn project(&self, descriptor: &[f32]) -> Vec<f32> {
        if descriptor.len() != self.mean.len() || descriptor.is_empty() {
            return Vec::new();
        }
        let centered: Vec<f32> = descriptor.iter().zip(&self.mean).map(|(a, b)| a - b).collect();
        self.directions
            .chunks_exact(self.mean.len())
            .map(|direction| dot(&centered, direction) as f32)
            .collect()
    }
}

fn mean(rows: &[&[f32]], len: usize) -> Vec<f32> {
    let mut sum = vec![0.0_f64; len];
    for row in rows {
        sum.iter_mut().zip(*row).for_each(|(sum, &value)| *sum += f64::from(value));
    }
    sum.iter().map(|value| (value / rows.len() as f64) as f32).collect()
}

/// Dot products of all rows with all, row after row.
fn products(rows: &[Vec<f32>]) -> Vec<f64> {
    let lower: Vec<Vec<f64>> =
        (0..rows.len()).into_par_iter().map(|i| (0..=i).map(|j| dot(&rows[i], &rows[j])).collect()).collect();
    let n = rows.len();
    let at = |i: usize, j: usize| if j <= i { lower[i][j] } else { lower[j][i] };
    (0..n * n).map(|k| at(k / n, k % n)).collect()
}

/// Dot product in double precision in a fixed number of sums.
fn dot(a: &[f32], b: &[f32]) -> f64 {
    const SUMS: usize = 8;
    let (a_parts, a_rest) = a.as_chunks::<SUMS>();
    let (b_parts, b_rest) = b.as_chunks::<SUMS>();
    let mut sums = [0.0_f64; SUMS];
    for (a, b) in a_parts.iter().zip(b_parts) {
        (0..SUMS).for_each(|k| sums[k] += f64::from(a[k]) * f64::from(b[k]));
    }
    let rest: f64 = a_rest.iter().zip(b_rest).map(|(&a, &b)| f64::from(a) * f64::from(b)).sum();
    sums.iter().sum::<f64>() + rest
}

/// The greatest eigenvalues of a symmetric positive matrix of `n` rows, and their vectors, by subspace iteration with a
/// Rayleigh–Ritz step at the end.
fn leading(matrix: &[f64], n: usize, count: usize, seed: Seed) -> (Vec<f64>, Vec<Vec<f64>>) {
    let width = (count + OVERSAMPLED).min(n);
    let mut rng = seed.derive("subspace").rng();
    let mut basis: Vec<Vec<f64>> =
        (0..width).map(|_| (0..n).map(|_| rng.random_range(-1.0..1.0)).collect()).collect();
    orthonormalize(&mut basis);
    let apply = |vector: &Vec<f64>| -> Vec<f64> {
        matrix.chunks_exact(n).map(|row| row.iter().zip(vector).map(|(a, b)| a * b).sum()).collect()
    };
    for _ in 0..ROUNDS {
        basis = basis.par_iter().map(apply).collect();
        orthonormalize(&mut basis);
    }
    let applied: Vec<Vec<f64>> = basis.par_iter().map(apply).collect();
    let width = basis.len();
    let small: Vec<f64> = (0..width * width)
        .map(|k| basis[k / width].iter().zip(&applied[k % width]).map(|(a, b)| a * b).sum())
        .collect();
    let (values, small_vectors) = symmetric_eigen(&small, width);
    let vector = |k: usize| -> Vec<f64> {
        let mut sum = vec![0.0; n];
        for (direction, weight) in basis.iter().zip(&small_vectors[k]) {
            sum.iter_mut().zip(direction).for_each(|(sum, value)| *sum += weight * value);
        }
        sum
    };
    let count = count.min(width);
    (values[..count].to_vec(), (0..count).into_par_iter().map(vector).collect())
}
