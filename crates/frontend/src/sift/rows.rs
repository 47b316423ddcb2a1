//! Kernels over rows of pixels: blurs, differences, extrema.
//!
//! Rows are padded to whole blocks of [`BLOCK`] pixels; what stands in the padding is computed like the rest and never
//! looked at.

use super::isa::{Isa, kernel};

/// Pixels that a kernel takes at once: four vectors of eight.
pub(super) const BLOCK: usize = 32;

/// Pixels in front of and behind a row that horizontal kernels may reach; more than the widest kernel's radius.
pub(super) const MARGIN: usize = 16;

/// Two rows that share a weight, as the arms of a symmetric kernel do. The middle row is a pair with itself at half
/// its weight.
#[derive(Clone, Copy)]
pub(super) struct RowPair<'a> {
    pub first: &'a [f32],
    pub second: &'a [f32],
    pub weight: f32,
}

/// Two columns that share a weight, as offsets into a row that starts [`MARGIN`] pixels before its first pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct ColumnPair {
    pub first: usize,
    pub second: usize,
    pub weight: f32,
}

kernel!(
    /// Weighted sum of rows; `out` has whole blocks and the rows are at least as long.
    blur_rows = blur_rows_body(pairs: &[RowPair<'_>], out: &mut [f32])
);
kernel!(
    /// Weighted sum of columns of `padded`, whose pixels start at [`MARGIN`].
    blur_columns = blur_columns_body(padded: &[f32], pairs: &[ColumnPair], out: &mut [f32])
);
kernel!(
    /// `out = minuend - subtrahend`.
    subtract = subtract_body(minuend: &[f32], subtrahend: &[f32], out: &mut [f32])
);
kernel!(
    /// Greys of 0 to 255 as 16-bit fixed point with 8 fractional bits, rounded to nearest even.
    to_fixed = to_fixed_body(row: &[f32], out: &mut [u16])
);
kernel!(
    /// The largest and smallest value of the 3 x 3 neighbourhood of each pixel but the first and the last.
    /// `scratch` has room for two rows.
    neighborhood = neighborhood_body(rows: [&[f32]; 3], scratch: &mut [f32], largest: &mut [f32], smallest: &mut [f32])
);
kernel!(
    /// Marks pixels whose value is beyond `threshold` and not exceeded in any of three neighbourhoods.
    mark_extrema = mark_extrema_body(row: &[f32], bounds: [(&[f32], &[f32]); 3], threshold: f32, marks: &mut [u8])
);

#[inline(always)]
fn block(row: &[f32], at: usize) -> &[f32; BLOCK] {
    row[at..].first_chunk().expect("rows are padded to whole blocks")
}

#[inline(always)]
fn blur_rows_body(pairs: &[RowPair<'_>], out: &mut [f32]) {
    for (index, out) in out.as_chunks_mut::<BLOCK>().0.iter_mut().enumerate() {
        let at = index * BLOCK;
        let mut sum = [0.0_f32; BLOCK];
        for pair in pairs {
            let (first, second) = (block(pair.first, at), block(pair.second, at));
            for lane in 0..BLOCK {
                sum[lane] = (first[lane] + second[lane]).mul_add(pair.weight, sum[lane]);
            }
        }
        *out = sum;
    }
}

#[inline(always)]
fn blur_columns_body(padded: &[f32], pairs: &[ColumnPair], out: &mut [f32]) {
    for (index, out) in out.as_chunks_mut::<BLOCK>().0.iter_mut().enumerate() {
        let at = index * BLOCK;
        let mut sum = [0.0_f32; BLOCK];
        for pair in pairs {
            let (first, second) = (block(padded, at + pair.first), block(padded, at + pair.second));
            for lane in 0..BLOCK {
                sum[lane] = (first[lane] + second[lane]).mul_add(pair.weight, sum[lane]);
            }
        }
        *out = sum;
    }
}

#[inline(always)]
fn subtract_body(minuend: &[f32], subtrahend: &[f32], out: &mut [f32]) {
    for ((out, a), b) in out.iter_mut().zip(minuend).zip(subtrahend) {
        *out = a - b;
    }
}

#[inline(always)]
fn to_fixed_body(row: &[f32], out: &mut [u16]) {
    /// Adding it leaves the value, rounded to an integer, in the low bits.
    const MAGIC: f32 = 8_388_608.0;
    for (out, value) in out.iter_mut().zip(row) {
        let scaled = value.mul_add(256.0, MAGIC);
        *out = scaled.to_bits() as u16;
    }
}

#[inline(always)]
fn larger(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

#[inline(always)]
fn smaller(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

#[inline(always)]
fn neighborhood_body(rows: [&[f32]; 3], scratch: &mut [f32], largest: &mut [f32], smallest: &mut [f32]) {
    let width = largest.len();
    let (tops, bottoms) = scratch.split_at_mut(width);
    let bottoms = &mut bottoms[..width];
    let (above, row, below) = (&rows[0][..width], &rows[1][..width], &rows[2][..width]);
    for x in 0..width {
        tops[x] = larger(larger(above[x], row[x]), below[x]);
        bottoms[x] = smaller(smaller(above[x], row[x]), below[x]);
    }
    if width < 3 {
        return;
    }
    let inner = width - 2;
    let (largest, smallest) = (&mut largest[1..=inner], &mut smallest[1..=inner]);
    for x in 0..inner {
        largest[x] = larger(larger(tops[x], tops[x + 1]), tops[x + 2]);
        smallest[x] = smaller(smaller(bottoms[x], bottoms[x + 1]), bottoms[x + 2]);
    }
}

#[inline(always)]
fn mark_extrema_body(row: &[f32], bounds: [(&[f32], &[f32]); 3], threshold: f32, marks: &mut [u8]) {
    let width = marks.len();
    let row = &row[..width];
    let [(max0, min0), (max1, min1), (max2, min2)] = bounds.map(|(max, min)| (&max[..width], &min[..width]));
    for x in 0..width {
        let value = row[x];
        let top = (value >= threshold) & (value >= max0[x]) & (value >= max1[x]) & (value >= max2[x]);
        let bottom = (value <= -threshold) & (value <= min0[x]) & (value <= min1[x]) & (value <= min2[x]);
        marks[x] = u8::from(top | bottom);
    }
}
