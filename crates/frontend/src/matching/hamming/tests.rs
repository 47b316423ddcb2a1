//! Every kernel against the oracle, and matching against known truth.

use rand::RngExt;
use terrane_geometry::Seed;
use terrane_scene::{DescriptorKind, Features, Keypoint};

use super::super::match_features;
use super::*;

fn random(count: usize, seed: u64) -> Vec<Bits> {
    let mut rng = Seed(seed).rng();
    (0..count).map(|_| std::array::from_fn(|_| rng.random_range(0..=255))).collect()
}

/// With that many bits turned over.
fn altered(bits: &Bits, count: usize, rng: &mut impl rand::Rng) -> Bits {
    let mut altered = *bits;
    for _ in 0..count {
        let bit = rng.random_range(0..256_usize);
        altered[bit / 8] ^= 1 << (bit % 8);
    }
    altered
}

fn features(descriptors: &[Bits]) -> Features {
    let keypoint = Keypoint { x_px: 0.5, y_px: 0.5, scale_px: 1.0, orientation_rad: 0.0 };
    Features {
        keypoints: vec![keypoint; descriptors.len()],
        kind: DescriptorKind::Bits256,
        descriptors: descriptors.as_flattened().to_vec(),
        colors: vec![[0; 3]; descriptors.len()],
    }
}

fn assert_all_equal(first: &[Bits], second: &[Bits]) {
    let truth = nearest_scalar(first, second);
    for kernel in HammingKernel::available() {
        assert_eq!(kernel.nearest(first, second), truth, "{}", kernel.name());
    }
}

#[test]
fn the_oracle_counts_differing_bits() {
    assert_eq!(distance(&[0; 32], &[255; 32]), 256);
    assert_eq!(distance(&[0b101; 32], &[0b110; 32]), 64);
    let found = nearest_scalar(&[[0; 32]], &[[255; 32], [1; 32], [3; 32]]);
    let neighbour = Neighbour { index: Some(1), distance_squared: 32, second_squared: 64 };
    assert_eq!(found.rows, [neighbour]);
    assert_eq!(found.columns[0].second_squared, u32::MAX);
}

#[test]
fn kernels_agree_on_every_size_around_a_tile() {
    for rows in [0, 1, 3, 4, 5, 8, 13] {
        for columns in [0, 1, 7, 8, 9, 31, 32, 33, 63, 64, 65, 130, 300] {
            assert_all_equal(&random(rows, 1), &random(columns, 2));
        }
    }
}

#[test]
fn kernels_agree_on_extremes_ties_and_copies() {
    let mut second = random(90, 3);
    second.extend_from_within(10..60);
    second.extend([[0; 32], [255; 32], [0; 32]]);
    let mut first = second[20..40].to_vec();
    // Distances of 254, 255 and 256, which bytes don't tell apart.
    let inverse = second[5].map(|byte| !byte);
    let mut nearly = inverse;
    nearly[0] ^= 1;
    let mut rather = nearly;
    rather[9] ^= 16;
    first.extend([[255; 32], [0; 32], inverse, nearly, rather]);
    assert_all_equal(&first, &second);
    let far: Vec<Bits> = vec![inverse, nearly, rather, inverse];
    assert_all_equal(&far, &second[5..6]);
    assert_all_equal(&second[5..6], &far);
    assert_all_equal(&[inverse], &second[5..6]);
    let mut rng = Seed(4).rng();
    let near: Vec<Bits> = second.iter().map(|bits| altered(bits, 20, &mut rng)).collect();
    assert_all_equal(&near, &second);
}

#[test]
fn copies_with_turned_bits_are_found_and_strangers_are_not() {
    let first = random(300, 10);
    let mut second = random(200, 11);
    let mut rng = Seed(12).rng();
    second.extend(first[..150].iter().map(|bits| altered(bits, 30, &mut rng)));
    let matches = match_features(&features(&first), &features(&second), &MatchOptions::default());
    let truth: Vec<(u32, u32)> = (0..150).map(|at| (at, at + 200)).collect();
    assert_eq!(matches.iter().map(|m| (m.first, m.second)).collect::<Vec<_>>(), truth);
    assert!(matches.iter().all(|m| m.ratio > 0.1 && m.ratio < 0.5));
    let strict = BinaryMatchOptions { max_distance: 10, ..BinaryMatchOptions::default() };
    let options = MatchOptions { binary: strict, ..MatchOptions::default() };
    assert!(match_features(&features(&first), &features(&second), &options).is_empty());
}

#[test]
fn mutual_test_keeps_one_to_one() {
    let first = random(40, 13);
    let mut second = vec![first[0]];
    second.extend(random(40, 14));
    let mut crowded = first.clone();
    crowded.push(first[0]);
    let strict = match_features(&features(&crowded), &features(&second), &MatchOptions::default());
    assert!(strict.is_empty(), "the second image's feature is torn between two");
    let loose = MatchOptions { mutual: false, ..MatchOptions::default() };
    let both = match_features(&features(&crowded), &features(&second), &loose);
    assert_eq!(both.iter().map(|m| (m.first, m.second)).collect::<Vec<_>>(), [(0, 0), (40, 0)]);
}

#[test]
fn kinds_do_not_mix_and_nothing_matches_nothing() {
    let (none, some) = (features(&[]), features(&random(8, 15)));
    let bytes = Features { kind: DescriptorKind::Bytes128, descriptors: vec![7; 8 * 128], ..some.clone() };
    let options = MatchOptions::default();
    for (a, b) in [(&none, &none), (&none, &some), (&some, &none), (&bytes, &some), (&some, &bytes)] {
        assert!(match_features(a, b, &options).is_empty());
    }
    assert_eq!(match_features(&some, &some, &options).len(), 8);
}
