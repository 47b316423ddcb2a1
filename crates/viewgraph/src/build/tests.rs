//! Building from pairs of known rotations.

use nalgebra::Vector3;
use terrane_geometry::{Rigid3, Seed, so3};
use terrane_scene::ImageId;

use super::*;

/// Numbers within ±1 from a seed.
fn vector(seed: u64) -> Vector3<f64> {
    let one = |k: u64| (Seed(seed).item(&[k]).0 >> 11) as f64 / (1u64 << 52) as f64 - 1.0;
    Vector3::new(one(0), one(1), one(2))
}

fn rotation(image: u32) -> UnitQuaternion<f64> {
    so3::exp(&(2.0 * vector(u64::from(image))))
}

/// A pair with the true rotation, turned by `error_rad` about some axis.
fn pair(a: u32, b: u32, error_rad: f64) -> PairSummary {
    let error = so3::exp(&(vector(u64::from(a * 1000 + b)).normalize() * error_rad));
    let turn = error * rotation(b) * rotation(a).inverse();
    PairSummary {
        pair: ImagePair::new(ImageId(a), ImageId(b)).expect("two images"),
        kind: PairKind::Calibrated,
        num_inliers: 100,
        second_from_first: Some(Rigid3::new(turn, Vector3::x())),
        median_angle_rad: 0.2,
    }
}

/// Each of `count` images with the four after it, with small errors.
fn ring(count: u32) -> Vec<PairSummary> {
    let mut pairs = Vec::new();
    for a in 0..count {
        for step in 1..=4 {
            let b = (a + step) % count;
            pairs.push(pair(a.min(b), a.max(b), 0.01));
        }
    }
    pairs
}

#[test]
fn good_pairs_stay_and_wrong_rotations_go_with_their_error() {
    let mut pairs = ring(40);
    for at in [5, 50, 77, 120] {
        let (a, b) = (pairs[at].pair.first().0, pairs[at].pair.second().0);
        pairs[at] = pair(a, b, 0.8);
    }
    let (graph, report) = ViewGraph::build(40, &pairs, &ViewGraphOptions::default());
    assert_eq!(graph.edges.len(), 156);
    assert_eq!(report.dropped.len(), 4);
    for dropped in &report.dropped {
        let DropReason::RotationDisagrees { error_deg } = dropped.reason else { panic!("{dropped:?}") };
        assert!((error_deg - 0.8f64.to_degrees()).abs() < 3.0, "{error_deg}");
    }
    assert!((0.05..1.0).contains(&report.median_rotation_error_deg), "{}", report.median_rotation_error_deg);
    assert_eq!(report.component_sizes, [40]);
    // The averaged rotations are the true ones but for one turn of the world.
    let turn = |image: u32| graph.rotations[image as usize].expect("averaged").inverse() * rotation(image);
    assert!((1..40).all(|image| turn(image).angle_to(&turn(0)) < 0.03));
}

#[test]
fn order_of_pairs_does_not_matter() {
    let pairs = ring(20);
    let mut turned = pairs.clone();
    turned.reverse();
    let options = ViewGraphOptions::default();
    assert_eq!(ViewGraph::build(20, &pairs, &options), ViewGraph::build(20, &turned, &options));
}

#[test]
fn pairs_that_cannot_position_are_dropped_by_name() {
    let mut pairs = ring(20);
    pairs[0].kind = PairKind::Watermark;
    pairs[1].kind = PairKind::Panoramic;
    pairs[2].num_inliers = 9;
    pairs.push(pair(3, 99, 0.0));
    pairs.push(pairs[10].clone());
    let mut unchecked = pair(0, 10, 0.0);
    unchecked.second_from_first = None;
    unchecked.kind = PairKind::Uncalibrated;
    pairs.push(unchecked);
    let (graph, report) = ViewGraph::build(20, &pairs, &ViewGraphOptions::default());
    let count =
        |wanted: &dyn Fn(&DropReason) -> bool| report.dropped.iter().filter(|d| wanted(&d.reason)).count();
    assert_eq!(count(&|reason| *reason == DropReason::Watermark), 1);
    assert_eq!(count(&|reason| *reason == DropReason::NoBaseline), 1);
    assert_eq!(count(&|reason| *reason == DropReason::FewInliers { num_inliers: 9 }), 1);
    assert_eq!(count(&|reason| *reason == DropReason::Invalid), 2);
    assert_eq!(report.num_unchecked, 1);
    assert_eq!(graph.edges.len(), 80 - 3 + 1);
    assert!(graph.edges.windows(2).all(|pair| pair[0].pair < pair[1].pair));
}

#[test]
fn components_have_gauges_of_their_own_and_edges_between_them_are_checked_by_what_they_are() {
    // Two rings of ten, joined by nothing.
    let mut pairs = ring(10);
    pairs.extend(
        ring(10).iter().map(|summary| pair(summary.pair.first().0 + 10, summary.pair.second().0 + 10, 0.01)),
    );
    let (graph, report) = ViewGraph::build(22, &pairs, &ViewGraphOptions::default());
    assert_eq!(graph.edges.len(), pairs.len());
    assert_eq!(report.component_sizes, [10, 10]);
    assert_eq!(report.num_isolated, 2);
    assert!(graph.rotations[20].is_none());
}

#[test]
fn narrow_pairs_weigh_less() {
    let mut narrow = pair(0, 1, 0.0);
    narrow.median_angle_rad = 1.5f64.to_radians();
    let (graph, _) = ViewGraph::build(3, &[narrow, pair(1, 2, 0.0)], &ViewGraphOptions::default());
    assert!((graph.edges[0].weight - 50.0).abs() < 1e-9 && (graph.edges[1].weight - 100.0).abs() < 1e-9);
}

#[test]
fn nothing_builds_to_nothing() {
    let (graph, report) = ViewGraph::build(0, &[], &ViewGraphOptions::default());
    assert!(graph.edges.is_empty() && report.dropped.is_empty());
    let (_, alone) = ViewGraph::build(2, &[], &ViewGraphOptions::default());
    assert_eq!(alone.num_isolated, 2);
}
