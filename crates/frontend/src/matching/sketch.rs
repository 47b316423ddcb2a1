//! Descriptors in 32 small numbers whose products bound the products of the descriptors.
//!
//! A descriptor, less a typical one, is turned by an orthonormal transform that gathers its variance: cosines over the
//! four rows and columns of cells, sines and cosines over the eight directions (the variance of SIFT falls with these
//! frequencies as that of images does; trained axes gain little). Of its 128 coefficients 31 are kept; the length of the
//! rest is the 32nd number. The product of two such sketches is at least that of the descriptors (Cauchy–Schwarz on the
//! rest), so `|a|² + |b|² − 2 sketch_a · sketch_b` is at most their squared distance. Sketches are then turned again, so
//! that no number is much greater than the others, and rounded to a *code*; what rounding took is kept as a length, and
//! its share in a product is bounded by Cauchy–Schwarz as well. Typical values, axes and scales decide how tight the
//! bound is, never whether it holds.

use terrane_scene::DESCRIPTOR_LEN;

use super::cells::gathered;
use super::sweep::ANY_REACH;
use crate::simd::{Path, compiled_twice};

/// Numbers of a sketch.
pub(super) const SKETCH_LEN: usize = 32;

/// A rounded sketch: entries from −64 to 63 where it is coarse, from −127 to 127 where it is fine.
pub(super) type Code = [i8; SKETCH_LEN];

/// The coefficients that are kept: frequency over rows, over columns, and place among the directions' (constant, cosine
/// and sine of one turn, of two, of three, alternation).
const KEPT: [[usize; 3]; SKETCH_LEN - 1] = [
    [0, 0, 0],
    [0, 0, 1],
    [0, 0, 2],
    [0, 0, 3],
    [0, 0, 4],
    [0, 1, 0],
    [0, 1, 1],
    [0, 1, 2],
    [0, 1, 3],
    [0, 1, 4],
    [0, 2, 1],
    [0, 2, 3],
    [0, 3, 1],
    [1, 0, 0],
    [1, 0, 1],
    [1, 0, 2],
    [1, 0, 3],
    [1, 0, 4],
    [1, 1, 1],
    [1, 1, 2],
    [1, 1, 3],
    [1, 1, 4],
    [1, 2, 1],
    [1, 2, 2],
    [2, 0, 2],
    [2, 1, 1],
    [2, 1, 2],
    [2, 3, 1],
    [3, 0, 2],
    [3, 1, 2],
    [3, 2, 2],
];
/// A typical RootSIFT descriptor of length 512, where its coefficients are not near zero.
const TYPICAL: [([usize; 3], f32); 10] = [
    ([0, 0, 0], 406.0),
    ([0, 0, 1], 61.0),
    ([0, 0, 3], 58.0),
    ([0, 0, 5], 15.0),
    ([0, 2, 0], -38.0),
    ([0, 2, 1], -50.0),
    ([0, 2, 3], -19.0),
    ([1, 1, 2], -25.0),
    ([2, 0, 0], -31.0),
    ([2, 0, 3], -16.0),
];

/// Root mean square of the entries of coarse codes: rarely is one beyond 64.
const TYPICAL_ENTRY: f32 = 18.0;
/// Least size of a coarse code's unit in bytes: smaller ones would come near the rounding of the transform.
const LEAST_UNIT: f32 = 1.0;
/// Bounds the rounding of f32 in a sketch of any bytes, in units: 2⁻²⁴ · 2,885 · 25 operations over half a [`LEAST_UNIT`].
const FLOAT_SLACK: f32 = 0.03;
/// Most that a base may be lowered for rounding.
const MAX_SLACK: f32 = (super::sweep::MAX_EXCESS / 2) as f32 - 10.0;

/// Base of a code that bounds nothing.
pub(super) const LOOSE: i32 = i32::MAX;

