//! Rows of samples in, brightness and colours at half size out: the only place that holds a whole image.
//!
//! Brightness takes one sample a pixel, colours three quarters of one: a row is reduced as soon as it is decoded.

use super::levels::{self, Levels};
use super::{DecodedImage, GrayImage, RgbImage};
use crate::FrontendError;

/// What the first samples of a pixel mean.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Model {
    /// Brightness.
    Gray,
    /// Red, green, blue.
    Rgb,
    /// JFIF's brightness and colour differences, of eight bits.
    YCbCr,
    /// Inks: 0 is none.
    Cmyk,
}

/// How a row's samples lie.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Pixels {
    pub model: Model,
    /// Samples from one pixel to the next: those that the model doesn't name are passed over.
    pub stride: usize,
}

/// A sample as a file holds it.
pub(super) trait Sample: Copy + Default + PartialOrd + Into<f32> {
    /// The largest value, or 1 for floating point.
    const FULL: f32;
    /// From a mean of samples.
    fn from_mean(mean: f32) -> Self;
    /// BT.601 luma.
    fn luma_of(rgb: [Self; 3]) -> Self;
    /// How values become eight bits; `None` when they are.
    fn levels(luma: &[Self], width: usize) -> Option<Levels>;
    /// Eight bits of a sample.
    fn to_eight(self, levels: Option<Levels>) -> u8;
    /// The samples as bytes, without a copy where they are bytes.
    fn into_eight(samples: Vec<Self>, levels: Option<Levels>) -> Vec<u8> {
        samples.into_iter().map(|sample| sample.to_eight(levels)).collect()
    }
}

impl Sample for u8 {
    const FULL: f32 = 255.0;

    fn from_mean(mean: f32) -> Self {
        (mean + 0.5) as u8
    }

    fn luma_of([r, g, b]: [u8; 3]) -> Self {
        ((19_595 * u32::from(r) + 38_470 * u32::from(g) + 7_471 * u32::from(b) + 32_768) >> 16) as u8
    }

    fn levels(_: &[Self], _: usize) -> Option<Levels> {
        None
    }

    fn to_eight(self, _: Option<Levels>) -> u8 {
        self
    }

    fn into_eight(samples: Vec<Self>, _: Option<Levels>) -> Vec<u8> {
        samples
    }
}

impl Sample for u16 {
    const FULL: f32 = 65_535.0;

    fn from_mean(mean: f32) -> Self {
        (mean + 0.5) as u16
    }

    fn luma_of([r, g, b]: [u16; 3]) -> Self {
        ((19_595 * u64::from(r) + 38_470 * u64::from(g) + 7_471 * u64::from(b) + 32_768) >> 16) as u16
    }

    fn levels(luma: &[Self], width: usize) -> Option<Levels> {
        levels::of_sixteen_bits(luma, width)
    }

    fn to_eight(self, levels: Option<Levels>) -> u8 {
        levels.map_or((self >> 8) as u8, |levels| levels.apply(f32::from(self)))
    }
}

impl Sample for f32 {
    const FULL: f32 = 1.0;

    fn from_mean(mean: f32) -> Self {
        mean
    }

    fn luma_of([r, g, b]: [f32; 3]) -> Self {
        0.299 * r + 0.587 * g + 0.114 * b
    }

    fn levels(luma: &[Self], width: usize) -> Option<Levels> {
        Some(levels::of_floats(luma, width))
    }

    fn to_eight(self, levels: Option<Levels>) -> u8 {
        levels.map_or(0, |levels| levels.apply(self))
    }
}

pub(super) struct Canvas<S> {
    width: usize,
    height: usize,
    num_rows: usize,
    luma: Vec<S>,
    colors: Option<Colors<S>>,
}

/// Colours of cells of 2 x 2 pixels.
struct Colors<S> {
    data: Vec<S>,
    /// Sums of the row of cells that is being filled.
    sums: Vec<[f32; 3]>,
}

impl<S: Sample> Canvas<S> {
    /// For an image of this size; colours are kept when they are wanted.
    pub fn new(width: usize, height: usize, with_colors: bool) -> Self {
        let colors =
            with_colors.then(|| Colors { data: Vec::new(), sums: vec![[0.0; 3]; width.div_ceil(2)] });
        Self { width, height, num_rows: 0, luma: Vec::with_capacity(width * height), colors }
    }

    /// Takes the next row, of `width` pixels.
    pub fn push_row(&mut self, pixels: Pixels, row: &[S]) {
        if self.num_rows == self.height || row.len() < self.width * pixels.stride {
            return;
        }
        let row = &row[..self.width * pixels.stride];
        match pixels.model {
            Model::Gray => self.luma.extend(row.chunks_exact(pixels.stride).map(|p| p[0])),
            Model::Rgb => self.push_colors(row, pixels.stride, |p| {
                let rgb = [p[0], p[1], p[2]];
                (S::luma_of(rgb), rgb)
            }),
            Model::YCbCr => self.push_colors(row, pixels.stride, |p| (p[0], rgb_of_ycbcr(p))),
            Model::Cmyk => self.push_colors(row, pixels.stride, |p| {
                let rgb = rgb_of_cmyk(p);
                (S::luma_of(rgb), rgb)
            }),
        }
        self.num_rows += 1;
    }

