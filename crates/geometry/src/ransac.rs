//! Robust estimation by random sampling, for any model.
//!
//! The loop owns sampling, stopping and the random stream; an [`Estimator`] knows the geometry. Models are compared by the
//! truncated squared error (MSAC, Torr & Zisserman 2000); each new best is optimised locally (LO-RANSAC, Chum, Matas &
//! Kittler 2003); the number of samples adapts to the share of inliers (Fischler & Bolles 1981); data in falling order of
//! quality can be drawn progressively (PROSAC, Chum & Matas 2005). Same data, options and seed give the same result.

use rand::Rng;
use rand_pcg::Pcg64Mcg;
use serde::{Deserialize, Serialize};

use crate::Seed;

#[cfg(test)]
mod tests;

/// Local optimisations of one model in the loop, and of the best at the end.
const LOCAL_ROUNDS: usize = 2;
const FINAL_ROUNDS: usize = 8;

/// How well a model explains the data.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Score {
    /// Sum over the data of the squared error, each cut off at the squared threshold. Lower is better.
    pub cost: f64,
    /// How many data lie within the threshold.
    pub num_inliers: u32,
}

/// What the loop needs to know of a problem.
pub trait Estimator {
    /// What is estimated.
    type Model: Clone;

    /// How many data determine a model; at least one.
    fn sample_len(&self) -> usize;

    /// How many data there are.
    fn data_len(&self) -> usize;

    /// Adds every model that the data at these distinct indices allow; none when they are degenerate.
    fn propose(&self, sample: &[usize], models: &mut Vec<Self::Model>);

    /// The score of a model. It may give up early once the cost exceeds `stop_at`, with any cost above it.
    fn score(&self, model: &Self::Model, stop_at: f64) -> Score;

    /// A model fitted to the data that agree with this one, or `None` when that fails. Need not be better.
    fn refine(&self, model: &Self::Model) -> Option<Self::Model>;

    /// The data within the threshold of a model, ascending.
    fn inliers(&self, model: &Self::Model) -> Vec<u32>;
}

/// How samples are drawn.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SampleOrder {
    /// Every datum is as likely as any other.
    #[default]
    Uniform,
    /// The data arrive in falling order of quality; the first are drawn earlier (Chum & Matas 2005).
    FallingQuality,
}

/// When to stop sampling, and how samples are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RansacOptions {
    /// Most samples. Range: at least 1. Default 10,000, as COLMAP's two-view geometry.
    pub max_iterations: u32,
    /// Fewest samples, whatever the share of inliers. Default 100, as COLMAP's two-view geometry.
    pub min_iterations: u32,
    /// Probability that one sample was free of outliers. Range: between 0 and 1. Default 0.9999, as PoseLib.
    pub confidence: f64,
    /// How samples are drawn. Default uniform.
    pub order: SampleOrder,
}

impl Default for RansacOptions {
    fn default() -> Self {
        Self { max_iterations: 10_000, min_iterations: 100, confidence: 0.9999, order: SampleOrder::Uniform }
    }
}

/// A model with the data that support it.
#[derive(Clone, Debug, PartialEq)]
pub struct Robust<M> {
    /// The best model found.
    pub model: M,
    /// Indices of the data within the threshold, ascending.
    pub inliers: Vec<u32>,
    /// Truncated squared error over all data, in the square of the threshold's unit.
    pub cost: f64,
    /// How many samples were drawn.
    pub iterations: u32,
}

/// The best model for the data, or `None` when no sample gave a model that at least a sample's worth of data support.
pub fn run<E: Estimator>(estimator: &E, options: &RansacOptions, seed: Seed) -> Option<Robust<E::Model>> {
    let (sample_len, data_len) = (estimator.sample_len(), estimator.data_len());
    if sample_len == 0 || data_len < sample_len {
        return None;
    }
    let mut sampler = Sampler::new(options, sample_len, data_len, seed);
    let mut sample = vec![0; sample_len];
    let mut models = Vec::new();
    let mut best: Option<(E::Model, Score)> = None;
    let mut best_minimal_cost = f64::INFINITY;
    let mut needed = options.max_iterations;
    let mut iterations = 0;
    while iterations < options.max_iterations && iterations < needed.max(options.min_iterations) {
        iterations += 1;
        sampler.draw(&mut sample);
        models.clear();
        estimator.propose(&sample, &mut models);
        let Some(found) = best_of(estimator, &models, best_minimal_cost) else { continue };
        best_minimal_cost = found.1.cost;
        let found = optimise(estimator, found, LOCAL_ROUNDS);
        if best.as_ref().is_none_or(|(_, score)| found.1.cost < score.cost) {
            let share = f64::from(found.1.num_inliers) / data_len as f64;
            needed = iterations_needed(share, sample_len, options.confidence);
            best = Some(found);
        }
    }
    let (model, score) = optimise(estimator, best?, FINAL_ROUNDS);
    let inliers = estimator.inliers(&model);
    (inliers.len() >= sample_len).then_some(Robust { model, inliers, cost: score.cost, iterations })
}

