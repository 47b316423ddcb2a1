//! The fixed structure of a shard during a solve: who sees what.

use std::ops::Range;

use super::layout::{Cameras, NONE};
use super::projection::project;
use super::{BehindCamera, BundleProblem, BundleShard};

/// About as many observations go into one unit of parallel work; fixed, so that results do not depend on threads.
const OBSERVATIONS_PER_CHUNK: usize = 512;

/// One observation that takes part.
#[derive(Clone, Copy)]
pub(super) struct Planned {
    pub pose: u32,
    pub point: u32,
    /// The entry of its intrinsics in its point, or [`NONE`].
    pub entry: u32,
    pub xy_px: [f32; 2],
}

/// The observations of a shard that take part, by point and then by pose, with the way back from poses.
pub(super) struct ShardPlan {
    pub observations: Vec<Planned>,
    /// First observation of each point, then their number.
    pub point_start: Vec<u32>,
    /// First item of each pose in `of_pose`, then their number.
    pub pose_start: Vec<u32>,
    /// Observations by pose, ascending.
    pub of_pose: Vec<u32>,
    /// First entry of each point, then their number. An entry is one of the refined intrinsics that see the point.
    pub entry_start: Vec<u32>,
    /// Intrinsics of each entry, ascending within a point.
    pub entry_intrinsics: Vec<u32>,
    /// Ranges of points that are worked on together.
    pub chunks: Vec<Range<usize>>,
    pub fixed_points: bool,
}

/// Which observations of a shard are left out, found once at the start of a solve.
#[derive(Default)]
pub(super) struct Dropped {
    /// Indices of observations, ascending.
    pub observations: Vec<u32>,
    pub behind_camera: u64,
    pub seen_once: u64,
}

impl Dropped {
    /// Leaves out what is behind its camera, and then points seen fewer than twice (unless points are fixed).
    pub fn find(
        shard: &BundleShard,
        problem: &BundleProblem,
        cameras: &Cameras,
        behind: BehindCamera,
    ) -> Self {
        let mut dropped = Self::default();
        let needed = if shard.fixed_points { 1 } else { 2 };
        let mut start = 0;
        let mut seen = Vec::new();
        while start < shard.observations.len() {
            let point = shard.observations[start].point;
            let end = start + shard.observations[start..].partition_point(|o| o.point == point);
            seen.clear();
            for i in start..end {
                let pose = shard.observations[i].pose as usize;
                let camera = &cameras.intrinsics[problem.intrinsics_of_pose[pose] as usize];
                let x_in_cam = cameras.x_in_cam(pose, &shard.points[point as usize]);
                match project(camera, &x_in_cam, behind) {
                    Some(xy) if xy.iter().all(|v| v.is_finite()) => seen.push(i as u32),
                    _ => {
                        dropped.behind_camera += 1;
                        dropped.observations.push(i as u32);
                    }
                }
            }
            if seen.len() < needed {
                dropped.seen_once += seen.len() as u64;
                dropped.observations.extend_from_slice(&seen);
            }
            start = end;
        }
        dropped.observations.sort_unstable();
        dropped
    }
}

impl ShardPlan {
    pub fn new(shard: &BundleShard, dropped: &Dropped, problem: &BundleProblem) -> Self {
        let refined: Vec<bool> =
            problem.intrinsics.iter().zip(&problem.refine).map(|(c, r)| !r.params(c).is_empty()).collect();
        let num_points = shard.points.len();
        let mut plan = Self {
            observations: Vec::with_capacity(shard.observations.len()),
            point_start: Vec::with_capacity(num_points + 1),
            pose_start: Vec::new(),
            of_pose: Vec::new(),
            entry_start: Vec::with_capacity(num_points + 1),
            entry_intrinsics: Vec::new(),
            chunks: Vec::new(),
            fixed_points: shard.fixed_points,
        };
        let mut skip = dropped.observations.iter().copied().peekable();
        let mut next = 0;
        let mut chunk = (0, 0);
        for point in 0..num_points {
            let first = plan.observations.len();
            plan.point_start.push(first as u32);
            plan.entry_start.push(plan.entry_intrinsics.len() as u32);
            while next < shard.observations.len() && shard.observations[next].point as usize == point {
                if skip.peek() == Some(&(next as u32)) {
                    skip.next();
                } else {
                    let o = shard.observations[next];
                    plan.observations.push(Planned {
                        pose: o.pose,
                        point: o.point,
                        entry: NONE,
                        xy_px: o.xy_px,
                    });
                }
                next += 1;
            }
            plan.observations[first..].sort_by_key(|o| o.pose);
            plan.add_entries(first, problem, &refined);
            if plan.observations.len() - chunk.1 >= OBSERVATIONS_PER_CHUNK || point + 1 == num_points {
                plan.chunks.push(chunk.0..point + 1);
                chunk = (point + 1, plan.observations.len());
            }
        }
        plan.point_start.push(plan.observations.len() as u32);
        plan.entry_start.push(plan.entry_intrinsics.len() as u32);
        plan.index_poses(problem.poses.len());
        plan
    }

    /// The entries of the point whose observations begin at `first`.
    fn add_entries(&mut self, first: usize, problem: &BundleProblem, refined: &[bool]) {
        let start = self.entry_intrinsics.len();
        for o in &self.observations[first..] {
            let intrinsics = problem.intrinsics_of_pose[o.pose as usize];
            if refined[intrinsics as usize] && !self.entry_intrinsics[start..].contains(&intrinsics) {
                self.entry_intrinsics.push(intrinsics);
            }
        }
        self.entry_intrinsics[start..].sort_unstable();
        for o in &mut self.observations[first..] {
            let intrinsics = problem.intrinsics_of_pose[o.pose as usize];
            if let Ok(at) = self.entry_intrinsics[start..].binary_search(&intrinsics) {
                o.entry = (start + at) as u32;
            }
        }
    }

    fn index_poses(&mut self, num_poses: usize) {
        let mut start = vec![0u32; num_poses + 1];
        for o in &self.observations {
            start[o.pose as usize + 1] += 1;
        }
        for pose in 0..num_poses {
            start[pose + 1] += start[pose];
        }
        let mut next = start.clone();
        self.of_pose = vec![0; self.observations.len()];
        for (i, o) in self.observations.iter().enumerate() {
            let at = &mut next[o.pose as usize];
            self.of_pose[*at as usize] = i as u32;
            *at += 1;
        }
        self.pose_start = start;
    }

    /// The observations of a point.
    #[inline(always)]
    pub fn of_point(&self, point: usize) -> Range<usize> {
        self.point_start[point] as usize..self.point_start[point + 1] as usize
    }

    /// The entries of a point.
    #[inline(always)]
    pub fn entries_of_point(&self, point: usize) -> Range<usize> {
        self.entry_start[point] as usize..self.entry_start[point + 1] as usize
    }

    /// The observations of a pose, ascending.
    pub fn of_pose(&self, pose: usize) -> &[u32] {
        &self.of_pose[self.pose_start[pose] as usize..self.pose_start[pose + 1] as usize]
    }

    /// Number of points that take part.
    pub fn num_points(&self) -> u64 {
        self.point_start.windows(2).filter(|w| w[1] > w[0]).count() as u64
    }
}
