//! Iterative closest points between two clouds, for a rigid or similarity transform.

use std::num::NonZero;

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use nalgebra::{Matrix3, SMatrix, SVector, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use terrane_geometry::{Sim3, so3};

use crate::statistics::{median, rms};

/// What is minimised.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum IcpMetric {
    /// Distances between nearest points (Besl & McKay 1992).
    PointToPoint,
    /// Distances of points to the tangent planes at their nearest points (Chen & Medioni 1991).
    PointToPlane,
}

/// How ICP goes about it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct IcpOptions {
    /// Off, nothing is refined.
    pub enabled: bool,
    /// What is minimised. Default point to plane: fewer iterations, and surfaces sampled differently don't pull.
    pub metric: IcpMetric,
    /// Whether scale may change. Default true: submaps have scales of their own.
    pub free_scale: bool,
    /// Farthest nearest neighbour that is a match, in medians of the distances at the start. Default 3.
    pub max_distance_in_medians: f64,
    /// Part of the closest matches that is used in each iteration (Chetverikov et al. 2002). Default 0.8.
    pub trim: f64,
    /// Neighbours that a normal is fitted to. Range: at least 3. Default 10.
    pub normal_neighbors: u32,
    /// Most iterations. Default 20.
    pub max_iterations: u32,
    /// Most points taken of a cloud, evenly by index. Default 20,000.
    pub max_points: u32,
}

impl Default for IcpOptions {
    fn default() -> Self {
        Self {
            enabled: true,
            metric: IcpMetric::PointToPlane,
            free_scale: true,
            max_distance_in_medians: 3.0,
            trim: 0.8,
            normal_neighbors: 10,
            max_iterations: 20,
            max_points: 20_000,
        }
    }
}

/// What ICP did. Lengths are in units of the target.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct IcpReport {
    /// Points of the source that were offered.
    pub num_source: u32,
    /// Points of the target that were offered.
    pub num_target: u32,
    /// Matches used in the last iteration.
    pub num_matches: u32,
    /// Iterations done.
    pub iterations: u32,
    /// RMS of the trimmed residuals before the first step.
    pub initial_rms: f64,
    /// RMS of the trimmed residuals after the last step.
    pub final_rms: f64,
    /// Whether the last step was small enough to stop.
    pub converged: bool,
    /// Whether the result was taken over; it is not when shared tracks fit worse after it.
    pub used: bool,
}

/// Least points on either side.
const MIN_POINTS: usize = 20;

/// A cloud with a search tree over it.
struct Target<'a> {
    points: &'a [Vector3<f64>],
    tree: ImmutableKdTree<f64, 3>,
    /// Unit normals; empty when they are not needed. `None` where neighbours don't lie on a plane.
    normals: Vec<Option<Vector3<f64>>>,
}

/// A source point with its nearest target point.
#[derive(Clone, Copy)]
struct Match {
    source: u32,
    target: u32,
    squared_distance: f64,
}

/// Moves `source` onto `target` from `start` (`target_from_source`), by ICP with trimmed matches.
///
/// `None` when either cloud has fewer than 20 points or nothing matches. Deterministic: matches are found in
/// parallel and taken in the order of the source.
pub fn align_points(
    source: &[Vector3<f64>],
    target: &[Vector3<f64>],
    start: &Sim3,
    options: &IcpOptions,
) -> Option<(Sim3, IcpReport)> {
    let usable = |cloud: &[Vector3<f64>]| {
        cloud.len() >= MIN_POINTS && cloud.iter().all(|x| x.iter().all(|value| value.is_finite()))
    };
    if !usable(source) || !usable(target) {
        return None;
    }
    let target = Target::new(target, options)?;
    let mut report = IcpReport {
        num_source: source.len() as u32,
        num_target: target.points.len() as u32,
        ..Default::default()
    };
    let mut pose = *start;
    let nearest = target.nearest(source, &pose);
    let mut distances: Vec<f64> = nearest.iter().map(|found| found.squared_distance.sqrt()).collect();
    let max_distance = options.max_distance_in_medians * median(&mut distances)?;
    let mut matches = trimmed(nearest, max_distance, options.trim);
    report.initial_rms = target.rms(source, &pose, &matches);
    while report.iterations < options.max_iterations && matches.len() >= MIN_POINTS {
        report.iterations += 1;
        let Some(step) = target.step(source, &pose, &matches, options) else { break };
        let next = pose.retract_left(&step);
        let next_matches = trimmed(target.nearest(source, &next), max_distance, options.trim);
        let moved = movement(source, &pose, &next);
        pose = next;
        matches = next_matches;
        if moved < 1e-4 * max_distance {
            report.converged = true;
            break;
        }
    }
    report.num_matches = matches.len() as u32;
    report.final_rms = target.rms(source, &pose, &matches);
    (report.num_matches as usize >= MIN_POINTS).then_some((pose, report))
}

/// RMS motion of the source between two poses, over a few of its points.
fn movement(source: &[Vector3<f64>], before: &Sim3, after: &Sim3) -> f64 {
    let step = source.len().div_ceil(100);
    let moves: Vec<f64> = source
        .iter()
        .step_by(step)
        .map(|x| (after.transform_point(x) - before.transform_point(x)).norm())
        .collect();
    rms(&moves)
}

/// The closest part of the matches within a distance, in the order of the source.
fn trimmed(mut matches: Vec<Match>, max_distance: f64, part: f64) -> Vec<Match> {
    matches.retain(|found| found.squared_distance <= max_distance * max_distance);
    let keep = ((matches.len() as f64 * part.clamp(0.1, 1.0)).ceil() as usize).min(matches.len());
    if keep < matches.len() {
        matches.select_nth_unstable_by(keep, |a, b| {
            a.squared_distance.total_cmp(&b.squared_distance).then(a.source.cmp(&b.source))
        });
        matches.truncate(keep);
        matches.sort_unstable_by_key(|found| found.source);
    }
    matches
}

