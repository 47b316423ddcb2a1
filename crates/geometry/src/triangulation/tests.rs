//! Truth, noise on both sides, wrong views, angles, degenerate rays.

use super::*;
use crate::small_lm::tests::assert_gradient;
use crate::test_support::{Random, radial_camera};

/// Cameras on a circle of 5 around a point near the origin, looking at the origin.
fn views(random: &mut Random, count: usize, noise_px: f64) -> (Vector3<f64>, Vec<View>) {
    let x_in_world = random.gaussian3(0.5);
    let camera = radial_camera();
    let mut views = vec![];
    while views.len() < count {
        let center = random.direction() * 5.0;
        let turn = nalgebra::Rotation3::face_towards(&-center, &random.direction()).inverse();
        let rotation = nalgebra::UnitQuaternion::from_rotation_matrix(&turn);
        let cam_from_world = Rigid3::from_rotation_and_center(rotation, &center);
        let pixel = camera.project(&cam_from_world.transform_point(&x_in_world)).unwrap();
        views.push(View { cam_from_world, camera, xy_px: pixel + random.gaussian2(noise_px) });
    }
    (x_in_world, views)
}

#[test]
fn truth_is_found_from_two_views_and_more() {
    let mut random = Random::new("triangulate");
    let mut good = 0;
    for case in 0..500 {
        let (x, views) = views(&mut random, 2 + case % 7, 0.0);
        good += usize::from(triangulate(&views).is_some_and(|found| (found - x).norm() < 1e-8));
        let robust = triangulate_robust(&views, &TriangulationOptions::default(), Seed(1));
        good += usize::from(robust.is_some_and(|found| (found.x_in_world - x).norm() < 1e-8));
    }
    assert!(good >= 990, "{good}");
}

#[test]
fn noise_shows_and_stays_small() {
    let mut random = Random::new("triangulate noise");
    let (mut sum, cases) = (0.0, 200);
    for _ in 0..cases {
        let (x, views) = views(&mut random, 6, 1.0);
        sum += (triangulate(&views).unwrap() - x).norm();
    }
    let mean = sum / f64::from(cases);
    // A pixel at distance 5 is 5/1300 = 3.8 mm; six views halve it.
    assert!(mean > 5e-4 && mean < 6e-3, "{mean}");
}

#[test]
fn wrong_views_are_left_out() {
    let mut random = Random::new("triangulate robust");
    for case in 0..200 {
        let count = 6 + case % 30;
        let (x, mut views) = views(&mut random, count, 0.3);
        for i in (0..count).step_by(3) {
            views[i].xy_px += 50.0 * random.gaussian2(3.0) + Vector2::new(200.0, 0.0);
        }
        let found = triangulate_robust(&views, &TriangulationOptions::default(), Seed(case as u64)).unwrap();
        assert!((found.x_in_world - x).norm() < 0.02);
        let bad = found.inliers.iter().filter(|&&i| i % 3 == 0).count();
        assert!(found.inliers.len() >= count - count.div_ceil(3) && bad <= 1, "{count} {:?}", found.inliers);
        assert!(found.inliers.is_sorted() && found.angle_rad > 0.1);
        assert_eq!(
            Some(found),
            triangulate_robust(&views, &TriangulationOptions::default(), Seed(case as u64))
        );
    }
}

#[test]
fn gradient_matches_differences() {
    let mut random = Random::new("triangulate gradient");
    let (x, views) = views(&mut random, 4, 2.0);
    assert_gradient(&PointProblem { views: &views }, &(x + random.gaussian3(0.05)), 1e-5);
}

