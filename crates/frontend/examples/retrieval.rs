//! How many of the pairs that can be matched retrieval finds, positions hidden:
//! `retrieval [--truth FILE] [--make-truth FILE] [--cache DIR] [--save-words FILE] [--set NAME=N] FOLDER`.
//!
//! The truth is a list of verified pairs, as `benches/peers/colmap_pairs.py` writes it: two names and a number of inliers
//! a line. `--make-truth` makes one with our own matching, of the 30 spatial neighbours of each image, or of all pairs
//! when there is no GPS.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use terrane_frontend::pairs::{PairMode, PairOptions, select};
use terrane_frontend::retrieval::{
    CompactDescriptors, Projection, RetrievalOptions, Similar, Sketch, Vocabulary, VocabularyOptions,
    nearest, refine, sample,
};
use terrane_frontend::verification::{Candidate, View, verify};
use terrane_frontend::{cameras, image, matching, metadata, sift};
use terrane_geometry::Seed;
use terrane_scene::{DESCRIPTOR_LEN, Features, ImageRecord, ImageTable, Keypoint};

#[derive(Default)]
struct Flags {
    truth: Option<PathBuf>,
    make_truth: Option<PathBuf>,
    cache: Option<PathBuf>,
    save_words: Option<PathBuf>,
    folder: PathBuf,
    retrieval: RetrievalOptions,
    vocabulary: VocabularyOptions,
}

fn main() {
    let flags = flags();
    let (table, features) = photographs(&flags);
    println!("{} images", table.images.len());
    if let Some(path) = &flags.make_truth {
        make_truth(&table, &features, path);
    }
    let similar = similar(&features, &flags);
    let Some(path) = &flags.truth else { return };
    let truth = read_truth(&table, path);
    for (name, lists) in &similar {
        print!("{name:>24}:");
        for count in [5, 10, 20, 30, 40, 60] {
            print!("  @{count} {:.4}", recall(lists, &truth, count));
        }
        println!();
    }
}

fn flags() -> Flags {
    let mut flags = Flags::default();
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        let mut value = || arguments.next().expect("a value");
        match argument.as_str() {
            "--truth" => flags.truth = Some(value().into()),
            "--make-truth" => flags.make_truth = Some(value().into()),
            "--cache" => flags.cache = Some(value().into()),
            "--save-words" => flags.save_words = Some(value().into()),
            "--set" => {
                let setting = value();
                let (name, number) = setting.split_once('=').expect("NAME=N");
                let number: u32 = number.parse().expect("a number");
                match name {
                    "dimensions" => flags.retrieval.dimensions = number,
                    "candidates" => flags.retrieval.candidates = number,
                    "local_features" => flags.retrieval.local_features = number,
                    "rounds" => flags.retrieval.rounds = number,
                    "num_words" => flags.vocabulary.num_words = number,
                    other => panic!("unknown option {other}"),
                }
            }
            _ => flags.folder = argument.into(),
        }
    }
    flags
}

/// The images of a folder with their features, from the cache where it has them.
fn photographs(flags: &Flags) -> (ImageTable, Vec<Features>) {
    let files = std::fs::read_dir(&flags.folder).expect("a folder");
    let mut paths: Vec<PathBuf> = files.filter_map(|entry| Some(entry.ok()?.path())).collect();
    paths.sort();
    let read: Vec<_> = paths.par_iter().filter_map(|path| photograph(path, flags.cache.as_deref())).collect();
    let described: Vec<_> = read.iter().map(|(name, metadata, _)| (name.clone(), metadata.clone())).collect();
    let (cameras, camera_of) = cameras::group(&described, None);
    let mut images = Vec::new();
    let mut features = Vec::new();
    for ((path, metadata, found), camera) in read.into_iter().zip(camera_of) {
        images.push(ImageRecord {
            path,
            content_hash: String::new(),
            camera,
            width_px: metadata.width_px,
            height_px: metadata.height_px,
            orientation: metadata.orientation,
            gps: metadata.gps,
            flight: metadata.flight,
            captured_s: metadata.captured_s,
        });
        features.push(found);
    }
    (ImageTable { cameras, images, rejected: Vec::new() }, features)
}

