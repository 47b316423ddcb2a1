//! The reduced camera system: what remains when points are eliminated.
//!
//! Each pose gathers its own block row from its observations, so that rows are filled in parallel without sharing and
//! every sum runs in the order of observations, whatever the number of threads.

use rayon::prelude::*;

use super::layout::{Layout, NONE};
use super::linearisation::{Linearisation, PoseZ, Terms};
use super::plan::ShardPlan;

/// A block of pose by pose, column-major.
pub(super) type PoseBlock = [f64; 36];

/// What one pose contributes: its block row, and its part of the rows of its intrinsics.
#[derive(Default)]
pub(super) struct PoseRow {
    /// Pose variables from the own one on, ascending; none when the pose is held.
    pub pose_columns: Vec<u32>,
    /// Intrinsics variables that see a point in common, ascending.
    pub intrinsics_columns: Vec<u32>,
    /// How many of these come before the own one.
    pub intrinsics_before: usize,
    pub pose_pose: Vec<PoseBlock>,
    /// 6 × stride, column-major, for each intrinsics column.
    pub pose_intrinsics: Vec<f64>,
    /// stride × stride, column-major, for each intrinsics column from the own one on.
    pub intrinsics_intrinsics: Vec<f64>,
    pub pose: Gradient<6>,
    pub intrinsics: Vec<Gradient<1>>,
}

/// The gradient of a block, the same after elimination, and the diagonal of its normal equations before.
#[derive(Clone, Copy)]
pub(super) struct Gradient<const N: usize> {
    pub full: [f64; N],
    pub reduced: [f64; N],
    pub diagonal: [f64; N],
}

impl<const N: usize> Default for Gradient<N> {
    fn default() -> Self {
        Self { full: [0.0; N], reduced: [0.0; N], diagonal: [0.0; N] }
    }
}

impl PoseRow {
    /// A row with room for its columns.
    pub fn new(layout: &Layout, pose: usize, pose_columns: Vec<u32>, intrinsics_columns: Vec<u32>) -> Self {
        let own = layout.intrinsics_variable_of_pose[pose];
        let stride = layout.stride;
        let free = layout.pose_variable[pose] != NONE;
        let intrinsics_before = intrinsics_columns.partition_point(|column| *column < own);
        let upper = if own == NONE { 0 } else { intrinsics_columns.len() - intrinsics_before };
        Self {
            pose_pose: vec![[0.0; 36]; if free { pose_columns.len() } else { 0 }],
            pose_intrinsics: vec![0.0; if free { 6 * stride * intrinsics_columns.len() } else { 0 }],
            intrinsics_intrinsics: vec![0.0; stride * stride * upper],
            pose: Gradient::default(),
            intrinsics: vec![Gradient::default(); if own == NONE { 0 } else { stride }],
            pose_columns: if free { pose_columns } else { Vec::new() },
            intrinsics_columns,
            intrinsics_before,
        }
    }

    fn clear(&mut self) {
        self.pose_pose.fill([0.0; 36]);
        self.pose_intrinsics.fill(0.0);
        self.intrinsics_intrinsics.fill(0.0);
        self.pose = Gradient::default();
        self.intrinsics.fill(Gradient::default());
    }
}

/// Sets all rows to zero.
pub(super) fn clear(rows: &mut [PoseRow]) {
    rows.par_iter_mut().for_each(PoseRow::clear);
}

/// Where the columns of the row at hand lie.
struct Slots {
    pose: Vec<u32>,
    intrinsics: Vec<u32>,
}

/// Adds an eliminated shard to the rows, one row for each pose.
pub(super) fn accumulate(rows: &mut [PoseRow], layout: &Layout, plan: &ShardPlan, shard: &Linearisation) {
    let slots = || Slots { pose: vec![0; layout.poses.len()], intrinsics: vec![0; layout.intrinsics.len()] };
    rows.par_iter_mut().enumerate().for_each_init(slots, |slots, (pose, row)| {
        if plan.of_pose(pose).is_empty() {
            return;
        }
        for (slot, column) in row.pose_columns.iter().enumerate() {
            slots.pose[*column as usize] = slot as u32;
        }
        for (slot, column) in row.intrinsics_columns.iter().enumerate() {
            slots.intrinsics[*column as usize] = slot as u32;
        }
        let work = RowWork { layout, plan, shard, slots, pose };
        // Fixed sizes let the compiler unroll; any other stride takes the general path with the same sums.
        match layout.stride {
            0 => work.accumulate::<0>(row),
            1 => work.accumulate::<1>(row),
            2 => work.accumulate::<2>(row),
            3 => work.accumulate::<3>(row),
            4 => work.accumulate::<4>(row),
            6 => work.accumulate::<6>(row),
            _ => work.accumulate::<{ usize::MAX }>(row),
        }
    });
}

struct RowWork<'a> {
    layout: &'a Layout,
    plan: &'a ShardPlan,
    shard: &'a Linearisation,
    slots: &'a Slots,
    pose: usize,
}

