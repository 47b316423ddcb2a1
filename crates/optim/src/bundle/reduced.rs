//! Putting the rows, the priors and the damping together, and solving for the cameras' step.

use nalgebra::Vector3;

use super::layout::{Cameras, Layout, NONE};
use super::linearisation::Context;
use super::schur::PoseRow;
use super::{BundleError, BundleOptions, BundleProblem};
use crate::linear::{BlockPattern, BlockSystem};

/// The reduced camera system at one point of the search.
pub(super) struct Reduced {
    system: BlockSystem,
    /// The gradient before elimination, negated: the right-hand side without points.
    pub descent: Vec<f64>,
    /// The right-hand side after elimination.
    reduced_descent: Vec<f64>,
    /// The diagonal that is damped.
    pub diagonal: Vec<f64>,
}

impl Reduced {
    pub fn new(pattern: BlockPattern, options: &BundleOptions) -> Result<Self, BundleError> {
        let n = pattern.num_unknowns();
        let system = BlockSystem::new(pattern, options.linear_solver)?;
        Ok(Self { system, descent: vec![0.0; n], reduced_descent: vec![0.0; n], diagonal: vec![0.0; n] })
    }

    /// Folds the rows in the order of poses, then adds priors and damping.
    pub fn assemble(&mut self, context: &Context<'_>, rows: &[PoseRow], options: &BundleOptions) {
        self.system.clear();
        self.descent.fill(0.0);
        self.reduced_descent.fill(0.0);
        self.diagonal.fill(0.0);
        for (pose, row) in rows.iter().enumerate() {
            self.add_row(context.layout, pose, row);
        }
        self.add_position_priors(context, options);
        self.add_focal_priors(context);
        self.hold_direction(context);
        let dims: Vec<usize> = context.layout.dims();
        let mut at = 0;
        for (block, dim) in dims.into_iter().enumerate() {
            for component in 0..dim {
                // A parameter without any effect stays where it is.
                self.diagonal[at] = self.diagonal[at].max(f64::MIN_POSITIVE.sqrt());
                let damped = (context.damping * self.diagonal[at]).max(f64::MIN_POSITIVE.sqrt());
                self.system.add_to_diagonal(block, component, damped);
                at += 1;
            }
        }
    }

    fn add_row(&mut self, layout: &Layout, pose: usize, row: &PoseRow) {
        let free = layout.poses.len();
        let stride = layout.stride;
        let variable = layout.pose_variable[pose] as usize;
        for (column, block) in row.pose_columns.iter().zip(&row.pose_pose) {
            self.system.add(variable, *column as usize, block, 6);
        }
        if !row.pose_columns.is_empty() && stride > 0 {
            for (column, block) in
                row.intrinsics_columns.iter().zip(row.pose_intrinsics.chunks_exact(6 * stride))
            {
                self.system.add(variable, free + *column as usize, block, 6);
            }
        }
        if !row.pose_columns.is_empty() {
            for a in 0..6 {
                self.descent[6 * variable + a] -= row.pose.full[a];
                self.reduced_descent[6 * variable + a] -= row.pose.reduced[a];
                self.diagonal[6 * variable + a] += row.pose.diagonal[a];
            }
        }
        let own = layout.intrinsics_variable_of_pose[pose];
        if own == NONE {
            return;
        }
        let block = free + own as usize;
        let columns = &row.intrinsics_columns[row.intrinsics_before..];
        for (column, values) in columns.iter().zip(row.intrinsics_intrinsics.chunks_exact(stride * stride)) {
            self.system.add(block, free + *column as usize, values, stride);
        }
        let offset = self.system.pattern().offset(block);
        for a in 0..self.system.pattern().dim(block) {
            self.descent[offset + a] -= row.intrinsics[a].full[0];
            self.reduced_descent[offset + a] -= row.intrinsics[a].reduced[0];
            self.diagonal[offset + a] += row.intrinsics[a].diagonal[0];
        }
    }

    /// Adds `weight · j jᵀ` and the gradient of a residual to a block, for a row `j` of its Jacobian.
    fn add_prior(&mut self, block: usize, jacobian: &[f64], residual: f64, weight: f64) {
        let offset = self.system.pattern().offset(block);
        let n = jacobian.len();
        let mut outer = [0.0; 36];
        for c in 0..n {
            for a in 0..n {
                outer[n * c + a] = weight * jacobian[a] * jacobian[c];
            }
            let descent = weight * jacobian[c] * residual;
            self.descent[offset + c] -= descent;
            self.reduced_descent[offset + c] -= descent;
            self.diagonal[offset + c] += outer[n * c + c];
        }
        self.system.add(block, block, &outer[..n * n], n);
    }

