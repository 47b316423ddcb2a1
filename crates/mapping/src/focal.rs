//! Focal lengths of cameras of which nothing is known, from the fundamental matrices of their pairs.
//!
//! With the right focal length `f`, `K(f)ᵀ F K(f)` has two equal singular values (Huang & Faugeras 1989; Mendonça &
//! Cipolla 1999). One pair alone is often degenerate, many together vote.

use nalgebra::{Matrix3, Vector2};
use rayon::prelude::*;
use terrane_geometry::ransac::RansacOptions;
use terrane_geometry::{Camera, Seed, two_view};
use terrane_scene::{FocalSource, PairKind};

use crate::cluster::Cluster;

/// Pairs that vote, those with most matches first.
const MAX_PAIRS: usize = 40;
/// Fewest matches of a pair that votes.
const MIN_MATCHES: usize = 50;
/// Focal lengths that are looked at: from 0.4 to 4 times the longer side, in steps of about one per cent.
const NUM_FOCALS: usize = 231;
const LEAST_RATIO: f64 = 0.4;
const MOST_RATIO: f64 = 4.0;
/// Difference of the singular values, as a share of the larger, beyond which a pair does not support a focal length.
const TOLERANCE: f64 = 0.03;

/// Intrinsics to start from, and for each camera whether its focal length is still a mere guess.
pub(crate) fn initial_cameras(cluster: &Cluster<'_>, seed: Seed) -> (Vec<Camera>, Vec<bool>) {
    let mut cameras: Vec<Camera> = cluster.cameras.iter().map(|(_, record)| record.camera).collect();
    let mut guessed = vec![false; cameras.len()];
    for (at, (_, record)) in cluster.cameras.iter().enumerate() {
        // Fundamental matrices are those of perspective cameras.
        if record.focal_source != FocalSource::Guess || !record.camera.model.is_perspective() {
            continue;
        }
        guessed[at] = true;
        if let Some(focal_px) = vote(cluster, at, seed.derive("focal").item(&[at as u64])) {
            let num_focal = record.camera.model.num_focal();
            cameras[at].params_mut()[..num_focal].fill(focal_px);
            guessed[at] = false;
        }
    }
    (cameras, guessed)
}

/// The focal length that most pairs of a camera support, or `None` when too few are telling.
fn vote(cluster: &Cluster<'_>, camera: usize, seed: Seed) -> Option<f64> {
    let mut pairs: Vec<usize> = (0..cluster.pairs.len())
        .filter(|&at| {
            let pair = &cluster.pairs[at];
            let telling = matches!(pair.source.summary.kind, PairKind::Calibrated | PairKind::Uncalibrated);
            let own = cluster.camera_of[pair.first] == camera && cluster.camera_of[pair.second] == camera;
            telling && own && pair.source.matches.len() >= MIN_MATCHES
        })
        .collect();
    pairs.sort_by_key(|&at| std::cmp::Reverse(cluster.pairs[at].source.matches.len()));
    pairs.truncate(MAX_PAIRS);
    let ballots: Vec<Option<Vec<f64>>> = pairs
        .par_iter()
        .map(|&at| ballot(cluster, at, &cluster.cameras[camera].1.camera, seed.item(&[at as u64])))
        .collect();
    let ballots: Vec<Vec<f64>> = ballots.into_iter().flatten().collect();
    if ballots.len() < 3 {
        return None;
    }
    let totals: Vec<f64> = (0..NUM_FOCALS).map(|k| ballots.iter().map(|ballot| ballot[k]).sum()).collect();
    let best = (0..NUM_FOCALS).max_by(|&a, &b| totals[a].total_cmp(&totals[b]).then(b.cmp(&a)))?;
    let at_edge = best == 0 || best == NUM_FOCALS - 1;
    let supported = totals[best] >= 0.25 * ballots.len() as f64;
    (supported && !at_edge).then(|| longer_side_px(&cluster.cameras[camera].1.camera) * ratio(best))
}

fn longer_side_px(camera: &Camera) -> f64 {
    f64::from(camera.width_px.max(camera.height_px))
}

fn ratio(step: usize) -> f64 {
    LEAST_RATIO * (MOST_RATIO / LEAST_RATIO).powf(step as f64 / (NUM_FOCALS - 1) as f64)
}

/// How well a pair supports each focal length, within [0, 1]; `None` when it does not tell them apart.
fn ballot(cluster: &Cluster<'_>, at: usize, camera: &Camera, seed: Seed) -> Option<Vec<f64>> {
    let center = camera.principal_point_px();
    let (first, second): (Vec<Vector2<f64>>, Vec<Vector2<f64>>) = cluster
        .matches(&cluster.pairs[at])
        .map(|(a, b)| (cluster.xy_px(a) - center, cluster.xy_px(b) - center))
        .unzip();
    let ransac = RansacOptions { max_iterations: 2000, ..RansacOptions::default() };
    let found = two_view::estimate_fundamental(&first, &second, 3.0, &ransac, seed)?;
    let support: Vec<f64> = (0..NUM_FOCALS)
        .map(|step| {
            let focal_px = longer_side_px(camera) * ratio(step);
            let k = Matrix3::from_diagonal(&nalgebra::Vector3::new(focal_px, focal_px, 1.0));
            let mut values = (k * found.model * k).singular_values();
            values.as_mut_slice().sort_unstable_by(|a, b| b.total_cmp(a));
            let gap = (values[0] - values[1]) / values[0];
            if gap.is_finite() { (-(gap / TOLERANCE).powi(2)).exp() } else { 0.0 }
        })
        .collect();
    // Axes that meet or are parallel make every focal length fit.
    let mean = support.iter().sum::<f64>() / NUM_FOCALS as f64;
    (mean < 0.5).then_some(support)
}
