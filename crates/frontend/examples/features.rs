//! Extracts the features of photographs and prints what that costs: `features [--first-octave -1|0] [--out DIR] FILES`.
//!
//! For measuring while the front end is worked on; the benches hold the figures that are claimed.

use std::time::{Duration, Instant};

use terrane_frontend::sift::{FirstOctave, SiftOptions, extract};
use terrane_frontend::{cameras, image, metadata};

fn main() {
    let mut options = SiftOptions::default();
    let mut files = Vec::new();
    let mut arguments = std::env::args().skip(1);
    let value = |name: &str, arguments: &mut dyn Iterator<Item = String>| -> String {
        arguments.next().unwrap_or_else(|| panic!("{name} needs a value"))
    };
    let mut out_dir = None;
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--first-octave" => {
                options.first_octave = match value("--first-octave", &mut arguments).as_str() {
                    "-1" => FirstOctave::Doubled,
                    _ => FirstOctave::Original,
                }
            }
            "--spread" => options.spread = value("--spread", &mut arguments).parse().expect("a number"),
            "--octaves" => {
                options.num_octaves = value("--octaves", &mut arguments).parse().expect("a number")
            }
            "--max" => options.max_features = value("--max", &mut arguments).parse().expect("a number"),
            "--out" => out_dir = Some(value("--out", &mut arguments)),
            _ => files.push(argument),
        }
    }
    for file in files {
        let bytes = std::fs::read(&file).expect("readable");
        let metadata = metadata::read(&bytes).expect("an image");
        let focal = cameras::estimate_focal(&metadata);
        let start = cpu_time();
        let started = Instant::now();
        let decoded = image::decode(&bytes, &image::DecodeOptions::default()).expect("an image");
        let decoded_at = cpu_time();
        let features = extract(&decoded.luma, decoded.rgb.as_ref(), &options);
        let done = cpu_time();
        println!(
            "{file}: {} x {}, decode {:.3} s, sift {:.3} s (CPU), wall {:.3} s, {} features, focal {:.1} px by {:?}, peak {} MiB",
            decoded.luma.width,
            decoded.luma.height,
            (decoded_at - start).as_secs_f64(),
            (done - decoded_at).as_secs_f64(),
            started.elapsed().as_secs_f64(),
            features.len(),
            focal.focal_px,
            focal.evidence,
            peak_mib(),
        );
        if let Some(dir) = &out_dir {
            let name =
                std::path::Path::new(&file).file_name().expect("a file").to_string_lossy().into_owned();
            let mut bytes = (features.len() as u64).to_le_bytes().to_vec();
            for keypoint in &features.keypoints {
                for v in [keypoint.x_px, keypoint.y_px, keypoint.scale_px, keypoint.orientation_rad] {
                    bytes.extend(v.to_le_bytes());
                }
            }
            bytes.extend(&features.descriptors);
            std::fs::write(format!("{dir}/{name}.sift"), bytes).expect("writable");
        }
    }
}

/// CPU time of all threads of this process, from the kernel's books (Linux; zero elsewhere).
fn cpu_time() -> Duration {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    let ticks: u64 = [11, 12].iter().filter_map(|&k| fields.get(k)?.parse::<u64>().ok()).sum();
    Duration::from_millis(ticks * 10)
}

fn peak_mib() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find(|line| line.starts_with("VmHWM:")).unwrap_or_default();
    line.split_whitespace().nth(1).and_then(|kib| kib.parse::<u64>().ok()).unwrap_or(0) / 1024
}
