//! What a user may choose about the view graph and its partition.

use serde::{Deserialize, Serialize};

/// How the view graph is filtered.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ViewGraphOptions {
    /// Fewest inlier matches of an edge. Range: at least 1. Default 15, as COLMAP's `min_num_matches`.
    pub min_inliers: u32,
    /// Largest disagreement of an edge's rotation with the averaged rotations, in degrees. Range: above 0, at most
    /// 180. Default 12: between COLMAP's and GLOMAP's 10 and Theia's 15.
    pub max_rotation_error_deg: f64,
    /// Median angle between the rays of a pair, in degrees, from which an edge has its full weight; narrower pairs
    /// count less. Range: above 0. Default 3: below it depth is uncertain (Schönberger & Frahm 2016 filter at 1.5).
    pub full_weight_angle_deg: f64,
}

impl Default for ViewGraphOptions {
    fn default() -> Self {
        Self { min_inliers: 15, max_rotation_error_deg: 12.0, full_weight_angle_deg: 3.0 }
    }
}

/// How the view graph is cut.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PartitionOptions {
    /// Most images of a cluster, those shared with others included. A hard bound. Range: at least 8. Default 150:
    /// a submap of it is adjusted in seconds and stays below 1 GiB with 8,192 features an image.
    pub max_cluster_size: u32,
    /// Images that the two clusters of a seam should share. Range: at least 3, at most a quarter of
    /// `max_cluster_size`. Default 8: a similarity needs 3 cameras, the rest is for wrong ones and for its precision.
    pub min_overlap_images: u32,
    /// Part of `max_cluster_size` that a cluster's own images fill; the rest is for overlap. Range: 0.3 to 0.9.
    /// Default 0.6: with four neighbours each, as aerial blocks have, 10 % of the images go to each seam.
    pub core_fraction: f64,
    /// Components with fewer images are left out, with the reason. Range: at least 2. Default 3.
    pub min_component_size: u32,
}

impl Default for PartitionOptions {
    fn default() -> Self {
        Self { max_cluster_size: 150, min_overlap_images: 8, core_fraction: 0.6, min_component_size: 3 }
    }
}
