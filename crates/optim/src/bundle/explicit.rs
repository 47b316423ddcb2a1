//! Steps by an explicit reduced camera system: small and middle problems.

use nalgebra::Vector3;

use super::layout::{Cameras, Layout};
use super::levenberg_marquardt::{Backend, Linearised};
use super::linearisation::{Context, Linearisation};
use super::pattern::Covisibility;
use super::plan::{Dropped, ShardPlan};
use super::reduced::Reduced;
use super::schur::{self, PoseRow};
use super::step::{CameraStep, Tried, try_step};
use super::terms;
use super::{BundleError, BundleOptions, BundleProblem, BundleReport, BundleShard, Gauge, Shards};

/// What the solve keeps of a shard.
struct ShardState {
    dropped: Dropped,
    points: Vec<Vector3<f64>>,
    trial: Vec<Vector3<f64>>,
    /// The linearisation, while memory lasts.
    kept: Option<(ShardPlan, Linearisation)>,
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

/// A problem with its reduced camera system.
pub(super) struct Explicit<'a> {
    shards: &'a dyn Shards,
    setup: Setup<'a>,
    cameras: Cameras,
    states: Vec<ShardState>,
    rows: Vec<PoseRow>,
    reduced: Reduced,
    /// The cameras of the step that was tried last.
    tried: Option<Cameras>,
}

impl Setup<'_> {
    fn context<'b>(&'b self, cameras: &'b Cameras, damping: f64) -> Context<'b> {
        Context {
            problem: self.problem,
            layout: &self.layout,
            cameras,
            loss: self.options.loss,
            loss_scale_px: self.options.loss_scale_px,
            behind: self.options.behind_camera,
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
        terms::cost(self.problem, &self.layout, cameras, self.options)
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

impl<'a> Explicit<'a> {
    /// Reads every shard once: what takes part, what sees what, what is unknown.
    pub fn prepare(
        problem: &'a BundleProblem,
        shards: &'a dyn Shards,
        options: &'a BundleOptions,
        report: &mut BundleReport,
    ) -> Result<Self, BundleError> {
        let cameras = Cameras::of(problem);
        let num_poses = problem.poses.len();
        let mut covisibility = Covisibility::new(num_poses);
        let mut observed = vec![false; num_poses];
        let (mut states, mut plans) = (Vec::with_capacity(shards.len()), Vec::new());
        let (mut fixed_points, mut free_points) = (false, false);
        let mut memory = options.linearisation_memory_bytes;
        for i in 0..shards.len() {
            let shard = shards.load(i)?;
            shard.validate(i, num_poses)?;
            let dropped = Dropped::find(&shard, problem, &cameras, options.behind_camera);
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
        let held = held_pair.map(|(held, _)| held);
        let layout = Layout::new(problem, &observed, held, options.behind_camera);
        for (state, plan) in states.iter_mut().zip(plans) {
            state.kept = plan.map(|plan| {
                let linearisation = Linearisation::new(&plan, layout.stride);
                (plan, linearisation)
            });
        }
        report.unconstrained_poses = unconstrained(problem, &layout, held_pair);
        report.reduced_unknowns = layout.num_unknowns() as u64;
        let ties = terms::ties(&terms::terms(problem, &layout, &cameras, options));
        let (rows, pattern) = covisibility.rows(&layout, &ties);
        let free = layout.poses.len();
        let intrinsics_offsets = (0..layout.intrinsics.len()).map(|v| pattern.offset(free + v)).collect();
        let reduced = Reduced::new(pattern, options)?;
        let setup = Setup { problem, options, layout, intrinsics_offsets, held_pair, free_points };
        Ok(Self { shards, setup, cameras, states, rows, reduced, tried: None })
    }

    /// Whether any parameter may move and anything says where to.
    pub fn anything_to_adjust(&self, report: &BundleReport) -> bool {
        let any = report.observations > 0 || self.setup.problem.has_measurements();
        any && (self.setup.layout.num_unknowns() > 0 || self.setup.free_points)
    }

    /// The accepted cameras, and the accepted points of each shard.
    pub fn into_result(self) -> (Cameras, Vec<Vec<Vector3<f64>>>) {
        (self.cameras, self.states.into_iter().map(|state| state.points).collect())
    }
}

impl Backend for Explicit<'_> {
    fn linearise(&mut self, damping: f64, anew: bool) -> Result<Linearised, BundleError> {
        schur::clear(&mut self.rows);
        let mut sum = Linearised::default();
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
                    let (plan, mut shard) = setup.replan(self.shards, i, state)?;
                    let updated = shard.update(&context, &plan, Some(&state.points));
                    schur::accumulate(rows, &setup.layout, &plan, &shard);
                    updated
                }
            };
            sum.cost += updated.cost;
            sum.steepest = sum.steepest.max(updated.steepest);
        }
        sum.cost += setup.prior_cost(&self.cameras);
        self.reduced.assemble(&context, rows, setup.options);
        sum.steepest = sum.steepest.max(self.reduced.steepest());
        Ok(sum)
    }

    fn try_step(&mut self, damping: f64) -> Result<Option<Tried>, BundleError> {
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
                    let (plan, mut shard) = setup.replan(self.shards, i, state)?;
                    shard.update(&context, &plan, Some(&state.points));
                    try_step(&context, &camera_step, (&plan, &shard), &state.points, &mut state.trial)
                }
            };
            sum = sum.plus(&tried);
        }
        self.tried = Some(next);
        Ok(Some(sum))
    }

    fn accept(&mut self) -> Result<(), BundleError> {
        if let Some(next) = self.tried.take() {
            self.cameras = next;
            for state in &mut self.states {
                std::mem::swap(&mut state.points, &mut state.trial);
            }
        }
        Ok(())
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
    if gauge == Gauge::Damped || fixed_points || fixed.len() > 1 || problem.priors.fixes_the_datum() {
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

pub(super) fn unconstrained(problem: &BundleProblem, layout: &Layout, held: Option<(u32, u32)>) -> Vec<u32> {
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