impl RowWork<'_> {
    fn accumulate<const K: usize>(&self, row: &mut PoseRow) {
        let stride = if K == usize::MAX { self.layout.stride } else { K };
        let free = !row.pose_columns.is_empty();
        let refined = self.layout.intrinsics_variable_of_pose[self.pose] != NONE;
        for &observation in self.plan.of_pose(self.pose) {
            let observation = observation as usize;
            if free {
                self.add_pose(row, observation);
                if stride > 0 {
                    self.add_pose_by_intrinsics(row, observation, stride);
                }
            }
            if stride > 0 && refined {
                self.add_intrinsics(row, observation, stride);
            }
        }
    }

    fn add_pose(&self, row: &mut PoseRow, observation: usize) {
        let terms = &self.shard.terms[observation];
        let own = &mut row.pose_pose[0];
        for c in 0..6 {
            let (x, y) = (terms.pose[0][c], terms.pose[1][c]);
            for a in 0..6 {
                own[6 * c + a] += terms.pose[0][a] * x + terms.pose[1][a] * y;
            }
            row.pose.diagonal[c] += x * x + y * y;
            let gradient = x * terms.residual[0] + y * terms.residual[1];
            row.pose.full[c] += gradient;
            row.pose.reduced[c] += gradient;
        }
        if self.plan.fixed_points {
            return;
        }
        let z = &self.shard.pose_z[observation];
        let planned = &self.plan.observations[observation];
        let point = planned.point as usize;
        let reduced = &self.shard.points[point].reduced;
        for a in 0..6 {
            row.pose.reduced[a] -= z[a] * reduced[0] + z[6 + a] * reduced[1] + z[12 + a] * reduced[2];
        }
        for other in observation..self.plan.of_point(point).end {
            let other_pose = self.plan.observations[other].pose;
            let variable = self.layout.pose_variable[other_pose as usize];
            if variable == NONE {
                continue;
            }
            let block = &mut row.pose_pose[self.slots.pose[variable as usize] as usize];
            subtract_outer(block, z, &self.shard.pose_z[other]);
            if other != observation && other_pose == planned.pose {
                // A pose that sees a point twice: the pair counts in both orders.
                subtract_outer(block, &self.shard.pose_z[other], z);
            }
        }
    }

    #[inline(always)]
    fn add_pose_by_intrinsics(&self, row: &mut PoseRow, observation: usize, stride: usize) {
        let planned = &self.plan.observations[observation];
        let variable = self.layout.intrinsics_variable_of_pose[self.pose];
        if variable != NONE {
            let slot = self.slots.intrinsics[variable as usize] as usize;
            let block = &mut row.pose_intrinsics[6 * stride * slot..6 * stride * (slot + 1)];
            let terms = &self.shard.terms[observation];
            let (x, y) = self.shard.intrinsics[2 * stride * observation..2 * stride * (observation + 1)]
                .split_at(stride);
            for c in 0..stride {
                for a in 0..6 {
                    block[6 * c + a] += terms.pose[0][a] * x[c] + terms.pose[1][a] * y[c];
                }
            }
        }
        if self.plan.fixed_points {
            return;
        }
        let z = &self.shard.pose_z[observation];
        for entry in self.plan.entries_of_point(planned.point as usize) {
            let variable = self.layout.intrinsics_variable[self.plan.entry_intrinsics[entry] as usize];
            let slot = self.slots.intrinsics[variable as usize] as usize;
            let block = &mut row.pose_intrinsics[6 * stride * slot..6 * stride * (slot + 1)];
            let other = &self.shard.entry_z[3 * stride * entry..3 * stride * (entry + 1)];
            for c in 0..stride {
                let (z0, z1, z2) = (other[c], other[stride + c], other[2 * stride + c]);
                for a in 0..6 {
                    block[6 * c + a] -= z[a] * z0 + z[6 + a] * z1 + z[12 + a] * z2;
                }
            }
        }
    }

    #[inline(always)]
    fn add_intrinsics(&self, row: &mut PoseRow, observation: usize, stride: usize) {
        let Terms { residual, .. } = &self.shard.terms[observation];
        let (x, y) =
            self.shard.intrinsics[2 * stride * observation..2 * stride * (observation + 1)].split_at(stride);
        let block = stride * stride;
        let own = &mut row.intrinsics_intrinsics[..block];
        for c in 0..stride {
            for a in 0..stride {
                own[stride * c + a] += x[a] * x[c] + y[a] * y[c];
            }
            let gradient = &mut row.intrinsics[c];
            let value = x[c] * residual[0] + y[c] * residual[1];
            gradient.diagonal[0] += x[c] * x[c] + y[c] * y[c];
            gradient.full[0] += value;
            gradient.reduced[0] += value;
        }
        if self.plan.fixed_points {
            return;
        }
        let planned = &self.plan.observations[observation];
        let z = &self.shard.intrinsics_z[3 * stride * observation..3 * stride * (observation + 1)];
        let reduced = &self.shard.points[planned.point as usize].reduced;
        for a in 0..stride {
            row.intrinsics[a].reduced[0] -=
                z[a] * reduced[0] + z[stride + a] * reduced[1] + z[2 * stride + a] * reduced[2];
        }
        // Entries of a point ascend, and so the own one is followed by those of the upper triangle.
        for entry in planned.entry as usize..self.plan.entries_of_point(planned.point as usize).end {
            let variable = self.layout.intrinsics_variable[self.plan.entry_intrinsics[entry] as usize];
            let slot = self.slots.intrinsics[variable as usize] as usize - row.intrinsics_before;
            let target = &mut row.intrinsics_intrinsics[block * slot..block * (slot + 1)];
            let other = &self.shard.entry_z[3 * stride * entry..3 * stride * (entry + 1)];
            for c in 0..stride {
                let (z0, z1, z2) = (other[c], other[stride + c], other[2 * stride + c]);
                for a in 0..stride {
                    target[stride * c + a] -= z[a] * z0 + z[stride + a] * z1 + z[2 * stride + a] * z2;
                }
            }
        }
    }
}

/// `block -= z otherᵀ`.
#[inline(always)]
fn subtract_outer(block: &mut PoseBlock, z: &PoseZ, other: &PoseZ) {
    for c in 0..6 {
        let (z0, z1, z2) = (other[c], other[6 + c], other[12 + c]);
        for a in 0..6 {
            block[6 * c + a] -= z[a] * z0 + z[6 + a] * z1 + z[12 + a] * z2;
        }
    }
}
