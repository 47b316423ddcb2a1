//! Which way a problem is solved, and what it leaves behind.

use nalgebra::Vector3;

use super::explicit::Explicit;
use super::implicit::solve_here;
use super::layout::Cameras;
use super::levenberg_marquardt::minimise;
use super::{
    AdjustedCameras, BundleError, BundleOptions, BundleProblem, BundleReport, BundleSolver, Gauge, Shards,
};

/// Up to this many camera unknowns the system is factorised. With 441 (problem-49 of BAL) that is the faster way by a
/// quarter, with 3,600 (an aerial block of 400 photographs) conjugate gradients are six times as fast.
const EXPLICIT_UP_TO: usize = 600;

/// Adjusts poses, intrinsics and points to minimise robust reprojection errors and priors.
///
/// Levenberg–Marquardt with the diagonal as damping (Marquardt 1963) and Nielsen's (1999) update of it. The problem and
/// the shards' points are changed only when the solve ends without an error. Beside the reduced system and the kept
/// linearisations, memory is 48 bytes for each point.
///
/// # Errors
///
/// When the problem, the options or a shard are not valid, when a shard can't be loaded or stored, or when the reduced
/// system does not fit into indices. That nothing could be adjusted is no error: see [`Termination`].
pub fn solve(
    problem: &mut BundleProblem,
    shards: &mut dyn Shards,
    options: &BundleOptions,
) -> Result<BundleReport, BundleError> {
    problem.validate()?;
    options.validate()?;
    let mut report = BundleReport::empty();
    report.solver = choose(problem, options)?;
    let (cameras, points) = match report.solver {
        BundleSolver::Implicit => solve_here(problem, shards, options, &mut report)?,
        _ => solve_explicit(problem, shards, options, &mut report)?,
    };
    for (i, points) in points.iter().enumerate() {
        shards.store_points(i, points)?;
    }
    AdjustedCameras::from(cameras).put_into(problem);
    Ok(report)
}

type Solution = (Cameras, Vec<Vec<Vector3<f64>>>);

fn solve_explicit(
    problem: &BundleProblem,
    shards: &dyn Shards,
    options: &BundleOptions,
    report: &mut BundleReport,
) -> Result<Solution, BundleError> {
    let mut explicit = Explicit::prepare(problem, shards, options, report)?;
    let anything = explicit.anything_to_adjust(report);
    report.termination = minimise(&mut explicit, options, anything, report)?;
    Ok(explicit.into_result())
}

/// What [`BundleSolver::Auto`] stands for.
fn choose(problem: &BundleProblem, options: &BundleOptions) -> Result<BundleSolver, BundleError> {
    let free = problem.fixed_poses.iter().filter(|fixed| !**fixed).count();
    let refined =
        problem.refine.iter().zip(&problem.intrinsics).map(|(refine, camera)| refine.params(camera).len());
    let unknowns = 6 * free + refined.sum::<usize>();
    match (options.solver, options.gauge) {
        (BundleSolver::Implicit, Gauge::TwoPoses) => Err(BundleError::invalid(
            "conjugate gradients can't hold a direction: choose the damped gauge, fix poses, or use the explicit solver"
                .to_owned(),
        )),
        (BundleSolver::Auto, Gauge::Damped) if unknowns > EXPLICIT_UP_TO => Ok(BundleSolver::Implicit),
        (BundleSolver::Auto, _) => Ok(BundleSolver::Explicit),
        (forced, _) => Ok(forced),
    }
}
