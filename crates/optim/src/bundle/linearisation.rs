//! Residuals and Jacobians of a shard at one point of the search, and the elimination of its points.
//!
//! With `J_c`, `J_p` the Jacobians in camera and point, `V = Σ J_pᵀJ_p + λD = L Lᵀ` of each point and
//! `Z = J_cᵀ J_p L⁻ᵀ` of each observation, the reduced camera system gets `−Z Zᵀ` for each pair of observations of a point.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::layout::{Cameras, Layout};
use super::plan::{Planned, ShardPlan};
use super::projection::{project_with_jacobian, residual_px};
use super::terms::Term;
use super::{BehindCamera, BundleProblem};
use crate::Loss;

/// What all observations are linearised against.
pub(super) struct Context<'a> {
    pub problem: &'a BundleProblem,
    pub layout: &'a Layout,
    pub cameras: &'a Cameras,
    pub loss: Loss,
    pub loss_scale_px: f64,
    pub behind: BehindCamera,
    /// A pose and a direction in its frame along which it must not move.
    pub held_direction: Option<(u32, Vector3<f64>)>,
    pub damping: f64,
}

impl Context<'_> {
    /// Takes what a term says of the held direction out of its Jacobian.
    pub fn release_held_direction(&self, term: &mut Term) {
        let Some((held, direction)) = &self.held_direction else { return };
        let variable = self.layout.pose_variable[*held as usize];
        for block in term.blocks.iter_mut().filter(|block| block.block == variable) {
            let first = 3 - block.local;
            for row in 0..3 {
                let along: f64 =
                    (0..3).map(|c| block.columns.get(first + c).map_or(0.0, |v| v[row]) * direction[c]).sum();
                for (c, column) in block.columns.iter_mut().skip(first).enumerate() {
                    column[row] -= along * direction[c];
                }
            }
        }
    }
}

/// Weighted residual and Jacobians of one observation; rows are x and y.
#[derive(Clone, Copy, Default)]
pub(super) struct Terms {
    pub pose: [[f64; 6]; 2],
    pub point: [[f64; 3]; 2],
    pub residual: [f64; 2],
}

/// The eliminated point: `L⁻¹` (lower triangle by rows), `L⁻¹ g`, and the diagonal that is damped.
#[derive(Clone, Copy, Default)]
pub(super) struct PointTerms {
    pub inverse: [f64; 6],
    pub reduced: [f64; 3],
    pub diagonal: [f64; 3],
}

/// `Z` of one observation and its pose, column after column.
pub(super) type PoseZ = [f64; 18];

/// The linearised shard. Arrays over parameters of intrinsics have room for `stride` of them.
pub(super) struct Linearisation {
    pub terms: Vec<Terms>,
    pub pose_z: Vec<PoseZ>,
    /// Jacobian in the intrinsics, two rows of `stride`, for each observation.
    pub intrinsics: Vec<f64>,
    /// `Z` in the intrinsics, three columns of `stride`, for each observation.
    pub intrinsics_z: Vec<f64>,
    /// The same, summed over the observations of an entry.
    pub entry_z: Vec<f64>,
    pub points: Vec<PointTerms>,
}

/// What [`Linearisation::update`] found.
#[derive(Clone, Copy, Default)]
pub(super) struct Updated {
    /// The cost, where the shard was linearised.
    pub cost: f64,
    /// The largest `g² / D` of a point's coordinate.
    pub steepest: f64,
}

/// The parts of a linearisation that belong to one chunk of points.
struct Chunk<'a> {
    points: std::ops::Range<usize>,
    terms: &'a mut [Terms],
    pose_z: &'a mut [PoseZ],
    intrinsics: &'a mut [f64],
    intrinsics_z: &'a mut [f64],
    entry_z: &'a mut [f64],
    eliminated: &'a mut [PointTerms],
}

