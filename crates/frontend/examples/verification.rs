//! Verifies the pairs of a folder of photographs and prints what that costs and finds:
//! `verification [--camera MODEL:params] [--max-pairs N] [--cache DIR] [--export DIR] [--repeats N] [--pairs]
//! [--guided off|after|first] FOLDER`.
//!
//! With `--guided` each pair is matched and verified in one step, which is what is then timed.
//! All pairs are matched, or the ten nearest by position where there are more than forty photographs. `--cache` keeps
//! features and matches from one call to the next; `--export` writes cameras, keypoints, matches and inliers as text, for
//! `benches/peers/colmap_verification.py`. For measuring while the front end is worked on; the benches hold the figures
//! that are claimed.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::time::Instant;

use rayon::prelude::*;
use terrane_frontend::cameras::{self, GivenCamera};
use terrane_frontend::matching::{Match, MatchOptions, match_features};
use terrane_frontend::metadata::{self, ImageMetadata};
use terrane_frontend::verification::{
    Candidate, GuidedMatching, Photograph as Side, VerificationOptions, View, match_and_verify, verify,
};
use terrane_frontend::{image, sift};
use terrane_geometry::Seed;
use terrane_scene::{
    CameraRecord, DESCRIPTOR_LEN, Features, FocalSource, ImageId, ImagePair, Keypoint, MatchedPair, PairKind,
};

struct Arguments {
    folder: PathBuf,
    camera: Option<GivenCamera>,
    max_pairs: usize,
    cache: Option<PathBuf>,
    export: Option<PathBuf>,
    repeats: u32,
    lists_pairs: bool,
    guided: Option<GuidedMatching>,
}

struct Photograph {
    name: String,
    camera: CameraRecord,
    features: Features,
}

/// What came of a pair.
struct Verified {
    pair: ImagePair,
    matches: Vec<Match>,
    found: Option<MatchedPair>,
    /// The least of the repeats.
    milliseconds: f64,
}

fn main() {
    let arguments = arguments();
    let (photographs, metadata) = photographs(&arguments);
    let pairs = thinned(pairs(&metadata), arguments.max_pairs);
    let guided = arguments.guided.unwrap_or_default();
    let options = VerificationOptions { guided, ..VerificationOptions::default() };
    let verified: Vec<Verified> = if arguments.guided.is_some() {
        pairs
            .iter()
            .map(|&pair| matched_and_verified(&photographs, pair, &options, arguments.repeats))
            .collect()
    } else {
        let matched: Vec<(ImagePair, Vec<Match>)> =
            pairs.par_iter().map(|&pair| (pair, matches(&arguments, &photographs, pair))).collect();
        matched
            .into_iter()
            .map(|(pair, matches)| verified(&photographs, pair, matches, &options, arguments.repeats))
            .collect()
    };
    if arguments.lists_pairs {
        verified.iter().for_each(|of| println!("{}", line_of(&photographs, of)));
    }
    summarise(&verified, options.min_inliers);
    if let Some(folder) = &arguments.export {
        export(folder, &photographs, &verified);
    }
}

fn arguments() -> Arguments {
    let mut found = Arguments {
        folder: PathBuf::new(),
        camera: None,
        max_pairs: usize::MAX,
        cache: None,
        export: None,
        repeats: 3,
        lists_pairs: false,
        guided: None,
    };
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        let mut value = || arguments.next().unwrap_or_else(|| panic!("{argument} needs a value"));
        match argument.as_str() {
            "--camera" => found.camera = Some(value().parse().expect("a camera")),
            "--max-pairs" => found.max_pairs = value().parse().expect("a number"),
            "--cache" => found.cache = Some(value().into()),
            "--export" => found.export = Some(value().into()),
            "--repeats" => found.repeats = value().parse().expect("a number"),
            "--pairs" => found.lists_pairs = true,
            "--guided" => {
                found.guided = Some(match value().as_str() {
                    "after" => GuidedMatching::After,
                    "first" => GuidedMatching::First,
                    _ => GuidedMatching::Off,
                })
            }
            _ => found.folder = argument.into(),
        }
    }
    for folder in [&found.cache, &found.export].into_iter().flatten() {
        std::fs::create_dir_all(folder).expect("a folder that can be written");
    }
    found
}

