//! Which poses and intrinsics see points in common.

use super::layout::{Layout, NONE};
use super::plan::ShardPlan;
use super::schur::PoseRow;
use crate::linear::BlockPattern;

/// Up to this many poses every pair is taken to see something in common.
const FULL_UP_TO: usize = 60;

/// Neighbours of every pose, by index of pose and of intrinsics; gathered shard by shard.
pub(super) struct Covisibility {
    /// For each pose the poses after it (and itself) that share a point, ascending.
    poses: Vec<Vec<u32>>,
    /// For each pose the refined intrinsics that share a point, ascending.
    intrinsics: Vec<Vec<u32>>,
    full: bool,
}

impl Covisibility {
    pub fn new(num_poses: usize) -> Self {
        let full = num_poses <= FULL_UP_TO;
        let n = if full { 0 } else { num_poses };
        Self { poses: vec![Vec::new(); n], intrinsics: vec![Vec::new(); n], full }
    }

    /// Adds what a shard's points are seen by.
    pub fn add(&mut self, plan: &ShardPlan) {
        if self.full {
            return;
        }
        let mut pose_mark = vec![u32::MAX; self.poses.len()];
        let mut intrinsics_mark = Vec::new();
        for pose in 0..self.poses.len() {
            let (poses, intrinsics) = (&mut self.poses[pose], &mut self.intrinsics[pose]);
            let (known, known_intrinsics) = (poses.len(), intrinsics.len());
            poses.iter().for_each(|p| pose_mark[*p as usize] = pose as u32);
            for i in intrinsics.iter() {
                mark(&mut intrinsics_mark, *i, pose as u32);
            }
            for &observation in plan.of_pose(pose) {
                let point = plan.observations[observation as usize].point as usize;
                for other in &plan.observations[observation as usize..plan.of_point(point).end] {
                    if pose_mark[other.pose as usize] != pose as u32 {
                        pose_mark[other.pose as usize] = pose as u32;
                        poses.push(other.pose);
                    }
                }
                for entry in plan.entries_of_point(point) {
                    if mark(&mut intrinsics_mark, plan.entry_intrinsics[entry], pose as u32) {
                        intrinsics.push(plan.entry_intrinsics[entry]);
                    }
                }
            }
            if poses.len() > known {
                poses.sort_unstable();
            }
            if intrinsics.len() > known_intrinsics {
                intrinsics.sort_unstable();
            }
        }
    }

    /// The rows of the reduced system, one for each pose, and its pattern; `ties` are pairs of blocks that priors and marks
    /// bring together.
    pub fn rows(&self, layout: &Layout, ties: &[(u32, u32)]) -> (Vec<PoseRow>, BlockPattern) {
        let num_poses = layout.pose_variable.len();
        let rows: Vec<PoseRow> = (0..num_poses)
            .map(|pose| {
                let (poses, intrinsics) = self.columns(layout, pose);
                PoseRow::new(layout, pose, poses, intrinsics)
            })
            .collect();
        let free = layout.poses.len();
        let dims = layout.dims();
        let mut above = vec![Vec::new(); dims.len()];
        ties.iter().for_each(|(row, column)| above[*column as usize].push(*row));
        for (pose, row) in rows.iter().enumerate() {
            let variable = layout.pose_variable[pose];
            if variable != NONE {
                row.pose_columns.iter().for_each(|column| above[*column as usize].push(variable));
                row.intrinsics_columns
                    .iter()
                    .for_each(|column| above[free + *column as usize].push(variable));
            }
            let own = layout.intrinsics_variable_of_pose[pose];
            if own != NONE {
                for column in &row.intrinsics_columns[row.intrinsics_before..] {
                    above[free + *column as usize].push(free as u32 + own);
                }
            }
        }
        let pattern = BlockPattern::new(&dims, above);
        (rows, pattern)
    }

    fn columns(&self, layout: &Layout, pose: usize) -> (Vec<u32>, Vec<u32>) {
        let own = layout.pose_variable[pose];
        if self.full {
            let poses = if own == NONE { Vec::new() } else { (own..layout.poses.len() as u32).collect() };
            return (poses, (0..layout.intrinsics.len() as u32).collect());
        }
        let variable = |of: &[u32], index: &u32| Some(of[*index as usize]).filter(|v| *v != NONE);
        let mut poses: Vec<u32> =
            self.poses[pose].iter().filter_map(|p| variable(&layout.pose_variable, p)).collect();
        if own != NONE && poses.first() != Some(&own) {
            poses.insert(0, own);
        }
        let intrinsics =
            self.intrinsics[pose].iter().filter_map(|i| variable(&layout.intrinsics_variable, i)).collect();
        (poses, intrinsics)
    }
}

/// Marks an index; whether it was new.
fn mark(marks: &mut Vec<u32>, index: u32, with: u32) -> bool {
    let index = index as usize;
    if marks.len() <= index {
        marks.resize(index + 1, u32::MAX);
    }
    std::mem::replace(&mut marks[index], with) != with
}
