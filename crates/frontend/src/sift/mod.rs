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
mod patch;
mod rows;
mod select;
mod shape;
pub(crate) mod shared;
mod space;
#[cfg(test)]
mod tests;
mod weighted;

use rayon::prelude::*;
use terrane_scene::{DESCRIPTOR_LEN, DescriptorKind, Features, Keypoint};

use crate::Mask;
use crate::image::{GrayImage, RgbImage};
use descriptor::{describe, orientations};
use extrema::Extremum;
use isa::Isa;
use octave::TILE_COLUMNS;
pub use options::{FirstOctave, SMALL_PIXELS, SiftOptions};
use select::{Placed, Ranked, first_at_places, select};
use shape::{Shape, Surroundings};
use space::{Blob, Paths, ScaleSpace};

/// Finds and describes the features of a photograph, in falling strength, of at most `options.max_features` blobs.
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
    let paths = Paths { isa: Isa::detect(), tile_columns: TILE_COLUMNS };
    extract_with(paths, luma, rgb, mask, options)
}

fn extract_with(
    paths: Paths,
    luma: &GrayImage,
    rgb: Option<&RgbImage>,
    mask: Option<&Mask>,
    options: &SiftOptions,
) -> Features {
    let mut space = ScaleSpace::new(paths, luma, options);
    let mut blobs = strongest(&space, luma, mask, options);
    let is_small = luma.width * luma.height <= SMALL_PIXELS;
    let is_short = blobs.len() < options.max_features as usize;
    if options.first_octave == FirstOctave::Auto && is_small && is_short && !space.is_empty() {
        space.add_doubled(paths, luma, options);
        blobs = strongest(&space, luma, mask, options);
    }
    let isa = paths.isa;
    let seen = seen(&space, blobs, options);
    let oriented = orient(isa, &space, &seen, luma, options);
    let descriptors: Vec<[u8; DESCRIPTOR_LEN]> = by_place(
        &oriented,
        |(seen, _)| &seen.blob,
        |(seen, orientation_rad)| describe(isa, &seen.surroundings(&space).place(), *orientation_rad),
    );
    let keypoints: Vec<Keypoint> = oriented
        .iter()
        .map(|(seen, orientation_rad)| keypoint(&space, &seen.blob, seen.shape.turned(*orientation_rad)))
        .collect();
    let colors = keypoints.iter().map(|keypoint| color_at(keypoint, luma, rgb)).collect();
    let kind = DescriptorKind::Bytes128;
    Features { keypoints, kind, descriptors: descriptors.into_flattened(), colors }
}

/// A blob and what it is seen through.
#[derive(Clone, Copy)]
struct Seen {
    blob: Blob,
    shape: Shape,
}

impl Seen {
    fn surroundings<'a>(&self, space: &'a ScaleSpace) -> Surroundings<'a> {
        Surroundings::of(space.place(&self.blob), &self.shape)
    }
}

/// Blobs with their shapes, or round ones where none are asked for.
fn seen(space: &ScaleSpace, blobs: Vec<Blob>, options: &SiftOptions) -> Vec<Seen> {
    let shapes = match options.affine {
        true => by_place(&blobs, |blob| blob, |blob| Shape::of(&space.place(blob))),
        false => vec![Shape::ROUND; blobs.len()],
    };
    blobs.into_iter().zip(shapes).map(|(blob, shape)| Seen { blob, shape }).collect()
}

fn keypoint(space: &ScaleSpace, blob: &Blob, orientation_rad: f32) -> Keypoint {
    let step_px = space.step_px(blob.octave);
    let Extremum { x, y, sigma, .. } = blob.extremum;
    Keypoint { x_px: x * step_px + 0.5, y_px: y * step_px + 0.5, scale_px: sigma * step_px, orientation_rad }
}

/// Height of the extremum times the blob's area. Noise and blur reach fine blobs first, so that of two equally high the
/// coarser is found again more often; without the area, twice as many are lost when the scale changes.
fn strength(space: &ScaleSpace, blob: &Blob) -> f32 {
    let scale_px = blob.extremum.sigma * space.step_px(blob.octave);
    blob.extremum.response * scale_px * scale_px
}

fn placed(space: &ScaleSpace, blob: &Blob) -> Placed {
    let Keypoint { x_px, y_px, scale_px, .. } = keypoint(space, blob, 0.0);
    Placed { x_px, y_px, scale_px, octave: blob.octave, step_px: space.step_px(blob.octave) }
}

fn ranked(space: &ScaleSpace, blob: &Blob) -> Ranked {
    let Keypoint { x_px, y_px, .. } = keypoint(space, blob, 0.0);
    Ranked { x_px, y_px }
}

/// The blobs that stay, in falling strength.
fn strongest(space: &ScaleSpace, luma: &GrayImage, mask: Option<&Mask>, options: &SiftOptions) -> Vec<Blob> {
    let mut blobs = space.blobs();
    blobs.sort_by(|a, b| {
        let (m, n) = (&a.extremum, &b.extremum);
        strength(space, b)
            .total_cmp(&strength(space, a))
            .then(a.octave.cmp(&b.octave))
            .then(m.y.total_cmp(&n.y))
            .then(m.x.total_cmp(&n.x))
            .then(m.sigma.total_cmp(&n.sigma))
    });
    let places: Vec<Placed> = blobs.iter().map(|blob| placed(space, blob)).collect();
    let is_first = first_at_places(&places);
    let mut is_first = is_first.iter();
    blobs.retain(|_| is_first.next() == Some(&true));
    if let Some(mask) = mask {
        blobs.retain(|blob| {
            let Ranked { x_px, y_px } = ranked(space, blob);
            mask.keeps(x_px, y_px)
        });
    }
    let places: Vec<Ranked> = blobs.iter().map(|blob| ranked(space, blob)).collect();
    let size = (luma.width, luma.height);
    select(&places, options.max_features as usize, options.spread, size)
        .into_iter()
        .map(|k| blobs[k])
        .collect()
}

/// Gives each blob its orientations, of which it may have several, and cuts the result to half as many again as blobs are
/// asked for.
fn orient(
    isa: Isa,
    space: &ScaleSpace,
    blobs: &[Seen],
    luma: &GrayImage,
    options: &SiftOptions,
) -> Vec<(Seen, f32)> {
    let limit = options.max_orientations as usize;
    let found: Vec<Vec<f32>> = by_place(
        blobs,
        |seen| &seen.blob,
        |seen| match options.upright {
            true => vec![0.0],
            false => orientations(isa, &seen.surroundings(space).place(), limit),
        },
    );
    let oriented: Vec<(Seen, f32)> =
        blobs.iter().zip(found).flat_map(|(seen, found)| found.into_iter().map(|o| (*seen, o))).collect();
    let places: Vec<Ranked> = oriented.iter().map(|(seen, _)| ranked(space, &seen.blob)).collect();
    let size = (luma.width, luma.height);
    select(&places, options.most_features(), options.spread, size).into_iter().map(|k| oriented[k]).collect()
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
