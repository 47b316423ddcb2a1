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
    let projection = Projection::train(&encoded, 12, Seed(12));
    assert_eq!(projection.dimensions(), 12);
    let mut descriptors = CompactDescriptors::new(projection.dimensions());
    encoded.iter().for_each(|values| descriptors.push(&projection.project(values)));
    for (at, list) in nearest(&descriptors, |_| true, 2, Seed(13)).into_iter().enumerate() {
        assert!(list.iter().all(|similar| similar.index as usize % 6 == at % 6), "image {at}: {list:?}");
        assert!(list.iter().all(|similar| similar.similarity > 0.3 && similar.similarity < 1.0));
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
    let projection = Projection::train(&encoded, 8, Seed(12));
    let mut descriptors = CompactDescriptors::new(projection.dimensions());
    encoded.iter().for_each(|values| descriptors.push(&projection.project(values)));
    for (at, list) in nearest(&descriptors, |_| true, 2, Seed(13)).into_iter().enumerate() {
        assert!(list.iter().all(|similar| similar.index as usize % 4 == at % 4), "image {at}: {list:?}");
        assert!(list.iter().all(|similar| similar.similarity > 0.1), "image {at}: {list:?}");
    }
}

#[test]
fn dot_products_are_equal_on_every_path() {
    let mut rng = Seed(14).rng();
    for len in [32, 96, 128, 256, 512, 544] {
        let mut query: Vec<i8> = (0..len).map(|_| rng.random_range(-127..=127)).collect();
        let mut rows: Vec<i8> = (0..len * 9 + 5).map(|_| rng.random_range(-127..=127)).collect();
        for extreme in [false, true] {
            if extreme {
                query.iter_mut().for_each(|value| *value = if *value < 0 { -127 } else { 127 });
                rows.iter_mut()
                    .enumerate()
                    .for_each(|(at, value)| *value = if at % 7 == 0 { 0 } else { -127 });
            }
            let exact: Vec<i32> = rows
                .chunks_exact(len)
                .map(|row| row.iter().zip(&query).map(|(&a, &b)| i32::from(a) * i32::from(b)).sum())
                .collect();
            for kernel in DotKernel::available() {
                let mut dots = vec![7];
                kernel.dots(&query, &rows, &mut dots);
                assert_eq!(dots[1..], exact, "{} with {len} numbers", kernel.name());
            }
        }
    }
    DotKernel::fastest().dots(&[], &[], &mut Vec::new());
}

/// Descriptors around points of a curve, so that neighbours are known and there are many cells.
fn on_a_curve(count: usize) -> CompactDescriptors {
    let mut rng = Seed(15).rng();
    let mut descriptors = CompactDescriptors::new(40);
    let waves: Vec<[f32; 2]> =
        (0..40).map(|_| [rng.random_range(0.02..0.5), rng.random_range(0.0..6.0)]).collect();
    for at in 0..count {
        let along = at as f32 * 0.2;
        let numbers: Vec<f32> =
            waves.iter().map(|w| (w[0] * along + w[1]).cos() + rng.random_range(-0.1..0.1)).collect();
        descriptors.push(&numbers);
    }
    descriptors
}

fn exactly(descriptors: &CompactDescriptors, query: usize, count: usize) -> Vec<u32> {
    let cosine = |other: usize| {
        let dot: i32 = descriptors
            .get(query)
            .iter()
            .zip(descriptors.get(other))
            .map(|(&a, &b)| i32::from(a) * i32::from(b))
            .sum();
        dot as f32 * descriptors.inverse_length(query) * descriptors.inverse_length(other)
    };
    let mut others: Vec<usize> = (0..descriptors.len())
        .filter(|&other| other != query && descriptors.inverse_length(other) > 0.0)
        .collect();
    others.sort_by(|&a, &b| cosine(b).total_cmp(&cosine(a)).then(a.cmp(&b)));
    others.iter().take(count).map(|&other| other as u32).collect()
}

#[test]
fn nearest_is_exact_for_a_few_and_nearly_so_for_many() {
    for (count, least) in [(300, 1.0), (9_000, 0.97)] {
        let descriptors = on_a_curve(count);
        let found = nearest(&descriptors, |at| at % 10 == 0, 10, Seed(16));
        let (mut hits, mut wanted) = (0, 0);
        for at in (0..count).step_by(count / 30) {
            if at % 10 != 0 {
                assert!(found[at].is_empty());
                continue;
            }
            let truth = exactly(&descriptors, at, 10);
            hits += found[at].iter().filter(|similar| truth.contains(&similar.index)).count();
            wanted += truth.len();
            assert!(found[at].is_sorted_by(|a, b| a.similarity >= b.similarity));
        }
        assert!(hits as f64 >= least * wanted as f64 && wanted > 0, "{hits} of {wanted} of {count}");
    }
}

