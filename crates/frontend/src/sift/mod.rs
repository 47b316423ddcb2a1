//! Scale-invariant features: SIFT (Lowe 2004) with RootSIFT descriptors in eight bits.
//!
//! The scale space is streamed row by row (see `octave`), so that memory is little more than three levels of the finest
//! octave in 16 bits: about 16 bytes a pixel of the photograph from octave 0, 60 from octave −1. Coordinates follow the
//! project's convention: the centre of the first pixel is (0.5, 0.5).
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

use rayon::prelude::*;
use terrane_scene::{DESCRIPTOR_LEN, DescriptorKind, Features, Keypoint};

use crate::image::{GrayImage, RgbImage};
use descriptor::{describe, orientations};
use extrema::{Detector, Extremum};
use first::FirstImage;
use gradient::Place;
use isa::Isa;
use octave::{BASE_SIGMA, Base, Octave};
pub use options::{FirstOctave, SiftOptions};
use select::{Ranked, select};

/// The shortest side of an octave, in its pixels.
const MIN_SIDE: usize = 12;

/// Finds and describes the features of a photograph, in falling strength, at most `options.max_features`.
///
/// Colours are looked up in `rgb`, or are the grey of `luma` when there is none. A photograph that is too small or
/// without texture has no features; that is no error.
pub fn extract(luma: &GrayImage, rgb: Option<&RgbImage>, options: &SiftOptions) -> Features {
    extract_with(Isa::detect(), luma, rgb, options)
}

fn extract_with(isa: Isa, luma: &GrayImage, rgb: Option<&RgbImage>, options: &SiftOptions) -> Features {
    let octaves = scale_space(isa, luma, options);
    let blobs = strongest(&octaves, luma, options);
    let oriented = orient(isa, &octaves, &blobs, luma, options);
    let descriptors: Vec<[u8; DESCRIPTOR_LEN]> = oriented
        .par_iter()
        .map(|(blob, orientation_rad)| describe(isa, &blob.place(&octaves), *orientation_rad))
        .collect();
    let keypoints: Vec<Keypoint> =
        oriented.iter().map(|(blob, orientation_rad)| blob.keypoint(options, *orientation_rad)).collect();
    let colors = keypoints.iter().map(|keypoint| color_at(keypoint, luma, rgb)).collect();
    let kind = DescriptorKind::Bytes128;
    Features { keypoints, kind, descriptors: descriptors.into_flattened(), colors }
}

/// All octaves, finest first.
fn scale_space(isa: Isa, luma: &GrayImage, options: &SiftOptions) -> Vec<Octave> {
    let doubled = options.first_octave == FirstOctave::Doubled;
    let mut octaves = Vec::new();
    if luma.data.len() != luma.width * luma.height || luma.data.is_empty() {
        return octaves;
    }
    let mut detector = Detector::new(255.0 * options.contrast_threshold, options.edge_threshold);
    let mut base = Base::First(Box::new(FirstImage::new(luma, doubled, BASE_SIGMA)));
    for _ in 0..options.num_octaves {
        if base.size().width.min(base.size().height) < MIN_SIDE {
            break;
        }
        let (octave, next) = octave::run(isa, base, &mut detector);
        octaves.push(octave);
        base = next;
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
        Place { plane: &octaves[self.octave].levels[usize::from(level) - 1], x, y, sigma }
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

    fn ranked(&self, options: &SiftOptions) -> Ranked {
        let Keypoint { x_px, y_px, .. } = self.keypoint(options, 0.0);
        Ranked { x_px, y_px }
    }
}

/// The blobs that stay, in falling strength.
fn strongest(octaves: &[Octave], luma: &GrayImage, options: &SiftOptions) -> Vec<Blob> {
    let mut blobs: Vec<Blob> = octaves
        .iter()
        .enumerate()
        .flat_map(|(octave, found)| found.extrema.iter().map(move |&extremum| Blob { octave, extremum }))
        .collect();
    blobs.sort_by(|a, b| {
        let (m, n) = (&a.extremum, &b.extremum);
        n.response
            .total_cmp(&m.response)
            .then(a.octave.cmp(&b.octave))
            .then(m.y.total_cmp(&n.y))
            .then(m.x.total_cmp(&n.x))
            .then(m.sigma.total_cmp(&n.sigma))
    });
    // Two cells may have led to one and the same extremum.
    blobs.dedup_by(|a, b| a.octave == b.octave && a.extremum == b.extremum);
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
    let found: Vec<Vec<f32>> = blobs
        .par_iter()
        .map(|blob| match options.upright {
            true => vec![0.0],
            false => orientations(isa, &blob.place(octaves), options.max_orientations as usize),
        })
        .collect();
    let oriented: Vec<(Blob, f32)> =
        blobs.iter().zip(found).flat_map(|(blob, found)| found.into_iter().map(|o| (*blob, o))).collect();
    let ranked: Vec<Ranked> = oriented.iter().map(|(blob, _)| blob.ranked(options)).collect();
    let size = (luma.width, luma.height);
    select(&ranked, options.max_features as usize, options.spread, size)
        .into_iter()
        .map(|k| oriented[k])
        .collect()
}

fn color_at(keypoint: &Keypoint, luma: &GrayImage, rgb: Option<&RgbImage>) -> [u8; 3] {
    let pixel = |at: f32, len: usize| (at.max(0.0) as usize).min(len.saturating_sub(1));
    let (x, y) = (pixel(keypoint.x_px, luma.width), pixel(keypoint.y_px, luma.height));
    let of_rgb = rgb.and_then(|rgb| rgb.data.get(3 * (y * rgb.width + x)..)?.first_chunk::<3>().copied());
    of_rgb.unwrap_or_else(|| [luma.data[y * luma.width + x]; 3])
}