fn photographs(arguments: &Arguments) -> (Vec<Photograph>, Vec<ImageMetadata>) {
    let mut files: Vec<PathBuf> = std::fs::read_dir(&arguments.folder)
        .expect("a folder")
        .map(|entry| entry.expect("an entry").path())
        .filter(|path| {
            let ending = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
            ["jpg", "jpeg", "png", "tif", "tiff"].contains(&ending.as_str())
        })
        .collect();
    files.sort();
    let name = |path: &Path| path.file_name().expect("a file").to_string_lossy().into_owned();
    let images: Vec<(String, ImageMetadata)> = files
        .iter()
        .map(|path| (name(path), metadata::read(&std::fs::read(path).expect("readable")).expect("an image")))
        .collect();
    let (records, camera_of_image) = cameras::group(&images, arguments.camera.as_ref());
    let photographs = files
        .par_iter()
        .zip(&camera_of_image)
        .map(|(path, camera)| Photograph {
            name: name(path),
            camera: records[camera.0 as usize].clone(),
            features: features(arguments, path, &name(path)),
        })
        .collect();
    (photographs, images.into_iter().map(|(_, metadata)| metadata).collect())
}

fn features(arguments: &Arguments, path: &Path, name: &str) -> Features {
    let cached = arguments.cache.as_ref().map(|folder| folder.join(format!("{name}.features")));
    if let Some(bytes) = cached.as_ref().and_then(|file| std::fs::read(file).ok()) {
        let count = bytes.len() / (size_of::<Keypoint>() + DESCRIPTOR_LEN);
        let (keypoints, descriptors) = bytes.split_at(count * size_of::<Keypoint>());
        let keypoints = bytemuck::pod_collect_to_vec(keypoints);
        let (descriptors, colors) = (descriptors.to_vec(), vec![[0; 3]; count]);
        return Features { keypoints, descriptors, colors, ..Features::default() };
    }
    let bytes = std::fs::read(path).expect("readable");
    let decoded = image::decode(&bytes, &image::DecodeOptions::default()).expect("an image");
    let features = sift::extract(&decoded.luma, None, &sift::SiftOptions::default());
    if let Some(file) = cached {
        let bytes = [bytemuck::cast_slice(&features.keypoints), features.descriptors.as_slice()].concat();
        std::fs::write(file, bytes).expect("writable");
    }
    features
}

/// All pairs, or those of each photograph and its ten nearest.
fn pairs(metadata: &[ImageMetadata]) -> Vec<ImagePair> {
    const ALL: usize = 40;
    const NEAREST: usize = 10;
    let place = |image: &ImageMetadata| {
        let gps = image.gps.as_ref()?;
        Some([gps.latitude_deg, gps.longitude_deg * gps.latitude_deg.to_radians().cos()])
    };
    let pair = |a: usize, b: usize| ImagePair::new(ImageId::from_index(a), ImageId::from_index(b));
    let mut chosen = BTreeSet::new();
    for (a, image) in metadata.iter().enumerate() {
        let mut others: Vec<(f64, usize)> = (0..metadata.len())
            .filter(|&b| b != a)
            .map(|b| match (place(image), place(&metadata[b])) {
                (Some(p), Some(q)) => ((p[0] - q[0]).hypot(p[1] - q[1]), b),
                _ => (a.abs_diff(b) as f64, b),
            })
            .collect();
        others.sort_by(|p, q| p.0.total_cmp(&q.0).then(p.1.cmp(&q.1)));
        let taken = if metadata.len() <= ALL { others.len() } else { NEAREST };
        chosen.extend(others[..taken.min(others.len())].iter().filter_map(|(_, b)| pair(a, *b)));
    }
    chosen.into_iter().collect()
}

