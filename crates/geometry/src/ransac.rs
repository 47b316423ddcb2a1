//! Robust estimation by random sampling, for any model.
//!
//! The loop owns sampling, stopping and the random stream; an [`Estimator`] knows the geometry. Models are compared by the
//! truncated squared error (MSAC, Torr & Zisserman 2000), which is given up as soon as it exceeds the best so far (bail-out,
//! Capel 2005); each new best is optimised locally (LO-RANSAC, Chum, Matas & Kittler 2003); the number of samples adapts to
//! the share of inliers (Fischler & Bolles 1981); data in falling order of quality can be drawn progressively (PROSAC, Chum &
//! Matas 2005). Same data, options and seed give the same result on any processor.

mod sampler;
mod stopping;
#[cfg(test)]
mod tests;

use serde::{Deserialize, Serialize};

use crate::Seed;
use sampler::Sampler;
use stopping::Stopping;
pub use stopping::iterations_needed;

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

    /// Fewest data, of those that [`Estimator::screen`] looks at, that must agree with a model for it to be looked at further.
    /// Default: a sample's worth.
    fn min_support(&self) -> usize {
        self.sample_len()
    }

    /// Adds every model that the data at these distinct indices allow; none when they are degenerate.
    fn propose(&self, sample: &[usize], models: &mut Vec<Self::Model>);

    /// The score of a model. It may give up early once the cost exceeds `stop_at`, with any cost above it.
    fn score(&self, model: &Self::Model, stop_at: f64) -> Score;

    /// A cheaper score by which the models of samples are compared with each other only, as over part of the data or in
    /// single precision. Default: the score itself.
    fn screen(&self, model: &Self::Model, stop_at: f64) -> Score {
        self.score(model, stop_at)
    }

    /// A model fitted to the data that agree with this one, or `None` when that fails. Need not be better.
    fn refine(&self, model: &Self::Model) -> Option<Self::Model>;

    /// A cheaper refinement for models on the way. Default: the refinement itself.
    fn refine_briefly(&self, model: &Self::Model) -> Option<Self::Model> {
        self.refine(model)
    }

    /// A refinement that lowers the cost by a smaller share is the last. Default 1e-6: rounding.
    fn min_gain(&self) -> f64 {
        1e-6
    }

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
    run_from(estimator, None, options, seed)
}

/// [`run`] with a model that is known beforehand, as one of a narrower kind: samples must do better, and fewer are drawn when
/// it is good.
pub fn run_from<E: Estimator>(
    estimator: &E,
    start: Option<E::Model>,
    options: &RansacOptions,
    seed: Seed,
) -> Option<Robust<E::Model>> {
    let (sample_len, data_len) = (estimator.sample_len(), estimator.data_len());
    if sample_len == 0 || data_len < sample_len {
        return None;
    }
    let mut sampler = Sampler::new(options, sample_len, data_len, seed);
    let mut stopping = Stopping::new(options, sample_len, data_len);
    let mut sample = vec![0; sample_len];
    let mut models = Vec::new();
    let mut best = start.map(|model| {
        let score = estimator.score(&model, f64::INFINITY);
        optimise((model, score), LOCAL_ROUNDS, estimator, E::refine_briefly)
    });
    if let Some((model, _)) = &best {
        stopping.set_best(&estimator.inliers(model));
    }
    let mut best_screened = f64::INFINITY;
    let mut iterations = 0;
    while !stopping.is_enough(iterations, sampler.pool) {
        iterations += 1;
        sampler.draw(&mut sample);
        models.clear();
        estimator.propose(&sample, &mut models);
        let Some((model, screened)) = best_of(estimator, &models, best_screened) else { continue };
        best_screened = screened.cost;
        let score = estimator.score(&model, f64::INFINITY);
        let found = optimise((model, score), LOCAL_ROUNDS, estimator, E::refine_briefly);
        if best.as_ref().is_none_or(|(_, score)| found.1.cost < score.cost) {
            stopping.set_best(&estimator.inliers(&found.0));
            best = Some(found);
        }
    }
    let (model, score) = optimise(best?, FINAL_ROUNDS, estimator, E::refine);
    let inliers = estimator.inliers(&model);
    (inliers.len() >= sample_len).then_some(Robust { model, inliers, cost: score.cost, iterations })
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

/// The best model of one sample, when it beats `cost_to_beat` and has inliers enough.
fn best_of<E: Estimator>(estimator: &E, models: &[E::Model], cost_to_beat: f64) -> Option<(E::Model, Score)> {
    let mut best: Option<(usize, Score)> = None;
    for (index, model) in models.iter().enumerate() {
        let limit = best.map_or(cost_to_beat, |(_, score)| score.cost);
        let score = estimator.screen(model, limit);
        if score.cost < limit && score.num_inliers as usize >= estimator.min_support() {
            best = Some((index, score));
        }
    }
    best.map(|(index, score)| (models[index].clone(), score))
}

/// Refines while that helps, at most so many times.
fn optimise<E: Estimator>(
    start: (E::Model, Score),
    rounds: usize,
    estimator: &E,
    refine: impl Fn(&E, &E::Model) -> Option<E::Model>,
) -> (E::Model, Score) {
    let mut best = start;
    for _ in 0..rounds {
        let Some(model) = refine(estimator, &best.0) else { break };
        let score = estimator.score(&model, best.1.cost);
        let gained = best.1.cost - score.cost;
        if !(gained > 0.0) {
            break;
        }
        let done = gained < estimator.min_gain() * best.1.cost;
        best = (model, score);
        if done {
            break;
        }
    }
    best
}
