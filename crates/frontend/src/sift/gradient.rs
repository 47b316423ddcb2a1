//! Gradients around a keypoint, and the kernels that gather them into histograms.

use super::isa::{Isa, kernel};
use super::math::{direction_in_eighths, exp_f32};
use super::octave::Plane;

/// Pixels that are turned into gradients at once.
const LANES: usize = 8;
/// The widest window for orientations in whole vectors: 4.5 standard deviations of at most 4.04 pixels on both sides.
const MAX_SPAN: usize = 56;

/// Bins of an orientation histogram (Lowe 2004).
pub(super) const ORIENTATION_BINS: usize = 36;
/// Cells of a descriptor along one axis, and directions in each (Lowe 2004).
pub(super) const CELLS: usize = 4;
pub(super) const DIRECTIONS: usize = 8;

/// A descriptor while it is gathered: cells with a rim of one on each side.
pub(super) const RIMMED_CELLS: usize = CELLS + 2;

/// Cells of a descriptor with its rim, row after row, and the directions of each.
pub(super) type Gathered = [[f32; DIRECTIONS]; RIMMED_CELLS * RIMMED_CELLS];

/// A place in a level of the scale space, in pixels of the plane.
#[derive(Clone, Copy)]
pub(super) struct Place<'a> {
    pub plane: &'a Plane,
    pub x: f32,
    pub y: f32,
    pub sigma: f32,
}

/// The axes of a descriptor.
#[derive(Clone, Copy)]
pub(super) struct Frame {
    /// From pixels of the plane, relative to the place, to cells, relative to the middle.
    pub cells_from_px: [[f32; 2]; 2],
    /// From gradients of the plane to gradients along the cells' axes, up to a common factor.
    pub gradient: [[f32; 2]; 2],
}

