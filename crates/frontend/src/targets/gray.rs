//! Grey values in single precision: smoothed, halved, sampled between pixels.

use nalgebra::Vector2;
use rayon::prelude::*;

use crate::image::GrayImage;

/// One channel, row after row; the first pixel's centre is at (0.5, 0.5).
#[derive(Clone, Debug)]
pub(super) struct FloatImage {
    pub width: usize,
    pub height: usize,
    pub data: Vec<f32>,
}

impl FloatImage {
    pub fn new(image: &GrayImage) -> Self {
        let data = image.data.iter().map(|&value| f32::from(value)).collect();
        Self { width: image.width, height: image.height, data }
    }

    #[inline]
    pub fn at(&self, column: usize, row: usize) -> f32 {
        self.data[row * self.width + column]
    }

    /// Smoothed by (1 4 6 4 1) / 16 both ways: a Gaussian of one pixel. Border pixels are repeated.
    pub fn smoothed(&self) -> Self {
        let (width, height) = (self.width, self.height);
        let mut across = vec![0.0f32; self.data.len()];
        across.par_chunks_mut(width.max(1)).zip(self.data.par_chunks(width.max(1))).for_each(|(out, row)| {
            for x in 0..width {
                let at = |d: isize| row[x.saturating_add_signed(d).min(width - 1)];
                out[x] = (6.0 * at(0) + 4.0 * (at(-1) + at(1)) + (at(-2) + at(2))) / 16.0;
            }
        });
        let mut data = vec![0.0f32; self.data.len()];
        data.par_chunks_mut(width.max(1)).enumerate().for_each(|(y, out)| {
            let row = |d: isize| &across[y.saturating_add_signed(d).min(height - 1) * width..][..width];
            let rows = [row(-2), row(-1), row(0), row(1), row(2)];
            for x in 0..width {
                let (far, near) = (rows[0][x] + rows[4][x], rows[1][x] + rows[3][x]);
                out[x] = (6.0 * rows[2][x] + 4.0 * near + far) / 16.0;
            }
        });
        Self { width, height, data }
    }

    /// Half as many columns and rows, each pixel the mean of four; `None` when nothing would be left.
    pub fn halved(&self) -> Option<Self> {
        let (width, height) = (self.width / 2, self.height / 2);
        if width == 0 || height == 0 {
            return None;
        }
        let mut data = vec![0.0f32; width * height];
        data.par_chunks_mut(width).enumerate().for_each(|(y, out)| {
            for (x, value) in out.iter_mut().enumerate() {
                let (x, y) = (2 * x, 2 * y);
                let sum = self.at(x, y) + self.at(x + 1, y) + self.at(x, y + 1) + self.at(x + 1, y + 1);
                *value = 0.25 * sum;
            }
        });
        Some(Self { width, height, data })
    }

    /// Whether a point lies at least `margin_px` within the image.
    pub fn holds(&self, xy_px: &Vector2<f64>, margin_px: f64) -> bool {
        xy_px.x >= margin_px
            && xy_px.y >= margin_px
            && xy_px.x <= self.width as f64 - margin_px
            && xy_px.y <= self.height as f64 - margin_px
    }

    /// Bilinear interpolation; border pixels are repeated.
    pub fn sample(&self, xy_px: &Vector2<f64>) -> f64 {
        let x = (xy_px.x - 0.5).clamp(0.0, self.width.saturating_sub(1) as f64);
        let y = (xy_px.y - 0.5).clamp(0.0, self.height.saturating_sub(1) as f64);
        let (column, row) = (x as usize, y as usize);
        let (right, below) = ((column + 1).min(self.width - 1), (row + 1).min(self.height - 1));
        let (a, b) = (x - column as f64, y - row as f64);
        let value = |column, row| f64::from(self.at(column, row));
        let above = value(column, row) * (1.0 - a) + value(right, row) * a;
        let under = value(column, below) * (1.0 - a) + value(right, below) * a;
        above * (1.0 - b) + under * b
    }
}
