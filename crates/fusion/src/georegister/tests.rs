//! Geo-referencing a known scene: precise where it can be, named where it can't.

use nalgebra::UnitQuaternion;
use terrane_geometry::geodesy::Geodetic;
use terrane_geometry::{Camera, CameraModel, Rigid3, Seed};
use terrane_scene::{
    CameraId, CameraRecord, FocalSource, GpsPrior, ImageRecord, ImageTable, Orientation, RegisteredImage,
};

use super::*;
use crate::test_support::{Draws, block};

const SEED: Seed = Seed(21);
const SIGMA_M: f64 = 2.0;

/// Cameras of an aerial block in a frame of their own, their noisy positions, and the truth.
fn located(noise_m: f64, seed: u64) -> (Vec<RegisteredImage>, Vec<LocalPosition>, Sim3) {
    let scene = block(60, 500);
    let mut draws = Draws::new(seed);
    let enu_from_local = draws.similarity();
    let local_from_enu = enu_from_local.inverse();
    let (mut images, mut positions) = (Vec::new(), Vec::new());
    for image in &scene.truth.images {
        let x_in_enu = image.cam_from_world.center() + noise_m * draws.vector();
        positions.push(LocalPosition { image: image.image, x_in_enu, sigma_m: Vector3::repeat(SIGMA_M) });
        let cam_from_world = local_from_enu.transform_camera(&image.cam_from_world);
        images.push(RegisteredImage { cam_from_world, ..*image });
    }
    (images, positions, enu_from_local)
}

/// RMS distance between where two similarities put the cameras.
fn distance(images: &[RegisteredImage], a: &Sim3, b: &Sim3) -> f64 {
    let all: Vec<f64> = images
        .iter()
        .map(|image| image.cam_from_world.center())
        .map(|x| (a.transform_point(&x) - b.transform_point(&x)).norm())
        .collect();
    crate::statistics::rms(&all)
}

fn registered(outcome: &GeoOutcome) -> (&Sim3, &GeoReport) {
    match outcome {
        GeoOutcome::Registered { enu_from_local, report } => (enu_from_local, report),
        GeoOutcome::NotRegistered { reason, .. } => panic!("not registered: {reason}"),
    }
}

fn reason(outcome: &GeoOutcome) -> &str {
    match outcome {
        GeoOutcome::Registered { report, .. } => panic!("registered: {report:?}"),
        GeoOutcome::NotRegistered { reason, .. } => reason,
    }
}

#[test]
fn exact_positions_give_the_truth() {
    let (images, positions, truth) = located(0.0, 1);
    let outcome = register(&images, &positions, &GeoOptions::default(), SEED);
    let (found, report) = registered(&outcome);
    assert!(distance(&images, found, &truth) < 1e-6);
    assert_eq!(report.num_inliers, 60);
}

#[test]
fn noise_is_averaged_over_the_cameras() {
    let (images, positions, truth) = located(SIGMA_M, 2);
    let outcome = register(&images, &positions, &GeoOptions::default(), SEED);
    let (found, report) = registered(&outcome);
    // Seven parameters from 180 numbers: the fit is about sqrt(7 / 60) of the noise.
    let error_m = distance(&images, found, &truth);
    assert!((0.1..1.4).contains(&error_m), "{error_m} m");
    assert!((2.4..4.2).contains(&report.median_m), "{} m", report.median_m);
}

#[test]
fn one_position_in_ten_may_be_anywhere() {
    let (images, mut positions, truth) = located(SIGMA_M, 3);
    let mut draws = Draws::new(9);
    for k in (3..60).step_by(10) {
        positions[k].x_in_enu += 150.0 * draws.vector();
    }
    let outcome = register(&images, &positions, &GeoOptions::default(), SEED);
    let (found, report) = registered(&outcome);
    assert!(distance(&images, found, &truth) < 1.6, "{} m", distance(&images, found, &truth));
    assert!((50..=54).contains(&report.num_inliers), "{}", report.num_inliers);
}

#[test]
fn a_constant_height_error_is_absorbed_and_receivers_may_be_worse_than_they_say() {
    let (images, mut positions, truth) = located(3.0 * SIGMA_M, 4);
    positions.iter_mut().for_each(|position| position.x_in_enu.z += 48.0);
    let outcome = register(&images, &positions, &GeoOptions::default(), SEED);
    let (found, report) = registered(&outcome);
    let mut lifted = truth;
    lifted.translation.z += 48.0;
    assert!(distance(&images, found, &lifted) < 4.0, "{} m", distance(&images, found, &lifted));
    assert!(report.num_inliers >= 50);
}