kernel!(
    /// Adds the gradients within 4.5 sigma, weighted by a Gaussian of 1.5 sigma, to a histogram of directions.
    gather_orientations = gather_orientations_body(place: &Place<'_>, histogram: &mut [f32; ORIENTATION_BINS])
);
kernel!(
    /// Adds the gradients of a descriptor's window, trilinearly interpolated between cells and directions and weighted by
    /// a Gaussian of two cells.
    gather_descriptor = gather_descriptor_body(place: &Place<'_>, frame: &Frame, histogram: &mut Gathered)
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

/// Rounds a number between -1000 and 1000 down (a whole number may also go to itself minus one), as a number and as
/// an integer.
#[inline(always)]
fn split(value: f32) -> (f32, u32) {
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

/// Half a descriptor's window with its rim, in cells.
const REACH: f32 = 2.5;

/// The part of a row, as offsets from the place, that lies in a descriptor's window.
#[inline(always)]
fn chord(frame: &Frame, dy: f32) -> (f32, f32) {
    let (mut low, mut high) = (-1e4_f32, 1e4_f32);
    for [along, across] in frame.cells_from_px {
        let across = across * dy;
        if along.abs() > 1e-6 {
            let (a, b) = ((-REACH - across) / along, (REACH - across) / along);
            low = low.max(a.min(b));
            high = high.min(a.max(b));
        } else if across.abs() > REACH {
            high = low - 1.0;
        }
    }
    (low, high)
}

#[inline(always)]
fn gather_descriptor_body(place: &Place<'_>, frame: &Frame, histogram: &mut Gathered) {
    let Place { plane, x, y, .. } = *place;
    let [[a, b], [c, d]] = frame.cells_from_px;
    let per_determinant = REACH / (a * d - b * c).abs();
    let (reach_x, reach_y) = ((b.abs() + d.abs()) * per_determinant, (a.abs() + c.abs()) * per_determinant);
    let (first_column, last_column) = range(x, reach_x, plane.size.width);
    let (first_row, last_row) = range(y, reach_y, plane.size.height);
    let mut pending = Pending::default();
    for row in first_row..=last_row {
        let dy = row as f32 - y;
        let (low, high) = chord(frame, dy);
        let low = ((x + low).max(0.0) as i32).max(first_column);
        let high = ((x + high).min(1e6) as i32 + 1).min(last_column);
        let mut column = low;
        while column <= high {
            let gradients = gradients(plane, column as usize, row as usize);
            let samples = Samples::new(&gradients, frame, (column as f32 - x, dy));
            for lane in 0..((high - column + 1) as usize).min(LANES) {
                pending.add(&samples, lane, histogram);
            }
            column += LANES as i32;
        }
    }
    pending.flush(histogram);
}

/// Where gradients fall in a descriptor's histogram.
struct Samples {
    /// The upper left of four cells.
    cell: [u32; LANES],
    /// The lower of two directions.
    direction: [u32; LANES],
    weight: [f32; LANES],
    across: [f32; LANES],
    down: [f32; LANES],
    around: [f32; LANES],
}

impl Samples {
    #[inline(always)]
    fn new(gradients: &Gradients, frame: &Frame, (dx, dy): (f32, f32)) -> Self {
        let zeros = [0.0_f32; LANES];
        let none = [0; LANES];
        let mut out =
            Self { cell: none, direction: none, weight: zeros, across: zeros, down: zeros, around: zeros };
        // From the middle of the window to the rim's first cell.
        const SHIFT: f32 = (RIMMED_CELLS as f32 - 1.0) / 2.0;
        const LAST: f32 = RIMMED_CELLS as f32 - 1.001;
        let [[a, b], [c, d]] = frame.cells_from_px;
        let [[e, f], [g, h]] = frame.gradient;
        for lane in 0..LANES {
            let dx = dx + lane as f32;
            let (column, row) = (a.mul_add(dx, b * dy), c.mul_add(dx, d * dy));
            // A Gaussian of two cells.
            let exponent = (column * column + row * row) * -0.125;
            let weight = exp_f32(if exponent < -80.0 { -80.0 } else { exponent });
            let (column, row) = (column + SHIFT, row + SHIFT);
            let inside = (column > 0.0) & (column < LAST) & (row > 0.0) & (row < LAST);
            let (column, row) = if inside { (column, row) } else { (1.0, 1.0) };
            let (gx, gy) = (gradients.across[lane], gradients.down[lane]);
            let (gx, gy) = (e.mul_add(gx, f * gy), g.mul_add(gx, h * gy));
            let (column_whole, column_index) = split(column);
            let (row_whole, row_index) = split(row);
            let turn = direction_in_eighths(gx, gy);
            let (turn_whole, turn_index) = split(turn);
            let weight = (gx * gx + gy * gy).sqrt() * weight;
            out.weight[lane] = if inside { weight } else { 0.0 };
            out.across[lane] = column - column_whole;
            out.down[lane] = row - row_whole;
            out.around[lane] = turn - turn_whole;
            out.cell[lane] = row_index.wrapping_mul(RIMMED_CELLS as u32).wrapping_add(column_index);
            out.direction[lane] = turn_index;
        }
        out
    }
}

/// One for each direction, and the first again after the last.
const DIRECTION_MASKS: [[f32; DIRECTIONS]; DIRECTIONS + 2] = {
    let mut masks = [[0.0; DIRECTIONS]; DIRECTIONS + 2];
    let mut k = 0;
    while k < DIRECTIONS + 2 {
        masks[k][k % DIRECTIONS] = 1.0;
        k += 1;
    }
    masks
};

/// What neighbouring samples add to the same four cells, so that it waits in registers.
#[derive(Default)]
struct Pending {
    cell: usize,
    cells: [[f32; DIRECTIONS]; 4],
}

impl Pending {
    /// The upper left cells' largest index whose four cells exist.
    const LAST_CELL: usize = RIMMED_CELLS * RIMMED_CELLS - RIMMED_CELLS - 2;

    #[inline(always)]
    fn add(&mut self, samples: &Samples, lane: usize, histogram: &mut Gathered) {
        let cell = (samples.cell[lane] as usize).min(Self::LAST_CELL);
        if cell != self.cell {
            self.flush(histogram);
            self.cell = cell;
            self.cells = Default::default();
        }
        let direction = (samples.direction[lane] as usize).min(DIRECTIONS);
        let far = samples.weight[lane] * samples.around[lane];
        let near = samples.weight[lane] - far;
        let (first, second) = (&DIRECTION_MASKS[direction], &DIRECTION_MASKS[direction + 1]);
        let mut values = [0.0; DIRECTIONS];
        for k in 0..DIRECTIONS {
            values[k] = near * first[k] + far * second[k];
        }
        let (across, down) = (samples.across[lane], samples.down[lane]);
        let lower_right = across * down;
        let (upper_right, lower_left) = (across - lower_right, down - lower_right);
        let shares = [1.0 - across - lower_left, upper_right, lower_left, lower_right];
        for (cell, share) in self.cells.iter_mut().zip(shares) {
            for k in 0..DIRECTIONS {
                cell[k] = values[k].mul_add(share, cell[k]);
            }
        }
    }

    #[inline(always)]
    fn flush(&self, histogram: &mut Gathered) {
        let upper_left = self.cell;
        let places = [0, 1, RIMMED_CELLS, RIMMED_CELLS + 1].map(|offset| upper_left + offset);
        for (place, cell) in places.into_iter().zip(&self.cells) {
            for k in 0..DIRECTIONS {
                histogram[place][k] += cell[k];
            }
        }
    }
}
