//! Cutting the view graph into clusters of bounded size that overlap.

mod bisect;
mod coarsen;
mod fragments;
mod overlap;
mod report;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use terrane_geometry::Seed;
use terrane_scene::{ClusterId, ComponentId, ImageId};

use self::coarsen::WeightedGraph;
use self::overlap::OverlapBounds;
use crate::{PartitionOptions, ViewGraph, components::components};

/// Shared images below which two clusters don't make a seam: a similarity of cameras needs three.
const MIN_SEAM_IMAGES: usize = 3;

/// Images that are rebuilt together.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Cluster {
    /// Its place in [`Partition::clusters`].
    pub id: ClusterId,
    /// The component that it is a part of.
    pub component: ComponentId,
    /// Its images, ascending, those shared with others included. Never more than `max_cluster_size`.
    pub images: Vec<ImageId>,
    /// How many of them have this cluster as their home; every image has one home.
    pub num_core: u32,
}

/// Two clusters that share images.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Seam {
    /// The cluster with the lower id.
    pub a: ClusterId,
    /// The cluster with the higher id.
    pub b: ClusterId,
    /// Images of both, ascending.
    pub shared_images: Vec<ImageId>,
    /// Weight of the edges between the homes of the two.
    pub cut_weight: f64,
}

/// Images that are connected by edges.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Component {
    /// Its place in [`Partition::components`]; 0 is the largest.
    pub id: ComponentId,
    /// Its clusters, ascending.
    pub clusters: Vec<ClusterId>,
    /// How many images it has.
    pub num_images: u32,
}

/// An image that is in no cluster.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LeftOut {
    /// Which image.
    pub image: ImageId,
    /// Why, in words.
    pub reason: String,
}

/// Clusters that cover the view graph.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Partition {
    /// Clusters; `clusters[id.index()]` is the cluster of that id.
    pub clusters: Vec<Cluster>,
    /// Pairs of clusters that share images, ascending by (a, b).
    pub seams: Vec<Seam>,
    /// Components, largest first.
    pub components: Vec<Component>,
    /// Images in no cluster, ascending.
    pub left_out: Vec<LeftOut>,
    /// Figures and warnings.
    pub report: PartitionReport,
}

/// How good a partition is, before any mapping is paid for.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PartitionReport {
    /// Images of the largest cluster.
    pub largest_cluster: u32,
    /// Images of the smallest cluster.
    pub smallest_cluster: u32,
    /// Images counted once for each cluster they are in, over images in any cluster; 1 without overlap.
    pub duplication: f64,
    /// Fewest shared images of any seam; 0 without seams.
    pub fewest_shared_images: u32,
    /// Seams with fewer shared images than asked, as (a, b, how many).
    pub weak_seams: Vec<(ClusterId, ClusterId, u32)>,
    /// Seams whose loss would part the clusters of a component, as (a, b).
    pub bridges: Vec<(ClusterId, ClusterId)>,
}

/// Cuts the graph into clusters of at most `max_cluster_size` images that share images with their neighbours.
///
/// Each component that fits is one cluster. A larger one is cut by multilevel recursive bisection (Karypis & Kumar
/// 1998) into homes of about `core_fraction · max_cluster_size` images along its weakest edges; each home then takes
/// in the images of its neighbours that hold strongest to it. The homes are connected wherever room allows.
pub fn partition(graph: &ViewGraph, options: &PartitionOptions, seed: Seed) -> Partition {
    let bounds = Bounds::new(options);
    let pairs = graph.edges.iter().map(|edge| (edge.pair.first().0, edge.pair.second().0));
    let mut result = Partition::default();
    for members in components(graph.num_images as usize, pairs) {
        if members.len() < bounds.min_component {
            let reason = match members.len() {
                1 => "no verified pair holds it to another image".to_owned(),
                count => format!("its component has only {count} images"),
            };
            let left_out =
                members.iter().map(|node| LeftOut { image: ImageId(*node), reason: reason.clone() });
            result.left_out.extend(left_out);
            continue;
        }
        let id = ComponentId::from_index(result.components.len());
        add_component(&mut result, id, &members, graph, (&bounds, seed.item(&[u64::from(members[0])])));
    }
    result.left_out.sort_by_key(|left_out| left_out.image);
    result.seams.sort_by_key(|seam| (seam.a, seam.b));
    result.report = report::report(&result, bounds.min_shared);
    result
}

