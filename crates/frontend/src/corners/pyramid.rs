//! A pyramid of ever smaller copies of a photograph, and blurred ones of its levels.
//!
//! Every level is made from the one before, by a tent filter as wide as the step of the scale, in integers.

use std::borrow::Cow;

use crate::image::GrayImage;
use crate::sift::shared::BlurredImage;
use crate::simd::{Path, compiled_twice};

/// One size of the photograph.
pub(super) struct Level<'a> {
    /// Its pixels.
    pub image: Cow<'a, GrayImage>,
    /// Pixels of the photograph in one of the level, along columns and rows.
    pub step: (f32, f32),
}

/// Makes the level that is `scale` times smaller than the first one, from one that is at most twice as large.
pub(super) fn shrink(path: Path, from: &GrayImage, first: &GrayImage, scale: f64) -> Option<Level<'static>> {
    let size = |side: usize| (side as f64 / scale).round() as usize;
    let (width, height) = (size(first.width), size(first.height));
    if width == 0 || height == 0 {
        return None;
    }
    let image = resample(path, from, width, height);
    let step = (first.width as f32 / width as f32, first.height as f32 / height as f32);
    Some(Level { image: Cow::Owned(image), step })
}

/// The pixels that one pixel of the result is made of: weights in units of 2⁻¹⁴ from a first one on.
struct Taps {
    start: Vec<usize>,
    weights: Vec<[u32; MAX_TAPS]>,
}

/// A tent of at most two source pixels to each side.
const MAX_TAPS: usize = 4;
const ONE: u32 = 1 << 14;

impl Taps {
    /// Taps of a side of `from` pixels that becomes `to`, which is not less than half of it.
    fn new(from: usize, to: usize) -> Self {
        let ratio = from as f64 / to as f64;
        let reach = ratio.clamp(1.0, 2.0);
        let mut taps = Self { start: Vec::with_capacity(to), weights: Vec::with_capacity(to) };
        for at in 0..to {
            let center = (at as f64 + 0.5) * ratio - 0.5;
            let first = (center - reach).floor() as isize + 1;
            // All taps lie inside: those that would not get no weight.
            let start = first.clamp(0, from.saturating_sub(MAX_TAPS) as isize);
            let mut weights = [0.0; MAX_TAPS];
            for (k, weight) in weights.iter_mut().enumerate().take(from) {
                *weight = (1.0 - ((start + k as isize) as f64 - center).abs() / reach).max(0.0);
            }
            taps.start.push(start as usize);
            taps.weights.push(in_units(weights));
        }
        taps
    }
}

/// Weights that add up to [`ONE`] exactly: the greatest takes what rounding leaves.
fn in_units(weights: [f64; MAX_TAPS]) -> [u32; MAX_TAPS] {
    let sum: f64 = weights.iter().sum();
    let mut units = weights.map(|weight| (weight / sum * f64::from(ONE)).round() as u32);
    let greatest = (0..MAX_TAPS).max_by_key(|&k| units[k]).unwrap_or(0);
    let others: u32 = (0..MAX_TAPS).filter(|&k| k != greatest).map(|k| units[k]).sum();
    units[greatest] = ONE.saturating_sub(others);
    units
}

fn resample(path: Path, from: &GrayImage, width: usize, height: usize) -> GrayImage {
    let (across, down) = (Taps::new(from.width, width), Taps::new(from.height, height));
    let mut data = vec![0; width * height];
    // Rows that have been narrowed, by their number modulo the taps, and which row each holds.
    let mut narrow = vec![vec![0_u16; width]; MAX_TAPS];
    let mut held = [usize::MAX; MAX_TAPS];
    let mut padded = vec![0_u8; from.width + MAX_TAPS];
    for (y, out) in data.chunks_exact_mut(width).enumerate() {
        let rows = down.start[y]..(down.start[y] + MAX_TAPS).min(from.height);
        for row in rows.clone() {
            let slot = row % MAX_TAPS;
            if held[slot] != row {
                padded[..from.width].copy_from_slice(&from.data[row * from.width..(row + 1) * from.width]);
                narrow_row(&padded, &across, &mut narrow[slot]);
                held[slot] = row;
            }
        }
        let row = |k: usize| narrow[(rows.start + k).min(from.height - 1) % MAX_TAPS].as_slice();
        combine(path, [row(0), row(1), row(2), row(3)], down.weights[y], out);
    }
    GrayImage { width, height, data }
}

/// Values with seven fractional bits.
fn narrow_row(padded: &[u8], taps: &Taps, out: &mut [u16]) {
    for ((out, &start), weights) in out.iter_mut().zip(&taps.start).zip(&taps.weights) {
        let Some(pixels) = padded[start..].first_chunk::<MAX_TAPS>() else { continue };
        let sum: u32 = (0..MAX_TAPS).map(|k| u32::from(pixels[k]) * weights[k]).sum();
        *out = ((sum + (1 << 6)) >> 7) as u16;
    }
}

compiled_twice!(combine = combine_body(rows: [&[u16]; MAX_TAPS], weights: [u32; MAX_TAPS], out: &mut [u8]));

