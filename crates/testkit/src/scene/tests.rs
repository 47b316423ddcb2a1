//! The generator keeps its own promises.

use super::*;
use crate::compare;

#[test]
fn noise_shows_in_reprojection_and_stays_near() {
    let scene = SyntheticScene::new(&SceneOptions { noise_px: 0.5, ..Default::default() });
    // The mean length of a two-dimensional normal vector is sigma * sqrt(pi / 2).
    let expected = 0.5 * (std::f64::consts::PI / 2.0).sqrt();
    let got = scene.truth.mean_reprojection_error_px();
    assert!((got / expected - 1.0).abs() < 0.05, "mean error {got}, expected {expected}");
}

#[test]
fn same_seed_same_scene_other_seed_other_scene() {
    let make = |seed| SyntheticScene::new(&SceneOptions { seed: Seed(seed), ..Default::default() });
    assert_eq!(make(3).truth, make(3).truth);
    assert_ne!(make(3).truth, make(4).truth);
}

#[test]
fn every_layout_has_pairs_and_only_the_panorama_lacks_depth() {
    let nadir = Layout::Nadir { height_m: 60.0, spacing_m: 15.0, row_spacing_m: 20.0, relief_m: 5.0 };
    let street = Layout::Street { spacing_m: 1.5, half_width_m: 6.0 };
    let panorama = Layout::Panorama { step_rad: 0.2 };
    for layout in [Layout::Orbit { radius_m: 10.0 }, nadir, street, panorama] {
        let scene = SyntheticScene::new(&SceneOptions { layout, num_points: 4000, ..Default::default() });
        assert!(scene.pairs.len() >= scene.images.len() - 1, "{layout:?} has {} pairs", scene.pairs.len());
        let with_baseline = scene.pairs.iter().filter(|pair| pair.summary.kind.has_baseline()).count();
        assert_eq!(with_baseline == 0, layout == panorama, "{layout:?}");
    }
}

#[test]
fn asked_for_outliers_are_there() {
    let scene = SyntheticScene::new(&SceneOptions { outlier_fraction: 0.3, ..Default::default() });
    let (mut wrong, mut all) = (0, 0);
    for pair in &scene.pairs {
        let first = &scene.images[pair.summary.pair.first().index()];
        let second = &scene.images[pair.summary.pair.second().index()];
        for [a, b] in &pair.matches {
            all += 1;
            wrong +=
                usize::from(first.point_of_keypoint[*a as usize] != second.point_of_keypoint[*b as usize]);
        }
    }
    let share = wrong as f64 / all as f64;
    assert!((0.27..0.33).contains(&share), "share of wrong matches {share}");
}

#[test]
fn comparison_undoes_a_similarity() {
    let scene = SyntheticScene::new(&SceneOptions::default());
    let mut moved = scene.truth.clone();
    let turn = terrane_geometry::so3::exp(&Vector3::new(0.3, -1.0, 0.5));
    moved.transform(&terrane_geometry::Sim3::new(3.0, turn, Vector3::new(5.0, 1.0, -2.0)));
    let fitted = compare::cameras(&moved, &scene.truth, true).expect("enough images");
    assert!(fitted.center_rmse_m < 1e-9 && fitted.rotation_max_rad < 1e-7, "{fitted:?}");
    let unfitted = compare::cameras(&moved, &scene.truth, false).expect("enough images");
    assert!(unfitted.center_rmse_m > 1.0, "{unfitted:?}");
}
