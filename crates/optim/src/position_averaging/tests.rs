//! Positions recovered from directions and baselines, with outliers and gauges.

use rand::RngExt;
use terrane_geometry::Seed;

use super::*;

fn vector(rng: &mut rand_pcg::Pcg64Mcg, size: f64) -> Vector3<f64> {
    Vector3::from_fn(|_, _| (0..12).map(|_| rng.random_range(-0.5..0.5)).sum::<f64>()) * size
}

fn truth(n: usize, seed: u64) -> Vec<Vector3<f64>> {
    let mut rng = Seed(seed).rng();
    (0..n).map(|i| Vector3::new((i % 8) as f64, (i / 8) as f64, 0.0) * 5.0 + vector(&mut rng, 1.0)).collect()
}

/// The distances from truth after the best shift and scale; sorted.
fn errors(found: &[Option<Vector3<f64>>], truth: &[Vector3<f64>]) -> Vec<f64> {
    let found: Vec<_> = found.iter().map(|x| x.unwrap()).collect();
    let n = truth.len() as f64;
    let (a, b) = (found.iter().sum::<Vector3<f64>>() / n, truth.iter().sum::<Vector3<f64>>() / n);
    let dot: f64 = found.iter().zip(truth).map(|(f, t)| (f - a).dot(&(t - b))).sum();
    let scale = dot / found.iter().map(|f| (f - a).norm_squared()).sum::<f64>();
    let mut errors: Vec<f64> =
        found.iter().zip(truth).map(|(f, t)| ((f - a) * scale - (t - b)).norm()).collect();
    errors.sort_by(f64::total_cmp);
    errors
}

/// Submaps of 16 neighbours, overlapping by half, each with its own unit and shared offsets.
fn submaps(truth: &[Vector3<f64>], noise: f64, outliers: f64) -> (Vec<RelativePosition>, Vec<f64>) {
    let mut rng = Seed(3).rng();
    let (mut edges, mut scales) = (Vec::new(), Vec::new());
    for (group, start) in (0..truth.len().saturating_sub(8)).step_by(8).enumerate() {
        let scale = rng.random_range(0.3..3.0);
        scales.push(scale);
        let nodes = start..(start + 16).min(truth.len());
        for from in nodes.clone() {
            for to in from + 1..nodes.end.min(from + 5) {
                let mut offset = (truth[to] - truth[from]) / scale + vector(&mut rng, noise);
                if rng.random_range(0.0..1.0) < outliers {
                    offset = vector(&mut rng, 10.0);
                }
                edges.push(RelativePosition {
                    from: from as u32,
                    to: to as u32,
                    offset_in_world: offset,
                    group: Some(group as u32),
                    sigma: noise.max(1e-6),
                });
            }
        }
    }
    (edges, scales)
}

fn directions(truth: &[Vector3<f64>], noise_rad: f64, outliers: f64) -> Vec<RelativePosition> {
    let mut rng = Seed(9).rng();
    let mut edges = Vec::new();
    for from in 0..truth.len() {
        for to in from + 1..truth.len() {
            if (truth[to] - truth[from]).norm() < 12.0 {
                let mut offset = (truth[to] - truth[from]).normalize() + vector(&mut rng, noise_rad);
                if rng.random_range(0.0..1.0) < outliers {
                    offset = vector(&mut rng, 1.0);
                }
                let (from, to, sigma) = (from as u32, to as u32, noise_rad.max(1e-6));
                edges.push(RelativePosition { from, to, offset_in_world: offset * 3.0, group: None, sigma });
            }
        }
    }
    edges
}

