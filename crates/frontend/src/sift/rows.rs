//! Kernels over rows of pixels: blurs, differences, extrema.
//!
//! Brightness is held in 16 bits with [`FRACTION_BITS`] fractional bits and weights as parts of 65,536. The upper half of
//! a product is one instruction of most processors; it is rounded down, so that sums start at half a unit a tap. They
//! can't overflow, for weights add up to one and the brightest grey leaves room. Rows are padded to whole blocks of
//! [`BLOCK`] pixels; what stands in the padding is computed like the rest and never looked at.

use super::isa::{Isa, kernel};

pub(super) use super::weighted::BLOCK;

/// Pixels in front of and behind a row that horizontal kernels may reach; more than the widest kernel's radius.
pub(super) const MARGIN: usize = 16;

/// The most taps of a kernel.
pub(super) const MAX_TAPS: usize = 16;

/// Fractional bits of brightness.
pub(super) const FRACTION_BITS: u32 = 8;

/// Fixed-point units of one grey level.
pub(super) const UNITS_PER_GREY: f64 = (1 << FRACTION_BITS) as f64;

kernel!(
    /// `out = minuend - subtrahend`. Differences of neighbouring levels never reach a fifth of the range.
    subtract = subtract_body(minuend: &[u16], subtrahend: &[u16], out: &mut [i16])
);
kernel!(
    /// Every second value.
    halve = halve_body(row: &[u16], out: &mut [u16])
);
kernel!(
    /// Puts even and odd columns together.
    interleave = interleave_body(even: &[u16], odd: &[u16], out: &mut [u16])
);
kernel!(
    /// Bytes as fixed point.
    to_fixed = to_fixed_body(pixels: &[u8], out: &mut [u16])
);
kernel!(
    /// Marks the inner pixels whose value is beyond `threshold` and beyond or level with all six neighbours: those left,
    /// right, above and below, and those in the differences before and after.
    mark_extrema = mark_extrema_body(rows: &[&[i16]; 5], threshold: i16, marks: &mut [u8])
);

#[inline(always)]
fn subtract_body(minuend: &[u16], subtrahend: &[u16], out: &mut [i16]) {
    for ((out, a), b) in out.iter_mut().zip(minuend).zip(subtrahend) {
        *out = a.wrapping_sub(*b) as i16;
    }
}

#[inline(always)]
fn halve_body(row: &[u16], out: &mut [u16]) {
    for (out, pair) in out.iter_mut().zip(row.as_chunks::<2>().0) {
        *out = pair[0];
    }
}

#[inline(always)]
fn interleave_body(even: &[u16], odd: &[u16], out: &mut [u16]) {
    for ((pair, even), odd) in out.as_chunks_mut::<2>().0.iter_mut().zip(even).zip(odd) {
        *pair = [*even, *odd];
    }
}

#[inline(always)]
fn to_fixed_body(pixels: &[u8], out: &mut [u16]) {
    for (out, pixel) in out.iter_mut().zip(pixels) {
        *out = u16::from(*pixel) << FRACTION_BITS;
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
            subtract(isa, &long, &long[9..], &mut differences);
            let mut marks = vec![0; 4 * BLOCK - 3];
            mark_extrema(isa, &std::array::from_fn(|k| &signed[k * k + k..]), 200, &mut marks);
            let mut rows = vec![vec![0; 3 * BLOCK - 1]; 3];
            halve(isa, &long, &mut rows[0]);
            interleave(isa, &long, &long[5..], &mut rows[1][..2 * BLOCK]);
            to_fixed(isa, &bytes, &mut rows[2]);
            (differences, marks, rows)
        };
        let oracle = run(Isa::BASELINE);
        assert!(oracle.1.contains(&1) && oracle.1.contains(&0));
        for isa in Isa::available() {
            assert_eq!(run(isa), oracle, "{isa:?}");
        }
    }
}
