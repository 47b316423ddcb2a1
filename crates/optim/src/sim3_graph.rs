//! Similarities of many frames from measured similarities between them and known positions: one joint robust solve.
//!
//! Minimises `Σ ρ(rᵀ Ω r) / 2` over all edges and priors by Levenberg–Marquardt on Sim(3), with exact Jacobians and a
//! sparse Cholesky factorisation. The loss starts wide and is narrowed step by step (graduated non-convexity, Blake &
//! Zisserman 1987; Yang et al. 2020), so that an edge which closes no loop loses its weight wherever it stands in the start.
//! A component without priors has its strongest node held; with priors its frame is theirs.

use nalgebra::{SMatrix, SVector, Vector3};
use serde::{Deserialize, Serialize};
use terrane_geometry::Sim3;

use crate::Loss;
use crate::graph::{Forest, Link};

mod solver;
mod terms;

/// A measured similarity between two frames.
#[derive(Clone, Debug, PartialEq)]
pub struct Sim3Edge {
    /// First node.
    pub from: u32,
    /// Second node; not the first.
    pub to: u32,
    /// `x_in_to = to_from_from * x_in_from`.
    pub to_from_from: Sim3,
    /// Inverse covariance of a perturbation `(ω, v, λ)` on the left of `to_from_from`, in the frame of `to`; symmetric
    /// and positive semi-definite.
    pub information: SMatrix<f64, 7, 7>,
}

/// A known position of a point of a frame, as a camera centre measured by GPS.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PositionPrior {
    /// The node in whose frame the point is known.
    pub node: u32,
    /// The point in the node's frame.
    pub x_in_node: Vector3<f64>,
    /// Where it was measured in the world.
    pub x_in_world: Vector3<f64>,
    /// Standard deviation along each axis of the world; positive.
    pub sigma_m: Vector3<f64>,
}

/// Options of [`solve`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Sim3GraphOptions {
    /// Loss of edges. Default: Cauchy.
    pub edge_loss: Loss,
    /// Its scale, as a Mahalanobis distance over seven degrees of freedom. Range: above 0. Default 4 (98 % of a
    /// correct edge's residuals are below).
    pub edge_loss_scale_sigma: f64,
    /// Loss of position priors. Default: Cauchy.
    pub prior_loss: Loss,
    /// Its scale in standard deviations over three degrees of freedom. Range: above 0. Default 3.
    pub prior_loss_scale_sigma: f64,
    /// The loss starts this many times wider and is narrowed fourfold until it has its scale. Range: at least 1.
    /// Default 64.
    pub graduation: f64,
    /// Most linear solves at each width of the loss. Default 50.
    pub max_iterations: u32,
    /// A width is done when a step lowers the cost by less than this part. Default 1e-10.
    pub cost_tolerance: f64,
}

impl Default for Sim3GraphOptions {
    fn default() -> Self {
        Self {
            edge_loss: Loss::Cauchy,
            edge_loss_scale_sigma: 4.0,
            prior_loss: Loss::Cauchy,
            prior_loss_scale_sigma: 3.0,
            graduation: 64.0,
            max_iterations: 50,
            cost_tolerance: 1e-10,
        }
    }
}

/// The solved graph.
#[derive(Clone, Debug, PartialEq)]
pub struct Sim3Solution {
    /// `world_from_node` of each node.
    pub world_from_node: Vec<Sim3>,
    /// For each edge the `(ω, v, λ)` by which the solution differs from it, in the frame of `to`; NaN when ignored.
    pub edge_residuals: Vec<SVector<f64, 7>>,
    /// For each edge the weight that the loss leaves it, in [0, 1]; 0 when ignored. A wrong seam has a small one.
    pub edge_weights: Vec<f64>,
    /// For each prior the weight that the loss leaves it, in [0, 1]; 0 when ignored.
    pub prior_weights: Vec<f64>,
    /// What was done.
    pub report: Sim3GraphReport,
}

/// Figures of one solve.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Sim3GraphReport {
    /// Robust cost of the start.
    pub initial_cost: f64,
    /// Robust cost of the solution.
    pub final_cost: f64,
    /// Linear solves.
    pub iterations: u32,
    /// Whether the last width of the loss ended within its tolerance.
    pub converged: bool,
    /// Edges left out: out of range, from a node to itself, not finite, or with a negative information.
    pub ignored_edges: Vec<u32>,
    /// Priors left out: out of range, not finite, or with a standard deviation that is not positive.
    pub ignored_priors: Vec<u32>,
}

