//! Small dense least squares by Levenberg–Marquardt (Levenberg 1944, Marquardt 1963), with sizes known at compile time.
//!
//! The solver knows no cameras and no points: a [`LeastSquares`] problem offers its cost, its normal equations and a step.
//! For problems with thousands of unknowns see `terrane-optim`.

use nalgebra::{SMatrix, SVector};

use crate::linear::solve_positive_definite;

/// A least-squares problem with `N` unknowns in the tangent space of its state.
pub trait LeastSquares<const N: usize> {
    /// What is estimated.
    type State: Clone;

    /// Half the sum of (robustified) squared residuals; not finite where the state is outside the domain.
    fn cost(&self, state: &Self::State) -> f64;

    /// Adds every residual, with its Jacobian at the zero step, to the normal equations.
    fn linearize(&self, state: &Self::State, into: &mut NormalEquations<N>);

    /// The state after a step in the tangent space.
    fn retract(&self, state: &Self::State, step: &SVector<f64, N>) -> Self::State;
}

/// `JᵀWJ` (lower triangle) and `JᵀWr`, summed residual by residual.
#[derive(Clone, Debug)]
pub struct NormalEquations<const N: usize> {
    hessian: SMatrix<f64, N, N>,
    gradient: SVector<f64, N>,
}

impl<const N: usize> Default for NormalEquations<N> {
    fn default() -> Self {
        Self { hessian: SMatrix::zeros(), gradient: SVector::zeros() }
    }
}

impl<const N: usize> NormalEquations<N> {
    /// Adds one scalar residual of this weight with its row of the Jacobian.
    #[inline]
    pub fn add(&mut self, weight: f64, residual: f64, row: &[f64; N]) {
        for j in 0..N {
            let weighted = weight * row[j];
            self.gradient[j] += weighted * residual;
            for i in j..N {
                self.hessian[(i, j)] += weighted * row[i];
            }
        }
    }

    /// `JᵀWr`, the gradient of the cost.
    pub fn gradient(&self) -> &SVector<f64, N> {
        &self.gradient
    }

    /// `JᵀWJ`, both triangles.
    pub fn hessian(&self) -> SMatrix<f64, N, N> {
        SMatrix::from_fn(|i, j| self.hessian[(i.max(j), i.min(j))])
    }

    /// The damped step, or `None` when the damped matrix is not positive definite.
    fn step(&self, damping: f64) -> Option<SVector<f64, N>> {
        let mut damped = self.hessian;
        let floor = 1e-9 * (0..N).map(|i| self.hessian[(i, i)]).fold(0.0, f64::max);
        for i in 0..N {
            damped[(i, i)] += damping * self.hessian[(i, i)].max(floor);
        }
        solve_positive_definite(&damped, &-self.gradient)
    }

    /// What the linear model says the cost falls by.
    fn predicted_decrease(&self, step: &SVector<f64, N>) -> f64 {
        -self.gradient.dot(step) - 0.5 * step.dot(&(self.hessian() * step))
    }
}

/// When to stop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LmOptions {
    /// Most steps tried, accepted or not. Default 25: small problems converge in fewer than ten.
    pub max_iterations: u32,
    /// Stop when no component of the gradient is larger. Default 1e-12.
    pub gradient_tolerance: f64,
    /// Stop when a step is shorter, in the tangent space's units. Default 1e-10.
    pub step_tolerance: f64,
    /// Stop when the cost falls by a smaller share. Default 1e-10.
    pub cost_tolerance: f64,
    /// Damping of the first step, relative to the diagonal. Default 1e-4.
    pub initial_damping: f64,
}

impl Default for LmOptions {
    fn default() -> Self {
        Self {
            max_iterations: 25,
            gradient_tolerance: 1e-12,
            step_tolerance: 1e-10,
            cost_tolerance: 1e-10,
            initial_damping: 1e-4,
        }
    }
}

/// Why the solver stopped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LmTermination {
    /// The gradient is below its tolerance.
    Gradient,
    /// The last step is below its tolerance.
    Step,
    /// The last decrease of the cost is below its tolerance.
    Cost,
    /// The most iterations were used.
    MaxIterations,
    /// No damping gave a lower cost.
    NoDescent,
    /// The start is outside the problem's domain, or its normal equations are not finite.
    Degenerate,
}

/// What the solver did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LmReport {
    /// Cost at the start.
    pub initial_cost: f64,
    /// Cost at the returned state; never above the initial cost.
    pub final_cost: f64,
    /// Steps tried.
    pub iterations: u32,
    /// Why it stopped.
    pub termination: LmTermination,
}

