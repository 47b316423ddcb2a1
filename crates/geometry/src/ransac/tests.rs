//! The loop, with a mock whose models are integers: data vote for the integer that they are.

use super::sampler::below;
use super::*;
use crate::test_support::Random;

struct Mock {
    data: Vec<i64>,
    /// A sample proposes a model only when it is pure.
    sample_len: usize,
    refines: bool,
}

impl Estimator for Mock {
    type Model = i64;

    fn sample_len(&self) -> usize {
        self.sample_len
    }

    fn data_len(&self) -> usize {
        self.data.len()
    }

    fn propose(&self, sample: &[usize], models: &mut Vec<i64>) {
        assert!((1..sample.len()).all(|k| !sample[..k].contains(&sample[k])), "samples are distinct");
        let first = self.data[sample[0]];
        if sample.iter().all(|&i| self.data[i] == first) {
            models.push(if self.refines { first + 1 } else { first });
        }
    }

    fn score(&self, model: &i64, stop_at: f64) -> Score {
        msac(self.data.len(), 4.0, stop_at, |i| ((self.data[i] - model) as f64).powi(2))
    }

    fn refine(&self, model: &i64) -> Option<i64> {
        self.refines.then_some(model - 1)
    }

    fn inliers(&self, model: &i64) -> Vec<u32> {
        indices_within(self.data.len(), 4.0, |i| ((self.data[i] - model) as f64).powi(2))
    }
}

/// `count` data of which every `1/share`-th is 7 and the others all differ.
fn votes(count: usize, period: usize) -> Vec<i64> {
    (0..count as i64).map(|i| if (i as usize).is_multiple_of(period) { 7 } else { 100 + 10 * i }).collect()
}

#[test]
fn the_majority_wins_and_inliers_are_ascending() {
    let mock = Mock { data: votes(200, 3), sample_len: 3, refines: false };
    let found = run(&mock, &RansacOptions::default(), Seed(1)).unwrap();
    assert_eq!(found.model, 7);
    assert_eq!(found.inliers, (0..200).step_by(3).collect::<Vec<u32>>());
    assert_eq!(found.cost, 4.0 * (200 - 67) as f64);
}

#[test]
fn the_local_step_repairs_biased_proposals() {
    let mock = Mock { data: votes(60, 2), sample_len: 2, refines: true };
    assert_eq!(run(&mock, &RansacOptions::default(), Seed(3)).unwrap().model, 7);
}

#[test]
fn stopping_adapts_to_the_share_of_inliers() {
    let options = RansacOptions { min_iterations: 0, ..Default::default() };
    let clean = Mock { data: vec![7; 50], sample_len: 3, refines: false };
    assert_eq!(run(&clean, &options, Seed(1)).unwrap().iterations, 1);
    let half = Mock { data: votes(400, 2), sample_len: 3, refines: false };
    let expected = iterations_needed(0.5, 3, options.confidence);
    assert!((60..=80).contains(&expected), "{expected}");
    assert_eq!(run(&half, &options, Seed(1)).unwrap().iterations, expected);
    let at_least = RansacOptions { min_iterations: 500, ..options };
    assert_eq!(run(&half, &at_least, Seed(1)).unwrap().iterations, 500);
    let hopeless = Mock { data: (0..90).map(|i| 10 * i).collect(), sample_len: 3, refines: false };
    assert_eq!(run(&hopeless, &RansacOptions { max_iterations: 77, ..options }, Seed(1)), None);
}

#[test]
fn the_number_of_samples_follows_the_formula_at_its_edges() {
    assert_eq!(iterations_needed(1.0, 5, 0.99), 1);
    assert_eq!(iterations_needed(0.0, 5, 0.99), u32::MAX);
    assert_eq!(iterations_needed(0.5, 5, 0.0), 1);
    assert_eq!(iterations_needed(0.5, 1, 0.75), 2);
    assert_eq!(iterations_needed(1e-9, 8, 0.99), u32::MAX);
    assert!(iterations_needed(0.5, 5, 1.0) > 1000);
    assert_eq!(iterations_needed(f64::NAN, 5, 0.99), u32::MAX);
}

#[test]
fn too_few_data_give_nothing() {
    for len in 0..3 {
        let mock = Mock { data: vec![7; len], sample_len: 3, refines: false };
        assert_eq!(run(&mock, &RansacOptions::default(), Seed(1)), None);
    }
    let none = RansacOptions { max_iterations: 0, ..Default::default() };
    assert_eq!(run(&Mock { data: vec![7; 9], sample_len: 3, refines: false }, &none, Seed(1)), None);
}

#[test]
fn seeds_decide_and_nothing_else() {
    let mock = Mock { data: votes(300, 4), sample_len: 3, refines: false };
    let once = run(&mock, &RansacOptions::default(), Seed(9)).unwrap();
    assert_eq!(once, run(&mock, &RansacOptions::default(), Seed(9)).unwrap());
}

#[test]
fn progressive_order_finds_good_data_sooner() {
    let mut data: Vec<i64> = (0..1000).map(|i| 100 + 10 * i).collect();
    data[..60].fill(7);
    let mock = Mock { data, sample_len: 4, refines: false };
    let options = RansacOptions { max_iterations: 2000, min_iterations: 0, ..Default::default() };
    let progressive = RansacOptions { order: SampleOrder::FallingQuality, ..options };
    assert_eq!(run(&mock, &options, Seed(5)), None);
    let found = run(&mock, &progressive, Seed(5)).unwrap();
    assert_eq!((found.model, found.inliers.len()), (7, 60));
}

#[test]
fn progressive_sampling_ends_uniform_and_stays_in_range() {
    let options =
        RansacOptions { max_iterations: 3000, order: SampleOrder::FallingQuality, ..Default::default() };
    let mut sampler = Sampler::new(&options, 5, 40, Seed(2));
    let (mut sample, mut hits) = ([0; 5], [0; 40]);
    for _ in 0..6000 {
        sampler.draw(&mut sample);
        sample.iter().for_each(|&i| hits[i] += 1);
    }
    assert_eq!(sampler.pool, 40);
    assert!(hits[0] > hits[39] && hits[39] > 300, "{hits:?}");
}

#[test]
fn uniform_draws_are_even() {
    let mut random = Random::new("unused but separate");
    assert!(random.unit() < 1.0);
    let mut rng = Seed(4).rng();
    let mut hits = [0u32; 10];
    (0..100_000).for_each(|_| hits[below(&mut rng, 10)] += 1);
    assert!(hits.iter().all(|&count| count.abs_diff(10_000) < 500), "{hits:?}");
}

#[test]
fn scoring_stops_early_and_treats_nan_as_outlier() {
    let full = msac(1000, 1.0, f64::INFINITY, |_| f64::NAN);
    assert_eq!(full, Score { cost: 1000.0, num_inliers: 0 });
    let early = msac(1000, 1.0, 10.0, |_| f64::NAN);
    assert!(early.cost > 10.0 && early.cost < 100.0);
}
