//! Gaussian kernels and the first image of the scale space.

use super::isa::Isa;
use super::math::exp;
use super::rows::{ColumnPair, MARGIN, RowPair, blur_columns, blur_rows};

/// One half of a symmetric kernel: the weights of pixels at distances `start`, `start + 1`, …, where `start` is 0 or ½.
///
/// Kernels are cut off at four standard deviations and add up to one.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Taps {
    /// True when the kernel's centre lies halfway between two pixels.
    pub between: bool,
    /// Weights by distance; of a kernel that is centred on a pixel the first is halved, for it counts twice.
    pub weights: Vec<f32>,
}

impl Taps {
    /// A Gaussian of a standard deviation in pixels, at most 4.
    pub(super) fn gaussian(sigma_px: f64, between: bool) -> Self {
        let start = if between { 0.5 } else { 0.0 };
        let count = ((4.0 * sigma_px - start).ceil().max(0.0) as usize + 1).min(MARGIN);
        let mut weights: Vec<f64> = (0..count)
            .map(|k| {
                let distance = (k as f64 + start) / sigma_px;
                exp(-0.5 * distance * distance)
            })
            .collect();
        if !between {
            weights[0] *= 0.5;
        }
        let sum: f64 = 2.0 * weights.iter().sum::<f64>();
        Self { between, weights: weights.into_iter().map(|w| (w / sum) as f32).collect() }
    }

    /// How many rows before the centre's (rounded down) the kernel needs; after it, one more when it lies between.
    pub(super) fn radius(&self) -> usize {
        self.weights.len() - 1
    }

    /// The pairs of rows around `center`; `row` maps a row number, possibly outside the image, to pixels.
    pub(super) fn rows<'a>(&self, center: usize, row: impl Fn(isize) -> &'a [f32]) -> Vec<RowPair<'a>> {
        let center = center as isize;
        let shift = isize::from(self.between);
        let pair = |(k, &weight): (usize, &f32)| {
            let k = k as isize;
            RowPair { first: row(center - k), second: row(center + k + shift), weight }
        };
        self.weights.iter().enumerate().map(pair).collect()
    }

    /// The pairs of columns of a padded row.
    pub(super) fn columns(&self) -> Vec<ColumnPair> {
        let shift = usize::from(self.between);
        let pair = |(k, &weight): (usize, &f32)| ColumnPair {
            first: MARGIN - k,
            second: MARGIN + k + shift,
            weight,
        };
        self.weights.iter().enumerate().map(pair).collect()
    }
}

/// Repeats the first and the last of `width` pixels, which start at [`MARGIN`], into the margins.
pub(super) fn fill_margins(padded: &mut [f32], width: usize) {
    let first = padded[MARGIN];
    padded[..MARGIN].fill(first);
    let last = padded[MARGIN + width - 1];
    padded[MARGIN + width..].fill(last);
}

/// A separable blur of one standard deviation.
pub(super) struct Blur {
    /// Weights along columns.
    pub taps: Taps,
    columns: Vec<ColumnPair>,
}

impl Blur {
    pub(super) fn new(taps: Taps) -> Self {
        let columns = taps.columns();
        Self { taps, columns }
    }

    /// One row of the blurred image into `out`, from rows around `center`.
    pub(super) fn row<'a>(
        &self,
        isa: Isa,
        (center, width): (usize, usize),
        row: impl Fn(isize) -> &'a [f32],
        (padded, out): (&mut [f32], &mut [f32]),
    ) {
        let stride = out.len();
        blur_rows(isa, &self.taps.rows(center, row), &mut padded[MARGIN..MARGIN + stride]);
        fill_margins(padded, width);
        blur_columns(isa, padded, &self.columns, out);
    }
}
