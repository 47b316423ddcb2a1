//! Truth among outliers, noise on both sides, planes and rotations, degenerate input.

use nalgebra::Vector3;

use super::*;
use crate::Rigid3;
use crate::homography::distance_from_rotation;
use crate::test_support::{Random, TwoViews, project, two_views};

/// Views of which every `period`-th correspondence is random.
fn with_outliers(random: &mut Random, count: usize, noise: f64, planar: bool, period: usize) -> TwoViews {
    let mut views = two_views(random, count, noise, planar);
    for i in (0..count).step_by(period) {
        views.second[i] = Vector2::new(random.uniform(-0.7, 0.7), random.uniform(-0.7, 0.7));
    }
    views
}

fn pose_error(found: &Rigid3, truth: &Rigid3) -> f64 {
    found.rotation.angle_to(&truth.rotation) + found.translation.angle(&truth.translation)
}

#[test]
fn essential_matrices_and_poses_are_found_among_outliers() {
    let mut random = Random::new("robust essential");
    let mut good = 0;
    for case in 0..100 {
        let views = with_outliers(&mut random, 300, 0.0, case % 4 == 3, 2);
        let found =
            estimate_essential(&views.first, &views.second, 1e-3, &RansacOptions::default(), Seed(case))
                .unwrap();
        assert!(found.inliers.len() >= 145 && found.inliers.len() < 180, "{}", found.inliers.len());
        let pose = pose_from_essential(&found.model, &views.first, &views.second, &found.inliers).unwrap();
        assert!(pose.median_angle_rad > 0.01 && pose.median_angle_rad < 0.5);
        // Random correspondences within the threshold pull a little. A plane has a second, equally good solution.
        let near = pose_error(&pose.second_from_first, &views.second_from_first) < 5e-3;
        good += usize::from(near || case % 4 == 3);
    }
    assert!(good >= 98, "{good}");
}

#[test]
fn noise_shows_and_stays_small() {
    let mut random = Random::new("essential noise");
    let (mut sum, mut refined_sum) = (0.0, 0.0);
    for case in 0..40 {
        let views = with_outliers(&mut random, 300, 5e-4, false, 3);
        let found =
            estimate_essential(&views.first, &views.second, 2e-3, &RansacOptions::default(), Seed(case))
                .unwrap();
        assert!(found.inliers.len() >= 190);
        let pose = pose_from_essential(&found.model, &views.first, &views.second, &found.inliers).unwrap();
        assert!(pose.num_in_front >= 190);
        let refined =
            refine_relative_pose(&pose.second_from_first, &views.first, &views.second, &found.inliers, 1e-3);
        assert!((refined.translation.norm() - 1.0).abs() < 1e-12);
        sum += pose_error(&pose.second_from_first, &views.second_from_first);
        refined_sum += pose_error(&refined, &views.second_from_first);
    }
    let (mean, refined) = (sum / 40.0, refined_sum / 40.0);
    assert!(mean > 1e-4 && mean < 1.5e-2 && refined > 1e-4 && refined < 1.5e-2, "{mean} {refined}");
}

#[test]
fn fundamental_matrices_are_found_in_pixels() {
    let mut random = Random::new("robust fundamental");
    let mut good = 0;
    let to_pixels = |point: &Vector2<f64>| point * 1000.0 + Vector2::new(800.0, 600.0);
    for case in 0..50 {
        let views = with_outliers(&mut random, 300, 5e-4, false, 3);
        let first: Vec<_> = views.first.iter().map(to_pixels).collect();
        let second: Vec<_> = views.second.iter().map(to_pixels).collect();
        let found =
            estimate_fundamental(&first, &second, 2.0, &RansacOptions::default(), Seed(case)).unwrap();
        assert!(found.model.determinant().abs() < 1e-12);
        let k = Matrix3::new(1000.0, 0.0, 800.0, 0.0, 1000.0, 600.0, 0.0, 0.0, 1.0);
        let essential = k.transpose() * found.model * k;
        let pose = pose_from_essential(&essential, &views.first, &views.second, &found.inliers).unwrap();
        let mean_cost = found.cost / 300.0;
        // A third pays the threshold, the others the noise of half a pixel.
        assert!(mean_cost > 1.3 && mean_cost < 1.7, "{mean_cost}");
        good += usize::from(
            found.inliers.len() >= 190
                && pose_error(&pose.second_from_first, &views.second_from_first) < 0.15,
        );
    }
    assert!(good >= 47, "{good}");
}

#[test]
fn homographies_are_found_and_explained() {
    let mut random = Random::new("robust homography");
    let mut good = 0;
    for case in 0..100 {
        let mut views = with_outliers(&mut random, 200, 2e-4, true, 3);
        // A few points off the plane, which decide between the two explanations.
        let off = two_views(&mut random, 1, 0.0, false);
        assert_eq!(off.first.len(), 1);
        for i in 0..12 {
            let x = Vector3::new(0.05 * i as f64 - 0.3, 0.1, 1.0) * (4.0 + 0.2 * i as f64);
            let x_in_second = views.second_from_first.transform_point(&x);
            views.first.push(project(&x));
            views.second.push(project(&x_in_second));
        }
        let found =
            estimate_homography(&views.first, &views.second, 1e-3, &RansacOptions::default(), Seed(case))
                .unwrap();
        assert!(found.inliers.len() >= 125 && found.inliers.len() < 150, "{}", found.inliers.len());
        assert!(found.inliers.iter().all(|&i| {
            let first = views.first[i as usize].push(1.0);
            (found.model * first).z > 0.0
        }));
        let poses = poses_from_homography(&found.model, &views.first, &views.second, &found.inliers);
        let near =
            poses.iter().any(|pose| pose_error(&pose.second_from_first, &views.second_from_first) < 0.05);
        good += usize::from(near);
    }
    assert!(good >= 95, "{good}");
}