fn photograph(path: &Path, cache: Option<&Path>) -> Option<(String, metadata::ImageMetadata, Features)> {
    let bytes = std::fs::read(path).ok()?;
    let metadata = metadata::read(&bytes).ok()?;
    let name = path.file_name()?.to_string_lossy().into_owned();
    let cached = cache.map(|dir| dir.join(format!("{name}.features")));
    if let Some(features) = cached.as_ref().and_then(|path| load(&std::fs::read(path).ok()?)) {
        return Some((name, metadata, features));
    }
    let decoded = image::decode(&bytes, &image::DecodeOptions::default()).ok()?;
    let features = sift::extract(&decoded.luma, decoded.rgb.as_ref(), &sift::SiftOptions::default());
    if let Some(path) = cached {
        std::fs::write(path, save(&features)).expect("writable cache");
    }
    Some((name, metadata, features))
}

fn save(features: &Features) -> Vec<u8> {
    let mut bytes = (features.len() as u64).to_le_bytes().to_vec();
    for keypoint in &features.keypoints {
        for value in [keypoint.x_px, keypoint.y_px, keypoint.scale_px, keypoint.orientation_rad] {
            bytes.extend(value.to_le_bytes());
        }
    }
    bytes.extend(&features.descriptors);
    bytes
}

fn load(bytes: &[u8]) -> Option<Features> {
    let (len, rest) = bytes.split_at_checked(8)?;
    let len = u64::from_le_bytes(len.try_into().ok()?) as usize;
    let (keypoints, descriptors) = rest.split_at_checked(16 * len)?;
    let number = |four: &[u8]| f32::from_le_bytes(four.try_into().unwrap_or_default());
    let keypoint = |k: &[u8]| Keypoint {
        x_px: number(&k[..4]),
        y_px: number(&k[4..8]),
        scale_px: number(&k[8..12]),
        orientation_rad: number(&k[12..]),
    };
    (descriptors.len() == len * DESCRIPTOR_LEN).then(|| Features {
        keypoints: keypoints.chunks_exact(16).map(keypoint).collect(),
        descriptors: descriptors.to_vec(),
        colors: vec![[0; 3]; len],
        ..Features::default()
    })
}

/// Lists of similar images at each step, with what they cost.
fn similar(features: &[Features], flags: &Flags) -> Vec<(String, Vec<Vec<Similar>>)> {
    let seed = Seed(0).derive("pairs");
    let started = cpu_s();
    let per_image = (flags.vocabulary.num_samples as usize).div_ceil(features.len().max(1));
    let sampled: Vec<u8> = features
        .iter()
        .enumerate()
        .flat_map(|(at, features)| sample(features, per_image, seed.item(&[at as u64])))
        .collect();
    let vocabulary = Vocabulary::train(&sampled, &flags.vocabulary, seed.derive("vocabulary"));
    if let Some(path) = &flags.save_words {
        std::fs::write(path, vocabulary.words().as_flattened()).expect("writable words");
    }
    println!("vocabulary of {} words: {:.2} CPU-s", vocabulary.num_words(), cpu_s() - started);
    let started = cpu_s();
    let encoded: Vec<Vec<f32>> = features.par_iter().map(|features| vocabulary.encode(features)).collect();
    println!("encoding: {:.2} CPU-s", cpu_s() - started);
    let started = cpu_s();
    let projection =
        Projection::train(&encoded, flags.retrieval.dimensions as usize, seed.derive("projection"));
    let mut short = CompactDescriptors::new(projection.dimensions());
    for descriptor in &encoded {
        short.push(&projection.project(descriptor));
    }
    println!("projection to {}: {:.2} CPU-s", projection.dimensions(), cpu_s() - started);
    let count = 60.max(flags.retrieval.candidates as usize);
    let global = nearest(&short, |_| true, count, seed.derive("nearest"));
    let sketches: Vec<Sketch> = features
        .par_iter()
        .map(|features| Sketch::new(features, flags.retrieval.local_features as usize))
        .collect();
    let mut lists = vec![("global descriptors".to_owned(), global.clone())];
    for rounds in 0..=flags.retrieval.rounds {
        let options = RetrievalOptions { rounds, ..flags.retrieval.clone() };
        let started = cpu_s();
        let load = |image: usize| Ok::<_, ()>(sketches[image].clone());
        let refined = refine(global.clone(), count, &options, load).expect("sketches are there");
        println!("{rounds} rounds: {:.2} CPU-s", cpu_s() - started);
        lists.push((format!("looked at, {rounds} rounds"), refined));
    }
    lists
}

