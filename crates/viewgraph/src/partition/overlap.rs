//! Which images neighbouring clusters share.

use std::collections::{BTreeMap, BTreeSet};

use super::coarsen::WeightedGraph;
use crate::components::DisjointSets;

/// Bounds of the overlap.
#[derive(Clone, Copy)]
pub(super) struct OverlapBounds {
    /// Most images of a cluster, shared ones included.
    pub(super) max_size: usize,
    /// Images that a seam should share.
    pub(super) min_shared: u32,
}

/// Clusters that grow into each other. Nodes are images, parts are the homes that the cut gave them.
pub(super) struct Overlap<'a> {
    graph: &'a WeightedGraph,
    part_of: &'a [u32],
    bounds: OverlapBounds,
    /// Images of each part's cluster.
    members: Vec<BTreeSet<u32>>,
    /// Clusters of each image, ascending.
    clusters_of: Vec<Vec<u32>>,
    /// How many images each pair of clusters shares.
    shared: BTreeMap<(u32, u32), u32>,
}

/// The clusters (ascending images each) and the pairs of parts with the weight between them.
pub(super) struct Overlapping {
    pub(super) clusters: Vec<Vec<u32>>,
    pub(super) cut: BTreeMap<(u32, u32), f64>,
}

/// Gives each cluster images of its neighbours: first for seams that hold the component together twice over, then
/// for the others, strongest first, as long as there is room.
pub(super) fn grow(
    graph: &WeightedGraph,
    part_of: &[u32],
    num_parts: u32,
    bounds: OverlapBounds,
) -> Overlapping {
    let cut: BTreeMap<(u32, u32), f64> =
        graph.edges_between(part_of).into_iter().map(|(a, b, weight)| ((a, b), weight)).collect();
    let (required, others) = required_seams(num_parts, &cut);
    let mut members = vec![BTreeSet::new(); num_parts as usize];
    for (node, part) in part_of.iter().enumerate() {
        members[*part as usize].insert(node as u32);
    }
    let mut overlap = Overlap {
        graph,
        part_of,
        bounds,
        members,
        clusters_of: part_of.iter().map(|part| vec![*part]).collect(),
        shared: BTreeMap::new(),
    };
    // In steps, so that no seam takes all the room of a cluster that others need too.
    for step in 1..=4 {
        let wanted = (bounds.min_shared * step).div_ceil(4);
        required.iter().for_each(|seam| overlap.fill(*seam, wanted));
    }
    others.iter().for_each(|seam| overlap.fill(*seam, bounds.min_shared));
    let clusters = overlap.members.iter().map(|nodes| nodes.iter().copied().collect()).collect();
    Overlapping { clusters, cut }
}

/// Seams that every part needs (a spanning tree of the strongest, and those that close cycles over it until no seam
/// is a bridge), and the rest; both strongest first.
fn required_seams(num_parts: u32, cut: &BTreeMap<(u32, u32), f64>) -> (Vec<(u32, u32)>, Vec<(u32, u32)>) {
    let mut seams: Vec<((u32, u32), f64)> = cut.iter().map(|(seam, weight)| (*seam, *weight)).collect();
    seams.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    let mut sets = DisjointSets::new(num_parts as usize);
    let mut tree_neighbors: Vec<Vec<u32>> = vec![Vec::new(); num_parts as usize];
    let (mut required, mut rest) = (Vec::new(), Vec::new());
    for ((a, b), _) in seams {
        if sets.join(a, b) {
            tree_neighbors[a as usize].push(b);
            tree_neighbors[b as usize].push(a);
            required.push((a, b));
        } else {
            rest.push((a, b));
        }
    }
    let (parent, depth) = rooted(&tree_neighbors);
    // Parts that no single seam can part any more; the representative is the one nearest to the root.
    let mut block: Vec<u32> = (0..num_parts).collect();
    let mut others = Vec::new();
    for (a, b) in rest {
        let (mut x, mut y) = (top(&mut block, a), top(&mut block, b));
        if x == y {
            others.push((a, b));
            continue;
        }
        while x != y {
            let lower = if depth[x as usize] >= depth[y as usize] { &mut x } else { &mut y };
            block[*lower as usize] = parent[*lower as usize];
            *lower = top(&mut block, *lower);
        }
        required.push((a, b));
    }
    (required, others)
}

