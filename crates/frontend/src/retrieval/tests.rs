//! Vocabulary, encoding and neighbours against known groups.

use super::*;
use terrane_scene::{DescriptorKind, Keypoint};

type Descriptor = [u8; DESCRIPTOR_LEN];

fn features(descriptors: &[Descriptor]) -> Features {
    let keypoint = Keypoint { x_px: 0.5, y_px: 0.5, scale_px: 1.0, orientation_rad: 0.0 };
    Features {
        keypoints: vec![keypoint; descriptors.len()],
        descriptors: descriptors.as_flattened().to_vec(),
        colors: vec![[0; 3]; descriptors.len()],
        ..Features::default()
    }
}

fn random(count: usize, seed: u64) -> Vec<Descriptor> {
    let mut rng = Seed(seed).rng();
    (0..count).map(|_| std::array::from_fn(|_| rng.random_range(0..120))).collect()
}

fn noisy(descriptor: &Descriptor, amount: u8, rng: &mut impl rand::Rng) -> Descriptor {
    descriptor.map(|byte| byte.saturating_add(rng.random_range(0..=amount)))
}

fn options(num_words: u32) -> VocabularyOptions {
    VocabularyOptions { num_words, ..VocabularyOptions::default() }
}

#[test]
fn sample_is_distinct_ordered_and_complete_when_large() {
    let descriptors = random(50, 1);
    let all = features(&descriptors);
    assert_eq!(sample(&all, 100, Seed(2)), all.descriptors);
    assert!(sample(&all, 0, Seed(2)).is_empty());
    let some = sample(&all, 20, Seed(2));
    let places: Vec<usize> = some
        .as_chunks::<DESCRIPTOR_LEN>()
        .0
        .iter()
        .map(|drawn| descriptors.iter().position(|descriptor| descriptor == drawn).expect("drawn from these"))
        .collect();
    assert_eq!(places.len(), 20);
    assert!(places.is_sorted_by(|a, b| a < b));
    assert_ne!(sample(&all, 20, Seed(3)), some);
}

#[test]
fn training_finds_the_clusters_that_are_there() {
    let centers = random(10, 4);
    let mut rng = Seed(5).rng();
    let data: Vec<Descriptor> = (0..2000).map(|at| noisy(&centers[at % 10], 8, &mut rng)).collect();
    let vocabulary = Vocabulary::train(data.as_flattened(), &options(10), Seed(6));
    assert_eq!(vocabulary.num_words(), 10);
    for center in &centers {
        let close = vocabulary
            .words()
            .iter()
            .any(|word| word.iter().zip(center).all(|(&w, &c)| w.abs_diff(c + 4) <= 2));
        assert!(close, "noise is uniform over 0..=8, so the mean is four above the centre");
    }
}

#[test]
fn training_is_the_same_for_any_number_of_threads() {
    let data = random(9000, 7);
    let train = || Vocabulary::train(data.as_flattened(), &options(16), Seed(8));
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads can be had");
        pool.install(train)
    };
    assert_eq!(with(1), with(3));
}

#[test]
fn degenerate_training_sets_do_not_panic() {
    assert_eq!(Vocabulary::train(&[], &options(8), Seed(0)).num_words(), 0);
    let same = [[7; DESCRIPTOR_LEN]; 100];
    let vocabulary = Vocabulary::train(same.as_flattened(), &options(8), Seed(0));
    assert_eq!(vocabulary.words(), &[[7; DESCRIPTOR_LEN]]);
    assert!(vocabulary.encode(&features(&[])).is_empty());
    assert!(vocabulary.encode(&features(&same)).iter().all(|value| *value == 0.0));
    assert!(Vocabulary { words: Vec::new() }.encode(&features(&same)).is_empty());
}