/// The verified pairs of spatial neighbours, or of all.
fn make_truth(table: &ImageTable, features: &[Features], path: &Path) {
    let has_gps = table.images.iter().any(|image| image.gps.is_some());
    let mode = if has_gps { PairMode::Gps } else { PairMode::Exhaustive };
    let options = PairOptions { mode, footprints: false, ..PairOptions::default() };
    let pairs = select(table, None, &options).pairs;
    let started = cpu_s();
    let inliers = |pair: &terrane_scene::ImagePair| -> Option<usize> {
        let view = |image: terrane_scene::ImageId| View {
            camera: table.camera_of(image),
            keypoints: &features[image.index()].keypoints,
        };
        let (first, second) = (&features[pair.first().index()], &features[pair.second().index()]);
        let matches = matching::match_features(first, second, &matching::MatchOptions::default());
        let candidate = Candidate {
            pair: *pair,
            first: view(pair.first()),
            second: view(pair.second()),
            matches: &matches,
        };
        let seed = Seed(1).item(&[u64::from(pair.first().0), u64::from(pair.second().0)]);
        Some(verify(&candidate, &Default::default(), seed).ok()?.matches.len())
    };
    let found: Vec<Option<usize>> = pairs.par_iter().map(inliers).collect();
    let mut text = String::new();
    for (pair, inliers) in pairs.iter().zip(found) {
        let name = |image: terrane_scene::ImageId| table.image(image).path.as_str();
        if let Some(inliers) = inliers {
            text += &format!("{}\t{}\t{inliers}\n", name(pair.first()), name(pair.second()));
        }
    }
    std::fs::write(path, text).expect("writable truth");
    println!("matched {} pairs in {:.1} CPU-s", pairs.len(), cpu_s() - started);
}

fn read_truth(table: &ImageTable, path: &Path) -> Vec<(usize, usize)> {
    let text = std::fs::read_to_string(path).expect("a readable truth");
    let at = |name: &str| table.images.iter().position(|image| image.path == name);
    let pairs: Vec<(usize, usize)> = text
        .lines()
        .filter_map(|line| {
            let mut parts = line.split(['\t', ' ']);
            Some((at(parts.next()?)?, at(parts.next()?)?))
        })
        .collect();
    println!("{} pairs to find", pairs.len());
    pairs
}

/// Share of the pairs that are among the first `count` of either image.
fn recall(lists: &[Vec<Similar>], truth: &[(usize, usize)], count: usize) -> f64 {
    let mut found = BTreeSet::new();
    for (image, list) in lists.iter().enumerate() {
        for similar in list.iter().take(count) {
            let other = similar.index as usize;
            found.insert((image.min(other), image.max(other)));
        }
    }
    let hits = truth.iter().filter(|&&(a, b)| found.contains(&(a.min(b), a.max(b)))).count();
    hits as f64 / truth.len().max(1) as f64
}

/// CPU seconds of all threads of this process, from the kernel's books (Linux; zero elsewhere).
fn cpu_s() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    let ticks: u64 = [11, 12].iter().filter_map(|&k| fields.get(k)?.parse::<u64>().ok()).sum();
    ticks as f64 / 100.0
}
