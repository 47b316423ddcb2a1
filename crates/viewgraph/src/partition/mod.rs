//! Cutting the view graph into clusters of bounded size that overlap.

use serde::{Deserialize, Serialize};
use terrane_scene::{ClusterId, ComponentId, ImageId};

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
