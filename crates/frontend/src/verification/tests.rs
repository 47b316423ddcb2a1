//! Kinds, inliers and poses against known two-view scenes.

mod sweeps;

use super::*;
use nalgebra::{UnitQuaternion, Vector2, Vector3};
use rand::RngExt;
use terrane_geometry::{Camera, CameraModel, Rigid3, so3};
use terrane_scene::{Features, FocalSource, ImageId, PairKind};

use crate::matching::MatchOptions;

const WIDTH: u32 = 1200;
const HEIGHT: u32 = 900;
const NOISE_PX: f64 = 0.5;

fn record(focal_px: f64, focal_source: FocalSource) -> CameraRecord {
    let camera = Camera::centered(CameraModel::SimpleRadial, WIDTH, HEIGHT, focal_px);
    CameraRecord { camera, focal_source, name: "test".into() }
}

fn pose(turn: Vector3<f64>, center: Vector3<f64>) -> Rigid3 {
    Rigid3::from_rotation_and_center(so3::exp(&turn), &center)
}

/// Keypoints of two images and the matches between them, the true ones first.
#[derive(Default)]
struct Scene {
    first: Vec<Keypoint>,
    second: Vec<Keypoint>,
    matches: Vec<Match>,
    num_true: usize,
}

impl Scene {
    fn push(&mut self, first: Vector2<f64>, second: Vector2<f64>, ratio: f32) {
        let keypoint = |point: Vector2<f64>| Keypoint {
            x_px: point.x as f32,
            y_px: point.y as f32,
            scale_px: 2.0,
            orientation_rad: 0.0,
        };
        let index = self.first.len() as u32;
        self.first.push(keypoint(first));
        self.second.push(keypoint(second));
        self.matches.push(Match { first: index, second: index, ratio });
    }

    /// Points at `depth(x, y)` metres along the rays of random pixels, seen from the origin and from `second_from_first`.
    fn observed(
        count: usize,
        second_from_first: &Rigid3,
        depth: impl Fn(f64, f64, f64) -> f64,
        seed: u64,
    ) -> Self {
        Self::observed_at(1000.0, count, second_from_first, depth, seed)
    }

    /// The same with a focal length.
    fn observed_at(
        focal_px: f64,
        count: usize,
        second_from_first: &Rigid3,
        depth: impl Fn(f64, f64, f64) -> f64,
        seed: u64,
    ) -> Self {
        let camera = record(focal_px, FocalSource::Given).camera;
        let mut rng = Seed(seed).rng();
        let mut scene = Self::default();
        while scene.first.len() < count {
            let xy = Vector2::new(rng.random_range(0.0..1200.0), rng.random_range(0.0..900.0));
            let Some(normalized) = camera.unproject(&xy) else { continue };
            let x = normalized.push(1.0) * depth(normalized.x, normalized.y, rng.random_range(0.0..1.0));
            let Some(seen) = camera.project(&second_from_first.transform_point(&x)) else { continue };
            if !(0.0..1200.0).contains(&seen.x) || !(0.0..900.0).contains(&seen.y) {
                continue;
            }
            let mut noise = || {
                let twelve: f64 = (0..12).map(|_| rng.random_range(-0.5..0.5)).sum();
                NOISE_PX * twelve
            };
            let (xy, seen) = (xy + Vector2::new(noise(), noise()), seen + Vector2::new(noise(), noise()));
            let ratio = rng.random_range(0.2..0.7);
            scene.push(xy, seen, ratio);
        }
        scene.num_true = count;
        scene
    }

    fn with_outliers(mut self, count: usize, seed: u64) -> Self {
        let mut rng = Seed(seed).rng();
        for _ in 0..count {
            let mut point = || Vector2::new(rng.random_range(0.0..1200.0), rng.random_range(0.0..900.0));
            let (first, second) = (point(), point());
            self.push(first, second, rng.random_range(0.4..0.8));
        }
        self
    }

    /// Adds a stamp in the lower left corner that is the same in both images.
    fn with_stamp(mut self, count: usize, seed: u64) -> Self {
        let mut rng = Seed(seed).rng();
        for _ in 0..count {
            let point = Vector2::new(rng.random_range(20.0..200.0), rng.random_range(850.0..890.0));
            self.push(point, point, rng.random_range(0.0..0.3));
        }
        self
    }

