//! The order of things: seams, then the whole in rounds, then what nothing holds.

use terrane_optim::Loss;
use terrane_optim::bundle::{self, BundleOptions, BundleReport};
use terrane_scene::{ImageId, ScenePoint};

use super::problem::{AdjustShards, PoseIndex};
use super::{AdjustInput, AdjustOptions, AdjustReport, AdjustRound, MergedShards, filter, problem, seam};
use crate::FusionError;
use crate::merge::{MergedCameras, MergedShard};

/// An image with fewer observations after the last round is left out: nothing holds it.
const MIN_SUPPORT: u64 = 8;

/// Adjusts a merged component in place: the cameras of each seam with all others held (as Fang et al. 2019 and
/// others do by levels), then everything together in rounds of bundle adjustment and filtering.
///
/// Satellite positions hold the world frame as weak priors. Without them the frame is that of the start.
///
/// # Errors
/// When a shard can't be loaded or stored, or the shards contradict the cameras.
pub fn adjust(
    cameras: &mut MergedCameras,
    shards: &mut dyn MergedShards,
    input: &AdjustInput<'_>,
    options: &AdjustOptions,
) -> Result<AdjustReport, FusionError> {
    check(cameras)?;
    let mut report = AdjustReport::default();
    let mut figures = filter::measure(cameras, shards)?;
    report.initial_mean_error_px = figures.mean_error_px();
    if options.seams_first {
        adjust_seams(cameras, shards, input, options, &mut report)?;
        figures = filter::measure(cameras, shards)?;
    }
    let bundle_options = bundle_options(options, options.round_iterations);
    for round in 1..=options.rounds.max(1) {
        let mut problem = problem::camera_problem(cameras, input.fixed_intrinsics);
        if options.use_positions {
            problem.priors.positions = problem::priors_for(cameras, input, figures.mean_error_px());
            report.num_positions = problem.priors.positions.len() as u32;
        }
        let index = PoseIndex::new(&cameras.images);
        let mut adapter = AdjustShards { inner: &mut *shards, index: &index };
        let solved =
            bundle::solve(&mut problem, &mut adapter, &bundle_options).map_err(FusionError::adjustment)?;
        problem::take_over(&problem, cameras);
        figures = filter::filter(cameras, shards, options)?;
        let before = figures.observations + figures.dropped_observations;
        let mut entry = round_of(format!("whole {round}"), &solved);
        entry.num_dropped_observations = figures.dropped_observations;
        entry.num_dropped_points = figures.dropped_points;
        report.rounds.push(entry);
        if figures.dropped_observations * 1000 < before && solved.termination.converged() {
            break;
        }
    }
    report.dropped_images = drop_unsupported(cameras, shards)?;
    figures = filter::measure(cameras, shards)?;
    report.mean_error_px = figures.mean_error_px();
    report.num_points = figures.points;
    report.num_observations = figures.observations;
    Ok(report)
}

/// The cameras of every seam, one seam after another.
fn adjust_seams(
    cameras: &mut MergedCameras,
    shards: &mut dyn MergedShards,
    input: &AdjustInput<'_>,
    options: &AdjustOptions,
    report: &mut AdjustReport,
) -> Result<(), FusionError> {
    let bundle_options = bundle_options(options, options.seam_iterations);
    for (number, images) in input.seams.iter().enumerate() {
        let mut free = images.clone();
        free.sort_unstable();
        if let Some(solved) = seam::adjust_seam(cameras, shards, &free, &bundle_options)? {
            report.rounds.push(round_of(format!("seam {number}"), &solved));
        }
    }
    Ok(())
}

fn bundle_options(options: &AdjustOptions, max_iterations: u32) -> BundleOptions {
    BundleOptions {
        loss: Loss::SoftL1,
        loss_scale_px: options.loss_scale_px,
        prior_loss: Loss::Huber,
        max_iterations,
        ..Default::default()
    }
}

fn round_of(name: String, solved: &BundleReport) -> AdjustRound {
    AdjustRound {
        name,
        initial_cost: solved.initial_cost,
        final_cost: solved.final_cost,
        iterations: solved.iterations,
        termination: format!("{:?}", solved.termination),
        num_dropped_observations: 0,
        num_dropped_points: 0,
    }
}

/// Cameras must ascend, and every image's camera must be there.
fn check(cameras: &MergedCameras) -> Result<(), FusionError> {
    if !cameras.images.is_sorted_by_key(|image| image.image)
        || !cameras.cameras.is_sorted_by_key(|entry| entry.0)
    {
        return Err(FusionError::invalid("the camera table", "cameras and images must ascend by id"));
    }
    for image in &cameras.images {
        if cameras.cameras.binary_search_by_key(&image.camera, |entry| entry.0).is_err() {
            let reason =
                format!("image {} was taken by camera {}, which is not there", image.image, image.camera);
            return Err(FusionError::invalid("the camera table", reason));
        }
    }
    Ok(())
}

/// Leaves out images with too few observations, and those observations; returns the images.
fn drop_unsupported(
    cameras: &mut MergedCameras,
    shards: &mut dyn MergedShards,
) -> Result<Vec<ImageId>, FusionError> {
    let support = filter::support(cameras, shards)?;
    let weak: Vec<ImageId> = cameras
        .images
        .iter()
        .zip(&support)
        .filter(|(_, count)| **count < MIN_SUPPORT)
        .map(|(image, _)| image.image)
        .collect();
    if weak.is_empty() {
        return Ok(weak);
    }
    cameras.images.retain(|image| weak.binary_search(&image.image).is_err());
    for shard in 0..shards.len() {
        let merged = shards.load(shard)?;
        let mut kept = MergedShard::default();
        for point in &merged.points {
            let first_observation = kept.observations.len() as u64;
            let stays = merged.track(point).iter().filter(|seen| weak.binary_search(&seen.image).is_err());
            kept.observations.extend(stays);
            let count = kept.observations.len() as u64 - first_observation;
            if count >= 2 {
                kept.points.push(ScenePoint { first_observation, num_observations: count as u32, ..*point });
            } else {
                kept.observations.truncate(first_observation as usize);
            }
        }
        drop(merged);
        shards.store(shard, kept)?;
    }
    Ok(weak)
}
