//! Orientations and descriptors of keypoints.

use terrane_scene::DESCRIPTOR_LEN;

use super::gradient::{ORIENTATION_BINS, Place, gather_orientations};
use super::isa::Isa;
use super::math::cos_sin;
use super::patch::{CELLS, DIRECTIONS, PER_CELL, Step, gather_descriptor};

/// Width of a descriptor's cell in standard deviations of the keypoint (Lowe 2004, as in VLFeat).
const CELL_SIGMAS: f64 = 3.0;
/// Peaks of the orientation histogram that are at least this part of the highest make a keypoint of their own (Lowe 2004).
const PEAK_SHARE: f32 = 0.8;
/// The largest part of a descriptor that one entry may be, before the second normalisation (Lowe 2004).
const CLAMP: f32 = 0.2;
/// What a RootSIFT entry of one becomes; entries above one half, which are rare, are cut off at 255.
const QUANTUM: f32 = 512.0;

/// Directions of the dominant gradients in radians between -π and π, strongest first, at most `limit`.
pub(super) fn orientations(isa: Isa, place: &Place<'_>, limit: usize) -> Vec<f32> {
    let mut histogram = [0.0_f32; ORIENTATION_BINS];
    gather_orientations(isa, place, &mut histogram);
    for _ in 0..6 {
        histogram = smoothed(&histogram);
    }
    let highest = histogram.iter().copied().fold(0.0_f32, f32::max);
    let mut peaks: Vec<(f32, f32)> = (0..ORIENTATION_BINS)
        .filter_map(|k| {
            let before = histogram[(k + ORIENTATION_BINS - 1) % ORIENTATION_BINS];
            let after = histogram[(k + 1) % ORIENTATION_BINS];
            let value = histogram[k];
            // Not `> after`: two level bins are one peak.
            if !(value > before && value >= after && value >= PEAK_SHARE * highest) {
                return None;
            }
            let shift = 0.5 * (before - after) / (before + after - 2.0 * value);
            Some((value, k as f32 + 0.5 + shift))
        })
        .collect();
    if peaks.is_empty() {
        // Wholly symmetric: any direction is as good.
        return vec![0.0];
    }
    // Stable: equal peaks stay in the order of their bins.
    peaks.sort_by(|a, b| b.0.total_cmp(&a.0));
    peaks.truncate(limit);
    peaks.into_iter().map(|(_, bin)| radians_of_bin(bin)).collect()
}

fn radians_of_bin(bin: f32) -> f32 {
    let turn = bin / ORIENTATION_BINS as f32;
    (if turn > 0.5 { turn - 1.0 } else { turn }) * std::f32::consts::TAU
}

fn smoothed(histogram: &[f32; ORIENTATION_BINS]) -> [f32; ORIENTATION_BINS] {
    std::array::from_fn(|k| {
        let before = histogram[(k + ORIENTATION_BINS - 1) % ORIENTATION_BINS];
        let after = histogram[(k + 1) % ORIENTATION_BINS];
        (before + histogram[k] + after) / 3.0
    })
}

/// The descriptor of a place: rows of cells, in each the directions, relative to the orientation.
///
/// RootSIFT (Arandjelović & Zisserman 2012) in eight bits: round(512 √(d / |d|₁)), at most 255, of Lowe's clamped
/// descriptor d. Its length is 512 within rounding, so that dot products compare as those of unit vectors do.
pub(super) fn describe(isa: Isa, place: &Place<'_>, orientation_rad: f32) -> [u8; DESCRIPTOR_LEN] {
    quantized(&root_sift(isa, place, orientation_rad))
}

/// The descriptor before it is rounded: of length one, or all zeros where there is no gradient.
pub(super) fn root_sift(isa: Isa, place: &Place<'_>, orientation_rad: f32) -> [f32; DESCRIPTOR_LEN] {
    let (cosine, sine) = cos_sin(f64::from(orientation_rad));
    let step_px = CELL_SIGMAS * f64::from(place.sigma) / PER_CELL as f64;
    let step = Step { x: (cosine * step_px) as f32, y: (sine * step_px) as f32 };
    let mut cells = [[0.0_f32; DIRECTIONS]; CELLS * CELLS];
    gather_descriptor(isa, place, &step, &mut cells);
    let mut histogram = [0.0; DESCRIPTOR_LEN];
    histogram.copy_from_slice(cells.as_flattened());
    let length = histogram.iter().map(|v| v * v).sum::<f32>().sqrt();
    if !(length > 0.0) {
        return [0.0; DESCRIPTOR_LEN];
    }
    let clamped = histogram.map(|v| (v / length).min(CLAMP));
    let sum: f32 = clamped.iter().sum();
    clamped.map(|v| (v / sum).sqrt())
}

fn quantized(root_sift: &[f32; DESCRIPTOR_LEN]) -> [u8; DESCRIPTOR_LEN] {
    // Adding it rounds to an integer, ties to even, which then stands in the low bits.
    const MAGIC: f32 = 8_388_608.0;
    root_sift.map(|v| ((QUANTUM * v).min(255.0) + MAGIC).to_bits() as u8)
}
