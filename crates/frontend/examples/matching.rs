//! Matches photographs with every path and matcher and prints what that costs:
//! `matching [--max N] [--matcher NAME] [--repeats N] PHOTOS`.
//!
//! For measuring while the front end is worked on; the benches hold the figures that are claimed.

use std::hint::black_box;
use std::time::{Duration, Instant};

use terrane_frontend::matching::{
    Match, MatchKernel, MatchOptions, Matcher, PreparedImage, cascade_paths, match_prepared,
};
use terrane_frontend::{image, sift};
use terrane_scene::{DESCRIPTOR_LEN, Features};

fn main() {
    let mut options = sift::SiftOptions::default();
    let (mut files, mut matchers, mut repeats) = (Vec::new(), Matcher::ALL.to_vec(), 5);
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        let mut value = || arguments.next().unwrap_or_else(|| panic!("{argument} needs a value"));
        match argument.as_str() {
            "--max" => options.max_features = value().parse().expect("a number"),
            "--matcher" => matchers = vec![Matcher::Exact, value().parse().expect("a matcher")],
            "--repeats" => repeats = value().parse().expect("a number"),
            _ => files.push(argument),
        }
    }
    let images: Vec<Features> = files.iter().map(|file| features_of(file, &options)).collect();
    let [first, second, ..] = images.as_slice() else { panic!("two photographs at least") };
    if matchers.len() == Matcher::ALL.len() {
        print_kernels(first, second, repeats);
    }
    let (products, bounds) = cascade_paths();
    println!("cascade: products by {products}, bounds by {bounds}");
    for &matcher in &matchers {
        let options = MatchOptions { matcher, ..MatchOptions::default() };
        let least = least_time(repeats, || drop(black_box(PreparedImage::new(first, &options))));
        println!("prepare for {}: {:.2} ms an image", matcher.name(), 1e3 * least);
    }
    for a in 0..images.len() {
        for b in a + 1..images.len() {
            println!("{} - {}", files[a], files[b]);
            print_pair(&images[a], &images[b], &matchers, repeats);
        }
    }
}

fn features_of(file: &str, options: &sift::SiftOptions) -> Features {
    let bytes = std::fs::read(file).expect("readable");
    let decoded = image::decode(&bytes, &image::DecodeOptions::default()).expect("an image");
    sift::extract(&decoded.luma, decoded.rgb.as_ref(), options)
}

fn print_kernels(first: &Features, second: &Features, repeats: usize) {
    let (a, b) = (descriptors_of(first), descriptors_of(second));
    println!("{} x {} descriptors, one thread", a.len(), b.len());
    for kernel in MatchKernel::available() {
        let (rows, columns) = (kernel.pack_rows(a), kernel.pack_columns(b));
        let least = least_time(repeats, || drop(black_box(kernel.nearest_packed(&rows, &columns))));
        let giga = (a.len() * b.len() * DESCRIPTOR_LEN) as f64 / least / 1e9;
        println!("{:>12}: {:8.2} ms, {giga:6.1} GMAC/s", kernel.name(), 1e3 * least);
    }
}

fn descriptors_of(features: &Features) -> &[[u8; DESCRIPTOR_LEN]] {
    features.descriptors.as_chunks().0
}

fn print_pair(first: &Features, second: &Features, matchers: &[Matcher], repeats: usize) {
    let mut exact: Vec<Match> = Vec::new();
    for &matcher in matchers {
        let options = MatchOptions { matcher, ..MatchOptions::default() };
        let (a, b) = (PreparedImage::new(first, &options), PreparedImage::new(second, &options));
        let mut matches = Vec::new();
        let least = least_time(repeats, || matches = match_prepared(&a, &b, &options));
        if matcher == Matcher::Exact {
            exact = matches.clone();
        }
        let is_right = |m: &&Match| exact.iter().any(|e| (e.first, e.second) == (m.first, m.second));
        let num_right = matches.iter().filter(is_right).count();
        println!(
            "{:>12}: {:8.2} ms, {} matches, recall {:.4}, {}",
            matcher.name(),
            1e3 * least,
            matches.len(),
            num_right as f64 / exact.len().max(1) as f64,
            if matches == exact { "equal" } else { "not equal" },
        );
    }
}

/// Least time of some repeats: processor time in hundredths of seconds is too coarse, so wall time on an idle machine.
fn least_time(repeats: usize, mut work: impl FnMut()) -> f64 {
    let time = |_| {
        let start = Instant::now();
        work();
        start.elapsed()
    };
    (0..repeats).map(time).min().unwrap_or(Duration::ZERO).as_secs_f64()
}
