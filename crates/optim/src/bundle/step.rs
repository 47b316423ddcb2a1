//! Trying a step: points by back-substitution, and the cost where it leads.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::layout::{Cameras, NONE};
use super::linearisation::{Context, Linearisation};
use super::plan::ShardPlan;
use super::projection::{project, residual_px};

/// A point's step is halved so often, at most, to keep the point in front of its cameras.
const MAX_HALVINGS: u32 = 3;

/// What a step does to a shard.
#[derive(Clone, Copy, Default)]
pub(super) struct Tried {
    /// Cost after the step; infinite where a point can't be kept in front of its cameras.
    pub cost: f64,
    /// By how much the damped model says that the points' part of the step lowers the cost.
    pub model_reduction: f64,
    /// Squared norm of the points' step.
    pub step_squared: f64,
    /// Squared norm of the points.
    pub norm_squared: f64,
}

impl Tried {
    /// The won part of what the model promised; not above zero when the step is no descent.
    pub fn gain(&self, cost: f64) -> f64 {
        let gain = (cost - self.cost) / self.model_reduction;
        if gain.is_finite() && self.model_reduction > 0.0 { gain } else { -1.0 }
    }

    /// Whether the step is no longer than this part of the parameters' norm.
    pub fn is_short(&self, tolerance: f64) -> bool {
        self.step_squared.sqrt() <= tolerance * (self.norm_squared.sqrt() + tolerance)
    }

    /// The sum of two parts.
    pub fn plus(self, part: &Self) -> Self {
        Self {
            cost: self.cost + part.cost,
            model_reduction: self.model_reduction + part.model_reduction,
            step_squared: self.step_squared + part.step_squared,
            norm_squared: self.norm_squared + part.norm_squared,
        }
    }
}

/// The step of the cameras, and where it leads.
pub(super) struct CameraStep<'a> {
    pub step: &'a [f64],
    pub cameras: &'a Cameras,
    /// First unknown of each intrinsics variable.
    pub intrinsics_offsets: &'a [usize],
}

/// Writes a shard's points after a step to `trial` and evaluates them.
pub(super) fn try_step(
    context: &Context<'_>,
    camera_step: &CameraStep<'_>,
    (plan, shard): (&ShardPlan, &Linearisation),
    points: &[Vector3<f64>],
    trial: &mut [Vector3<f64>],
) -> Tried {
    let mut rest = trial;
    let mut chunks: Vec<_> = plan
        .chunks
        .iter()
        .map(|range| {
            let (first, second) = std::mem::take(&mut rest).split_at_mut(range.len());
            rest = second;
            (range.clone(), first)
        })
        .collect();
    let parts: Vec<Tried> = chunks
        .par_iter_mut()
        .map(|(range, trial)| {
            let mut sum = Tried::default();
            for (point, trial) in range.clone().zip(trial.iter_mut()) {
                let x = &points[point];
                *trial = *x;
                if plan.of_point(point).is_empty() {
                    continue;
                }
                let delta = if plan.fixed_points {
                    Vector3::zeros()
                } else {
                    point_step(context, camera_step, plan, shard, point, &mut sum)
                };
                sum.norm_squared += x.norm_squared();
                sum.cost += settle(context, camera_step.cameras, plan, point, (x, &delta, trial));
            }
            sum
        })
        .collect();
    parts.iter().fold(Tried::default(), Tried::plus)
}

/// Back-substitution: `δp = −L⁻ᵀ (L⁻¹ g + Σ Zᵀ δc)`.
#[inline(always)]
fn point_step(
    context: &Context<'_>,
    camera_step: &CameraStep<'_>,
    plan: &ShardPlan,
    shard: &Linearisation,
    point: usize,
    sum: &mut Tried,
) -> Vector3<f64> {
    let terms = &shard.points[point];
    let mut reduced = terms.reduced;
    let layout = context.layout;
    for i in plan.of_point(point) {
        let variable = layout.pose_variable[plan.observations[i].pose as usize];
        if variable == NONE {
            continue;
        }
        let delta = &camera_step.step[6 * variable as usize..6 * variable as usize + 6];
        let z = &shard.pose_z[i];
        for c in 0..3 {
            for a in 0..6 {
                reduced[c] += z[6 * c + a] * delta[a];
            }
        }
    }
    let stride = layout.stride;
    for entry in plan.entries_of_point(point) {
        let variable = layout.intrinsics_variable[plan.entry_intrinsics[entry] as usize] as usize;
        let offset = camera_step.intrinsics_offsets[variable];
        let delta = &camera_step.step[offset..offset + layout.params[variable].len()];
        let z = &shard.entry_z[3 * stride * entry..3 * stride * (entry + 1)];
        for c in 0..3 {
            for (a, delta) in delta.iter().enumerate() {
                reduced[c] += z[stride * c + a] * delta;
            }
        }
    }
    let inverse = &terms.inverse;
    let delta = Vector3::new(
        -(inverse[0] * reduced[0] + inverse[1] * reduced[1] + inverse[3] * reduced[2]),
        -(inverse[2] * reduced[1] + inverse[4] * reduced[2]),
        -(inverse[5] * reduced[2]),
    );
    for c in 0..3 {
        // −g·δp = (L⁻¹ g)·(−Lᵀ δp).
        let damped = context.damping * terms.diagonal[c] * delta[c] * delta[c];
        sum.model_reduction += 0.5 * (damped + terms.reduced[c] * reduced[c]);
    }
    sum.step_squared += delta.norm_squared();
    delta
}

/// The cost of a point after its step, shortened where it would leave the view of a camera.
#[inline(always)]
fn settle(
    context: &Context<'_>,
    cameras: &Cameras,
    plan: &ShardPlan,
    point: usize,
    (x, delta, trial): (&Vector3<f64>, &Vector3<f64>, &mut Vector3<f64>),
) -> f64 {
    let mut length = 1.0;
    for _ in 0..=MAX_HALVINGS {
        *trial = x + delta * length;
        if let Some(cost) = point_cost(context, cameras, plan, point, trial) {
            return cost;
        }
        length *= 0.5;
    }
    *trial = *x;
    point_cost(context, cameras, plan, point, trial).unwrap_or(f64::INFINITY)
}

/// The cost of a point's observations, or `None` where it can't be seen.
#[inline(always)]
fn point_cost(
    context: &Context<'_>,
    cameras: &Cameras,
    plan: &ShardPlan,
    point: usize,
    x: &Vector3<f64>,
) -> Option<f64> {
    let mut cost = 0.0;
    for observation in &plan.observations[plan.of_point(point)] {
        let pose = observation.pose as usize;
        let camera = &cameras.intrinsics[context.problem.intrinsics_of_pose[pose] as usize];
        let xy = project(camera, &cameras.x_in_cam(pose, x), context.behind)?;
        let [dx, dy] = residual_px(camera, &xy, observation.xy_px);
        cost += 0.5 * context.loss.evaluate(dx * dx + dy * dy, context.loss_scale_px).0;
    }
    cost.is_finite().then_some(cost)
}