#[test]
fn narrow_angles_and_points_behind_are_refused() {
    let mut random = Random::new("triangulate narrow");
    let (x, views) = views(&mut random, 1, 0.0);
    let mut beside = views[0];
    beside.cam_from_world.translation.x += 0.05;
    beside.xy_px = beside.camera.project(&beside.cam_from_world.transform_point(&x)).unwrap();
    let pair = [views[0], beside];
    let angle = ray_angle_rad(&pair[0].cam_from_world.center(), &pair[1].cam_from_world.center(), &x);
    assert!(angle > 0.005 && angle < 0.015, "{angle}");
    assert!(triangulate_robust(&pair, &TriangulationOptions::default(), Seed(1)).is_none());
    let generous = TriangulationOptions { min_angle_rad: 0.004, ..Default::default() };
    let found = triangulate_robust(&pair, &generous, Seed(1)).unwrap();
    assert!((found.angle_rad - angle).abs() < 1e-6);
    // Swapping the pixels makes the rays part: they meet behind.
    let mut swapped = pair;
    (swapped[0].xy_px, swapped[1].xy_px) = (pair[1].xy_px, pair[0].xy_px);
    assert!(triangulate(&swapped).is_none());
    assert!(triangulate_robust(&swapped, &generous, Seed(1)).is_none());
}

#[test]
fn degenerate_input_gives_none() {
    let mut random = Random::new("triangulate degenerate");
    let (_, views) = views(&mut random, 3, 0.0);
    let options = TriangulationOptions::default();
    assert!(triangulate(&[]).is_none() && triangulate(&views[..1]).is_none());
    assert!(triangulate_robust(&[], &options, Seed(1)).is_none());
    assert!(triangulate_robust(&views[..1], &options, Seed(1)).is_none());
    assert!(triangulate_robust(&[views[0]; 5], &options, Seed(1)).is_none());
    let mut broken = views;
    for view in &mut broken {
        view.xy_px.x = f64::NAN;
    }
    assert!(triangulate(&broken).is_none() && triangulate_robust(&broken, &options, Seed(1)).is_none());
}

#[test]
fn angles_are_exact_at_their_ends() {
    let angle = |a, b| ray_angle_rad(&a, &b, &Vector3::zeros());
    assert_eq!(angle(Vector3::x(), Vector3::x() * 2.0), 0.0);
    assert!((angle(Vector3::x(), -Vector3::x()) - std::f64::consts::PI).abs() < 1e-15);
    assert!((angle(Vector3::x(), Vector3::y()) - std::f64::consts::FRAC_PI_2).abs() < 1e-15);
}

#[test]
fn the_covariance_predicts_the_scatter() {
    let mut random = Random::new("point covariance");
    let sigma_px = 0.5;
    let (x, clean) = views(&mut random, 5, 0.0);
    let predicted = point_covariance(&clean, &x, sigma_px).unwrap();
    let (mut scatter, count) = (Matrix3::zeros(), 4000);
    for _ in 0..count {
        let mut noisy = clean.clone();
        noisy.iter_mut().for_each(|view| view.xy_px += random.gaussian2(sigma_px));
        let off = triangulate(&noisy).unwrap() - x;
        scatter += off * off.transpose() / f64::from(count);
    }
    for direction in [Vector3::x(), Vector3::y(), Vector3::z(), Vector3::repeat(0.6)] {
        let ratio = direction.dot(&(scatter * direction)) / direction.dot(&(predicted * direction));
        assert!(ratio > 0.9 && ratio < 1.1, "{ratio}");
    }
    let doubled = point_covariance(&clean, &x, 2.0 * sigma_px).unwrap();
    assert!((doubled - 4.0 * predicted).norm() < 1e-12 * doubled.norm());
    assert!(point_covariance(&clean[..1], &x, 1.0).is_none());
    assert!(point_covariance(&[clean[0], clean[0]], &x, 1.0).is_none());
    assert!(point_covariance(&clean, &Vector3::repeat(f64::NAN), 1.0).is_none());
    assert!(point_covariance(&clean, &Vector3::repeat(100.0), 1.0).is_none());
}

#[test]
fn outliers_are_the_rest() {
    let found = Triangulated { x_in_world: Vector3::zeros(), inliers: vec![1, 4], angle_rad: 1.0 };
    assert_eq!(found.outliers(6), [0, 2, 3, 5]);
    assert!(found.outliers(0).is_empty());
}
