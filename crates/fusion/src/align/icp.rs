//! Iterative closest points between two clouds, for a rigid or similarity transform.

use serde::{Deserialize, Serialize};

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
