//! Parts that fell into pieces, mended.

use super::coarsen::WeightedGraph;

/// Makes parts connected: the largest piece of a part stays, the others go to the neighbouring part that holds them
/// strongest and has room (first up to the core's bound, then up to the cluster's), or become parts of their own.
/// Parts are renumbered without gaps by their lowest node; returns how many there are.
pub(super) fn mend(graph: &WeightedGraph, part_of: &mut [u32], (core, max): (u64, u64)) -> u32 {
    let pieces = pieces(graph, part_of);
    let mut kept: Vec<(u32, usize)> = Vec::new();
    let mut loose = Vec::new();
    // Largest first, so that the first piece of a part is the one that stays.
    for piece in pieces {
        let part = part_of[piece[0] as usize];
        if kept.iter().any(|(other, _)| *other == part) {
            loose.push(piece);
        } else {
            kept.push((part, piece.len()));
        }
    }
    let mut next_part = part_of.iter().max().map_or(0, |part| part + 1);
    for piece in loose {
        let home = part_of[piece[0] as usize];
        let mut hold: Vec<(u32, f64)> = Vec::new();
        for node in &piece {
            for (neighbor, weight) in graph.neighbors(*node) {
                let part = part_of[*neighbor as usize];
                if part == home {
                    continue;
                }
                match hold.iter_mut().find(|entry| entry.0 == part) {
                    Some(entry) => entry.1 += weight,
                    None => hold.push((part, *weight)),
                }
            }
        }
        hold.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        let size_of = |part: u32| part_of.iter().filter(|other| **other == part).count() as u64;
        let fits = |room: u64| hold.iter().map(|entry| entry.0).find(|part| size_of(*part) + piece.len() as u64 <= room);
        // A small piece may use room that was meant for overlap; a large one stands alone.
        let new_home = fits(core).or_else(|| if piece.len() as u64 * 4 < core { fits((core + max) / 2) } else { None });
        let new_home = new_home.unwrap_or_else(|| {
            next_part += 1;
            next_part - 1
        });
        piece.iter().for_each(|node| part_of[*node as usize] = new_home);
    }
    renumber(part_of)
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
