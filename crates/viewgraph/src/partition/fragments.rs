//! Parts that fell into pieces, mended.

use std::collections::{BTreeMap, BTreeSet};

use super::coarsen::WeightedGraph;

/// Makes parts connected: the largest piece of a part stays, the others go to the neighbouring part that holds them
/// strongest and has room (first up to the core's bound, then up to half of what is meant for overlap), or become
/// parts of their own. Parts are renumbered without gaps by their lowest node; returns how many there are.
pub(super) fn mend(graph: &WeightedGraph, part_of: &mut [u32], (core, max): (u64, u64)) -> u32 {
    // Every piece is a part of its own at first; `members` keeps each part connected from here on.
    let mut members = pieces(graph, part_of);
    let mut stays = vec![true; members.len()];
    let mut seen = BTreeSet::new();
    for (piece, nodes) in members.iter().enumerate() {
        stays[piece] = seen.insert(part_of[nodes[0] as usize]);
    }
    for (piece, nodes) in members.iter().enumerate() {
        nodes.iter().for_each(|node| part_of[*node as usize] = piece as u32);
    }
    for piece in (0..members.len()).filter(|piece| !stays[*piece]) {
        let size = members[piece].len() as u64;
        let hold = holds(graph, part_of, &members[piece]);
        let fits = |room: u64| {
            hold.iter().map(|entry| entry.0).find(|part| members[*part as usize].len() as u64 + size <= room)
        };
        let small = size * 4 < core;
        let home = fits(core).or_else(|| if small { fits((core + max) / 2) } else { None });
        if let Some(home) = home {
            let nodes = std::mem::take(&mut members[piece]);
            nodes.iter().for_each(|node| part_of[*node as usize] = home);
            members[home as usize].extend(nodes);
        }
    }
    renumber(part_of)
}

/// Other parts that hold a part's nodes, with the weight of the edges, strongest first.
fn holds(graph: &WeightedGraph, part_of: &[u32], nodes: &[u32]) -> Vec<(u32, f64)> {
    let mut hold: BTreeMap<u32, f64> = BTreeMap::new();
    for node in nodes {
        for (neighbor, weight) in graph.neighbors(*node) {
            let part = part_of[*neighbor as usize];
            if part != part_of[*node as usize] {
                *hold.entry(part).or_insert(0.0) += weight;
            }
        }
    }
    let mut hold: Vec<(u32, f64)> = hold.into_iter().collect();
    hold.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    hold
}

/// The connected pieces of all parts, largest first, ties by the lowest node; nodes ascend.
fn pieces(graph: &WeightedGraph, part_of: &[u32]) -> Vec<Vec<u32>> {
    let within = graph
        .edges()
        .filter(|(a, b, _)| part_of[*a as usize] == part_of[*b as usize])
        .map(|(a, b, _)| (a, b));
    crate::components::components(graph.len(), within)
}

fn renumber(part_of: &mut [u32]) -> u32 {
    let mut number = vec![None; part_of.iter().max().map_or(0, |part| *part as usize + 1)];
    let mut count = 0;
    for part in part_of.iter_mut() {
        let new = *number[*part as usize].get_or_insert_with(|| {
            count += 1;
            count - 1
        });
        *part = new;
    }
    count
}
