//! Pairs of a hundred thousand made-up photographs: CPU time, peak memory, and what the search misses.
//! `pairs_100k [--images N] [--no-exact]`.
//!
//! A block is flown in lines over a square, photographs 20 m apart and 80 m above the ground. Global descriptors change
//! smoothly over the ground (random Fourier features, Rahimi & Recht 2007) and have noise on top, so that neighbours
//! are alike and the rest is not.

use rand::RngExt;
use terrane_frontend::pairs::{PairMode, PairOptions, blocks, select};
use terrane_frontend::retrieval::{CompactDescriptors, DotKernel, Projection, nearest};
use terrane_geometry::{Camera, CameraModel, Seed};
use terrane_scene::{
    AttitudeOf, AttitudePrior, CameraId, CameraRecord, FlightPrior, FocalSource, GpsPrior, ImageRecord,
    ImageTable, Orientation,
};

const SPACING_M: f64 = 20.0;
const DIMENSIONS: usize = 128;
const NEIGHBOURS: usize = 30;

fn main() {
    let mut num_images = 100_000;
    let mut exact = true;
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--images" => num_images = arguments.next().and_then(|n| n.parse().ok()).expect("a number"),
            "--no-exact" => exact = false,
            other => panic!("unknown argument {other}"),
        }
    }
    println!("dot products: {}", DotKernel::fastest().name());
    footprints(num_images);
    projection();
    retrieval(num_images, exact);
}

/// Place of an image in its line and its line.
fn place(at: usize, num_images: usize) -> (f64, f64) {
    let side = (num_images as f64).sqrt().ceil() as usize;
    (((at % side) as f64) * SPACING_M, ((at / side) as f64) * SPACING_M)
}

fn footprints(num_images: usize) {
    let table = table(num_images);
    for (name, footprints) in [("footprints", true), ("distances", false)] {
        let options = PairOptions { mode: PairMode::Gps, footprints, ..PairOptions::default() };
        let started = cpu_s();
        let selection = select(&table, None, &options);
        let selected_s = cpu_s() - started;
        let made = blocks(&selection.pairs, &Default::default());
        println!(
            "{name}: {num_images} images, {} pairs ({} by footprints) in {selected_s:.1} CPU-s, {} blocks in {:.1} CPU-s, peak {} MiB",
            selection.pairs.len(),
            selection.report.from_footprints,
            made.len(),
            (cpu_s() - started) - selected_s,
            peak_mib()
        );
    }
}

fn table(num_images: usize) -> ImageTable {
    let mut rng = Seed(1).rng();
    let mut image = |at: usize| {
        let (east_m, north_m) = place(at, num_images);
        let (east_m, north_m) = (east_m + rng.random_range(-3.0..3.0), north_m + rng.random_range(-3.0..3.0));
        let yaw_deg = if (north_m / SPACING_M).round() as i64 % 2 == 0 { 90.0 } else { -90.0 };
        let attitude = AttitudePrior {
            of: AttitudeOf::Gimbal,
            yaw_deg: Some(yaw_deg),
            pitch_deg: if at.is_multiple_of(3) { -60.0 } else { -90.0 },
            roll_deg: 0.0,
        };
        ImageRecord {
            path: format!("{at:06}.jpg"),
            content_hash: String::new(),
            camera: CameraId(0),
            width_px: 4000,
            height_px: 3000,
            orientation: Orientation::default(),
            gps: Some(GpsPrior {
                latitude_deg: 47.0 + north_m / 111_132.0,
                longitude_deg: 8.0 + east_m / 76_000.0,
                altitude_m: Some(500.0),
                sigma_horizontal_m: 5.0,
                sigma_vertical_m: 10.0,
            }),
            flight: Some(FlightPrior { height_above_ground_m: Some(80.0), attitude: Some(attitude) }),
            captured_s: None,
        }
    };
    let images = (0..num_images).map(&mut image).collect();
    let camera = CameraRecord {
        camera: Camera::centered(CameraModel::SimpleRadial, 4000, 3000, 3000.0),
        focal_source: FocalSource::Exif,
        name: "made up".into(),
    };
    ImageTable { cameras: vec![camera], images, rejected: Vec::new() }
}

