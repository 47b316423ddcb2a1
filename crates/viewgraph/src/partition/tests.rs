//! Properties of partitions, on grids, chains, stars and random graphs.

use std::collections::BTreeSet;

use proptest::prelude::*;
use terrane_scene::{ImagePair, PairKind};

use super::*;
use crate::ViewEdge;

const SEED: Seed = Seed(7);

fn graph(num_images: u32, edges: &[(u32, u32, f64)]) -> ViewGraph {
    let mut edges: Vec<ViewEdge> = edges
        .iter()
        .filter_map(|(a, b, weight)| {
            Some(ViewEdge {
                pair: ImagePair::new(ImageId(*a), ImageId(*b))?,
                kind: PairKind::Calibrated,
                num_inliers: *weight as u32,
                median_angle_rad: 0.1,
                weight: *weight,
            })
        })
        .collect();
    edges.sort_by_key(|edge| edge.pair);
    edges.dedup_by_key(|edge| edge.pair);
    ViewGraph { num_images, edges, rotations: vec![None; num_images as usize] }
}

/// An aerial block: every image sees those at most two places away, nearer ones better.
fn grid(columns: u32, rows: u32) -> ViewGraph {
    let mut edges = Vec::new();
    for (x, y) in (0..rows).flat_map(|y| (0..columns).map(move |x| (x, y))) {
        for (dx, dy) in [(1, 0), (2, 0), (0, 1), (1, 1), (-1, 1), (0, 2)] {
            let (u, v) = (x as i32 + dx, y as i32 + dy);
            if u >= 0 && u < columns as i32 && v < rows as i32 {
                let weight = 400.0 / f64::from(dx * dx + dy * dy);
                edges.push((y * columns + x, v as u32 * columns + u as u32, weight));
            }
        }
    }
    graph(columns * rows, &edges)
}

/// What every partition must hold, whatever the graph.
fn check(graph: &ViewGraph, options: &PartitionOptions, partition: &Partition) {
    let mut placed = vec![0; graph.num_images as usize];
    let mut cores = 0;
    for (at, cluster) in partition.clusters.iter().enumerate() {
        assert_eq!(cluster.id.index(), at);
        assert!(
            cluster.images.len() <= options.max_cluster_size as usize,
            "cluster of {}",
            cluster.images.len()
        );
        assert!(cluster.images.windows(2).all(|pair| pair[0] < pair[1]));
        cluster.images.iter().for_each(|image| placed[image.index()] += 1);
        cores += cluster.num_core;
        assert_connected(graph, &cluster.images);
    }
    for left_out in &partition.left_out {
        assert_eq!(placed[left_out.image.index()], 0);
        placed[left_out.image.index()] = 1;
    }
    assert!(placed.iter().all(|count| *count >= 1), "an image is nowhere");
    assert_eq!(cores as usize + partition.left_out.len(), graph.num_images as usize);
    for seam in &partition.seams {
        let (a, b) = (&partition.clusters[seam.a.index()], &partition.clusters[seam.b.index()]);
        let both: Vec<_> = a.images.iter().filter(|image| b.images.contains(image)).copied().collect();
        assert_eq!(both, seam.shared_images);
        assert!(seam.a < seam.b && both.len() >= MIN_SEAM_IMAGES);
    }
}

fn assert_connected(graph: &ViewGraph, images: &[ImageId]) {
    let inside: BTreeSet<ImageId> = images.iter().copied().collect();
    let pairs = graph.edges.iter().map(|edge| (edge.pair.first(), edge.pair.second()));
    let within = pairs.filter(|(a, b)| inside.contains(a) && inside.contains(b)).map(|(a, b)| (a.0, b.0));
    let sets = components(graph.num_images as usize, within);
    assert_eq!(sets[0].len(), images.len(), "a cluster is in pieces");
}

#[test]
fn a_component_that_fits_is_one_cluster() {
    let graph = grid(7, 7);
    let options = PartitionOptions { max_cluster_size: 49, ..Default::default() };
    let partition = partition(&graph, &options, SEED);
    check(&graph, &options, &partition);
    assert_eq!(partition.clusters.len(), 1);
    assert_eq!(partition.clusters[0].num_core, 49);
    assert!(partition.seams.is_empty() && partition.left_out.is_empty());
}

