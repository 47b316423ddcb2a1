//! Every kind of features on scenes with known answers, and on images that have none.

use super::scenes::{Scene, Similarity};
use super::*;
use crate::matching::{MatchOptions, match_features};

const SIDE: usize = 320;

fn options(method: FeatureMethod) -> FeatureOptions {
    FeatureOptions { method, ..FeatureOptions::default() }
}

/// Of features of `first` that `second` shows: the share found again within 1.5 pixels, the share matched, the share of
/// matches that are right (within three pixels), and the median distance in pixels of the right ones from the truth.
fn compare(first: &Features, second: &Features, second_from_first: &Similarity) -> [f64; 4] {
    let place = |features: &Features, k: usize| {
        (f64::from(features.keypoints[k].x_px), f64::from(features.keypoints[k].y_px))
    };
    let truth = |k: usize| second_from_first.apply(place(first, k));
    let error = |k: usize, other: usize| {
        let (a, b) = (truth(k), place(second, other));
        (a.0 - b.0).hypot(a.1 - b.1)
    };
    let is_shown = |k: usize| {
        let (x, y) = truth(k);
        let inside = 30.0..SIDE as f64 - 30.0;
        inside.contains(&x) && inside.contains(&y)
    };
    let shown: Vec<usize> = (0..first.len()).filter(|&k| is_shown(k)).collect();
    let repeated = shown.iter().filter(|&&k| (0..second.len()).any(|other| error(k, other) < 1.5)).count();
    let matches = match_features(first, second, &MatchOptions::default());
    let errors: Vec<f64> = matches
        .iter()
        .filter(|found| is_shown(found.first as usize))
        .map(|found| error(found.first as usize, found.second as usize))
        .collect();
    let mut right: Vec<f64> = errors.iter().copied().filter(|error| *error < 3.0).collect();
    right.sort_by(f64::total_cmp);
    let share = |part: usize, whole: usize| part as f64 / whole.max(1) as f64;
    assert!(shown.len() > 150, "only {} features are shown", shown.len());
    [
        share(repeated, shown.len()),
        share(errors.len(), shown.len()),
        share(right.len(), errors.len()),
        right.get(right.len() / 2).copied().unwrap_or(f64::INFINITY),
    ]
}

/// The least share repeated, least share matched, least share right, greatest median error in pixels.
type Bounds = [f64; 4];

fn check(method: FeatureMethod, cases: &[((f64, f64, f64), Bounds)]) {
    let scene = Scene::random(420, SIDE as f64, 11);
    let same = Similarity::about_middle(SIDE as f64, 0.0, 1.0);
    let first = scene.draw(SIDE, &same, 0.5);
    let first = extract(&first, None, &options(method));
    let mut wrong = Vec::new();
    for &((angle_rad, scale, blur_px), bounds) in cases {
        let second_from_first = Similarity::about_middle(SIDE as f64, angle_rad, scale);
        let second = extract(&scene.draw(SIDE, &second_from_first, blur_px), None, &options(method));
        let found = compare(&first, &second, &second_from_first);
        let holds = (0..3).all(|k| found[k] >= bounds[k]) && found[3] <= bounds[3];
        // A bound that is far off guards nothing.
        let is_tight = (0..3).all(|k| found[k] < bounds[k] + 0.2) && found[3] > 0.4 * bounds[3];
        if !(holds && is_tight) {
            wrong.push(format!("{:?}: {found:.3?}, bounds {bounds:?}", (angle_rad, scale, blur_px)));
        }
    }
    assert!(wrong.is_empty(), "{method}:\n{}", wrong.join("\n"));
}

// The strongest level of a corner wins, so that places shift a little with scale; blur takes the finest corners away.

#[test]
fn harris_survives_rotation_scale_and_blur() {
    check(
        FeatureMethod::Harris,
        &[
            ((0.6, 1.0, 0.5), [0.8, 0.75, 0.97, 0.16]),
            ((0.0, 1.25, 0.5), [0.88, 0.72, 0.96, 0.45]),
            ((0.2, 1.0, 1.2), [0.22, 0.1, 0.9, 0.8]),
        ],
    );
}

#[test]
fn fast_survives_rotation_scale_and_blur() {
    check(
        FeatureMethod::Fast,
        &[
            ((0.6, 1.0, 0.5), [0.72, 0.65, 0.96, 0.22]),
            ((0.0, 1.25, 0.5), [0.75, 0.6, 0.95, 0.45]),
            ((0.2, 1.0, 1.2), [0.15, 0.07, 0.9, 0.75]),
        ],
    );
}

#[test]
fn orb_survives_rotation_scale_and_blur() {
    check(
        FeatureMethod::Orb,
        &[
            ((0.6, 1.0, 0.5), [0.7, 0.5, 0.96, 0.18]),
            ((0.0, 1.25, 0.5), [0.75, 0.24, 0.92, 0.42]),
            ((0.2, 1.0, 1.2), [0.18, 0.03, 0.8, 0.7]),
        ],
    );
}

