//! Absolute rotations from relative ones: robust averaging over the whole graph.
//!
//! Chatterjee & Govindu (2013): from a spanning tree of the strongest edges (as a start only), steps in the tangent space
//! under the L1 norm, then iteratively re-weighted least squares with a loss that forgets outliers. Every step solves one
//! sparse Laplacian system over all edges. All components are solved, each with the rotation of its root held.

use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use terrane_geometry::so3;

use crate::Loss;
use crate::graph::{Forest, Link};
use crate::linear::{BlockPattern, BlockSystem, LinearSolver};

/// A measured relative rotation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RelativeRotation {
    /// First node.
    pub from: u32,
    /// Second node; not the first.
    pub to: u32,
    /// `to_from_world = to_from_from * from_from_world`.
    pub to_from_from: UnitQuaternion<f64>,
    /// How much the edge counts; positive.
    pub weight: f64,
}

/// Options of [`average`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RotationAveragingOptions {
    /// Most steps under the L1 norm. Default 10.
    pub max_l1_iterations: u32,
    /// Most re-weighted steps after them. Default 100.
    pub max_irls_iterations: u32,
    /// Loss of the re-weighted steps. Default: Geman–McClure.
    pub loss: Loss,
    /// Scale of that loss in degrees. Range: above 0. Default 5 (Chatterjee & Govindu 2013).
    pub loss_scale_deg: f64,
    /// Stop when the mean step is below this, in radians. Default 1e-7.
    pub step_tolerance_rad: f64,
}

impl Default for RotationAveragingOptions {
    fn default() -> Self {
        Self {
            max_l1_iterations: 10,
            max_irls_iterations: 100,
            loss: Loss::GemanMcclure,
            loss_scale_deg: 5.0,
            step_tolerance_rad: 1e-7,
        }
    }
}

/// Averaged rotations.
#[derive(Clone, Debug, PartialEq)]
pub struct RotationAverages {
    /// `node_from_world` of each node, in the gauge of its component; `None` for nodes without a usable edge.
    pub rotations: Vec<Option<UnitQuaternion<f64>>>,
    /// Component of each node; 0 is the largest. Rotations of different components can't be compared.
    pub component: Vec<u32>,
    /// For each edge the angle by which it disagrees with the averages; NaN for ignored edges.
    pub edge_error_rad: Vec<f64>,
    /// For each edge the final weight of the loss, in [0, 1]; 0 for ignored edges.
    pub edge_weight: Vec<f64>,
    /// What was done.
    pub report: RotationAveragingReport,
}

/// Figures of one averaging.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RotationAveragingReport {
    /// Components with at least two nodes.
    pub num_components: u32,
    /// Edges left out: out of range, from a node to itself, not finite, or without weight.
    pub ignored_edges: Vec<u32>,
    /// Steps under the L1 norm.
    pub l1_iterations: u32,
    /// Re-weighted steps.
    pub irls_iterations: u32,
    /// Whether the last step was below the tolerance.
    pub converged: bool,
    /// Median disagreement of the edges, in radians.
    pub median_error_rad: f64,
}

/// Re-solves of the weights within one L1 step.
const L1_INNER_ITERATIONS: usize = 4;
/// Residuals below this weigh alike under the L1 norm, in radians.
const L1_FLOOR_RAD: f64 = 1e-4;
/// Steps under the L1 norm end at this mean step, in radians.
const L1_TOLERANCE_RAD: f64 = 1e-3;

