//! Corners on a pyramid, described by gradients or by comparisons.
//!
//! Corners are found by FAST (Rosten & Drummond 2006) or by Harris & Stephens (1988) on every level of a pyramid, ranked
//! by Harris' measure, thinned so that a place is described once, and placed to fractions of a pixel on the measure's
//! peak. Described by gradients they are compared as SIFT's features are; described by rotated BRIEF they are ORB's
//! (Rublee et al. 2011).
//!
//! Features are the same bytes on any number of threads and any processor.

mod brief;
mod fast;
mod harris;
mod options;
mod pyramid;
mod separate;
#[cfg(test)]
mod tests;

use std::borrow::Cow;

use rayon::prelude::*;
use terrane_scene::{DescriptorKind, Features, Keypoint};

use crate::Mask;
use crate::image::{GrayImage, RgbImage};
use crate::sift::shared::{BlurredImage, color_at, direction_rad, select_spread};
use crate::simd::Path;
pub use options::CornerOptions;
use pyramid::{BLUR_SIGMA_PX, Level, blur, shrink};
use separate::{Place, separate};

/// How corners are found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CornerDetector {
    /// The segment test of FAST, nine of sixteen.
    Fast,
    /// The measure of Harris and Stephens.
    Harris,
}

/// How corners are described.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CornerDescriptor {
    /// Histograms of gradients, as SIFT's: 128 bytes.
    Gradients,
    /// Rotated BRIEF: 256 bits.
    Brief,
}

/// A pixel of a level that may be a corner.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Candidate {
    x: usize,
    y: usize,
    /// Larger is better; comparable between corners of one detector.
    response: f32,
}

/// A corner in pixels of its level; the first pixel's centre is at (0, 0).
#[derive(Clone, Copy, Debug, PartialEq)]
struct Corner {
    level: usize,
    x: f32,
    y: f32,
    response: f32,
}

impl Corner {
    fn place(&self, levels: &[Level<'_>]) -> Place {
        let (across, down) = levels[self.level].step;
        Place { x_px: (self.x + 0.5) * across, y_px: (self.y + 0.5) * down, step_px: across.max(down) }
    }

    fn keypoint(&self, levels: &[Level<'_>], orientation_rad: f32) -> Keypoint {
        let Place { x_px, y_px, step_px } = self.place(levels);
        Keypoint { x_px, y_px, scale_px: BLUR_SIGMA_PX * step_px, orientation_rad }
    }
}

/// Finds and describes the corners of a photograph, in falling strength, at most `options.max_features`.
///
/// Colours are looked up in `rgb`, or are the grey of `luma` when there is none. A photograph that is too small or
/// without texture has no features; that is no error.
pub fn extract(
    luma: &GrayImage,
    rgb: Option<&RgbImage>,
    (detector, descriptor): (CornerDetector, CornerDescriptor),
    options: &CornerOptions,
) -> Features {
    extract_masked((luma, rgb), None, (detector, descriptor), options)
}

/// [`extract`] with corners only where a mask lets them be. What it keeps out does not count towards
/// `options.max_features`.
pub fn extract_masked(
    (luma, rgb): (&GrayImage, Option<&RgbImage>),
    mask: Option<&Mask>,
    (detector, descriptor): (CornerDetector, CornerDescriptor),
    options: &CornerOptions,
) -> Features {
    extract_with(Path::detect(), (luma, rgb), mask, (detector, descriptor), options)
}

fn extract_with(
    path: Path,
    (luma, rgb): (&GrayImage, Option<&RgbImage>),
    mask: Option<&Mask>,
    (detector, descriptor): (CornerDetector, CornerDescriptor),
    options: &CornerOptions,
) -> Features {
    let keeps = |corner: &Corner, levels: &[Level<'_>]| {
        let place = corner.place(levels);
        mask.is_none_or(|mask| mask.keeps(place.x_px, place.y_px))
    };
    let levels = pyramid(path, luma, options);
    let margin = match descriptor {
        CornerDescriptor::Gradients => fast::MARGIN,
        CornerDescriptor::Brief => brief::MARGIN + 3,
    };
    let mut found = detect(path, &levels, (detector, margin), options);
    found.retain(|corner| keeps(corner, &levels));
    let corners = strongest(found, &levels, luma, options);
    let mut corners: Vec<Corner> = corners.par_iter().map(|corner| refined(corner, &levels)).collect();
    // Refinement may have moved one over the edge of a mask.
    corners.retain(|corner| keeps(corner, &levels));
    match descriptor {
        CornerDescriptor::Gradients => describe_gradients(path, &levels, &corners, (luma, rgb), options),
        CornerDescriptor::Brief => describe_brief(path, &levels, &corners, (luma, rgb), options),
    }
}

/// All levels that are large enough to hold corners, finest first.
fn pyramid<'a>(path: Path, luma: &'a GrayImage, options: &CornerOptions) -> Vec<Level<'a>> {
    let min_side = 2 * (brief::MARGIN + 3);
    let mut levels: Vec<Level<'a>> = Vec::new();
    if luma.data.len() != luma.width * luma.height || luma.width.min(luma.height) < min_side {
        return levels;
    }
    levels.push(Level { image: Cow::Borrowed(luma), step: (1.0, 1.0) });
    let mut scale = 1.0;
    while levels.len() < options.num_levels as usize {
        scale *= options.level_scale;
        let last = &levels[levels.len() - 1].image;
        match shrink(path, last, luma, scale) {
            Some(level) if level.image.width.min(level.image.height) >= min_side => levels.push(level),
            _ => break,
        }
    }
    levels
}

