//! One component: rounds of re-weighted least squares over positions and scales.

use nalgebra::{Matrix3, Vector3};

use super::{NodePosition, PositionAverages, PositionAveragingOptions, RelativePosition};
use crate::Loss;
use crate::graph::Forest;
use crate::linear::{BlockPattern, BlockSystem, LinearSolver};

/// Part of the diagonal that pulls undetermined unknowns to where they are.
const PULL: f64 = 1e-9;
/// Baselines count as at least this part of the root mean square baseline.
const SHORTEST: f64 = 1e-3;

/// Scales start at no less than this.
const SMALLEST_START: f64 = 1e-3;

/// A component with what it is made of.
pub(super) struct Part<'a> {
    component: u32,
    root: u32,
    pub nodes: Vec<u32>,
    /// Edges with their numbers.
    pub edges: Vec<(u32, &'a RelativePosition)>,
    /// Priors with their numbers.
    pub priors: Vec<(u32, &'a NodePosition)>,
}

/// What holds a component.
enum Gauge {
    /// Its priors.
    Priors,
    /// A node at a position, and the scale of a group at one.
    Group { node: usize, group: usize },
    /// A node at a position, and a mean baseline of one.
    MeanBaseline { node: usize },
}

/// Positions and scales of groups, by their numbers in the part.
#[derive(Clone)]
struct State {
    x: Vec<Vector3<f64>>,
    scales: Vec<f64>,
}

struct Solver<'a> {
    part: &'a Part<'a>,
    numbers: &'a [u32],
    groups: Vec<u32>,
    gauge: Gauge,
    /// First block of the groups; blocks before are nodes. Held ones have none.
    node_block: Vec<Option<usize>>,
    group_block: Vec<Option<usize>>,
    system: BlockSystem,
    right: Vec<f64>,
}

impl<'a> Part<'a> {
    pub fn new(component: u32, forest: &Forest) -> Self {
        let root = forest.roots[component as usize];
        Self { component, root, nodes: Vec::new(), edges: Vec::new(), priors: Vec::new() }
    }

    /// Solves the part and writes what belongs to it.
    pub fn solve(
        &self,
        numbers: &[u32],
        options: &PositionAveragingOptions,
        averages: &mut PositionAverages,
    ) {
        let Some(mut solver) = Solver::new(self, numbers) else {
            averages.report.singular_components.push(self.component);
            return;
        };
        let mut state = solver.start();
        let (mut iterations, mut converged, mut solved) = (0, false, false);
        for round in 0..options.huber_iterations + options.max_iterations {
            let loss = if round < options.huber_iterations { Loss::Huber } else { options.loss };
            let scale = solver.loss_scale(&state, options.loss_scale_sigma);
            let Some(next) = solver.round(&state, (loss, scale), round == 0) else {
                break;
            };
            (iterations, solved) = (round + 1, true);
            let moved = state.x.iter().zip(&next.x).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max);
            state = next;
            if moved <= options.step_tolerance * solver.rms_baseline(&state) {
                converged = round >= options.huber_iterations || loss == options.loss;
                if converged {
                    break;
                }
            }
        }
        averages.report.converged &= converged;
        if self.component == 0 {
            averages.report.iterations = iterations;
        }
        if !solved || state.x.iter().any(|x| !x.iter().all(|v| v.is_finite())) {
            averages.report.singular_components.push(self.component);
            return;
        }
        solver.write(&state, options, averages);
    }
}