/// Averages relative rotations over a graph of `num_nodes` nodes.
pub fn average(
    num_nodes: usize,
    edges: &[RelativeRotation],
    options: &RotationAveragingOptions,
) -> RotationAverages {
    let links: Vec<Link> = (0u32..).zip(edges).filter_map(|(i, edge)| link(num_nodes, i, edge)).collect();
    let mut usable = vec![false; edges.len()];
    links.iter().for_each(|link| usable[link.edge as usize] = true);
    let forest = Forest::new(num_nodes, &links);
    let mut report = RotationAveragingReport {
        num_components: forest.sizes.iter().filter(|size| **size > 1).count() as u32,
        ignored_edges: (0u32..).zip(&usable).filter(|(_, usable)| !**usable).map(|(i, _)| i).collect(),
        ..Default::default()
    };
    let mut rotations = vec![UnitQuaternion::identity(); num_nodes];
    for (link, forward) in &forest.tree {
        let to_from_from = edges[link.edge as usize].to_from_from;
        if *forward {
            rotations[link.to as usize] = to_from_from * rotations[link.from as usize];
        } else {
            rotations[link.from as usize] = to_from_from.inverse() * rotations[link.to as usize];
        }
    }
    if let Some(mut averaging) = Averaging::new(edges, &links, &forest) {
        averaging.descend_l1(&mut rotations, options, &mut report);
        averaging.descend_robustly(&mut rotations, options, &mut report);
    }
    finish(edges, &usable, (rotations, forest), options, report)
}

fn link(num_nodes: usize, index: u32, edge: &RelativeRotation) -> Option<Link> {
    let RelativeRotation { from, to, weight, .. } = *edge;
    let finite = edge.to_from_from.coords.iter().all(|v| v.is_finite()) && weight.is_finite() && weight > 0.0;
    let in_range = (from as usize) < num_nodes && (to as usize) < num_nodes && from != to;
    (finite && in_range).then_some(Link { from, to, strength: weight, edge: index })
}

/// The linear system over all components, with roots held.
struct Averaging<'a> {
    edges: Vec<&'a RelativeRotation>,
    /// Unknown of each node; `None` for roots and nodes without edges.
    unknown: Vec<Option<usize>>,
    system: BlockSystem,
}

impl<'a> Averaging<'a> {
    fn new(edges: &'a [RelativeRotation], links: &[Link], forest: &Forest) -> Option<Self> {
        let mut unknown = vec![None; forest.component.len()];
        let mut next = 0;
        for (node, component) in forest.component.iter().enumerate() {
            if forest.roots[*component as usize] as usize != node {
                unknown[node] = Some(next);
                next += 1;
            }
        }
        let mut above = vec![Vec::new(); next];
        for link in links {
            if let (Some(a), Some(b)) = (unknown[link.from as usize], unknown[link.to as usize]) {
                above[a.max(b)].push(a.min(b) as u32);
            }
        }
        let system = BlockSystem::new(BlockPattern::new(&vec![1; next], above), LinearSolver::Auto).ok()?;
        let edges = links.iter().map(|link| &edges[link.edge as usize]).collect();
        (next > 0).then_some(Self { edges, unknown, system })
    }

    /// `log(R_toᵀ R_measured R_from)` of every edge: what the steps should make up for.
    fn residuals(&self, rotations: &[UnitQuaternion<f64>]) -> Vec<Vector3<f64>> {
        let residual = |edge: &&RelativeRotation| {
            let (from, to) = (rotations[edge.from as usize], rotations[edge.to as usize]);
            so3::log(&(to.inverse() * edge.to_from_from * from))
        };
        self.edges.iter().map(residual).collect()
    }

    /// The step of each node that fits `step_to − step_from = residual` with the given weights.
    fn solve(&mut self, residuals: &[Vector3<f64>], weights: &[f64]) -> Option<Vec<Vector3<f64>>> {
        self.system.clear();
        let n = self.system.pattern().num_unknowns();
        let mut right = vec![0.0; 3 * n];
        let most = weights.iter().copied().fold(0.0, f64::max);
        for ((edge, residual), weight) in self.edges.iter().zip(residuals).zip(weights) {
            // Edges that the loss forgot still hold the graph together, barely.
            let weight = weight.max(1e-12 * most);
            let (from, to) = (self.unknown[edge.from as usize], self.unknown[edge.to as usize]);
            for (node, sign) in [(from, -1.0), (to, 1.0)] {
                if let Some(node) = node {
                    self.system.add_to_diagonal(node, 0, weight);
                    for c in 0..3 {
                        right[c * n + node] += sign * weight * residual[c];
                    }
                }
            }
            if let (Some(a), Some(b)) = (from, to) {
                self.system.add(a.min(b), a.max(b), &[-weight], 1);
            }
        }
        if !self.system.factorize() {
            return None;
        }
        self.system.solve_in_place(&mut right);
        let step = |unknown: &Option<usize>| {
            unknown.map_or(Vector3::zeros(), |i| Vector3::new(right[i], right[n + i], right[2 * n + i]))
        };
        Some(self.unknown.iter().map(step).collect())
    }

