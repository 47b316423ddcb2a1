//! Rates of success over kinds of scenes, shares of outliers and errors of the focal length, with bounds on both sides.

use super::*;
use crate::matching::match_features;

const CASES: u64 = 8;

/// Of several scenes: how many are verified as this kind with nearly all that is true and little else.
fn num_right(kind: PairKind, camera: &CameraRecord, scene: impl Fn(u64) -> Scene) -> usize {
    let options = VerificationOptions::default();
    let is_right = |seed: &u64| {
        let scene = scene(100 + 10 * seed);
        let Ok(found) = scene.verify_with(camera, &options) else { return false };
        let (right, wrong) = scene.judge(&found);
        let num_false = scene.matches.len() - scene.num_true;
        found.summary.kind == kind && right * 100 >= 95 * scene.num_true && wrong * 15 <= num_false.max(30)
    };
    (0..CASES).filter(is_right).count()
}

/// Outliers for each true match of a share of outliers.
fn outliers(num_true: usize, percent: usize) -> usize {
    num_true * percent / (100 - percent)
}

#[test]
fn scenes_with_depth_are_found_among_nine_outliers_of_ten() {
    let camera = record(1000.0, FocalSource::Exif);
    for (percent, least) in [(0, 8), (30, 8), (50, 8), (70, 8), (80, 7), (90, 6)] {
        let right = num_right(PairKind::Calibrated, &camera, |seed| {
            let scene = Scene::observed(120, &side_step(), deep, seed);
            scene.with_outliers(outliers(120, percent), seed + 1)
        });
        assert!(right >= least, "{percent} % outliers: {right} of {CASES}");
    }
}

#[test]
fn nothing_true_is_nothing_found() {
    // Chance alone reaches the fewest inliers only among many matches.
    let camera = record(1000.0, FocalSource::Exif);
    let options = VerificationOptions::default();
    for (count, most) in [(40, 0), (80, 1), (160, 4)] {
        let scene = |seed: u64| Scene::default().with_outliers(count, 300 + seed);
        let found = (0..CASES).filter(|&seed| scene(seed).verify_with(&camera, &options).is_ok()).count();
        assert!(found <= most, "{count} random matches: {found} of {CASES} verified");
    }
}

#[test]
fn planes_and_turns_are_told_apart_among_outliers() {
    let plane = |x: f64, y: f64, _: f64| 10.0 / (1.0 + 0.3 * x - 0.2 * y);
    let turn = pose(Vector3::new(0.05, 0.2, -0.03), Vector3::zeros());
    for source in [FocalSource::Given, FocalSource::Guess] {
        let camera = record(1000.0, source);
        for percent in [0, 50, 70] {
            let planar = num_right(PairKind::Planar, &camera, |seed| {
                Scene::observed(150, &side_step(), plane, seed)
                    .with_outliers(outliers(150, percent), seed + 1)
            });
            let turned = num_right(PairKind::Panoramic, &camera, |seed| {
                Scene::observed(150, &turn, deep, seed).with_outliers(outliers(150, percent), seed + 1)
            });
            assert!(planar >= 7 && turned >= 7, "{source:?}, {percent} %: {planar} and {turned} of {CASES}");
        }
    }
}

#[test]
fn forward_motion_and_wide_angles_are_scenes_with_depth() {
    let ahead = pose(Vector3::new(0.01, -0.02, 0.02), Vector3::new(0.1, 0.05, 2.0));
    for (focal_px, truth) in [(1000.0, ahead), (350.0, ahead), (350.0, side_step()), (4000.0, side_step())] {
        let camera = record(focal_px, FocalSource::Given);
        let depth =
            |x: f64, y: f64, at: f64| if focal_px > 2000.0 { 12.0 + 20.0 * at } else { deep(x, y, at) };
        let scene =
            |seed| Scene::observed_at(focal_px, 200, &truth, depth, seed).with_outliers(200, seed + 1);
        let right = num_right(PairKind::Calibrated, &camera, scene);
        assert!(right >= 7, "focal length {focal_px}: {right} of {CASES}");
        let found = scene(777).verify_with(&camera, &VerificationOptions::default()).expect("verified");
        let (rotation, direction) = pose_error_deg(&found, &truth);
        // A narrow view hardly tells a turn from a step aside.
        let most_deg = if focal_px > 2000.0 { 3.0 } else { 0.5 };
        assert!(rotation < most_deg && direction < 3.0, "focal length {focal_px}: {rotation} {direction}");
    }
}