impl<'a> Target<'a> {
    fn new(points: &'a [Vector3<f64>], options: &IcpOptions) -> Option<Self> {
        let coordinates: Vec<[f64; 3]> = points.iter().map(|x| [x.x, x.y, x.z]).collect();
        let tree = ImmutableKdTree::new_from_slice(&coordinates).ok()?;
        let mut target = Self { points, tree, normals: Vec::new() };
        if options.metric == IcpMetric::PointToPlane {
            let count = NonZero::new(options.normal_neighbors.max(3) as usize + 1)?;
            target.normals = points.par_iter().map(|x| target.normal(x, count)).collect();
        }
        Some(target)
    }

    /// The normal of the plane through a point's neighbours; `None` when they lie as well on a line or in a ball.
    fn normal(&self, x: &Vector3<f64>, count: NonZero<usize>) -> Option<Vector3<f64>> {
        let mut found: Vec<u32> = self
            .tree
            .query(&[x.x, x.y, x.z])
            .nearest_n::<SquaredEuclidean<f64>>(count)
            .execute()
            .iter()
            .map(|neighbor| neighbor.item)
            .collect();
        // Sums in one order, whatever the tree's.
        found.sort_unstable();
        let neighbors = || found.iter().map(|at| self.points[*at as usize]);
        let mean = neighbors().sum::<Vector3<f64>>() / found.len() as f64;
        let covariance: Matrix3<f64> = neighbors().map(|y| (y - mean) * (y - mean).transpose()).sum();
        let eigen = covariance.symmetric_eigen();
        let mut order = [0, 1, 2];
        order.sort_by(|i, j| eigen.eigenvalues[*i].total_cmp(&eigen.eigenvalues[*j]));
        let [small, middle, _] = order.map(|i| eigen.eigenvalues[i]);
        (small < 0.3 * middle).then(|| eigen.eigenvectors.column(order[0]).into_owned())
    }

    /// The nearest target point of every source point.
    fn nearest(&self, source: &[Vector3<f64>], target_from_source: &Sim3) -> Vec<Match> {
        source
            .par_iter()
            .enumerate()
            .map(|(at, x)| {
                let x = target_from_source.transform_point(x);
                let found =
                    self.tree.query(&[x.x, x.y, x.z]).nearest_one::<SquaredEuclidean<f64>>().execute();
                Match { source: at as u32, target: found.item, squared_distance: found.distance }
            })
            .collect()
    }

    /// RMS of the matches' residuals: to the plane where there is a normal, else to the point.
    fn rms(&self, source: &[Vector3<f64>], pose: &Sim3, matches: &[Match]) -> f64 {
        let residuals: Vec<f64> = matches
            .iter()
            .map(|found| {
                let offset =
                    pose.transform_point(&source[found.source as usize]) - self.points[found.target as usize];
                self.normal_of(found.target).map_or(offset.norm(), |normal| normal.dot(&offset))
            })
            .collect();
        rms(&residuals)
    }

    fn normal_of(&self, target: u32) -> Option<Vector3<f64>> {
        self.normals.get(target as usize).copied().flatten()
    }

    /// One Gauss–Newton step about the matches' mean, as a left perturbation of the pose.
    fn step(
        &self,
        source: &[Vector3<f64>],
        pose: &Sim3,
        matches: &[Match],
        options: &IcpOptions,
    ) -> Option<SVector<f64, 7>> {
        let moved = |found: &Match| pose.transform_point(&source[found.source as usize]);
        let mean = matches.iter().map(moved).sum::<Vector3<f64>>() / matches.len() as f64;
        let mut hessian = SMatrix::<f64, 7, 7>::zeros();
        let mut gradient = SVector::<f64, 7>::zeros();
        for found in matches {
            let x = moved(found);
            let offset = x - self.points[found.target as usize];
            let mut jacobian = SMatrix::<f64, 3, 7>::zeros();
            jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(&-so3::skew(&(x - mean)));
            jacobian.fixed_view_mut::<3, 3>(0, 3).copy_from(&Matrix3::identity());
            jacobian.set_column(6, &(x - mean));
            match self.normal_of(found.target) {
                Some(normal) => {
                    let row = normal.transpose() * jacobian;
                    hessian += row.transpose() * row;
                    gradient += row.transpose() * normal.dot(&offset);
                }
                None => {
                    hessian += jacobian.transpose() * jacobian;
                    gradient += jacobian.transpose() * offset;
                }
            }
        }
        if !options.free_scale {
            hessian.fixed_view_mut::<7, 1>(0, 6).fill(0.0);
            hessian.fixed_view_mut::<1, 7>(6, 0).fill(0.0);
            hessian[(6, 6)] = 1.0;
            gradient[6] = 0.0;
        }
        // A little damping: on a plane, sliding and turning in it are free.
        for i in 0..7 {
            hessian[(i, i)] *= 1.0 + 1e-6;
            hessian[(i, i)] += 1e-12;
        }
        let about_mean = hessian.cholesky()?.solve(&-gradient);
        // The same motion, written about the origin.
        let turn = so3::exp(&about_mean.fixed_rows::<3>(0).into_owned());
        let shift = mean + about_mean.fixed_rows::<3>(3) - about_mean[6].exp() * (turn * mean);
        let mut step = about_mean;
        step.fixed_rows_mut::<3>(3).copy_from(&shift);
        step.iter().all(|value| value.is_finite()).then_some(step)
    }
}