/// The sketches of one image.
pub(super) struct Sketches {
    /// What rows of a sweep are made from.
    pub(super) coarse: Codes,
    /// What columns are made from.
    pub(super) fine: Codes,
    /// Squared length of each sketch in bytes, which is that of the descriptor less the typical one.
    squared: Vec<f32>,
}

/// Sketches rounded to multiples of a unit.
pub(super) struct Codes {
    pub(super) codes: Vec<Code>,
    /// What an entry of one stands for, in bytes.
    unit: f32,
    /// Squared length of each code.
    squared: Vec<f32>,
    /// Length of what rounding took from each sketch, in units, at least.
    lost: Vec<f32>,
    /// Root mean square of `lost`.
    typical_lost: f32,
    /// Root mean square and maximum of the lengths of codes.
    typical_length: f32,
    greatest_length: f32,
}

impl Sketches {
    pub(super) fn new(descriptors: &[[u8; DESCRIPTOR_LEN]]) -> Self {
        let mut sketches = vec![[0.0; SKETCH_LEN]; descriptors.len()];
        sketch_all(Path::detect(), descriptors, &mut sketches);
        let squared: Vec<f32> = sketches.iter().map(squared_length).collect();
        let unit = (root_mean(&squared) / (SKETCH_LEN as f32).sqrt() / TYPICAL_ENTRY).max(LEAST_UNIT);
        sketches.iter_mut().for_each(turn);
        Self {
            coarse: Codes::new(&sketches, unit, -64..=63),
            fine: Codes::new(&sketches, 0.5 * unit, -127..=127),
            squared,
        }
    }

    pub(super) fn len(&self) -> usize {
        self.squared.len()
    }

    /// Those at `order`, one after another.
    pub(super) fn in_order(&self, order: &[u32]) -> Self {
        Self {
            coarse: self.coarse.in_order(order),
            fine: self.fine.in_order(order),
            squared: gathered(&self.squared, order),
        }
    }

    /// The bases of this image's limits where it has the rows and another image the columns; [`LOOSE`] where rounding
    /// has taken too much for bounds to be of use.
    pub(super) fn row_bases(&self, columns: &Self) -> Vec<i32> {
        bases(&self.squared, &self.coarse, &columns.fine)
    }

    /// The bases of this image's limits where it has the columns.
    pub(super) fn column_bases(&self, rows: &Self) -> Vec<i32> {
        bases(&self.squared, &self.fine, &rows.coarse)
    }

    /// Half the squared length of each sketch in units of a product with another image's coarse codes, modulo 2¹⁶.
    pub(super) fn score_bases(&self, rows: &Self) -> Vec<i16> {
        let per_unit = 0.5 / (self.fine.unit * rows.coarse.unit);
        self.squared.iter().map(|squared| (squared * per_unit) as i32 as i16).collect()
    }

    /// The reach that a squared distance in bytes comes to, where this image has the rows.
    pub(super) fn reach(&self, columns: &Self, squared_distance: u32) -> i32 {
        if squared_distance == u32::MAX {
            return ANY_REACH;
        }
        let reach = squared_distance as f32 / (2.0 * self.coarse.unit * columns.fine.unit);
        (reach * 1.000_01) as i32 + 2
    }
}

/// Half the squared lengths, less this side's share of what rounding may have taken from a product:
/// `|code_a| lost_b + lost_a |code_b| + lost_a lost_b`.
///
/// Each product of two is split by `2xy ≤ x²/k + k y²`, with k such that equality holds where both are typical.
fn bases(squared: &[f32], side: &Codes, other: &Codes) -> Vec<i32> {
    let unit = side.unit * other.unit;
    let (by_length, by_lost) =
        (0.5 * other.typical_lost / side.typical_length, 0.5 * other.typical_length / side.typical_lost);
    let base = |at: usize| {
        let lost = side.lost[at];
        // The other side's share is at least zero: where much was lost, this side bears it all.
        let of_lost = (by_lost * lost * lost).min(lost * other.greatest_length);
        let of_length = by_length * side.squared[at];
        let of_floats = FLOAT_SLACK * (squared[at].sqrt() / side.unit + 1.0) * side.unit / other.unit;
        let slack = (of_lost + of_length + 0.5 * lost * lost) * 1.000_01 + of_floats + 1.0;
        if slack < MAX_SLACK { (0.5 * squared[at] / unit - slack).floor() as i32 } else { LOOSE }
    };
    (0..squared.len()).map(base).collect()
}

