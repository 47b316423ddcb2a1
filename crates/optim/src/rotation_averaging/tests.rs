//! Rotations recovered from relative ones, with noise, outliers and several components.

use rand::RngExt;
use terrane_geometry::Seed;

use super::*;

struct Graph {
    truth: Vec<UnitQuaternion<f64>>,
    edges: Vec<RelativeRotation>,
    outlier: Vec<bool>,
}

fn vector(rng: &mut rand_pcg::Pcg64Mcg, size: f64) -> Vector3<f64> {
    Vector3::from_fn(|_, _| (0..12).map(|_| rng.random_range(-0.5..0.5)).sum::<f64>()) * size
}

/// A band graph of random rotations.
fn graph(nodes: usize, noise_rad: f64, outliers: f64, seed: u64) -> Graph {
    let mut rng = Seed(seed).rng();
    let truth: Vec<_> = (0..nodes).map(|_| so3::exp(&vector(&mut rng, 1.5))).collect();
    let (mut edges, mut outlier) = (Vec::new(), Vec::new());
    for from in 0..nodes {
        for to in from + 1..(from + 8).min(nodes) {
            let wrong = rng.random_range(0.0..1.0) < outliers;
            let noise =
                if wrong { so3::exp(&vector(&mut rng, 1.5)) } else { so3::exp(&vector(&mut rng, noise_rad)) };
            let to_from_from = noise * truth[to] * truth[from].inverse();
            edges.push(RelativeRotation { from: from as u32, to: to as u32, to_from_from, weight: 1.0 });
            outlier.push(wrong);
        }
    }
    Graph { truth, edges, outlier }
}

/// Errors against truth after the best common rotation, sorted.
fn errors(found: &[UnitQuaternion<f64>], truth: &[UnitQuaternion<f64>]) -> Vec<f64> {
    let turns: Vec<_> = found.iter().zip(truth).map(|(f, t)| t.inverse() * f).collect();
    let mut mean = turns[0];
    for _ in 0..10 {
        let step =
            turns.iter().map(|t| so3::log(&(mean.inverse() * t))).sum::<Vector3<f64>>() / turns.len() as f64;
        mean *= so3::exp(&step);
    }
    let mut errors: Vec<f64> = turns.iter().map(|t| t.angle_to(&mean)).collect();
    errors.sort_by(f64::total_cmp);
    errors
}

#[test]
fn truth_is_found_among_outliers() {
    let noise = 0.5f64.to_radians();
    let Graph { truth, edges, outlier } = graph(120, noise, 0.2, 5);
    let averages = average(120, &edges, &RotationAveragingOptions::default());
    assert!(averages.report.converged, "{:?}", averages.report);
    let found: Vec<_> = averages.rotations.iter().map(|r| r.unwrap()).collect();
    let errors = errors(&found, &truth);
    let (median, worst) = (errors[60], errors[119]);
    assert!(median > 0.1 * noise && median < 5.0 * noise && worst < 12.0 * noise, "{median} {worst}");
    for (i, wrong) in outlier.iter().enumerate() {
        if averages.edge_error_rad[i] > 0.2 {
            assert!(*wrong && averages.edge_weight[i] < 0.1, "edge {i}");
        }
    }
    assert!((0.3 * noise..6.0 * noise).contains(&averages.report.median_error_rad));
}

#[test]
fn perfect_edges_give_the_truth_in_every_component() {
    let Graph { truth, mut edges, .. } = graph(60, 0.0, 0.0, 6);
    edges.retain(|e| (e.from < 40) == (e.to < 40));
    let averages = average(61, &edges, &RotationAveragingOptions::default());
    assert_eq!(averages.report.num_components, 2);
    assert!(averages.rotations[60].is_none());
    assert!(
        averages.component[..40].iter().all(|c| *c == 0)
            && averages.component[40..60].iter().all(|c| *c == 1)
    );
    for range in [0..40, 40..60] {
        let found: Vec<_> = averages.rotations[range.clone()].iter().map(|r| r.unwrap()).collect();
        assert!(errors(&found, &truth[range]).last().unwrap() < &1e-7);
    }
}

#[test]
fn unusable_edges_are_ignored_and_named() {
    let Graph { mut edges, .. } = graph(10, 0.0, 0.0, 7);
    let good = edges.len() as u32;
    let nan = UnitQuaternion::new_unchecked(nalgebra::Quaternion::new(f64::NAN, 0.0, 0.0, 0.0));
    edges.push(RelativeRotation { to: 99, ..edges[0] });
    edges.push(RelativeRotation { from: 3, to: 3, ..edges[0] });
    edges.push(RelativeRotation { to_from_from: nan, ..edges[0] });
    edges.push(RelativeRotation { weight: 0.0, ..edges[0] });
    let averages = average(10, &edges, &RotationAveragingOptions::default());
    assert_eq!(averages.report.ignored_edges, [good, good + 1, good + 2, good + 3]);
    assert!(averages.edge_error_rad[good as usize].is_nan());
    assert!(averages.rotations.iter().all(Option::is_some));
    let empty = average(0, &[], &RotationAveragingOptions::default());
    assert!(empty.rotations.is_empty());
    let lonely = average(2, &[], &RotationAveragingOptions::default());
    assert_eq!(lonely.rotations, [None, None]);
}
