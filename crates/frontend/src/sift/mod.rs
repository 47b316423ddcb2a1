//! Scale-invariant features: SIFT (Lowe 2004) with RootSIFT descriptors in eight bits.
//!
//! The scale space is streamed row by row in 16-bit fixed point (see `octave`). What orientations and descriptors need of it
//! is kept: 6 bytes a pixel of the photograph from octave 0, 24 from octave −1, besides the photograph and the features.
//! Coordinates follow the project's convention: the centre of the first pixel is (0.5, 0.5).
//!
//! Features are the same bytes on any number of threads and any processor: kernels fix their operations and their
//! order (see `isa`), and no function of the C library is called.

mod blur;
mod descriptor;
mod extrema;
mod first;
mod gradient;
mod isa;
mod math;
mod octave;
mod options;
mod rows;
mod select;
pub(crate) mod shared;
#[cfg(test)]
mod tests;
mod weighted;

use rayon::prelude::*;
use terrane_scene::{DESCRIPTOR_LEN, DescriptorKind, Features, Keypoint};

use crate::Mask;
use crate::image::{GrayImage, RgbImage};
use descriptor::{describe, orientations};
use extrema::{Extremum, Thresholds};
use gradient::Place;
use isa::Isa;
use octave::{Base, LEVELS, Octave, TILE_COLUMNS};
pub use options::{FirstOctave, SiftOptions};
use select::{Placed, Ranked, first_at_places, select};

/// The shortest side of an octave, in its pixels.
const MIN_SIDE: usize = 12;

/// Finds and describes the features of a photograph, in falling strength, at most `options.max_features`.
///
/// Colours are looked up in `rgb`, or are the grey of `luma` when there is none. A photograph that is too small or
/// without texture has no features; that is no error.
pub fn extract(luma: &GrayImage, rgb: Option<&RgbImage>, options: &SiftOptions) -> Features {
    extract_masked(luma, rgb, None, options)
}

/// [`extract`] with features only where a mask lets them be. What it keeps out does not count towards
/// `options.max_features`.
pub fn extract_masked(
    luma: &GrayImage,
    rgb: Option<&RgbImage>,
    mask: Option<&Mask>,
    options: &SiftOptions,
) -> Features {
    extract_with((Isa::detect(), TILE_COLUMNS), luma, rgb, mask, options)
}

fn extract_with(
    (isa, tile_columns): (Isa, usize),
    luma: &GrayImage,
    rgb: Option<&RgbImage>,
    mask: Option<&Mask>,
    options: &SiftOptions,
) -> Features {
    let octaves = scale_space(isa, luma, options, tile_columns);
    let blobs = strongest(&octaves, luma, mask, options);
    let oriented = orient(isa, &octaves, &blobs, luma, options);
    let descriptors: Vec<[u8; DESCRIPTOR_LEN]> = by_place(
        &oriented,
        |(blob, _)| blob,
        |(blob, orientation_rad)| describe(isa, &blob.place(&octaves), *orientation_rad),
    );
    let keypoints: Vec<Keypoint> =
        oriented.iter().map(|(blob, orientation_rad)| blob.keypoint(options, *orientation_rad)).collect();
    let colors = keypoints.iter().map(|keypoint| color_at(keypoint, luma, rgb)).collect();
    let kind = DescriptorKind::Bytes128;
    Features { keypoints, kind, descriptors: descriptors.into_flattened(), colors }
}

/// All octaves, finest first.
fn scale_space(isa: Isa, luma: &GrayImage, options: &SiftOptions, tile_columns: usize) -> Vec<Octave> {
    let mut octaves: Vec<Octave> = Vec::new();
    if luma.data.len() != luma.width * luma.height || luma.data.is_empty() {
        return octaves;
    }
    let thresholds = Thresholds::new(255.0 * options.contrast_threshold, options.edge_threshold);
    for _ in 0..options.num_octaves {
        let doubled = options.first_octave == FirstOctave::Doubled;
        let base = match octaves.last() {
            None => Base::Photo { photo: luma, doubled },
            Some(octave) => Base::Kept(&octave.levels[LEVELS - 1]),
        };
        let size = base.size();
        if size.width.min(size.height) < MIN_SIDE {
            break;
        }
        let octave = octave::run(isa, base, &thresholds, tile_columns);
        octaves.push(octave);
    }
    octaves
}

/// An extremum and the octave that it was found in.
#[derive(Clone, Copy)]
struct Blob {
    octave: usize,
    extremum: Extremum,
}