#[test]
fn nearest_skips_what_can_not_be_compared() {
    let mut descriptors = CompactDescriptors::new(3);
    for numbers in
        [&[1.0, 0.1, 0.0][..], &[], &[f32::NAN, 0.0, 0.0], &[0.9, 0.0, 0.1], &[0.0; 3], &[-1.0, 0.0, 0.0]]
    {
        descriptors.push(numbers);
    }
    descriptors.push(&[1e-42, 0.0, 0.0]);
    descriptors.push(&[0.0; 400]);
    let found = nearest(&descriptors, |_| true, 5, Seed(0));
    let indices = |at: usize| found[at].iter().map(|similar| similar.index).collect::<Vec<_>>();
    assert_eq!(indices(0), [3, 5]);
    assert!([1, 2, 4, 6, 7].iter().all(|&at| found[at].is_empty()));
    assert!((found[0][1].similarity + 0.995).abs() < 0.01);
    assert!(nearest(&CompactDescriptors::new(0), |_| true, 3, Seed(0)).is_empty());
    assert!(nearest(&descriptors, |_| true, 0, Seed(0)).iter().all(Vec::is_empty));
    let mut equal = CompactDescriptors::new(32);
    (0..6_000).for_each(|_| equal.push(&[0.5; 32]));
    let found = nearest(&equal, |at| at == 3_000, 4, Seed(0));
    assert_eq!(found[3_000].len(), 4, "a crowd of equals is cut to a bounded part");
}

#[test]
fn projections_keep_what_varies() {
    let mut rng = Seed(17).rng();
    let directions: Vec<Vec<f32>> =
        (0..3).map(|_| (0..200).map(|_| rng.random_range(-1.0..1.0)).collect()).collect();
    let sample: Vec<Vec<f32>> = (0..60)
        .map(|_| {
            let weights: [f32; 3] = [9.0, 3.0, 1.0].map(|size| rng.random_range(-size..size));
            (0..200).map(|k| 5.0 + (0..3).map(|d| weights[d] * directions[d][k]).sum::<f32>()).collect()
        })
        .collect();
    let projection = Projection::train(&sample, 10, Seed(18));
    assert_eq!(projection.dimensions(), 3, "the rest is rounding");
    let distance = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f32>().sqrt();
    for pair in sample.windows(2) {
        let (whole, kept) = (
            distance(&pair[0], &pair[1]),
            distance(&projection.project(&pair[0]), &projection.project(&pair[1])),
        );
        assert!((whole - kept).abs() < 1e-3 * whole, "{whole} became {kept}");
    }
    let first: Vec<f32> = sample.iter().map(|row| projection.project(row)[0].abs()).collect();
    let last: Vec<f32> = sample.iter().map(|row| projection.project(row)[2].abs()).collect();
    assert!(first.iter().sum::<f32>() > 3.0 * last.iter().sum::<f32>());
    assert!(projection.project(&[0.0; 7]).is_empty());
    assert_eq!(Projection::train(&[], 4, Seed(0)).dimensions(), 0);
    assert_eq!(Projection::train(&sample[..1], 4, Seed(0)).dimensions(), 0);
    let equal: Vec<Vec<f32>> = sample.iter().map(|_| vec![1.0; 20]).collect();
    assert_eq!(Projection::train(&equal, 4, Seed(0)).dimensions(), 0);
}

/// Features of a plane of `places`, turned, scaled and shifted, with others that have nothing to do with it.
fn seen(places: &[Descriptor], angle: f32, scale: f32, others: u64, rng: &mut impl rand::Rng) -> Features {
    let mut all = features(&places.iter().map(|d| noisy(d, 6, rng)).collect::<Vec<_>>());
    let mut position = Seed(19).rng();
    for keypoint in &mut all.keypoints {
        let (x, y) = (position.random_range(-300.0..300.0), position.random_range(-200.0..200.0));
        let (sin, cos) = angle.sin_cos();
        keypoint.x_px = 500.0 + scale * (cos * x - sin * y) + rng.random_range(-3.0..3.0);
        keypoint.y_px = 500.0 + scale * (sin * x + cos * y) + rng.random_range(-3.0..3.0);
        keypoint.scale_px = 8.0 * scale;
    }
    let mut noise = features(&random(40, others));
    for keypoint in &mut noise.keypoints {
        keypoint.x_px = rng.random_range(0.0..1000.0);
        keypoint.y_px = rng.random_range(0.0..1000.0);
        keypoint.scale_px = rng.random_range(1.0..30.0);
    }
    all.keypoints.extend(noise.keypoints);
    all.descriptors.extend(noise.descriptors);
    all.colors.extend(noise.colors);
    all
}

