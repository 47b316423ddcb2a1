//! Outcomes other than one whole submap, input that contradicts itself, and the same bytes whatever the order or threads.

use terrane_geometry::Seed;
use terrane_scene::{CameraId, ClusterId, ImageFate, ImageId, ImagePair, MatchedPair};
use terrane_testkit::scene::{Layout, SceneOptions, SyntheticScene};

use super::{check_invariants, cluster_of, map};
use crate::{ClusterInput, MappingOptions, reconstruct};

fn empty() -> ClusterInput {
    ClusterInput { cluster: ClusterId(0), images: Vec::new(), cameras: Vec::new(), pairs: Vec::new() }
}

/// Adds a scene with ids that start at `first`.
fn add(input: &mut ClusterInput, scene: &SyntheticScene, first: u32) {
    let moved = |image: ImageId| ImageId(image.0 + first);
    let mut other = cluster_of(scene);
    for image in &mut other.images {
        image.image = moved(image.image);
        image.camera = CameraId(first);
    }
    for pair in &mut other.pairs {
        let ids = pair.summary.pair;
        pair.summary.pair = ImagePair::new(moved(ids.first()), moved(ids.second())).expect("two images");
    }
    input.images.append(&mut other.images);
    input.pairs.append(&mut other.pairs);
    input.cameras.push((CameraId(first), scene.cameras[0].1.clone()));
}

#[test]
fn nothing_in_nothing_out() {
    let (outcome, report) = map(&empty());
    assert!(outcome.submaps.is_empty() && outcome.fates.is_empty());
    assert_eq!(report.num_images, 0);
}

#[test]
fn a_panorama_has_no_depth() {
    let options =
        SceneOptions { layout: Layout::Panorama { step_rad: 0.2 }, num_images: 8, ..SceneOptions::default() };
    let scene = SyntheticScene::new(&options);
    let mut input = cluster_of(&scene);
    let (outcome, _) = map(&input);
    assert!(outcome.submaps.is_empty());
    for (_, fate) in &outcome.fates {
        assert!(matches!(fate, ImageFate::LeftOut { reason } if reason.contains("turned")), "{fate:?}");
    }
    // And when verification took the pairs for something better.
    for pair in &mut input.pairs {
        pair.summary.kind = terrane_scene::PairKind::Calibrated;
    }
    let (outcome, report) = map(&input);
    assert!(outcome.submaps.is_empty(), "{report:?}");
    for (_, fate) in &outcome.fates {
        assert!(matches!(fate, ImageFate::LeftOut { reason } if !reason.is_empty()), "{fate:?}");
    }
}

#[test]
fn two_components_and_a_stranger() {
    let big = SyntheticScene::new(&SceneOptions::default());
    let small =
        SyntheticScene::new(&SceneOptions { num_images: 7, seed: Seed(5), ..SceneOptions::default() });
    let mut input = empty();
    add(&mut input, &small, 0);
    add(&mut input, &big, 100);
    let mut stranger = cluster_of(&big).images.remove(0);
    stranger.image = ImageId(50);
    stranger.camera = CameraId(100);
    input.images.push(stranger);
    let (outcome, report) = map(&input);
    assert_eq!(
        outcome.submaps.iter().map(|submap| submap.reconstruction.images.len()).collect::<Vec<_>>(),
        [12, 7]
    );
    outcome.submaps.iter().for_each(|submap| check_invariants(&submap.reconstruction));
    assert_eq!(outcome.fates.len(), 20);
    for (image, fate) in &outcome.fates {
        match image.0 {
            50 => {
                assert!(matches!(fate, ImageFate::LeftOut { reason } if reason.contains("no verified pair")))
            }
            0..50 => assert_eq!(*fate, ImageFate::Registered { submap: 1 }),
            _ => assert_eq!(*fate, ImageFate::Registered { submap: 0 }),
        }
    }
    assert_eq!(report.num_registered, 19);
}