fn thinned(pairs: Vec<ImagePair>, at_most: usize) -> Vec<ImagePair> {
    let taken = pairs.len().min(at_most);
    (0..taken).map(|k| pairs[k * pairs.len() / taken]).collect()
}

fn matches(arguments: &Arguments, photographs: &[Photograph], pair: ImagePair) -> Vec<Match> {
    let file = arguments
        .cache
        .as_ref()
        .map(|folder| folder.join(format!("{}-{}.matches", pair.first().0, pair.second().0)));
    if let Some(bytes) = file.as_ref().and_then(|file| std::fs::read(file).ok()) {
        let words: Vec<u32> = bytemuck::pod_collect_to_vec(&bytes);
        let to_match = |w: &[u32]| Match { first: w[0], second: w[1], ratio: f32::from_bits(w[2]) };
        return words.chunks_exact(3).map(to_match).collect();
    }
    let [first, second] = [pair.first(), pair.second()].map(|image| &photographs[image.index()].features);
    let matches = match_features(first, second, &MatchOptions::default());
    if let Some(file) = file {
        let words: Vec<u32> =
            matches.iter().flat_map(|found| [found.first, found.second, found.ratio.to_bits()]).collect();
        std::fs::write(file, bytemuck::cast_slice::<u32, u8>(&words)).expect("writable");
    }
    matches
}

fn verified(
    photographs: &[Photograph],
    pair: ImagePair,
    matches: Vec<Match>,
    options: &VerificationOptions,
    repeats: u32,
) -> Verified {
    let view = |image: ImageId| {
        let photograph = &photographs[image.index()];
        View { camera: &photograph.camera, keypoints: &photograph.features.keypoints }
    };
    let candidate =
        Candidate { pair, first: view(pair.first()), second: view(pair.second()), matches: &matches };
    let mut milliseconds = f64::INFINITY;
    let mut found = None;
    for _ in 0..repeats.max(1) {
        let start = Instant::now();
        found = verify(&candidate, options, Seed(1)).ok();
        milliseconds = milliseconds.min(start.elapsed().as_secs_f64() * 1e3);
    }
    Verified { pair, found, milliseconds, matches }
}

/// Both steps as one; the matches are the inliers.
fn matched_and_verified(
    photographs: &[Photograph],
    pair: ImagePair,
    options: &VerificationOptions,
    repeats: u32,
) -> Verified {
    let side = |image: ImageId| {
        let photograph = &photographs[image.index()];
        Side { camera: &photograph.camera, features: &photograph.features }
    };
    let (first, second) = (side(pair.first()), side(pair.second()));
    let mut milliseconds = f64::INFINITY;
    let mut found = None;
    for _ in 0..repeats.max(1) {
        let start = Instant::now();
        let matching = MatchOptions::default();
        let match_all = || match_features(first.features, second.features, &matching);
        found = match_and_verify(pair, [&first, &second], match_all, &matching, options, Seed(1)).ok();
        milliseconds = milliseconds.min(start.elapsed().as_secs_f64() * 1e3);
    }
    let inliers = found.iter().flat_map(|found| &found.matches);
    let matches = inliers.map(|&[first, second]| Match { first, second, ratio: 0.0 }).collect();
    Verified { pair, found, milliseconds, matches }
}

fn kind_name(found: Option<&MatchedPair>) -> &'static str {
    match found.map(|pair| pair.summary.kind) {
        None => "refused",
        Some(PairKind::Calibrated) => "calibrated",
        Some(PairKind::Uncalibrated) => "uncalibrated",
        Some(PairKind::Planar) => "planar",
        Some(PairKind::Panoramic) => "panoramic",
        Some(PairKind::Watermark) => "watermark",
    }
}

/// Names, matches, inliers, kind, time.
fn line_of(photographs: &[Photograph], of: &Verified) -> String {
    let name = |image: ImageId| photographs[image.index()].name.as_str();
    format!(
        "{} {} {} {} {} {:.3}",
        name(of.pair.first()),
        name(of.pair.second()),
        of.matches.len(),
        of.found.as_ref().map_or(0, |found| found.matches.len()),
        kind_name(of.found.as_ref()),
        of.milliseconds,
    )
}

