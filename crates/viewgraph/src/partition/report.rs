//! What a partition is worth, before any mapping is paid for.

use std::collections::BTreeSet;

use terrane_scene::{ClusterId, ImageId};

use super::{Partition, PartitionReport};
use crate::components::components;

/// The figures of a partition whose seams ask for `min_shared` images.
pub(super) fn report(partition: &Partition, min_shared: u32) -> PartitionReport {
    let sizes = || partition.clusters.iter().map(|cluster| cluster.images.len() as u32);
    let distinct: BTreeSet<ImageId> =
        partition.clusters.iter().flat_map(|cluster| cluster.images.iter().copied()).collect();
    let total: u32 = sizes().sum();
    let shared = |seam: &super::Seam| seam.shared_images.len() as u32;
    PartitionReport {
        largest_cluster: sizes().max().unwrap_or(0),
        smallest_cluster: sizes().min().unwrap_or(0),
        duplication: if distinct.is_empty() { 0.0 } else { f64::from(total) / distinct.len() as f64 },
        fewest_shared_images: partition.seams.iter().map(shared).min().unwrap_or(0),
        weak_seams: partition
            .seams
            .iter()
            .filter(|seam| shared(seam) < min_shared)
            .map(|seam| (seam.a, seam.b, shared(seam)))
            .collect(),
        bridges: bridges(partition),
    }
}

/// Seams without which more clusters would be apart; by trying each, as there are few.
fn bridges(partition: &Partition) -> Vec<(ClusterId, ClusterId)> {
    let pieces_without = |left_out: Option<usize>| {
        let seams = partition.seams.iter().enumerate().filter(|(at, _)| Some(*at) != left_out);
        components(partition.clusters.len(), seams.map(|(_, seam)| (seam.a.0, seam.b.0))).len()
    };
    let whole = pieces_without(None);
    (0..partition.seams.len())
        .filter(|at| pieces_without(Some(*at)) > whole)
        .map(|at| (partition.seams[at].a, partition.seams[at].b))
        .collect()
}