/// Solves all nodes jointly from a start, as [`initialise`] gives.
pub fn solve(
    initial: &[Sim3],
    edges: &[Sim3Edge],
    priors: &[PositionPrior],
    options: &Sim3GraphOptions,
) -> Sim3Solution {
    let usable_edges: Vec<bool> = edges.iter().map(|edge| edge_is_usable(initial.len(), edge)).collect();
    let usable_priors: Vec<bool> = priors.iter().map(|prior| prior_is_usable(initial.len(), prior)).collect();
    let problem = solver::Problem::new(initial.len(), (edges, &usable_edges), (priors, &usable_priors));
    let mut report = Sim3GraphReport {
        ignored_edges: unusable(&usable_edges),
        ignored_priors: unusable(&usable_priors),
        ..Default::default()
    };
    let mut world_from_node: Vec<Sim3> =
        initial.iter().map(|start| if sim3_is_sane(start) { *start } else { Sim3::identity() }).collect();
    solver::descend(&problem, &mut world_from_node, options, &mut report);
    let residual = |(edge, usable): (&Sim3Edge, &bool)| {
        if *usable { terms::edge_residual(edge, &world_from_node) } else { SVector::repeat(f64::NAN) }
    };
    let edge_residuals: Vec<SVector<f64, 7>> = edges.iter().zip(&usable_edges).map(residual).collect();
    let edge_weight = |(edge, residual): (&Sim3Edge, &SVector<f64, 7>)| {
        let squared = residual.dot(&(edge.information * residual));
        if squared.is_nan() {
            0.0
        } else {
            options.edge_loss.evaluate(squared, options.edge_loss_scale_sigma).1
        }
    };
    let prior_weight = |(prior, usable): (&PositionPrior, &bool)| {
        if !usable {
            return 0.0;
        }
        let squared = terms::prior_residual(prior, &world_from_node).norm_squared();
        options.prior_loss.evaluate(squared, options.prior_loss_scale_sigma).1
    };
    Sim3Solution {
        edge_weights: edges.iter().zip(&edge_residuals).map(edge_weight).collect(),
        prior_weights: priors.iter().zip(&usable_priors).map(prior_weight).collect(),
        world_from_node,
        edge_residuals,
        report,
    }
}

/// A start for [`solve`]: along spanning trees of the edges with the largest strengths; the root of each component is the
/// world. `strengths` are as many as edges; `None` for nodes without a usable edge.
pub fn initialise(num_nodes: usize, edges: &[Sim3Edge], strengths: &[f64]) -> Vec<Option<Sim3>> {
    let links: Vec<Link> = (0u32..)
        .zip(edges.iter().zip(strengths))
        .filter(|(_, (edge, strength))| edge_is_usable(num_nodes, edge) && strength.is_finite())
        .map(|(i, (edge, strength))| Link { from: edge.from, to: edge.to, strength: *strength, edge: i })
        .collect();
    let forest = Forest::new(num_nodes, &links);
    let mut world_from_node = vec![None; num_nodes];
    for (root, size) in forest.roots.iter().zip(&forest.sizes) {
        if *size > 1 {
            world_from_node[*root as usize] = Some(Sim3::identity());
        }
    }
    for (link, forward) in &forest.tree {
        let to_from_from = edges[link.edge as usize].to_from_from;
        let (known, new, known_from_new) = if *forward {
            (link.from, link.to, to_from_from.inverse())
        } else {
            (link.to, link.from, to_from_from)
        };
        world_from_node[new as usize] = world_from_node[known as usize].map(|world| world * known_from_new);
    }
    world_from_node
}

fn unusable(usable: &[bool]) -> Vec<u32> {
    (0u32..).zip(usable).filter(|(_, usable)| !**usable).map(|(i, _)| i).collect()
}

fn sim3_is_sane(similarity: &Sim3) -> bool {
    let parts = similarity.rotation.coords.iter().chain(similarity.translation.iter());
    parts.chain([&similarity.scale]).all(|v| v.is_finite()) && similarity.scale > 0.0
}

fn edge_is_usable(num_nodes: usize, edge: &Sim3Edge) -> bool {
    let in_range = (edge.from as usize) < num_nodes && (edge.to as usize) < num_nodes && edge.from != edge.to;
    let information = &edge.information;
    in_range
        && sim3_is_sane(&edge.to_from_from)
        && information.iter().all(|v| v.is_finite())
        && information.diagonal().iter().all(|v| *v >= 0.0)
}

fn prior_is_usable(num_nodes: usize, prior: &PositionPrior) -> bool {
    let finite = prior.x_in_node.iter().chain(prior.x_in_world.iter()).all(|v| v.is_finite());
    let positive = prior.sigma_m.iter().all(|v| v.is_finite() && *v > 0.0);
    (prior.node as usize) < num_nodes && finite && positive
}

#[cfg(test)]
mod tests;