/// Minimises from a start; the state returned is never worse than it.
pub fn minimize<const N: usize, P: LeastSquares<N>>(
    problem: &P,
    start: P::State,
    options: &LmOptions,
) -> (P::State, LmReport) {
    const MAX_DAMPING: f64 = 1e12;
    let mut state = start;
    let mut cost = problem.cost(&state);
    let mut report = LmReport {
        initial_cost: cost,
        final_cost: cost,
        iterations: 0,
        termination: LmTermination::Degenerate,
    };
    if !cost.is_finite() {
        return (state, report);
    }
    let mut damping = options.initial_damping;
    let mut equations = linearized(problem, &state);
    report.termination = loop {
        if !equations.gradient.iter().all(|value| value.is_finite()) {
            break LmTermination::Degenerate;
        }
        if equations.gradient.amax() <= options.gradient_tolerance {
            break LmTermination::Gradient;
        }
        if report.iterations >= options.max_iterations {
            break LmTermination::MaxIterations;
        }
        if damping > MAX_DAMPING {
            break LmTermination::NoDescent;
        }
        report.iterations += 1;
        let Some(step) = equations.step(damping) else {
            damping *= 10.0;
            continue;
        };
        if step.norm() <= options.step_tolerance {
            break LmTermination::Step;
        }
        let trial = problem.retract(&state, &step);
        let trial_cost = problem.cost(&trial);
        if !(trial_cost < cost) {
            damping *= 10.0;
            continue;
        }
        let decrease = cost - trial_cost;
        let trusted = decrease > 0.25 * equations.predicted_decrease(&step);
        damping = if trusted { (damping * 0.1).max(1e-12) } else { damping * 2.0 };
        let done = decrease <= options.cost_tolerance * cost;
        (state, cost) = (trial, trial_cost);
        if done {
            break LmTermination::Cost;
        }
        equations = linearized(problem, &state);
    };
    report.final_cost = cost;
    (state, report)
}

fn linearized<const N: usize, P: LeastSquares<N>>(problem: &P, state: &P::State) -> NormalEquations<N> {
    let mut equations = NormalEquations::default();
    problem.linearize(state, &mut equations);
    equations
}

/// The Cauchy loss `c²/2 ln(1 + r²/c²)` of a squared residual, as (half cost, weight of the residual).
#[inline]
pub fn cauchy(squared: f64, scale: f64) -> (f64, f64) {
    let scale_squared = scale * scale;
    let ratio = squared / scale_squared;
    (0.5 * scale_squared * ratio.ln_1p(), 1.0 / (1.0 + ratio))
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Checks the gradient that a problem accumulates against central differences of its cost, taken through its own step.
    pub(crate) fn assert_gradient<const N: usize, P: LeastSquares<N>>(
        problem: &P,
        state: &P::State,
        tolerance: f64,
    ) {
        let equations = linearized(problem, state);
        let numeric = SVector::<f64, N>::from_fn(|i, _| {
            let h = 1e-6;
            let at = |value: f64| {
                let mut step = SVector::<f64, N>::zeros();
                step[i] = value;
                problem.cost(&problem.retract(state, &step))
            };
            (at(h) - at(-h)) / (2.0 * h)
        });
        let scale = numeric.norm().max(1e-6);
        assert!(
            (equations.gradient() - numeric).norm() < tolerance * scale,
            "{} {numeric}",
            equations.gradient()
        );
    }

    /// Rosenbrock's valley as two residuals.
    struct Valley;

    impl LeastSquares<2> for Valley {
        type State = SVector<f64, 2>;

        fn cost(&self, s: &Self::State) -> f64 {
            0.5 * ((1.0 - s.x).powi(2) + 100.0 * (s.y - s.x * s.x).powi(2))
        }

        fn linearize(&self, s: &Self::State, into: &mut NormalEquations<2>) {
            into.add(1.0, 1.0 - s.x, &[-1.0, 0.0]);
            into.add(1.0, 10.0 * (s.y - s.x * s.x), &[-20.0 * s.x, 10.0]);
        }

        fn retract(&self, s: &Self::State, step: &SVector<f64, 2>) -> Self::State {
            s + step
        }
    }

    #[test]
    fn finds_the_bottom_of_the_valley() {
        let options = LmOptions { max_iterations: 200, ..Default::default() };
        let (state, report) = minimize(&Valley, SVector::from([-1.2, 1.0]), &options);
        assert!((state - SVector::from([1.0, 1.0])).norm() < 1e-7, "{state} {report:?}");
        assert!(report.final_cost < report.initial_cost && report.iterations > 3);
        assert_gradient(&Valley, &SVector::from([-1.2, 1.0]), 1e-6);
    }

    #[test]
    fn never_worse_than_the_start_and_says_why() {
        let at_minimum = minimize(&Valley, SVector::from([1.0, 1.0]), &LmOptions::default()).1;
        assert_eq!((at_minimum.iterations, at_minimum.termination), (0, LmTermination::Gradient));
        let lost = minimize(&Valley, SVector::from([f64::NAN, 1.0]), &LmOptions::default()).1;
        assert_eq!(lost.termination, LmTermination::Degenerate);
        let short = LmOptions { max_iterations: 1, ..Default::default() };
        assert_eq!(
            minimize(&Valley, SVector::from([-1.2, 1.0]), &short).1.termination,
            LmTermination::MaxIterations
        );
    }
}
