//! Compares kinds of features on a folder of photographs, every pair matched and verified:
//! `compare_features FOLDER [--methods orb,surf] [--OPTION VALUE]…`.
//!
//! For measuring while the front end is worked on; the benches hold the figures that are claimed.

use std::time::Duration;

use terrane_frontend::features::{FeatureMethod, FeatureOptions, extract};
use terrane_frontend::matching::{MatchOptions, match_features};
use terrane_frontend::verification::{Candidate, View, verify};
use terrane_frontend::{cameras, image, metadata};
use terrane_geometry::Seed;
use terrane_scene::{CameraId, CameraRecord, Features, ImageId, ImagePair};

struct Settings {
    folder: String,
    methods: Vec<FeatureMethod>,
    options: FeatureOptions,
    matching: MatchOptions,
}

fn settings() -> Settings {
    let mut arguments = std::env::args().skip(1);
    let folder = arguments.next().expect("usage: compare_features FOLDER [--methods NAMES] [--OPTION VALUE]");
    let mut made = Settings {
        folder,
        methods: FeatureMethod::ALL.to_vec(),
        options: FeatureOptions::default(),
        matching: MatchOptions::default(),
    };
    while let Some(name) = arguments.next() {
        let value = arguments.next().expect("every option has a value");
        let number = || value.parse::<f64>().expect("a number");
        let (corners, surf) = (&mut made.options.corners, &mut made.options.surf);
        match name.as_str() {
            "--methods" => {
                made.methods = value.split(',').map(|name| name.parse().expect("a method")).collect();
            }
            "--max" => {
                let max = number() as u32;
                (corners.max_features, surf.max_features) = (max, max);
                made.options.sift.max_features = max;
            }
            "--levels" => corners.num_levels = number() as u32,
            "--scale" => corners.level_scale = number(),
            "--fast" => corners.fast_threshold = number() as u8,
            "--harris" => corners.harris_threshold = number(),
            "--separation" => corners.separation_px = number(),
            "--orientations" => corners.max_orientations = number() as u32,
            "--hessian" => surf.hessian_threshold = number(),
            "--octaves" => surf.num_octaves = number() as u32,
            "--ratio" => (made.matching.max_ratio, made.matching.binary.max_ratio) = (number(), number()),
            "--distance" => made.matching.binary.max_distance = number() as u32,
            other => panic!("no option {other}"),
        }
    }
    made
}

/// Decoded photographs with the cameras that took them.
struct Photographs {
    decoded: Vec<image::DecodedImage>,
    cameras: Vec<CameraRecord>,
    camera_of: Vec<CameraId>,
}

fn read_all(folder: &str) -> Photographs {
    let mut files: Vec<_> =
        std::fs::read_dir(folder).expect("a folder").flatten().map(|entry| entry.path()).collect();
    files.sort();
    let (mut named, mut decoded) = (Vec::new(), Vec::new());
    for file in files.iter().filter(|file| file.is_file()) {
        let bytes = std::fs::read(file).expect("readable");
        let Ok(pixels) = image::decode(&bytes, &image::DecodeOptions::default()) else { continue };
        decoded.push(pixels);
        let name = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
        named.push((name, metadata::read(&bytes).expect("an image")));
    }
    let (cameras, camera_of) = cameras::group(&named, None);
    Photographs { decoded, cameras, camera_of }
}

fn main() {
    let settings = settings();
    let photographs = read_all(&settings.folder);
    println!(
        "method: features an image, CPU-s an image; matches a pair, CPU-s a pair; verified pairs, inliers in all"
    );
    for method in &settings.methods {
        let options = FeatureOptions { method: *method, ..settings.options.clone() };
        let start = cpu_time();
        let features: Vec<Features> = photographs
            .decoded
            .iter()
            .map(|pixels| extract(&pixels.luma, pixels.rgb.as_ref(), &options))
            .collect();
        let extracted = cpu_time();
        compare(&settings, &photographs, &features, (*method, extracted - start));
    }
}

fn compare(
    settings: &Settings,
    photographs: &Photographs,
    features: &[Features],
    (method, extraction): (FeatureMethod, Duration),
) {
    let count = features.len();
    let view = |at: usize| View {
        camera: &photographs.cameras[photographs.camera_of[at].index()],
        keypoints: &features[at].keypoints,
    };
    let (mut matching, mut num_matches, mut inliers) = (Duration::ZERO, 0, Vec::new());
    let pairs: Vec<(usize, usize)> = (0..count).flat_map(|a| (a + 1..count).map(move |b| (a, b))).collect();
    for &(a, b) in &pairs {
        let start = cpu_time();
        let matches = match_features(&features[a], &features[b], &settings.matching);
        matching += cpu_time() - start;
        num_matches += matches.len();
        let pair = ImagePair::new(ImageId::from_index(a), ImageId::from_index(b)).expect("two images");
        let candidate = Candidate { pair, first: view(a), second: view(b), matches: &matches };
        if let Ok(verified) = verify(&candidate, &Default::default(), Seed(1)) {
            inliers.push(verified.matches.len());
        }
    }
    let total: usize = features.iter().map(Features::len).sum();
    println!(
        "{method}: {:.0}, {:.3}; {:.0}, {:.4}; {} of {}, {}",
        total as f64 / count as f64,
        extraction.as_secs_f64() / count as f64,
        num_matches as f64 / pairs.len() as f64,
        matching.as_secs_f64() / pairs.len() as f64,
        inliers.len(),
        pairs.len(),
        inliers.iter().sum::<usize>(),
    );
}

/// CPU time of all threads of this process, from the kernel's books (Linux; zero elsewhere).
fn cpu_time() -> Duration {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    let ticks: u64 = [11, 12].iter().filter_map(|&k| fields.get(k)?.parse::<u64>().ok()).sum();
    Duration::from_millis(ticks * 10)
}
