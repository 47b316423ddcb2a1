//! SURF (Bay et al. 2008), turned or upright: blobs by boxes, descriptors of Haar wavelets, both from an integral image.
//!
//! Features are the same bytes on any number of threads and any processor.

mod descriptor;
mod hessian;
mod integral;
mod options;
#[cfg(test)]
mod tests;

use rayon::prelude::*;
use terrane_scene::{DescriptorKind, Features, Keypoint};

use crate::Mask;
use crate::image::{GrayImage, RgbImage};
use crate::sift::shared::{color_at, select_spread};
use crate::simd::Path;
use descriptor::{describe, orientation};
use hessian::{Blob, detect};
use integral::Integral;
pub use options::SurfOptions;

/// Finds and describes the features of a photograph, in falling strength, at most `options.max_features`.
///
/// Descriptors have 64 entries, and 64 zeros behind them. Colours are looked up in `rgb`, or are the grey of `luma` when
/// there is none. A photograph that is too small or without texture has no features; that is no error.
pub fn extract(luma: &GrayImage, rgb: Option<&RgbImage>, options: &SurfOptions) -> Features {
    extract_masked((luma, rgb), None, options)
}

/// [`extract`] with features only where a mask lets them be. What it keeps out does not count towards
/// `options.max_features`.
pub fn extract_masked(
    (luma, rgb): (&GrayImage, Option<&RgbImage>),
    mask: Option<&Mask>,
    options: &SurfOptions,
) -> Features {
    extract_with(Path::detect(), (luma, rgb), mask, options)
}

fn extract_with(
    path: Path,
    (luma, rgb): (&GrayImage, Option<&RgbImage>),
    mask: Option<&Mask>,
    options: &SurfOptions,
) -> Features {
    let mut features = Features { kind: DescriptorKind::Bytes128, ..Features::default() };
    if luma.data.len() != luma.width * luma.height || luma.data.is_empty() {
        return features;
    }
    let integral = Integral::new(luma);
    let blobs = strongest(
        detect(path, &integral, options.num_octaves as usize, options.hessian_threshold as f32),
        luma,
        mask,
        options,
    );
    let described: Vec<(f32, [u8; terrane_scene::DESCRIPTOR_LEN])> = blobs
        .par_iter()
        .map(|blob| {
            let orientation_rad = if options.upright { 0.0 } else { orientation(&integral, blob) };
            (orientation_rad, describe(&integral, blob, orientation_rad))
        })
        .collect();
    for (blob, (orientation_rad, descriptor)) in blobs.iter().zip(&described) {
        let Blob { x_px, y_px, scale_px, .. } = *blob;
        let keypoint = Keypoint { x_px, y_px, scale_px, orientation_rad: *orientation_rad };
        features.keypoints.push(keypoint);
        features.colors.push(color_at(&keypoint, luma, rgb));
        features.descriptors.extend_from_slice(descriptor);
    }
    features
}

/// The blobs that stay, in falling strength.
fn strongest(
    mut blobs: Vec<Blob>,
    luma: &GrayImage,
    mask: Option<&Mask>,
    options: &SurfOptions,
) -> Vec<Blob> {
    blobs.retain(|blob| mask.is_none_or(|mask| mask.keeps(blob.x_px, blob.y_px)));
    // Stable: equal ones stay in the order of octaves, scales and rows.
    blobs.sort_by(|a, b| b.response.total_cmp(&a.response));
    let places_px: Vec<(f32, f32)> = blobs.iter().map(|blob| (blob.x_px, blob.y_px)).collect();
    let size = (luma.width, luma.height);
    let chosen = select_spread(&places_px, options.max_features as usize, options.spread, size);
    chosen.into_iter().map(|k| blobs[k]).collect()
}
