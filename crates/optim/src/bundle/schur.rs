//! The reduced camera system: what remains when points are eliminated.
//!
//! Each pose gathers its own block row from its observations, so that rows are filled in parallel without sharing and
//! every sum runs in the order of observations, whatever the number of threads.

use rayon::prelude::*;

use terrane_geometry::camera::MAX_PARAMS;

use super::layout::{Layout, NONE};
use super::linearisation::{Linearisation, PoseZ};
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
        RowWork { layout, plan, shard, slots, pose }.run(row, wide_is_available());
    });
}

/// Whether rows may run on 256-bit vectors; the sums are the same either way, bit for bit.
fn wide_is_available() -> bool {
    #[cfg(target_arch = "x86_64")]
    {
        std::arch::is_x86_feature_detected!("avx2")
    }
    #[cfg(not(target_arch = "x86_64"))]
    {
        false
    }
}

struct RowWork<'a> {
    layout: &'a Layout,
    plan: &'a ShardPlan,
    shard: &'a Linearisation,
    slots: &'a Slots,
    pose: usize,
}

impl RowWork<'_> {
    /// Fixed sizes let the compiler unroll; more parameters than these are padded to the next.
    fn run(&self, row: &mut PoseRow, wide: bool) {
        match self.layout.stride {
            // Without refined intrinsics their arrays are empty.
            0 | 1 => self.dispatch::<1>(row, wide),
            2 => self.dispatch::<2>(row, wide),
            3 => self.dispatch::<3>(row, wide),
            4 => self.dispatch::<4>(row, wide),
            6 => self.dispatch::<6>(row, wide),
            8 => self.dispatch::<8>(row, wide),
            12 => self.dispatch::<12>(row, wide),
            _ => self.dispatch::<{ MAX_PARAMS }>(row, wide),
        }
    }

    fn dispatch<const K: usize>(&self, row: &mut PoseRow, wide: bool) {
        #[cfg(target_arch = "x86_64")]
        if wide {
            // SAFETY: `wide` comes from `wide_is_available`, so this processor has AVX2.
            unsafe { self.accumulate_wide::<K>(row) };
            return;
        }
        let _ = wide;
        self.accumulate::<K>(row);
    }

    /// [`RowWork::accumulate`] compiled for 256-bit vectors: the same operations in the same order, without fusing, so
    /// that the bytes equal those of the plain twin.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn accumulate_wide<const K: usize>(&self, row: &mut PoseRow) {
        self.accumulate::<K>(row);
    }

    #[inline(always)]
    fn accumulate<const K: usize>(&self, row: &mut PoseRow) {
        let free = !row.pose_columns.is_empty();
        let own = self.layout.intrinsics_variable_of_pose[self.pose];
        let own = (own != NONE).then(|| self.slots.intrinsics[own as usize] as usize);
        let (intrinsics, _) = self.shard.intrinsics.as_chunks::<K>();
        for &observation in self.plan.of_pose(self.pose) {
            let observation = observation as usize;
            let jacobian =
                own.map(|slot| (slot, &intrinsics[2 * observation], &intrinsics[2 * observation + 1]));
            if free {
                self.add_pose(row, observation);
                self.add_pose_by_intrinsics::<K>(row, observation, jacobian);
            }
            if let Some((slot, x, y)) = jacobian {
                self.add_intrinsics::<K>(row, observation, slot, [x, y]);
            }
        }
    }

    #[inline(always)]
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
        let end = self.plan.of_point(point).end;
        let others =
            self.plan.observations[observation..end].iter().zip(&self.shard.pose_z[observation..end]);
        for (i, (other, other_z)) in others.enumerate() {
            let variable = self.layout.pose_variable[other.pose as usize];
            if variable == NONE {
                continue;
            }
            let block = &mut row.pose_pose[self.slots.pose[variable as usize] as usize];
            subtract_outer(block, z, other_z);
            if i > 0 && other.pose == planned.pose {
                // A pose that sees a point twice: the pair counts in both orders.
                subtract_outer(block, other_z, z);
            }
        }
    }

    #[inline(always)]
    fn add_pose_by_intrinsics<const K: usize>(
        &self,
        row: &mut PoseRow,
        observation: usize,
        jacobian: Option<(usize, &[f64; K], &[f64; K])>,
    ) {
        let (blocks, _) = row.pose_intrinsics.as_chunks_mut::<6>();
        if let Some((slot, x, y)) = jacobian {
            let terms = &self.shard.terms[observation];
            for (c, column) in blocks[K * slot..K * (slot + 1)].iter_mut().enumerate() {
                for a in 0..6 {
                    column[a] += terms.pose[0][a] * x[c] + terms.pose[1][a] * y[c];
                }
            }
        }
        if self.plan.fixed_points {
            return;
        }
        let z = &self.shard.pose_z[observation];
        let (entry_z, _) = self.shard.entry_z.as_chunks::<K>();
        for entry in self.plan.entries_of_point(self.plan.observations[observation].point as usize) {
            let variable = self.layout.intrinsics_variable[self.plan.entry_intrinsics[entry] as usize];
            let slot = self.slots.intrinsics[variable as usize] as usize;
            let [z0, z1, z2] = [&entry_z[3 * entry], &entry_z[3 * entry + 1], &entry_z[3 * entry + 2]];
            for (c, column) in blocks[K * slot..K * (slot + 1)].iter_mut().enumerate() {
                for a in 0..6 {
                    column[a] -= z[a] * z0[c] + z[6 + a] * z1[c] + z[12 + a] * z2[c];
                }
            }
        }
    }

    #[inline(always)]
    fn add_intrinsics<const K: usize>(
        &self,
        row: &mut PoseRow,
        observation: usize,
        own_slot: usize,
        [x, y]: [&[f64; K]; 2],
    ) {
        let residual = &self.shard.terms[observation].residual;
        let (blocks, _) = row.intrinsics_intrinsics.as_chunks_mut::<K>();
        for (c, column) in blocks[..K].iter_mut().enumerate() {
            for a in 0..K {
                column[a] += x[a] * x[c] + y[a] * y[c];
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
        let (z, _) = self.shard.intrinsics_z.as_chunks::<K>();
        let z = [&z[3 * observation], &z[3 * observation + 1], &z[3 * observation + 2]];
        let reduced = &self.shard.points[planned.point as usize].reduced;
        for a in 0..K {
            row.intrinsics[a].reduced[0] -=
                z[0][a] * reduced[0] + z[1][a] * reduced[1] + z[2][a] * reduced[2];
        }
        let (entry_z, _) = self.shard.entry_z.as_chunks::<K>();
        // Entries of a point ascend, and so the own one is followed by those of the upper triangle.
        for entry in planned.entry as usize..self.plan.entries_of_point(planned.point as usize).end {
            let variable = self.layout.intrinsics_variable[self.plan.entry_intrinsics[entry] as usize];
            let slot = self.slots.intrinsics[variable as usize] as usize - own_slot;
            let [z0, z1, z2] = [&entry_z[3 * entry], &entry_z[3 * entry + 1], &entry_z[3 * entry + 2]];
            for (c, column) in blocks[K * slot..K * (slot + 1)].iter_mut().enumerate() {
                for a in 0..K {
                    column[a] -= z[0][a] * z0[c] + z[1][a] * z1[c] + z[2][a] * z2[c];
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Numbers without pattern.
    fn fill(values: &mut [f64], seed: f64) {
        for (i, value) in values.iter_mut().enumerate() {
            *value = ((i as f64 + seed) * 12.9898).sin() * 43.758;
        }
    }

    #[test]
    fn wide_rows_equal_plain_ones_to_the_last_bit() {
        use super::super::tests::linearised_scene;
        if !wide_is_available() {
            println!("this processor has no wide vectors: nothing to compare");
            return;
        }
        for num_params in [0, 1, 2, 4, 8] {
            let scene = linearised_scene(num_params);
            let slots = Slots {
                pose: (0..scene.layout.poses.len() as u32).collect(),
                intrinsics: (0..scene.layout.intrinsics.len() as u32).collect(),
            };
            let make = || {
                let columns = (0..scene.layout.poses.len() as u32).collect();
                let mut row = PoseRow::new(
                    &scene.layout,
                    0,
                    columns,
                    (0..scene.layout.intrinsics.len() as u32).collect(),
                );
                row.pose_pose.iter_mut().for_each(|block| fill(block, 1.0));
                row
            };
            let (mut plain, mut wide) = (make(), make());
            let (layout, plan, shard) = (&scene.layout, &scene.plan, &scene.shard);
            let work = RowWork { layout, plan, shard, slots: &slots, pose: 0 };
            work.run(&mut plain, false);
            work.run(&mut wide, true);
            assert_eq!(plain.pose_pose, wide.pose_pose);
            assert_eq!(plain.pose_intrinsics, wide.pose_intrinsics);
            assert_eq!(plain.intrinsics_intrinsics, wide.intrinsics_intrinsics);
            assert_eq!(plain.pose.reduced, wide.pose.reduced);
        }
    }
}
