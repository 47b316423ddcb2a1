//! The view graph and its partition.

use terrane_scene::codec::{ArchiveWriter, Kind};
use terrane_viewgraph::{ViewGraph, partition as cut};

use super::{ExecutionContext, Made, encode_error, read};
use crate::{ArtefactKey, PipelineError, Stage, Store};

pub(super) fn view_graph(
    store: &Store,
    context: &ExecutionContext,
    num_images: u32,
    matches: &[ArtefactKey],
) -> Result<Made, PipelineError> {
    let mut summaries = Vec::new();
    for key in matches {
        context.cancel.check()?;
        summaries.extend(read::pair_summaries(store, key)?.0);
    }
    summaries.sort_by_key(|summary| summary.pair);
    let (graph, report) = ViewGraph::build(num_images, &summaries, &context.config.view_graph);
    let counts = vec![("pairs", summaries.len() as u64), ("edges", graph.edges.len() as u64)];
    let mut archive = ArchiveWriter::new(Kind::Record);
    archive.json(read::GRAPH, 0, &graph).map_err(encode_error)?;
    archive.json(read::REPORT, 0, &report).map_err(encode_error)?;
    Ok(Made { bytes: archive.finish(), counts })
}

pub(super) fn partition(
    store: &Store,
    context: &ExecutionContext,
    view_graph: &ArtefactKey,
) -> Result<Made, PipelineError> {
    let graph = read::view_graph(store, view_graph)?;
    let partition = cut(&graph, &context.config.partition, context.config.stage_seed(Stage::Partition));
    let counts = vec![
        ("clusters", partition.clusters.len() as u64),
        ("seams", partition.seams.len() as u64),
        ("left_out", partition.left_out.len() as u64),
    ];
    let mut archive = ArchiveWriter::new(Kind::Record);
    archive.json(read::PARTITION, 0, &partition).map_err(encode_error)?;
    Ok(Made { bytes: archive.finish(), counts })
}
