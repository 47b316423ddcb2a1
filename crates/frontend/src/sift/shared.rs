//! What other detectors share with SIFT: orientations and descriptors from gradients, the choice among keypoints,
//! colours, and functions that are the same bits on every processor.

use terrane_scene::{DESCRIPTOR_LEN, Keypoint};

use super::gradient::Place;
use super::isa::Isa;
use super::octave::{Plane, Size};
use super::select::{Ranked, select};
use super::{descriptor, math};
use crate::image::{GrayImage, RgbImage};

/// A blurred image in 16-bit fixed point with 8 fractional bits.
pub(crate) struct BlurredImage(Plane);

impl BlurredImage {
    /// An image of zeros.
    pub(crate) fn new(width: usize, height: usize) -> Self {
        let data = vec![0; width * height + Plane::SLACK];
        Self(Plane { size: Size { width, height }, step: 1, data })
    }

    /// Values from one row to the next.
    pub(crate) fn stride(&self) -> usize {
        self.0.size.width
    }

    /// All values; those of a row start at a multiple of the stride.
    pub(crate) fn values(&self) -> &[u16] {
        &self.0.data
    }

    /// A row.
    pub(crate) fn row_mut(&mut self, y: usize) -> &mut [u16] {
        let width = self.stride();
        &mut self.0.data[y * width..(y + 1) * width]
    }

    /// Directions in radians of the dominant gradients around a place, strongest first, at most `limit`. The first
    /// pixel's centre is at (0, 0).
    pub(crate) fn orientations(&self, place: (f32, f32), sigma_px: f32, limit: usize) -> Vec<f32> {
        descriptor::orientations(Isa::detect(), &self.place(place, sigma_px), limit)
    }

    /// The gradients around a place as a RootSIFT descriptor.
    pub(crate) fn describe(
        &self,
        place: (f32, f32),
        sigma_px: f32,
        orientation_rad: f32,
    ) -> [u8; DESCRIPTOR_LEN] {
        descriptor::describe(Isa::detect(), &self.place(place, sigma_px), orientation_rad)
    }

    fn place(&self, (x, y): (f32, f32), sigma: f32) -> Place<'_> {
        Place { plane: &self.0, x, y, sigma }
    }
}

/// Chooses at most `limit` of places (pixels of the photograph) in falling strength, a share `spread` of them evenly
/// over the photograph; returns their positions, ascending.
pub(crate) fn select_spread(
    places_px: &[(f32, f32)],
    limit: usize,
    spread: f64,
    (width, height): (usize, usize),
) -> Vec<usize> {
    let ranked: Vec<Ranked> = places_px.iter().map(|&(x_px, y_px)| Ranked { x_px, y_px }).collect();
    select(&ranked, limit, spread, (width, height))
}

/// Red, green and blue at a keypoint; the grey where there are no colours.
pub(crate) fn color_at(keypoint: &Keypoint, luma: &GrayImage, rgb: Option<&RgbImage>) -> [u8; 3] {
    super::color_at(keypoint, luma, rgb)
}

/// exp(x), the same bits on every processor.
pub(crate) fn exp(x: f64) -> f64 {
    math::exp(x)
}

/// Cosine and sine of an angle between -10 and 10 radians, the same bits on every processor.
pub(crate) fn cos_sin(angle_rad: f64) -> (f64, f64) {
    math::cos_sin(angle_rad)
}

/// Direction of (x, y) in eighths of a turn, in [0, 8], the same bits on every processor.
#[inline]
pub(crate) fn direction_in_eighths(x: f32, y: f32) -> f32 {
    math::direction_in_eighths(x, y)
}

/// Direction of (x, y) in radians between -π and π, the same bits on every processor.
pub(crate) fn direction_rad(x: f32, y: f32) -> f32 {
    let turn = direction_in_eighths(x, y) / 8.0;
    (if turn > 0.5 { turn - 1.0 } else { turn }) * std::f32::consts::TAU
}