#[inline(always)]
fn combine_body(rows: [&[u16]; MAX_TAPS], weights: [u32; MAX_TAPS], out: &mut [u8]) {
    let rows = rows.map(|row| &row[..out.len()]);
    for x in 0..out.len() {
        let mut sum = 1 << 20;
        for k in 0..MAX_TAPS {
            sum += u32::from(rows[k][x]) * weights[k];
        }
        out[x] = (sum >> 21) as u8;
    }
}

/// A Gaussian of two pixels, cut off after three, in units of 2⁻⁸.
const BLUR: [u32; 7] = [18, 34, 49, 54, 49, 34, 18];
const RADIUS: usize = BLUR.len() / 2;
/// The standard deviation in pixels of what [`blur`] does together with the level's own blur.
pub(super) const BLUR_SIGMA_PX: f32 = 2.0;

/// A level blurred by a Gaussian of two pixels; its border is repeated outwards.
pub(super) fn blur(path: Path, image: &GrayImage) -> BlurredImage {
    let (width, height) = (image.width, image.height);
    let mut blurred = BlurredImage::new(width, height);
    let mut padded = vec![0_u8; width + 2 * RADIUS];
    let mut across = vec![vec![0_u16; width]; BLUR.len()];
    let mut done = 0;
    for y in 0..height {
        while done <= (y + RADIUS).min(height - 1) {
            pad(&image.data[done * width..(done + 1) * width], &mut padded);
            blur_across(path, &padded, &mut across[done % BLUR.len()]);
            done += 1;
        }
        let row = |k: usize| {
            let row = (y + k).saturating_sub(RADIUS).min(height - 1);
            across[row % BLUR.len()].as_slice()
        };
        let rows: [&[u16]; BLUR.len()] = std::array::from_fn(row);
        blur_down(path, rows, &mut blurred.row_mut(y)[..width]);
    }
    blurred
}

fn pad(row: &[u8], padded: &mut [u8]) {
    let (Some(&first), Some(&last)) = (row.first(), row.last()) else { return };
    padded[..RADIUS].fill(first);
    padded[RADIUS..RADIUS + row.len()].copy_from_slice(row);
    padded[RADIUS + row.len()..].fill(last);
}

compiled_twice!(blur_across = blur_across_body(padded: &[u8], out: &mut [u16]));
compiled_twice!(blur_down = blur_down_body(rows: [&[u16]; BLUR.len()], out: &mut [u16]));

#[inline(always)]
fn blur_across_body(padded: &[u8], out: &mut [u16]) {
    let width = out.len();
    let padded = &padded[..width + 2 * RADIUS];
    for x in 0..width {
        let mut sum = 0_u16;
        for k in 0..BLUR.len() {
            sum += u16::from(padded[x + k]) * BLUR[k] as u16;
        }
        out[x] = sum;
    }
}

#[inline(always)]
fn blur_down_body(rows: [&[u16]; BLUR.len()], out: &mut [u16]) {
    let rows = rows.map(|row| &row[..out.len()]);
    for x in 0..out.len() {
        let mut sum = 1 << 7;
        for k in 0..BLUR.len() {
            sum += u32::from(rows[k][x]) * BLUR[k];
        }
        out[x] = (sum >> 8) as u16;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn textured(width: usize, height: usize) -> GrayImage {
        let value = |at: usize| {
            let (x, y) = ((at % width) as f64, (at / width) as f64);
            (128.0 + 60.0 * (x / 9.0).sin() + 50.0 * (y / 7.0 + x / 31.0).cos()) as u8
        };
        GrayImage { width, height, data: (0..width * height).map(value).collect() }
    }

    #[test]
    fn shrinking_keeps_levels_and_places() {
        let image = textured(301, 217);
        let level = shrink(Path::detect(), &image, &image, 1.2).unwrap();
        assert_eq!((level.image.width, level.image.height), (251, 181));
        for (x, y) in [(3, 3), (100, 50), (247, 177)] {
            let (px, py) = ((x as f64 + 0.5) * 301.0 / 251.0 - 0.5, (y as f64 + 0.5) * 217.0 / 181.0 - 0.5);
            let truth = 128.0 + 60.0 * (px / 9.0).sin() + 50.0 * (py / 7.0 + px / 31.0).cos();
            let found = f64::from(level.image.data[y * 251 + x]);
            assert!((found - truth).abs() < 2.0, "{found} {truth}");
        }
        let flat = GrayImage { width: 50, height: 40, data: vec![255; 2000] };
        assert!(shrink(Path::detect(), &flat, &flat, 1.9).unwrap().image.data.iter().all(|v| *v == 255));
        assert!(shrink(Path::detect(), &flat, &flat, 1e3).is_none());
    }

    #[test]
    fn a_blur_keeps_greys_and_paths_agree() {
        let flat = GrayImage { width: 9, height: 3, data: vec![255; 27] };
        let blurred = blur(Path::detect(), &flat);
        assert!((0..3).all(|y| blurred.values()[y * blurred.stride()..][..9].iter().all(|v| *v == 255 << 8)));
        for (width, height) in [(1, 1), (5, 2), (133, 61)] {
            let image = textured(width, height);
            assert_eq!(blur(Path::detect(), &image).values(), blur(Path::BASELINE, &image).values());
            let half = |path| resample(path, &image, width.div_ceil(2), height.div_ceil(2));
            assert_eq!(half(Path::detect()), half(Path::BASELINE));
        }
    }
}