#[test]
fn two_images_are_enough() {
    let scene = SyntheticScene::new(&SceneOptions::default());
    let mut input = cluster_of(&scene);
    input.images.truncate(2);
    input.pairs.retain(|pair| pair.summary.pair.second() < ImageId(2));
    let (outcome, report) = map(&input);
    assert_eq!(outcome.submaps.len(), 1, "{report:?}");
    check_invariants(&outcome.submaps[0].reconstruction);
    assert!(outcome.submaps[0].reconstruction.points.len() > 500);
}

#[test]
fn a_wrong_image_stays_out() {
    let scene = SyntheticScene::new(&SceneOptions::default());
    let mut input = cluster_of(&scene);
    // Every match of the last image is shuffled, as if it showed another place with the same windows.
    let wrong = ImageId(11);
    for pair in input.pairs.iter_mut().filter(|pair| pair.summary.pair.second() == wrong) {
        let count = pair.matches.len();
        let seconds: Vec<u32> = pair.matches.iter().map(|entry| entry[1]).collect();
        for (at, entry) in pair.matches.iter_mut().enumerate() {
            entry[1] = seconds[(at * 7 + count / 3) % count];
        }
    }
    let (outcome, _) = map(&input);
    assert_eq!(outcome.submaps.len(), 1);
    assert_eq!(outcome.submaps[0].reconstruction.images.len(), 11);
    assert!(
        matches!(&outcome.fates[11].1, ImageFate::LeftOut { reason } if reason.contains("agree on a pose"))
    );
}

#[test]
fn same_bytes_for_any_threads_and_order() {
    let options = SceneOptions { outlier_fraction: 0.2, num_images: 10, ..SceneOptions::default() };
    let input = cluster_of(&SyntheticScene::new(&options));
    let in_pool = |threads: usize, input: &ClusterInput| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| map(input))
    };
    let one = in_pool(1, &input);
    assert_eq!(one, in_pool(2, &input));
    let mut turned = input.clone();
    turned.images.reverse();
    turned.pairs.reverse();
    assert_eq!(one, in_pool(3, &turned));
}

#[test]
fn contradictions_are_refused() {
    let sound = cluster_of(&SyntheticScene::new(&SceneOptions { num_images: 3, ..SceneOptions::default() }));
    let check = |change: &dyn Fn(&mut ClusterInput), wanted: &str| {
        let mut input = sound.clone();
        change(&mut input);
        let error = reconstruct(&input, &MappingOptions::default(), Seed(1)).expect_err(wanted);
        assert!(error.is_invalid_input());
        assert!(error.to_string().contains(wanted), "{error}");
    };
    check(&|input| input.images.push(input.images[0].clone()), "image 0 occurs twice");
    check(&|input| input.cameras.push(input.cameras[0].clone()), "camera 0 occurs twice");
    check(&|input| input.cameras.clear(), "image 0 names camera 0");
    check(&|input| input.images[1].colors.truncate(1), "image 1 has");
    check(&|input| input.images[1].keypoints_px[0][1] = f32::NAN, "image 1 has a keypoint");
    check(&|input| input.cameras[0].1.camera.params_mut()[0] = 0.0, "camera 0 has parameters");
    check(&|input| input.images.truncate(2), "pair 0-2 names an image");
    check(&|input| input.pairs.push(input.pairs[0].clone()), "pair 0-1 occurs twice");
    check(&|input| input.pairs[0].matches[0][1] = u32::MAX, "image 1 lacks");
    let mut options = MappingOptions::default();
    options.registration.min_inliers = 1;
    let error = reconstruct(&sound, &options, Seed(1)).expect_err("too few");
    assert!(error.to_string().contains("mapping.registration.min_inliers"), "{error}");
}

#[test]
fn images_without_features_or_matches_do_no_harm() {
    let mut input =
        cluster_of(&SyntheticScene::new(&SceneOptions { num_images: 4, ..SceneOptions::default() }));
    input.images[1].keypoints_px.clear();
    input.images[1].colors.clear();
    input.pairs.retain(|pair| pair.summary.pair.other(ImageId(1)).is_none());
    if let Some(pair) = input.pairs.first().cloned() {
        input.pairs[0] = MatchedPair { matches: Vec::new(), ..pair };
    }
    let (outcome, _) = map(&input);
    assert!(matches!(&outcome.fates[1].1, ImageFate::LeftOut { reason } if reason.contains("no features")));
}
