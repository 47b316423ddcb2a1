//! Poses of random scenes by many points, exact, noisy and degenerate.

use nalgebra::Vector2;

use super::*;
use crate::small_lm::tests::assert_gradient;
use crate::test_support::Random;

struct Case {
    truth: Rigid3,
    rays: Vec<Vector3<f64>>,
    x_in_world: Vec<Vector3<f64>>,
}

impl Case {
    /// Points 3 to 12 units ahead; with `plane` on one slanted plane; rays with noise in normalized units.
    fn new(random: &mut Random, count: usize, plane: bool, noise: f64) -> Self {
        let truth = random.rigid();
        let slope = random.gaussian2(0.3);
        let mut case = Self { truth, rays: vec![], x_in_world: vec![] };
        for _ in 0..count {
            let xy = Vector2::new(random.uniform(-0.6, 0.6), random.uniform(-0.6, 0.6));
            let depth = if plane { 6.0 / (1.0 - slope.dot(&xy)) } else { random.uniform(3.0, 12.0) };
            case.x_in_world.push(truth.inverse().transform_point(&(xy.push(1.0) * depth)));
            case.rays.push((xy + random.gaussian2(noise)).push(1.0).normalize());
        }
        case
    }

    fn error(&self) -> f64 {
        let distance = |pose: &Rigid3| pose.local_left(&self.truth).norm();
        pnp(&self.rays, &self.x_in_world).iter().map(distance).fold(f64::INFINITY, f64::min)
    }
}

#[test]
fn the_truth_is_found_from_any_number_of_points() {
    let mut random = Random::new("pnp");
    for (count, plane, share) in [
        (3, false, 0.99),
        (4, false, 0.99),
        (5, false, 0.99),
        (6, false, 0.99),
        (10, false, 0.999),
        (50, false, 0.999),
    ]
    .into_iter()
    .chain([(4, true, 0.99), (8, true, 0.99), (30, true, 0.99)])
    {
        let good = (0..1000).filter(|_| Case::new(&mut random, count, plane, 0.0).error() < 1e-5).count();
        assert!(good as f64 >= 1000.0 * share, "{count} {plane} {good}");
    }
}

#[test]
fn the_error_grows_with_the_noise_and_falls_with_the_count() {
    let mut random = Random::new("pnp noise");
    let median = |random: &mut Random, count: usize, noise: f64| {
        let mut errors: Vec<f64> = (0..501).map(|_| Case::new(random, count, false, noise).error()).collect();
        errors.sort_by(f64::total_cmp);
        errors[250]
    };
    let (small, large) = (median(&mut random, 20, 1e-4), median(&mut random, 20, 1e-3));
    assert!(small > 1e-5 && small < 3e-3, "{small}");
    assert!(large > 5.0 * small && large < 20.0 * small, "{small} {large}");
    let many = median(&mut random, 320, 1e-3);
    assert!(many > 0.15 * large && many < 0.45 * large, "{many} {large}");
}

#[test]
fn the_gradient_is_right() {
    let mut random = Random::new("pnp gradient");
    let case = Case::new(&mut random, 10, false, 0.01);
    let form = Form::new(&case.rays, &case.x_in_world).unwrap();
    assert_gradient(&form, &random.rotation(), 1e-6);
}

#[test]
fn degenerate_input_gives_none() {
    let mut random = Random::new("pnp degenerate");
    let case = Case::new(&mut random, 10, false, 0.0);
    let (rays, x) = (&case.rays, &case.x_in_world);
    assert!(pnp(&rays[..2], &x[..2]).is_empty() && pnp(rays, &x[..9]).is_empty() && pnp(&[], &[]).is_empty());
    assert!(pnp(rays, &[x[0]; 10]).is_empty());
    let line: Vec<_> = (0..10).map(|i| x[0] + (x[1] - x[0]) * f64::from(i)).collect();
    assert!(pnp(rays, &line).is_empty());
    assert!(pnp(&[rays[0]; 10], x).is_empty());
    assert!(pnp(&[Vector3::repeat(f64::NAN); 10], x).is_empty());
    assert!(pnp(rays, &[Vector3::repeat(f64::INFINITY); 10]).is_empty());
}