    /// Turns every node by its step, in the world's frame; the mean angle.
    fn turn(&self, rotations: &mut [UnitQuaternion<f64>], steps: &[Vector3<f64>]) -> f64 {
        let mut sum = 0.0;
        for (rotation, step) in rotations.iter_mut().zip(steps) {
            *rotation *= so3::exp(step);
            rotation.renormalize();
            sum += step.norm();
        }
        sum / self.system.pattern().num_unknowns().max(1) as f64
    }

    fn descend_l1(
        &mut self,
        rotations: &mut [UnitQuaternion<f64>],
        options: &RotationAveragingOptions,
        report: &mut RotationAveragingReport,
    ) {
        for _ in 0..options.max_l1_iterations {
            let residuals = self.residuals(rotations);
            let mut left: Vec<f64> = residuals.iter().map(Vector3::norm).collect();
            let mut steps = None;
            for _ in 0..L1_INNER_ITERATIONS {
                let weights: Vec<f64> = self
                    .edges
                    .iter()
                    .zip(&left)
                    .map(|(edge, left)| edge.weight / left.max(L1_FLOOR_RAD))
                    .collect();
                let Some(solved) = self.solve(&residuals, &weights) else { break };
                for ((edge, residual), left) in self.edges.iter().zip(&residuals).zip(&mut left) {
                    *left = (residual + solved[edge.from as usize] - solved[edge.to as usize]).norm();
                }
                steps = Some(solved);
            }
            let Some(steps) = steps else { return };
            report.l1_iterations += 1;
            if self.turn(rotations, &steps) < L1_TOLERANCE_RAD {
                return;
            }
        }
    }

    fn descend_robustly(
        &mut self,
        rotations: &mut [UnitQuaternion<f64>],
        options: &RotationAveragingOptions,
        report: &mut RotationAveragingReport,
    ) {
        let scale = options.loss_scale_deg.to_radians();
        for _ in 0..options.max_irls_iterations {
            let residuals = self.residuals(rotations);
            let weights: Vec<f64> = self
                .edges
                .iter()
                .zip(&residuals)
                .map(|(edge, residual)| edge.weight * options.loss.evaluate(residual.norm_squared(), scale).1)
                .collect();
            let Some(steps) = self.solve(&residuals, &weights) else { return };
            report.irls_iterations += 1;
            if self.turn(rotations, &steps) < options.step_tolerance_rad {
                report.converged = true;
                return;
            }
        }
    }
}

fn finish(
    edges: &[RelativeRotation],
    usable: &[bool],
    (rotations, forest): (Vec<UnitQuaternion<f64>>, Forest),
    options: &RotationAveragingOptions,
    mut report: RotationAveragingReport,
) -> RotationAverages {
    let scale = options.loss_scale_deg.to_radians();
    let edge_error_rad: Vec<f64> = edges
        .iter()
        .zip(usable)
        .map(|(edge, usable)| {
            if !usable {
                return f64::NAN;
            }
            let predicted = rotations[edge.to as usize] * rotations[edge.from as usize].inverse();
            predicted.angle_to(&edge.to_from_from)
        })
        .collect();
    let weight =
        |error: &f64| if error.is_nan() { 0.0 } else { options.loss.evaluate(error * error, scale).1 };
    let mut sorted: Vec<f64> = edge_error_rad.iter().copied().filter(|e| !e.is_nan()).collect();
    sorted.sort_by(f64::total_cmp);
    report.median_error_rad = sorted.get(sorted.len() / 2).copied().unwrap_or(0.0);
    let in_graph = |component: &u32| forest.sizes[*component as usize] > 1;
    RotationAverages {
        rotations: rotations.iter().zip(&forest.component).map(|(r, c)| in_graph(c).then_some(*r)).collect(),
        edge_weight: edge_error_rad.iter().map(weight).collect(),
        component: forest.component,
        edge_error_rad,
        report,
    }
}

#[cfg(test)]
mod tests;
