//! Both compilations of SURF against each other, and descriptors that turn with the image.

use super::*;
use crate::features::scenes::{Scene, Similarity};

#[test]
fn scalar_and_vector_paths_agree_bit_for_bit() {
    let luma = Scene::random(250, 233.0, 8).draw(233, &Similarity::about_middle(233.0, 0.3, 1.1), 0.5);
    for upright in [false, true] {
        let options = SurfOptions { upright, ..SurfOptions::default() };
        let plain = extract_with(Path::BASELINE, &luma, None, &options);
        assert!(plain.len() > 100, "{}", plain.len());
        assert_eq!(plain, extract_with(Path::detect(), &luma, None, &options));
    }
}

#[test]
fn descriptors_have_one_length_and_end_in_zeros() {
    let luma = Scene::random(200, 180.0, 2).draw(180, &Similarity::about_middle(180.0, 0.0, 1.0), 0.5);
    let features = extract(&luma, None, &SurfOptions::default());
    for k in 0..features.len() {
        let descriptor = features.descriptor(k);
        assert!(descriptor.iter().all(|byte| *byte < 128) && descriptor[64..] == [0; 64]);
        let length = descriptor.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
        assert!((220.0..258.0).contains(&length), "{length}");
    }
}

#[test]
fn a_quarter_turn_turns_orientations_and_keeps_descriptors() {
    let luma = Scene::random(200, 200.0, 4).draw(200, &Similarity::about_middle(200.0, 0.0, 1.0), 0.5);
    // Column x, row y goes to column 199 - y, row x: a quarter turn from x towards y.
    let turned = (0..200 * 200).map(|at| luma.data[(199 - at % 200) * 200 + at / 200]).collect();
    let turned = extract(&GrayImage { data: turned, ..luma.clone() }, None, &SurfOptions::default());
    let features = extract(&luma, None, &SurfOptions::default());
    let (mut pairs, mut near, mut alike) = (0, 0, 0);
    for (k, a) in features.keypoints.iter().enumerate() {
        let (x, y) = (200.0 - a.y_px, a.x_px);
        let same = |b: &&Keypoint| {
            (b.x_px - x).hypot(b.y_px - y) < 0.3 && (b.scale_px / a.scale_px - 1.0).abs() < 0.05
        };
        let Some(other) = turned.keypoints.iter().position(|b| same(&b)) else { continue };
        pairs += 1;
        let turn =
            (turned.keypoints[other].orientation_rad - a.orientation_rad) / std::f32::consts::TAU - 0.25;
        near += usize::from((turn - turn.round()).abs() < 0.02);
        let squared = |(a, b): (&u8, &u8)| u32::from(a.abs_diff(*b)).pow(2);
        let distance: u32 = features.descriptor(k).iter().zip(turned.descriptor(other)).map(squared).sum();
        alike += usize::from(distance < 100 * 100);
    }
    assert!(pairs > 60, "{pairs} of {}", features.len());
    assert!(near as f64 > 0.85 * pairs as f64, "{near} of {pairs}");
    assert!(alike as f64 > 0.8 * pairs as f64, "{alike} of {pairs}");
}
