//! Samples of distinct indices, uniform or progressive (PROSAC, Chum & Matas 2005).

use rand::Rng;
use rand_pcg::Pcg64Mcg;

use super::{RansacOptions, SampleOrder};
use crate::Seed;

/// Draws samples of distinct indices, uniformly or progressively.
pub(super) struct Sampler {
    rng: Pcg64Mcg,
    sample_len: usize,
    data_len: usize,
    drawn: f64,
    /// PROSAC: samples come from the first `pool` data until `drawn` reaches `pool_until`.
    pub(super) pool: usize,
    pool_until: f64,
    mean_draws: f64,
}

impl Sampler {
    /// After this many samples PROSAC is plain RANSAC (Chum & Matas 2005).
    const MAX_GROWTH: f64 = 200_000.0;

    pub(super) fn new(options: &RansacOptions, sample_len: usize, data_len: usize, seed: Seed) -> Self {
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

    pub(super) fn draw(&mut self, sample: &mut [usize]) {
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
pub(super) fn below(rng: &mut Pcg64Mcg, len: usize) -> usize {
    ((u128::from(rng.next_u64()) * len as u128) >> 64) as usize
}