/// Images of the same place share most of their descriptors, up to noise.
#[test]
fn images_of_one_place_find_each_other() {
    let mut rng = Seed(9).rng();
    let places: Vec<Vec<Descriptor>> = (0..6).map(|place| random(300, 20 + place)).collect();
    let images: Vec<Features> = (0..18)
        .map(|at| {
            let shared = places[at % 6].iter().skip(20 * (at / 6)).map(|d| noisy(d, 10, &mut rng));
            let mut all: Vec<Descriptor> = shared.collect();
            all.extend(random(100, 40 + at as u64));
            features(&all)
        })
        .collect();
    let training: Vec<u8> =
        images.iter().enumerate().flat_map(|(at, f)| sample(f, 200, Seed(10).item(&[at as u64]))).collect();
    let vocabulary = Vocabulary::train(&training, &options(32), Seed(11));
    let encoded: Vec<Vec<f32>> = images.iter().map(|features| vocabulary.encode(features)).collect();
    for values in &encoded {
        let length: f32 = values.iter().map(|value| value * value).sum::<f32>().sqrt();
        assert!((length - 1.0).abs() < 1e-5);
    }
    for (at, list) in nearest(&encoded, 2).into_iter().enumerate() {
        assert!(list.iter().all(|similar| similar.index as usize % 6 == at % 6), "image {at}: {list:?}");
        assert!(list.iter().all(|similar| similar.similarity > 0.1 && similar.similarity < 0.999));
    }
}

#[test]
fn images_of_one_place_find_each_other_by_bits() {
    let mut rng = Seed(31).rng();
    let bits = |seed: u64, count: usize| -> Vec<[u8; 32]> {
        let mut rng = Seed(seed).rng();
        (0..count).map(|_| std::array::from_fn(|_| rng.random_range(0..=255))).collect()
    };
    let places: Vec<Vec<[u8; 32]>> = (0..4).map(|place| bits(place, 300)).collect();
    let images: Vec<Features> = (0..12)
        .map(|at| {
            let mut all = places[at % 4].clone();
            for descriptor in &mut all {
                for _ in 0..20 {
                    let bit = rng.random_range(0..256_usize);
                    descriptor[bit / 8] ^= 1 << (bit % 8);
                }
            }
            all.extend(bits(50 + at as u64, 100));
            Features {
                kind: DescriptorKind::Bits256,
                descriptors: all.into_flattened(),
                ..Features::default()
            }
        })
        .collect();
    let training: Vec<u8> =
        images.iter().enumerate().flat_map(|(at, f)| sample(f, 200, Seed(10).item(&[at as u64]))).collect();
    let vocabulary = Vocabulary::train(&training, &options(32), Seed(11));
    let encoded: Vec<Vec<f32>> = images.iter().map(|features| vocabulary.encode(features)).collect();
    for (at, list) in nearest(&encoded, 2).into_iter().enumerate() {
        assert!(list.iter().all(|similar| similar.index as usize % 4 == at % 4), "image {at}: {list:?}");
        assert!(list.iter().all(|similar| similar.similarity > 0.1), "image {at}: {list:?}");
    }
}

#[test]
fn nearest_is_that_of_the_definition_and_skips_the_unusable() {
    let mut rng = Seed(12).rng();
    let mut descriptors: Vec<Vec<f32>> =
        (0..37).map(|_| (0..19).map(|_| rng.random_range(-1.0..1.0)).collect()).collect();
    descriptors[4] = Vec::new();
    descriptors[5] = vec![1.0; 7];
    descriptors[6][3] = f32::NAN;
    descriptors[11] = descriptors[10].clone();
    let found = nearest(&descriptors, 5);
    for (at, list) in found.iter().enumerate() {
        if (4..7).contains(&at) {
            assert!(list.is_empty());
            continue;
        }
        let exact = |other: usize| -> f64 {
            descriptors[at].iter().zip(&descriptors[other]).map(|(&a, &b)| f64::from(a) * f64::from(b)).sum()
        };
        let worst = list.last().map(|similar| similar.index as usize).expect("five neighbours");
        assert_eq!(list.len(), 5);
        let better = (0..37)
            .filter(|&other| other != at && !(4..7).contains(&other) && exact(other) > exact(worst) + 1e-5);
        assert!(better.count() <= 4);
        assert!(list.is_sorted_by(|a, b| a.similarity >= b.similarity));
    }
    assert!(nearest(&[], 3).is_empty());
    assert!(nearest(&descriptors, 0).iter().all(Vec::is_empty));
    assert_eq!(nearest(&descriptors, 1000)[0].len(), 33);
}