#[test]
fn wrong_focal_lengths_are_survived() {
    let scene = |seed| Scene::observed(300, &side_step(), deep, seed).with_outliers(150, seed + 1);
    for factor in [0.5, 0.7, 1.0, 1.4, 2.0] {
        let guessed = record(1000.0 * factor, FocalSource::Guess);
        let right = num_right(PairKind::Uncalibrated, &guessed, scene);
        assert!(right >= 7, "factor {factor}, guessed: {right} of {CASES}");
        // Trusted, the essential matrix is kept while it explains nearly as much, whatever the kind.
        let trusted = record(1000.0 * factor, FocalSource::Exif);
        let shares: Vec<usize> = (0..CASES)
            .map(|seed| {
                let scene = scene(100 + 10 * seed);
                let found = scene.verify_with(&trusted, &VerificationOptions::default());
                found.map_or(0, |found| scene.judge(&found).0 / 3)
            })
            .collect();
        let num_good = shares.iter().filter(|share| **share >= 90).count();
        assert!(num_good >= 7, "factor {factor}, trusted: {shares:?} % of the true matches");
    }
}

#[test]
fn degenerate_points_never_panic() {
    let camera = record(1000.0, FocalSource::Exif);
    let options = VerificationOptions::default();
    let at = |x: f64, y: f64| Vector2::new(x, y);
    let shapes: [&dyn Fn(usize) -> Vector2<f64>; 4] = [
        &|_| at(300.0, 400.0),
        &|i| at(10.0 + 5.0 * i as f64, 20.0 + 3.0 * i as f64),
        &|i| at(if i % 2 == 0 { 100.0 } else { 900.0 }, 300.0),
        &|i| at((i * 7919 % 1200) as f64, (i * 104_729 % 900) as f64),
    ];
    for first in shapes {
        for second in shapes {
            let mut scene = Scene::default();
            (0..120).for_each(|i| scene.push(first(i), second(i), 0.5));
            if let Ok(found) = scene.verify_with(&camera, &options) {
                let pose = found.summary.second_from_first;
                assert!(pose.is_none_or(|pose| pose.translation.norm().is_finite()));
                assert!(found.summary.median_angle_rad.is_finite());
            }
        }
    }
}

#[test]
fn guidance_finds_what_the_ratio_test_refused() {
    let camera = record(1000.0, FocalSource::Given);
    let scene = Scene::observed(600, &side_step(), deep, 900);
    // Ten kinds of descriptors with some noise: nothing stands out in the whole image, much does along a line. The first
    // sixty are all different.
    let mut rng = Seed(901).rng();
    let kinds: Vec<[u8; 128]> = (0..70).map(|_| std::array::from_fn(|_| rng.random_range(0..120))).collect();
    let mut descriptors = [Vec::new(), Vec::new()];
    for i in 0..600 {
        let kind = if i < 60 { i } else { 60 + i % 10 };
        for side in &mut descriptors {
            side.extend(kinds[kind].map(|value| value + rng.random_range(0..8)));
        }
    }
    let [one, other] = descriptors;
    let features = |keypoints: &[Keypoint], descriptors| Features {
        keypoints: keypoints.to_vec(),
        descriptors,
        colors: vec![[0; 3]; 600],
        ..Features::default()
    };
    let (first, second) = (features(&scene.first, one), features(&scene.second, other));
    let found = |guided| {
        let options = VerificationOptions { guided, ..VerificationOptions::default() };
        let pair = ImagePair::new(ImageId(0), ImageId(1)).expect("two images");
        let side = |features| Photograph { camera: &camera, features };
        let matching = MatchOptions::default();
        let match_all = || match_features(&first, &second, &matching);
        match_and_verify(pair, [&side(&first), &side(&second)], match_all, &matching, &options, Seed(5))
            .expect("verified")
    };
    let (plain, guided) = (found(GuidedMatching::Off), found(GuidedMatching::After));
    let right = guided.matches.iter().filter(|pair| pair[0] == pair[1]).count();
    assert!((50..100).contains(&plain.matches.len()), "{}", plain.matches.len());
    assert!(
        (300..600).contains(&right) && right * 100 > 95 * guided.matches.len(),
        "{right} of {}",
        guided.matches.len()
    );
    assert_eq!(guided.summary.kind, PairKind::Calibrated);
    // Too few features to be guided by the strongest first.
    assert_eq!(found(GuidedMatching::First), guided);
}