#[test]
fn submaps_of_unknown_scale_are_joined() {
    let truth = truth(64, 1);
    for outliers in [0.0, 0.1] {
        let (edges, scales) = submaps(&truth, 0.02, outliers);
        let averages = average(64, &edges, &[], &PositionAveragingOptions::default());
        assert!(averages.report.converged, "{:?}", averages.report);
        let errors = errors(&averages.positions, &truth);
        assert!(errors[32] > 1e-3 && errors[63] < 0.4, "{outliers}: {} {}", errors[32], errors[63]);
        // Scales are relative to the held group's.
        let found: Vec<f64> = averages.group_scales.iter().map(|s| s.unwrap()).collect();
        for (found_scale, scale) in found.iter().zip(&scales) {
            let ratio = (found_scale / found[0]) / (scale / scales[0]);
            assert!((0.97..1.03).contains(&ratio), "{ratio}");
        }
        let forgotten =
            averages.edge_weights.iter().filter(|w| **w < 0.05).count() as f64 / edges.len() as f64;
        assert!((forgotten - outliers).abs() < 0.05, "{forgotten}");
    }
}

#[test]
fn priors_give_the_scale_and_the_place() {
    let truth = truth(64, 1);
    let (edges, scales) = submaps(&truth, 0.02, 0.1);
    let mut rng = Seed(3).rng();
    let mut priors: Vec<NodePosition> = (0..64)
        .step_by(5)
        .map(|node| NodePosition {
            node,
            x_in_world: truth[node as usize] + vector(&mut rng, 0.1),
            sigma_m: Vector3::repeat(0.1),
        })
        .collect();
    priors[3].x_in_world.y += 100.0;
    let averages = average(64, &edges, &priors, &PositionAveragingOptions::default());
    let worst =
        averages.positions.iter().zip(&truth).map(|(f, t)| (f.unwrap() - t).norm()).fold(0.0, f64::max);
    assert!((0.01..0.5).contains(&worst), "{worst}");
    for (found, scale) in averages.group_scales.iter().zip(&scales) {
        assert!((found.unwrap() / scale - 1.0).abs() < 0.05);
    }
    assert!(averages.prior_weights[3] < 0.01 && averages.prior_weights[4] > 0.3);
}

#[test]
fn directions_alone_give_positions_up_to_scale() {
    let truth = truth(48, 2);
    for (noise, outliers, bound) in [(0.0, 0.0, 1e-4), (0.01, 0.0, 0.3), (0.01, 0.1, 0.5)] {
        let edges = directions(&truth, noise, outliers);
        let averages = average(48, &edges, &[], &PositionAveragingOptions::default());
        let errors = errors(&averages.positions, &truth);
        assert!(errors[47] < bound && errors[24] >= 0.02 * noise, "{noise} {outliers}: {errors:?}");
    }
}

#[test]
fn bad_input_and_loose_ends_are_named_or_left_where_they_are() {
    let truth = truth(16, 1);
    let (mut edges, _) = submaps(&truth, 0.01, 0.0);
    let good = edges.len() as u32;
    edges.push(RelativePosition { to: 99, ..edges[0] });
    edges.push(RelativePosition { from: 4, to: 4, ..edges[0] });
    edges.push(RelativePosition { offset_in_world: Vector3::zeros(), ..edges[0] });
    edges.push(RelativePosition { sigma: 0.0, ..edges[0] });
    edges.push(RelativePosition { offset_in_world: Vector3::repeat(f64::NAN), ..edges[0] });
    // A pair apart, whose only edge is of a group of its own.
    edges.push(RelativePosition { from: 16, to: 17, group: Some(7), ..edges[0] });
    let zero = NodePosition { node: 0, x_in_world: Vector3::zeros(), sigma_m: Vector3::zeros() };
    let averages = average(19, &edges, &[zero], &PositionAveragingOptions::default());
    assert_eq!(averages.report.ignored_edges, (good..good + 5).collect::<Vec<_>>());
    assert_eq!(averages.report.ignored_priors, [0]);
    assert_eq!((averages.report.num_components, averages.positions[18]), (2, None));
    let baseline = averages.positions[17].unwrap() - averages.positions[16].unwrap();
    assert!((baseline - edges[0].offset_in_world).norm() < 1e-6);
    let empty = average(0, &[], &[], &PositionAveragingOptions::default());
    assert!(empty.positions.is_empty() && empty.report.converged);
}
