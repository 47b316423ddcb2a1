//! Whole mappings of synthetic scenes against their truth.

mod bookkeeping;
mod outcomes;
mod scenes;

use terrane_geometry::Seed;
use terrane_scene::{ClusterId, ImageFate, Reconstruction, SubmapOutcome};
use terrane_testkit::compare::{self, Comparison};
use terrane_testkit::scene::{SceneOptions, SyntheticScene};

use crate::{ClusterImage, ClusterInput, MappingOptions, MappingReport, reconstruct};

/// A scene as a cluster.
fn cluster_of(scene: &SyntheticScene) -> ClusterInput {
    let images = scene.images.iter().map(|image| ClusterImage {
        image: image.image,
        camera: image.camera,
        keypoints_px: image.keypoints_px.clone(),
        colors: image.colors.clone(),
        position_prior: None,
    });
    ClusterInput {
        cluster: ClusterId(3),
        images: images.collect(),
        cameras: scene.cameras.clone(),
        pairs: scene.pairs.clone(),
    }
}

fn map(input: &ClusterInput) -> (SubmapOutcome, MappingReport) {
    reconstruct(input, &MappingOptions::default(), Seed(7)).expect("the input is sound")
}

/// Maps a scene whose images must all end in one submap, and compares it with the truth.
fn map_whole(options: &SceneOptions) -> (Reconstruction, Comparison, MappingReport) {
    let scene = SyntheticScene::new(options);
    let (outcome, report) = map(&cluster_of(&scene));
    for (image, fate) in &outcome.fates {
        assert_eq!(*fate, ImageFate::Registered { submap: 0 }, "image {image}");
    }
    assert_eq!(outcome.submaps.len(), 1);
    let result = outcome.submaps.into_iter().next().expect("one submap").reconstruction;
    check_invariants(&result);
    let comparison = compare::cameras(&result, &scene.truth, true).expect("at least three images");
    (result, comparison, report)
}

/// What every reconstruction promises.
fn check_invariants(result: &Reconstruction) {
    assert!(result.images.windows(2).all(|two| two[0].image < two[1].image));
    assert!(result.images.iter().all(|image| result.camera(image.camera).is_some()));
    let mut next = 0;
    for point in &result.points {
        assert_eq!(point.first_observation, next);
        next += u64::from(point.num_observations);
        let track = result.track(point);
        assert!(track.len() >= 2);
        assert!(
            track.windows(2).all(|two| two[0].image < two[1].image),
            "one observation of an image, ascending"
        );
        for observation in track {
            let error_px = result.reprojection_error_px(&point.x_in_world, observation);
            assert!(error_px.is_some_and(|error_px| error_px <= 4.0 + 1e-3), "{error_px:?}");
        }
    }
    assert_eq!(next, result.observations.len() as u64);
}
