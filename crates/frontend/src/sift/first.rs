//! Rows of the first image of the scale space, made one after another from the photograph.
//!
//! Octave −1 has twice the photograph's columns and rows: its pixel j lies at pixel j/2 of the photograph. It is not
//! interpolated and then blurred; both are one Gaussian, sampled at whole distances for even rows and columns and
//! between them for odd ones.

use super::blur::{Blur, Taps, fill_margins};
use super::isa::Isa;
use super::octave::{RowRing, Size};
use super::rows::{BLOCK, MARGIN, blur_columns, blur_rows};
use crate::image::GrayImage;

/// Standard deviation in pixels that a photograph is taken to have been blurred with already (Lowe 2004).
const CAMERA_BLUR_PX: f64 = 0.5;

/// A photograph as a source of rows of its blurred (and doubled) version.
pub(super) struct FirstImage<'a> {
    photo: &'a GrayImage,
    doubled: bool,
    /// On pixels, and between them for the doubled image.
    phases: Vec<Blur>,
    /// Rows of the photograph as floating-point numbers; all before `converted` have been in it.
    source: RowRing,
    converted: usize,
    padded: Vec<f32>,
    scratch: Vec<f32>,
}

impl<'a> FirstImage<'a> {
    /// A source whose rows have been blurred to `sigma_px` of its own pixels in all.
    pub(super) fn new(photo: &'a GrayImage, doubled: bool, sigma_px: f64) -> Self {
        let scale = if doubled { 2.0 } else { 1.0 };
        let sigma_in_photo = ((sigma_px / scale).powi(2) - CAMERA_BLUR_PX * CAMERA_BLUR_PX).max(0.01).sqrt();
        let phases: Vec<Blur> = [false, true]
            .into_iter()
            .take(if doubled { 2 } else { 1 })
            .map(|between| Blur::new(Taps::gaussian(sigma_in_photo, between)))
            .collect();
        let radius = phases.iter().map(|blur| blur.taps.radius() + 1).max().unwrap_or(0);
        let source = RowRing::new(photo.width, 2 * radius + 1);
        let stride = photo.width.next_multiple_of(BLOCK);
        let padded = vec![0.0; stride + 2 * MARGIN];
        Self { photo, doubled, phases, source, converted: 0, padded, scratch: vec![0.0; 2 * stride] }
    }

    /// Columns and rows of the image.
    pub(super) fn size(&self) -> Size {
        let factor = if self.doubled { 2 } else { 1 };
        Size { width: factor * self.photo.width, height: factor * self.photo.height }
    }

    /// Writes row `y`; rows are asked for in order.
    pub(super) fn row(&mut self, isa: Isa, y: usize, out: &mut [f32]) {
        let (center, phase) = if self.doubled { (y / 2, y % 2) } else { (y, 0) };
        let radius = self.phases[phase].taps.radius() + 1;
        self.convert_through((center + radius).min(self.photo.height - 1));
        let (photo, source) = (self.photo, &self.source);
        let last_row = photo.height as isize - 1;
        let row = |y: isize| source.row(y.clamp(0, last_row) as usize);
        if !self.doubled {
            self.phases[0].row(isa, (center, photo.width), row, (&mut self.padded, out));
            return;
        }
        let stride = self.scratch.len() / 2;
        blur_rows(isa, &self.phases[phase].taps.rows(center, row), &mut self.padded[MARGIN..MARGIN + stride]);
        fill_margins(&mut self.padded, photo.width);
        let (even, odd) = self.scratch.split_at_mut(stride);
        blur_columns(isa, &self.padded, &self.phases[0].taps.columns(), even);
        blur_columns(isa, &self.padded, &self.phases[1].taps.columns(), odd);
        for (pair, (even, odd)) in out.chunks_exact_mut(2).zip(even.iter().zip(odd.iter())) {
            pair[0] = *even;
            pair[1] = *odd;
        }
    }

    fn convert_through(&mut self, last: usize) {
        let width = self.photo.width;
        while self.converted <= last {
            let pixels = &self.photo.data[self.converted * width..(self.converted + 1) * width];
            let row = self.source.row_mut(self.converted);
            for (out, pixel) in row.iter_mut().zip(pixels) {
                *out = f32::from(*pixel);
            }
            self.converted += 1;
        }
    }
}
