//! Kernels over rows of pixels: blurs, differences, extrema.
//!
//! Brightness is held in 16 bits with [`FRACTION_BITS`] fractional bits, around mid-grey, and weights as parts of 32,768: a
//! product is rounded to nearest as it is formed, and a sum of them can't overflow, for weights are positive and add up to
//! one. Rows are padded to whole blocks of [`BLOCK`] pixels; what stands in the padding is computed like the rest and
//! never looked at.

use super::isa::{Isa, kernel};

/// Pixels that a kernel takes at once: four vectors of sixteen.
pub(super) const BLOCK: usize = 64;

/// Pixels in front of and behind a row that horizontal kernels may reach; more than the widest kernel's radius.
pub(super) const MARGIN: usize = 16;

/// The most taps of a kernel.
pub(super) const MAX_TAPS: usize = 16;

/// Fractional bits of brightness.
pub(super) const FRACTION_BITS: u32 = 8;

/// Fixed-point units of one grey level.
pub(super) const UNITS_PER_GREY: f64 = (1 << FRACTION_BITS) as f64;

kernel!(
    /// Weighted sum of rows; `out` has whole blocks and the rows are at least as long.
    blur_rows = blur_rows_body(rows: &[&[i16]], weights: &[i16], out: &mut [i16])
);
kernel!(
    /// Weighted sum of columns of `padded` at `offsets` from each pixel of `out`.
    blur_columns = blur_columns_body(padded: &[i16], offsets: &[usize], weights: &[i16], out: &mut [i16])
);
kernel!(
    /// `out = minuend - subtrahend`. Differences of neighbouring levels never reach a fifth of the range.
    subtract = subtract_body(minuend: &[i16], subtrahend: &[i16], out: &mut [i16])
);
kernel!(
    /// Every second value.
    halve = halve_body(row: &[i16], out: &mut [i16])
);
kernel!(
    /// Puts even and odd columns together.
    interleave = interleave_body(even: &[i16], odd: &[i16], out: &mut [i16])
);
kernel!(
    /// Bytes as fixed point.
    to_fixed = to_fixed_body(pixels: &[u8], out: &mut [i16])
);
kernel!(
    /// Marks the inner pixels whose value is beyond `threshold` and beyond or level with all six neighbours: those left,
    /// right, above and below, and those in the differences before and after.
    mark_extrema = mark_extrema_body(rows: &[&[i16]; 5], threshold: i16, marks: &mut [u8])
);

/// `value * weight / 32768`, rounded to nearest: one instruction of most processors.
#[inline(always)]
fn scaled(value: i16, weight: i16) -> i16 {
    ((((i32::from(value) * i32::from(weight)) >> 14) + 1) >> 1) as i16
}

#[inline(always)]
fn block(row: &[i16], at: usize) -> &[i16; BLOCK] {
    row[at..].first_chunk().expect("rows are padded to whole blocks")
}

#[inline(always)]
fn blur_rows_body(rows: &[&[i16]], weights: &[i16], out: &mut [i16]) {
    for (index, out) in out.as_chunks_mut::<BLOCK>().0.iter_mut().enumerate() {
        let at = index * BLOCK;
        let mut sum = [0_i16; BLOCK];
        for (row, weight) in rows.iter().zip(weights) {
            let values = block(row, at);
            for lane in 0..BLOCK {
                sum[lane] = sum[lane].wrapping_add(scaled(values[lane], *weight));
            }
        }
        *out = sum;
    }
}

#[inline(always)]
fn blur_columns_body(padded: &[i16], offsets: &[usize], weights: &[i16], out: &mut [i16]) {
    for (index, out) in out.as_chunks_mut::<BLOCK>().0.iter_mut().enumerate() {
        let at = index * BLOCK;
        let mut sum = [0_i16; BLOCK];
        for (offset, weight) in offsets.iter().zip(weights) {
            let values = block(padded, at + offset);
            for lane in 0..BLOCK {
                sum[lane] = sum[lane].wrapping_add(scaled(values[lane], *weight));
            }
        }
        *out = sum;
    }
}