/// Learning a projection from as many and as long descriptors as a run does.
fn projection() {
    let mut rng = Seed(2).rng();
    let sample: Vec<Vec<f32>> =
        (0..1024).map(|_| (0..8192).map(|_| rng.random_range(-0.02..0.02)).collect()).collect();
    let started = cpu_s();
    let projection = Projection::train(&sample, DIMENSIONS, Seed(3));
    let trained_s = cpu_s() - started;
    let projected: usize = sample.iter().map(|row| projection.project(row).len()).sum();
    println!(
        "projection: {} dimensions learnt in {trained_s:.1} CPU-s; {:.2} ms an image",
        projected / sample.len(),
        ((cpu_s() - started) - trained_s) * 1e3 / sample.len() as f64
    );
}

fn retrieval(num_images: usize, exact: bool) {
    let started = cpu_s();
    let descriptors = descriptors(num_images);
    println!("made {num_images} descriptors in {:.1} CPU-s", (cpu_s() - started));
    let started = cpu_s();
    let found = nearest(&descriptors, |_| true, NEIGHBOURS, Seed(4));
    println!("nearest: {NEIGHBOURS} of each in {:.1} CPU-s, peak {} MiB", (cpu_s() - started), peak_mib());
    if !exact {
        return;
    }
    let (mut hits, mut wanted) = (0, 0);
    for query in (0..num_images).step_by((num_images / 500).max(1)) {
        let truth = exactly(&descriptors, query);
        hits += found[query].iter().filter(|similar| truth.contains(&similar.index)).count();
        wanted += truth.len();
    }
    println!(
        "recall against the exact {NEIGHBOURS}: {:.4} on {} images",
        hits as f64 / wanted as f64,
        wanted / NEIGHBOURS
    );
}

fn exactly(descriptors: &CompactDescriptors, query: usize) -> Vec<u32> {
    let length =
        |at: usize| descriptors.get(at).iter().map(|&v| f64::from(v) * f64::from(v)).sum::<f64>().sqrt();
    let mut dots = Vec::new();
    let kernel = DotKernel::fastest();
    let mut scored: Vec<(f64, u32)> = Vec::new();
    for other in (0..descriptors.len()).filter(|&other| other != query) {
        dots.clear();
        kernel.dots(descriptors.get(query), descriptors.get(other), &mut dots);
        scored.push((f64::from(dots[0]) / length(other), other as u32));
    }
    scored.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    scored.iter().take(NEIGHBOURS).map(|entry| entry.1).collect()
}

fn descriptors(num_images: usize) -> CompactDescriptors {
    let mut rng = Seed(5).rng();
    let mut gauss = || (0..12).map(|_| rng.random_range(0.0..1.0)).sum::<f64>() - 6.0;
    // Alike over some 60 m.
    let waves: Vec<[f64; 3]> =
        (0..DIMENSIONS).map(|_| [gauss() / 60.0, gauss() / 60.0, gauss() * 10.0]).collect();
    let mut descriptors = CompactDescriptors::new(DIMENSIONS);
    for at in 0..num_images {
        let (x, y) = place(at, num_images);
        let numbers: Vec<f32> =
            waves.iter().map(|w| ((w[0] * x + w[1] * y + w[2]).cos() + 0.5 * gauss()) as f32).collect();
        descriptors.push(&numbers);
    }
    descriptors
}

/// CPU seconds of all threads of this process, from the kernel's books (Linux; zero elsewhere).
fn cpu_s() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    let ticks: u64 = [11, 12].iter().filter_map(|&k| fields.get(k)?.parse::<u64>().ok()).sum();
    ticks as f64 / 100.0
}

fn peak_mib() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find(|line| line.starts_with("VmHWM:")).unwrap_or_default();
    line.split_whitespace().nth(1).and_then(|kib| kib.parse::<u64>().ok()).unwrap_or(0) / 1024
}