impl<'a> Solver<'a> {
    fn new(part: &'a Part<'a>, numbers: &'a [u32]) -> Option<Self> {
        let mut groups: Vec<u32> = part.edges.iter().filter_map(|(_, edge)| edge.group).collect();
        groups.sort_unstable();
        let mut sizes = Vec::new();
        for run in groups.chunk_by(|a, b| a == b) {
            sizes.push(run.len());
        }
        groups.dedup();
        let gauge = gauge(part, numbers, &sizes);
        let (held_node, held_group) = match gauge {
            Gauge::Priors => (None, None),
            Gauge::Group { node, group } => (Some(node), Some(group)),
            Gauge::MeanBaseline { node } => (Some(node), None),
        };
        let mut dims = Vec::new();
        let mut block = |dim: usize, held: bool| {
            (!held).then(|| {
                dims.push(dim);
                dims.len() - 1
            })
        };
        let node_block: Vec<_> = (0..part.nodes.len()).map(|i| block(3, held_node == Some(i))).collect();
        let group_block: Vec<_> = (0..groups.len()).map(|i| block(1, held_group == Some(i))).collect();
        let mut above = vec![Vec::new(); dims.len()];
        for (_, edge) in &part.edges {
            let ends = [edge.from, edge.to].map(|node| node_block[numbers[node as usize] as usize]);
            if let [Some(a), Some(b)] = ends {
                above[a.max(b)].push(a.min(b) as u32);
            }
            let group = edge.group.and_then(|group| groups.binary_search(&group).ok());
            if let Some(column) = group.and_then(|group| group_block[group]) {
                above[column].extend(ends.into_iter().flatten().map(|end| end as u32));
            }
        }
        let system = BlockSystem::new(BlockPattern::new(&dims, above), LinearSolver::Auto).ok()?;
        let right = vec![0.0; system.pattern().num_unknowns()];
        Some(Self { part, numbers, groups, gauge, node_block, group_block, system, right })
    }

    fn start(&self) -> State {
        let mut x = vec![Vector3::zeros(); self.part.nodes.len()];
        for (_, prior) in &self.part.priors {
            x[self.number(prior.node)] = prior.x_in_world;
        }
        State { x, scales: vec![1.0; self.groups.len()] }
    }

    fn number(&self, node: u32) -> usize {
        self.numbers[node as usize] as usize
    }

    fn group(&self, edge: &RelativePosition) -> Option<usize> {
        edge.group.and_then(|group| self.groups.binary_search(&group).ok())
    }

    fn baseline(&self, edge: &RelativePosition, state: &State) -> Vector3<f64> {
        state.x[self.number(edge.to)] - state.x[self.number(edge.from)]
    }

    fn rms_baseline(&self, state: &State) -> f64 {
        let squared: f64 =
            self.part.edges.iter().map(|(_, edge)| self.baseline(edge, state).norm_squared()).sum();
        (squared / self.part.edges.len().max(1) as f64).sqrt()
    }

    /// An edge's residual in standard deviations.
    fn residual(&self, edge: &RelativePosition, state: &State) -> f64 {
        let baseline = self.baseline(edge, state);
        match self.group(edge) {
            Some(group) => {
                let scale = state.scales[group];
                (baseline - edge.offset_in_world * scale).norm()
                    / (edge.sigma * scale.abs().max(f64::MIN_POSITIVE))
            }
            // A chord, so that the opposite direction is the worst one.
            None => {
                let direction = baseline.try_normalize(0.0).unwrap_or_default();
                (direction - edge.offset_in_world.normalize()).norm() / edge.sigma
            }
        }
    }

    /// The scale of the loss: the given one, and wider while most edges still disagree with it, so that a poor start
    /// does not decide which edges are forgotten.
    fn loss_scale(&self, state: &State, least: f64) -> f64 {
        let mut residuals: Vec<f64> =
            self.part.edges.iter().map(|(_, edge)| self.residual(edge, state)).collect();
        let middle = residuals.len() / 2;
        let (_, median, _) = residuals.select_nth_unstable_by(middle, f64::total_cmp);
        median.max(least)
    }

