//! Seams between parts of a known scene.

use nalgebra::Matrix3;

use super::*;
use crate::test_support::{Draws, EXACT, USUAL, block, ids, submap};

const SEED: Seed = Seed(11);

/// Truth for `b_from_a` where each is moved by its own similarity.
fn truth(a_from_world: &Sim3, b_from_world: &Sim3) -> Sim3 {
    *b_from_world * a_from_world.inverse()
}

#[test]
fn noise_free_overlap_gives_the_similarity_exactly() {
    let scene = block(40, 3000);
    let mut draws = Draws::new(5);
    let (from_a, from_b) = (draws.similarity(), draws.similarity());
    let a = submap(&scene.truth, &ids(0..24), &from_a, EXACT, 1);
    let b = submap(&scene.truth, &ids(16..40), &from_b, EXACT, 2);
    let outcome = align(&a, &b, &AlignOptions::default(), SEED);
    let (found, _) = outcome.accepted().expect("the seam is true");
    let error = found.local_left(&truth(&from_a, &from_b));
    assert!(error.norm() < 1e-6, "{error:?}");
    assert_eq!(outcome.evidence.num_shared_cameras, 8);
    assert_eq!(outcome.evidence.num_agreeing_cameras, 8);
}

#[test]
fn noise_shows_and_is_averaged_and_the_information_is_of_its_size() {
    let scene = block(40, 3000);
    let mut draws = Draws::new(6);
    let (from_a, from_b) = (draws.similarity(), draws.similarity());
    let a = submap(&scene.truth, &ids(0..24), &from_a, USUAL, 1);
    let b = submap(&scene.truth, &ids(16..40), &from_b, USUAL, 2);
    let outcome = align(&a, &b, &AlignOptions::default(), SEED);
    let (found, information) = outcome.accepted().expect("the seam is true");
    // Where the overlap is, in metres.
    let middle = from_a.transform_point(&scene.truth.images[20].cam_from_world.center());
    let error = (found.transform_point(&middle) - truth(&from_a, &from_b).transform_point(&middle)).norm();
    let error_m = error / from_b.scale;
    assert!((1e-5..0.1).contains(&error_m), "{error_m} m");
    let rms_m = outcome.evidence.point_rms / from_b.scale;
    assert!((0.05..0.2).contains(&rms_m), "{rms_m} m");
    let eigenvalues = information.symmetric_eigenvalues();
    assert!(eigenvalues.min() > 0.0, "{eigenvalues:?}");
}

#[test]
fn mismatched_tracks_are_outvoted() {
    let scene = block(40, 3000);
    let mut draws = Draws::new(7);
    let (from_a, from_b) = (draws.similarity(), draws.similarity());
    let mut a = submap(&scene.truth, &ids(0..24), &from_a, USUAL, 1);
    let b = submap(&scene.truth, &ids(16..40), &from_b, USUAL, 2);
    let count = a.points.len();
    for k in (0..count).step_by(3) {
        a.points[k].x_in_world = a.points[(k * 7 + 1) % count].x_in_world;
    }
    let outcome = align(&a, &b, &AlignOptions::default(), SEED);
    let (found, _) = outcome.accepted().expect("two of three tracks are right");
    let middle = from_a.transform_point(&scene.truth.images[20].cam_from_world.center());
    let error = (found.transform_point(&middle) - truth(&from_a, &from_b).transform_point(&middle)).norm();
    assert!(error / from_b.scale < 0.15, "{}", error / from_b.scale);
    assert!(outcome.evidence.num_inliers < outcome.evidence.num_shared_points * 8 / 10);
}

#[test]
fn a_wrong_seam_is_refused_with_the_reason() {
    let scene = block(40, 3000);
    let mut draws = Draws::new(8);
    let a = submap(&scene.truth, &ids(0..24), &draws.similarity(), USUAL, 1);
    let mut b = submap(&scene.truth, &ids(16..40), &draws.similarity(), USUAL, 2);
    // Another place: the shared images lie elsewhere in b, each on its own.
    for image in &mut b.images {
        let turn = terrane_geometry::so3::exp(&draws.vector());
        let center = image.cam_from_world.center() + 100.0 * draws.vector();
        image.cam_from_world = terrane_geometry::Rigid3::from_rotation_and_center(turn, &center);
    }
    for point in &mut b.points {
        point.x_in_world += 100.0 * draws.vector();
    }
    let outcome = align(&a, &b, &AlignOptions::default(), SEED);
    let SeamVerdict::Refused { reason } = &outcome.verdict else { panic!("accepted: {outcome:?}") };
    assert!(reason.contains("shared cameras"), "{reason}");
}

