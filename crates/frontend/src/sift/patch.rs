//! A descriptor's window, sampled on a grid that turns with the keypoint (Lowe 2004 took sixteen by sixteen samples).
//!
//! The grid lies along the descriptor's axes, so that each sample's place among the cells, and with it its weight in
//! them, is the same for every keypoint. Samples are three quarters of the keypoint's scale apart: a level's blur leaves nothing
//! between them.

use super::gradient::{Place, split};
use super::isa::{Isa, kernel};
use super::math::{direction_in_eighths, exp_f32};

/// Cells of a descriptor along one axis, and directions in each (Lowe 2004).
pub(super) const CELLS: usize = 4;
pub(super) const DIRECTIONS: usize = 8;
/// Samples of a cell along one axis.
pub(super) const PER_CELL: usize = 4;

/// Samples of the window along one axis: half a cell around the descriptor's still counts for the nearest.
const SAMPLES: usize = (CELLS + 1) * PER_CELL;
/// Lanes that they fill, in whole vectors.
const LANES: usize = SAMPLES.next_multiple_of(8);
/// Rows of brightness: gradients look at both neighbours.
const ROWS: usize = SAMPLES + 2;
/// Columns of brightness, likewise.
const COLUMNS: usize = (LANES + 2).next_multiple_of(8);

/// A descriptor while it is gathered, cells row after row.
pub(super) type Cells = [[f32; DIRECTIONS]; CELLS * CELLS];

/// From one sample to the next along a descriptor's rows, in pixels of the plane; along its columns is a quarter turn further.
#[derive(Clone, Copy)]
pub(super) struct Step {
    pub x: f32,
    pub y: f32,
}

