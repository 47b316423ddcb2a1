//! Positions of cameras from relative positions whose scale is unknown: one scale for each group, as a submap, or one for
//! each direction, as from two views.
//!
//! With rotations known (from rotation averaging) every relative position is a vector in the world's orientation, and the
//! problem is linear: `position_to − position_from = scale · offset`. Directions keep only the part of a baseline that is
//! perpendicular to them (Govindu 2001), weighted by the inverse length of the baseline so that errors are angles (as in
//! Wilson & Snavely 2014 and Zhuang et al. 2018). Robust by re-weighting (as LUD, Özyeşil & Singer 2015): first under
//! Huber's loss, which is convex, then under the given one. Each round solves one sparse system over all edges.
//!
//! Gauge, for each component: two position priors or more give position and scale. Otherwise the root stays at the origin
//! (or where its prior says), and scale is fixed by the largest group, which keeps its own, or, where there are only
//! directions, by a mean baseline of one.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use crate::Loss;
use crate::graph::{Forest, Link};

mod solver;

/// A relative position whose length is known up to a scale.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RelativePosition {
    /// First node.
    pub from: u32,
    /// Second node; not the first.
    pub to: u32,
    /// From the first to the second, with the world's orientation: in the unit of its group, or of any length.
    pub offset_in_world: Vector3<f64>,
    /// The group whose scale it shares; `None` when only its direction means something.
    pub group: Option<u32>,
    /// Standard deviation of each component in the unit of the group; of a direction, in radians. Positive.
    pub sigma: f64,
}

/// A known position of a node.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NodePosition {
    /// The node.
    pub node: u32,
    /// Where it was measured.
    pub x_in_world: Vector3<f64>,
    /// Standard deviation along each axis of the world; positive.
    pub sigma_m: Vector3<f64>,
}

/// Options of [`average`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PositionAveragingOptions {
    /// Rounds under Huber's loss. Default 20.
    pub huber_iterations: u32,
    /// Most rounds under the final loss. Default 100.
    pub max_iterations: u32,
    /// Final loss. Default: Cauchy.
    pub loss: Loss,
    /// Scale of both losses, in standard deviations. Range: above 0. Default 3.
    pub loss_scale_sigma: f64,
    /// Stop when no position moves by more than this part of the root mean square baseline. Default 1e-9.
    pub step_tolerance: f64,
}

impl Default for PositionAveragingOptions {
    fn default() -> Self {
        Self {
            huber_iterations: 20,
            max_iterations: 100,
            loss: Loss::Cauchy,
            loss_scale_sigma: 3.0,
            step_tolerance: 1e-9,
        }
    }
}

/// Averaged positions.
#[derive(Clone, Debug, PartialEq)]
pub struct PositionAverages {
    /// Position of each node in its component's gauge; `None` for nodes without a usable edge, and for components whose
    /// system is singular.
    pub positions: Vec<Option<Vector3<f64>>>,
    /// Component of each node; 0 is the largest. Positions of different components can't be compared, unless both have
    /// two priors.
    pub component: Vec<u32>,
    /// For each group the length in the world of its unit; `None` when nothing usable is of this group. A group in
    /// several components has the scale of the largest.
    pub group_scales: Vec<Option<f64>>,
    /// For each edge its residual in standard deviations; NaN for ignored edges.
    pub edge_residual_sigma: Vec<f64>,
    /// For each edge the weight that the loss leaves it, in [0, 1]; 0 for ignored edges.
    pub edge_weights: Vec<f64>,
    /// For each prior the weight that the loss leaves it, in [0, 1]; 0 for ignored priors.
    pub prior_weights: Vec<f64>,
    /// What was done.
    pub report: PositionAveragingReport,
}

/// Figures of one averaging.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PositionAveragingReport {
    /// Components with at least two nodes.
    pub num_components: u32,
    /// Components whose system is singular; they have no positions.
    pub singular_components: Vec<u32>,
    /// Edges left out: out of range, from a node to itself, not finite, without length, or with a bad sigma.
    pub ignored_edges: Vec<u32>,
    /// Priors left out: out of range, not finite, or with a bad sigma.
    pub ignored_priors: Vec<u32>,
    /// Rounds of the largest component.
    pub iterations: u32,
    /// Whether every component's last round moved nothing beyond the tolerance.
    pub converged: bool,
}

