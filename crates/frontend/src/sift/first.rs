//! Rows of the first image of the scale space, made one after another from the photograph.
//!
//! Octave −1 has twice the photograph's columns and rows: its pixel j lies at pixel j/2 of the photograph. It is not
//! interpolated and then blurred; both are one Gaussian, sampled at whole distances for even rows and columns and
//! between them for odd ones.
//!
//! The blur is [`FIRST_BLUR_PX`], whatever the camera has blurred already. Lowe (2004) adds only what is missing from
//! half a pixel of the photograph to 1.6 of the octave, which leaves octave −1 with a blur of 1.25 pixels of its own: noise and
//! what is above half of a photograph's resolution then make many blobs that no other photograph has. With the whole blur the
//! share of blobs that are found again rises by 3 points in octave 0 and by 6 in octave −1, at equal numbers, and their
//! places are nearer by a tenth.

use std::ops::Range;

use super::blur::Taps;
use super::isa::Isa;
use super::octave::{RowRing, Size};
use super::rows::{BLOCK, MARGIN, interleave, to_fixed};
use crate::image::GrayImage;

/// Standard deviation in pixels of the first image of the blur that makes it of the photograph.
const FIRST_BLUR_PX: f64 = 1.7;

/// The size of the first image.
pub(super) fn size_of_first(photo: &GrayImage, doubled: bool) -> Size {
    let factor = if doubled { 2 } else { 1 };
    Size { width: factor * photo.width, height: factor * photo.height }
}

/// Some columns of a photograph as a source of rows of its blurred (and doubled) version.
pub(super) struct FirstImage<'a> {
    photo: &'a GrayImage,
    doubled: bool,
    /// Columns of the photograph that rows are made of; the margins hold their neighbours.
    columns: Range<usize>,
    /// On pixels, and between them for the doubled image.
    phases: Vec<Taps>,
    /// Rows of the photograph with margins; all before `converted` have been in it.
    source: RowRing<i16>,
    converted: usize,
    padded: Vec<i16>,
    even: Vec<i16>,
    odd: Vec<i16>,
}

impl<'a> FirstImage<'a> {
    /// A source of `columns` of the first image, the first of which is even.
    pub(super) fn new(photo: &'a GrayImage, doubled: bool, columns: &Range<usize>) -> Self {
        let factor = if doubled { 2 } else { 1 };
        let added_px = FIRST_BLUR_PX / factor as f64;
        let phases: Vec<Taps> =
            [false, true][..factor].iter().map(|&between| Taps::gaussian(added_px, between)).collect();
        let columns = columns.start / factor..columns.end.div_ceil(factor);
        let radius = phases.iter().map(Taps::radius).max().unwrap_or(0);
        let padded_len = columns.len().next_multiple_of(BLOCK) + 2 * MARGIN;
        let source = RowRing::new(padded_len, 2 * radius + 1);
        let padded = vec![0; padded_len.next_multiple_of(BLOCK)];
        let (even, odd) = match doubled {
            true => (
                vec![0; columns.len().next_multiple_of(BLOCK)],
                vec![0; columns.len().next_multiple_of(BLOCK)],
            ),
            false => (Vec::new(), Vec::new()),
        };
        Self { photo, doubled, columns, phases, source, converted: 0, padded, even, odd }
    }

    /// Writes row `y`; rows are asked for in order.
    pub(super) fn row(&mut self, isa: Isa, y: usize, out: &mut [i16]) {
        let (center, phase) = if self.doubled { (y / 2, y % 2) } else { (y, 0) };
        let vertical = &self.phases[phase];
        let last_row = self.photo.height - 1;
        let needed = (center + vertical.radius()).min(last_row);
        while self.converted <= needed {
            convert(isa, self.photo, &self.columns, self.converted, self.source.row_mut(self.converted));
            self.converted += 1;
        }
        let row = |y: isize| self.source.row(y.clamp(0, last_row as isize) as usize);
        vertical.blur_rows(isa, center, row, &mut self.padded);
        match self.phases.as_slice() {
            [on, between] => {
                on.blur_columns(isa, &self.padded, &mut self.even);
                between.blur_columns(isa, &self.padded, &mut self.odd);
                interleave(isa, &self.even, &self.odd, out);
            }
            phases => phases[0].blur_columns(isa, &self.padded, out),
        }
    }
}

/// A row of the photograph with what stands beside its columns, or the nearest pixel where there is nothing.
fn convert(isa: Isa, photo: &GrayImage, columns: &Range<usize>, y: usize, out: &mut [i16]) {
    let pixels = &photo.data[y * photo.width..(y + 1) * photo.width];
    let before = columns.start.min(MARGIN);
    let end = (columns.end + MARGIN).min(photo.width);
    let inside = MARGIN - before..MARGIN + end - columns.start;
    to_fixed(isa, &pixels[columns.start - before..end], &mut out[inside.clone()]);
    let (first, last) = (out[inside.start], out[inside.end - 1]);
    out[..inside.start].fill(first);
    out[inside.end..].fill(last);
}
