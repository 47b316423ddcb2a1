//! Connected components by union-find.

/// Disjoint sets over `0..len`, joined by the lower root so that the result does not depend on the order of joins.
pub(crate) struct DisjointSets {
    parent: Vec<u32>,
}

impl DisjointSets {
    pub(crate) fn new(len: usize) -> Self {
        Self { parent: (0..len as u32).collect() }
    }

    /// The lowest member of the set that `node` is in.
    pub(crate) fn root(&mut self, node: u32) -> u32 {
        let mut at = node;
        while self.parent[at as usize] != at {
            let up = self.parent[self.parent[at as usize] as usize];
            self.parent[at as usize] = up;
            at = up;
        }
        at
    }

    /// Joins two sets; true when they were apart.
    pub(crate) fn join(&mut self, a: u32, b: u32) -> bool {
        let (a, b) = (self.root(a), self.root(b));
        if a == b {
            return false;
        }
        self.parent[a.max(b) as usize] = a.min(b);
        true
    }
}

/// The components of a graph as ascending member lists, largest first, ties by the lowest member.
pub(crate) fn components(len: usize, edges: impl Iterator<Item = (u32, u32)>) -> Vec<Vec<u32>> {
    let mut sets = DisjointSets::new(len);
    for (a, b) in edges {
        sets.join(a, b);
    }
    let mut lists: Vec<Vec<u32>> = vec![Vec::new(); len];
    for node in 0..len as u32 {
        let root = sets.root(node);
        lists[root as usize].push(node);
    }
    lists.retain(|members| !members.is_empty());
    lists.sort_by(|a, b| b.len().cmp(&a.len()).then(a[0].cmp(&b[0])));
    lists
}