impl Linearisation {
    /// Room for a plan.
    pub fn new(plan: &ShardPlan, stride: usize) -> Self {
        let n = plan.observations.len();
        Self {
            terms: vec![Terms::default(); n],
            pose_z: vec![[0.0; 18]; n],
            intrinsics: vec![0.0; 2 * stride * n],
            intrinsics_z: vec![0.0; 3 * stride * n],
            entry_z: vec![0.0; 3 * stride * plan.entry_intrinsics.len()],
            points: vec![PointTerms::default(); plan.point_start.len() - 1],
        }
    }

    /// The bytes that [`Linearisation::new`] and the plan of so many observations and points take.
    pub fn predicted_bytes(observations: usize, points: usize, stride: usize) -> u64 {
        let observation = size_of::<Terms>() + size_of::<PoseZ>() + 8 * 8 * stride + size_of::<Planned>() + 4;
        (observations * observation + points * (size_of::<PointTerms>() + 16)) as u64
    }

    /// Linearises at the given points, or, without points, as before with another damping; eliminates the points.
    pub fn update(
        &mut self,
        context: &Context<'_>,
        plan: &ShardPlan,
        points: Option<&[Vector3<f64>]>,
    ) -> Updated {
        let mut chunks = self.chunks(plan, context.layout.stride);
        let parts: Vec<Updated> = chunks
            .par_iter_mut()
            .map(|chunk| {
                let mut updated = Updated::default();
                for point in chunk.points.clone() {
                    if plan.of_point(point).is_empty() {
                        continue;
                    }
                    if let Some(points) = points {
                        updated.cost += chunk.linearise_point(context, plan, point, &points[point]);
                    }
                    if !plan.fixed_points {
                        let steepest = chunk.eliminate_point(context, plan, point);
                        updated.steepest = updated.steepest.max(steepest);
                    }
                }
                updated
            })
            .collect();
        parts.iter().fold(Updated::default(), |sum, part| Updated {
            cost: sum.cost + part.cost,
            steepest: sum.steepest.max(part.steepest),
        })
    }

    fn chunks<'a>(&'a mut self, plan: &ShardPlan, stride: usize) -> Vec<Chunk<'a>> {
        let mut terms = self.terms.as_mut_slice();
        let mut pose_z = self.pose_z.as_mut_slice();
        let mut intrinsics = self.intrinsics.as_mut_slice();
        let mut intrinsics_z = self.intrinsics_z.as_mut_slice();
        let mut entry_z = self.entry_z.as_mut_slice();
        let mut eliminated = self.points.as_mut_slice();
        plan.chunks
            .iter()
            .map(|points| {
                let n = (plan.point_start[points.end] - plan.point_start[points.start]) as usize;
                let entries = (plan.entry_start[points.end] - plan.entry_start[points.start]) as usize;
                Chunk {
                    points: points.clone(),
                    terms: take(&mut terms, n),
                    pose_z: take(&mut pose_z, n),
                    intrinsics: take(&mut intrinsics, 2 * stride * n),
                    intrinsics_z: take(&mut intrinsics_z, 3 * stride * n),
                    entry_z: take(&mut entry_z, 3 * stride * entries),
                    eliminated: take(&mut eliminated, points.len()),
                }
            })
            .collect()
    }
}

fn take<'a, T>(rest: &mut &'a mut [T], n: usize) -> &'a mut [T] {
    let (first, second) = std::mem::take(rest).split_at_mut(n);
    *rest = second;
    first
}

