//! A weighted graph, and smaller ones like it, by joining the ends of heavy edges (Karypis & Kumar 1998).

/// An undirected graph in compressed rows; every edge stands in the rows of both its ends.
#[derive(Clone, Debug, Default)]
pub(super) struct WeightedGraph {
    /// Row of node i: `neighbors[start[i]..start[i + 1]]`.
    start: Vec<usize>,
    neighbors: Vec<(u32, f64)>,
    /// How many images each node stands for.
    pub(super) size: Vec<u32>,
}

impl WeightedGraph {
    /// A graph from its edges, each given once; rows ascend by neighbour.
    pub(super) fn new(size: Vec<u32>, edges: &[(u32, u32, f64)]) -> Self {
        let mut start = vec![0usize; size.len() + 1];
        for (a, b, _) in edges {
            start[*a as usize + 1] += 1;
            start[*b as usize + 1] += 1;
        }
        for node in 0..size.len() {
            start[node + 1] += start[node];
        }
        let mut next = start.clone();
        let mut neighbors = vec![(0, 0.0); 2 * edges.len()];
        for (a, b, weight) in edges {
            for (from, to) in [(*a, *b), (*b, *a)] {
                neighbors[next[from as usize]] = (to, *weight);
                next[from as usize] += 1;
            }
        }
        for node in 0..size.len() {
            neighbors[start[node]..start[node + 1]].sort_by_key(|neighbor| neighbor.0);
        }
        Self { start, neighbors, size }
    }

    pub(super) fn len(&self) -> usize {
        self.size.len()
    }

    pub(super) fn total_size(&self) -> u64 {
        self.size.iter().map(|size| u64::from(*size)).sum()
    }

    /// Neighbours of a node with the weights of the edges to them, ascending.
    pub(super) fn neighbors(&self, node: u32) -> &[(u32, f64)] {
        &self.neighbors[self.start[node as usize]..self.start[node as usize + 1]]
    }

    /// Every edge once, as (lower, higher, weight), ascending.
    pub(super) fn edges(&self) -> impl Iterator<Item = (u32, u32, f64)> + '_ {
        (0..self.len() as u32).flat_map(move |a| {
            self.neighbors(a).iter().filter(move |(b, _)| a < *b).map(move |(b, weight)| (a, *b, *weight))
        })
    }

    /// The part of the graph on `nodes` (ascending), renumbered in that order.
    pub(super) fn subgraph(&self, nodes: &[u32]) -> Self {
        let mut edges = Vec::new();
        for (at, node) in nodes.iter().enumerate() {
            for (neighbor, weight) in self.neighbors(*node) {
                if neighbor > node
                    && let Ok(other) = nodes.binary_search(neighbor)
                {
                    edges.push((at as u32, other as u32, *weight));
                }
            }
        }
        Self::new(nodes.iter().map(|node| self.size[*node as usize]).collect(), &edges)
    }

    /// A graph with pairs of strongly joined nodes made one, none larger than `max_size`; and the coarse node of each.
    ///
    /// Nodes are visited lightest first, so that leaves find a partner before their neighbours are taken.
    pub(super) fn coarsened(&self, max_size: u64) -> (Self, Vec<u32>) {
        const FREE: u32 = u32::MAX;
        let mut order: Vec<u32> = (0..self.len() as u32).collect();
        order.sort_by_key(|node| (self.neighbors(*node).len(), *node));
        let mut coarse_of = vec![FREE; self.len()];
        let mut size = Vec::new();
        for node in order {
            if coarse_of[node as usize] != FREE {
                continue;
            }
            let own = u64::from(self.size[node as usize]);
            let mut partner: Option<(u32, f64)> = None;
            for (neighbor, weight) in self.neighbors(node) {
                let fits = own + u64::from(self.size[*neighbor as usize]) <= max_size;
                if fits
                    && coarse_of[*neighbor as usize] == FREE
                    && partner.is_none_or(|best| *weight > best.1)
                {
                    partner = Some((*neighbor, *weight));
                }
            }
            let coarse = size.len() as u32;
            coarse_of[node as usize] = coarse;
            let mut total = self.size[node as usize];
            if let Some((partner, _)) = partner {
                coarse_of[partner as usize] = coarse;
                total += self.size[partner as usize];
            }
            size.push(total);
        }
        (Self::new(size, &self.edges_between(&coarse_of)), coarse_of)
    }

    /// Edges between groups of nodes with their weights added up, ascending.
    pub(super) fn edges_between(&self, group_of: &[u32]) -> Vec<(u32, u32, f64)> {
        let mut edges: Vec<(u32, u32, f64)> = self
            .edges()
            .map(|(a, b, weight)| (group_of[a as usize], group_of[b as usize], weight))
            .filter(|(a, b, _)| a != b)
            .map(|(a, b, weight)| (a.min(b), a.max(b), weight))
            .collect();
        edges.sort_by_key(|(a, b, _)| (*a, *b));
        edges.dedup_by(|next, kept| {
            let same = (next.0, next.1) == (kept.0, kept.1);
            if same {
                kept.2 += next.2;
            }
            same
        });
        edges
    }
}
