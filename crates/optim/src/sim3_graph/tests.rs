//! Similarities recovered from a graph, with wrong edges and satellite positions.

use nalgebra::{SMatrix, SVector, UnitQuaternion};
use rand::RngExt;
use terrane_geometry::{Seed, so3};

use super::terms::{edge_jacobian, edge_residual, prior_jacobian, prior_residual};
use super::*;

fn normal(rng: &mut rand_pcg::Pcg64Mcg) -> f64 {
    (0..12).map(|_| rng.random_range(-0.5..0.5)).sum()
}

fn vector(rng: &mut rand_pcg::Pcg64Mcg, size: f64) -> Vector3<f64> {
    Vector3::from_fn(|_, _| normal(rng)) * size
}

/// Standard deviations of an edge: radians, lengths, logarithm of scale.
const SIGMAS: [f64; 7] = [0.002, 0.002, 0.002, 0.02, 0.02, 0.02, 0.003];

fn noise(rng: &mut rand_pcg::Pcg64Mcg) -> SVector<f64, 7> {
    SVector::from_fn(|i, _| SIGMAS[i] * normal(rng))
}

fn information() -> SMatrix<f64, 7, 7> {
    SMatrix::from_diagonal(&SVector::from_fn(|i, _| SIGMAS[i].powi(-2)))
}

/// Frames on a grid, each joined to its neighbours.
fn grid(side: usize, with_noise: bool, seed: u64) -> (Vec<Sim3>, Vec<Sim3Edge>) {
    let mut rng = Seed(seed).rng();
    let mut truth = Vec::new();
    for i in 0..side * side {
        let rotation = so3::exp(&vector(&mut rng, 1.0));
        let at = Vector3::new((i % side) as f64, (i / side) as f64, 0.0) * 10.0 + vector(&mut rng, 1.0);
        truth.push(Sim3::new(normal(&mut rng).mul_add(0.3, 0.0).exp(), rotation, at));
    }
    let mut edges = Vec::new();
    for i in 0..side * side {
        for (j, inside) in [(i + 1, i % side + 1 < side), (i + side, i / side + 1 < side)] {
            if inside {
                let measured = truth[j].inverse() * truth[i];
                let step = if with_noise { noise(&mut rng) } else { SVector::zeros() };
                edges.push(Sim3Edge {
                    from: i as u32,
                    to: j as u32,
                    to_from_from: measured.retract_left(&step),
                    information: information(),
                });
            }
        }
    }
    (truth, edges)
}

fn start(n: usize, edges: &[Sim3Edge]) -> Vec<Sim3> {
    initialise(n, edges, &vec![1.0; edges.len()]).into_iter().map(|s| s.unwrap()).collect()
}

/// The distances of frames' origins from truth, after bringing the first frame home; sorted.
fn errors(found: &[Sim3], truth: &[Sim3]) -> Vec<f64> {
    let from: Vec<_> = found.iter().map(|s| s.translation).collect();
    let to: Vec<_> = truth.iter().map(|s| s.translation).collect();
    let home = terrane_geometry::alignment::umeyama(&from, &to, None).unwrap();
    let mut errors: Vec<f64> =
        from.iter().zip(&to).map(|(f, t)| (home.transform_point(f) - t).norm()).collect();
    errors.sort_by(f64::total_cmp);
    errors
}

#[test]
fn jacobians_agree_with_differences() {
    let (mut nodes, mut edges) = grid(2, true, 3);
    let mut rng = Seed(8).rng();
    // A large difference, where first orders would not do.
    edges[0].to_from_from =
        edges[0].to_from_from.retract_left(&SVector::from([0.5, -0.4, 0.9, 1.0, 2.0, -1.0, 0.4]));
    let (edge, h) = (edges[0].clone(), 1e-6);
    let prior = PositionPrior {
        node: edge.from,
        x_in_node: vector(&mut rng, 3.0),
        x_in_world: vector(&mut rng, 3.0),
        sigma_m: Vector3::new(0.5, 1.0, 2.0),
    };
    let jacobian = edge_jacobian(&edge, &nodes, &edge_residual(&edge, &nodes));
    let of_prior = prior_jacobian(&prior, &nodes);
    for c in 0..7 {
        for (node, sign) in [(edge.from as usize, 1.0), (edge.to as usize, -1.0)] {
            let kept = nodes[node];
            let mut at = |value: f64| {
                let mut delta = SVector::<f64, 7>::zeros();
                delta[c] = value;
                nodes[node] = kept.retract_left(&delta);
                let values = (edge_residual(&edge, &nodes), prior_residual(&prior, &nodes));
                nodes[node] = kept;
                values
            };
            let (plus, minus) = (at(h), at(-h));
            let difference = (plus.0 - minus.0) / (2.0 * h);
            assert!(
                (difference - sign * jacobian.column(c)).amax() < 1e-6 * (1.0 + jacobian.amax()),
                "column {c}"
            );
            if sign > 0.0 {
                let difference = (plus.1 - minus.1) / (2.0 * h);
                assert!(
                    (difference - of_prior.column(c)).amax() < 1e-6 * (1.0 + of_prior.amax()),
                    "column {c}"
                );
            }
        }
    }
}

