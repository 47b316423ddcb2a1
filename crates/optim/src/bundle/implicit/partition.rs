//! A problem cut into parts, before anybody holds them.

use super::super::layout::Cameras;
use super::super::plan::Dropped;
use super::super::{BundleError, BundleOptions, BundleProblem, BundleReport, Shards};
use super::clusters::{Parted, Views, make_parts};
use super::part::Part;
use super::worker::CameraSide;

/// A problem cut into parts.
pub struct Partition {
    /// The camera side, with the clusters.
    pub side: CameraSide,
    /// One part for each cluster.
    pub parts: Vec<Part>,
    /// Shard and index of each point of each part.
    pub origins: Vec<Vec<(u32, u32)>>,
    /// What takes part and what is left out; the rest is zero.
    pub report: BundleReport,
}

/// Cuts a problem into parts: reads every shard three times, the observations of one at a time beside the parts.
///
/// Observations whose point starts behind the camera and points seen fewer than twice are left out.
///
/// # Errors
/// When the problem, the options or a shard are not valid, or a shard can't be read.
pub fn partition(
    problem: &BundleProblem,
    shards: &dyn Shards,
    options: &BundleOptions,
) -> Result<Partition, BundleError> {
    problem.validate()?;
    options.validate()?;
    let cameras = Cameras::of(problem);
    let num_poses = problem.poses.len();
    let mut report = BundleReport::empty();
    let mut views = Views::new(num_poses);
    let mut dropped = Vec::with_capacity(shards.len());
    for index in 0..shards.len() {
        let shard = shards.load(index)?;
        shard.validate(index, num_poses)?;
        let out = Dropped::find(&shard, problem, &cameras, options.behind_camera);
        let mut skip = out.observations.iter().copied().peekable();
        let mut last = None;
        for (i, o) in shard.observations.iter().enumerate() {
            if skip.next_if_eq(&(i as u32)).is_none() {
                views.add(o.pose, &shard.points[o.point as usize]);
                report.observations += 1;
                report.points += u64::from(last != Some(o.point));
                last = Some(o.point);
            }
        }
        report.behind_camera += out.behind_camera;
        report.seen_once += out.seen_once;
        dropped.push(out);
    }
    let clusters = views.cluster(problem, options.cluster_poses as usize);
    let Parted { parts, origins } = make_parts(shards, &dropped, &clusters)?;
    let side = CameraSide::new(problem.clone(), options.clone(), views.observed(), clusters);
    report.unconstrained_poses = super::super::explicit::unconstrained(problem, &side.layout, None);
    report.reduced_unknowns = side.map.num_unknowns as u64;
    report.clusters = side.clusters.count as u32;
    Ok(Partition { side, parts, origins, report })
}
