//! From verified pairs to the view graph: rotations averaged over the whole, what disagrees left out.

use std::collections::BTreeSet;

use nalgebra::UnitQuaternion;
use terrane_optim::rotation_averaging::{self, RelativeRotation, RotationAveragingOptions};
use terrane_scene::{ImagePair, PairKind, PairSummary};

use crate::{DropReason, DroppedEdge, ViewEdge, ViewGraph, ViewGraphOptions, ViewGraphReport, components::components};

/// Averagings: the second judges every edge by rotations that the dropped ones have no part in.
const NUM_AVERAGINGS: usize = 2;

impl ViewGraph {
    /// Builds the graph of `num_images` images from the summaries of their verified pairs, in any order.
    ///
    /// The rotations of all pairs are averaged robustly, each connected component for itself (Chatterjee & Govindu
    /// 2013); pairs that disagree with the result are dropped. Panoramic pairs take part in the averaging and are
    /// no edges; pairs without a rotation are edges that could not be checked.
    pub fn build(num_images: u32, summaries: &[PairSummary], options: &ViewGraphOptions) -> (Self, ViewGraphReport) {
        let mut report = ViewGraphReport { num_pairs: summaries.len() as u32, ..Default::default() };
        let usable = usable_pairs(num_images, summaries, options, &mut report.dropped);
        let (rotations, errors) = average(num_images, &usable, options);
        let mut edges = Vec::new();
        let mut kept_errors = Vec::new();
        for (summary, error_deg) in usable.iter().zip(&errors) {
            match drop_reason(summary, *error_deg, options) {
                Some(reason) => report.dropped.push(DroppedEdge { pair: summary.pair, reason }),
                None => {
                    kept_errors.extend(*error_deg);
                    report.num_unchecked += u32::from(error_deg.is_none());
                    edges.push(edge(summary, options));
                }
            }
        }
        report.dropped.sort_by_key(|dropped| dropped.pair);
        let graph = Self { num_images, edges, rotations };
        report.num_edges = graph.edges.len() as u32;
        kept_errors.sort_by(f64::total_cmp);
        report.median_rotation_error_deg = kept_errors.get(kept_errors.len() / 2).copied().unwrap_or(0.0);
        let pairs = graph.edges.iter().map(|edge| (edge.pair.first().0, edge.pair.second().0));
        let sizes = components(num_images as usize, pairs).into_iter().map(|members| members.len() as u32);
        let (single, several): (Vec<u32>, Vec<u32>) = sizes.partition(|size| *size == 1);
        report.num_isolated = single.len() as u32;
        report.component_sizes = several;
        (graph, report)
    }
}

/// Pairs that may say something about rotations, ascending, each once; the others are dropped.
fn usable_pairs<'a>(
    num_images: u32,
    summaries: &'a [PairSummary],
    options: &ViewGraphOptions,
    dropped: &mut Vec<DroppedEdge>,
) -> Vec<&'a PairSummary> {
    let mut sorted: Vec<&PairSummary> = summaries.iter().collect();
    sorted.sort_by_key(|summary| (summary.pair, std::cmp::Reverse(summary.num_inliers)));
    let mut seen: BTreeSet<ImagePair> = BTreeSet::new();
    let mut usable = Vec::new();
    for summary in sorted {
        let reason = if summary.kind == PairKind::Watermark {
            Some(DropReason::Watermark)
        } else if summary.num_inliers < options.min_inliers {
            Some(DropReason::FewInliers { num_inliers: summary.num_inliers })
        } else if !is_valid(summary, num_images) || !seen.insert(summary.pair) {
            Some(DropReason::Invalid)
        } else {
            None
        };
        match reason {
            Some(reason) => dropped.push(DroppedEdge { pair: summary.pair, reason }),
            None => usable.push(summary),
        }
    }
    usable
}

fn is_valid(summary: &PairSummary, num_images: u32) -> bool {
    let rotation_is_finite = summary
        .second_from_first
        .is_none_or(|pose| pose.rotation.coords.iter().all(|value| value.is_finite()));
    summary.pair.second().0 < num_images && summary.median_angle_rad.is_finite() && rotation_is_finite
}

/// Averaged rotations, and each pair's disagreement with them in degrees (`None` without a rotation).
fn average(
    num_images: u32,
    pairs: &[&PairSummary],
    options: &ViewGraphOptions,
) -> (Vec<Option<UnitQuaternion<f64>>>, Vec<Option<f64>>) {
    let mut rotations = vec![None; num_images as usize];
    let mut errors: Vec<Option<f64>> = vec![Some(0.0); pairs.len()];
    for _ in 0..NUM_AVERAGINGS {
        let relative: Vec<RelativeRotation> = pairs
            .iter()
            .zip(&errors)
            .filter(|(_, error_deg)| error_deg.is_some_and(|error| error <= options.max_rotation_error_deg))
            .filter_map(|(summary, _)| relative_rotation(summary))
            .collect();
        rotations =
            rotation_averaging::average(num_images as usize, &relative, &RotationAveragingOptions::default())
                .rotations;
        errors = pairs.iter().map(|summary| error_deg(summary, &rotations)).collect();
    }
    (rotations, errors)
}

fn relative_rotation(summary: &PairSummary) -> Option<RelativeRotation> {
    let second_from_first = summary.second_from_first?;
    Some(RelativeRotation {
        from: summary.pair.first().0,
        to: summary.pair.second().0,
        to_from_from: second_from_first.rotation,
        weight: f64::from(summary.num_inliers).sqrt(),
    })
}

/// `None` when the pair has no rotation, or its images lie in components that only dropped pairs join.
fn error_deg(summary: &PairSummary, rotations: &[Option<UnitQuaternion<f64>>]) -> Option<f64> {
    let measured = summary.second_from_first?.rotation;
    let first = rotations[summary.pair.first().index()]?;
    let second = rotations[summary.pair.second().index()]?;
    Some((second * first.inverse()).angle_to(&measured).to_degrees())
}

fn drop_reason(summary: &PairSummary, error_deg: Option<f64>, options: &ViewGraphOptions) -> Option<DropReason> {
    match error_deg {
        Some(error_deg) if error_deg > options.max_rotation_error_deg => {
            Some(DropReason::RotationDisagrees { error_deg })
        }
        _ if !summary.kind.has_baseline() => Some(DropReason::NoBaseline),
        _ => None,
    }
}

/// Weight: inliers (the strength of two views), fewer for narrow angles (whose depth is uncertain).
fn edge(summary: &PairSummary, options: &ViewGraphOptions) -> ViewEdge {
    let full_rad = options.full_weight_angle_deg.max(f64::EPSILON).to_radians();
    let by_angle = (summary.median_angle_rad / full_rad).clamp(0.1, 1.0);
    ViewEdge {
        pair: summary.pair,
        kind: summary.kind,
        num_inliers: summary.num_inliers,
        median_angle_rad: summary.median_angle_rad,
        weight: f64::from(summary.num_inliers.max(1)) * by_angle,
    }
}

#[cfg(test)]
mod tests;