    fn verify_with(
        &self,
        camera: &CameraRecord,
        options: &VerificationOptions,
    ) -> Result<MatchedPair, NotVerified> {
        let candidate = Candidate {
            pair: ImagePair::new(ImageId(3), ImageId(7)).expect("two images"),
            first: View { camera, keypoints: &self.first },
            second: View { camera, keypoints: &self.second },
            matches: &self.matches,
        };
        verify(&candidate, options, Seed(5))
    }

    fn verify(&self, focal_px: f64, focal_source: FocalSource) -> Result<MatchedPair, NotVerified> {
        self.verify_with(&record(focal_px, focal_source), &VerificationOptions::default())
    }

    /// True matches found, and others.
    fn judge(&self, found: &MatchedPair) -> (usize, usize) {
        let right = found.matches.iter().filter(|pair| (pair[0] as usize) < self.num_true).count();
        (right, found.matches.len() - right)
    }
}

/// Errors of rotation and direction in degrees.
fn pose_error_deg(found: &MatchedPair, truth: &Rigid3) -> (f64, f64) {
    let pose = found.summary.second_from_first.expect("a pose");
    let direction = truth.translation.angle(&pose.translation);
    (pose.rotation.angle_to(&truth.rotation).to_degrees(), direction.to_degrees())
}

fn deep(_: f64, _: f64, at: f64) -> f64 {
    6.0 + 10.0 * at
}

fn side_step() -> Rigid3 {
    pose(Vector3::new(0.02, -0.15, 0.05), Vector3::new(2.0, 0.2, -0.3))
}

#[test]
fn a_scene_with_depth_is_calibrated() {
    let truth = side_step();
    let scene = Scene::observed(400, &truth, deep, 1).with_outliers(200, 2);
    let found = scene.verify(1000.0, FocalSource::Exif).expect("verified");
    assert_eq!(found.summary.kind, PairKind::Calibrated);
    let (right, wrong) = scene.judge(&found);
    assert!(right >= 396 && wrong <= 8, "{right} right, {wrong} wrong");
    let (rotation, direction) = pose_error_deg(&found, &truth);
    assert!(rotation < 0.1 && direction < 0.5, "{rotation} {direction}");
    assert!(rotation > 1e-5, "noise must show");
    assert!((found.summary.second_from_first.expect("a pose").translation.norm() - 1.0).abs() < 1e-9);
    let angle_deg = found.summary.median_angle_rad.to_degrees();
    assert!(angle_deg > 8.0 && angle_deg < 14.0, "{angle_deg}");
    assert_eq!(found.summary.num_inliers as usize, found.matches.len());
    assert!(found.matches.is_sorted());
}

#[test]
fn a_guessed_focal_length_gives_an_uncalibrated_pair_with_a_pose() {
    let truth = side_step();
    let scene = Scene::observed(400, &truth, deep, 3).with_outliers(100, 4);
    for factor in [0.8, 1.0, 1.3] {
        let found = scene.verify(1000.0 * factor, FocalSource::Guess).expect("verified");
        assert_eq!(found.summary.kind, PairKind::Uncalibrated);
        let (right, wrong) = scene.judge(&found);
        assert!(right >= 390 && wrong <= 6, "{factor}: {right} right, {wrong} wrong");
        let (rotation, direction) = pose_error_deg(&found, &truth);
        assert!(rotation < 3.0 && direction < 4.0, "{factor}: {rotation} {direction}");
    }
}

#[test]
fn a_plane_is_planar_and_keeps_its_pose() {
    let truth = side_step();
    let plane = |x: f64, y: f64, _: f64| 10.0 / (1.0 + 0.3 * x - 0.2 * y);
    let scene = Scene::observed(300, &truth, plane, 5).with_outliers(100, 6);
    let found = scene.verify(1000.0, FocalSource::Exif).expect("verified");
    assert_eq!(found.summary.kind, PairKind::Planar);
    assert!(scene.judge(&found).0 >= 296);
    let (rotation, direction) = pose_error_deg(&found, &truth);
    assert!(rotation < 3.0 && direction < 4.0, "{rotation} {direction}");
}

