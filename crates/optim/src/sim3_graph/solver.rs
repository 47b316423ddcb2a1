//! Levenberg–Marquardt over the graph, with a loss that narrows.

use nalgebra::SVector;
use terrane_geometry::Sim3;

use super::terms::{edge_jacobian, edge_residual, prior_jacobian, prior_residual};
use super::{Forest, Link, PositionPrior, Sim3Edge, Sim3GraphOptions, Sim3GraphReport};
use crate::linear::{BlockPattern, BlockSystem, LinearSolver};

const INITIAL_DAMPING: f64 = 1e-6;
const MAX_DAMPING: f64 = 1e12;
/// The loss is narrowed by this factor from width to width.
const NARROWING: f64 = 4.0;

/// The usable edges and priors, and the unknown of each node.
pub(super) struct Problem<'a> {
    edges: Vec<&'a Sim3Edge>,
    priors: Vec<&'a PositionPrior>,
    /// `None` for held nodes.
    unknown: Vec<Option<usize>>,
    num_unknowns: usize,
}

impl<'a> Problem<'a> {
    pub fn new(
        num_nodes: usize,
        (edges, usable_edges): (&'a [Sim3Edge], &[bool]),
        (priors, usable_priors): (&'a [PositionPrior], &[bool]),
    ) -> Self {
        let edges: Vec<&Sim3Edge> =
            edges.iter().zip(usable_edges).filter(|(_, u)| **u).map(|(e, _)| e).collect();
        let priors: Vec<&PositionPrior> =
            priors.iter().zip(usable_priors).filter(|(_, u)| **u).map(|(p, _)| p).collect();
        let links: Vec<Link> = edges
            .iter()
            .map(|edge| Link { from: edge.from, to: edge.to, strength: edge.information.trace(), edge: 0 })
            .collect();
        let forest = Forest::new(num_nodes, &links);
        let mut has_prior = vec![false; forest.roots.len()];
        priors.iter().for_each(|prior| has_prior[forest.component[prior.node as usize] as usize] = true);
        let mut num_unknowns = 0;
        let unknown = (0..num_nodes)
            .map(|node| {
                let component = forest.component[node] as usize;
                let held = !has_prior[component] && forest.roots[component] as usize == node;
                (!held).then(|| {
                    num_unknowns += 1;
                    num_unknowns - 1
                })
            })
            .collect();
        Self { edges, priors, unknown, num_unknowns }
    }

    fn pattern(&self) -> BlockPattern {
        let mut above = vec![Vec::new(); self.num_unknowns];
        for edge in &self.edges {
            if let (Some(a), Some(b)) = (self.unknown[edge.from as usize], self.unknown[edge.to as usize]) {
                above[a.max(b)].push(a.min(b) as u32);
            }
        }
        BlockPattern::new(&vec![7; self.num_unknowns], above)
    }

    fn cost(&self, nodes: &[Sim3], options: &Sim3GraphOptions, width: f64) -> f64 {
        let edges = self.edges.iter().map(|edge| {
            let residual = edge_residual(edge, nodes);
            let squared = residual.dot(&(edge.information * residual)).max(0.0);
            0.5 * options.edge_loss.evaluate(squared, width * options.edge_loss_scale_sigma).0
        });
        let priors = self.priors.iter().map(|prior| {
            let squared = prior_residual(prior, nodes).norm_squared();
            0.5 * options.prior_loss.evaluate(squared, width * options.prior_loss_scale_sigma).0
        });
        edges.sum::<f64>() + priors.sum::<f64>()
    }
}

/// The normal equations at one point of the search.
struct Normal {
    system: BlockSystem,
    descent: Vec<f64>,
    diagonal: Vec<f64>,
}

impl Normal {
    fn fill(&mut self, problem: &Problem<'_>, nodes: &[Sim3], options: &Sim3GraphOptions, width: f64) {
        self.system.clear();
        self.descent.fill(0.0);
        self.diagonal.fill(0.0);
        for edge in &problem.edges {
            let residual = edge_residual(edge, nodes);
            let squared = residual.dot(&(edge.information * residual)).max(0.0);
            let weight = options.edge_loss.evaluate(squared, width * options.edge_loss_scale_sigma).1;
            let jacobian = edge_jacobian(edge, nodes, &residual);
            let weighted = jacobian.transpose() * edge.information * weight;
            let block = weighted * jacobian;
            let descent = -(weighted * residual);
            let (from, to) = (problem.unknown[edge.from as usize], problem.unknown[edge.to as usize]);
            for (node, sign) in [(from, 1.0), (to, -1.0)] {
                if let Some(node) = node {
                    self.add(node, block.as_slice(), &(descent * sign));
                }
            }
            if let (Some(a), Some(b)) = (from, to) {
                self.system.add(a.min(b), a.max(b), (-block).as_slice(), 7);
            }
        }
        for prior in &problem.priors {
            let residual = prior_residual(prior, nodes);
            let scale = width * options.prior_loss_scale_sigma;
            let weight = options.prior_loss.evaluate(residual.norm_squared(), scale).1;
            let weighted = prior_jacobian(prior, nodes).transpose() * weight;
            if let Some(node) = problem.unknown[prior.node as usize] {
                let block = weighted * prior_jacobian(prior, nodes);
                self.add(node, block.as_slice(), &-(weighted * residual));
            }
        }
    }

    fn add(&mut self, node: usize, block: &[f64], descent: &SVector<f64, 7>) {
        self.system.add(node, node, block, 7);
        for c in 0..7 {
            self.diagonal[7 * node + c] += block[8 * c];
            self.descent[7 * node + c] += descent[c];
        }
    }

    /// The damped step, and by how much its model lowers the cost. `damped` is what the diagonal carries already.
    fn solve(&mut self, damping: f64, damped: &mut f64) -> Option<(Vec<f64>, f64)> {
        for node in 0..self.diagonal.len() / 7 {
            for c in 0..7 {
                // Directions that nothing measures stay where they are.
                let diagonal = self.diagonal[7 * node + c].max(1e-12);
                self.system.add_to_diagonal(node, c, (damping - *damped) * diagonal);
            }
        }
        *damped = damping;
        if !self.system.factorize() {
            return None;
        }
        let mut step = self.descent.clone();
        self.system.solve_in_place(&mut step);
        let terms = step.iter().zip(&self.descent).zip(&self.diagonal);
        let reduction = terms.map(|((h, g), d)| 0.5 * h * (damping * d.max(1e-12) * h + g)).sum::<f64>();
        (step.iter().all(|v| v.is_finite()) && reduction.is_finite()).then_some((step, reduction))
    }
}

/// Moves the nodes to a minimum, from the widest loss to the given one.
pub(super) fn descend(
    problem: &Problem<'_>,
    nodes: &mut Vec<Sim3>,
    options: &Sim3GraphOptions,
    report: &mut Sim3GraphReport,
) {
    report.initial_cost = problem.cost(nodes, options, 1.0);
    report.final_cost = report.initial_cost;
    if problem.num_unknowns == 0 {
        report.converged = true;
        return;
    }
    let pattern = problem.pattern();
    let n = pattern.num_unknowns();
    let Ok(system) = BlockSystem::new(pattern, LinearSolver::Auto) else { return };
    let mut normal = Normal { system, descent: vec![0.0; n], diagonal: vec![0.0; n] };
    let mut width = options.graduation.max(1.0);
    loop {
        report.converged = descend_at(problem, nodes, (&mut normal, width), options, &mut report.iterations);
        if width <= 1.0 {
            break;
        }
        width = (width / NARROWING).max(1.0);
    }
    report.final_cost = problem.cost(nodes, options, 1.0);
}

/// Levenberg–Marquardt at one width; whether it ended within its tolerance.
fn descend_at(
    problem: &Problem<'_>,
    nodes: &mut Vec<Sim3>,
    (normal, width): (&mut Normal, f64),
    options: &Sim3GraphOptions,
    iterations: &mut u32,
) -> bool {
    let mut cost = problem.cost(nodes, options, width);
    let (mut damping, mut factor) = (INITIAL_DAMPING, 2.0);
    normal.fill(problem, nodes, options, width);
    let mut damped = 0.0;
    for _ in 0..options.max_iterations {
        if cost == 0.0 {
            return true;
        }
        *iterations += 1;
        let tried = normal.solve(damping, &mut damped).map(|(step, reduction)| {
            let moved: Vec<Sim3> = moved(problem, nodes, &step);
            let next = problem.cost(&moved, options, width);
            (moved, next, reduction)
        });
        match tried {
            Some((moved, next, reduction)) if next < cost && reduction > 0.0 => {
                let gain = (cost - next) / reduction;
                damping = (damping * (1.0 - (2.0 * gain - 1.0).powi(3)).max(1.0 / 3.0)).max(1e-14);
                factor = 2.0;
                *nodes = moved;
                let won = (cost - next) / cost;
                cost = next;
                if won <= options.cost_tolerance {
                    return true;
                }
                normal.fill(problem, nodes, options, width);
                damped = 0.0;
            }
            Some((_, _, reduction)) if reduction <= 1e-13 * cost => return true,
            _ => {
                damping *= factor;
                factor *= 2.0;
                if damping > MAX_DAMPING {
                    return false;
                }
            }
        }
    }
    false
}

fn moved(problem: &Problem<'_>, nodes: &[Sim3], step: &[f64]) -> Vec<Sim3> {
    nodes
        .iter()
        .zip(&problem.unknown)
        .map(|(node, unknown)| match unknown {
            Some(i) => node.retract_left(&SVector::<f64, 7>::from_column_slice(&step[7 * i..7 * i + 7])),
            None => *node,
        })
        .collect()
}
