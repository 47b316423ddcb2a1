//! Truth, noise on both sides, outliers, degenerate layouts.

use super::*;
use crate::test_support::Random;

fn random_sim3(random: &mut Random) -> Sim3 {
    Sim3::new(random.uniform(-2.0, 2.0).exp(), random.rotation(), random.gaussian3(10.0))
}

fn pair(
    random: &mut Random,
    sim3: &Sim3,
    count: usize,
    noise: f64,
) -> (Vec<Vector3<f64>>, Vec<Vector3<f64>>) {
    let from: Vec<_> = (0..count).map(|_| random.gaussian3(3.0)).collect();
    let to = from.iter().map(|x| sim3.transform_point(x) + random.gaussian3(noise)).collect();
    (from, to)
}

fn difference(a: &Sim3, b: &Sim3) -> f64 {
    a.local_left(b).norm()
}

#[test]
fn three_points_and_more_give_the_truth() {
    let mut random = Random::new("umeyama");
    let mut good = 0;
    for case in 0..1000 {
        let truth = random_sim3(&mut random);
        let (from, to) = pair(&mut random, &truth, 3 + case % 5, 0.0);
        good += usize::from(umeyama(&from, &to, None).is_some_and(|found| difference(&found, &truth) < 1e-8));
    }
    assert!(good >= 995, "{good}");
}

#[test]
fn noise_shows_and_stays_small() {
    let mut random = Random::new("umeyama noise");
    let truth = random_sim3(&mut random);
    let (from, to) = pair(&mut random, &truth, 400, 0.05 * truth.scale);
    let error = difference(&umeyama(&from, &to, None).unwrap(), &truth);
    assert!(error > 1e-5 && error < 0.05, "{error}");
}

#[test]
fn weights_silence_wrong_points() {
    let mut random = Random::new("weights");
    let truth = random_sim3(&mut random);
    let (from, mut to) = pair(&mut random, &truth, 10, 0.0);
    to[4] += Vector3::new(50.0, 0.0, 0.0);
    let mut weights = vec![1.0; 10];
    assert!(difference(&umeyama(&from, &to, Some(&weights)).unwrap(), &truth) > 0.1);
    weights[4] = 0.0;
    assert!(difference(&umeyama(&from, &to, Some(&weights)).unwrap(), &truth) < 1e-9);
}

#[test]
fn planar_points_and_mirrored_points_give_proper_rotations() {
    let mut random = Random::new("planar");
    let truth = random_sim3(&mut random);
    let from: Vec<_> = (0..20).map(|_| Vector3::new(random.gaussian(), random.gaussian(), 0.0)).collect();
    let to: Vec<_> = from.iter().map(|x| truth.transform_point(x)).collect();
    assert!(difference(&umeyama(&from, &to, None).unwrap(), &truth) < 1e-9);
    let solid: Vec<_> = (0..20).map(|_| random.gaussian3(1.0)).collect();
    let mirrored: Vec<_> = solid.iter().map(|x| Vector3::new(x.x, x.y, -x.z)).collect();
    if let Some(found) = umeyama(&solid, &mirrored, None) {
        assert!((found.rotation.to_rotation_matrix().matrix().determinant() - 1.0).abs() < 1e-9);
    }
}

#[test]
fn rigid_keeps_the_scale() {
    let mut random = Random::new("rigid");
    let truth = Sim3::new(1.0, random.rotation(), random.gaussian3(5.0));
    let (from, to) = pair(&mut random, &truth, 6, 0.0);
    let found = rigid_from_points(&from, &to, None).unwrap();
    assert!(difference(&Sim3::from_rigid(&found), &truth) < 1e-9);
    let directions: Vec<_> = (0..4).map(|_| random.direction()).collect();
    let turned: Vec<_> = directions.iter().map(|x| truth.rotation * x).collect();
    assert!(rotation_from_directions(&directions, &turned).unwrap().angle_to(&truth.rotation) < 1e-9);
}

#[test]
fn degenerate_input_gives_none() {
    let line: Vec<_> =
        (0..8).map(|i| Vector3::new(1.0, 2.0, -0.5) * f64::from(i) + Vector3::x() * 1e3).collect();
    let mut random = Random::new("degenerate");
    let solid: Vec<_> = (0..8).map(|_| random.gaussian3(1.0)).collect();
    assert_eq!(umeyama(&line, &solid, None), None);
    assert_eq!(umeyama(&solid, &line, None), None);
    assert_eq!(umeyama(&[solid[0]; 5], &solid[..5], None), None);
    assert_eq!(umeyama(&solid[..5], &[solid[0]; 5], None), None);
    assert_eq!(umeyama(&solid[..2], &solid[..2], None), None);
    assert_eq!(umeyama(&solid[..4], &solid[..5], None), None);
    assert_eq!(umeyama(&solid, &solid, Some(&[0.0; 8])), None);
    assert_eq!(umeyama(&solid, &solid, Some(&[-1.0; 8])), None);
    assert_eq!(umeyama(&solid, &[Vector3::repeat(f64::NAN); 8], None), None);
    assert_eq!(umeyama(&[Vector3::repeat(f64::INFINITY); 8], &solid, None), None);
    assert!(estimate_sim3(&line, &line, 0.1, &RansacOptions::default(), Seed(1)).is_none());
    assert!(estimate_sim3(&solid[..3], &solid, 0.1, &RansacOptions::default(), Seed(1)).is_none());
}

#[test]
fn outliers_are_left_out() {
    let mut random = Random::new("robust");
    let truth = random_sim3(&mut random);
    let noise = 0.01 * truth.scale;
    let (from, mut to) = pair(&mut random, &truth, 300, noise);
    for i in (0..300).step_by(2) {
        to[i] += random.gaussian3(5.0 * truth.scale);
    }
    let found = estimate_sim3(&from, &to, 4.0 * noise, &RansacOptions::default(), Seed(1)).unwrap();
    assert!((145..160).contains(&found.inliers.len()), "{}", found.inliers.len());
    let error = difference(&found.model, &truth);
    assert!(error > 1e-6 && error < 0.02, "{error}");
    let rigid_to: Vec<_> = to.iter().map(|x| x / truth.scale).collect();
    let rigid = estimate_rigid3(&from, &rigid_to, 0.04, &RansacOptions::default(), Seed(1)).unwrap();
    assert!((145..160).contains(&rigid.inliers.len()));
}
