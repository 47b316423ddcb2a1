//! A start for the joint solve: similarities spread along the strongest seams. Never the result.

use nalgebra::Vector3;
use terrane_geometry::{Sim3, so3};

use super::place::UsableSeam;
use crate::SubmapSummary;

/// A triangle of seams that closes within these confirms all three.
const MAX_LOOP_ROTATION_DEG: f64 = 4.0;
const MAX_LOOP_SCALE: f64 = 0.08;
const MAX_LOOP_DISTANCE: f64 = 0.15;

/// The components of submaps under seams: ascending members, ordered by the first.
pub(super) fn components(num_submaps: usize, seams: &[UsableSeam]) -> Vec<Vec<u32>> {
    let mut label: Vec<u32> = (0..num_submaps as u32).collect();
    // Few submaps and seams: relabel until nothing changes.
    let mut changed = true;
    while changed {
        changed = false;
        for seam in seams {
            let low = label[seam.a as usize].min(label[seam.b as usize]);
            for submap in [seam.a, seam.b] {
                changed |= label[submap as usize] != low;
                label[submap as usize] = low;
            }
        }
    }
    let mut members: Vec<Vec<u32>> = vec![Vec::new(); num_submaps];
    for (submap, label) in label.iter().enumerate() {
        members[*label as usize].push(submap as u32);
    }
    members.retain(|list| !list.is_empty());
    members
}

/// `world_from_submap` of every submap, from the one with most images of each component outwards, by the seams with
/// most confirmed triangles and shared points first (Prim 1957).
pub(super) fn spread(submaps: &[SubmapSummary], seams: &[UsableSeam]) -> Vec<Sim3> {
    let support = triangle_support(seams);
    let mut world_from_submap = vec![Sim3::identity(); submaps.len()];
    let mut reached = vec![false; submaps.len()];
    for members in components(submaps.len(), seams) {
        let root = members.iter().copied().max_by_key(|submap| {
            (submaps[*submap as usize].images.len(), std::cmp::Reverse(*submap))
        });
        let Some(root) = root else { continue };
        reached[root as usize] = true;
        loop {
            let mut best: Option<(u32, f64, usize)> = None;
            for (index, seam) in seams.iter().enumerate() {
                let crosses = reached[seam.a as usize] != reached[seam.b as usize];
                let better = best.is_none_or(|(confirmed, strength, _)| {
                    (support[index], seam.strength) > (confirmed, strength)
                });
                if crosses && better {
                    best = Some((support[index], seam.strength, index));
                }
            }
            let Some((_, _, index)) = best else { break };
            let seam = &seams[index];
            let b_from_a = seam.edge.to_from_from;
            if reached[seam.a as usize] {
                world_from_submap[seam.b as usize] = world_from_submap[seam.a as usize] * b_from_a.inverse();
                reached[seam.b as usize] = true;
            } else {
                world_from_submap[seam.a as usize] = world_from_submap[seam.b as usize] * b_from_a;
                reached[seam.a as usize] = true;
            }
        }
    }
    world_from_submap
}

/// For each seam, in how many triangles that close it is.
fn triangle_support(seams: &[UsableSeam]) -> Vec<u32> {
    let mut support = vec![0; seams.len()];
    let find = |from: u32, to: u32| {
        seams.iter().position(|seam| (seam.a, seam.b) == (from, to) || (seam.a, seam.b) == (to, from))
    };
    let step = |index: usize, from: u32| match seams[index].a == from {
        true => seams[index].edge.to_from_from,
        false => seams[index].edge.to_from_from.inverse(),
    };
    for (first, seam) in seams.iter().enumerate() {
        let (a, b) = (seam.a, seam.b);
        for (second, other) in seams.iter().enumerate().skip(first + 1) {
            let third_node = match (other.a, other.b) {
                (x, y) if x == b && y != a => y,
                (x, y) if y == b && x != a => x,
                _ => continue,
            };
            let Some(third) = find(third_node, a) else { continue };
            let around = step(third, third_node) * step(second, b) * step(first, a);
            if closes(&around, &seam.middle_in_a, seam.depth_in_b / seam.edge.to_from_from.scale) {
                [first, second, third].into_iter().for_each(|index| support[index] += 1);
            }
        }
    }
    support
}

/// Whether going round a loop comes back, near `x` with this depth.
fn closes(around: &Sim3, x: &Vector3<f64>, depth: f64) -> bool {
    so3::log(&around.rotation).norm().to_degrees() <= MAX_LOOP_ROTATION_DEG
        && around.scale.ln().abs() <= MAX_LOOP_SCALE
        && (around.transform_point(x) - x).norm() <= MAX_LOOP_DISTANCE * depth
}
