//! Balanced cuts: multilevel bisection with Fiduccia–Mattheyses refinement, applied again and again.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use terrane_geometry::Seed;

use super::coarsen::WeightedGraph;

/// Nodes below which a graph is cut directly.
const COARSEST: usize = 64;
/// Starting points tried on the coarsest graph.
const NUM_STARTS: u64 = 12;
/// Refinement passes of a level.
const NUM_PASSES: usize = 6;

/// Cuts a connected graph into parts of at most `max_size` images each, by recursive bisection; the part of each node.
pub(super) fn cut(graph: &WeightedGraph, max_size: u64, seed: Seed) -> Vec<u32> {
    let mut part_of = vec![0; graph.len()];
    let mut num_parts = 0;
    // One in twenty spare, so that cuts may follow the scene rather than the count.
    let wanted = (graph.total_size() as f64 * 1.05 / max_size as f64).ceil() as u64;
    let mut open = vec![((0..graph.len() as u32).collect::<Vec<_>>(), wanted, seed)];
    while let Some((nodes, wanted, seed)) = open.pop() {
        let size: u64 = nodes.iter().map(|node| u64::from(graph.size[*node as usize])).sum();
        if size <= max_size || nodes.len() == 1 {
            nodes.iter().for_each(|node| part_of[*node as usize] = num_parts);
            num_parts += 1;
            continue;
        }
        let wanted = wanted.max(size.div_ceil(max_size)).max(2);
        let (left, right) = (wanted / 2, wanted - wanted / 2);
        let on_right = bisect(&graph.subgraph(&nodes), left as f64 / wanted as f64, wanted, seed);
        let side = |right: bool| -> Vec<u32> {
            nodes.iter().zip(&on_right).filter(|(_, at)| **at == right).map(|(node, _)| *node).collect()
        };
        open.push((side(true), right, seed.derive(b"right")));
        open.push((side(false), left, seed.derive(b"left")));
    }
    part_of
}

/// Sizes that the left side may have.
#[derive(Clone, Copy)]
struct Balance {
    low: f64,
    high: f64,
}

impl Balance {
    /// How far a size is outside.
    fn excess(self, left_size: f64) -> f64 {
        (self.low - left_size).max(left_size - self.high).max(0.0)
    }
}

/// Cuts a graph in two, `left_part` of the images on the left; for each node whether it is on the right.
/// Both sides hold at least one node.
fn bisect(graph: &WeightedGraph, left_part: f64, wanted: u64, seed: Seed) -> Vec<bool> {
    let total = graph.total_size();
    let mut levels: Vec<(WeightedGraph, Vec<u32>)> = Vec::new();
    let max_node = (total / (4 * wanted.max(2))).max(1);
    let mut coarsest = graph.clone();
    while coarsest.len() > COARSEST {
        let (coarse, coarse_of) = coarsest.coarsened(max_node);
        if coarse.len() * 10 > coarsest.len() * 9 {
            break;
        }
        levels.push((std::mem::replace(&mut coarsest, coarse), coarse_of));
    }
    // Less than the spare images of the parts that follow, so that their number need not grow.
    let slack = (total as f64 * 0.04).max(0.5);
    let target = total as f64 * left_part;
    let balance = Balance { low: target - slack, high: target + slack };
    let mut on_right = best_start(&coarsest, target, balance, seed);
    while let Some((fine, coarse_of)) = levels.pop() {
        on_right = coarse_of.iter().map(|coarse| on_right[*coarse as usize]).collect();
        refine(&fine, &mut on_right, balance);
    }
    if on_right.iter().all(|right| *right) || on_right.iter().all(|right| !*right) {
        // Only a graph with one giant node ends here; any cut will do.
        on_right = (0..graph.len()).map(|node| node > 0).collect();
    }
    on_right
}

/// The best of several refined starts, each grown from another node until the left side is full.
fn best_start(graph: &WeightedGraph, target: f64, balance: Balance, seed: Seed) -> Vec<bool> {
    let mut best: Option<(f64, f64, Vec<bool>)> = None;
    for start in 0..NUM_STARTS.min(graph.len() as u64) {
        let from = seed.item(&[start]).0 % graph.len() as u64;
        let mut on_right = grow(graph, from as u32, target);
        refine(graph, &mut on_right, balance);
        let excess = balance.excess(left_size(graph, &on_right));
        let weight = cut_weight(graph, &on_right);
        let better = best.as_ref().is_none_or(|(best_excess, best_weight, _)| {
            excess.total_cmp(best_excess).then(weight.total_cmp(best_weight)) == Ordering::Less
        });
        if better {
            best = Some((excess, weight, on_right));
        }
    }
    best.map(|(_, _, on_right)| on_right).unwrap_or_default()
}

fn left_size(graph: &WeightedGraph, on_right: &[bool]) -> f64 {
    graph.size.iter().zip(on_right).filter(|(_, right)| !**right).map(|(size, _)| f64::from(*size)).sum()
}

pub(super) fn cut_weight(graph: &WeightedGraph, on_right: &[bool]) -> f64 {
    graph
        .edges()
        .filter(|(a, b, _)| on_right[*a as usize] != on_right[*b as usize])
        .map(|(_, _, weight)| weight)
        .sum()
}

/// Ordered by gain, ties by the lower node.
#[derive(Clone, Copy, PartialEq)]
struct Candidate {
    gain: f64,
    node: u32,
}

impl Eq for Candidate {}

impl Ord for Candidate {
    fn cmp(&self, other: &Self) -> Ordering {
        self.gain.total_cmp(&other.gain).then(other.node.cmp(&self.node))
    }
}

