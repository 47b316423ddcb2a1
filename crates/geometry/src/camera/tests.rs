//! Round trips, Jacobians by central differences, edges of the domain, names.

use super::*;
use crate::test_support::Random;

/// One camera of each perspective model with plausible and one with strong distortion.
fn cameras() -> Vec<Camera> {
    let plain = [1200.0, 1190.0, 800.0, 610.0];
    let mut all = vec![];
    for model in CameraModel::ALL.into_iter().filter(|model| model.is_perspective()) {
        for strength in [0.3, 1.0] {
            let coefficients = [-0.12, 0.03, 0.002, -0.0015, 0.01, 0.02, -0.01, 0.004].map(|k| k * strength);
            let mut params = plain[2 - model.num_focal()..].to_vec();
            params.extend(&coefficients[..model.num_distortion()]);
            all.push(Camera::new(model, 1600, 1200, &params).unwrap());
        }
    }
    all
}

fn point_ahead(random: &mut Random) -> Vector3<f64> {
    Vector3::new(random.uniform(-0.6, 0.6), random.uniform(-0.5, 0.5), 1.0) * random.uniform(0.5, 50.0)
}

#[test]
fn pixels_go_out_and_come_back() {
    let mut random = Random::new("camera round trip");
    for camera in cameras() {
        for _ in 0..500 {
            let x_in_cam = point_ahead(&mut random);
            let pixel = camera.project(&x_in_cam).unwrap();
            let normalized = camera.unproject(&pixel).unwrap();
            assert!((normalized - x_in_cam.xy() / x_in_cam.z).norm() < 1e-12, "{camera:?}");
            assert!((camera.pixel_from_normalized(&normalized) - pixel).norm() < 1e-9);
            assert!(camera.ray(&pixel).unwrap().cross(&x_in_cam).norm() < 1e-9 * x_in_cam.norm());
        }
    }
}

#[test]
fn jacobians_match_central_differences() {
    let mut random = Random::new("camera jacobian");
    for camera in cameras() {
        for _ in 0..50 {
            let x_in_cam = point_ahead(&mut random);
            let analytic = camera.project_with_jacobian(&x_in_cam).unwrap();
            let (xy_px, d_point) = camera.project_with_point_jacobian(&x_in_cam).unwrap();
            let pixel = camera.project(&x_in_cam).unwrap();
            assert!((analytic.xy_px - pixel).norm() < 1e-9 && (xy_px - pixel).norm() < 1e-9);
            assert!((analytic.d_point - d_point).norm() < 1e-9 * d_point.norm());
            for axis in 0..3 {
                let h = 1e-6 * x_in_cam.z;
                let mut shift = Vector3::zeros();
                shift[axis] = h;
                let numeric = (camera.project(&(x_in_cam + shift)).unwrap()
                    - camera.project(&(x_in_cam - shift)).unwrap())
                    / (2.0 * h);
                assert!((numeric - d_point.column(axis)).norm() < 1e-6 * d_point.norm());
            }
            assert_params_jacobian(&camera, &x_in_cam, &analytic);
        }
    }
}

fn assert_params_jacobian(camera: &Camera, x_in_cam: &Vector3<f64>, analytic: &Projection) {
    let count = camera.params().len();
    for i in 0..count {
        let h = 1e-6 * camera.params()[i].abs().max(1.0);
        let at = |sign: f64| {
            let mut moved = *camera;
            moved.params_mut()[i] += sign * h;
            moved.project(x_in_cam).unwrap()
        };
        let numeric = (at(1.0) - at(-1.0)) / (2.0 * h);
        let column = analytic.d_params.column(i);
        assert!(
            (numeric - column).norm() < 1e-6 * (1.0 + column.norm()),
            "{camera:?} {i} {numeric} {column}"
        );
    }
    assert_eq!(analytic.d_params.columns(count, MAX_PARAMS - count).norm(), 0.0);
}

#[test]
fn nothing_is_seen_behind_or_beyond_the_fold() {
    for camera in cameras() {
        for z in [0.0, -1.0, f64::NAN, f64::NEG_INFINITY] {
            let x_in_cam = Vector3::new(0.1, 0.2, z);
            assert!(camera.project(&x_in_cam).is_none() && camera.project_with_jacobian(&x_in_cam).is_none());
            assert!(camera.project_with_point_jacobian(&x_in_cam).is_none());
        }
        assert!(camera.unproject(&Vector2::new(f64::NAN, 3.0)).is_none_or(|xy| xy.x.is_nan()));
    }
    // r (1 - 0.3 r²) grows up to r² = 1/0.9 and is 0.7027 there.
    let barrel = Camera::new(CameraModel::SimpleRadial, 1000, 1000, &[500.0, 500.0, 500.0, -0.3]).unwrap();
    assert!(barrel.project(&Vector3::new(1.05, 0.0, 1.0)).is_some());
    assert!(barrel.project(&Vector3::new(1.06, 0.0, 1.0)).is_none());
    assert!(barrel.project_with_jacobian(&Vector3::new(1.06, 0.0, 1.0)).is_none());
    assert!(barrel.unproject(&Vector2::new(500.0 + 351.0, 500.0)).is_some());
    assert!(barrel.unproject(&Vector2::new(500.0 + 352.0, 500.0)).is_none());
}

#[test]
fn strong_pincushion_and_wide_angles_still_invert() {
    let mut random = Random::new("pincushion");
    for (k1, k2) in [(0.5, 0.0), (0.5, 0.3), (-0.2, 0.05), (0.0, 0.2), (0.3, -0.02)] {
        let camera = Camera::new(CameraModel::Radial, 1000, 1000, &[400.0, 500.0, 500.0, k1, k2]).unwrap();
        for _ in 0..300 {
            let at = Vector3::new(random.uniform(-1.0, 1.0), random.uniform(-1.0, 1.0), 1.0);
            let Some(pixel) = camera.project(&at) else { continue };
            assert!((camera.unproject(&pixel).unwrap() - at.xy()).norm() < 1e-10, "{k1} {k2} {at}");
        }
    }
}

#[test]
fn names_numbers_and_counts_agree() {
    for model in CameraModel::ALL {
        assert_eq!(CameraModel::from_name(model.name()), Some(model));
        assert_eq!(CameraModel::from_colmap_id(model.colmap_id()), Some(model));
        assert_eq!(Camera::centered(model, 4, 3, 5.0).params().len(), model.num_params());
        assert!(Camera::new(model, 4, 3, &vec![1.0; model.num_params() + 1]).is_none());
    }
    assert_eq!(CameraModel::from_name("pinhole"), None);
}