#[test]
fn nothing_shared_is_an_outcome() {
    let scene = block(40, 3000);
    let a = submap(&scene.truth, &ids(0..15), &Sim3::identity(), EXACT, 1);
    let b = submap(&scene.truth, &ids(20..40), &Sim3::identity(), EXACT, 2);
    let outcome = align(&a, &b, &AlignOptions::default(), SEED);
    assert!(matches!(&outcome.verdict, SeamVerdict::Refused { reason } if reason.contains("no image")));
    let empty = align(&a, &Reconstruction::default(), &AlignOptions::default(), SEED);
    assert!(empty.accepted().is_none());
}

#[test]
fn the_same_seed_gives_the_same_outcome() {
    let scene = block(40, 2000);
    let a = submap(&scene.truth, &ids(0..24), &Draws::new(1).similarity(), USUAL, 1);
    let b = submap(&scene.truth, &ids(16..40), &Draws::new(2).similarity(), USUAL, 2);
    let run = || align(&a, &b, &AlignOptions::default(), SEED);
    assert_eq!(run(), run());
}

/// A bumpy surface: no two places alike.
fn surface(seed: u64, count: usize) -> Vec<Vector3<f64>> {
    let mut draws = Draws::new(seed);
    (0..count)
        .map(|_| {
            let (x, y) = (10.0 * draws.signed(), 10.0 * draws.signed());
            Vector3::new(x, y, (0.5 * x).sin() + (0.4 * y + 0.3 * x).cos() + 0.05 * x * y)
        })
        .collect()
}

#[test]
fn icp_converges_on_surfaces_sampled_differently() {
    let target = surface(1, 4000);
    let moved = Sim3::new(
        1.04,
        terrane_geometry::so3::exp(&Vector3::new(0.03, -0.04, 0.05)),
        Vector3::new(0.2, -0.3, 0.2),
    );
    let source: Vec<_> = surface(2, 3000).iter().map(|x| moved.inverse().transform_point(x)).collect();
    for (metric, bound) in [(icp::IcpMetric::PointToPlane, 0.05), (icp::IcpMetric::PointToPoint, 0.25)] {
        let options = icp::IcpOptions { metric, max_iterations: 60, ..Default::default() };
        let (found, report) = icp::align_points(&source, &target, &Sim3::identity(), &options)
            .expect("clouds are large enough");
        let errors: Vec<f64> =
            source.iter().map(|x| (found.transform_point(x) - moved.transform_point(x)).norm()).collect();
        let rms = crate::statistics::rms(&errors);
        assert!(rms < bound, "{metric:?}: {rms}");
        assert!(report.final_rms < report.initial_rms, "{report:?}");
    }
}

#[test]
fn icp_keeps_scale_when_it_is_fixed() {
    let target = surface(1, 3000);
    let source: Vec<_> = surface(2, 2000).iter().map(|x| x * 0.98 + Vector3::new(0.1, 0.0, 0.1)).collect();
    let options = icp::IcpOptions { free_scale: false, ..Default::default() };
    let (found, _) = icp::align_points(&source, &target, &Sim3::identity(), &options).expect("enough points");
    assert!((found.scale - 1.0).abs() < 1e-12);
    assert!(found.translation.norm() > 0.02, "it moved");
}

#[test]
fn icp_needs_points() {
    let few = surface(1, 5);
    let enough = surface(2, 100);
    let options = icp::IcpOptions::default();
    assert!(icp::align_points(&few, &enough, &Sim3::identity(), &options).is_none());
    let mut broken = surface(3, 100);
    broken[7].x = f64::NAN;
    assert!(icp::align_points(&broken, &enough, &Sim3::identity(), &options).is_none());
}

#[test]
fn information_is_the_inverse_spread_of_the_estimate() {
    // Many noisy draws of the same seam: the spread of the similarity must be what the information says.
    let mut draws = Draws::new(3);
    let places: Vec<Vector3<f64>> = (0..60).map(|_| 5.0 * draws.vector()).collect();
    let sigma = 0.1;
    let mut spread = SMatrix::<f64, 7, 7>::zeros();
    let mut information = SMatrix::<f64, 7, 7>::zeros();
    let rounds = 300;
    for _ in 0..rounds {
        let data: Vec<Correspondence> = places
            .iter()
            .map(|x| Correspondence {
                x_in_a: *x,
                x_in_b: x + sigma * draws.vector(),
                sigma,
                threshold: f64::INFINITY,
            })
            .collect();
        let found = tracks::refine(&data, &Sim3::identity()).expect("points in general position");
        let error = found.local_left(&Sim3::identity());
        spread += error * error.transpose() / f64::from(rounds);
        information = tracks::information(&data, &Sim3::identity(), f64::INFINITY);
    }
    // E[eᵀ Λ e] is the number of parameters, when Λ is right; the kernel costs a little.
    let normalised = (information * spread).trace() / 7.0;
    assert!((0.5..1.5).contains(&normalised), "{normalised}");
    let rotation_part: Matrix3<f64> = spread.fixed_view::<3, 3>(0, 0).into_owned();
    assert!(rotation_part.trace() > 0.0);
}