    fn add_position_priors(&mut self, context: &Context<'_>, options: &BundleOptions) {
        for prior in &context.problem.position_priors {
            let variable = context.layout.pose_variable[prior.pose as usize];
            if variable == NONE {
                continue;
            }
            let center = context.cameras.poses[prior.pose as usize].center();
            let residual = (center - prior.center_in_world).component_div(&prior.sigma_m);
            let (_, weight) =
                options.prior_loss.evaluate(residual.norm_squared(), options.prior_loss_scale_sigma);
            for axis in 0..3 {
                // With (ω, v) on the left of cam_from_world the centre moves by −Rᵀ v.
                let rotation = &context.cameras.rotations[prior.pose as usize];
                let mut along = Vector3::from_fn(|c, _| -rotation[c][axis] / prior.sigma_m[axis]);
                if let Some((held, direction)) = &context.held_direction
                    && *held == prior.pose
                {
                    along -= direction * along.dot(direction);
                }
                let jacobian = [0.0, 0.0, 0.0, along.x, along.y, along.z];
                self.add_prior(variable as usize, &jacobian, residual[axis], weight);
            }
        }
    }

    fn add_focal_priors(&mut self, context: &Context<'_>) {
        for prior in &context.problem.focal_priors {
            let variable = context.layout.intrinsics_variable[prior.intrinsics as usize];
            if variable == NONE {
                continue;
            }
            let camera = &context.cameras.intrinsics[prior.intrinsics as usize];
            let block = context.layout.poses.len() + variable as usize;
            let refined = &context.layout.params[variable as usize];
            for (a, &param) in refined.iter().enumerate().filter(|(_, p)| **p < camera.model.num_focal()) {
                let residual = (camera.params()[param] - prior.focal_px) / prior.sigma_px;
                let weight = 1.0 / (prior.sigma_px * prior.sigma_px);
                let offset = self.system.pattern().offset(block) + a;
                self.system.add_to_diagonal(block, a, weight);
                self.diagonal[offset] += weight;
                self.descent[offset] -= residual / prior.sigma_px;
                self.reduced_descent[offset] -= residual / prior.sigma_px;
            }
        }
    }

    /// Gives the held direction a stiffness of its own, so that the step along it is zero.
    fn hold_direction(&mut self, context: &Context<'_>) {
        let Some((pose, n)) = &context.held_direction else { return };
        let variable = context.layout.pose_variable[*pose as usize];
        if variable == NONE {
            return;
        }
        let offset = 6 * variable as usize;
        let stiffness = self.diagonal[offset + 3..offset + 6].iter().sum::<f64>().max(1.0);
        let jacobian = [0.0, 0.0, 0.0, n.x, n.y, n.z];
        self.add_prior(variable as usize, &jacobian, 0.0, stiffness);
    }

    /// The step of the cameras, or `None` when the system is not positive definite.
    pub fn solve(&mut self) -> Option<Vec<f64>> {
        if !self.system.factorize() {
            return None;
        }
        let mut step = self.reduced_descent.clone();
        self.system.solve_in_place(&mut step);
        step.iter().all(|v| v.is_finite()).then_some(step)
    }

    /// The largest `g² / D` of an unknown.
    pub fn steepest(&self) -> f64 {
        self.descent.iter().zip(&self.diagonal).map(|(g, d)| g * g / d).fold(0.0, f64::max)
    }

    /// By how much the damped model says that a step lowers the cost: `½ h·(λ D h + descent)`.
    pub fn model_reduction(&self, step: &[f64], damping: f64) -> f64 {
        let terms = step.iter().zip(&self.descent).zip(&self.diagonal);
        terms.map(|((h, descent), d)| 0.5 * h * (damping * d * h + descent)).sum()
    }
}

/// The cost of all priors.
pub(super) fn prior_cost(
    problem: &BundleProblem,
    layout: &Layout,
    cameras: &Cameras,
    options: &BundleOptions,
) -> f64 {
    let positions = problem.position_priors.iter().map(|prior| {
        let center = cameras.poses[prior.pose as usize].center();
        let residual = (center - prior.center_in_world).component_div(&prior.sigma_m);
        0.5 * options.prior_loss.evaluate(residual.norm_squared(), options.prior_loss_scale_sigma).0
    });
    let focals = problem.focal_priors.iter().map(|prior| {
        let variable = layout.intrinsics_variable[prior.intrinsics as usize];
        if variable == NONE {
            return 0.0;
        }
        let camera = &cameras.intrinsics[prior.intrinsics as usize];
        let refined = layout.params[variable as usize].iter().filter(|p| **p < camera.model.num_focal());
        refined.map(|p| 0.5 * ((camera.params()[*p] - prior.focal_px) / prior.sigma_px).powi(2)).sum()
    });
    positions.sum::<f64>() + focals.sum::<f64>()
}
