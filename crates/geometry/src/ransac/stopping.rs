//! How many samples are enough.

use super::{RansacOptions, SampleOrder};
use crate::elementary::{log_of_complement, natural_log};

/// Fewest data of a prefix whose share of inliers may end progressive sampling.
const MIN_PREFIX: usize = 50;
/// Prefixes looked at, from a quarter of the data to all.
const PREFIXES: usize = 16;

/// Knows when the best model so far has been looked for long enough.
pub(super) struct Stopping {
    sample_len: usize,
    data_len: usize,
    options: RansacOptions,
    /// Lengths of prefixes, and how many samples from within each are enough.
    needed: Vec<(usize, u32)>,
}

impl Stopping {
    pub(super) fn new(options: &RansacOptions, sample_len: usize, data_len: usize) -> Self {
        Self { sample_len, data_len, options: *options, needed: vec![(data_len, u32::MAX)] }
    }

    /// Takes note of the inliers, ascending, of a new best model.
    ///
    /// In falling order of quality samples come from a prefix of the data, where the share of inliers is higher than over all:
    /// samples needed are counted for that prefix (maximality of PROSAC, Chum & Matas 2005).
    pub(super) fn set_best(&mut self, inliers: &[u32]) {
        let shortest = match self.options.order {
            SampleOrder::Uniform => PREFIXES,
            SampleOrder::FallingQuality => PREFIXES / 4,
        };
        let prefixes = (shortest..=PREFIXES)
            .map(|k| self.data_len * k / PREFIXES)
            .filter(|&len| len >= MIN_PREFIX || len == self.data_len);
        self.needed = prefixes
            .map(|len| {
                let count = inliers.partition_point(|&i| (i as usize) < len);
                let share = count as f64 / len as f64;
                (len, iterations_needed(share, self.sample_len, self.options.confidence))
            })
            .collect();
    }

    /// Whether this many samples from the first `pool` data are enough.
    pub(super) fn is_enough(&self, iterations: u32, pool: usize) -> bool {
        let is_found = || self.needed.iter().any(|&(len, needed)| len >= pool && iterations >= needed);
        iterations >= self.options.max_iterations || iterations >= self.options.min_iterations && is_found()
    }
}

/// How many samples of `sample_len` must be drawn to meet one without outliers with this confidence.
pub fn iterations_needed(inlier_share: f64, sample_len: usize, confidence: f64) -> u32 {
    let share = inlier_share.clamp(0.0, 1.0);
    let all_inliers = (0..sample_len).fold(1.0, |product, _| product * share);
    let allowed_failure = (1.0 - confidence).clamp(f64::MIN_POSITIVE, 1.0);
    if all_inliers >= 1.0 {
        return 1;
    }
    // The complement's logarithm keeps tiny shares, where `1 - x` would round to one; the cast saturates.
    let needed = (natural_log(allowed_failure) / log_of_complement(all_inliers)).ceil();
    if needed.is_nan() { u32::MAX } else { (needed as u32).max(1) }
}
