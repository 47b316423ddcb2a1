//! The Levenberg–Marquardt loop.

use nalgebra::Vector3;

use super::layout::{Cameras, Layout};
use super::linearisation::{Context, Linearisation};
use super::pattern::Covisibility;
use super::plan::{Dropped, ShardPlan};
use super::reduced::{Reduced, prior_cost};
use super::schur::{self, PoseRow};
use super::step::{CameraStep, Tried, try_step};
use super::{
    BundleError, BundleOptions, BundleProblem, BundleReport, BundleShard, Gauge, Shards, Termination,
};

/// A step must win at least this part of what its model promised (Ceres).
const MIN_GAIN: f64 = 1e-3;
const MIN_DAMPING: f64 = 1e-14;
const MAX_DAMPING: f64 = 1e16;
/// Differences of costs below this part of them are noise.
const ROUNDING: f64 = 1e-13;

/// What the solve keeps of a shard.
struct ShardState {
    dropped: Dropped,
    points: Vec<Vector3<f64>>,
    trial: Vec<Vector3<f64>>,
    /// The linearisation, while memory lasts.
    kept: Option<(ShardPlan, Linearisation)>,
}

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
    let mut solver = Solver::prepare(problem, &*shards, options)?;
    let (termination, initial_cost, final_cost) = solver.run(&*shards)?;
    let Solver { cameras, states, mut report, .. } = solver;
    report.termination = termination;
    report.initial_cost = initial_cost;
    report.final_cost = final_cost;
    for (i, state) in states.iter().enumerate() {
        shards.store_points(i, &state.points)?;
    }
    problem.poses = cameras.poses;
    problem.intrinsics = cameras.intrinsics;
    Ok(report)
}

/// What stays the same during a solve.
struct Setup<'a> {
    problem: &'a BundleProblem,
    options: &'a BundleOptions,
    layout: Layout,
    /// First unknown of each intrinsics variable.
    intrinsics_offsets: Vec<usize>,
    /// The two poses of [`Gauge::TwoPoses`].
    held_pair: Option<(u32, u32)>,
    /// Whether any point may move.
    free_points: bool,
}

struct Solver<'a> {
    setup: Setup<'a>,
    cameras: Cameras,
    states: Vec<ShardState>,
    rows: Vec<PoseRow>,
    reduced: Reduced,
    report: BundleReport,
}

impl Setup<'_> {
    fn context<'b>(&'b self, cameras: &'b Cameras, damping: f64) -> Context<'b> {
        Context {
            problem: self.problem,
            layout: &self.layout,
            cameras,
            loss: self.options.loss,
            loss_scale_px: self.options.loss_scale_px,
            held_direction: self.held_direction(cameras),
            damping,
        }
    }

    /// The direction from one held pose to the other, in the frame of the second.
    fn held_direction(&self, cameras: &Cameras) -> Option<(u32, Vector3<f64>)> {
        let (first, second) = self.held_pair?;
        let (first, pose) = (&cameras.poses[first as usize], &cameras.poses[second as usize]);
        let direction = pose.rotation * (pose.center() - first.center());
        direction.try_normalize(0.0).map(|direction| (second, direction))
    }

    fn prior_cost(&self, cameras: &Cameras) -> f64 {
        prior_cost(self.problem, &self.layout, cameras, self.options)
    }

    /// The plan of a shard that is not kept, and room for its linearisation.
    fn replan(
        &self,
        shards: &dyn Shards,
        index: usize,
        state: &ShardState,
    ) -> Result<(ShardPlan, Linearisation), BundleError> {
        let shard = shards.load(index)?;
        if shard.points.len() != state.points.len() {
            return Err(BundleError::invalid(format!("shard {index} changed during the solve")));
        }
        let plan = ShardPlan::new(&shard, &state.dropped, self.problem);
        let linearisation = Linearisation::new(&plan, self.layout.stride);
        Ok((plan, linearisation))
    }
}