    /// One weighted solve; `None` when the system is singular.
    fn round(&mut self, state: &State, (loss, scale): (Loss, f64), first: bool) -> Option<State> {
        self.system.clear();
        self.right.fill(0.0);
        let rms = self.rms_baseline(state);
        for (_, edge) in &self.part.edges {
            let robust = if first { 1.0 } else { loss.evaluate(self.residual(edge, state).powi(2), scale).1 };
            let unit = match self.group(edge) {
                Some(group) => state.scales[group].abs().max(1e-12),
                None if first => 1.0,
                None => self.baseline(edge, state).norm().max(SHORTEST * rms).max(f64::MIN_POSITIVE),
            };
            let weight = robust / (edge.sigma * unit).powi(2);
            self.add_edge(edge, state, weight, first);
        }
        for (_, prior) in &self.part.priors {
            let node = self.numbers[prior.node as usize] as usize;
            let Some(block) = self.node_block[node] else { continue };
            let residual = (state.x[node] - prior.x_in_world).component_div(&prior.sigma_m);
            let robust = if first { 1.0 } else { loss.evaluate(residual.norm_squared(), scale).1 };
            let offset = self.system.pattern().offset(block);
            for axis in 0..3 {
                let weight = robust / prior.sigma_m[axis].powi(2);
                self.system.add_to_diagonal(block, axis, weight);
                self.right[offset + axis] += weight * prior.x_in_world[axis];
            }
        }
        self.pull(state, first);
        if !self.system.factorize() {
            return None;
        }
        let mut solution = self.right.clone();
        self.system.solve_in_place(&mut solution);
        let next = self.read(state, &solution, first);
        if let Gauge::MeanBaseline { .. } = self.gauge { self.normalized(next) } else { Some(next) }
    }

    /// Adds `weight · |x_to − x_from − offset − change · unknown|²` of an edge of a group, or the same across a direction.
    ///
    /// The first round takes the scale itself as unknown, which is linear but draws everything together where edges
    /// disagree. Later ones linearise errors in the group's unit, `(x_to − x_from) / scale − offset`, in the logarithm of
    /// the scale, which do not.
    fn add_edge(&mut self, edge: &RelativePosition, state: &State, weight: f64, first: bool) {
        let ends = [edge.from, edge.to].map(|node| self.number(node));
        let blocks = ends.map(|node| self.node_block[node]);
        let group = self.group(edge);
        let column = group.and_then(|group| self.group_block[group]);
        let direction = edge.offset_in_world.normalize();
        let (metric, offset) = match group {
            Some(group) if column.is_none() || !first => {
                (Matrix3::identity() * weight, edge.offset_in_world * state.scales[group])
            }
            Some(_) => (Matrix3::identity() * weight, Vector3::zeros()),
            // Only directions: what makes baselines long in their directions; their mean is set afterwards.
            None if matches!(self.gauge, Gauge::MeanBaseline { .. }) => {
                ((Matrix3::identity() - direction * direction.transpose()) * weight, direction)
            }
            None => ((Matrix3::identity() - direction * direction.transpose()) * weight, Vector3::zeros()),
        };
        let pull = if group.is_some() { metric * offset } else { offset * weight };
        let change = if first { edge.offset_in_world } else { self.baseline(edge, state) };
        let mut held = Vector3::zeros();
        for (i, sign) in [(0, -1.0), (1, 1.0)] {
            let Some(block) = blocks[i] else {
                held += state.x[ends[i]] * sign;
                continue;
            };
            self.system.add(block, block, metric.as_slice(), 3);
            let mut right = pull * sign;
            if blocks[1 - i].is_none() {
                right += metric * state.x[ends[1 - i]];
            }
            if let Some(column) = column {
                self.system.add(block, column, (change * (-sign * weight)).as_slice(), 3);
            }
            let at = self.system.pattern().offset(block);
            (0..3).for_each(|axis| self.right[at + axis] += right[axis]);
        }
        if let [Some(a), Some(b)] = blocks {
            self.system.add(a.min(b), a.max(b), (-metric).as_slice(), 3);
        }
        if let Some(column) = column {
            self.system.add_to_diagonal(column, 0, weight * change.norm_squared());
            let at = self.system.pattern().offset(column);
            self.right[at] += weight * change.dot(&(held - offset));
        }
    }