impl Chunk<'_> {
    /// Residuals and Jacobians of a point's observations; their cost.
    fn linearise_point(
        &mut self,
        context: &Context<'_>,
        plan: &ShardPlan,
        point: usize,
        x: &Vector3<f64>,
    ) -> f64 {
        let first = plan.point_start[self.points.start] as usize;
        let stride = context.layout.stride;
        let mut cost = 0.0;
        for i in plan.of_point(point) {
            let at = i - first;
            let intrinsics = &mut self.intrinsics[2 * stride * at..2 * stride * (at + 1)];
            cost += linearise(context, &plan.observations[i], x, &mut self.terms[at], intrinsics);
        }
        cost
    }

    /// Eliminates a point; see [`Updated::steepest`].
    fn eliminate_point(&mut self, context: &Context<'_>, plan: &ShardPlan, point: usize) -> f64 {
        let first = plan.point_start[self.points.start] as usize;
        let stride = context.layout.stride;
        let observations = plan.of_point(point);
        let local = observations.start - first..observations.end - first;
        let (eliminated, steepest) = factorize_point(&self.terms[local.clone()], context.damping);
        self.eliminated[point - self.points.start] = eliminated;
        for at in local {
            let terms = &self.terms[at];
            let scaled = terms.point.map(|row| times_inverse_transposed(&row, &eliminated.inverse));
            let z = &mut self.pose_z[at];
            for c in 0..3 {
                for a in 0..6 {
                    z[6 * c + a] = terms.pose[0][a] * scaled[0][c] + terms.pose[1][a] * scaled[1][c];
                }
            }
            if stride > 0 {
                let (x, y) = self.intrinsics[2 * stride * at..2 * stride * (at + 1)].split_at(stride);
                let z = &mut self.intrinsics_z[3 * stride * at..3 * stride * (at + 1)];
                for c in 0..3 {
                    for a in 0..stride {
                        z[stride * c + a] = x[a] * scaled[0][c] + y[a] * scaled[1][c];
                    }
                }
            }
        }
        if stride > 0 {
            self.sum_entries(plan, point, stride);
        }
        steepest
    }

    fn sum_entries(&mut self, plan: &ShardPlan, point: usize, stride: usize) {
        let first = plan.point_start[self.points.start] as usize;
        let first_entry = plan.entry_start[self.points.start] as usize;
        let width = 3 * stride;
        for entry in plan.entries_of_point(point) {
            self.entry_z[width * (entry - first_entry)..width * (entry - first_entry + 1)].fill(0.0);
        }
        for i in plan.of_point(point) {
            let entry = plan.observations[i].entry;
            if entry != super::layout::NONE {
                let entry = entry as usize - first_entry;
                let z = &self.intrinsics_z[width * (i - first)..width * (i - first + 1)];
                for (sum, z) in self.entry_z[width * entry..width * (entry + 1)].iter_mut().zip(z) {
                    *sum += z;
                }
            }
        }
    }
}

/// Residual and Jacobians of one observation, weighted by the loss; its cost.
///
/// An observation that can't be projected weighs nothing; steps that would lead there are refused before.
pub(super) fn linearise(
    context: &Context<'_>,
    observation: &Planned,
    x: &Vector3<f64>,
    terms: &mut Terms,
    intrinsics: &mut [f64],
) -> f64 {
    let pose = observation.pose as usize;
    let camera_index = context.problem.intrinsics_of_pose[pose] as usize;
    let camera = &context.cameras.intrinsics[camera_index];
    let x_in_cam = context.cameras.x_in_cam(pose, x);
    let Some(projection) = project_with_jacobian(camera, &x_in_cam, context.behind) else {
        *terms = Terms::default();
        intrinsics.fill(0.0);
        return 0.0;
    };
    let residual = residual_px(camera, &projection.xy_px, observation.xy_px);
    let squared = residual[0] * residual[0] + residual[1] * residual[1];
    let (rho, weight) = context.loss.evaluate(squared, context.loss_scale_px);
    let root = weight.sqrt();
    let rotation = &context.cameras.rotations[pose];
    for row in 0..2 {
        let d = [0, 1, 2].map(|c| root * projection.d_point[(row, c)]);
        terms.residual[row] = root * residual[row];
        // d x_in_cam / d(ω, v) = [-[x]ₓ | I], so that the first half is x × d.
        terms.pose[row] = [
            x_in_cam.y * d[2] - x_in_cam.z * d[1],
            x_in_cam.z * d[0] - x_in_cam.x * d[2],
            x_in_cam.x * d[1] - x_in_cam.y * d[0],
            d[0],
            d[1],
            d[2],
        ];
        terms.point[row] =
            [0, 1, 2].map(|c| d[0] * rotation[0][c] + d[1] * rotation[1][c] + d[2] * rotation[2][c]);
    }
    if let Some((held, direction)) = &context.held_direction
        && *held == observation.pose
    {
        for row in &mut terms.pose {
            let along = row[3] * direction.x + row[4] * direction.y + row[5] * direction.z;
            for c in 0..3 {
                row[3 + c] -= along * direction[c];
            }
        }
    }
    let variable = context.layout.intrinsics_variable_of_pose[pose];
    if variable != super::layout::NONE {
        let (x_row, y_row) = intrinsics.split_at_mut(context.layout.stride);
        for (a, &param) in context.layout.params[variable as usize].iter().enumerate() {
            x_row[a] = root * projection.d_params[(0, param)];
            y_row[a] = root * projection.d_params[(1, param)];
        }
    }
    0.5 * rho
}