/// Averages relative positions over a graph of `num_nodes` nodes.
pub fn average(
    num_nodes: usize,
    edges: &[RelativePosition],
    priors: &[NodePosition],
    options: &PositionAveragingOptions,
) -> PositionAverages {
    let usable: Vec<bool> = edges.iter().map(|edge| edge_is_usable(num_nodes, edge)).collect();
    let usable_prior: Vec<bool> = priors.iter().map(|prior| prior_is_usable(num_nodes, prior)).collect();
    let links: Vec<Link> = (0u32..)
        .zip(edges.iter().zip(&usable))
        .filter(|(_, (_, usable))| **usable)
        .map(|(i, (edge, _))| Link { from: edge.from, to: edge.to, strength: 1.0, edge: i })
        .collect();
    let forest = Forest::new(num_nodes, &links);
    let num_groups = edges.iter().zip(&usable).filter(|(_, u)| **u).filter_map(|(e, _)| e.group).max();
    let mut averages = PositionAverages {
        positions: vec![None; num_nodes],
        group_scales: vec![None; num_groups.map_or(0, |last| last as usize + 1)],
        edge_residual_sigma: vec![f64::NAN; edges.len()],
        edge_weights: vec![0.0; edges.len()],
        prior_weights: vec![0.0; priors.len()],
        report: PositionAveragingReport {
            num_components: forest.sizes.iter().filter(|size| **size > 1).count() as u32,
            ignored_edges: unusable(&usable),
            ignored_priors: unusable(&usable_prior),
            converged: true,
            ..Default::default()
        },
        component: Vec::new(),
    };
    let mut parts: Vec<solver::Part<'_>> =
        (0..averages.report.num_components).map(|component| solver::Part::new(component, &forest)).collect();
    let component = |node: u32| forest.component[node as usize] as usize;
    for link in &links {
        parts[component(link.from)].edges.push((link.edge, &edges[link.edge as usize]));
    }
    for (i, prior) in (0u32..).zip(priors).filter(|(i, _)| usable_prior[*i as usize]) {
        if let Some(part) = parts.get_mut(component(prior.node)) {
            part.priors.push((i, prior));
        }
    }
    let mut numbers = vec![u32::MAX; num_nodes];
    for (node, component) in forest.component.iter().enumerate() {
        if let Some(part) = parts.get_mut(*component as usize) {
            numbers[node] = part.nodes.len() as u32;
            part.nodes.push(node as u32);
        }
    }
    for part in &parts {
        part.solve(&numbers, options, &mut averages);
    }
    averages.component = forest.component;
    averages
}

fn unusable(usable: &[bool]) -> Vec<u32> {
    (0u32..).zip(usable).filter(|(_, usable)| !**usable).map(|(i, _)| i).collect()
}

fn edge_is_usable(num_nodes: usize, edge: &RelativePosition) -> bool {
    let in_range = (edge.from as usize) < num_nodes && (edge.to as usize) < num_nodes && edge.from != edge.to;
    let finite = edge.offset_in_world.iter().all(|v| v.is_finite()) && edge.sigma.is_finite();
    // Groups are counted, so that a wild number must not become memory.
    let group_in_range = edge.group.is_none_or(|group| group < MAX_GROUPS);
    in_range && group_in_range && finite && edge.offset_in_world.norm() > 0.0 && edge.sigma > 0.0
}

/// Group numbers must be below this.
pub const MAX_GROUPS: u32 = 1 << 26;

fn prior_is_usable(num_nodes: usize, prior: &NodePosition) -> bool {
    let finite = prior.x_in_world.iter().all(|v| v.is_finite());
    (prior.node as usize) < num_nodes && finite && prior.sigma_m.iter().all(|v| v.is_finite() && *v > 0.0)
}

#[cfg(test)]
mod tests;