    fn push_colors(&mut self, row: &[S], stride: usize, read: impl Fn(&[S]) -> (S, [S; 3])) {
        let Some(colors) = &mut self.colors else {
            self.luma.extend(row.chunks_exact(stride).map(|p| read(p).0));
            return;
        };
        if colors.data.is_empty() {
            colors.data.reserve_exact(3 * colors.sums.len() * self.height.div_ceil(2));
        }
        for (cell, pair) in colors.sums.iter_mut().zip(row.chunks(2 * stride)) {
            for pixel in pair.chunks_exact(stride) {
                let (luma, rgb) = read(pixel);
                self.luma.push(luma);
                for (sum, value) in cell.iter_mut().zip(rgb) {
                    *sum += value.into();
                }
            }
        }
        let (top, is_last) = (self.num_rows.is_multiple_of(2), self.num_rows + 1 == self.height);
        if top && !is_last {
            return;
        }
        let rows = if top { 1 } else { 2 };
        for (k, cell) in colors.sums.iter_mut().enumerate() {
            let count = rows * (self.width - 2 * k).min(2);
            colors.data.extend(cell.map(|sum| S::from_mean(sum / count as f32)));
            *cell = [0.0; 3];
        }
    }

    /// The image, once every row is there.
    pub fn finish(self) -> Result<DecodedImage, FrontendError> {
        let (width, height) = (self.width, self.height);
        if self.num_rows != height {
            return Err(FrontendError::corrupt(format!(
                "the file holds {} of {height} rows of pixels: copy it again from its source",
                self.num_rows
            )));
        }
        let levels = S::levels(&self.luma, width);
        let luma = GrayImage { width, height, data: S::into_eight(self.luma, levels) };
        let rgb = self.colors.filter(|colors| !colors.data.is_empty()).map(|colors| RgbImage {
            width: width.div_ceil(2),
            height: height.div_ceil(2),
            data: S::into_eight(colors.data, levels),
        });
        Ok(DecodedImage { luma, rgb })
    }
}

fn rgb_of_ycbcr<S: Sample>(pixel: &[S]) -> [S; 3] {
    let (y, cb, cr): (f32, f32, f32) = (pixel[0].into(), pixel[1].into() - 128.0, pixel[2].into() - 128.0);
    [y + 1.402 * cr, y - 0.344_136 * cb - 0.714_136 * cr, y + 1.772 * cb]
        .map(|v| S::from_mean(v.clamp(0.0, S::FULL)))
}

fn rgb_of_cmyk<S: Sample>(pixel: &[S]) -> [S; 3] {
    let light: f32 = S::FULL - pixel[3].into();
    [0, 1, 2].map(|k| S::from_mean((S::FULL - pixel[k].into()) * light / S::FULL))
}

/// Splits JPEG's interleaved YCbCr in place, so that the decoder's buffer is the only large one: brightness moves to
/// its front, colours are averaged over 2 x 2 pixels and converted.
pub(super) fn split_ycbcr(mut data: Vec<u8>, width: usize, height: usize) -> DecodedImage {
    let mut colors = Vec::with_capacity(3 * width.div_ceil(2) * height.div_ceil(2));
    for top in (0..height).step_by(2) {
        let rows = (height - top).min(2);
        let (upper, lower) =
            (&data[3 * width * top..][..3 * width], &data[3 * width * (top + rows - 1)..][..3 * width]);
        // The last row of an odd height, and the last column of an odd width, count twice.
        for (a, b) in upper.chunks(6).zip(lower.chunks(6)) {
            let last = a.len() - 3;
            let mean = |k: usize| {
                (i32::from(a[k]) + i32::from(a[last + k]) + i32::from(b[k]) + i32::from(b[last + k]) + 2) >> 2
            };
            colors.extend(rgb_of_sums(mean(0), mean(1), mean(2)));
        }
        for row in top..top + rows {
            take_luma(&mut data, row, width);
        }
    }
    data.truncate(width * height);
    data.shrink_to_fit();
    let rgb = RgbImage { width: width.div_ceil(2), height: height.div_ceil(2), data: colors };
    DecodedImage { luma: GrayImage { width, height, data }, rgb: Some(rgb) }
}

/// Moves the brightness of a row from its place among the colours to its place in the plane.
fn take_luma(data: &mut [u8], row: usize, width: usize) {
    if row == 0 {
        for k in 0..width {
            data[k] = data[3 * k];
        }
        return;
    }
    let (front, back) = data.split_at_mut(3 * width * row);
    let target = &mut front[width * row..][..width];
    for (target, pixel) in target.iter_mut().zip(back.as_chunks::<3>().0) {
        *target = pixel[0];
    }
}

/// JFIF's YCbCr to RGB in 16-bit fixed point.
fn rgb_of_sums(y: i32, cb: i32, cr: i32) -> [u8; 3] {
    let (y, cb, cr) = ((y << 16) + 32_768, cb - 128, cr - 128);
    [y + 91_881 * cr, y - 22_554 * cb - 46_802 * cr, y + 116_130 * cb].map(|v| (v >> 16).clamp(0, 255) as u8)
}
