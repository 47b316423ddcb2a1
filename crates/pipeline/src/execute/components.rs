//! From submaps to final components: average, merge, adjust, geo-register.

use serde::{Deserialize, Serialize};
use terrane_fusion::adjust::{AdjustInput, AdjustReport, adjust as adjust_component};
use terrane_fusion::align::Seam;
use terrane_fusion::average::{CameraAverageReport, CameraAverages, Placement, average_cameras, place};
use terrane_fusion::georegister::{
    EnuOrigin, GeoOutcome, LocalPositions, local_positions, register, residuals,
};
use terrane_fusion::merge::{MergeReport, MergedCameras, merge as merge_submaps};
use terrane_fusion::seams::{SeamFigures, measure, seam_images};
use terrane_fusion::{FusionError, SubmapSummary};
use terrane_geometry::Sim3;
use terrane_scene::codec::{Archive, ArchiveWriter, Kind, write_reconstruction};
use terrane_scene::{CameraId, FocalSource, ImageId, ImageTable, Reconstruction};

use super::read::{self, Sharded};
use super::shards::{ShardFolder, write_sharded};
use super::{ExecutionContext, Made, encode_error};
use crate::{ArtefactKey, PipelineError, Stage, Store};

/// Links that a summary keeps of each camera: more than the neighbours that an aerial image has.
const MAX_LINKS: usize = 24;

/// What average reports beside the placement.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct AverageReport {
    /// The origin of the local frame, when any photograph has a position.
    pub origin: Option<EnuOrigin>,
    /// Every seam, by numbers of submaps.
    pub seams: Vec<Seam>,
    /// Cluster and place in it of each submap.
    pub submaps: Vec<(u32, u32)>,
    /// Camera averaging, by component.
    pub cameras: Vec<CameraAverageReport>,
}

/// What merge reports.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct MergeOutcome {
    pub report: MergeReport,
    /// How far submaps disagree, seam by seam, once placed; by numbers of submaps.
    pub seams: Vec<(u32, u32, SeamFigures)>,
}

/// What geo-registration reports.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct FinalOutcome {
    pub geo: GeoOutcome,
    pub images: u64,
    pub points: u64,
    pub observations: u64,
    pub mean_reprojection_error_px: f64,
    pub mean_track_length: f64,
}

pub(super) fn average(
    store: &Store,
    context: &ExecutionContext,
    table_key: &ArtefactKey,
    submaps: &[ArtefactKey],
    seams: &[(u32, u32, ArtefactKey)],
) -> Result<Made, PipelineError> {
    let table = context.table(store, table_key)?;
    let mut report = AverageReport::default();
    let mut summaries = Vec::new();
    let mut first_of = Vec::new();
    for key in submaps {
        context.cancel.check()?;
        let outcome = read::submap(store, key)?;
        first_of.push(summaries.len() as u32);
        for (place, submap) in outcome.submaps.iter().enumerate() {
            report.submaps.push((outcome.cluster.0, place as u32));
            summaries.push(SubmapSummary::of(&submap.reconstruction, MAX_LINKS));
        }
    }
    for (a, b, key) in seams {
        for (i, j, outcome) in read::seams(store, key)? {
            let first = |place: &u32| first_of.get(*place as usize).copied().unwrap_or_default();
            report.seams.push(Seam { a: first(a) + i, b: first(b) + j, outcome });
        }
    }
    let local = local_positions(&table);
    let positions = local.as_ref().map_or(&[][..], |local| &local.positions);
    report.origin = local.as_ref().map(|local| local.origin);
    let seed = context.config.stage_seed(Stage::Average);
    let placement = place(&summaries, &report.seams, positions, &context.config.place, seed);
    let mut archive = ArchiveWriter::new(Kind::Reconstruction);
    let mut shared = Vec::new();
    for component in 0..placement.components.len() {
        context.cancel.check()?;
        let averages = average_cameras(&summaries, &placement, component, &context.config.camera_average);
        shared.push(seam_images(&summaries, &placement, component));
        let cameras = Reconstruction { images: averages.images, ..Default::default() };
        write_reconstruction(&mut archive, component as u32, &cameras).map_err(encode_error)?;
        report.cameras.push(averages.report);
    }
    let counts = vec![
        ("submaps", summaries.len() as u64),
        ("seams", report.seams.len() as u64),
        ("components", placement.components.len() as u64),
    ];
    archive.json(read::PLACEMENT, 0, &placement).map_err(encode_error)?;
    archive.json(read::SHARED, 0, &shared).map_err(encode_error)?;
    archive.json(read::REPORT, 0, &report).map_err(encode_error)?;
    Ok(Made { bytes: archive.finish(), counts })
}

