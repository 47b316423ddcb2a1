//! Placing parts of a known scene.

use nalgebra::Vector3;
use terrane_geometry::{Seed, Sim3, so3};
use terrane_scene::{ImageId, Reconstruction};

use super::*;
use crate::SubmapSummary;
use crate::align::{AlignOptions, Seam, SeamEvidence, SeamOutcome, SeamVerdict, align};
use crate::georegister::{GeoOutcome, LocalPosition};
use crate::statistics::rms;
use crate::test_support::{Draws, Noise, USUAL, block, submap};

const SEED: Seed = Seed(31);

/// An aerial block of 6 × 8 in four overlapping quarters, each moved by a similarity of its own.
struct Quarters {
    truth: Reconstruction,
    parts: Vec<Reconstruction>,
    submaps: Vec<SubmapSummary>,
    seams: Vec<Seam>,
}

/// Splits a block into four by position, with a margin that neighbours share.
fn quarters(noise: Noise) -> Quarters {
    let truth = block(48, 4000).truth;
    let center = |at: usize| truth.images[at].cam_from_world.center();
    let count = truth.images.len();
    let middle = (0..count).map(center).sum::<Vector3<f64>>() / count as f64;
    let margin = 14.0;
    let mut draws = Draws::new(13);
    let mut parts = Vec::new();
    for (right, upper) in [(false, false), (true, false), (false, true), (true, true)] {
        let inside = |x: f64, positive: bool| if positive { x > -margin } else { x < margin };
        let images: Vec<ImageId> = (0..count)
            .filter(|at| inside(center(*at).x - middle.x, right) && inside(center(*at).y - middle.y, upper))
            .map(|at| truth.images[at].image)
            .collect();
        parts.push(submap(&truth, &images, &draws.similarity(), noise, 40 + parts.len() as u64));
    }
    let mut seams = Vec::new();
    for a in 0..4u32 {
        for b in a + 1..4 {
            let outcome = align(&parts[a as usize], &parts[b as usize], &AlignOptions::default(), SEED);
            seams.push(Seam { a, b, outcome });
        }
    }
    let submaps = parts.iter().map(|part| SubmapSummary::of(part, 10)).collect();
    Quarters { truth, parts, submaps, seams }
}

fn positions(truth: &Reconstruction, sigma: f64) -> Vec<LocalPosition> {
    let mut draws = Draws::new(3);
    let position = |image: &terrane_scene::RegisteredImage| LocalPosition {
        image: image.image,
        x_in_enu: image.cam_from_world.center() + sigma * draws.vector(),
        sigma_m: Vector3::repeat(sigma),
    };
    truth.images.iter().map(position).collect()
}

/// RMS distance of cameras from the truth, after the best similarity when `fit`.
fn camera_error(truth: &Reconstruction, images: &[terrane_scene::RegisteredImage], fit: bool) -> f64 {
    let got = Reconstruction { images: images.to_vec(), cameras: truth.cameras.clone(), ..Default::default() };
    terrane_testkit::compare::cameras(&got, truth, fit).expect("enough cameras").center_rmse_m
}

#[test]
fn quarters_come_together_without_positions() {
    let scene = quarters(USUAL);
    let placement = place(&scene.submaps, &scene.seams, &[], &PlaceOptions::default(), SEED);
    assert_eq!(placement.components.len(), 1);
    assert_eq!(placement.components[0].num_images, 48);
    assert!(placement.seams.iter().all(|seam| seam.refused.is_none()), "{:?}", placement.seams);
    let averages = average_cameras(&scene.submaps, &placement, 0, &CameraAverageOptions::default());
    let error_m = camera_error(&scene.truth, &averages.images, true);
    assert!((1e-3..0.15).contains(&error_m), "{error_m} m");
    assert!(matches!(placement.components[0].geo, GeoOutcome::NotRegistered { .. }));
}

#[test]
fn positions_bring_the_whole_home_in_spite_of_outliers() {
    let scene = quarters(USUAL);
    let mut positions = positions(&scene.truth, 2.0);
    let mut draws = Draws::new(77);
    for at in (2..48).step_by(10) {
        positions[at].x_in_enu += 200.0 * draws.vector();
    }
    let placement = place(&scene.submaps, &scene.seams, &positions, &PlaceOptions::default(), SEED);
    let GeoOutcome::Registered { report, .. } = &placement.components[0].geo else { panic!("not registered") };
    assert!((40..=44).contains(&report.num_inliers), "{}", report.num_inliers);
    assert!((1.5..4.5).contains(&report.median_m), "{}", report.median_m);
    let averages = average_cameras(&scene.submaps, &placement, 0, &CameraAverageOptions::default());
    let absolute = camera_error(&scene.truth, &averages.images, false);
    let relative = camera_error(&scene.truth, &averages.images, true);
    assert!((0.05..2.0).contains(&absolute), "{absolute} m");
    assert!(relative < 0.2, "{relative} m");
}

