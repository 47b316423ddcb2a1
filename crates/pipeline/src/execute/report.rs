//! The report of a run, without clocks: what came in, what came out, and why what did not. Schema: `docs/report.md`.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};
use terrane_frontend::pairs::PairReport;
use terrane_fusion::adjust::AdjustReport;
use terrane_fusion::align::SeamEvidence;
use terrane_fusion::average::PlacedSeam;
use terrane_fusion::georegister::{EnuOrigin, GeoOutcome, GeoResidual};
use terrane_fusion::merge::MergeReport;
use terrane_fusion::seams::SeamFigures;
use terrane_mapping::MappingReport;
use terrane_scene::codec::{ArchiveWriter, Kind, read_submap_report};
use terrane_scene::{ClusterId, ImageFate, ImageId, ImageTable};
use terrane_viewgraph::{Partition, PartitionReport, ViewGraphReport};

use super::components::{AverageReport, FinalOutcome, MergeOutcome};
use super::read::{self, Sharded, TableArtefact};
use super::{Inputs, Made, encode_error};
use crate::plan::RunFigures;
use crate::task::FinishedRun;
use crate::{ArtefactKey, PipelineError, Store};

/// Everything that `report.json` says but times.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct RunReport {
    pub images: ImagesReport,
    pub inputs: InputsReport,
    pub cameras: Vec<CameraReport>,
    pub pairs: PairsReport,
    pub view_graph: ViewGraphReport,
    pub partition: PartitionReport,
    pub clusters: Vec<ClusterReport>,
    pub seams: Vec<SeamReport>,
    pub components: Vec<ComponentReport>,
    pub frame: FrameReport,
    pub nothing_reconstructed: Option<String>,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct ImagesReport {
    pub offered: u64,
    pub usable: u64,
    pub registered: u64,
    /// Path and reason, by path.
    pub left_out: Vec<LeftOutImage>,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct LeftOutImage {
    pub path: String,
    /// The stage that left it out.
    pub stage: String,
    pub reason: String,
}

/// What was read beside photographs.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct InputsReport {
    pub masks: Option<MasksReport>,
    pub database: Option<DatabaseReport>,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct MasksReport {
    pub found: u64,
    pub missing: u64,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct DatabaseReport {
    pub images: u64,
    pub without_photograph: u64,
    pub pairs: u64,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct CameraReport {
    pub name: String,
    pub focal_source: String,
    pub images: u64,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct PairsReport {
    pub chosen: u64,
    pub how: PairReport,
    pub features_per_image: f64,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct ClusterReport {
    pub cluster: u32,
    pub images: u64,
    /// Why there is no submap, when the task failed.
    pub failed: Option<String>,
    pub mapping: Option<MappingReport>,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct SeamReport {
    /// Cluster and submap of it.
    pub a: (u32, u32),
    pub b: (u32, u32),
    pub evidence: SeamEvidence,
    /// Why the seam is not used, by alignment or by the joint solve.
    pub refused: Option<String>,
    /// What the joint solve left over.
    pub placed: Option<PlacedSeam>,
    /// How far the two disagree about what they share, once placed; metres when geo-referenced.
    pub figures: Option<SeamFigures>,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct ComponentReport {
    pub images: u64,
    pub points: u64,
    pub observations: u64,
    pub mean_reprojection_error_px: f64,
    pub mean_track_length: f64,
    pub merge: MergeReport,
    pub adjust: AdjustReport,
    pub georeferenced: bool,
    /// Why not, when not.
    pub not_georeferenced: Option<String>,
    pub gps: Option<GpsReport>,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct GpsReport {
    pub positions: u64,
    pub inliers: u64,
    pub median_m: f64,
    pub rmse_m: f64,
    /// By path: camera minus satellite position, east, north, up in metres.
    pub residuals: Vec<ResidualReport>,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct ResidualReport {
    pub path: String,
    pub residual_m: [f64; 3],
    pub inlier: bool,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct FrameReport {
    /// `local east-north-up` or `arbitrary`.
    pub kind: String,
    pub origin: Option<EnuOrigin>,
    pub crs: String,
    pub height_datum: String,
}

pub(super) fn export(store: &Store, run: &FinishedRun) -> Result<Made, PipelineError> {
    let report = gather(store, run)?;
    let figures = figures(&report);
    let counts = vec![("registered", figures.registered), ("points", figures.points)];
    let mut archive = ArchiveWriter::new(Kind::Record);
    archive.json(read::FIGURES, 0, &figures).map_err(encode_error)?;
    archive.json(read::REPORT, 0, &report).map_err(encode_error)?;
    archive.json(read::FINISHED, 0, run).map_err(encode_error)?;
    Ok(Made { bytes: archive.finish(), counts })
}

fn figures(report: &RunReport) -> RunFigures {
    let observations: u64 = report.components.iter().map(|component| component.observations).sum();
    let weighted = |component: &ComponentReport| {
        component.mean_reprojection_error_px * component.observations as f64 / observations.max(1) as f64
    };
    let largest = report.components.first();
    RunFigures {
        images: report.images.offered,
        registered: report.images.registered,
        rejected: report.images.offered - report.images.usable,
        clusters: report.clusters.len() as u64,
        components: report.components.len() as u64,
        points: report.components.iter().map(|component| component.points).sum(),
        mean_reprojection_error_px: report.components.iter().map(weighted).sum(),
        georeferenced: largest.is_some_and(|component| component.georeferenced),
        gps_rmse_m: largest.and_then(|component| component.gps.as_ref()).map(|gps| gps.rmse_m),
        gps_median_m: largest.and_then(|component| component.gps.as_ref()).map(|gps| gps.median_m),
        nothing: report.nothing_reconstructed.clone(),
    }
}

fn gather(store: &Store, run: &FinishedRun) -> Result<RunReport, PipelineError> {
    let TableArtefact { table, inputs, .. } = read::table(store, &run.table)?;
    let (_, pairs) = read::pairs(store, &run.pairs)?;
    let partition = read::partition(store, &run.partition)?;
    let mut left_out = LeftOut::default();
    for (image, reason) in &pairs.rejected {
        left_out.add(*image, "features", reason);
    }
    for entry in &partition.left_out {
        left_out.add(entry.image, "partition", &entry.reason);
    }
    let clusters = clusters(store, run, &partition, &mut left_out)?;
    let mut registered = BTreeSet::new();
    let mut components = Vec::new();
    let mut figures_of_seams = Vec::new();
    for (place, component) in run.components.iter().enumerate() {
        let merge: MergeOutcome = read::record(store, &component.merge, Kind::Reconstruction, read::REPORT)?;
        figures_of_seams.extend(merge.seams);
        let adjust = super::components::adjust_report(store, &component.adjust)?;
        for image in &adjust.dropped_images {
            left_out.add(*image, "adjust", "too few observations hold it after adjustment");
        }
        let last = Sharded::open(store, &component.georegister)?;
        registered.extend(last.cameras()?.images.iter().map(|image| image.image));
        components.push(component_report(&table, merge.report, adjust, last.record(read::REPORT)?));
        debug_assert!(place < run.components.len());
    }
    let average = match &run.average {
        Some(key) => Some((read::placement(store, key)?, average_report(store, key)?)),
        None => None,
    };
    let origin = average.as_ref().and_then(|(_, report)| report.origin);
    let num_features: u64 = pairs.num_features.iter().map(|count| u64::from(*count)).sum();
    Ok(RunReport {
        images: images_report(&table, &registered, &left_out),
        inputs: inputs_report(&table, &inputs),
        cameras: cameras_report(&table),
        pairs: PairsReport {
            chosen: pairs.num_pairs,
            how: pairs.report,
            features_per_image: num_features as f64 / pairs.num_features.len().max(1) as f64,
        },
        view_graph: read::record(store, &run.view_graph, Kind::Record, read::REPORT)?,
        nothing_reconstructed: nothing(&components, pairs.num_pairs, &clusters),
        frame: frame_report(&components, origin),
        seams: average
            .map(|(placement, report)| seams(placement.seams, report, figures_of_seams))
            .unwrap_or_default(),
        partition: partition.report,
        clusters,
        components,
    })
}

/// The first reason for each image, in the order of the stages.
#[derive(Default)]
struct LeftOut(BTreeMap<ImageId, (&'static str, String)>);

impl LeftOut {
    fn add(&mut self, image: ImageId, stage: &'static str, reason: &str) {
        self.0.entry(image).or_insert_with(|| (stage, reason.to_owned()));
    }
}

fn clusters(
    store: &Store,
    run: &FinishedRun,
    partition: &Partition,
    left_out: &mut LeftOut,
) -> Result<Vec<ClusterReport>, PipelineError> {
    let size = |cluster: ClusterId| {
        partition.clusters.get(cluster.index()).map_or(0, |found| found.images.len() as u64)
    };
    let mut reports = Vec::new();
    for (cluster, key) in &run.submaps {
        let source = read::StoredArtefact::new(store, key)?;
        let (fates, mapping) =
            read_submap_report::<MappingReport>(source).map_err(read::scene_error(*key))?;
        for (image, fate) in &fates {
            if let ImageFate::LeftOut { reason } = fate {
                left_out.add(*image, "submap", reason);
            }
        }
        let images = size(*cluster);
        reports.push(ClusterReport { cluster: cluster.0, images, failed: None, mapping: Some(mapping) });
    }
    for (cluster, reason) in &run.lost_clusters {
        for image in partition.clusters.get(cluster.index()).map_or(&[][..], |found| &found.images) {
            left_out.add(*image, "submap", &format!("its cluster could not be mapped: {reason}"));
        }
        let images = size(*cluster);
        reports.push(ClusterReport {
            cluster: cluster.0,
            images,
            failed: Some(reason.clone()),
            mapping: None,
        });
    }
    reports.sort_by_key(|report| report.cluster);
    Ok(reports)
}

fn average_report(store: &Store, key: &ArtefactKey) -> Result<AverageReport, PipelineError> {
    read::record(store, key, Kind::Reconstruction, read::REPORT)
}

fn images_report(table: &ImageTable, registered: &BTreeSet<ImageId>, left_out: &LeftOut) -> ImagesReport {
    let mut entries: Vec<LeftOutImage> = table
        .rejected
        .iter()
        .map(|file| LeftOutImage {
            path: file.path.clone(),
            stage: "ingest".to_owned(),
            reason: file.reason.clone(),
        })
        .collect();
    for image in table.ids().filter(|image| !registered.contains(image)) {
        let (stage, reason) = match left_out.0.get(&image) {
            Some((stage, reason)) => (*stage, reason.clone()),
            None => ("merge", "no component that was kept holds it".to_owned()),
        };
        entries.push(LeftOutImage { path: table.image(image).path.clone(), stage: stage.to_owned(), reason });
    }
    entries.sort_by(|a, b| a.path.cmp(&b.path));
    ImagesReport {
        offered: (table.images.len() + table.rejected.len()) as u64,
        usable: table.images.len() as u64,
        registered: registered.len() as u64,
        left_out: entries,
    }
}

fn inputs_report(table: &ImageTable, inputs: &Inputs) -> InputsReport {
    let without_photograph = table.images.iter().filter(|image| image.content_hash.is_empty()).count() as u64;
    InputsReport {
        masks: inputs.count_masks().map(|(found, missing)| MasksReport { found, missing }),
        database: inputs.imported.as_ref().map(|imported| DatabaseReport {
            images: imported.images.len() as u64,
            without_photograph,
            pairs: imported.num_pairs,
        }),
    }
}

fn cameras_report(table: &ImageTable) -> Vec<CameraReport> {
    let mut reports: Vec<CameraReport> = table
        .cameras
        .iter()
        .map(|camera| CameraReport {
            name: camera.name.clone(),
            focal_source: format!("{:?}", camera.focal_source).to_lowercase(),
            images: 0,
        })
        .collect();
    for image in &table.images {
        if let Some(report) = reports.get_mut(image.camera.index()) {
            report.images += 1;
        }
    }
    reports
}

fn component_report(
    table: &ImageTable,
    merge: MergeReport,
    adjust: AdjustReport,
    last: FinalOutcome,
) -> ComponentReport {
    let path =
        |residual: &GeoResidual| table.images.get(residual.image.index()).map_or("", |image| &image.path);
    let (gps, why_not) = match last.geo {
        GeoOutcome::Registered { report, .. } => {
            let residuals = report.residuals.iter().map(|residual| ResidualReport {
                path: path(residual).to_owned(),
                residual_m: residual.residual_m.into(),
                inlier: residual.inlier,
            });
            let gps = GpsReport {
                positions: u64::from(report.num_positions),
                inliers: u64::from(report.num_inliers),
                median_m: report.median_m,
                rmse_m: report.rmse_m,
                residuals: residuals.collect(),
            };
            (Some(gps), None)
        }
        GeoOutcome::NotRegistered { reason, .. } => (None, Some(reason)),
    };
    ComponentReport {
        images: last.images,
        points: last.points,
        observations: last.observations,
        mean_reprojection_error_px: last.mean_reprojection_error_px,
        mean_track_length: last.mean_track_length,
        merge,
        adjust,
        georeferenced: gps.is_some(),
        not_georeferenced: why_not,
        gps,
    }
}

fn seams(
    placed: Vec<PlacedSeam>,
    average: AverageReport,
    figures: Vec<(u32, u32, SeamFigures)>,
) -> Vec<SeamReport> {
    let name = |submap: u32| average.submaps.get(submap as usize).copied().unwrap_or_default();
    let mut placed: Vec<Option<PlacedSeam>> = placed.into_iter().map(Some).collect();
    placed.resize(average.seams.len(), None);
    let figures_of: BTreeMap<(u32, u32), SeamFigures> =
        figures.into_iter().map(|(a, b, entry)| ((a, b), entry)).collect();
    let mut reports = Vec::new();
    for (seam, placed) in average.seams.iter().zip(placed) {
        let by_alignment = match &seam.outcome.verdict {
            terrane_fusion::align::SeamVerdict::Refused { reason } => Some(reason.clone()),
            terrane_fusion::align::SeamVerdict::Accepted { .. } => None,
        };
        let by_placement = placed.as_ref().and_then(|placed| placed.refused.clone());
        reports.push(SeamReport {
            a: name(seam.a),
            b: name(seam.b),
            evidence: seam.outcome.evidence.clone(),
            refused: by_alignment.or(by_placement),
            placed,
            figures: figures_of.get(&(seam.a, seam.b)).cloned(),
        });
    }
    reports
}

fn frame_report(components: &[ComponentReport], origin: Option<EnuOrigin>) -> FrameReport {
    if components.first().is_some_and(|component| component.georeferenced) {
        FrameReport {
            kind: "local east-north-up".to_owned(),
            origin,
            crs: "metres east, north and up of the origin, which is on WGS 84 (EPSG:4979)".to_owned(),
            height_datum: "as in EXIF, unknown".to_owned(),
        }
    } else {
        FrameReport {
            kind: "arbitrary".to_owned(),
            origin: None,
            crs: "none: frame and scale are arbitrary".to_owned(),
            height_datum: "none".to_owned(),
        }
    }
}

fn nothing(components: &[ComponentReport], num_pairs: u64, clusters: &[ClusterReport]) -> Option<String> {
    if components.iter().any(|component| component.images > 0) {
        return None;
    }
    let why = if num_pairs == 0 {
        "no two photographs could be compared: at least two with features are needed"
    } else if clusters.is_empty() {
        "no group of photographs shows the same things: check that they overlap"
    } else {
        "the photographs overlap too little, or were all taken from one place: report.json has the reason for each"
    };
    Some(format!("nothing could be reconstructed: {why}"))
}
