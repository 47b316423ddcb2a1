//! Gradients around a keypoint, and the kernel that gathers them into a histogram of directions.

use super::isa::{Isa, kernel};
use super::math::{direction_in_eighths, exp_f32};
use super::octave::Plane;

/// Pixels that are turned into gradients at once.
const LANES: usize = 8;
/// The widest window for orientations in whole vectors: 4.5 standard deviations of at most 4.04 pixels on both sides.
const MAX_SPAN: usize = 56;

/// Bins of an orientation histogram (Lowe 2004).
pub(super) const ORIENTATION_BINS: usize = 36;
/// A place in a level of the scale space, in pixels of the plane.
#[derive(Clone, Copy)]
pub(super) struct Place<'a> {
    pub plane: &'a Plane,
    pub x: f32,
    pub y: f32,
    pub sigma: f32,
}

kernel!(
    /// Adds the gradients within 4.5 sigma, weighted by a Gaussian of 1.5 sigma, to a histogram of directions.
    gather_orientations = gather_orientations_body(place: &Place<'_>, histogram: &mut [f32; ORIENTATION_BINS])
);

/// [`LANES`] gradients, without a common factor.
struct Gradients {
    across: [f32; LANES],
    down: [f32; LANES],
}

#[inline(always)]
fn gradients(plane: &Plane, x: usize, y: usize) -> Gradients {
    let stride = plane.size.width;
    let at = y * stride + x;
    let values = |at: usize| -> &[u16; LANES] {
        plane.data[at..].first_chunk().expect("planes have slack behind them")
    };
    let (left, right) = (values(at - 1), values(at + 1));
    let (above, below) = (values(at - stride), values(at + stride));
    let mut out = Gradients { across: [0.0; LANES], down: [0.0; LANES] };
    for lane in 0..LANES {
        out.across[lane] = (i32::from(right[lane]) - i32::from(left[lane])) as f32;
        out.down[lane] = (i32::from(below[lane]) - i32::from(above[lane])) as f32;
    }
    out
}

/// Rounds a number whose size is below four million down (a whole number may also go to itself minus one), as a number
/// and as an integer.
#[inline(always)]
pub(super) fn split(value: f32) -> (f32, u32) {
    const MAGIC: f32 = 12_582_912.0;
    let shifted = (value - 0.5) + MAGIC;
    (shifted - MAGIC, shifted.to_bits().wrapping_sub(MAGIC.to_bits()))
}

/// Weights of columns from `first` on: a Gaussian around `center`.
#[inline(always)]
fn column_weights(first: i32, center: f32, falloff: f32) -> [f32; MAX_SPAN] {
    let mut weights = [0.0; MAX_SPAN];
    let start = first as f32 - center;
    for (k, weight) in weights.iter_mut().enumerate() {
        let distance = start + k as f32;
        let exponent = distance * distance * falloff;
        *weight = exp_f32(if exponent < -80.0 { -80.0 } else { exponent });
    }
    weights
}

/// The rows or columns within `radius` of a place that have neighbours on both sides.
#[inline(always)]
fn range(center: f32, radius: f32, len: usize) -> (i32, i32) {
    let low = (center - radius).max(0.0) as i32;
    let high = (center + radius) as i32 + 1;
    (low.max(1), high.min(len as i32 - 2))
}

#[inline(always)]
fn gather_orientations_body(place: &Place<'_>, histogram: &mut [f32; ORIENTATION_BINS]) {
    let Place { plane, x, y, sigma } = *place;
    let radius = 4.5 * sigma;
    let falloff = -0.5 / (2.25 * sigma * sigma);
    let (first_column, _) = range(x, radius, plane.size.width);
    let (first_row, last_row) = range(y, radius, plane.size.height);
    let weights = column_weights(first_column, x, falloff);
    // Two rounds: directions are offset by one round less half a bin.
    let mut rounds = [0.0_f32; 2 * ORIENTATION_BINS + 2];
    for row in first_row..=last_row {
        let dy = row as f32 - y;
        let chord = radius * radius - dy * dy;
        if chord < 0.0 {
            continue;
        }
        let (low, high) = range(x, chord.sqrt(), plane.size.width);
        let row_weight = exp_f32(dy * dy * falloff);
        let mut column = low.max(first_column);
        while column <= high {
            let gradients = gradients(plane, column as usize, row as usize);
            let offset = (column - first_column) as usize;
            let column_weights: &[f32; LANES] =
                weights[offset.min(MAX_SPAN - LANES)..].first_chunk().expect("in range");
            let (mut bins, mut near, mut far) = ([0_u32; LANES], [0.0_f32; LANES], [0.0_f32; LANES]);
            for lane in 0..LANES {
                let (dx, dy) = (gradients.across[lane], gradients.down[lane]);
                let bin = direction_in_eighths(dx, dy).mul_add(ORIENTATION_BINS as f32 / 8.0, 35.5);
                let (whole, index) = split(bin);
                let weight = (dx * dx + dy * dy).sqrt() * (column_weights[lane] * row_weight);
                far[lane] = (bin - whole) * weight;
                near[lane] = weight - far[lane];
                bins[lane] = index;
            }
            let count = ((high - column + 1) as usize).min(LANES);
            for lane in 0..count {
                let bin = (bins[lane] as usize).min(2 * ORIENTATION_BINS);
                rounds[bin] += near[lane];
                rounds[bin + 1] += far[lane];
            }
            column += LANES as i32;
        }
    }
    for (k, value) in rounds.iter().enumerate() {
        histogram[k % ORIENTATION_BINS] += value;
    }
}
