//! Nearest neighbours of 8,192 descriptors among 8,192 others, one thread, on every path that this processor has.

use terrane_benches::Request;
use terrane_benches::table::{Bar, Row};
use terrane_benches::usage::cpu_of;
use terrane_frontend::matching::{MatchKernel, Nearest};
use terrane_frontend::sift::{self, FirstOctave, SiftOptions};
use terrane_scene::DESCRIPTOR_LEN;

use crate::sets::{Set, decoded};

const COUNT: usize = 8192;
const ROUNDS: usize = 5;

type Descriptor = [u8; DESCRIPTOR_LEN];

pub fn rows(_: &Request) -> anyhow::Result<Vec<Row>> {
    let photographs = Set::named("fountain-P11").photographs(2)?;
    let options = SiftOptions {
        max_features: COUNT as u32,
        first_octave: FirstOctave::Doubled,
        ..SiftOptions::default()
    };
    let descriptors: Vec<Vec<Descriptor>> = decoded(&photographs)?
        .iter()
        .map(|image| {
            let features = sift::extract(&image.luma, None, &options);
            features.descriptors.as_chunks::<DESCRIPTOR_LEN>().0.iter().copied().take(COUNT).collect()
        })
        .collect();
    let (first, second) = (&descriptors[0], &descriptors[1]);
    let macs = (first.len() * second.len() * DESCRIPTOR_LEN) as f64;
    let mut rows = Vec::new();
    let mut oracle: Option<Nearest> = None;
    for kernel in MatchKernel::available() {
        let rounds = if kernel.name() == "scalar" { 1 } else { ROUNDS };
        let mut best_s = f64::INFINITY;
        let mut found = None;
        for _ in 0..rounds {
            let (seconds, nearest) = cpu_of(|| kernel.nearest(first, second));
            best_s = best_s.min(seconds);
            found = Some(nearest);
        }
        let equal = match (&oracle, &found) {
            (Some(oracle), Some(found)) => oracle == found,
            _ => true,
        };
        oracle = oracle.or(found);
        let name = kernel.name();
        let figure = |what: &str| format!("{} x {} by {name}: {what}", first.len(), second.len());
        rows.push(Row::new(figure("time"), Some(best_s * 1e3), "ms", Bar::None));
        rows.push(Row::new(figure("speed"), Some(macs / best_s * 1e-9), "GMAC/s", Bar::None));
        rows.push(Row::new(
            figure("equal to the first path"),
            Some(f64::from(u8::from(equal))),
            "",
            Bar::AtLeast(1.0),
        ));
    }
    Ok(rows)
}
