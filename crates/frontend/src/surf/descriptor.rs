//! Orientation and descriptor from Haar wavelets (Bay et al. 2008).

use std::sync::OnceLock;

use terrane_scene::DESCRIPTOR_LEN;

use super::hessian::Blob;
use super::integral::Integral;
use crate::sift::shared::{cos_sin, direction_in_eighths, direction_rad, exp};

/// Radius of the disc that decides the orientation, in scales.
const DISC: i32 = 6;
/// Standard deviation of its weights, in scales (Bay et al. 2008: 2; OpenSURF: 2.5).
const DISC_SIGMA: f64 = 2.5;
/// Bins of a turn, and how many of them are summed up: a sixth of a turn.
const BINS: usize = 72;
const SUMMED_BINS: usize = BINS / 6;

/// Samples of a descriptor along one axis, and cells along it.
const SAMPLES: usize = 24;
const CELLS: usize = 4;
/// Width of a descriptor's window and of its cells, in scales (Bay et al. 2008).
const WINDOW_SCALES: f32 = 20.0;
const CELL_SCALES: f32 = WINDOW_SCALES / CELLS as f32;
/// Standard deviation of the samples' weights, in scales. Wider than the 3.3 of Bay et al. 2008, for cells overlap here.
const SIGMA: f64 = 6.0;
/// What a descriptor of length one is multiplied by. An entry above one half, which is rare, is cut off, so that bytes
/// stay below 128 and products in sixteen bits.
const QUANTUM: f32 = 254.0;

/// Weights by column and row.
struct Weights {
    disc: Vec<(i32, i32, f32)>,
    samples: [f32; SAMPLES],
}

fn weights() -> &'static Weights {
    static WEIGHTS: OnceLock<Weights> = OnceLock::new();
    WEIGHTS.get_or_init(|| {
        let gaussian = |squared: f64, sigma: f64| exp(-0.5 * squared / (sigma * sigma)) as f32;
        let square = (-DISC..=DISC).flat_map(|y| (-DISC..=DISC).map(move |x| (x, y)));
        let disc = square
            .filter(|(x, y)| x * x + y * y < DISC * DISC)
            .map(|(x, y)| (x, y, gaussian(f64::from(x * x + y * y), DISC_SIGMA)))
            .collect();
        let samples = std::array::from_fn(|k| gaussian(f64::from(offset(k)).powi(2), SIGMA));
        Weights { disc, samples }
    })
}

/// How far sample `k` lies from the middle, in scales.
fn offset(k: usize) -> f32 {
    (k as f32 - 0.5 * (SAMPLES as f32 - 1.0)) * (WINDOW_SCALES / SAMPLES as f32)
}

/// Halves a wavelet's side, at least one pixel: pixels from its middle to its edge.
fn half_side(scales: f32, scale_px: f32) -> i32 {
    ((0.5 * scales * scale_px).round() as i32).max(1)
}

/// The corner between pixels that is nearest to a place.
fn corner(x_px: f32, y_px: f32) -> (i32, i32) {
    (x_px.round() as i32, y_px.round() as i32)
}

/// The direction, in radians, in which the strongest sixth of a turn of the wavelets' responses points.
pub(super) fn orientation(integral: &Integral, blob: &Blob) -> f32 {
    let half = half_side(4.0, blob.scale_px);
    let mut bins = [(0.0_f32, 0.0_f32); BINS];
    for &(column, row, weight) in &weights().disc {
        let x_px = blob.x_px + column as f32 * blob.scale_px;
        let y_px = blob.y_px + row as f32 * blob.scale_px;
        let (dx, dy) = integral.haar(corner(x_px, y_px), half);
        let bin = (direction_in_eighths(dx, dy) * (BINS as f32 / 8.0)) as usize % BINS;
        bins[bin].0 += dx * weight;
        bins[bin].1 += dy * weight;
    }
    let (mut best, mut longest) = ((1.0, 0.0), 0.0);
    for start in 0..BINS {
        let (mut x, mut y) = (0.0_f32, 0.0_f32);
        for k in start..start + SUMMED_BINS {
            x += bins[k % BINS].0;
            y += bins[k % BINS].1;
        }
        let length = x * x + y * y;
        if length > longest {
            (best, longest) = ((x, y), length);
        }
    }
    direction_rad(best.0, best.1)
}

/// Sums of a cell, positive and negative ones apart: along x and along y.
type Cell = [f32; 4];

/// The descriptor: of each of 4 × 4 cells the positive and the negative sums of responses along both axes; 64 bytes,
/// then zeros.
///
/// Bay et al. keep Σd and Σ|d|. With P and N the sums of positive and of negative parts these are P − N and P + N, and
/// squared distances between (P − N, P + N) are twice those between (P, N): the same descriptor, without signs. Cells
/// overlap, each sample counting for the cells around it, as in Agrawal et al. 2008.
pub(super) fn describe(integral: &Integral, blob: &Blob, orientation_rad: f32) -> [u8; DESCRIPTOR_LEN] {
    let (cosine, sine) = cos_sin(f64::from(orientation_rad));
    let (cosine, sine) = (cosine as f32, sine as f32);
    let half = half_side(2.0, blob.scale_px);
    let weights = &weights().samples;
    let mut cells = [[[0.0_f32; 4]; CELLS]; CELLS];
    for row in 0..SAMPLES {
        for column in 0..SAMPLES {
            let (u, v) = (offset(column), offset(row));
            let x_px = blob.x_px + blob.scale_px * (cosine * u - sine * v);
            let y_px = blob.y_px + blob.scale_px * (sine * u + cosine * v);
            let (dx, dy) = integral.haar(corner(x_px, y_px), half);
            let weight = weights[row] * weights[column];
            let along = (cosine * dx + sine * dy) * weight;
            let across = (cosine * dy - sine * dx) * weight;
            add(&mut cells, (u, v), [along.max(0.0), (-along).max(0.0), across.max(0.0), (-across).max(0.0)]);
        }
    }
    quantized(&cells)
}

/// Adds a sample to the cells around it, bilinearly.
fn add(cells: &mut [[Cell; CELLS]; CELLS], (u, v): (f32, f32), sample: Cell) {
    let (column, row) = (u / CELL_SCALES + 1.5, v / CELL_SCALES + 1.5);
    let (first_column, first_row) = (column.floor(), row.floor());
    for (dy, down) in [(0, 1.0 - (row - first_row)), (1, row - first_row)] {
        for (dx, right) in [(0, 1.0 - (column - first_column)), (1, column - first_column)] {
            let (row, column) = (first_row as i32 + dy, first_column as i32 + dx);
            let cell = usize::try_from(row).ok().and_then(|row| cells.get_mut(row));
            let cell = cell.zip(usize::try_from(column).ok()).and_then(|(row, column)| row.get_mut(column));
            if let Some(cell) = cell {
                (0..4).for_each(|k| cell[k] += sample[k] * (down * right));
            }
        }
    }
}

fn quantized(cells: &[[Cell; CELLS]; CELLS]) -> [u8; DESCRIPTOR_LEN] {
    let values = cells.as_flattened().as_flattened();
    let length = values.iter().map(|v| v * v).fold(0.0_f32, |a, b| a + b).sqrt();
    let mut bytes = [0; DESCRIPTOR_LEN];
    if length > 0.0 {
        for (byte, value) in bytes.iter_mut().zip(values) {
            *byte = (QUANTUM * (value / length)).round_ties_even().min(127.0) as u8;
        }
    }
    bytes
}