impl<'a> Solver<'a> {
    /// Reads every shard once: what takes part, what sees what, what is unknown.
    fn prepare(
        problem: &'a BundleProblem,
        shards: &dyn Shards,
        options: &'a BundleOptions,
    ) -> Result<Self, BundleError> {
        let cameras = Cameras::new(problem.poses.clone(), problem.intrinsics.clone());
        let num_poses = problem.poses.len();
        let mut report = BundleReport::empty();
        let mut covisibility = Covisibility::new(num_poses);
        let mut observed = vec![false; num_poses];
        let (mut states, mut plans) = (Vec::with_capacity(shards.len()), Vec::new());
        let (mut fixed_points, mut free_points) = (false, false);
        let mut memory = options.linearisation_memory_bytes;
        for i in 0..shards.len() {
            let shard = shards.load(i)?;
            shard.validate(i, num_poses)?;
            let dropped = Dropped::find(&shard, problem, &cameras);
            let plan = ShardPlan::new(&shard, &dropped, problem);
            plan.observations.iter().for_each(|o| observed[o.pose as usize] = true);
            covisibility.add(&plan);
            fixed_points |= shard.fixed_points;
            free_points |= !shard.fixed_points && !plan.observations.is_empty();
            report.observations += plan.observations.len() as u64;
            report.points += plan.num_points();
            report.behind_camera += dropped.behind_camera;
            report.seen_once += dropped.seen_once;
            // The stride is not known yet: predict with the largest that is compiled with a fixed size.
            let bytes = Linearisation::predicted_bytes(plan.observations.len(), shard.points.len(), 6);
            let keep = bytes <= memory;
            memory -= if keep { bytes } else { 0 };
            plans.push(keep.then_some(plan));
            let points = shard.into_owned_points();
            states.push(ShardState { dropped, trial: points.clone(), points, kept: None });
        }
        let held_pair = held_pair(problem, &observed, fixed_points, options.gauge);
        let layout = Layout::new(problem, &observed, held_pair.map(|(held, _)| held));
        for (state, plan) in states.iter_mut().zip(plans) {
            state.kept = plan.map(|plan| {
                let linearisation = Linearisation::new(&plan, layout.stride);
                (plan, linearisation)
            });
        }
        report.unconstrained_poses = unconstrained(problem, &layout, held_pair);
        report.reduced_unknowns = layout.num_unknowns() as u64;
        let (rows, pattern) = covisibility.rows(&layout);
        let free = layout.poses.len();
        let intrinsics_offsets = (0..layout.intrinsics.len()).map(|v| pattern.offset(free + v)).collect();
        let reduced = Reduced::new(pattern, options)?;
        let setup = Setup { problem, options, layout, intrinsics_offsets, held_pair, free_points };
        Ok(Self { setup, cameras, states, rows, reduced, report })
    }

    /// Iterates to a minimum; why it stopped, and the cost before and after.
    fn run(&mut self, shards: &dyn Shards) -> Result<(Termination, f64, f64), BundleError> {
        let mut damping = self.setup.options.initial_damping;
        let mut factor = 2.0;
        let (mut cost, mut steepest) = self.linearise(shards, damping, true)?;
        let initial_cost = cost;
        let anything = self.report.observations > 0 || !self.setup.problem.position_priors.is_empty();
        if !anything || (self.setup.layout.num_unknowns() == 0 && !self.setup.free_points) {
            return Ok((Termination::NothingToAdjust, initial_cost, cost));
        }
        let termination = loop {
            let tolerance = self.setup.options.gradient_tolerance;
            if steepest <= 2.0 * cost * tolerance * tolerance || cost == 0.0 {
                break Termination::Gradient;
            }
            if self.report.iterations >= self.setup.options.max_iterations {
                break Termination::MaxIterations;
            }
            self.report.iterations += 1;
            let tried = self.try_damping(shards, damping)?;
            let gain = tried.as_ref().map_or(-1.0, |(_, tried)| tried.gain(cost));
            let promised = tried.as_ref().map_or(f64::INFINITY, |(_, tried)| tried.model_reduction);
            if let Some((next, tried)) = tried
                && gain > MIN_GAIN
            {
                self.accept(next);
                self.report.accepted_steps += 1;
                damping = (damping * (1.0 - (2.0 * gain - 1.0).powi(3)).max(1.0 / 3.0)).max(MIN_DAMPING);
                factor = 2.0;
                let won = cost - tried.cost;
                let before = std::mem::replace(&mut cost, tried.cost);
                if won <= self.setup.options.cost_tolerance * before {
                    break Termination::Cost;
                }
                if tried.is_short(self.setup.options.step_tolerance) {
                    break Termination::Step;
                }
                steepest = self.linearise(shards, damping, true)?.1;
            } else {
                // Little damping, and still the model promises less than rounding hides.
                if promised <= ROUNDING * cost && factor <= 64.0 {
                    break Termination::Cost;
                }
                damping *= factor;
                factor *= 2.0;
                if damping > MAX_DAMPING {
                    break Termination::NoDescent;
                }
                self.linearise(shards, damping, false)?;
            }
        };
        Ok((termination, initial_cost, cost))
    }

    /// Fills the reduced system; the cost and the largest `g² / D`. Without `anew`, only the damping has changed.
    fn linearise(
        &mut self,
        shards: &dyn Shards,
        damping: f64,
        anew: bool,
    ) -> Result<(f64, f64), BundleError> {
        schur::clear(&mut self.rows);
        let (mut cost, mut steepest) = (0.0, 0.0f64);
        let (setup, rows) = (&self.setup, &mut self.rows);
        let context = setup.context(&self.cameras, damping);
        for (i, state) in self.states.iter_mut().enumerate() {
            let updated = match &mut state.kept {
                Some((plan, shard)) => {
                    let updated = shard.update(&context, plan, anew.then_some(&state.points));
                    schur::accumulate(rows, &setup.layout, plan, shard);
                    updated
                }
                None => {
                    let (plan, mut shard) = setup.replan(shards, i, state)?;
                    let updated = shard.update(&context, &plan, Some(&state.points));
                    schur::accumulate(rows, &setup.layout, &plan, &shard);
                    updated
                }
            };
            cost += updated.cost;
            steepest = steepest.max(updated.steepest);
        }
        cost += setup.prior_cost(&self.cameras);
        self.reduced.assemble(&context, rows, setup.options);
        Ok((cost, steepest.max(self.reduced.steepest())))
    }

