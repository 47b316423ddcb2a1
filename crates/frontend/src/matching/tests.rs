//! Every kernel against the oracle, on random and adversarial descriptors; matching against known truth.

use super::*;
use rand::RngExt;
use terrane_geometry::Seed;
use terrane_scene::Keypoint;

type Descriptor = [u8; DESCRIPTOR_LEN];

fn random(count: usize, limit: u8, seed: u64) -> Vec<Descriptor> {
    let mut rng = Seed(seed).rng();
    (0..count).map(|_| std::array::from_fn(|_| rng.random_range(0..=limit))).collect()
}

pub(super) fn features(descriptors: &[Descriptor]) -> Features {
    let keypoint = Keypoint { x_px: 0.5, y_px: 0.5, scale_px: 1.0, orientation_rad: 0.0 };
    Features {
        keypoints: vec![keypoint; descriptors.len()],
        descriptors: descriptors.as_flattened().to_vec(),
        colors: vec![[0; 3]; descriptors.len()],
        ..Features::default()
    }
}

fn assert_all_equal(first: &[Descriptor], second: &[Descriptor]) {
    let truth = scalar::nearest(first, second);
    for kernel in MatchKernel::available() {
        assert_eq!(kernel.nearest(first, second), truth, "{}", kernel.name());
    }
}

#[test]
fn kernels_agree_on_every_size_around_a_tile() {
    for rows in [0, 1, 2, 3, 4, 5, 7, 8, 9, 17, 33] {
        for columns in [0, 1, 7, 8, 9, 15, 16, 17, 31, 33, 129, 130] {
            assert_all_equal(&random(rows, 127, 1), &random(columns, 127, 2));
            assert_all_equal(&random(rows, 255, 3), &random(columns, 255, 4));
        }
    }
}

#[test]
fn kernels_agree_on_extreme_bytes() {
    for (a, b) in [(0, 255), (255, 255), (127, 127), (127, 0), (128, 127), (127, 128), (128, 128), (0, 0)] {
        let mut first = vec![[a; DESCRIPTOR_LEN]; 11];
        let mut second = vec![[b; DESCRIPTOR_LEN]; 19];
        assert_all_equal(&first, &second);
        first.extend(random(30, a.max(1), 5));
        second.extend(random(30, b.max(1), 6));
        first[3] = [255; DESCRIPTOR_LEN];
        second[5] = std::array::from_fn(|k| if k % 2 == 0 { 255 } else { 0 });
        second[6] = std::array::from_fn(|k| if k % 4 < 2 { 127 } else { 0 });
        assert_all_equal(&first, &second);
    }
}

#[test]
fn kernels_agree_when_wide_descriptors_are_scattered() {
    let mut first = random(400, 127, 7);
    let mut second = random(500, 127, 8);
    for at in (0..400).step_by(37) {
        first[at][at % 128] = 200;
        second[at + 3][at % 128] = 255;
    }
    assert_all_equal(&first, &second);
}

#[test]
fn kernels_agree_on_ties_and_copies() {
    let mut second = random(100, 3, 9);
    second.extend_from_within(20..60);
    let first: Vec<Descriptor> = second[10..70].to_vec();
    assert_all_equal(&first, &second);
    let found = scalar::nearest(&first, &second);
    assert_eq!(found.rows[0].index, Some(10));
    assert_eq!(found.rows[10].index, None, "two copies are equally near");
    assert_eq!(found.rows[10].distance_squared, 0);
    assert_eq!(found.rows[10].second_squared, 0);
}

#[test]
fn copies_with_noise_are_found_and_strangers_are_not() {
    let first = random(300, 60, 10);
    let mut second = random(200, 60, 11);
    let mut rng = Seed(12).rng();
    for source in 0..150 {
        let noisy = first[source].map(|byte: u8| byte.saturating_add(rng.random_range(0..6)));
        second.push(noisy);
    }
    let matches = match_features(&features(&first), &features(&second), &MatchOptions::default());
    let truth: Vec<(u32, u32)> = (0..150).map(|at| (at, at + 200)).collect();
    let found: Vec<(u32, u32)> = matches.iter().map(|m| (m.first, m.second)).collect();
    assert_eq!(found, truth);
    assert!(matches.iter().all(|m| m.ratio > 0.02 && m.ratio < 0.5));
}

#[test]
fn mutual_test_keeps_one_to_one() {
    let first: Vec<Descriptor> = random(40, 60, 13);
    let mut second = vec![first[0].map(|byte| byte.saturating_add(1))];
    second.extend(random(40, 60, 14));
    let mut crowded = first.clone();
    crowded.push(first[0].map(|byte| byte.saturating_add(2)));
    let strict = match_features(&features(&crowded), &features(&second), &MatchOptions::default());
    assert!(strict.is_empty(), "the second image's feature is torn between two");
    let loose = MatchOptions { mutual: false, ..MatchOptions::default() };
    let both = match_features(&features(&crowded), &features(&second), &loose);
    assert_eq!(both.iter().map(|m| (m.first, m.second)).collect::<Vec<_>>(), [(0, 0), (40, 0)]);
}

#[test]
fn degenerate_inputs_give_no_match() {
    let none = features(&[]);
    let blank = features(&[[0; DESCRIPTOR_LEN]; 3]);
    let some = features(&random(5, 127, 15));
    let options = MatchOptions::default();
    for (a, b) in [(&none, &none), (&none, &some), (&some, &none), (&blank, &some), (&blank, &blank)] {
        assert!(match_features(a, b, &options).is_empty());
    }
    let one = features(&random(1, 127, 16));
    let alone = match_features(&one, &one, &options);
    assert_eq!(alone.len(), 1);
    assert_eq!(alone[0].ratio, 0.0);
}

#[test]
fn distance_limit_is_that_of_unit_vectors() {
    let first = [std::array::from_fn(|k| if k < 64 { 100 } else { 0 })];
    let second = [std::array::from_fn(|k| if k < 32 { 100 } else { 0 })];
    // The cosine is 1/√2, the distance of the unit vectors √(2 − √2) = 0.765.
    for (limit, expected) in [(0.76, 0), (0.77, 1)] {
        let options = MatchOptions { max_distance: limit, ..MatchOptions::default() };
        assert_eq!(match_features(&features(&first), &features(&second), &options).len(), expected);
    }
}
