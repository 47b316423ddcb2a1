//! Preconditioned conjugate gradients (Hestenes & Stiefel 1952).

use super::super::BundleError;

/// A symmetric positive definite system that can be multiplied with, and something near its inverse.
pub(super) trait System {
    /// `S x`.
    fn multiply(&mut self, x: &[f64]) -> Result<Vec<f64>, BundleError>;

    /// `M⁻¹ r`.
    fn precondition(&mut self, r: &[f64]) -> Result<Vec<f64>, BundleError>;
}

/// What conjugate gradients found.
#[derive(Clone, Debug, Default)]
pub(super) struct Solved {
    pub x: Vec<f64>,
    /// What is left: `b − S x`.
    pub residual: Vec<f64>,
    pub iterations: u32,
}

/// Solves `S x = b` from zero, until the residual in the norm of `M⁻¹` is below `tolerance` of the first. Where rounding
/// makes `S` or `M` look indefinite, it ends with what it has.
pub(super) fn solve(
    system: &mut dyn System,
    b: &[f64],
    tolerance: f64,
    max_iterations: u32,
) -> Result<Solved, BundleError> {
    let mut solved = Solved { x: vec![0.0; b.len()], residual: b.to_vec(), iterations: 0 };
    let mut z = system.precondition(b)?;
    let mut direction = z.clone();
    let first = dot(&solved.residual, &z);
    let mut energy = first;
    while energy > tolerance * tolerance * first && energy.is_finite() && solved.iterations < max_iterations {
        let image = system.multiply(&direction)?;
        let curvature = dot(&direction, &image);
        if !(curvature > 0.0 && curvature.is_finite()) {
            break;
        }
        solved.iterations += 1;
        let length = energy / curvature;
        for i in 0..b.len() {
            solved.x[i] += length * direction[i];
            solved.residual[i] -= length * image[i];
        }
        z = system.precondition(&solved.residual)?;
        let next = dot(&solved.residual, &z);
        let ratio = next / energy;
        energy = next;
        for i in 0..b.len() {
            direction[i] = z[i] + ratio * direction[i];
        }
    }
    Ok(solved)
}

/// In a fixed order, four sums at a time.
pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<4>(), b.as_chunks::<4>());
    let mut sums = [0.0; 4];
    for (a, b) in a.iter().zip(b) {
        (0..4).for_each(|l| sums[l] += a[l] * b[l]);
    }
    let rest: f64 = a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum();
    (sums[0] + sums[2]) + (sums[1] + sums[3]) + rest
}