    /// Solves with this damping and evaluates the step; `None` where there is none.
    fn try_damping(
        &mut self,
        shards: &dyn Shards,
        damping: f64,
    ) -> Result<Option<(Cameras, Trial)>, BundleError> {
        let Some(step) = self.reduced.solve() else { return Ok(None) };
        let setup = &self.setup;
        let Some(next) = self.cameras.stepped(&setup.layout, &step) else { return Ok(None) };
        let mut sum = Tried {
            cost: setup.prior_cost(&next),
            model_reduction: self.reduced.model_reduction(&step, damping),
            step_squared: step.iter().map(|h| h * h).sum(),
            norm_squared: self.cameras.squared_norm(&setup.layout),
        };
        let context = setup.context(&self.cameras, damping);
        let camera_step =
            CameraStep { step: &step, cameras: &next, intrinsics_offsets: &setup.intrinsics_offsets };
        for (i, state) in self.states.iter_mut().enumerate() {
            let tried = match &state.kept {
                Some((plan, shard)) => {
                    try_step(&context, &camera_step, (plan, shard), &state.points, &mut state.trial)
                }
                None => {
                    let (plan, mut shard) = setup.replan(shards, i, state)?;
                    shard.update(&context, &plan, Some(&state.points));
                    try_step(&context, &camera_step, (&plan, &shard), &state.points, &mut state.trial)
                }
            };
            sum.cost += tried.cost;
            sum.model_reduction += tried.model_reduction;
            sum.step_squared += tried.step_squared;
            sum.norm_squared += tried.norm_squared;
        }
        Ok(Some((next, Trial(sum))))
    }

    fn accept(&mut self, next: Cameras) {
        self.cameras = next;
        for state in &mut self.states {
            std::mem::swap(&mut state.points, &mut state.trial);
        }
    }
}

/// A step over the whole problem.
struct Trial(Tried);

impl std::ops::Deref for Trial {
    type Target = Tried;

    fn deref(&self) -> &Tried {
        &self.0
    }
}

impl Trial {
    /// The won part of what the model promised; not above zero when the step is no descent.
    fn gain(&self, cost: f64) -> f64 {
        let gain = (cost - self.cost) / self.model_reduction;
        if gain.is_finite() && self.model_reduction > 0.0 { gain } else { -1.0 }
    }

    fn is_short(&self, tolerance: f64) -> bool {
        self.step_squared.sqrt() <= tolerance * (self.norm_squared.sqrt() + tolerance)
    }
}

/// The poses of [`Gauge::TwoPoses`]: one to hold, and the farthest from it.
fn held_pair(
    problem: &BundleProblem,
    observed: &[bool],
    fixed_points: bool,
    gauge: Gauge,
) -> Option<(u32, u32)> {
    let fixed: Vec<usize> = (0..observed.len()).filter(|i| problem.fixed_poses[*i] && observed[*i]).collect();
    if gauge == Gauge::Damped || fixed_points || fixed.len() > 1 || problem.position_priors.len() >= 3 {
        return None;
    }
    let first = fixed.first().copied().or_else(|| observed.iter().position(|o| *o))?;
    let center = problem.poses[first].center();
    let distance = |i: usize| (problem.poses[i].center() - center).norm_squared();
    let second = (0..observed.len())
        .filter(|i| *i != first && observed[*i])
        .max_by(|a, b| distance(*a).total_cmp(&distance(*b)).then(b.cmp(a)))?;
    Some((first as u32, second as u32))
}

fn unconstrained(problem: &BundleProblem, layout: &Layout, held: Option<(u32, u32)>) -> Vec<u32> {
    (0..problem.poses.len() as u32)
        .filter(|pose| {
            let free = !problem.fixed_poses[*pose as usize] && held.is_none_or(|(first, _)| first != *pose);
            free && layout.pose_variable[*pose as usize] == super::layout::NONE
        })
        .collect()
}

/// Takes the points out of a loaded shard.
trait IntoOwnedPoints {
    fn into_owned_points(self) -> Vec<Vector3<f64>>;
}

impl IntoOwnedPoints for std::borrow::Cow<'_, BundleShard> {
    fn into_owned_points(self) -> Vec<Vector3<f64>> {
        match self {
            std::borrow::Cow::Borrowed(shard) => shard.points.clone(),
            std::borrow::Cow::Owned(shard) => shard.points,
        }
    }
}