pub(super) fn merge(
    store: &Store,
    context: &ExecutionContext,
    average: &ArtefactKey,
    submaps: &[ArtefactKey],
    component: u32,
) -> Result<Made, PipelineError> {
    let placement = read::placement(store, average)?;
    let averages = camera_averages(store, average, component)?;
    let inside = |submap: usize| placement.component_of.get(submap) == Some(&component);
    let mut reconstructions = Vec::new();
    for key in submaps {
        context.cancel.check()?;
        for submap in read::submap(store, key)?.submaps {
            // Submaps of other components keep their number and lose their content.
            let keep = inside(reconstructions.len());
            reconstructions.push(if keep { submap.reconstruction } else { Reconstruction::default() });
        }
    }
    let seams = seam_figures(&reconstructions, &placement, component);
    let borrowed: Vec<&Reconstruction> = reconstructions.iter().collect();
    let merged = merge_submaps(&borrowed, &placement, &averages, component as usize, &context.config.merge);
    drop(reconstructions);
    let counts = vec![
        ("images", merged.cameras.images.len() as u64),
        ("points", merged.report.num_points),
        ("joined", merged.report.num_joined),
    ];
    let outcome = MergeOutcome { report: merged.report.clone(), seams };
    let mut archive = ArchiveWriter::new(Kind::Reconstruction);
    archive.json(read::REPORT, 0, &outcome).map_err(encode_error)?;
    write_sharded(archive, &merged.cameras, &merged.shards, counts)
}

fn seam_figures(
    submaps: &[Reconstruction],
    placement: &Placement,
    component: u32,
) -> Vec<(u32, u32, SeamFigures)> {
    let inside = |submap: u32| placement.component_of.get(submap as usize) == Some(&component);
    let seams = placement.seams.iter().filter(|seam| inside(seam.a) && inside(seam.b));
    seams
        .filter_map(|seam| {
            let (a, b) = (submaps.get(seam.a as usize)?, submaps.get(seam.b as usize)?);
            let world_from = |submap: u32| placement.world_from_submap.get(submap as usize);
            Some((seam.a, seam.b, measure(a, b, world_from(seam.a)?, world_from(seam.b)?)))
        })
        .collect()
}

fn camera_averages(
    store: &Store,
    average: &ArtefactKey,
    component: u32,
) -> Result<CameraAverages, PipelineError> {
    let source = read::StoredArtefact::new(store, average)?;
    let archive = Archive::open(source, Kind::Reconstruction).map_err(read::scene_error(*average))?;
    let cameras = terrane_scene::codec::read_reconstruction(&archive, component)
        .map_err(read::scene_error(*average))?;
    let mut report: AverageReport = archive.json(read::REPORT, 0).map_err(read::scene_error(*average))?;
    let has_report = (component as usize) < report.cameras.len();
    let report = if has_report { report.cameras.swap_remove(component as usize) } else { Default::default() };
    Ok(CameraAverages { images: cameras.images, report })
}

pub(super) fn adjust(
    store: &Store,
    context: &ExecutionContext,
    table_key: &ArtefactKey,
    (average, component): (&ArtefactKey, u32),
    merge: &ArtefactKey,
) -> Result<Made, PipelineError> {
    let table = context.table(store, table_key)?;
    let placement = read::placement(store, average)?;
    let shared: Vec<Vec<Vec<ImageId>>> = read::record(store, average, Kind::Reconstruction, read::SHARED)?;
    let georeferenced = matches!(
        placement.components.get(component as usize).map(|placed| &placed.geo),
        Some(GeoOutcome::Registered { .. })
    );
    let local = local_positions(&table).filter(|_| georeferenced);
    let fixed: Vec<CameraId> = (0..table.cameras.len())
        .map(CameraId::from_index)
        .filter(|id| table.cameras[id.index()].focal_source == FocalSource::Given)
        .collect();
    let input = AdjustInput {
        positions: local.as_ref().map_or(&[][..], |local| &local.positions),
        fixed_intrinsics: &fixed,
        seams: shared.get(component as usize).map_or(&[][..], Vec::as_slice),
    };
    let merged = Sharded::open(store, merge)?;
    let cameras = merged.cameras()?;
    let mut cameras = MergedCameras { cameras: cameras.cameras, images: cameras.images };
    let mut folder = ShardFolder::load(&merged)?;
    let report = adjust_component(&mut cameras, &mut folder, &input, &context.config.adjust)
        .map_err(|error| fusion_error(&error))?;
    let counts = vec![
        ("images", cameras.images.len() as u64),
        ("points", report.num_points),
        ("observations", report.num_observations),
    ];
    let mut archive = ArchiveWriter::new(Kind::Reconstruction);
    archive.json(read::REPORT, 0, &report).map_err(encode_error)?;
    write_sharded(archive, &cameras, &folder.into_shards()?, counts)
}

