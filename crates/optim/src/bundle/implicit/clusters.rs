//! Clusters of cameras that look at the same place, and the points that each sees most of.

use nalgebra::{Vector3, Vector6};
use rayon::prelude::*;

use super::super::plan::Dropped;
use super::super::{BundleError, BundleProblem, BundleShard, Shards};
use super::part::Part;

/// Which cluster every pose belongs to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Clusters {
    /// For each pose its cluster.
    pub of_pose: Vec<u32>,
    /// How many there are.
    pub count: usize,
    /// The poses of each cluster, ascending.
    pub members: Vec<Vec<u32>>,
}

impl Clusters {
    /// Clusters from the cluster of each pose.
    pub fn new(of_pose: Vec<u32>) -> Self {
        let count = of_pose.iter().max().map_or(0, |last| *last as usize + 1);
        let mut members = vec![Vec::new(); count];
        for (pose, cluster) in of_pose.iter().enumerate() {
            members[*cluster as usize].push(pose as u32);
        }
        Self { of_pose, count, members }
    }
}

/// What the poses see, gathered shard by shard.
pub(super) struct Views {
    sums: Vec<Vector3<f64>>,
    counts: Vec<u32>,
}

impl Views {
    pub fn new(num_poses: usize) -> Self {
        Self { sums: vec![Vector3::zeros(); num_poses], counts: vec![0; num_poses] }
    }

    /// Adds an observation.
    pub fn add(&mut self, pose: u32, x_in_world: &Vector3<f64>) {
        self.sums[pose as usize] += x_in_world;
        self.counts[pose as usize] += 1;
    }

    /// Whether each pose sees anything.
    pub fn observed(&self) -> Vec<bool> {
        self.counts.iter().map(|count| *count > 0).collect()
    }

    /// Cuts the poses into balanced clusters, again and again across the coordinate in which their centres, or the means
    /// of the points that they see, are spread widest.
    pub fn cluster(&self, problem: &BundleProblem, most_poses: usize) -> Clusters {
        let places: Vec<Vector6<f64>> = (0..self.counts.len())
            .map(|pose| {
                let center = problem.poses[pose].center();
                let count = f64::from(self.counts[pose].max(1));
                let seen = if self.counts[pose] == 0 { center } else { self.sums[pose] / count };
                Vector6::new(center.x, center.y, center.z, seen.x, seen.y, seen.z)
            })
            .collect();
        let (mut of_pose, mut count) = (vec![0; places.len()], 0);
        let mut poses: Vec<u32> = (0..places.len() as u32).collect();
        split(&mut poses, places.len().div_ceil(most_poses.max(1)), &places, &mut of_pose, &mut count);
        Clusters::new(of_pose)
    }
}

/// Gives `parts` clusters, from number `count` on, to the poses.
fn split(poses: &mut [u32], parts: usize, places: &[Vector6<f64>], of_pose: &mut [u32], count: &mut u32) {
    if parts <= 1 {
        poses.iter().for_each(|pose| of_pose[*pose as usize] = *count);
        *count += u32::from(!poses.is_empty());
        return;
    }
    let n = poses.len() as f64;
    let mean = poses.iter().map(|pose| places[*pose as usize]).sum::<Vector6<f64>>() / n;
    let spread: Vector6<f64> = poses.iter().map(|pose| (places[*pose as usize] - mean).map(|v| v * v)).sum();
    let axis = spread.imax();
    let value = |pose: &u32| places[*pose as usize][axis];
    poses.sort_unstable_by(|a, b| value(a).total_cmp(&value(b)).then(a.cmp(b)));
    let first_parts = parts / 2;
    let (first, second) = poses.split_at_mut(poses.len() * first_parts / parts);
    split(first, first_parts, places, of_pose, count);
    split(second, parts - first_parts, places, of_pose, count);
}

/// The parts of a problem, and where each of their points came from: shard and index.
pub(super) struct Parted {
    pub parts: Vec<Part>,
    pub origins: Vec<Vec<(u32, u32)>>,
}