#[test]
fn surf_survives_rotation_scale_and_blur() {
    check(
        FeatureMethod::Surf,
        &[
            ((0.6, 1.0, 0.5), [0.6, 0.4, 0.95, 0.6]),
            ((0.0, 1.25, 0.5), [0.64, 0.5, 0.93, 0.85]),
            ((0.2, 1.0, 1.2), [0.6, 0.45, 0.95, 0.45]),
        ],
    );
}

#[test]
fn upright_surf_survives_scale_and_small_turns() {
    check(
        FeatureMethod::SurfUpright,
        &[((0.1, 1.0, 0.5), [0.78, 0.72, 0.95, 0.25]), ((0.0, 1.25, 0.5), [0.64, 0.58, 0.95, 0.8])],
    );
}

#[test]
fn images_without_features_are_no_error() {
    for method in FeatureMethod::ALL {
        for (width, height) in [(0, 0), (1, 1), (3, 40), (17, 400), (40, 40), (41, 41), (64, 64), (97, 53)] {
            let flat = GrayImage { width, height, data: vec![77; width * height] };
            let features = extract(&flat, None, &options(method));
            assert!(features.is_empty(), "{method}: {width} x {height}");
            assert_eq!(features.kind, method.descriptors(), "{method}");
        }
        let broken = GrayImage { width: 90, height: 90, data: vec![1; 7] };
        assert!(extract(&broken, None, &options(method)).is_empty(), "{method}");
    }
}

#[test]
fn small_images_full_of_texture_have_features_or_none_and_never_panic() {
    let mut state = 9_u64;
    let mut byte = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 56) as u8
    };
    for side in (1..20).chain([31, 32, 33, 40, 41, 47, 48, 49, 64, 65]) {
        for (width, height) in [(side, side), (side, 70), (70, side)] {
            let image = GrayImage { width, height, data: (0..width * height).map(|_| byte()).collect() };
            for method in FeatureMethod::ALL {
                let features = extract(&image, None, &options(method));
                let is_inside = |k: &terrane_scene::Keypoint| {
                    (0.0..=width as f32).contains(&k.x_px) && (0.0..=height as f32).contains(&k.y_px)
                };
                assert!(features.keypoints.iter().all(is_inside), "{method}: {width} x {height}");
            }
        }
    }
}

#[test]
fn features_keep_the_contract() {
    let scene = Scene::random(300, 200.0, 5);
    let luma = scene.draw(200, &Similarity::about_middle(200.0, 0.0, 1.0), 0.5);
    let pixels = luma.data.iter().flat_map(|v| [*v, 1, 2]).collect();
    let rgb = RgbImage { width: 200, height: 200, data: pixels };
    for method in FeatureMethod::ALL {
        let all = extract(&luma, Some(&rgb), &options(method));
        assert!(all.len() > 100, "{method}: {}", all.len());
        assert_eq!(all.kind, method.descriptors());
        assert_eq!(all.descriptors.len(), all.len() * all.kind.num_bytes());
        assert!(all.colors.iter().all(|color| color[1..] == [1, 2]), "{method}");
        let mut few = options(method);
        (few.sift.max_features, few.corners.max_features, few.surf.max_features) = (50, 50, 50);
        let few = extract(&luma, Some(&rgb), &few);
        // SIFT counts blobs, and some have a second orientation.
        let most = if matches!(method, FeatureMethod::Sift | FeatureMethod::SiftAffine) { 75 } else { 50 };
        assert!((50..=most).contains(&few.len()), "{method}: {}", few.len());
        assert_eq!(few.keypoints[0], all.keypoints[0], "{method}");
        let on_threads = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
            pool.install(|| extract(&luma, Some(&rgb), &options(method)))
        };
        assert_eq!(on_threads(1), on_threads(3), "{method}");
    }
}

#[test]
fn upright_features_take_the_photograph_s_axes() {
    let scene = Scene::random(200, 160.0, 6);
    let luma = scene.draw(160, &Similarity::about_middle(160.0, 0.0, 1.0), 0.5);
    for method in [FeatureMethod::SiftUpright, FeatureMethod::SurfUpright] {
        let features = extract(&luma, None, &options(method));
        assert!(
            features.len() > 30 && features.keypoints.iter().all(|k| k.orientation_rad == 0.0),
            "{method}"
        );
    }
}

#[test]
fn names_are_read_back_and_unknown_ones_refused_with_the_known() {
    for method in FeatureMethod::ALL {
        assert_eq!(method.name().parse::<FeatureMethod>().expect("its own name"), method);
    }
    let refused = "bogus".parse::<FeatureMethod>().unwrap_err();
    assert!(refused.is_invalid_option());
    let message = refused.to_string();
    for method in FeatureMethod::ALL {
        assert!(message.contains(method.name()), "{message}");
    }
}

#[test]
fn options_name_every_field_that_is_wrong() {
    let mut wrong = options(FeatureMethod::Orb);
    assert!(wrong.validate().is_ok());
    (wrong.corners.level_scale, wrong.corners.fast_threshold, wrong.surf.spread) = (1.0, 0, 7.0);
    let message = wrong.validate().unwrap_err().to_string();
    assert!(message.contains("level_scale") && message.contains("fast_threshold"), "{message}");
    assert!(!message.contains("spread"), "{message}");
    wrong.method = FeatureMethod::Surf;
    assert!(wrong.validate().unwrap_err().to_string().contains("spread"));
}