#[inline(always)]
fn subtract_body(minuend: &[i16], subtrahend: &[i16], out: &mut [i16]) {
    for ((out, a), b) in out.iter_mut().zip(minuend).zip(subtrahend) {
        *out = a.wrapping_sub(*b);
    }
}

#[inline(always)]
fn halve_body(row: &[i16], out: &mut [i16]) {
    for (out, pair) in out.iter_mut().zip(row.as_chunks::<2>().0) {
        *out = pair[0];
    }
}

#[inline(always)]
fn interleave_body(even: &[i16], odd: &[i16], out: &mut [i16]) {
    for ((pair, even), odd) in out.as_chunks_mut::<2>().0.iter_mut().zip(even).zip(odd) {
        *pair = [*even, *odd];
    }
}

#[inline(always)]
fn to_fixed_body(pixels: &[u8], out: &mut [i16]) {
    for (out, pixel) in out.iter_mut().zip(pixels) {
        *out = (i16::from(*pixel) - 128) << FRACTION_BITS;
    }
}

#[inline(always)]
fn mark_extrema_body(rows: &[&[i16]; 5], threshold: i16, marks: &mut [u8]) {
    let Some(inner) = marks.len().checked_sub(2).filter(|&inner| inner > 0) else { return };
    let [above, row, below, before, after] = *rows;
    let (left, row, right) = (&row[..inner], &row[1..=inner], &row[2..inner + 2]);
    let (above, below) = (&above[1..=inner], &below[1..=inner]);
    let (before, after) = (&before[1..=inner], &after[1..=inner]);
    let marks = &mut marks[1..=inner];
    for x in 0..inner {
        let value = row[x];
        let largest = left[x].max(right[x]).max(above[x].max(below[x])).max(before[x].max(after[x]));
        let smallest = left[x].min(right[x]).min(above[x].min(below[x])).min(before[x].min(after[x]));
        let is_top = (value >= threshold) & (value >= largest);
        let is_bottom = (value <= -threshold) & (value <= smallest);
        marks[x] = u8::from(is_top | is_bottom);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_path_gives_the_same_bits_at_the_ends_of_the_range() {
        let extremes = [i16::MIN, i16::MIN + 1, -1, 0, 1, 32_512, i16::MAX];
        let value = |k: usize| match k % 3 {
            0 => extremes[(k / 3) % extremes.len()],
            _ => (k.wrapping_mul(40_503).wrapping_mul(k + 7) >> 3) as i16,
        };
        let long: Vec<i16> = (0..8 * BLOCK).map(value).collect();
        let weights: Vec<i16> = vec![1, 333, 7000, 18_100, 7000, 333, 1];
        assert_eq!(weights.iter().map(|w| i32::from(*w)).sum::<i32>(), 32_768);
        let rows: Vec<&[i16]> = (0..weights.len()).map(|k| &long[5 * k..]).collect();
        let offsets: Vec<usize> = (0..weights.len()).map(|k| 3 * k + 1).collect();
        let run = |isa: Isa| {
            let mut outs = vec![vec![0_i16; 4 * BLOCK]; 3];
            blur_rows(isa, &rows, &weights, &mut outs[0]);
            blur_columns(isa, &long, &offsets, &weights, &mut outs[1]);
            subtract(isa, &long, &long[9..], &mut outs[2]);
            let mut marks = vec![0; 4 * BLOCK - 3];
            mark_extrema(isa, &std::array::from_fn(|k| &long[k * k + k..]), 200, &mut marks);
            (outs, marks)
        };
        let oracle = run(Isa::BASELINE);
        assert!(oracle.1.contains(&1) && oracle.1.contains(&0));
        for isa in Isa::available() {
            assert_eq!(run(isa), oracle, "{isa:?}");
        }
    }

    #[test]
    fn a_level_image_stays_level_at_both_ends_of_the_range() {
        let weights = [9000, 14_768, 9000];
        for value in [-32_768, -32_767, 0, 32_511, 32_512] {
            let row = vec![value; BLOCK];
            let mut out = vec![0; BLOCK];
            blur_rows(Isa::BASELINE, &[&row, &row, &row], &weights, &mut out);
            assert!(out.iter().all(|v| (i32::from(*v) - i32::from(value)).abs() <= 1), "{value} {}", out[0]);
        }
    }
}
