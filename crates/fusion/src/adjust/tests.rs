//! Adjusting a disturbed scene brings the truth back.

use nalgebra::Vector3;
use terrane_geometry::{Rigid3, so3};
use terrane_scene::{Reconstruction, ScenePoint};
use terrane_testkit::compare;

use super::*;
use crate::merge::{MergedCameras, assemble};
use crate::test_support::{Draws, block, ids};

/// The scene's truth as cameras and shards, its poses and points disturbed.
fn disturbed(center_m: f64, num_shards: usize) -> (Reconstruction, MergedCameras, Vec<MergedShard>) {
    let truth = block(30, 1500).truth;
    let mut draws = Draws::new(8);
    let mut cameras = MergedCameras { cameras: truth.cameras.clone(), images: truth.images.clone() };
    for image in &mut cameras.images {
        let center = image.cam_from_world.center() + center_m * draws.vector();
        let turn = so3::exp(&(center_m / 100.0 * draws.vector()));
        image.cam_from_world =
            Rigid3::from_rotation_and_center(turn * image.cam_from_world.rotation, &center);
    }
    let mut shards = vec![MergedShard::default(); num_shards];
    for (at, point) in truth.points.iter().enumerate() {
        let shard = &mut shards[at % num_shards];
        let track = truth.track(point);
        shard.points.push(ScenePoint {
            x_in_world: point.x_in_world + center_m * draws.vector(),
            first_observation: shard.observations.len() as u64,
            ..*point
        });
        shard.observations.extend_from_slice(track);
    }
    (truth, cameras, shards)
}

fn whole(cameras: &MergedCameras, shards: &[MergedShard]) -> Reconstruction {
    assemble(cameras, shards)
}

#[test]
fn a_disturbed_scene_is_adjusted_down_to_its_noise() {
    let (truth, mut cameras, mut shards) = disturbed(0.3, 3);
    let seams = [ids(10..16)];
    let input = AdjustInput { seams: &seams, ..Default::default() };
    let report = adjust(&mut cameras, &mut shards, &input, &AdjustOptions::default()).expect("it adjusts");
    let got = whole(&cameras, &shards);
    // The mean length of a two-dimensional normal vector of 0.5 px is 0.63 px; the fit takes a little away.
    assert!((0.4..0.64).contains(&report.mean_error_px), "{report:?}");
    assert!(report.initial_mean_error_px > 2.0);
    assert!((got.mean_reprojection_error_px() - report.mean_error_px).abs() < 1e-9);
    let error = compare::cameras(&got, &truth, true).expect("enough cameras");
    assert!((1e-4..0.15).contains(&error.center_rmse_m), "{error:?}");
    assert_eq!(report.rounds[0].name, "seam 0");
    assert!(report.rounds.iter().all(|round| round.final_cost <= round.initial_cost));
    assert!(report.dropped_images.is_empty());
}

#[test]
fn wrong_observations_are_dropped() {
    let (truth, mut cameras, mut shards) = disturbed(0.1, 1);
    let count = shards[0].observations.len();
    for seen in shards[0].observations.iter_mut().step_by(25) {
        seen.x_px += 40.0;
    }
    let report = adjust(&mut cameras, &mut shards, &AdjustInput::default(), &AdjustOptions::default())
        .expect("it adjusts");
    let dropped: u64 = report.rounds.iter().map(|round| round.num_dropped_observations).sum();
    assert!(dropped >= count as u64 / 25 && dropped < count as u64 / 8, "{dropped} of {count}");
    let error = compare::cameras(&whole(&cameras, &shards), &truth, true).expect("enough cameras");
    assert!(error.center_rmse_m < 0.2, "{error:?}");
}

#[test]
fn weak_positions_hold_the_frame_and_do_no_harm() {
    let (truth, mut cameras, mut shards) = disturbed(0.1, 1);
    let mut draws = Draws::new(5);
    let positions: Vec<LocalPosition> = truth
        .images
        .iter()
        .map(|image| LocalPosition {
            image: image.image,
            x_in_enu: image.cam_from_world.center() + 2.0 * draws.vector(),
            sigma_m: Vector3::repeat(2.0),
        })
        .collect();
    let input = AdjustInput { positions: &positions, ..Default::default() };
    let report = adjust(&mut cameras, &mut shards, &input, &AdjustOptions::default()).expect("it adjusts");
    let got = whole(&cameras, &shards);
    assert!(report.num_positions >= 28);
    assert!((0.4..0.64).contains(&report.mean_error_px), "{report:?}");
    let absolute = compare::cameras(&got, &truth, false).expect("enough cameras");
    let relative = compare::cameras(&got, &truth, true).expect("enough cameras");
    // Thirty positions of 2 m: the frame is known to a metre or so, the shape far better.
    assert!(absolute.center_rmse_m < 2.0, "{absolute:?}");
    assert!(relative.center_rmse_m < 0.25, "{relative:?}");
}

#[test]
fn a_fixed_camera_keeps_its_intrinsics_and_a_free_one_finds_them() {
    for (fixed, expect_found) in [(vec![CameraId(0)], false), (Vec::new(), true)] {
        let (truth, mut cameras, mut shards) = disturbed(0.05, 1);
        let told = cameras.cameras[0].1.mean_focal_px() * 1.02;
        cameras.cameras[0].1.params_mut()[0] = told;
        let input = AdjustInput { fixed_intrinsics: &fixed, ..Default::default() };
        adjust(&mut cameras, &mut shards, &input, &AdjustOptions::default()).expect("it adjusts");
        let got = cameras.cameras[0].1.mean_focal_px();
        let wanted = truth.cameras[0].1.mean_focal_px();
        if expect_found {
            assert!(
                (got - wanted).abs() < (told - wanted).abs(),
                "{got} is no nearer to {wanted} than {told}"
            );
        } else {
            assert_eq!(got, told);
        }
    }
}

#[test]
fn tables_that_contradict_are_an_error() {
    let (_, mut cameras, mut shards) = disturbed(0.1, 1);
    cameras.images[3].camera = CameraId(9);
    let error = adjust(&mut cameras, &mut shards, &AdjustInput::default(), &AdjustOptions::default())
        .expect_err("camera 9 is not there");
    assert!(error.is_invalid_input() && error.to_string().contains("camera 9"), "{error}");
}

#[test]
fn an_image_that_nothing_holds_is_left_out() {
    let (_, mut cameras, mut shards) = disturbed(0.05, 2);
    let lonely = ImageId(7);
    let mut draws = Draws::new(2);
    for shard in &mut shards {
        for seen in shard.observations.iter_mut().filter(|seen| seen.image == lonely) {
            (seen.x_px, seen.y_px) =
                (600.0 + 500.0 * draws.signed() as f32, 450.0 + 400.0 * draws.signed() as f32);
        }
    }
    let report = adjust(&mut cameras, &mut shards, &AdjustInput::default(), &AdjustOptions::default())
        .expect("it adjusts");
    assert_eq!(report.dropped_images, [lonely]);
    assert!(cameras.images.iter().all(|image| image.image != lonely));
    assert!(shards.iter().all(|shard| shard.observations.iter().all(|seen| seen.image != lonely)));
}

#[test]
fn nothing_is_adjusted_to_nothing() {
    let report = adjust(
        &mut MergedCameras::default(),
        &mut Vec::<MergedShard>::new(),
        &AdjustInput::default(),
        &AdjustOptions::default(),
    );
    assert_eq!(report.expect("nothing is no error").num_points, 0);
}
