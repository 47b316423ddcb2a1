//! Submaps and the seams between them.

use std::collections::BTreeSet;

use terrane_fusion::align;
use terrane_fusion::georegister::local_positions;
use terrane_mapping::{ClusterImage, ClusterInput, PositionPrior, reconstruct};
use terrane_scene::codec::{self, ArchiveWriter, Kind};
use terrane_scene::{CameraId, ClusterId, ImageId, ImagePair, ImageTable, Reconstruction};

use super::{ExecutionContext, Made, encode_error, read};
use crate::task::FeatureSet;
use crate::{ArtefactKey, PipelineError, Stage, Store, TaskSpec};

pub(super) fn submap(
    store: &Store,
    context: &ExecutionContext,
    spec: &TaskSpec,
) -> Result<Made, PipelineError> {
    let TaskSpec::Submap { table, view_graph, partition, cluster, features, matches } = spec else {
        return Err(PipelineError::bug("a submap task is not one"));
    };
    let table = context.table(store, table)?;
    let partition = read::partition(store, partition)?;
    let images = partition
        .clusters
        .get(cluster.index())
        .map(|found| found.images.as_slice())
        .ok_or_else(|| PipelineError::bug(format!("there is no cluster {cluster}")))?;
    let pairs = kept_pairs(store, view_graph, images)?;
    let mut input = cluster_input(store, &table, *cluster, images, features)?;
    for key in matches {
        context.cancel.check()?;
        input.pairs.extend(read::matches(store, key, |pair| pairs.contains(&pair))?);
    }
    input.pairs.sort_by_key(|pair| pair.summary.pair);
    let seed = context.config.stage_seed(Stage::Submap).item(&[u64::from(cluster.0)]);
    let (outcome, report) = reconstruct(&input, &context.config.mapping, seed)
        .map_err(|error| PipelineError::bug(format!("cluster {cluster}: {error}")))?;
    let counts = vec![
        ("images", images.len() as u64),
        ("registered", u64::from(report.num_registered)),
        ("submaps", outcome.submaps.len() as u64),
        ("points", outcome.submaps.iter().map(|submap| submap.reconstruction.points.len() as u64).sum()),
    ];
    Ok(Made { bytes: codec::encode_submap(&outcome, &report).map_err(encode_error)?, counts })
}

/// Edges of the view graph between images of a cluster.
fn kept_pairs(
    store: &Store,
    view_graph: &ArtefactKey,
    images: &[ImageId],
) -> Result<BTreeSet<ImagePair>, PipelineError> {
    let graph = read::view_graph(store, view_graph)?;
    let inside = |image: ImageId| images.binary_search(&image).is_ok();
    let edges = graph.edges.iter().map(|edge| edge.pair);
    Ok(edges.filter(|pair| inside(pair.first()) && inside(pair.second())).collect())
}

/// Everything about a cluster but its pairs.
fn cluster_input(
    store: &Store,
    table: &ImageTable,
    cluster: ClusterId,
    images: &[ImageId],
    features: &FeatureSet,
) -> Result<ClusterInput, PipelineError> {
    let positions = local_positions(table).map(|local| local.positions).unwrap_or_default();
    let cameras: BTreeSet<CameraId> = images.iter().map(|image| table.image(*image).camera).collect();
    let mut input = ClusterInput {
        cluster,
        images: Vec::with_capacity(images.len()),
        cameras: cameras.into_iter().map(|id| (id, table.cameras[id.index()].clone())).collect(),
        pairs: Vec::new(),
    };
    for image in images {
        let (keypoints, colors) = read::keypoints(store, features, *image)?;
        let prior =
            positions.binary_search_by_key(image, |position| position.image).ok().map(|at| &positions[at]);
        input.images.push(ClusterImage {
            image: *image,
            camera: table.image(*image).camera,
            keypoints_px: keypoints.iter().map(|keypoint| [keypoint.x_px, keypoint.y_px]).collect(),
            colors,
            position_prior: prior
                .map(|prior| PositionPrior { x_in_enu: prior.x_in_enu, sigma_m: prior.sigma_m }),
        });
    }
    Ok(input)
}

/// Every submap of one cluster with every submap of the other that has an image in common.
pub(super) fn align(
    store: &Store,
    context: &ExecutionContext,
    a: &ArtefactKey,
    b: &ArtefactKey,
) -> Result<Made, PipelineError> {
    let (a, b) = (read::submap(store, a)?, read::submap(store, b)?);
    let seed =
        context.config.stage_seed(Stage::Align).item(&[u64::from(a.cluster.0), u64::from(b.cluster.0)]);
    let mut seams = Vec::new();
    for (i, from) in a.submaps.iter().enumerate() {
        for (j, to) in b.submaps.iter().enumerate() {
            context.cancel.check()?;
            let (from, to) = (&from.reconstruction, &to.reconstruction);
            if share_an_image(from, to) {
                let outcome = align::align(from, to, &context.config.align, seed.item(&[i as u64, j as u64]));
                seams.push((i as u32, j as u32, outcome));
            }
        }
    }
    let accepted = seams.iter().filter(|(_, _, outcome)| outcome.accepted().is_some()).count();
    let counts = vec![("seams", seams.len() as u64), ("accepted", accepted as u64)];
    let mut archive = ArchiveWriter::new(Kind::Record);
    archive.json(read::SEAMS, 0, &seams).map_err(encode_error)?;
    Ok(Made { bytes: archive.finish(), counts })
}

fn share_an_image(a: &Reconstruction, b: &Reconstruction) -> bool {
    a.images.iter().any(|image| b.position_of(image.image).is_some())
}