#[test]
fn what_positions_cannot_tell_is_named() {
    let (images, positions, _) = located(0.0, 5);
    let options = GeoOptions::default();
    let few = register(&images, &positions[..2], &options, SEED);
    assert!(reason(&few).contains("2 registered photographs"), "{}", reason(&few));
    let none = register(&images, &[], &options, SEED);
    assert!(reason(&none).contains("0 registered photographs"));
    let mut equal = positions.clone();
    equal.iter_mut().for_each(|position| position.x_in_enu = Vector3::new(1.0, 2.0, 3.0));
    assert!(reason(&register(&images, &equal, &options, SEED)).contains("all equal"));
    let mut line = positions.clone();
    line.iter_mut().for_each(|position| position.x_in_enu.y = 0.3 * position.x_in_enu.x);
    assert!(reason(&register(&images, &line, &options, SEED)).contains("on a line"));
    let mut unrelated = positions.clone();
    let mut draws = Draws::new(3);
    unrelated.iter_mut().for_each(|position| position.x_in_enu = 500.0 * draws.vector());
    assert!(reason(&register(&images, &unrelated, &options, SEED)).contains("agree"));
}

#[test]
fn without_a_reference_up_is_up_and_two_positions_give_the_scale() {
    let (images, positions, truth) = located(0.0, 6);
    let outcome = register(&images, &positions[..1], &GeoOptions::default(), SEED);
    let GeoOutcome::NotRegistered { frame_from_local, .. } = outcome else {
        panic!("one position is enough?")
    };
    // The block looks down: up is against the view.
    let up_in_local = truth.rotation.inverse() * Vector3::z();
    let angle = (frame_from_local.rotation * up_in_local).angle(&Vector3::z());
    assert!(angle < 0.2, "{angle} rad");
    let two = [positions[0], positions[59]];
    let outcome = register(&images, &two, &GeoOptions::default(), SEED);
    let GeoOutcome::NotRegistered { frame_from_local, .. } = outcome else {
        panic!("two positions are enough?")
    };
    assert!((frame_from_local.scale / truth.scale - 1.0).abs() < 1e-6);
}

fn table(positions: &[Option<GpsPrior>]) -> ImageTable {
    let camera = Camera::centered(CameraModel::SimpleRadial, 100, 80, 90.0);
    let images = positions.iter().enumerate().map(|(at, gps)| ImageRecord {
        path: format!("{at:03}.jpg"),
        content_hash: String::new(),
        camera: CameraId(0),
        width_px: 100,
        height_px: 80,
        orientation: Orientation::default(),
        gps: *gps,
        flight: None,
        captured_s: None,
    });
    let record = CameraRecord { camera, focal_source: FocalSource::Exif, name: String::new() };
    ImageTable { cameras: vec![record], images: images.collect(), rejected: Vec::new() }
}

fn gps(latitude_deg: f64, longitude_deg: f64, altitude_m: Option<f64>) -> Option<GpsPrior> {
    let (sigma_horizontal_m, sigma_vertical_m) = (5.0, 10.0);
    Some(GpsPrior { latitude_deg, longitude_deg, altitude_m, sigma_horizontal_m, sigma_vertical_m })
}

#[test]
fn positions_are_metres_from_their_median() {
    let table =
        table(&[gps(47.0, 8.0, Some(500.0)), None, gps(47.001, 8.0, Some(510.0)), gps(46.999, 8.0, None)]);
    let local = local_positions(&table).expect("there are positions");
    assert_eq!(local.origin, EnuOrigin { latitude_deg: 47.0, longitude_deg: 8.0, height_m: 510.0 });
    assert_eq!(local.num_without_altitude, 1);
    let north = local.of(terrane_scene::ImageId(2)).expect("it has one").x_in_enu;
    assert!((north.y - 111.2).abs() < 0.2 && north.x.abs() < 1e-6 && north.z.abs() < 1e-2, "{north:?}");
    let back = local.origin.frame().geodetic_from_enu(&north);
    assert!((back.latitude_deg() - 47.001).abs() < 1e-9);
    let origin = Geodetic::from_degrees(47.0, 8.0, 510.0);
    assert!((local.origin.frame().origin().height_m - origin.height_m).abs() < 1e-12);
}

#[test]
fn positions_that_cannot_be_true_are_left_out() {
    let bad =
        [gps(0.0, 0.0, Some(0.0)), gps(f64::NAN, 8.0, None), gps(95.0, 8.0, None), gps(47.0, 8.0, Some(1e9))];
    assert!(local_positions(&table(&bad)).is_none());
    let mut mixed = vec![gps(47.0, 8.0, Some(500.0)); 3];
    mixed.extend(bad);
    mixed.push(gps(-47.0, 8.0, Some(500.0)));
    let local = local_positions(&table(&mixed)).expect("three are good");
    assert_eq!(local.positions.len(), 3);
    assert_eq!(local.rejected.len(), 5);
}

#[test]
fn no_cameras_is_an_outcome() {
    let outcome = register(&[], &[], &GeoOptions::default(), SEED);
    assert!(matches!(outcome, GeoOutcome::NotRegistered { .. }));
    let one = RegisteredImage {
        image: terrane_scene::ImageId(0),
        camera: CameraId(0),
        cam_from_world: Rigid3::new(UnitQuaternion::identity(), Vector3::zeros()),
    };
    assert!(matches!(register(&[one], &[], &GeoOptions::default(), SEED), GeoOutcome::NotRegistered { .. }));
}