/// Options within their ranges.
struct Bounds {
    max_size: usize,
    core_size: u64,
    min_shared: u32,
    min_component: usize,
}

impl Bounds {
    fn new(options: &PartitionOptions) -> Self {
        let max_size = options.max_cluster_size.max(8);
        let fraction =
            if options.core_fraction.is_finite() { options.core_fraction.clamp(0.3, 0.9) } else { 0.6 };
        Self {
            max_size: max_size as usize,
            core_size: (f64::from(max_size) * fraction).round() as u64,
            min_shared: options.min_overlap_images.clamp(3, (max_size / 4).max(3)),
            min_component: options.min_component_size.max(2) as usize,
        }
    }
}

/// Cuts one component and appends its clusters and seams.
fn add_component(
    result: &mut Partition,
    id: ComponentId,
    members: &[u32],
    graph: &ViewGraph,
    (bounds, seed): (&Bounds, Seed),
) {
    let first = result.clusters.len();
    let image = |node: &u32| ImageId(members[*node as usize]);
    if members.len() <= bounds.max_size {
        let images: Vec<ImageId> = members.iter().map(|node| ImageId(*node)).collect();
        let num_core = images.len() as u32;
        result.clusters.push(Cluster { id: ClusterId::from_index(first), component: id, images, num_core });
    } else {
        let local = local_graph(members, graph);
        let mut part_of = bisect::cut(&local, bounds.core_size, seed);
        let num_parts = fragments::mend(&local, &mut part_of, (bounds.core_size, bounds.max_size as u64));
        let overlap_bounds = OverlapBounds { max_size: bounds.max_size, min_shared: bounds.min_shared };
        let grown = overlap::grow(&local, &part_of, num_parts, overlap_bounds);
        let mut core_sizes = vec![0; num_parts as usize];
        part_of.iter().for_each(|part| core_sizes[*part as usize] += 1);
        for (part, nodes) in grown.clusters.iter().enumerate() {
            let num_core = core_sizes[part];
            let id_here = ClusterId::from_index(first + part);
            let images = nodes.iter().map(image).collect();
            result.clusters.push(Cluster { id: id_here, component: id, images, num_core });
        }
        add_seams(result, first, &grown.cut);
    }
    let clusters = (first..result.clusters.len()).map(ClusterId::from_index).collect();
    result.components.push(Component { id, clusters, num_images: members.len() as u32 });
}

/// The component's edges, with its members (ascending) renumbered.
fn local_graph(members: &[u32], graph: &ViewGraph) -> WeightedGraph {
    let place = |image: ImageId| members.binary_search(&image.0).ok().map(|at| at as u32);
    let edges: Vec<(u32, u32, f64)> = graph
        .edges
        .iter()
        .filter_map(|edge| Some((place(edge.pair.first())?, place(edge.pair.second())?, edge.weight)))
        .collect();
    WeightedGraph::new(vec![1; members.len()], &edges)
}

/// Appends a seam for each two clusters from `first` on that share enough images to be aligned.
fn add_seams(result: &mut Partition, first: usize, cut: &BTreeMap<(u32, u32), f64>) {
    let mut shared: BTreeMap<(ClusterId, ClusterId), Vec<ImageId>> = BTreeMap::new();
    let mut clusters_of: BTreeMap<ImageId, Vec<ClusterId>> = BTreeMap::new();
    for cluster in &result.clusters[first..] {
        for image in &cluster.images {
            clusters_of.entry(*image).or_default().push(cluster.id);
        }
    }
    for (image, clusters) in &clusters_of {
        for (k, a) in clusters.iter().enumerate() {
            clusters[k + 1..].iter().for_each(|b| shared.entry((*a, *b)).or_default().push(*image));
        }
    }
    for ((a, b), shared_images) in shared {
        if shared_images.len() >= MIN_SEAM_IMAGES {
            let parts = ((a.index() - first) as u32, (b.index() - first) as u32);
            let cut_weight = cut.get(&parts).copied().unwrap_or(0.0);
            result.seams.push(Seam { a, b, shared_images, cut_weight });
        }
    }
}