#[test]
fn votes_tell_one_place_from_another() {
    let mut rng = Seed(20).rng();
    let (here, there) = (random(60, 21), random(60, 22));
    let sketch = |features: &Features| Sketch::new(features, 90);
    let a = sketch(&seen(&here, 0.0, 1.0, 31, &mut rng));
    for (angle, scale) in [(0.0, 1.0), (1.9, 1.0), (-0.7, 1.6), (3.1, 0.6)] {
        let b = sketch(&seen(&here, angle, scale, 32, &mut rng));
        assert!(a.votes(&b) >= 40 && b.votes(&a) >= 40, "{angle} {scale}: {} votes", a.votes(&b));
    }
    let elsewhere = sketch(&seen(&there, 0.0, 1.0, 33, &mut rng));
    assert!(a.votes(&elsewhere) <= 4, "{} votes by chance", a.votes(&elsewhere));
    assert_eq!(a.votes(&Sketch::default()), 0);
    let mut broken = seen(&here, 0.0, 1.0, 31, &mut rng);
    broken.keypoints.iter_mut().for_each(|keypoint| keypoint.x_px = f32::NAN);
    assert_eq!(sketch(&broken).votes(&a), 0);
}

/// Twelve views along a strip; each shares half of its places with the next.
#[test]
fn neighbours_of_neighbours_are_found_and_errors_passed_on() {
    let mut rng = Seed(23).rng();
    let strip = random(30 * 14, 24);
    let sketches: Vec<Sketch> = (0..12)
        .map(|at| {
            let mut all = features(&strip[30 * at..30 * at + 90]);
            for (k, keypoint) in all.keypoints.iter_mut().enumerate() {
                keypoint.x_px = (k % 30) as f32 * 10.0 + (k / 30) as f32 * 300.0;
                keypoint.y_px = ((30 * at + k) * 7919 % 1000) as f32 + rng.random_range(0.0..2.0);
            }
            Sketch::new(&all, 200)
        })
        .collect();
    // Global descriptors only know the next view.
    let next = |at: usize| Similar { index: (at as u32 + 1) % 12, similarity: 0.5, votes: 0 };
    let initial: Vec<Vec<Similar>> = (0..12).map(|at| vec![next(at)]).collect();
    let load = |at: usize| Ok::<_, String>(sketches[at].clone());
    let options = RetrievalOptions::default();
    let found = refine(initial.clone(), 8, &options, load).expect("sketches are there");
    let indices = |at: usize| found[at].iter().map(|similar| similar.index).collect::<Vec<_>>();
    assert_eq!(
        indices(5)[..2].iter().map(|at| at % 2).sum::<u32>(),
        0,
        "{:?}: 4 and 6 share most",
        indices(5)
    );
    assert!(indices(5).contains(&3) && indices(5).contains(&7), "{:?}", indices(5));
    assert!(!indices(5).contains(&0) && !indices(5).contains(&10), "{:?}", indices(5));
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads can be had");
        pool.install(|| refine(initial.clone(), 8, &options, load))
    };
    assert_eq!(with(1), with(3));
    let failing = |at: usize| if at == 7 { Err("gone".to_owned()) } else { load(at) };
    assert_eq!(refine(initial, 8, &options, failing), Err("gone".to_owned()));
}

#[test]
fn the_search_is_the_same_for_any_number_of_threads() {
    let search = || {
        let descriptors = on_a_curve(5_000);
        let sample: Vec<Vec<f32>> = (0..80)
            .map(|at| descriptors.get(at * 50).iter().map(|&value| f32::from(value)).collect())
            .collect();
        let projection = Projection::train(&sample, 16, Seed(25));
        (nearest(&descriptors, |at| at % 7 == 0, 5, Seed(26)), projection)
    };
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads can be had");
        pool.install(search)
    };
    assert_eq!(with(1), with(3));
}

#[test]
fn words_can_be_given() {
    let words = random(3, 27);
    let given = Vocabulary::from_words(words.as_flattened()).expect("three words");
    assert_eq!(given.num_words(), 3);
    let hex: String = words.as_flattened().iter().map(|byte| format!("{byte:02x}")).collect();
    let options = VocabularyOptions { words: Some(hex.clone()), ..VocabularyOptions::default() };
    assert_eq!(options.given(), Ok(Some(given)));
    assert_eq!(VocabularyOptions::default().given(), Ok(None));
    for bad in ["", "0", "zz", &hex[1..], &hex[2..]] {
        let options = VocabularyOptions { words: Some(bad.to_owned()), ..VocabularyOptions::default() };
        assert!(options.given().is_err(), "{bad:.20}");
    }
}
