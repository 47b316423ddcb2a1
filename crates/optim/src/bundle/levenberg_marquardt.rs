//! The Levenberg–Marquardt loop, whatever solves its linear systems.

use super::step::Tried;
use super::{BundleError, BundleOptions, BundleReport, Termination};

/// A step must win at least this part of what its model promised (Ceres).
const MIN_GAIN: f64 = 1e-3;
const MIN_DAMPING: f64 = 1e-14;
const MAX_DAMPING: f64 = 1e16;
/// Differences of costs below this part of them are noise.
const ROUNDING: f64 = 1e-13;

/// What a linearisation found.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Linearised {
    /// The cost where it was linearised.
    pub cost: f64,
    /// The largest `g² / D` of an unknown.
    pub steepest: f64,
}

/// What the loop asks of the part that knows the problem.
pub(super) trait Backend {
    /// Linearises at the accepted cameras and points; without `anew`, only the damping has changed.
    fn linearise(&mut self, damping: f64, anew: bool) -> Result<Linearised, BundleError>;

    /// Solves with this damping and evaluates the step; `None` where there is none.
    fn try_step(&mut self, damping: f64) -> Result<Option<Tried>, BundleError>;

    /// Makes the tried step the accepted one.
    fn accept(&mut self) -> Result<(), BundleError>;
}

/// Iterates to a minimum with the diagonal as damping (Marquardt 1963) and Nielsen's (1999) update of it; why it
/// stopped. Costs and iterations go to the report.
pub(super) fn minimise(
    backend: &mut dyn Backend,
    options: &BundleOptions,
    anything_to_adjust: bool,
    report: &mut BundleReport,
) -> Result<Termination, BundleError> {
    let mut damping = options.initial_damping;
    let mut factor = 2.0;
    let Linearised { mut cost, mut steepest } = backend.linearise(damping, true)?;
    report.initial_cost = cost;
    report.final_cost = cost;
    if !anything_to_adjust {
        return Ok(Termination::NothingToAdjust);
    }
    loop {
        let tolerance = options.gradient_tolerance;
        if steepest <= 2.0 * cost * tolerance * tolerance || cost == 0.0 {
            return Ok(Termination::Gradient);
        }
        if report.iterations >= options.max_iterations {
            return Ok(Termination::MaxIterations);
        }
        report.iterations += 1;
        let tried = backend.try_step(damping)?;
        let gain = tried.as_ref().map_or(-1.0, |tried| tried.gain(cost));
        let promised = tried.as_ref().map_or(f64::INFINITY, |tried| tried.model_reduction);
        if let Some(tried) = tried
            && gain > MIN_GAIN
        {
            backend.accept()?;
            report.accepted_steps += 1;
            damping = (damping * (1.0 - (2.0 * gain - 1.0).powi(3)).max(1.0 / 3.0)).max(MIN_DAMPING);
            factor = 2.0;
            let won = cost - tried.cost;
            let before = std::mem::replace(&mut cost, tried.cost);
            report.final_cost = cost;
            if won <= options.cost_tolerance * before {
                return Ok(Termination::Cost);
            }
            if tried.is_short(options.step_tolerance) {
                return Ok(Termination::Step);
            }
            steepest = backend.linearise(damping, true)?.steepest;
        } else {
            // Little damping, and still the model promises less than rounding hides.
            if promised <= ROUNDING * cost && factor <= 64.0 {
                return Ok(Termination::Cost);
            }
            damping *= factor;
            factor *= 2.0;
            if damping > MAX_DAMPING {
                return Ok(Termination::NoDescent);
            }
            backend.linearise(damping, false)?;
        }
    }
}