#[test]
fn an_aerial_block_is_cut_with_strong_cyclic_seams() {
    let graph = grid(13, 13);
    let options = PartitionOptions { max_cluster_size: 50, ..Default::default() };
    let partition = partition(&graph, &options, SEED);
    check(&graph, &options, &partition);
    let count = partition.clusters.len();
    assert!((5..=8).contains(&count), "{count} clusters");
    assert!(partition.report.weak_seams.len() <= partition.seams.len() / 2, "{:?}", partition.report);
    assert!(partition.report.bridges.is_empty(), "{:?}", partition.report.bridges);
    assert!((1.2..1.7).contains(&partition.report.duplication), "{}", partition.report.duplication);
    for cluster in &partition.clusters {
        let seams = partition.seams.iter().filter(|seam| seam.a == cluster.id || seam.b == cluster.id);
        assert!(
            seams.filter(|seam| seam.shared_images.len() >= 8).count() >= 2,
            "cluster {} hangs loose",
            cluster.id
        );
    }
}

#[test]
fn the_same_graph_gives_the_same_partition() {
    let graph = grid(20, 20);
    let options = PartitionOptions { max_cluster_size: 60, ..Default::default() };
    assert_eq!(partition(&graph, &options, SEED), partition(&graph, &options, SEED));
}

#[test]
fn a_chain_is_cut_where_it_is_weak() {
    // Blocks of 20 that hold together by 100, joined by weights of 1.
    let mut edges = Vec::new();
    for image in 0..59u32 {
        edges.push((image, image + 1, if (image + 1) % 20 == 0 { 1.0 } else { 100.0 }));
        if image + 2 < 60 && (image % 20) < 18 {
            edges.push((image, image + 2, 50.0));
        }
    }
    let graph = graph(60, &edges);
    let options = PartitionOptions { max_cluster_size: 35, min_overlap_images: 6, ..Default::default() };
    let partition = partition(&graph, &options, SEED);
    check(&graph, &options, &partition);
    assert_eq!(partition.clusters.len(), 3);
    assert!(partition.clusters.iter().all(|cluster| cluster.num_core == 20), "{:?}", partition.clusters);
    assert_eq!(partition.report.bridges.len(), 2, "a chain has bridges, and the report says so");
}

#[test]
fn small_components_are_left_out_with_the_reason() {
    let mut edges = vec![(0, 1, 50.0), (1, 2, 50.0), (0, 2, 50.0), (4, 5, 90.0)];
    edges.push((2, 3, 20.0));
    let graph = graph(7, &edges);
    let partition = partition(&graph, &PartitionOptions::default(), SEED);
    check(&graph, &PartitionOptions::default(), &partition);
    assert_eq!(partition.components.len(), 1);
    let left_out: Vec<u32> = partition.left_out.iter().map(|left_out| left_out.image.0).collect();
    assert_eq!(left_out, [4, 5, 6]);
    assert!(partition.left_out[0].reason.contains("only 2 images"));
}

#[test]
fn nothing_gives_nothing() {
    let partition = partition(&ViewGraph::default(), &PartitionOptions::default(), SEED);
    assert!(partition.clusters.is_empty() && partition.left_out.is_empty());
}

#[test]
fn a_star_keeps_the_bound_although_every_seam_meets_in_its_hub() {
    // Twelve arms of 20 images on a hub of 20.
    let mut edges = Vec::new();
    for arm in 0..13u32 {
        for k in 0..20 {
            for step in 1..=2 {
                if k + step < 20 {
                    edges.push((arm * 20 + k, arm * 20 + k + step, 100.0));
                }
            }
        }
        if arm > 0 {
            edges.push((arm * 20, arm, 60.0));
            edges.push((arm * 20 + 1, arm, 60.0));
        }
    }
    let graph = graph(260, &edges);
    let options = PartitionOptions { max_cluster_size: 40, ..Default::default() };
    let partition = partition(&graph, &options, SEED);
    check(&graph, &options, &partition);
    let pairs = partition.seams.iter().map(|seam| (seam.a.0, seam.b.0));
    assert_eq!(components(partition.clusters.len(), pairs).len(), 1, "every cluster is reached by seams");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    #[test]
    fn any_graph_is_covered_within_the_bound(
        edges in prop::collection::vec((0u32..120, 0u32..120, 1.0f64..500.0), 0..400),
        max_cluster_size in 8u32..60,
        seed in 0u64..1000,
    ) {
        let graph = graph(120, &edges);
        let options = PartitionOptions { max_cluster_size, ..Default::default() };
        check(&graph, &options, &partition(&graph, &options, Seed(seed)));
    }
}