/// Corners of all levels, by level and rows.
fn detect(
    path: Path,
    levels: &[Level<'_>],
    (detector, margin): (CornerDetector, usize),
    options: &CornerOptions,
) -> Vec<Corner> {
    let of_level = |(level, Level { image, .. }): (usize, &Level<'_>)| -> Vec<Corner> {
        let candidates = match detector {
            CornerDetector::Harris => harris::detect(path, image, options.harris_threshold as f32),
            CornerDetector::Fast => {
                // As in ORB: the segment test finds corners and does not order them well.
                let mut candidates = fast::detect(path, image, options.fast_threshold);
                harris::rate(path, image, &mut candidates);
                candidates
            }
        };
        let is_inside = |candidate: &Candidate| {
            (margin..image.width - margin).contains(&candidate.x)
                && (margin..image.height - margin).contains(&candidate.y)
        };
        let corner = |Candidate { x, y, response }| Corner { level, x: x as f32, y: y as f32, response };
        let corners = candidates.into_iter().filter(is_inside).map(corner);
        corners.filter(|corner| corner.response > 0.0).collect()
    };
    levels.par_iter().enumerate().map(of_level).collect::<Vec<_>>().concat()
}

/// The corners that stay, in falling strength.
fn strongest(
    mut corners: Vec<Corner>,
    levels: &[Level<'_>],
    luma: &GrayImage,
    options: &CornerOptions,
) -> Vec<Corner> {
    // Stable: equal ones stay in the order of levels and rows.
    corners.sort_by(|a, b| b.response.total_cmp(&a.response));
    let size = (luma.width, luma.height);
    let places: Vec<Place> = corners.iter().map(|corner| corner.place(levels)).collect();
    let apart = separate(&places, options.separation_px as f32, size);
    let places_px: Vec<(f32, f32)> = apart.iter().map(|&k| (places[k].x_px, places[k].y_px)).collect();
    select_spread(&places_px, options.max_features as usize, options.spread, size)
        .into_iter()
        .map(|k| corners[apart[k]])
        .collect()
}

fn refined(corner: &Corner, levels: &[Level<'_>]) -> Corner {
    let (x, y) = harris::refine(&levels[corner.level].image, corner.x as usize, corner.y as usize);
    Corner { x, y, ..*corner }
}

/// Applies a function to all corners of a level and the level's blurred image, level by level, so that one such image
/// is held at a time; the results in the order of the corners.
fn by_level<T: Send + Default>(
    path: Path,
    levels: &[Level<'_>],
    corners: &[Corner],
    apply: impl Fn(&Corner, &GrayImage, &BlurredImage) -> T + Sync,
) -> Vec<T> {
    let mut results: Vec<T> = corners.iter().map(|_| T::default()).collect();
    for (at, level) in levels.iter().enumerate() {
        let of_level: Vec<usize> = (0..corners.len()).filter(|&k| corners[k].level == at).collect();
        if of_level.is_empty() {
            continue;
        }
        let blurred = blur(path, &level.image);
        let made: Vec<T> = of_level.par_iter().map(|&k| apply(&corners[k], &level.image, &blurred)).collect();
        for (k, made) in of_level.into_iter().zip(made) {
            results[k] = made;
        }
    }
    results
}

/// Corners with descriptors of gradients, one for each orientation, cut to the limit again.
fn describe_gradients(
    path: Path,
    levels: &[Level<'_>],
    corners: &[Corner],
    (luma, rgb): (&GrayImage, Option<&RgbImage>),
    options: &CornerOptions,
) -> Features {
    let described = by_level(path, levels, corners, |corner, _, blurred| {
        let place = (corner.x, corner.y);
        let orientations = match options.upright {
            true => vec![0.0],
            false => blurred.orientations(place, BLUR_SIGMA_PX, options.max_orientations as usize),
        };
        let describe =
            |orientation_rad| (orientation_rad, blurred.describe(place, BLUR_SIGMA_PX, orientation_rad));
        orientations.into_iter().map(describe).collect::<Vec<_>>()
    });
    let all: Vec<(Keypoint, _)> = corners
        .iter()
        .zip(described)
        .flat_map(|(corner, described)| {
            described.into_iter().map(|(orientation, bytes)| (corner.keypoint(levels, orientation), bytes))
        })
        .collect();
    let places_px: Vec<(f32, f32)> = all.iter().map(|(keypoint, _)| (keypoint.x_px, keypoint.y_px)).collect();
    let size = (luma.width, luma.height);
    let chosen = select_spread(&places_px, options.max_features as usize, options.spread, size);
    let mut features = Features { kind: DescriptorKind::Bytes128, ..Features::default() };
    for k in chosen {
        let (keypoint, bytes) = &all[k];
        features.keypoints.push(*keypoint);
        features.colors.push(color_at(keypoint, luma, rgb));
        features.descriptors.extend_from_slice(bytes);
    }
    features
}

/// Corners with rotated BRIEF.
fn describe_brief(
    path: Path,
    levels: &[Level<'_>],
    corners: &[Corner],
    (luma, rgb): (&GrayImage, Option<&RgbImage>),
    options: &CornerOptions,
) -> Features {
    let described = by_level(path, levels, corners, |corner, image, blurred| {
        let pixel = (corner.x.round() as usize, corner.y.round() as usize);
        let direction = if options.upright { (1.0, 0.0) } else { brief::direction(image, pixel.0, pixel.1) };
        (direction, brief::describe(path, blurred, pixel, direction))
    });
    let mut features = Features { kind: DescriptorKind::Bits256, ..Features::default() };
    for (corner, (direction, bits)) in corners.iter().zip(described) {
        let keypoint = corner.keypoint(levels, direction_rad(direction.0, direction.1));
        features.keypoints.push(keypoint);
        features.colors.push(color_at(&keypoint, luma, rgb));
        features.descriptors.extend_from_slice(&bits);
    }
    features
}