/// How many samples of `sample_len` must be drawn to meet one without outliers with this confidence.
pub fn iterations_needed(inlier_share: f64, sample_len: usize, confidence: f64) -> u32 {
    let all_inliers = inlier_share.clamp(0.0, 1.0).powi(i32::try_from(sample_len).unwrap_or(i32::MAX));
    let allowed_failure = (1.0 - confidence).clamp(f64::MIN_POSITIVE, 1.0);
    if all_inliers >= 1.0 {
        return 1;
    }
    // `ln_1p` keeps tiny shares, where `1 - x` would round to one; the cast saturates.
    let needed = (allowed_failure.ln() / (-all_inliers).ln_1p()).ceil();
    if needed.is_nan() { u32::MAX } else { (needed as u32).max(1) }
}

/// The MSAC score of errors given one by one; an error that is not a number counts as an outlier.
///
/// Gives up as soon as the cost exceeds `stop_at`, looked at every few data so that the sum stays fast.
pub fn msac(
    data_len: usize,
    max_squared_error: f64,
    stop_at: f64,
    squared_error: impl Fn(usize) -> f64,
) -> Score {
    const STRIDE: usize = 32;
    let mut score = Score { cost: 0.0, num_inliers: 0 };
    let mut start = 0;
    while start < data_len && score.cost <= stop_at {
        let end = (start + STRIDE).min(data_len);
        for i in start..end {
            let error = squared_error(i);
            let inside = error < max_squared_error;
            score.cost += if inside { error } else { max_squared_error };
            score.num_inliers += u32::from(inside);
        }
        start = end;
    }
    score
}

/// The indices whose squared error is below the squared threshold, ascending.
pub fn indices_within(
    data_len: usize,
    max_squared_error: f64,
    squared_error: impl Fn(usize) -> f64,
) -> Vec<u32> {
    (0..data_len).filter(|&i| squared_error(i) < max_squared_error).map(|i| i as u32).collect()
}

/// The best model of one sample, when it beats `cost_to_beat` and has a sample's worth of inliers.
fn best_of<E: Estimator>(estimator: &E, models: &[E::Model], cost_to_beat: f64) -> Option<(E::Model, Score)> {
    let mut best: Option<(usize, Score)> = None;
    for (index, model) in models.iter().enumerate() {
        let limit = best.map_or(cost_to_beat, |(_, score)| score.cost);
        let score = estimator.score(model, limit);
        if score.cost < limit && score.num_inliers as usize >= estimator.sample_len() {
            best = Some((index, score));
        }
    }
    best.map(|(index, score)| (models[index].clone(), score))
}

/// Refines while that helps, at most so many times.
fn optimise<E: Estimator>(estimator: &E, start: (E::Model, Score), rounds: usize) -> (E::Model, Score) {
    let mut best = start;
    for _ in 0..rounds {
        let Some(model) = estimator.refine(&best.0) else { break };
        let score = estimator.score(&model, best.1.cost);
        // Gains below this are rounding; they would only burn rounds.
        let gained = best.1.cost - score.cost;
        if !(gained > 0.0) {
            break;
        }
        let done = gained < 1e-6 * best.1.cost;
        best = (model, score);
        if done {
            break;
        }
    }
    best
}

/// Draws samples of distinct indices, uniformly or progressively.
struct Sampler {
    rng: Pcg64Mcg,
    sample_len: usize,
    data_len: usize,
    drawn: f64,
    /// PROSAC: samples come from the first `pool` data until `drawn` reaches `pool_until`.
    pool: usize,
    pool_until: f64,
    mean_draws: f64,
}

impl Sampler {
    /// After this many samples PROSAC is plain RANSAC (Chum & Matas 2005).
    const MAX_GROWTH: f64 = 200_000.0;

    fn new(options: &RansacOptions, sample_len: usize, data_len: usize, seed: Seed) -> Self {
        let mut mean_draws = f64::from(options.max_iterations).min(Self::MAX_GROWTH);
        for i in 0..sample_len {
            mean_draws *= (sample_len - i) as f64 / (data_len - i) as f64;
        }
        let pool = match options.order {
            SampleOrder::Uniform => data_len,
            SampleOrder::FallingQuality => sample_len,
        };
        let rng = seed.derive(b"ransac").rng();
        Self { rng, sample_len, data_len, drawn: 0.0, pool, pool_until: 1.0, mean_draws }
    }

    fn draw(&mut self, sample: &mut [usize]) {
        self.drawn += 1.0;
        while self.drawn > self.pool_until && self.pool < self.data_len {
            let next = (self.pool + 1) as f64;
            let grown = self.mean_draws * next / (next - self.sample_len as f64);
            self.pool_until += (grown - self.mean_draws).ceil();
            self.mean_draws = grown;
            self.pool += 1;
        }
        if self.pool >= self.data_len {
            self.draw_from(self.data_len, sample);
        } else {
            // The newest of the pool is always in; the others come from before it.
            let (last, others) = sample.split_last_mut().expect("a sample has at least one datum");
            *last = self.pool - 1;
            self.draw_from(self.pool - 1, others);
        }
    }

    fn draw_from(&mut self, len: usize, sample: &mut [usize]) {
        for k in 0..sample.len() {
            loop {
                let index = below(&mut self.rng, len);
                if !sample[..k].contains(&index) {
                    sample[k] = index;
                    break;
                }
            }
        }
    }
}

/// A number below `len`; own arithmetic, so that results outlive changes of the random library.
fn below(rng: &mut Pcg64Mcg, len: usize) -> usize {
    ((u128::from(rng.next_u64()) * len as u128) >> 64) as usize
}