#[test]
fn noisy_grid_reaches_the_cost_that_the_noise_predicts() {
    let (truth, edges) = grid(6, true, 1);
    let options = Sim3GraphOptions { edge_loss: Loss::Squared, ..Default::default() };
    let solution = solve(&start(36, &edges), &edges, &[], &options);
    assert!(solution.report.converged, "{:?}", solution.report);
    let freedom = 7.0 * (edges.len() as f64 - 35.0);
    let ratio = 2.0 * solution.report.final_cost / freedom;
    assert!((0.75..1.25).contains(&ratio), "{ratio}");
    let errors = errors(&solution.world_from_node, &truth);
    assert!(errors[18] > 1e-3 && errors[35] < 0.3, "{errors:?}");
}

#[test]
fn wrong_seams_lose_their_weight_even_where_the_start_rests_on_them() {
    let (truth, mut edges) = grid(6, true, 1);
    let mut rng = Seed(4).rng();
    let wrong = [17usize, 24, 40];
    for i in wrong {
        let step = SVector::from_fn(|c, _| if c < 3 { 0.5 } else { 2.0 } * normal(&mut rng));
        edges[i].to_from_from = edges[i].to_from_from.retract_left(&step);
    }
    let mut strengths = vec![1.0; edges.len()];
    wrong.iter().for_each(|i| strengths[*i] = 9.0);
    let initial: Vec<Sim3> = initialise(36, &edges, &strengths).into_iter().map(Option::unwrap).collect();
    let solution = solve(&initial, &edges, &[], &Sim3GraphOptions::default());
    for (i, weight) in solution.edge_weights.iter().enumerate() {
        assert_eq!(*weight < 0.05, wrong.contains(&i), "edge {i}: {weight}");
    }
    assert!(errors(&solution.world_from_node, &truth)[35] < 0.4);
}

#[test]
fn priors_bring_the_graph_into_the_world() {
    let (truth, edges) = grid(5, true, 2);
    let mut rng = Seed(4).rng();
    let mut priors = Vec::new();
    for i in 0..100u32 {
        let x_in_node = vector(&mut rng, 4.0);
        let x_in_world = truth[i as usize % 25].transform_point(&x_in_node) + vector(&mut rng, 0.1);
        priors.push(PositionPrior { node: i % 25, x_in_node, x_in_world, sigma_m: Vector3::repeat(0.1) });
    }
    priors[7].x_in_world += Vector3::new(500.0, 0.0, 0.0);
    let solution = solve(&start(25, &edges), &edges, &priors, &Sim3GraphOptions::default());
    let worst = truth
        .iter()
        .zip(&solution.world_from_node)
        .map(|(t, f)| (t.translation - f.translation).norm())
        .fold(0.0, f64::max);
    assert!((0.005..0.2).contains(&worst), "{worst}");
    assert!(solution.prior_weights[7] < 1e-3 && solution.prior_weights[8] > 0.3);
}

#[test]
fn perfect_edges_are_met_exactly_in_every_component() {
    let (_, mut edges) = grid(4, false, 5);
    edges.retain(|e| (e.from < 8) == (e.to < 8));
    let mut initial = start(16, &edges);
    initial[5] = initial[5].retract_left(&SVector::repeat(0.05));
    let solution = solve(&initial, &edges, &[], &Sim3GraphOptions::default());
    for residual in &solution.edge_residuals {
        assert!(residual.amax() < 1e-6, "{residual}");
    }
}

#[test]
fn bad_input_is_ignored_and_named() {
    let (_, mut edges) = grid(3, true, 6);
    let good = edges.len() as u32;
    let mut initial = start(9, &edges);
    initial[8].scale = f64::NAN;
    edges.push(Sim3Edge { to: 99, ..edges[0].clone() });
    edges.push(Sim3Edge { from: 2, to: 2, ..edges[0].clone() });
    edges.push(Sim3Edge { information: SMatrix::repeat(f64::NAN), ..edges[0].clone() });
    edges.push(Sim3Edge {
        to_from_from: Sim3::new(0.0, UnitQuaternion::identity(), Vector3::zeros()),
        ..edges[0].clone()
    });
    let zero_sigma = PositionPrior {
        node: 0,
        x_in_node: Vector3::zeros(),
        x_in_world: Vector3::zeros(),
        sigma_m: Vector3::zeros(),
    };
    let solution = solve(&initial, &edges, &[zero_sigma], &Sim3GraphOptions::default());
    assert_eq!(solution.report.ignored_edges, [good, good + 1, good + 2, good + 3]);
    assert_eq!(solution.report.ignored_priors, [0]);
    assert!(solution.world_from_node.iter().all(|s| s.scale.is_finite()));
    assert_eq!(solution.edge_weights[good as usize], 0.0);
    let empty = solve(&[], &[], &[], &Sim3GraphOptions::default());
    assert!(empty.world_from_node.is_empty() && empty.report.converged);
    assert_eq!(initialise(2, &[], &[]), [None, None]);
}