/// The normal equations of a point and their Cholesky factor; see [`factorize_normal`].
fn factorize_point(terms: &[Terms], damping: f64) -> (PointTerms, f64) {
    let mut v = [0.0; 6];
    let mut gradient = [0.0; 3];
    for t in terms {
        for row in 0..2 {
            let j = &t.point[row];
            v[0] += j[0] * j[0];
            v[1] += j[1] * j[0];
            v[2] += j[1] * j[1];
            v[3] += j[2] * j[0];
            v[4] += j[2] * j[1];
            v[5] += j[2] * j[2];
            for c in 0..3 {
                gradient[c] += j[c] * t.residual[row];
            }
        }
    }
    factorize_normal(&v, &gradient, damping)
}

/// Cholesky of `V + λD` (lower triangle by rows), and the largest squared gradient relative to its diagonal. A singular
/// point is held: all zeros.
#[inline(always)]
pub(super) fn factorize_normal(v: &[f64; 6], gradient: &[f64; 3], damping: f64) -> (PointTerms, f64) {
    let diagonal = [v[0], v[2], v[5]];
    let l00 = (v[0] * (1.0 + damping)).sqrt();
    let l10 = v[1] / l00;
    let l11 = (v[2] * (1.0 + damping) - l10 * l10).sqrt();
    let l20 = v[3] / l00;
    let l21 = (v[4] - l20 * l10) / l11;
    let l22 = (v[5] * (1.0 + damping) - l20 * l20 - l21 * l21).sqrt();
    let smallest = l00.min(l11).min(l22);
    if !(smallest > 0.0 && smallest.is_finite() && l22.is_finite()) || l11.is_nan() || l22.is_nan() {
        return (PointTerms::default(), 0.0);
    }
    let (i00, i11, i22) = (1.0 / l00, 1.0 / l11, 1.0 / l22);
    let i10 = -l10 * i00 * i11;
    let i21 = -l21 * i11 * i22;
    let i20 = -(l20 * i00 + l21 * i10) * i22;
    let inverse = [i00, i10, i11, i20, i21, i22];
    let g = gradient;
    let reduced = [i00 * g[0], i10 * g[0] + i11 * g[1], i20 * g[0] + i21 * g[1] + i22 * g[2]];
    let steepest = (0..3).map(|c| g[c] * g[c] / diagonal[c]).fold(0.0, f64::max);
    (PointTerms { inverse, reduced, diagonal }, steepest)
}

/// `row · L⁻ᵀ`.
#[inline(always)]
fn times_inverse_transposed(row: &[f64; 3], inverse: &[f64; 6]) -> [f64; 3] {
    [
        row[0] * inverse[0],
        row[0] * inverse[1] + row[1] * inverse[2],
        row[0] * inverse[3] + row[1] * inverse[4] + row[2] * inverse[5],
    ]
}