    /// Pulls every unknown a little to where it is, so that what nothing determines stays.
    fn pull(&mut self, state: &State, first: bool) {
        let to_current = !matches!(self.gauge, Gauge::MeanBaseline { .. });
        // In the first round a scale is itself, later its relative change.
        let scale = if first { 1.0 } else { 0.0 };
        let nodes = self.node_block.iter().zip(&state.x);
        let groups = self.group_block.iter().flatten();
        let blocks: Vec<(usize, [f64; 3], usize)> = nodes
            .filter_map(|(block, x)| block.map(|block| (block, [x.x, x.y, x.z], 3)))
            .chain(groups.map(|block| (*block, [scale, 0.0, 0.0], 1)))
            .collect();
        for (block, values, dim) in blocks {
            let offset = self.system.pattern().offset(block);
            for c in 0..dim {
                let pull = PULL * self.system.diagonal(block, c) + f64::MIN_POSITIVE.sqrt();
                self.system.add_to_diagonal(block, c, pull);
                self.right[offset + c] += if to_current { pull * values[c] } else { 0.0 };
            }
        }
    }

    fn read(&self, state: &State, solution: &[f64], first: bool) -> State {
        let mut next = state.clone();
        for (x, block) in next.x.iter_mut().zip(&self.node_block) {
            if let Some(block) = block {
                let offset = self.system.pattern().offset(*block);
                *x = Vector3::from_column_slice(&solution[offset..offset + 3]);
            }
        }
        for (scale, block) in next.scales.iter_mut().zip(&self.group_block) {
            if let Some(block) = block {
                let solved = solution[self.system.pattern().offset(*block)];
                *scale =
                    if first { solved.max(SMALLEST_START) } else { *scale * solved.clamp(-1.0, 1.0).exp() };
            }
        }
        next
    }

    /// The state with a mean baseline of one about the held node.
    fn normalized(&self, mut state: State) -> Option<State> {
        let Gauge::MeanBaseline { node } = self.gauge else { return Some(state) };
        let sum: f64 = self.part.edges.iter().map(|(_, edge)| self.baseline(edge, &state).norm()).sum();
        let factor = self.part.edges.len() as f64 / sum;
        let center = state.x[node];
        state.x.iter_mut().for_each(|x| *x = center + (*x - center) * factor);
        factor.is_finite().then_some(state)
    }

    fn write(&self, state: &State, options: &PositionAveragingOptions, averages: &mut PositionAverages) {
        for (node, x) in self.part.nodes.iter().zip(&state.x) {
            averages.positions[*node as usize] = Some(*x);
        }
        for (group, scale) in self.groups.iter().zip(&state.scales) {
            averages.group_scales[*group as usize].get_or_insert(*scale);
        }
        for (i, edge) in &self.part.edges {
            let residual = self.residual(edge, state);
            averages.edge_residual_sigma[*i as usize] = residual;
            averages.edge_weights[*i as usize] =
                options.loss.evaluate(residual * residual, options.loss_scale_sigma).1;
        }
        for (i, prior) in &self.part.priors {
            let residual =
                (state.x[self.number(prior.node)] - prior.x_in_world).component_div(&prior.sigma_m);
            let (_, weight) = options.loss.evaluate(residual.norm_squared(), options.loss_scale_sigma);
            averages.prior_weights[*i as usize] = weight;
        }
    }
}

fn gauge(part: &Part<'_>, numbers: &[u32], group_sizes: &[usize]) -> Gauge {
    let first = part.priors.first();
    if part.priors.iter().any(|(_, prior)| first.is_some_and(|(_, first)| prior.node != first.node)) {
        return Gauge::Priors;
    }
    let node = numbers[first.map_or(part.root, |(_, prior)| prior.node) as usize] as usize;
    let largest = (0..group_sizes.len()).max_by(|a, b| group_sizes[*a].cmp(&group_sizes[*b]).then(b.cmp(a)));
    match largest {
        Some(group) => Gauge::Group { node, group },
        None => Gauge::MeanBaseline { node },
    }
}
