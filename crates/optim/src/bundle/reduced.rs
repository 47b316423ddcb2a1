//! Putting the rows, the priors and the damping together, and solving for the cameras' step.

use smallvec::SmallVec;

use super::layout::{Layout, NONE};
use super::linearisation::Context;
use super::schur::PoseRow;
use super::terms::{Term, TermBlock, dot, terms};
use super::{BundleError, BundleOptions};
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
        for mut term in terms(context.problem, context.layout, context.cameras, options) {
            context.release_held_direction(&mut term);
            self.add_term(context, &term);
        }
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

    /// Adds what a prior or mark says: products of its Jacobians to the blocks, its gradient.
    fn add_term(&mut self, context: &Context<'_>, term: &Term) {
        let layout = context.layout;
        for a in &term.blocks {
            let first = layout.offsets[a.block as usize] + a.local;
            for (i, column) in a.columns.iter().enumerate() {
                let descent = term.weight * dot(column, &term.residual);
                self.descent[first + i] -= descent;
                self.reduced_descent[first + i] -= descent;
                self.diagonal[first + i] += term.weight * dot(column, column);
            }
            for b in term.blocks.iter().filter(|b| a.block <= b.block) {
                self.add_product(term.weight, a, b);
            }
        }
    }

    /// Adds `weight · JₐᵀJ_b` to the block of `a` and `b`, in this order.
    fn add_product(&mut self, weight: f64, a: &TermBlock, b: &TermBlock) {
        let pattern = self.system.pattern();
        let (rows, columns) = (pattern.dim(a.block as usize), pattern.dim(b.block as usize));
        let mut product = SmallVec::<[f64; 36]>::from_elem(0.0, rows * columns);
        for (j, right) in b.columns.iter().enumerate() {
            for (i, left) in a.columns.iter().enumerate() {
                product[rows * (b.local + j) + a.local + i] = weight * dot(left, right);
            }
        }
        self.system.add(a.block as usize, b.block as usize, &product, rows);
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
        let columns = n.iter().map(|along| [*along, 0.0, 0.0]).collect();
        let block = TermBlock { block: variable, local: 3, columns };
        let blocks = [block].into_iter().collect();
        let term = Term { rows: 1, residual: [0.0; 3], weight: stiffness, cost: 0.0, blocks };
        self.add_term(context, &term);
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
