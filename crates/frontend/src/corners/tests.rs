//! Both compilations of the corners against each other, and corners at known places.

use super::*;
use crate::features::scenes::{Scene, Similarity};

const DETECTORS: [CornerDetector; 2] = [CornerDetector::Fast, CornerDetector::Harris];
const DESCRIPTORS: [CornerDescriptor; 2] = [CornerDescriptor::Gradients, CornerDescriptor::Brief];

#[test]
fn scalar_and_vector_paths_agree_bit_for_bit() {
    let luma = Scene::random(250, 233.0, 8).draw(233, &Similarity::about_middle(233.0, 0.3, 1.1), 0.5);
    for detector in DETECTORS {
        for descriptor in DESCRIPTORS {
            let options = CornerOptions::default();
            let on = |path| extract_with(path, (&luma, None), None, (detector, descriptor), &options);
            let plain = on(Path::BASELINE);
            assert!(plain.len() > 100, "{}", plain.len());
            assert_eq!(plain, on(Path::detect()));
        }
    }
}

/// A checkerboard's crossings lie where they were drawn, though without any blur the measure is too coarse for more.
#[test]
fn crossings_are_placed_to_a_third_of_a_pixel() {
    let (side, cell) = (170_usize, 24.3);
    for (x0, y0) in [(20.0, 20.0), (20.31, 20.77), (20.5, 19.9)] {
        // The share of a pixel's row or column that lies in odd cells, exactly.
        let odd = |at: usize, start: f64| {
            let samples = (0..64).map(|k| (at as f64 + (f64::from(k) + 0.5) / 64.0 - start) / cell);
            samples.map(|cells| cells.floor().rem_euclid(2.0)).sum::<f64>() / 64.0
        };
        let value = |at: usize| {
            let (a, b) = (odd(at % side, x0), odd(at / side, y0));
            (60.0 + 140.0 * (a * (1.0 - b) + b * (1.0 - a))).round() as u8
        };
        let luma = GrayImage { width: side, height: side, data: (0..side * side).map(value).collect() };
        let options = CornerOptions { num_levels: 1, ..CornerOptions::default() };
        let found = extract(&luma, None, (CornerDetector::Harris, CornerDescriptor::Gradients), &options);
        for (i, j) in [(2, 2), (3, 4), (4, 1)] {
            let (x, y) = (x0 + f64::from(i) * cell, y0 + f64::from(j) * cell);
            let error = |k: &Keypoint| (f64::from(k.x_px) - x).hypot(f64::from(k.y_px) - y);
            let nearest = found.keypoints.iter().map(error).fold(f64::INFINITY, f64::min);
            assert!(nearest < 0.34, "{nearest} px from ({x}, {y})");
        }
    }
}

#[test]
fn places_found_on_several_levels_are_described_once() {
    let luma = Scene::random(120, 300.0, 3).draw(300, &Similarity::about_middle(300.0, 0.0, 1.0), 0.5);
    let found = |separation_px| {
        let options = CornerOptions { separation_px, max_orientations: 1, ..CornerOptions::default() };
        extract(&luma, None, (CornerDetector::Harris, CornerDescriptor::Brief), &options).keypoints
    };
    let (all, apart) = (found(0.0), found(4.0));
    assert!(all.len() > 2 * apart.len(), "{} and {}", all.len(), apart.len());
    let crowded = |keypoints: &[Keypoint]| {
        let near = |a: &Keypoint, b: &Keypoint| (a.x_px - b.x_px).hypot(a.y_px - b.y_px) < 1.0;
        let is_crowded = |k: usize| keypoints[..k].iter().any(|other| near(&keypoints[k], other));
        (0..keypoints.len()).filter(|&k| is_crowded(k)).count() as f64 / keypoints.len() as f64
    };
    // Refinement may lead two to one peak, rarely.
    assert!(crowded(&all) > 0.3, "{}", crowded(&all));
    assert!(crowded(&apart) < 0.05, "{}", crowded(&apart));
}
