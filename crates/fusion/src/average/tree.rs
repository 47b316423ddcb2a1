//! A start for the joint solve: similarities spread along the strongest seams. Never the result.

use nalgebra::Vector3;
use terrane_geometry::{Sim3, so3};
use terrane_optim::sim3_graph::{self, Sim3Edge};

use super::place::UsableSeam;

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

/// `world_from_submap` of every submap along spanning trees of the seams with most confirmed triangles, then most
/// shared points; the identity for a submap without seams.
pub(super) fn spread(num_submaps: usize, seams: &[UsableSeam]) -> Vec<Sim3> {
    let strongest = seams.iter().map(|seam| seam.strength).fold(1.0, f64::max);
    let strengths: Vec<f64> = triangle_support(seams)
        .iter()
        .zip(seams)
        .map(|(support, seam)| f64::from(*support) + 0.5 * seam.strength / strongest)
        .collect();
    let edges: Vec<Sim3Edge> = seams.iter().map(|seam| seam.edge.clone()).collect();
    let start = sim3_graph::initialise(num_submaps, &edges, &strengths);
    start.into_iter().map(Option::unwrap_or_default).collect()
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