impl Codes {
    fn new(turned: &[[f32; SKETCH_LEN]], unit: f32, range: std::ops::RangeInclusive<i8>) -> Self {
        let coded = turned.iter().map(|sketch| rounded(sketch, 1.0 / unit, &range));
        let (codes, lost): (Vec<Code>, Vec<f32>) = coded.unzip();
        let squared: Vec<f32> = codes.iter().map(|code| squared_length(&code.map(f32::from))).collect();
        let squared_lost: Vec<f32> = lost.iter().map(|lost| lost * lost).collect();
        Self {
            unit,
            typical_lost: root_mean(&squared_lost).max(1.0),
            typical_length: root_mean(&squared).max(1.0),
            greatest_length: squared.iter().copied().fold(0.0, f32::max).sqrt() * 1.000_01,
            codes,
            squared,
            lost,
        }
    }

    fn in_order(&self, order: &[u32]) -> Self {
        Self {
            codes: gathered(&self.codes, order),
            squared: gathered(&self.squared, order),
            lost: gathered(&self.lost, order),
            ..*self
        }
    }
}

fn root_mean(squares: &[f32]) -> f32 {
    let sum: f64 = squares.iter().map(|&square| f64::from(square)).sum();
    (sum / squares.len().max(1) as f64).sqrt() as f32
}

/// The code of a turned sketch and the length of what rounding took.
fn rounded(turned: &[f32; SKETCH_LEN], per_unit: f32, range: &std::ops::RangeInclusive<i8>) -> (Code, f32) {
    let (least, greatest) = (f32::from(*range.start()), f32::from(*range.end()));
    let mut code = [0; SKETCH_LEN];
    let mut lost = 0.0;
    for (entry, value) in code.iter_mut().zip(turned) {
        let value = value * per_unit;
        // Truncation of a positive number rounds as `floor` does, on any processor.
        *entry = ((value.clamp(least, greatest) + 128.5) as i32 - 128) as i8;
        lost += (value - f32::from(*entry)).powi(2);
    }
    (code, lost.sqrt() * 1.000_01 + FLOAT_SLACK)
}

/// The orthonormal Hadamard transform.
fn turn(values: &mut [f32; SKETCH_LEN]) {
    let mut half = 1;
    while half < SKETCH_LEN {
        for pair in values.chunks_exact_mut(2 * half) {
            let (low, high) = pair.split_at_mut(half);
            for (a, b) in low.iter_mut().zip(high) {
                (*a, *b) = (*a + *b, *a - *b);
            }
        }
        half *= 2;
    }
    const SCALE: f32 = 0.176_776_7;
    values.iter_mut().for_each(|value| *value *= SCALE);
}

compiled_twice!(
    sketch_all = sketch_all_body(descriptors: &[[u8; DESCRIPTOR_LEN]], sketches: &mut [[f32; SKETCH_LEN]])
);

#[inline(always)]
fn sketch_all_body(descriptors: &[[u8; DESCRIPTOR_LEN]], sketches: &mut [[f32; SKETCH_LEN]]) {
    for (sketch, descriptor) in sketches.iter_mut().zip(descriptors) {
        *sketch = sketch_of(descriptor);
    }
}

/// Kept coefficients and the length of the others.
#[inline(always)]
fn sketch_of(descriptor: &[u8; DESCRIPTOR_LEN]) -> [f32; SKETCH_LEN] {
    let mut coefficients = transform(descriptor);
    for ([row, column, direction], typical) in TYPICAL {
        coefficients[row][column][direction] -= typical;
    }
    let mut sketch = [0.0; SKETCH_LEN];
    for (kept, [row, column, direction]) in sketch.iter_mut().zip(KEPT) {
        std::mem::swap(kept, &mut coefficients[row][column][direction]);
    }
    let rest: f32 = coefficients.as_flattened().iter().map(squared_length).sum();
    sketch[SKETCH_LEN - 1] = rest.sqrt() * 1.000_01;
    sketch
}