#[test]
fn turning_cameras_are_told_from_moving_ones() {
    let mut random = Random::new("rotation");
    let options = RansacOptions::default();
    for case in 0..30 {
        let mut views = with_outliers(&mut random, 200, 0.0, false, 4);
        let moving = estimate_rotation(&views.first, &views.second, 2e-3, &options, Seed(case));
        assert!(moving.is_none_or(|found| found.inliers.len() < 100));
        let turn = random.small_rotation(0.4);
        for i in 0..200 {
            let seen = turn * views.first[i].push(1.0);
            if i % 4 != 0 {
                views.second[i] = project(&seen) + random.gaussian2(3e-4);
            }
        }
        let found = estimate_rotation(&views.first, &views.second, 2e-3, &options, Seed(case)).unwrap();
        assert!(found.inliers.len() >= 148 && found.model.angle_to(&turn) < 1e-3);
        let h = estimate_homography(&views.first, &views.second, 2e-3, &options, Seed(case)).unwrap();
        assert!(distance_from_rotation(&h.model) < 0.02);
    }
}

#[test]
fn the_order_of_quality_and_seeds_are_respected() {
    let mut random = Random::new("prosac essential");
    let mut views = two_views(&mut random, 400, 3e-4, false);
    for i in 80..400 {
        views.second[i] = Vector2::new(random.uniform(-0.7, 0.7), random.uniform(-0.7, 0.7));
    }
    let options = RansacOptions {
        min_iterations: 0,
        max_iterations: 300,
        order: ransac::SampleOrder::FallingQuality,
        ..Default::default()
    };
    let found = estimate_essential(&views.first, &views.second, 1.5e-3, &options, Seed(3)).unwrap();
    assert!(found.inliers.iter().filter(|&&i| i < 80).count() >= 75);
    let again = estimate_essential(&views.first, &views.second, 1.5e-3, &options, Seed(3)).unwrap();
    assert_eq!(found, again);
}

#[test]
fn degenerate_input_gives_none_or_finite() {
    let options = RansacOptions { max_iterations: 200, ..Default::default() };
    let mut random = Random::new("two view degenerate");
    let good = two_views(&mut random, 30, 0.0, false);
    let line: Vec<_> = (0..30).map(|i| Vector2::new(0.01 * f64::from(i), 0.02 * f64::from(i))).collect();
    let same = vec![Vector2::new(0.1, 0.2); 30];
    let nan = vec![Vector2::repeat(f64::NAN); 30];
    for (first, second) in [
        (&same, &same),
        (&nan, &nan),
        (&good.first, &nan),
        (&nan, &good.second),
        (&same, &good.second),
        (&line, &line),
        (&line, &good.second),
        (&good.first, &good.first),
    ] {
        let matrices = [
            estimate_essential(first, second, 1e-3, &options, Seed(1)),
            estimate_fundamental(first, second, 1e-3, &options, Seed(1)),
            estimate_homography(first, second, 1e-3, &options, Seed(1)),
        ];
        for found in matrices.iter().flatten() {
            assert!(found.model.iter().all(|value| value.is_finite()) && found.cost.is_finite());
            pose_from_essential(&found.model, first, second, &found.inliers);
            pose_from_homography(&found.model, first, second, &found.inliers);
        }
        estimate_rotation(first, second, 1e-3, &options, Seed(1));
    }
    for bad in [&nan, &same] {
        assert!(estimate_essential(bad, bad, 1e-3, &options, Seed(1)).is_none());
        assert!(estimate_fundamental(bad, bad, 1e-3, &options, Seed(1)).is_none());
        assert!(estimate_homography(bad, bad, 1e-3, &options, Seed(1)).is_none());
    }
    assert!(estimate_homography(&line, &line, 1e-3, &options, Seed(1)).is_none());
    let few = &good.first[..3];
    assert!(estimate_essential(few, few, 1e-3, &options, Seed(1)).is_none());
    assert!(estimate_fundamental(few, few, 1e-3, &options, Seed(1)).is_none());
    assert!(estimate_homography(few, few, 1e-3, &options, Seed(1)).is_none());
    assert!(estimate_rotation(&few[..1], &few[..1], 1e-3, &options, Seed(1)).is_none());
    assert!(estimate_essential(&good.first, few, 1e-3, &options, Seed(1)).is_none());
    assert!(pose_from_essential(&Matrix3::zeros(), &good.first, &good.second, &[0, 1]).is_none());
    assert!(pose_from_essential(&Matrix3::identity(), &good.first, &good.second, &[999]).is_none());
}
