//! Components and strongest spanning trees of a graph given by its edges.

/// An edge between two nodes, with its strength.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Link {
    pub from: u32,
    pub to: u32,
    pub strength: f64,
    /// Number of the edge, for the caller.
    pub edge: u32,
}

/// The components of a graph, and a tree through each.
pub(crate) struct Forest {
    /// Component of each node: 0 is the largest; nodes without edges come last, each on its own.
    pub component: Vec<u32>,
    /// The root of each component: the node with the greatest sum of strengths.
    pub roots: Vec<u32>,
    /// Number of nodes of each component.
    pub sizes: Vec<u32>,
    /// Edges of the strongest spanning trees, each component's from its root outwards: (link, forward), where forward
    /// means that the tree goes along the edge's own direction.
    pub tree: Vec<(Link, bool)>,
}

impl Forest {
    /// The forest of the strongest edges (Kruskal 1956); ties are broken by the edges' numbers.
    pub fn new(num_nodes: usize, links: &[Link]) -> Self {
        let mut order: Vec<usize> = (0..links.len()).collect();
        order.sort_by(|a, b| {
            links[*b].strength.total_cmp(&links[*a].strength).then(links[*a].edge.cmp(&links[*b].edge))
        });
        let mut sets = DisjointSets::new(num_nodes);
        let mut neighbours: Vec<Vec<(u32, Link, bool)>> = vec![Vec::new(); num_nodes];
        for link in order.into_iter().map(|i| links[i]) {
            if sets.join(link.from, link.to) {
                neighbours[link.from as usize].push((link.to, link, true));
                neighbours[link.to as usize].push((link.from, link, false));
            }
        }
        let (component, sizes) = numbered_components(&mut sets, num_nodes);
        let roots = strongest_nodes(&component, sizes.len(), links);
        let tree = walk(&neighbours, &roots);
        Self { component, roots, sizes, tree }
    }
}

/// Components by falling size, ties by their first node.
fn numbered_components(sets: &mut DisjointSets, num_nodes: usize) -> (Vec<u32>, Vec<u32>) {
    let mut size = vec![0u32; num_nodes];
    let roots: Vec<u32> = (0..num_nodes as u32).map(|node| sets.find(node)).collect();
    roots.iter().for_each(|root| size[*root as usize] += 1);
    let mut first = Vec::new();
    let mut seen = vec![false; num_nodes];
    for root in &roots {
        if !std::mem::replace(&mut seen[*root as usize], true) {
            first.push(*root);
        }
    }
    first.sort_by_key(|root| std::cmp::Reverse(size[*root as usize]));
    let mut number = vec![0u32; num_nodes];
    for (i, root) in first.iter().enumerate() {
        number[*root as usize] = i as u32;
    }
    let component = roots.iter().map(|root| number[*root as usize]).collect();
    (component, first.iter().map(|root| size[*root as usize]).collect())
}

fn strongest_nodes(component: &[u32], num_components: usize, links: &[Link]) -> Vec<u32> {
    let mut strength = vec![0.0; component.len()];
    for link in links {
        strength[link.from as usize] += link.strength;
        strength[link.to as usize] += link.strength;
    }
    let mut roots = vec![u32::MAX; num_components];
    for (node, component) in component.iter().enumerate() {
        let root = &mut roots[*component as usize];
        if *root == u32::MAX || strength[node] > strength[*root as usize] {
            *root = node as u32;
        }
    }
    roots
}

fn walk(neighbours: &[Vec<(u32, Link, bool)>], roots: &[u32]) -> Vec<(Link, bool)> {
    let mut tree = Vec::new();
    let mut reached = vec![false; neighbours.len()];
    for &root in roots {
        reached[root as usize] = true;
        let mut queue = std::collections::VecDeque::from([root]);
        while let Some(node) = queue.pop_front() {
            for &(other, link, forward) in &neighbours[node as usize] {
                if !std::mem::replace(&mut reached[other as usize], true) {
                    tree.push((link, forward));
                    queue.push_back(other);
                }
            }
        }
    }
    tree
}

/// Union by size with path halving.
struct DisjointSets {
    parent: Vec<u32>,
    size: Vec<u32>,
}

impl DisjointSets {
    fn new(n: usize) -> Self {
        Self { parent: (0..n as u32).collect(), size: vec![1; n] }
    }

    fn find(&mut self, mut node: u32) -> u32 {
        while self.parent[node as usize] != node {
            let grandparent = self.parent[self.parent[node as usize] as usize];
            self.parent[node as usize] = grandparent;
            node = grandparent;
        }
        node
    }

    /// Joins two sets; whether they were apart.
    fn join(&mut self, a: u32, b: u32) -> bool {
        let (a, b) = (self.find(a), self.find(b));
        if a == b {
            return false;
        }
        let (large, small) = if self.size[a as usize] >= self.size[b as usize] { (a, b) } else { (b, a) };
        self.parent[small as usize] = large;
        self.size[large as usize] += self.size[small as usize];
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn components_are_numbered_by_size_and_trees_take_the_strongest_edges() {
        let link = |edge, from, to, strength| Link { from, to, strength, edge };
        let links = [
            link(0, 5, 6, 9.0),
            link(1, 0, 1, 1.0),
            link(2, 1, 2, 5.0),
            link(3, 2, 0, 4.0),
            link(4, 2, 2, 50.0),
        ];
        let forest = Forest::new(7, &links);
        assert_eq!(forest.component, [0, 0, 0, 2, 3, 1, 1]);
        assert_eq!(forest.sizes, [3, 2, 1, 1]);
        assert_eq!(forest.roots[0], 2);
        let edges: Vec<(u32, bool)> =
            forest.tree.iter().map(|(link, forward)| (link.edge, *forward)).collect();
        assert_eq!(edges, [(2, false), (3, true), (0, true)]);
    }
}