kernel!(
    /// Adds the gradients of a descriptor's window, trilinearly interpolated between cells and directions and weighted by
    /// a Gaussian of two cells.
    gather_descriptor = gather_descriptor_body(place: &Place<'_>, step: &Step, cells: &mut Cells)
);

/// How far from the first and the last pixel places are kept.
const EDGE: f32 = 0.001;

/// Brightness at the samples and around them, and which samples have pixels on all sides.
struct Window {
    values: [[f32; COLUMNS]; ROWS],
    inside: [[f32; LANES]; SAMPLES],
}

/// How far a number of the grid is from its middle.
#[inline(always)]
fn from_middle(k: usize) -> f32 {
    k as f32 - 0.5 * (ROWS as f32 - 1.0)
}

#[inline(always)]
fn window(place: &Place<'_>, step: &Step) -> Window {
    let mut window = Window { values: [[0.0; COLUMNS]; ROWS], inside: [[0.0; LANES]; SAMPLES] };
    let size = place.plane.size;
    let (last_x, last_y) = (size.width as f32 - 1.0, size.height as f32 - 1.0);
    for row in 0..ROWS {
        let down = from_middle(row);
        let (start_x, start_y) = (place.x - step.y * down, place.y + step.x * down);
        let (mut column, mut line) = ([0_u32; COLUMNS], [0_u32; COLUMNS]);
        let (mut across, mut along) = ([0.0_f32; COLUMNS], [0.0_f32; COLUMNS]);
        let mut inside = [0.0_f32; COLUMNS];
        for k in 0..COLUMNS {
            let right = from_middle(k);
            let (x, y) = (step.x.mul_add(right, start_x), step.y.mul_add(right, start_y));
            let is_inside = (x >= 1.0) & (x <= last_x - 1.0) & (y >= 1.0) & (y <= last_y - 1.0);
            inside[k] = if is_inside { 1.0 } else { 0.0 };
            // Off the first and the last pixel, so that there is one on both sides.
            let (x, y) = (x.max(EDGE).min(last_x - EDGE), y.max(EDGE).min(last_y - EDGE));
            let (whole_x, whole_y);
            (whole_x, column[k]) = split(x);
            (whole_y, line[k]) = split(y);
            (across[k], along[k]) = (x - whole_x, y - whole_y);
        }
        // Two neighbours at a time; all else is done in vectors.
        let (mut upper, mut lower) = ([0_u32; COLUMNS], [0_u32; COLUMNS]);
        for k in 0..COLUMNS {
            let at = line[k] as usize * size.width + column[k] as usize;
            let pair = |at: usize| -> u32 {
                let [left, right]: [u16; 2] =
                    *place.plane.data[at..].first_chunk().expect("planes have slack behind them");
                u32::from(left) | u32::from(right) << 16
            };
            (upper[k], lower[k]) = (pair(at), pair(at + size.width));
        }
        for k in 0..COLUMNS {
            let between = |pair: u32| {
                let (left, right) = ((pair & 0xffff) as i32 as f32, (pair >> 16) as i32 as f32);
                (right - left).mul_add(across[k], left)
            };
            let (above, below) = (between(upper[k]), between(lower[k]));
            window.values[row][k] = (below - above).mul_add(along[k], above);
        }
        if (1..=SAMPLES).contains(&row) {
            window.inside[row - 1].copy_from_slice(&inside[1..=LANES]);
        }
    }
    window
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

/// A Gaussian of two cells.
#[inline(always)]
fn falloff() -> [f32; LANES] {
    std::array::from_fn(|k| {
        let cells = from_middle(k + 1) / PER_CELL as f32;
        exp_f32(cells * cells * -0.125)
    })
}

/// The part of a sample that goes to the later of the two cells that it lies between.
#[inline(always)]
fn later_share(sample: usize) -> f32 {
    ((sample % PER_CELL) as f32 + 0.5) / PER_CELL as f32
}

#[inline(always)]
fn gather_descriptor_body(place: &Place<'_>, step: &Step, cells: &mut Cells) {
    let window = window(place, step);
    let falloff = falloff();
    for row in 0..SAMPLES {
        let gathered = gather_row(&window, row, &falloff);
        // Rows of samples lie between rows of cells, of which the first and the last stand outside.
        let (later, share) = (row / PER_CELL, later_share(row));
        for (row, share) in [(later.checked_sub(1), 1.0 - share), (Some(later), share)] {
            let Some(cells) = row.and_then(|row| cells.as_chunks_mut::<CELLS>().0.get_mut(row)) else {
                continue;
            };
            for (cell, gathered) in cells.iter_mut().zip(&gathered[1..=CELLS]) {
                for k in 0..DIRECTIONS {
                    cell[k] = gathered[k].mul_add(share, cell[k]);
                }
            }
        }
    }
}

/// A row of samples in the cells that it crosses, one outside on both sides included.
#[inline(always)]
fn gather_row(window: &Window, row: usize, falloff: &[f32; LANES]) -> [[f32; DIRECTIONS]; CELLS + 2] {
    let [above, middle, below] = [0, 1, 2].map(|k| &window.values[row + k]);
    let inside = &window.inside[row];
    let (mut direction, mut near, mut far) = ([0_u32; LANES], [0.0_f32; LANES], [0.0_f32; LANES]);
    for k in 0..LANES {
        let (dx, dy) = (middle[k + 2] - middle[k], below[k + 1] - above[k + 1]);
        let weight = (dx * dx + dy * dy).sqrt() * (falloff[k] * falloff[row]) * inside[k];
        let turn = direction_in_eighths(dx, dy);
        let whole;
        (whole, direction[k]) = split(turn);
        far[k] = (turn - whole) * weight;
        near[k] = weight - far[k];
    }
    let mut cells = [[0.0; DIRECTIONS]; CELLS + 2];
    for between in 0..=CELLS {
        // Of the samples between two cells' middles.
        let (mut all, mut later) = ([0.0; DIRECTIONS], [0.0; DIRECTIONS]);
        for sample in between * PER_CELL..(between + 1) * PER_CELL {
            let direction = (direction[sample] as usize).min(DIRECTIONS);
            let (first, second) = (&DIRECTION_MASKS[direction], &DIRECTION_MASKS[direction + 1]);
            let share = later_share(sample);
            for k in 0..DIRECTIONS {
                let value = far[sample].mul_add(second[k], near[sample] * first[k]);
                all[k] += value;
                later[k] = value.mul_add(share, later[k]);
            }
        }
        for k in 0..DIRECTIONS {
            cells[between][k] += all[k] - later[k];
            cells[between + 1][k] += later[k];
        }
    }
    cells
}
