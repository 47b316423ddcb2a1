//! The graph of verified pairs: build, filter, measure and partition with overlap.
//!
//! Photographs are nodes, verified pairs are edges. [`ViewGraph::build`] averages the rotations of the whole graph
//! and drops what disagrees; [`partition`] cuts what is left into clusters of bounded size whose seams share
//! photographs. This crate never sees pixels, matches, files or the network.

mod build;
mod components;
mod graph;
mod options;
mod partition;

pub use graph::{DropReason, DroppedEdge, ViewEdge, ViewGraph, ViewGraphReport};
pub use options::{PartitionOptions, ViewGraphOptions};
pub use partition::{Cluster, Component, LeftOut, Partition, PartitionReport, Seam, partition};