fn top(block: &mut [u32], part: u32) -> u32 {
    let mut at = part;
    while block[at as usize] != at {
        block[at as usize] = block[block[at as usize] as usize];
        at = block[at as usize];
    }
    at
}

/// Parent and depth of every node of a forest, rooted at the lowest node of each tree.
fn rooted(neighbors: &[Vec<u32>]) -> (Vec<u32>, Vec<u32>) {
    let mut parent: Vec<u32> = (0..neighbors.len() as u32).collect();
    let mut depth = vec![u32::MAX; neighbors.len()];
    for root in 0..neighbors.len() as u32 {
        if depth[root as usize] != u32::MAX {
            continue;
        }
        depth[root as usize] = 0;
        let mut open = vec![root];
        while let Some(node) = open.pop() {
            for next in &neighbors[node as usize] {
                if depth[*next as usize] == u32::MAX {
                    depth[*next as usize] = depth[node as usize] + 1;
                    parent[*next as usize] = node;
                    open.push(*next);
                }
            }
        }
    }
    (parent, depth)
}

impl Overlap<'_> {
    /// Adds images to either cluster of a seam until `wanted` are shared, or none fits.
    fn fill(&mut self, (a, b): (u32, u32), wanted: u32) {
        let mut offers = [Offers::new(self, a, b), Offers::new(self, b, a)];
        while self.shared.get(&(a, b)).copied().unwrap_or(0) < wanted {
            let mut best: Option<(f64, u32, usize)> = None;
            for (side, offer) in offers.iter().enumerate() {
                if self.members[offer.to as usize].len() >= self.bounds.max_size {
                    continue;
                }
                if let Some((gain, node)) = offer.best(self)
                    && best.is_none_or(|(other, _, _)| gain > other)
                {
                    best = Some((gain, node, side));
                }
            }
            let Some((_, node, side)) = best else { break };
            offers[side].taken(self, node);
            self.add(node, offers[side].to);
        }
    }

    fn add(&mut self, node: u32, cluster: u32) {
        self.members[cluster as usize].insert(node);
        for other in &self.clusters_of[node as usize] {
            *self.shared.entry((cluster.min(*other), cluster.max(*other))).or_insert(0) += 1;
        }
        let at = self.clusters_of[node as usize].partition_point(|other| *other < cluster);
        self.clusters_of[node as usize].insert(at, cluster);
    }
}

/// Images of one part that may join the cluster of another.
struct Offers {
    from: u32,
    to: u32,
    /// How many of the shared images see each image of the other cluster.
    covered: BTreeMap<u32, u32>,
}

impl Offers {
    fn new(overlap: &Overlap<'_>, from: u32, to: u32) -> Self {
        let mut offers = Self { from, to, covered: BTreeMap::new() };
        for node in overlap.members[to as usize].intersection(&overlap.members[from as usize]) {
            offers.taken(overlap, *node);
        }
        offers
    }

    /// Counts a shared image's neighbours as covered.
    fn taken(&mut self, overlap: &Overlap<'_>, node: u32) {
        for (neighbor, _) in overlap.graph.neighbors(node) {
            *self.covered.entry(*neighbor).or_insert(0) += 1;
        }
    }

    /// The image that adds most: the weight of its edges into the other cluster, where those to images that shared
    /// ones already see count less, so that the overlap spreads along the seam.
    fn best(&self, overlap: &Overlap<'_>) -> Option<(f64, u32)> {
        let target = &overlap.members[self.to as usize];
        let mut best: Option<(f64, u32)> = None;
        for node in &overlap.members[self.from as usize] {
            if overlap.part_of[*node as usize] != self.from || target.contains(node) {
                continue;
            }
            let mut gain = 0.0;
            for (neighbor, weight) in overlap.graph.neighbors(*node) {
                if target.contains(neighbor) {
                    let covered = self.covered.get(neighbor).copied().unwrap_or(0);
                    gain += weight / f64::from(1 + covered);
                }
            }
            if gain > 0.0 && best.is_none_or(|(other, _)| gain > other) {
                best = Some((gain, *node));
            }
        }
        best
    }
}