impl PartialOrd for Candidate {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

/// A left side grown from a node, always by the node that is held strongest, until it has its size.
fn grow(graph: &WeightedGraph, from: u32, target: f64) -> Vec<bool> {
    let mut on_right = vec![true; graph.len()];
    let mut held = vec![0.0; graph.len()];
    let mut heap = BinaryHeap::from([Candidate { gain: 0.0, node: from }]);
    let mut size = 0.0;
    let mut unreached = 0..graph.len() as u32;
    while size < target {
        let next = match heap.pop() {
            Some(candidate) => candidate,
            // Another component of the graph.
            None => match unreached.by_ref().find(|node| on_right[*node as usize]) {
                Some(node) => Candidate { gain: held[node as usize], node },
                None => break,
            },
        };
        let node = next.node as usize;
        if !on_right[node] || next.gain < held[node] {
            continue;
        }
        let grown = size + f64::from(graph.size[node]);
        if size > 0.0 && grown - target > target - size {
            break;
        }
        size = grown;
        on_right[node] = false;
        for (neighbor, weight) in graph.neighbors(next.node) {
            if on_right[*neighbor as usize] {
                held[*neighbor as usize] += weight;
                heap.push(Candidate { gain: held[*neighbor as usize], node: *neighbor });
            }
        }
    }
    on_right
}

/// Lowers the cut by moving nodes one by one, also uphill, and keeping the best state met (Fiduccia & Mattheyses
/// 1982). Balance comes first.
fn refine(graph: &WeightedGraph, on_right: &mut [bool], balance: Balance) {
    for _ in 0..NUM_PASSES {
        if !refine_once(graph, on_right, balance) {
            break;
        }
    }
}

/// One pass; whether it improved.
fn refine_once(graph: &WeightedGraph, on_right: &mut [bool], balance: Balance) -> bool {
    let mut size = left_size(graph, on_right);
    let mut best = (balance.excess(size), 0.0);
    let mut pass = Pass {
        gain: (0..graph.len() as u32).map(|node| gain_of(graph, on_right, node)).collect(),
        moved: vec![false; graph.len()],
        heaps: [BinaryHeap::new(), BinaryHeap::new()],
    };
    for node in 0..graph.len() as u32 {
        if best.0 > 0.0 || touches_cut(graph, on_right, node) {
            pass.offer(node, on_right);
        }
    }
    let (mut change, mut path, mut best_len) = (0.0, Vec::new(), 0);
    let patience = 50.max(graph.len() / 20);
    while let Some((node, size_after)) = pass.take(graph, on_right, size, balance) {
        change -= pass.gain[node as usize];
        size = size_after;
        on_right[node as usize] = !on_right[node as usize];
        path.push(node);
        let excess = balance.excess(size);
        if (excess, change).partial_cmp(&best) == Some(Ordering::Less) {
            best = (excess, change);
            best_len = path.len();
        } else if path.len() - best_len > patience {
            break;
        }
        for (neighbor, _) in graph.neighbors(node) {
            if !pass.moved[*neighbor as usize] {
                pass.gain[*neighbor as usize] = gain_of(graph, on_right, *neighbor);
                pass.offer(*neighbor, on_right);
            }
        }
    }
    for node in &path[best_len..] {
        on_right[*node as usize] = !on_right[*node as usize];
    }
    best_len > 0
}

/// What a pass knows: gains, nodes that may not move again, and candidates of each side, best first (with stale
/// entries, which are skipped).
struct Pass {
    gain: Vec<f64>,
    moved: Vec<bool>,
    heaps: [BinaryHeap<Candidate>; 2],
}

impl Pass {
    fn offer(&mut self, node: u32, on_right: &[bool]) {
        let gain = self.gain[node as usize];
        self.heaps[usize::from(on_right[node as usize])].push(Candidate { gain, node });
    }

    /// The best move of either side that does not hurt the balance, and the left side's size after it.
    fn take(
        &mut self,
        graph: &WeightedGraph,
        on_right: &[bool],
        size: f64,
        balance: Balance,
    ) -> Option<(u32, f64)> {
        let mut best: Option<(Candidate, usize, f64)> = None;
        for side in 0..2 {
            while let Some(top) = self.heaps[side].peek().copied() {
                let node = top.node as usize;
                let stale =
                    self.moved[node] || top.gain != self.gain[node] || usize::from(on_right[node]) != side;
                if stale {
                    self.heaps[side].pop();
                    continue;
                }
                let after = size + f64::from(graph.size[node]) * if side == 1 { 1.0 } else { -1.0 };
                let hurts = balance.excess(after) > 0.0 && balance.excess(after) >= balance.excess(size);
                if !hurts && best.is_none_or(|(other, _, _)| top > other) {
                    best = Some((top, side, after));
                }
                break;
            }
        }
        let (candidate, side, after) = best?;
        self.heaps[side].pop();
        self.moved[candidate.node as usize] = true;
        Some((candidate.node, after))
    }
}

/// How much lighter the cut gets when a node changes sides.
fn gain_of(graph: &WeightedGraph, on_right: &[bool], node: u32) -> f64 {
    graph
        .neighbors(node)
        .iter()
        .map(
            |(neighbor, weight)| {
                if on_right[*neighbor as usize] == on_right[node as usize] { -weight } else { *weight }
            },
        )
        .sum()
}

fn touches_cut(graph: &WeightedGraph, on_right: &[bool], node: u32) -> bool {
    graph.neighbors(node).iter().any(|(neighbor, _)| on_right[*neighbor as usize] != on_right[node as usize])
}
