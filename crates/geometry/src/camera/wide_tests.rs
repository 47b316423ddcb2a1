//! Fisheyes, FOV, division, EUCM, panorama: against COLMAP's values, round trips, Jacobians, edges of the domain.

use super::*;
use crate::test_support::Random;

/// A model, its parameters, and where pycolmap 4.2.1 (`Camera.img_from_cam`, image of 1000 by 800 pixels, panorama 1000 by
/// 500) shows the points of [`POINTS`].
type Case = (CameraModel, &'static [f64], [[f64; 2]; 2]);

const POINTS: [[f64; 3]; 2] = [[0.3, -0.2, 1.0], [0.05, 0.9, 2.0]];

#[rustfmt::skip]
const CASES: [Case; 12] = [
    (CameraModel::OpenCvFisheye, &[520.0, 510.0, 500.0, 400.0, 0.03, -0.012, 0.004, -0.001],
        [[650.2359005158374, 301.7688342781063], [512.2748648106808, 616.6985749270184]]),
    (CameraModel::Fov, &[520.0, 510.0, 500.0, 400.0, 0.9],
        [[661.1400722401995, 294.6391835352541], [513.1614874805766, 632.3508751378721]]),
    (CameraModel::SimpleRadialFisheye, &[520.0, 500.0, 400.0, -0.04],
        [[649.0056312924221, 300.66291247171864], [512.1260196720074, 618.268354096132]]),
    (CameraModel::RadialFisheye, &[520.0, 500.0, 400.0, -0.04, 0.006],
        [[649.0185131704177, 300.65432455305483], [512.1283754008672, 618.3107572156089]]),
    (CameraModel::ThinPrismFisheye,
        &[520.0, 510.0, 500.0, 400.0, 0.03, -0.012, 0.002, -0.003, 0.004, -0.001, 0.0015, -0.0025],
        [[649.7688814501638, 301.98258531201077], [512.1539491600222, 616.9871025749455]]),
    (CameraModel::RadTanThinPrismFisheye,
        &[520.0, 510.0, 500.0, 400.0, 0.03, -0.012, 0.004, -0.001, 0.0005, -0.0001,
          0.002, -0.003, 0.0015, -0.0006, -0.0025, 0.0004],
        [[650.7980487545826, 301.2065542088294], [512.5640948231089, 615.665319490764]]),
    (CameraModel::SimpleDivision, &[520.0, 500.0, 400.0, -0.2],
        [[652.1421287752873, 298.57191414980844], [512.5108692227826, 625.1956460100868]]),
    (CameraModel::Division, &[520.0, 510.0, 500.0, 400.0, 0.15],
        [[659.1667570695028, 295.9294280699405], [513.4222419840927, 636.9541950268668]]),
    (CameraModel::SimpleFisheye, &[520.0, 500.0, 400.0],
        [[649.7227943645676, 300.184803756955], [512.2136126088693, 619.8450269596475]]),
    (CameraModel::Fisheye, &[520.0, 510.0, 500.0, 400.0],
        [[649.7227943645676, 302.1043267616289], [512.2136126088693, 615.6172379796543]]),
    (CameraModel::Eucm, &[520.0, 510.0, 500.0, 400.0, 0.6, 1.1],
        [[649.7887016448619, 302.061233539898], [512.2220120497269, 615.7655204163325]]),
    (CameraModel::Equirectangular, &[1000.0, 500.0],
        [[546.3867895388712, 219.87638870182678], [503.9780449560129, 317.28068809679786]]),
];

fn cameras() -> impl Iterator<Item = Camera> {
    CASES.iter().map(|(model, params, _)| Camera::new(*model, 1000, 800, params).unwrap())
}

/// Points up to 60 degrees off the axis, every fourth next to it; on all sides for a panorama.
fn point(camera: &Camera, i: usize, random: &mut Random) -> Vector3<f64> {
    if camera.model.is_spherical() {
        return random.direction() * random.uniform(0.5, 50.0);
    }
    let theta =
        if i.is_multiple_of(4) { 10f64.powf(random.uniform(-9.0, -1.0)) } else { random.uniform(0.0, 1.0) };
    let around = random.uniform(0.0, std::f64::consts::TAU);
    let (sin, cos) = theta.sin_cos();
    Vector3::new(sin * around.cos(), sin * around.sin(), cos) * random.uniform(0.5, 50.0)
}

#[test]
fn images_are_those_of_colmap() {
    for (camera, (_, _, pixels)) in cameras().zip(&CASES) {
        for (x, pixel) in POINTS.iter().zip(pixels) {
            let seen = camera.project(&Vector3::from(*x)).unwrap();
            assert!((seen - Vector2::from(*pixel)).norm() < 1e-9, "{camera:?} {seen}");
        }
    }
    let panorama = Camera::new(CameraModel::Equirectangular, 1000, 500, &[1000.0, 500.0]).unwrap();
    let behind = panorama.project(&Vector3::new(-0.3, 0.4, -1.0)).unwrap();
    assert!((behind - Vector2::new(46.3867895388711, 308.23155796992626)).norm() < 1e-9);
}

#[test]
fn pixels_go_out_and_come_back() {
    let mut random = Random::new("wide round trip");
    for camera in cameras() {
        let mut seen = 0;
        for i in 0..400 {
            let x = point(&camera, i, &mut random);
            let Some(pixel) = camera.project(&x) else { continue };
            seen += 1;
            let ray = camera.ray(&pixel).unwrap();
            assert!((ray - x.normalize()).norm() < 1e-11, "{camera:?} {x} {ray}");
            assert_eq!(camera.unproject(&pixel).is_some(), x.z > 0.0);
        }
        assert!(seen > 300, "{camera:?} {seen}");
    }
}

#[test]
fn jacobians_match_central_differences() {
    let mut random = Random::new("wide jacobian");
    for camera in cameras() {
        for i in 0..200 {
            let x = point(&camera, i, &mut random);
            // Neither next to the poles nor to a fold.
            if camera.project(&(x + Vector3::new(x.x, x.y, 0.0) * 0.05)).is_none()
                || x.x.hypot(x.z) < 0.1 * x.norm()
            {
                continue;
            }
            let analytic = camera.project_with_jacobian(&x).unwrap();
            let (xy_px, d_point) = camera.project_with_point_jacobian(&x).unwrap();
            assert!((analytic.xy_px - xy_px).norm() < 1e-9 && (analytic.d_point - d_point).norm() < 1e-9);
            assert!((camera.project(&x).unwrap() - xy_px).norm() < 1e-9);
            let h = 1e-5 * x.norm();
            for axis in 0..3 {
                let shift = Vector3::ith(axis, h);
                let difference = camera.residual_px(
                    &camera.project(&(x + shift)).unwrap(),
                    &camera.project(&(x - shift)).unwrap(),
                );
                let error = (difference / (2.0 * h) - d_point.column(axis)).norm();
                assert!(error < 1e-6 * d_point.norm(), "{camera:?} {x} {axis} {error}");
            }
            for k in 0..MAX_PARAMS {
                let column = analytic.d_params.column(k);
                let step = 1e-5 * camera.params().get(k).map_or(1.0, |value| value.abs().max(1.0));
                let at = |sign: f64| {
                    let mut moved = camera;
                    moved.params_mut().iter_mut().skip(k).take(1).for_each(|value| *value += sign * step);
                    moved.project(&x).unwrap()
                };
                let error = ((at(1.0) - at(-1.0)) / (2.0 * step) - column).norm();
                assert!(error < 1e-6 * (1.0 + column.norm()), "{camera:?} {x} {k} {error}");
            }
        }
    }
}

#[test]
fn domains_end_where_they_should() {
    for camera in cameras().filter(|camera| !camera.model.is_spherical()) {
        for z in [0.0, -1.0, f64::NAN] {
            assert!(camera.project(&Vector3::new(0.1, 0.2, z)).is_none(), "{camera:?}");
        }
    }
    let fisheye = |k: &[f64]| {
        let mut params = vec![500.0, 500.0, 500.0, 500.0];
        params.extend(k);
        Camera::new(CameraModel::OpenCvFisheye, 1000, 1000, &params).unwrap()
    };
    let at = |theta: f64| Vector3::new(theta.sin(), 0.0, theta.cos());
    // 1 − 1.5 s + 0.755 s² has no root.
    let grows = fisheye(&[-0.5, 0.151, 0.0, 0.0]);
    assert!(grows.project(&at(1.5)).is_some());
    // 1 − 1.5 s + 0.5 s² has the roots 1 and 2: folded from there on, though it grows again from s = 2.
    let folds = fisheye(&[-0.5, 0.1, 0.0, 0.0]);
    assert!(folds.project(&at(0.999)).is_some());
    assert!([1.001, 1.3, 1.5].iter().all(|theta| folds.project(&at(*theta)).is_none()));
    // The distorted angle of the fold is 0.6.
    assert!(folds.ray(&Vector2::new(500.0 + 299.9, 500.0)).is_some());
    assert!(folds.ray(&Vector2::new(500.0 + 300.1, 500.0)).is_none());
    // A ray beyond 90 degrees.
    let wide = fisheye(&[0.0; 4]);
    let ray = wide.ray(&Vector2::new(500.0 + 500.0 * 1.8, 500.0)).unwrap();
    assert!((ray - at(1.8)).norm() < 1e-12 && wide.unproject(&Vector2::new(1400.0, 500.0)).is_none());
}

#[test]
fn a_panorama_has_no_seam() {
    let panorama = Camera::new(CameraModel::Equirectangular, 1000, 500, &[1000.0, 500.0]).unwrap();
    let at = |x: f64| panorama.project(&Vector3::new(x, 0.0, -1.0)).unwrap();
    let (left, right) = (at(-0.01), at(0.01));
    assert!(left.x < 3.0 && right.x > 997.0);
    let residual = panorama.residual_px(&left, &right);
    assert!((residual.x - 2.0 * 0.01f64.atan() * 1000.0 / std::f64::consts::TAU).abs() < 1e-9);
    assert!(panorama.project(&Vector3::y()).is_none() && panorama.project(&Vector3::zeros()).is_none());
}