impl Blob {
    fn place<'a>(&self, octaves: &'a [Octave]) -> Place<'a> {
        let Extremum { x, y, sigma, level, .. } = self.extremum;
        let plane = &octaves[self.octave].levels[usize::from(level) - 1];
        let scale = 1.0 / plane.step as f32;
        Place { plane, x: scale * x, y: scale * y, sigma: scale * sigma }
    }

    /// Pixels of the photograph in one of the octave. Pixel i of an octave lies at pixel i * `step` of the photograph,
    /// whose centre has the coordinate i * `step` + 0.5.
    fn step(&self, options: &SiftOptions) -> f32 {
        let step = (1_u32 << self.octave) as f32;
        if options.first_octave == FirstOctave::Doubled { 0.5 * step } else { step }
    }

    fn keypoint(&self, options: &SiftOptions, orientation_rad: f32) -> Keypoint {
        let step = self.step(options);
        let Extremum { x, y, sigma, .. } = self.extremum;
        Keypoint { x_px: x * step + 0.5, y_px: y * step + 0.5, scale_px: sigma * step, orientation_rad }
    }

    /// Height of the extremum times the blob's area. Noise and blur reach fine blobs first, so that of two equally high the
    /// coarser is found again more often; without the area, twice as many are lost when the scale changes.
    fn strength(&self, options: &SiftOptions) -> f32 {
        let scale_px = self.extremum.sigma * self.step(options);
        self.extremum.response * scale_px * scale_px
    }

    fn placed(&self, options: &SiftOptions) -> Placed {
        let Keypoint { x_px, y_px, scale_px, .. } = self.keypoint(options, 0.0);
        Placed { x_px, y_px, scale_px, octave: self.octave, step_px: self.step(options) }
    }

    fn ranked(&self, options: &SiftOptions) -> Ranked {
        let Keypoint { x_px, y_px, .. } = self.keypoint(options, 0.0);
        Ranked { x_px, y_px }
    }
}

/// The blobs that stay, in falling strength.
fn strongest(octaves: &[Octave], luma: &GrayImage, mask: Option<&Mask>, options: &SiftOptions) -> Vec<Blob> {
    let mut blobs: Vec<Blob> = octaves
        .iter()
        .enumerate()
        .flat_map(|(octave, found)| found.extrema.iter().map(move |&extremum| Blob { octave, extremum }))
        .collect();
    blobs.sort_by(|a, b| {
        let (m, n) = (&a.extremum, &b.extremum);
        b.strength(options)
            .total_cmp(&a.strength(options))
            .then(a.octave.cmp(&b.octave))
            .then(m.y.total_cmp(&n.y))
            .then(m.x.total_cmp(&n.x))
            .then(m.sigma.total_cmp(&n.sigma))
    });
    let places: Vec<Placed> = blobs.iter().map(|blob| blob.placed(options)).collect();
    let is_first = first_at_places(&places);
    let mut is_first = is_first.iter();
    blobs.retain(|_| is_first.next() == Some(&true));
    if let Some(mask) = mask {
        blobs.retain(|blob| {
            let Ranked { x_px, y_px } = blob.ranked(options);
            mask.keeps(x_px, y_px)
        });
    }
    let ranked: Vec<Ranked> = blobs.iter().map(|blob| blob.ranked(options)).collect();
    let size = (luma.width, luma.height);
    select(&ranked, options.max_features as usize, options.spread, size)
        .into_iter()
        .map(|k| blobs[k])
        .collect()
}

/// Gives each blob its orientations, of which it may have several, and cuts the result to the limit again.
fn orient(
    isa: Isa,
    octaves: &[Octave],
    blobs: &[Blob],
    luma: &GrayImage,
    options: &SiftOptions,
) -> Vec<(Blob, f32)> {
    let found: Vec<Vec<f32>> = by_place(
        blobs,
        |blob| blob,
        |blob| match options.upright {
            true => vec![0.0],
            false => orientations(isa, &blob.place(octaves), options.max_orientations as usize),
        },
    );
    let oriented: Vec<(Blob, f32)> =
        blobs.iter().zip(found).flat_map(|(blob, found)| found.into_iter().map(|o| (*blob, o))).collect();
    let ranked: Vec<Ranked> = oriented.iter().map(|(blob, _)| blob.ranked(options)).collect();
    let size = (luma.width, luma.height);
    select(&ranked, options.max_features as usize, options.spread, size)
        .into_iter()
        .map(|k| oriented[k])
        .collect()
}

/// What `compute` makes of each item, in the items' order. Neighbours in a plane are computed one after another, so that
/// its rows are in the cache.
fn by_place<I: Sync, T: Send>(
    items: &[I],
    blob_of: impl Fn(&I) -> &Blob,
    compute: impl Fn(&I) -> T + Sync,
) -> Vec<T> {
    const BAND_ROWS: f32 = 32.0;
    let mut order: Vec<usize> = (0..items.len()).collect();
    order.sort_by_key(|&k| {
        let Blob { octave, extremum } = blob_of(&items[k]);
        (*octave, extremum.level, (extremum.y / BAND_ROWS) as u32, extremum.x as u32, k)
    });
    let mut made: Vec<(usize, T)> = order.into_par_iter().map(|k| (k, compute(&items[k]))).collect();
    made.sort_unstable_by_key(|(k, _)| *k);
    made.into_iter().map(|(_, value)| value).collect()
}

fn color_at(keypoint: &Keypoint, luma: &GrayImage, rgb: Option<&RgbImage>) -> [u8; 3] {
    let pixel = |at: f32, len: usize| (at.max(0.0) as usize).min(len.saturating_sub(1));
    let (x, y) = (pixel(keypoint.x_px, luma.width), pixel(keypoint.y_px, luma.height));
    let of_rgb = rgb.and_then(|rgb| rgb.at_pixel(x, y, (luma.width, luma.height)));
    of_rgb.unwrap_or_else(|| [luma.data[y * luma.width + x]; 3])
}