/// Storage may recover; anything else about fusion's own input is ours to answer for.
fn fusion_error(error: &FusionError) -> PipelineError {
    if error.is_storage() {
        PipelineError::storage(error.to_string())
    } else {
        PipelineError::bug(error.to_string())
    }
}

pub(super) fn georegister(
    store: &Store,
    context: &ExecutionContext,
    table_key: &ArtefactKey,
    adjusted: &ArtefactKey,
    component: u32,
) -> Result<Made, PipelineError> {
    let table = context.table(store, table_key)?;
    let sharded = Sharded::open(store, adjusted)?;
    let cameras = sharded.cameras()?;
    let mut cameras = MergedCameras { cameras: cameras.cameras, images: cameras.images };
    let local = local_positions(&table);
    let (geo, final_from_adjusted) = datum(context, &table, &cameras, local.as_ref(), component);
    for image in &mut cameras.images {
        image.cam_from_world = final_from_adjusted.transform_camera(&image.cam_from_world);
    }
    let mut outcome = FinalOutcome {
        geo,
        images: cameras.images.len() as u64,
        points: 0,
        observations: 0,
        mean_reprojection_error_px: 0.0,
        mean_track_length: 0.0,
    };
    let whole = Reconstruction {
        cameras: cameras.cameras.clone(),
        images: cameras.images.clone(),
        ..Default::default()
    };
    let mut sum_px = 0.0;
    let mut shards = Vec::new();
    for shard in 0..sharded.num_shards() {
        context.cancel.check()?;
        let mut points = sharded.shard(shard)?;
        for point in &mut points.points {
            point.x_in_world = final_from_adjusted.transform_point(&point.x_in_world);
        }
        for point in &points.points {
            let errors = points.track(point).iter();
            sum_px +=
                errors.filter_map(|seen| whole.reprojection_error_px(&point.x_in_world, seen)).sum::<f64>();
        }
        outcome.points += points.points.len() as u64;
        outcome.observations += points.observations.len() as u64;
        shards.push(super::shards::merged_shard(points));
    }
    outcome.mean_reprojection_error_px = sum_px / (outcome.observations.max(1)) as f64;
    outcome.mean_track_length = outcome.observations as f64 / outcome.points.max(1) as f64;
    let counts = vec![("images", outcome.images), ("points", outcome.points)];
    let mut archive = ArchiveWriter::new(Kind::Reconstruction);
    archive.json(read::REPORT, 0, &outcome).map_err(encode_error)?;
    write_sharded(archive, &cameras, &shards, counts)
}

/// The component's datum: what fits the satellite positions best, and the residuals in that frame.
fn datum(
    context: &ExecutionContext,
    table: &ImageTable,
    cameras: &MergedCameras,
    local: Option<&LocalPositions>,
    component: u32,
) -> (GeoOutcome, Sim3) {
    let positions = local.map_or(&[][..], |local| &local.positions);
    let seed = context.config.stage_seed(Stage::Georegister).item(&[u64::from(component)]);
    debug_assert!(positions.len() <= table.images.len());
    match register(&cameras.images, positions, &context.config.georegister, seed) {
        GeoOutcome::Registered { enu_from_local, .. } => {
            let mut moved = cameras.images.clone();
            for image in &mut moved {
                image.cam_from_world = enu_from_local.transform_camera(&image.cam_from_world);
            }
            let report = residuals(&moved, positions, &context.config.georegister);
            (GeoOutcome::Registered { enu_from_local, report }, enu_from_local)
        }
        GeoOutcome::NotRegistered { reason, frame_from_local } => {
            (GeoOutcome::NotRegistered { reason, frame_from_local }, frame_from_local)
        }
    }
}

/// What adjustment reports, for the run's report.
pub(super) fn adjust_report(store: &Store, key: &ArtefactKey) -> Result<AdjustReport, PipelineError> {
    read::record(store, key, Kind::Reconstruction, read::REPORT)
}
