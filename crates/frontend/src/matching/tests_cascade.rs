//! The cascade against all products, path by path, on descriptors as photographs have them and on adversarial ones; its
//! bounds; the sweeps against their oracle; what the approximate matcher finds.

use super::cascade::{self, CascadePaths, Prepared};
use super::prepared::as_given;
use super::sketch::{LOOSE, Sketches};
use super::sweep::{ANY_REACH, Limits, NO_REACH, SweepPath, sweep};
use super::tests::features;
use super::*;
use rand::RngExt;
use terrane_geometry::Seed;

type Descriptor = [u8; DESCRIPTOR_LEN];

/// Descriptors like RootSIFT's: a typical one, varied smoothly over cells and directions, of length 512.
fn rootsift(count: usize, seed: u64) -> Vec<Descriptor> {
    let mut rng = Seed(seed).rng();
    let mut one = || {
        let waves: [[f32; 4]; 4] =
            std::array::from_fn(|_| std::array::from_fn(|_| rng.random_range(-3.0..3.0)));
        let value = |k: usize| {
            let (row, column, direction) = ((k / 32) as f32, (k / 8 % 4) as f32, (k % 8) as f32);
            let wave = |wave: &[f32; 4]| {
                let phase = 0.4 * (wave[0] * row + wave[1] * column) + wave[2];
                (phase + direction * std::f32::consts::FRAC_PI_4 * wave[3].round()).cos()
            };
            let noise: f32 = rng.random_range(0.0..0.25);
            (waves.iter().map(wave).sum::<f32>() * 0.6 + 1.0 + noise).max(0.0)
        };
        to_length_512(&std::array::from_fn(value))
    };
    (0..count).map(|_| one()).collect()
}

fn to_length_512(values: &[f32; DESCRIPTOR_LEN]) -> Descriptor {
    let length = values.iter().map(|value| value * value).sum::<f32>().sqrt().max(1e-3);
    values.map(|value| (512.0 * value / length).round() as u8)
}

/// The descriptors again, disturbed, some of them twice, and strangers between them.
fn seen_again(first: &[Descriptor], seed: u64) -> Vec<Descriptor> {
    let mut rng = Seed(seed).rng();
    let mut second = rootsift(first.len() / 2, seed + 1);
    for (at, descriptor) in first.iter().enumerate().step_by(2) {
        let strength = [0.0, 4.0, 12.0, 30.0][at / 2 % 4];
        for _ in 0..1 + usize::from(at % 10 == 0) {
            let value =
                |k: usize| (f32::from(descriptor[k]) + rng.random_range(-1.0..1.0) * strength).max(0.0);
            second.push(to_length_512(&std::array::from_fn(value)));
        }
    }
    second
}

fn random(count: usize, limit: u8, seed: u64) -> Vec<Descriptor> {
    let mut rng = Seed(seed).rng();
    (0..count).map(|_| std::array::from_fn(|_| rng.random_range(0..=limit))).collect()
}

fn all_paths() -> Vec<CascadePaths> {
    let kernels = MatchKernel::available().iter();
    kernels
        .flat_map(|&kernel| SweepPath::available().iter().map(move |&sweep| CascadePaths { kernel, sweep }))
        .collect()
}

/// Matches by the cascade, which must be those of all products; whether bounds were of use.
fn assert_equal(first: &[Descriptor], second: &[Descriptor], options: &MatchOptions) -> (usize, bool) {
    let truth = matches_of(&MatchKernel::fastest().nearest(first, second), first, second, options);
    let mut of_use = true;
    for paths in all_paths() {
        let (a, b) = (Prepared::new(paths, first), Prepared::new(paths, second));
        match cascade::nearest(paths, &a, &b, options) {
            Some(nearest) => {
                let found = matches_of(&nearest, a.descriptors(), b.descriptors(), options);
                assert_eq!(as_given(found, Some(a.order()), Some(b.order())), truth, "{paths:?}");
            }
            None => of_use = false,
        }
    }
    (truth.len(), of_use)
}

#[test]
fn cascade_gives_the_matches_of_all_products() {
    let first = rootsift(1400, 1);
    let mut second = seen_again(&first[..600], 2);
    second.extend(rootsift(800, 19));
    let (num_matches, of_use) = assert_equal(&first, &second, &MatchOptions::default());
    assert!(of_use && (150..300).contains(&num_matches), "{num_matches} matches, bounds of use: {of_use}");
}

#[test]
fn cascade_is_exact_whatever_the_options() {
    let first = rootsift(700, 3);
    let second = seen_again(&first, 4);
    for max_ratio in [0.3, 0.8, 1.0] {
        for max_distance in [0.1, 0.7, 2.0] {
            for mutual in [false, true] {
                let options = MatchOptions { max_ratio, mutual, max_distance, ..MatchOptions::default() };
                assert_equal(&first, &second, &options);
            }
        }
    }
}

#[test]
fn cascade_is_exact_on_adversarial_descriptors() {
    let typical = rootsift(600, 5);
    let mut odd = typical.clone();
    odd[0] = [0; DESCRIPTOR_LEN];
    odd[1] = [255; DESCRIPTOR_LEN];
    odd[2] = std::array::from_fn(|k| if k == 7 { 255 } else { 0 });
    odd[3] = std::array::from_fn(|k| if k % 2 == 0 { 255 } else { 0 });
    odd[500] = odd[3];
    let copies = vec![typical[0]; 600];
    let few = [typical[1]; 300].into_iter().chain(typical[300..].iter().copied()).collect::<Vec<_>>();
    let sides =
        [typical, odd, copies, few, random(600, 127, 6), random(600, 255, 7), vec![[9; DESCRIPTOR_LEN]; 520]];
    for first in &sides {
        for second in &sides {
            assert_equal(first, second, &MatchOptions::default());
        }
    }
}

