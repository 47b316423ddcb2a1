//! Decodes photographs and prints what that costs: `decode [--gray] [--out DIR] FILES`; with `--out` the brightness is
//! written as PGM and the colours as PPM, to compare with other decoders.

use terrane_frontend::image::{DecodeOptions, decode};

fn main() {
    let mut options = DecodeOptions::default();
    let mut out = None;
    let mut files = Vec::new();
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--gray" => options.color = false,
            "--out" => out = arguments.next(),
            _ => files.push(std::path::PathBuf::from(argument)),
        }
    }
    for file in files {
        let bytes = std::fs::read(&file).expect("readable");
        let before = peak_bytes();
        let started = std::time::Instant::now();
        let image = match decode(&bytes, &options) {
            Ok(image) => image,
            Err(error) => {
                println!("{}: {error}", file.display());
                continue;
            }
        };
        let pixels = (image.luma.width * image.luma.height) as f64;
        println!(
            "{}: {} x {}, {:.3} s wall, file {:.2} bytes a pixel, peak beside it {:.2} bytes a pixel",
            file.display(),
            image.luma.width,
            image.luma.height,
            started.elapsed().as_secs_f64(),
            bytes.len() as f64 / pixels,
            peak_bytes().saturating_sub(before) as f64 / pixels,
        );
        let Some(out) = &out else { continue };
        let stem = std::path::Path::new(out).join(file.file_name().unwrap_or_default());
        let write = |extension: &str, magic: &str, (width, height): (usize, usize), data: &[u8]| {
            let mut file = format!("{magic}\n{width} {height}\n255\n").into_bytes();
            file.extend_from_slice(data);
            std::fs::write(stem.with_added_extension(extension), file).expect("writable");
        };
        write("pgm", "P5", (image.luma.width, image.luma.height), &image.luma.data);
        if let Some(rgb) = &image.rgb {
            write("ppm", "P6", (rgb.width, rgb.height), &rgb.data);
        }
    }
}

/// The most memory that this process has held (Linux; 0 elsewhere).
fn peak_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find(|line| line.starts_with("VmHWM:")).unwrap_or_default();
    line.split_whitespace().nth(1).and_then(|kib| kib.parse::<u64>().ok()).unwrap_or(0) * 1024
}