#[inline(always)]
fn squared_length<const N: usize>(values: &[f32; N]) -> f32 {
    values.iter().map(|value| value * value).sum()
}

/// Rows of the four-point cosine transform.
const COSINES: [[f32; 4]; 4] = {
    const A: f32 = 0.653_281_5;
    const B: f32 = 0.270_598_05;
    [[0.5, 0.5, 0.5, 0.5], [A, B, -B, -A], [0.5, -0.5, -0.5, 0.5], [B, -A, A, -B]]
};
/// Rows of the real eight-point Fourier transform.
const TURNS: [[f32; 8]; 8] = {
    const C: f32 = 0.353_553_4;
    [
        [C, C, C, C, C, C, C, C],
        [0.5, C, 0.0, -C, -0.5, -C, 0.0, C],
        [0.0, C, 0.5, C, 0.0, -C, -0.5, -C],
        [0.5, 0.0, -0.5, 0.0, 0.5, 0.0, -0.5, 0.0],
        [0.0, 0.5, 0.0, -0.5, 0.0, 0.5, 0.0, -0.5],
        [0.5, -C, 0.0, C, -0.5, C, 0.0, -C],
        [0.0, C, -0.5, C, 0.0, -C, 0.5, -C],
        [C, -C, C, -C, C, -C, C, -C],
    ]
};

/// All coefficients: by frequency over rows, over columns, over directions.
#[inline(always)]
fn transform(descriptor: &[u8; DESCRIPTOR_LEN]) -> [[[f32; 8]; 4]; 4] {
    let cells = descriptor.as_chunks::<8>().0;
    let mut by_direction = [[[0.0_f32; 8]; 4]; 4];
    for (cell, bytes) in cells.iter().enumerate() {
        let out = &mut by_direction[cell / 4][cell % 4];
        // By columns of the matrix, so that eight sums advance side by side.
        for (direction, byte) in bytes.iter().enumerate() {
            let value = f32::from(*byte);
            for frequency in 0..8 {
                out[frequency] += TURNS[frequency][direction] * value;
            }
        }
    }
    let mut by_column = [[[0.0; 8]; 4]; 4];
    let mut all = [[[0.0; 8]; 4]; 4];
    for row in 0..4 {
        for frequency in 0..4 {
            for column in 0..4 {
                add_scaled(
                    &mut by_column[row][frequency],
                    COSINES[frequency][column],
                    &by_direction[row][column],
                );
            }
        }
    }
    for frequency in 0..4 {
        for row in 0..4 {
            for column in 0..4 {
                add_scaled(&mut all[frequency][column], COSINES[frequency][row], &by_column[row][column]);
            }
        }
    }
    all
}

#[inline(always)]
fn add_scaled(sum: &mut [f32; 8], scale: f32, values: &[f32; 8]) {
    for (sum, value) in sum.iter_mut().zip(values) {
        *sum += scale * value;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_compilations_give_the_same_sketches() {
        let descriptor = |k: usize| -> [u8; DESCRIPTOR_LEN] {
            std::array::from_fn(|i| if k == 0 { 255 } else { ((k * 73 + i * i * 31 + k * i) % 256) as u8 })
        };
        let descriptors: Vec<_> = (0..300).map(descriptor).collect();
        let sketches = |path: Path| {
            let mut sketches = vec![[0.0; SKETCH_LEN]; descriptors.len()];
            sketch_all(path, &descriptors, &mut sketches);
            sketches.as_flattened().iter().map(|value| value.to_bits()).collect::<Vec<_>>()
        };
        assert_eq!(sketches(Path::BASELINE), sketches(Path::detect()));
    }
}