#[test]
fn prepared_images_of_every_size_match_as_all_products_do() {
    let options = MatchOptions::default();
    let exact = MatchOptions { matcher: Matcher::Exact, ..options.clone() };
    let sides = [0, 1, 2, 70, 530, 1100].map(|count| features(&rootsift(count, 8)));
    for first in &sides {
        for second in &sides {
            assert_eq!(match_features(first, second, &options), match_features(first, second, &exact));
            let ann = MatchOptions { matcher: Matcher::Ann, ..options.clone() };
            assert!(match_features(first, second, &ann).len() <= first.len().min(second.len()));
        }
    }
}

#[test]
fn sketches_never_overestimate_a_distance() {
    for (first, second) in [
        (rootsift(80, 9), seen_again(&rootsift(80, 9), 10)),
        (random(60, 255, 11), rootsift(60, 12)),
        (vec![[0; DESCRIPTOR_LEN], [255; DESCRIPTOR_LEN]], random(60, 3, 13)),
    ] {
        let (a, b) = (Sketches::new(&first), Sketches::new(&second));
        let (row_bases, column_bases) = (a.row_bases(&b), b.column_bases(&a));
        let mut tightness = Vec::new();
        for i in 0..first.len() {
            for j in 0..second.len() {
                if row_bases[i] == LOOSE || column_bases[j] == LOOSE {
                    continue;
                }
                let dot: i32 = a.coarse.codes[i]
                    .iter()
                    .zip(&b.fine.codes[j])
                    .map(|(&a, &b)| i32::from(a) * i32::from(b))
                    .sum();
                let excess = dot - row_bases[i] - column_bases[j];
                let squared = scalar::distance_squared(&first[i], &second[j]) as u32;
                assert!(excess >= -a.reach(&b, squared), "{i} {j}: {excess} against {squared}");
                assert!(excess <= sweep::MAX_EXCESS);
                tightness.push(-f64::from(excess) / f64::from(a.reach(&b, squared)));
            }
        }
        tightness.sort_by(f64::total_cmp);
        if let Some(median) = tightness.get(tightness.len() / 2) {
            assert!(*median > 0.3, "the median bound is {median} of the distance");
        }
    }
}

#[test]
fn sweeps_agree_with_their_oracle() {
    let mut rng = Seed(14).rng();
    for (num_rows, num_columns) in [(1, 1), (3, 31), (4, 32), (9, 33), (37, 1100)] {
        let mut side = |count: usize, limit: i8| {
            let codes: Vec<_> =
                (0..count).map(|_| std::array::from_fn(|_| rng.random_range(-limit..limit))).collect();
            let base = (0..count).map(|_| rng.random_range(-2000..9000)).collect();
            let reach = (0..count)
                .map(|at| match at % 9 {
                    0 => ANY_REACH,
                    1 => NO_REACH,
                    _ => rng.random_range(0..20_000),
                })
                .collect();
            let lone = (0..count).map(|at| if at % 11 == 2 { rng.random_range(0..20_000) } else { NO_REACH });
            (codes, Limits { base, reach, lone: lone.collect() })
        };
        let ((rows, row_limits), (columns, column_limits)) = (side(num_rows, 20), side(num_columns, 40));
        let survivors = |path: SweepPath| {
            let mut survivors = Vec::new();
            let (rows, columns) = (path.rows(&rows), path.columns(&columns));
            for start in (0..num_columns).step_by(sweep::CHUNK) {
                let range = start..num_columns.min(start + sweep::CHUNK);
                sweep((&rows, &row_limits), (&columns, &column_limits), range, &mut survivors);
            }
            survivors.sort_unstable();
            survivors
        };
        let truth = survivors(SweepPath::Scalar);
        assert!(num_rows < 9 || (!truth.is_empty() && truth.len() < num_rows * num_columns));
        for &path in SweepPath::available() {
            assert_eq!(survivors(path), truth, "{}", path.name());
        }
    }
}

#[test]
fn kernels_that_differ_from_the_oracle_are_found_out() {
    assert!(kernel::gives_the_oracles_answer(scalar::nearest));
    let wrong = |first: &[Descriptor], second: &[Descriptor]| {
        let mut nearest = scalar::nearest(first, second);
        nearest.columns[7].second_squared += 1;
        nearest
    };
    assert!(!kernel::gives_the_oracles_answer(wrong));
}

#[test]
fn approximate_matches_are_mostly_the_exact_ones() {
    let first = rootsift(3000, 17);
    let second = seen_again(&first, 18);
    let options = MatchOptions::default();
    let truth = matches_of(&MatchKernel::fastest().nearest(&first, &second), &first, &second, &options);
    let of_path = |path: SweepPath| {
        let (a, b) = (ann::Prepared::new(&first, path), ann::Prepared::new(&second, path));
        let nearest = ann::nearest(&a, &b);
        let found = matches_of(&nearest, a.descriptors(), b.descriptors(), &options);
        (nearest, as_given(found, Some(a.order()), Some(b.order())))
    };
    let scalar = of_path(SweepPath::Scalar);
    for &path in SweepPath::available() {
        assert_eq!(of_path(path), scalar, "{}", path.name());
    }
    let found = scalar.1;
    let pairs = |matches: &[Match]| matches.iter().map(|m| (m.first, m.second)).collect::<Vec<_>>();
    let truth = pairs(&truth);
    let right = pairs(&found).iter().filter(|pair| truth.contains(pair)).count();
    let recall = right as f64 / truth.len() as f64;
    assert!((0.9..=1.0).contains(&recall), "recall {recall}");
}
