//! Peak memory of the features stage, in a process of its own: two photographs of twelve megapixels at once, and one of two
//! hundred.

use std::process::Command;

use rayon::prelude::*;
use terrane_benches::table::{Bar, Row};
use terrane_benches::usage::peak_bytes;
use terrane_benches::{Request, process};
use terrane_frontend::image::{self, DecodeOptions};
use terrane_frontend::sift::{self, FirstOctave, SiftOptions};

use crate::sets::Set;

/// Marks the process that is measured.
const CHILD: &str = "TERRANE_BENCH_MEMORY";
/// Megapixels of the photographs that it looks at.
const CHILD_SIZE: &str = "TERRANE_BENCH_MEGAPIXELS";

/// Width and height in pixels.
const TWELVE_MEGAPIXELS: (usize, usize) = (4243, 2828);
/// Width and height in pixels.
const TWO_HUNDRED_MEGAPIXELS: (usize, usize) = (17_320, 11_547);

pub fn rows(request: &Request) -> anyhow::Result<Vec<Row>> {
    let mut rows = Vec::new();
    for octave in ["0", "-1"] {
        let figure = format!("features, two of 12 MP on 2 threads, first octave {octave}: peak");
        let peak = peak_mib(octave, TWELVE_MEGAPIXELS)?;
        rows.push(Row::new(figure, peak, "MiB", Bar::AtMost(1024.0)).note("goal 400 MiB"));
    }
    for octave in ["0", "-1"].iter().filter(|_| !request.quick) {
        let figure = format!("features, one of 200 MP on 2 threads, first octave {octave}: peak");
        rows.push(Row::new(figure, peak_mib(octave, TWO_HUNDRED_MEGAPIXELS)?, "MiB", Bar::None));
    }
    Ok(rows)
}

/// What the features stage takes at most, measured by a process of its own.
fn peak_mib(octave: &str, size: (usize, usize)) -> anyhow::Result<Option<f64>> {
    let mut command = Command::new(std::env::current_exe()?);
    command.env(CHILD, octave).env(CHILD_SIZE, if size == TWELVE_MEGAPIXELS { "12" } else { "200" });
    let (_, text) = process::run(&mut command)?;
    Ok(text.trim().parse::<f64>().ok().map(|bytes| bytes / f64::from(1 << 20)))
}

/// Extracts and prints the peak when this process is the one to be measured.
pub fn as_child() -> Option<anyhow::Result<()>> {
    let octave = std::env::var(CHILD).ok()?;
    let first_octave = if octave == "-1" { FirstOctave::Doubled } else { FirstOctave::Original };
    let is_large = std::env::var(CHILD_SIZE).is_ok_and(|size| size == "200");
    let (count, size) = if is_large { (1, TWO_HUNDRED_MEGAPIXELS) } else { (2, TWELVE_MEGAPIXELS) };
    Some(extract(first_octave, count, size))
}

fn extract(first_octave: FirstOctave, count: usize, size: (usize, usize)) -> anyhow::Result<()> {
    let photographs = Set::named("fountain-P11").photographs(count)?;
    let files: Vec<Vec<u8>> = photographs
        .iter()
        .map(|photograph| enlarged(&photograph.bytes, size))
        .collect::<anyhow::Result<_>>()?;
    reset_peak()?;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build()?;
    let options = SiftOptions { first_octave, ..SiftOptions::default() };
    let found: Vec<anyhow::Result<usize>> = pool.install(|| {
        files
            .par_iter()
            .map(|bytes| {
                let decoded = image::decode(bytes, &DecodeOptions::default())?;
                Ok(sift::extract(&decoded.luma, decoded.rgb.as_ref(), &options).len())
            })
            .collect()
    });
    for features in found {
        anyhow::ensure!(features? > 1000, "hardly a feature was found");
    }
    println!("{}", peak_bytes()?);
    Ok(())
}

/// Forgets the peak so far: enlarging the photographs is no part of what is measured.
fn reset_peak() -> anyhow::Result<()> {
    Ok(std::fs::write("/proc/self/clear_refs", "5")?)
}

/// A JPEG of this size that shows what a photograph does.
fn enlarged(bytes: &[u8], (width, height): (usize, usize)) -> anyhow::Result<Vec<u8>> {
    let rgb =
        image::decode(bytes, &DecodeOptions::default())?.rgb.ok_or_else(|| anyhow::anyhow!("no colours"))?;
    let mut data = Vec::with_capacity(3 * width * height);
    for y in 0..height {
        for x in 0..width {
            let at = (y * rgb.height / height * rgb.width + x * rgb.width / width) * 3;
            data.extend_from_slice(&rgb.data[at..at + 3]);
        }
    }
    let mut file = Vec::new();
    let encoder = jpeg_encoder::Encoder::new(&mut file, 92);
    encoder.encode(&data, width as u16, height as u16, jpeg_encoder::ColorType::Rgb)?;
    Ok(file)
}