fn summarise(verified: &[Verified], min_inliers: u32) {
    let mut kinds = BTreeMap::new();
    for of in verified {
        *kinds.entry(kind_name(of.found.as_ref())).or_insert(0) += 1;
    }
    println!("pairs {} kinds {kinds:?}", verified.len());
    let real = |of: &&Verified| of.found.is_some();
    let tried = |of: &&Verified| of.found.is_none() && of.matches.len() >= min_inliers as usize;
    let times = |chosen: &dyn Fn(&&Verified) -> bool| {
        quantiles(verified.iter().filter(|of| chosen(of)).map(|of| of.milliseconds).collect())
    };
    println!("verification of verified pairs, ms: {}", times(&real));
    println!("verification of refused pairs, ms: {}", times(&tried));
    let counts =
        |count: &dyn Fn(&Verified) -> f64| quantiles(verified.iter().filter(real).map(count).collect());
    println!("matches of verified pairs: {}", counts(&|of| of.matches.len() as f64));
    println!(
        "inliers of verified pairs: {}",
        counts(&|of| of.found.as_ref().map_or(0.0, |f| f.matches.len() as f64))
    );
    let total: usize = verified.iter().filter_map(|of| of.found.as_ref()).map(|f| f.matches.len()).sum();
    let total_ms: f64 = verified.iter().map(|of| of.milliseconds).sum();
    println!("inliers in all {total}, time in all {total_ms:.1} ms");
}

fn quantiles(mut values: Vec<f64>) -> String {
    if values.is_empty() {
        return "none".to_owned();
    }
    values.sort_by(f64::total_cmp);
    let at = |share: f64| values[((values.len() - 1) as f64 * share).round() as usize];
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    format!(
        "least {:.2}, quarter {:.2}, median {:.2}, three quarters {:.2}, 95 % {:.2}, most {:.2}, mean {mean:.2}",
        at(0.0),
        at(0.25),
        at(0.5),
        at(0.75),
        at(0.95),
        at(1.0)
    )
}

/// `cameras.txt` (name, model, width, height, trusted, parameters), `NAME.keypoints` (x y), `pairs.txt` (as [`line_of`]),
/// `matches.txt` (names, then indices and whether each is an inlier, then a blank line).
fn export(folder: &Path, photographs: &[Photograph], verified: &[Verified]) {
    let write = |name: &str, text: String| std::fs::write(folder.join(name), text).expect("writable");
    let mut cameras = String::new();
    for photograph in photographs {
        let record = &photograph.camera;
        let camera = &record.camera;
        let params: Vec<String> = camera.params().iter().map(f64::to_string).collect();
        let trusted = u8::from(record.focal_source != FocalSource::Guess);
        let (model, size) = (camera.model.name(), format!("{} {}", camera.width_px, camera.height_px));
        let _ = writeln!(cameras, "{} {model} {size} {trusted} {}", photograph.name, params.join(" "));
        let lines = photograph.features.keypoints.iter().map(|k| format!("{} {}\n", k.x_px, k.y_px));
        write(&format!("{}.keypoints", photograph.name), lines.collect());
    }
    write("cameras.txt", cameras);
    let mut matches = String::new();
    for of in verified {
        let inliers: BTreeSet<[u32; 2]> =
            of.found.iter().flat_map(|found| found.matches.iter().copied()).collect();
        let name = |image: ImageId| photographs[image.index()].name.as_str();
        let _ = writeln!(matches, "{} {}", name(of.pair.first()), name(of.pair.second()));
        for found in &of.matches {
            let inside = u8::from(inliers.contains(&[found.first, found.second]));
            let _ = writeln!(matches, "{} {} {inside}", found.first, found.second);
        }
        matches.push('\n');
    }
    write("matches.txt", matches);
    write("pairs.txt", verified.iter().map(|of| line_of(photographs, of) + "\n").collect());
}