#[test]
fn a_turn_on_the_spot_has_no_baseline() {
    let truth = pose(Vector3::new(0.05, 0.2, -0.03), Vector3::zeros());
    let scene = Scene::observed(300, &truth, deep, 7).with_outliers(100, 8);
    let found = scene.verify(1000.0, FocalSource::Exif).expect("verified");
    assert_eq!(found.summary.kind, PairKind::Panoramic);
    assert!(!found.summary.kind.has_baseline());
    let turn = found.summary.second_from_first.expect("a rotation");
    assert_eq!(turn.translation, Vector3::zeros());
    assert!(turn.rotation.angle_to(&truth.rotation).to_degrees() < 0.05);
    assert_eq!(found.summary.median_angle_rad, 0.0);
    assert!(scene.judge(&found).0 >= 296);
}

#[test]
fn an_image_and_its_copy_have_no_baseline() {
    let scene = Scene::observed(200, &Rigid3::identity(), deep, 9);
    let mut copy = Scene { num_true: 200, ..Scene::default() };
    for keypoint in &scene.first {
        let xy = Vector2::new(f64::from(keypoint.x_px), f64::from(keypoint.y_px));
        copy.push(xy, xy, 0.0);
    }
    for source in [FocalSource::Given, FocalSource::Exif, FocalSource::Guess] {
        let found = copy.verify(1000.0, source).expect("verified");
        assert_eq!(found.summary.kind, PairKind::Panoramic, "{source:?}");
        assert_eq!(found.matches.len(), 200);
        let turn = found.summary.second_from_first.expect("a rotation");
        assert!(turn.rotation.angle_to(&UnitQuaternion::identity()) < 1e-6);
    }
}

#[test]
fn a_stamp_alone_is_a_watermark_and_beside_a_scene_it_is_left_out() {
    let alone = Scene::default().with_stamp(60, 10).with_outliers(30, 11);
    let found = alone.verify(1000.0, FocalSource::Exif).expect("verified");
    assert_eq!(found.summary.kind, PairKind::Watermark);
    assert_eq!(found.summary.second_from_first, None);

    let truth = side_step();
    let stamped = Scene::observed(100, &truth, deep, 12).with_stamp(80, 13);
    let found = stamped.verify(1000.0, FocalSource::Exif).expect("verified");
    assert_eq!(found.summary.kind, PairKind::Calibrated);
    let (right, wrong) = stamped.judge(&found);
    assert!(right >= 98 && wrong == 0, "{right} right, {wrong} wrong");
}

#[test]
fn strangers_are_not_verified_and_the_reason_is_named() {
    let options = VerificationOptions::default();
    let camera = record(1000.0, FocalSource::Exif);
    let few = Scene::default().with_outliers(14, 14);
    assert_eq!(few.verify_with(&camera, &options), Err(NotVerified::TooFewMatches { found: 14, needed: 15 }));
    let many = Scene::default().with_outliers(60, 15);
    let Err(NotVerified::TooFewInliers { found, matches, needed }) = many.verify_with(&camera, &options)
    else {
        panic!("random matches have no geometry");
    };
    assert!((5..15).contains(&found) && matches == 60 && needed == 15, "{found}");
}

#[test]
fn broken_input_is_survived() {
    let mut scene = Scene::observed(100, &side_step(), deep, 16);
    scene.first[3].x_px = f32::NAN;
    scene.second[4].y_px = f32::INFINITY;
    scene.matches.push(Match { first: 1_000_000, second: 0, ratio: 0.1 });
    scene.matches.push(Match { first: 0, second: 1, ratio: f32::NAN });
    let found = scene.verify(1000.0, FocalSource::Exif).expect("verified");
    assert!(found.matches.len() >= 95 && found.matches.len() <= 98, "{}", found.matches.len());
    for focal in [0.0, f64::NAN, f64::INFINITY, -1.0] {
        // Whatever comes out, nothing panics.
        let _ = scene.verify(focal, FocalSource::Given);
    }
    let one_point =
        Scene { first: vec![scene.first[0]; 50], second: vec![scene.second[0]; 50], ..Scene::default() };
    let matches = (0..50).map(|at| Match { first: at, second: at, ratio: 0.5 }).collect();
    let _ = Scene { matches, ..one_point }.verify(1000.0, FocalSource::Exif);
}

#[test]
fn the_order_of_matches_does_not_matter() {
    let scene = Scene::observed(150, &side_step(), deep, 17).with_outliers(80, 18);
    let mut turned = Scene::observed(150, &side_step(), deep, 17).with_outliers(80, 18);
    turned.matches.reverse();
    assert_eq!(scene.verify(1000.0, FocalSource::Exif), turned.verify(1000.0, FocalSource::Exif));
}
