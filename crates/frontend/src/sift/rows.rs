//! Kernels over rows of pixels: blurs, differences, extrema.
//!
//! Brightness is held in 16 bits with [`FRACTION_BITS`] fractional bits: in rows less [`BIAS`], for the instructions that
//! multiply and add two numbers want signed ones, in planes as it is. Rows are padded to whole blocks of [`BLOCK`] pixels;
//! what stands in the padding is computed like the rest and never looked at.

use super::isa::{Isa, kernel};

pub(super) use super::weighted::BLOCK;

/// Pixels in front of and behind a row that horizontal kernels may reach; more than the widest kernel's radius.
pub(super) const MARGIN: usize = 16;

/// The most taps of a kernel.
pub(super) const MAX_TAPS: usize = 16;

/// Fractional bits of brightness.
pub(super) const FRACTION_BITS: u32 = 8;

/// What is taken from brightness in rows: half of the range, which changes one bit.
const BIAS: u16 = 1 << 15;

/// Fixed-point units of one grey level.
pub(super) const UNITS_PER_GREY: f64 = (1 << FRACTION_BITS) as f64;

kernel!(
    /// `out = minuend - subtrahend`. Differences of neighbouring levels never reach a fifth of the range.
    subtract = subtract_body(minuend: &[i16], subtrahend: &[i16], out: &mut [i16])
);
kernel!(
    /// Every value of a row, for a plane.
    to_plane = to_plane_body(row: &[i16], out: &mut [u16])
);
kernel!(
    /// Every second value of a row, for a plane.
    to_half_plane = to_half_plane_body(row: &[i16], out: &mut [u16])
);
kernel!(
    /// Values of a plane, for a row.
    from_plane = from_plane_body(values: &[u16], out: &mut [i16])
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

#[inline(always)]
fn subtract_body(minuend: &[i16], subtrahend: &[i16], out: &mut [i16]) {
    for ((out, a), b) in out.iter_mut().zip(minuend).zip(subtrahend) {
        *out = a.wrapping_sub(*b);
    }
}

#[inline(always)]
fn to_plane_body(row: &[i16], out: &mut [u16]) {
    for (out, value) in out.iter_mut().zip(row) {
        *out = *value as u16 ^ BIAS;
    }
}

#[inline(always)]
fn to_half_plane_body(row: &[i16], out: &mut [u16]) {
    for (out, pair) in out.iter_mut().zip(row.as_chunks::<2>().0) {
        *out = pair[0] as u16 ^ BIAS;
    }
}

#[inline(always)]
fn from_plane_body(values: &[u16], out: &mut [i16]) {
    for (out, value) in out.iter_mut().zip(values) {
        *out = (*value ^ BIAS) as i16;
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
        *out = ((u16::from(*pixel) << FRACTION_BITS) ^ BIAS) as i16;
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
    fn every_path_gives_the_same_bits() {
        let long: Vec<u16> =
            (0..8 * BLOCK).map(|k| (k.wrapping_mul(40_503).wrapping_mul(k + 7) >> 3) as u16).collect();
        let signed: Vec<i16> = long.iter().map(|v| *v as i16).collect();
        let bytes: Vec<u8> = long.iter().map(|v| *v as u8).collect();
        let run = |isa: Isa| {
            let mut differences = vec![0_i16; 4 * BLOCK];
            subtract(isa, &signed, &signed[9..], &mut differences);
            let mut marks = vec![0; 4 * BLOCK - 3];
            mark_extrema(isa, &std::array::from_fn(|k| &signed[k * k + k..]), 200, &mut marks);
            let mut planes = vec![vec![0; 3 * BLOCK - 1]; 2];
            to_plane(isa, &signed, &mut planes[0]);
            to_half_plane(isa, &signed, &mut planes[1]);
            let mut rows = vec![vec![0; 3 * BLOCK - 1]; 3];
            interleave(isa, &signed, &signed[5..], &mut rows[0][..2 * BLOCK]);
            to_fixed(isa, &bytes, &mut rows[1]);
            from_plane(isa, &planes[0], &mut rows[2]);
            assert_eq!(rows[2], signed[..3 * BLOCK - 1]);
            (differences, marks, planes, rows)
        };
        let oracle = run(Isa::BASELINE);
        assert!(oracle.1.contains(&1) && oracle.1.contains(&0));
        for isa in Isa::available() {
            assert_eq!(run(isa), oracle, "{isa:?}");
        }
    }
}