/// Gives every point that takes part to the cluster that sees it most often (the first of equals).
pub(super) fn make_parts(
    shards: &dyn Shards,
    dropped: &[Dropped],
    clusters: &Clusters,
) -> Result<Parted, BundleError> {
    let mut tally = vec![0u32; clusters.count];
    // Counted first, so that every array is made once, at its size.
    let mut counts = vec![(0usize, 0usize); clusters.count];
    for (index, dropped) in dropped.iter().enumerate() {
        let shard = shards.load(index)?;
        for_each_point(&shard, dropped, clusters, &mut tally, |cluster, _, seen| {
            let (points, observations) = &mut counts[cluster as usize];
            (*points, *observations) = (*points + 1, *observations + seen.len());
        });
    }
    let mut builders: Vec<Builder> = counts.into_iter().map(Builder::with_capacity).collect();
    for fixed in [false, true] {
        for (index, dropped) in dropped.iter().enumerate() {
            let shard = shards.load(index)?;
            if shard.fixed_points == fixed {
                for_each_point(&shard, dropped, clusters, &mut tally, |cluster, point, seen| {
                    let builder = &mut builders[cluster as usize];
                    let local = builder.points.len() as u32;
                    builder.points.push(shard.points[point as usize]);
                    builder.origins.push((index as u32, point));
                    builder.observations.extend(seen.iter().map(|(pose, xy_px)| (*pose, local, *xy_px)));
                });
            }
        }
        if !fixed {
            builders.iter_mut().for_each(|builder| builder.free_points = builder.points.len());
        }
    }
    let finished: Vec<(Part, Vec<(u32, u32)>)> = builders.into_par_iter().map(Builder::finish).collect();
    let (parts, origins) = finished.into_iter().unzip();
    Ok(Parted { parts, origins })
}

/// Calls `visit` with the cluster, the index and the observations of every point of a shard that takes part.
fn for_each_point(
    shard: &BundleShard,
    dropped: &Dropped,
    clusters: &Clusters,
    tally: &mut [u32],
    mut visit: impl FnMut(u32, u32, &[(u32, [f32; 2])]),
) {
    let mut skip = dropped.observations.iter().copied().peekable();
    let mut next = 0;
    let mut seen: Vec<(u32, [f32; 2])> = Vec::new();
    while next < shard.observations.len() {
        let point = shard.observations[next].point;
        seen.clear();
        while next < shard.observations.len() && shard.observations[next].point == point {
            if skip.next_if_eq(&(next as u32)).is_none() {
                seen.push((shard.observations[next].pose, shard.observations[next].xy_px));
            }
            next += 1;
        }
        if let Some(cluster) = majority(&seen, clusters, tally) {
            visit(cluster, point, &seen);
        }
    }
}

/// The cluster of most of the observations, the first of equals; `tally` is zero before and after.
fn majority(seen: &[(u32, [f32; 2])], clusters: &Clusters, tally: &mut [u32]) -> Option<u32> {
    let cluster = |pose: u32| clusters.of_pose[pose as usize];
    seen.iter().for_each(|(pose, _)| tally[cluster(*pose) as usize] += 1);
    let best = seen
        .iter()
        .map(|(pose, _)| cluster(*pose))
        .max_by_key(|c| (tally[*c as usize], std::cmp::Reverse(*c)));
    seen.iter().for_each(|(pose, _)| tally[cluster(*pose) as usize] = 0);
    best
}

/// A part that grows point by point.
struct Builder {
    points: Vec<Vector3<f64>>,
    free_points: usize,
    origins: Vec<(u32, u32)>,
    observations: Vec<(u32, u32, [f32; 2])>,
}

impl Builder {
    fn with_capacity((points, observations): (usize, usize)) -> Self {
        Self {
            points: Vec::with_capacity(points),
            free_points: 0,
            origins: Vec::with_capacity(points),
            observations: Vec::with_capacity(observations),
        }
    }

    fn finish(mut self) -> (Part, Vec<(u32, u32)>) {
        self.observations.sort_by_key(|(pose, _, _)| *pose);
        let mut part = Part {
            points: self.points,
            first_fixed_point: self.free_points as u32,
            point_of: self.observations.iter().map(|o| o.1).collect(),
            xy_px: self.observations.iter().map(|o| o.2).collect(),
            ..Part::default()
        };
        for (at, (pose, _, _)) in self.observations.iter().enumerate() {
            if part.poses.last() != Some(pose) {
                part.poses.push(*pose);
                part.first_observation.push(at as u32);
            }
        }
        part.first_observation.push(self.observations.len() as u32);
        (part, self.origins)
    }
}