#[test]
fn a_wrong_seam_is_switched_off_with_the_reason() {
    let mut scene = quarters(USUAL);
    let SeamVerdict::Accepted { b_from_a, .. } = &mut scene.seams[1].outcome.verdict else {
        panic!("the seam is true")
    };
    *b_from_a = Sim3::new(b_from_a.scale * 1.3, so3::exp(&Vector3::new(0.2, 0.4, -0.1)) * b_from_a.rotation, b_from_a.translation * 1.5);
    let placement = place(&scene.submaps, &scene.seams, &[], &PlaceOptions::default(), SEED);
    let refused: Vec<usize> =
        (0..scene.seams.len()).filter(|at| placement.seams[*at].refused.is_some()).collect();
    assert_eq!(refused, [1], "{:?}", placement.seams);
    assert!(placement.seams[1].refused.as_ref().is_some_and(|reason| reason.contains("contradict")));
    assert_eq!(placement.components.len(), 1);
    let averages = average_cameras(&scene.submaps, &placement, 0, &CameraAverageOptions::default());
    assert!(camera_error(&scene.truth, &averages.images, true) < 0.2);
}

#[test]
fn refused_seams_part_components_and_the_largest_comes_first() {
    let mut scene = quarters(USUAL);
    for seam in scene.seams.iter_mut().filter(|seam| seam.a == 0) {
        let verdict = SeamVerdict::Refused { reason: "for the test".into() };
        seam.outcome = SeamOutcome { verdict, evidence: SeamEvidence::default() };
    }
    let placement = place(&scene.submaps, &scene.seams, &[], &PlaceOptions::default(), SEED);
    assert_eq!(placement.components.len(), 2);
    assert_eq!(placement.components[0].submaps, [1, 2, 3]);
    assert_eq!(placement.components[1].submaps, [0]);
    assert_eq!(placement.component_of, [1, 0, 0, 0]);
    let alone = average_cameras(&scene.submaps, &placement, 1, &CameraAverageOptions::default());
    assert_eq!(alone.images.len(), scene.submaps[0].images.len());
}

#[test]
fn one_submap_goes_the_same_way() {
    let scene = quarters(USUAL);
    let positions = positions(&scene.truth, 0.5);
    let placement = place(&scene.submaps[..1], &[], &positions, &PlaceOptions::default(), SEED);
    assert_eq!(placement.components.len(), 1);
    assert!(matches!(placement.components[0].geo, GeoOutcome::Registered { .. }));
    let averages = average_cameras(&scene.submaps[..1], &placement, 0, &CameraAverageOptions::default());
    let error_m = camera_error(&scene.truth, &averages.images, false);
    assert!((0.01..0.6).contains(&error_m), "{error_m} m");
}

#[test]
fn nothing_is_placed_nowhere() {
    let placement = place(&[], &[], &[], &PlaceOptions::default(), SEED);
    assert!(placement.components.is_empty());
    assert!(average_cameras(&[], &placement, 0, &CameraAverageOptions::default()).images.is_empty());
}

#[test]
fn the_seams_of_a_good_placement_show_only_the_noise() {
    let scene = quarters(USUAL);
    let positions = positions(&scene.truth, 1.0);
    let placement = place(&scene.submaps, &scene.seams, &positions, &PlaceOptions::default(), SEED);
    let figures: Vec<_> = scene
        .seams
        .iter()
        .map(|seam| {
            let (a, b) = (seam.a as usize, seam.b as usize);
            let world = &placement.world_from_submap;
            crate::seams::measure(&scene.parts[a], &scene.parts[b], &world[a], &world[b])
        })
        .collect();
    // Two centres of 5 cm noise per axis are 12 cm apart, and the metre is that of the positions.
    let distances: Vec<f64> = figures.iter().map(|seam| seam.camera_distance_rms).collect();
    assert!((0.08..0.2).contains(&rms(&distances)), "{distances:?}");
    assert!(figures.iter().all(|seam| seam.point_distance_rms < 0.2 && seam.camera_rotation_rms_deg < 0.3));
}
