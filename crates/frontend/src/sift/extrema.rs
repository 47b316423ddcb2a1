//! Extrema of the differences of Gaussians, refined to fractions of a pixel (Lowe 2004, Brown & Lowe 2002).

use std::ops::Range;

use super::isa::Isa;
use super::octave::{LEVELS, RowRing, sigma_of_level};
use super::rows::{UNITS_PER_GREY, mark_extrema};

/// A blob, in pixels of its octave; the first pixel's centre is at (0, 0).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Extremum {
    /// Refined column.
    pub x: f32,
    /// Refined row.
    pub y: f32,
    /// Standard deviation in pixels of the octave.
    pub sigma: f32,
    /// The level, 1 to [`LEVELS`], whose blur is nearest.
    pub level: u8,
    /// Height of the extremum in greys, without sign.
    pub response: f32,
}

/// What an extremum must exceed.
#[derive(Clone, Copy)]
pub(super) struct Thresholds {
    contrast_units: f64,
    edge_bound: f64,
}

impl Thresholds {
    /// `contrast` in greys; `edge` is the largest ratio of principal curvatures.
    pub(super) fn new(contrast: f64, edge: f64) -> Self {
        Self { contrast_units: contrast * UNITS_PER_GREY, edge_bound: (edge + 1.0) * (edge + 1.0) / edge }
    }
}

/// The search of a tile.
pub(super) struct Detector {
    thresholds: Thresholds,
    /// Column of the octave that the tile starts at.
    first_column: usize,
    height: usize,
    width: usize,
    marks: Vec<u8>,
}

/// A place in the stack of differences while it is refined.
#[derive(Clone, Copy, PartialEq)]
struct Cell {
    x: usize,
    y: usize,
    s: usize,
}

struct Fit {
    offset: [f64; 3],
    value: f64,
    edge_ratio: f64,
}

/// How far from its cell an extremum may lie, in pixels and levels (VLFeat). What another cell finds too is found once.
const MAX_OFFSET: f64 = 1.5;

/// How often a place may move to a neighbour before it is given up.
const MAX_MOVES: usize = 5;

impl Detector {
    /// Rows before and after the searched one that must be there: refinement moves at most two and looks one further.
    pub(super) const REACH: usize = 3;

    pub(super) fn new(thresholds: &Thresholds, first_column: usize, height: usize, width: usize) -> Self {
        Self { thresholds: *thresholds, first_column, height, width, marks: vec![0; width] }
    }

    /// Appends what is found in `columns` of row `y`, an inner row, of the middle differences: by level, then by column.
    pub(super) fn search_row(
        &mut self,
        isa: Isa,
        differences: &[RowRing<i16>],
        y: usize,
        columns: &Range<usize>,
        found: &mut Vec<Extremum>,
    ) {
        let rows: [[&[i16]; 3]; LEVELS + 2] =
            std::array::from_fn(|s| std::array::from_fn(|dy| differences[s].row(y + dy - 1)));
        // A little below the threshold: interpolation raises the value.
        let threshold = (0.8 * self.thresholds.contrast_units).clamp(1.0, 32_767.0) as i16;
        for s in 1..=LEVELS {
            let [above, row, below] = rows[s];
            mark_extrema(
                isa,
                &[above, row, below, rows[s - 1][1], rows[s + 1][1]],
                threshold,
                &mut self.marks,
            );
            for x in marked(&self.marks, columns) {
                if is_extremum(&rows[s - 1..=s + 1], x) {
                    found.extend(self.refine(differences, Cell { x, y, s }));
                }
            }
        }
    }

    fn refine(&self, differences: &[RowRing<i16>], start: Cell) -> Option<Extremum> {
        let mut cell = start;
        let mut values = neighborhood_of(differences, cell);
        let mut fit = fit(&values)?;
        for _ in 0..MAX_MOVES {
            let next = self.neighbor(cell, &fit.offset, start);
            if next == cell {
                break;
            }
            cell = next;
            values = neighborhood_of(differences, cell);
            fit = self::fit(&values)?;
        }
        let is_near = fit.offset.iter().all(|o| o.abs() < MAX_OFFSET);
        let Thresholds { contrast_units, edge_bound } = self.thresholds;
        if !is_near || fit.value.abs() < contrast_units || !(0.0..edge_bound).contains(&fit.edge_ratio) {
            return None;
        }
        let [dx, dy, ds] = fit.offset;
        let [dx, dy] = unbiased_place(&values, ds.clamp(-1.0, 1.0)).unwrap_or([dx, dy]);
        let s = cell.s as f64 + ds;
        Some(Extremum {
            x: ((self.first_column + cell.x) as f64 + dx) as f32,
            y: (cell.y as f64 + dy) as f32,
            sigma: sigma_of_level(s) as f32,
            level: (s.round() as i64).clamp(1, LEVELS as i64) as u8,
            response: (fit.value.abs() / UNITS_PER_GREY) as f32,
        })
    }

    /// The neighbour in the same level that the extremum of a fit lies in, as far as it can be reached from the start.
    fn neighbor(&self, cell: Cell, offset: &[f64; 3], start: Cell) -> Cell {
        let moved = |at: usize, offset: f64, low: usize, high: usize| {
            let to = if offset > 0.6 {
                at + 1
            } else if offset < -0.6 {
                at - 1
            } else {
                at
            };
            to.clamp(low, high)
        };
        let reach = Self::REACH - 1;
        let range =
            |start: usize, len: usize| (start.saturating_sub(reach).max(1), (start + reach).min(len - 2));
        let ((low_x, high_x), (low_y, high_y)) = (range(start.x, self.width), range(start.y, self.height));
        Cell {
            x: moved(cell.x, offset[0], low_x, high_x),
            y: moved(cell.y, offset[1], low_y, high_y),
            s: cell.s,
        }
    }
}

/// Those of some columns that are marked.
fn marked<'a>(marks: &'a [u8], columns: &Range<usize>) -> impl Iterator<Item = usize> + 'a {
    let first = columns.start;
    let (whole, rest) = marks[columns.clone()].as_chunks::<32>();
    let blocks = whole.iter().map(|block| block.as_slice()).chain(std::iter::once(rest)).enumerate();
    blocks.filter(|(_, block)| block.iter().fold(0, |a, b| a | b) != 0).flat_map(move |(index, block)| {
        let places = block.iter().enumerate().filter(|(_, mark)| **mark != 0);
        places.map(move |(k, _)| first + 32 * index + k)
    })
}

/// Beyond all of its 26 neighbours. Of level neighbours the first one is the extremum, so that a blob midway between
/// pixels is found once.
fn is_extremum(levels: &[[&[i16]; 3]], x: usize) -> bool {
    let value = i32::from(levels[1][1][x]);
    let sign = if value < 0 { -1 } else { 1 };
    // How far the value is above those that come first, and above or level with those that come later.
    let (mut above_first, mut above_later) = (i32::MAX, i32::MAX);
    for (row, values) in levels.iter().flatten().enumerate() {
        for (column, neighbor) in values[x - 1..=x + 1].iter().enumerate() {
            let above = sign * (value - i32::from(*neighbor));
            match 3 * row + column {
                0..13 => above_first = above_first.min(above),
                _ => above_later = above_later.min(above),
            }
        }
    }
    above_first > 0 && above_later >= 0
}

/// A cell and its 26 neighbours, by level, row and column.
type Neighborhood = [[[f64; 3]; 3]; 3];

fn neighborhood_of(differences: &[RowRing<i16>], Cell { x, y, s }: Cell) -> Neighborhood {
    std::array::from_fn(|ds| {
        std::array::from_fn(|dy| {
            let row = differences[s + ds - 1].row(y + dy - 1);
            std::array::from_fn(|dx| f64::from(row[x + dx - 1]))
        })
    })
}

/// The paraboloid with the cell's first and second differences; `None` when it has no single extremum.
fn fit(values: &Neighborhood) -> Option<Fit> {
    let at = |dx: usize, dy: usize, ds: usize| values[ds][dy][dx];
    let center = at(1, 1, 1);
    let gradient = [
        0.5 * (at(2, 1, 1) - at(0, 1, 1)),
        0.5 * (at(1, 2, 1) - at(1, 0, 1)),
        0.5 * (at(1, 1, 2) - at(1, 1, 0)),
    ];
    let xx = at(2, 1, 1) + at(0, 1, 1) - 2.0 * center;
    let yy = at(1, 2, 1) + at(1, 0, 1) - 2.0 * center;
    let ss = at(1, 1, 2) + at(1, 1, 0) - 2.0 * center;
    let xy = 0.25 * (at(2, 2, 1) + at(0, 0, 1) - at(0, 2, 1) - at(2, 0, 1));
    let xs = 0.25 * (at(2, 1, 2) + at(0, 1, 0) - at(0, 1, 2) - at(2, 1, 0));
    let ys = 0.25 * (at(1, 2, 2) + at(1, 0, 0) - at(1, 0, 2) - at(1, 2, 0));
    let offset = solve_symmetric([xx, xy, xs, yy, ys, ss], gradient)?;
    let slope: f64 = gradient.iter().zip(&offset).map(|(g, o)| g * o).sum();
    let (trace, determinant) = (xx + yy, xx * yy - xy * xy);
    Some(Fit { offset, value: center + 0.5 * slope, edge_ratio: trace * trace / determinant })
}

/// The column and row of the extremum, from its level and without the bias of a paraboloid.
///
/// The differences are interpolated to the level first, for blobs are wider in coarser levels and one paraboloid in
/// three dimensions has no term for that. Around a blob's centre they fall as 1 - 2u + 3/2 u² with the squared distance u;
/// their fourth root falls as 1 - u/2 and has no term in u², so that a paraboloid fits it to the next order. `None` where
/// a neighbour is near or beyond zero, as across a ridge.
fn unbiased_place(values: &Neighborhood, level_offset: f64) -> Option<[f64; 2]> {
    let t = level_offset;
    let weights = [0.5 * t * (t - 1.0), 1.0 - t * t, 0.5 * t * (t + 1.0)];
    let plane: [[f64; 3]; 3] = std::array::from_fn(|dy| {
        std::array::from_fn(|dx| (0..3).map(|ds| weights[ds] * values[ds][dy][dx]).sum::<f64>())
    });
    let shares = plane.map(|row| row.map(|value| value / plane[1][1]));
    if shares.as_flattened().iter().any(|share| !(*share > 0.1)) {
        return None;
    }
    let v = shares.map(|row| row.map(|share| share.sqrt().sqrt()));
    let (gx, gy) = (0.5 * (v[1][2] - v[1][0]), 0.5 * (v[2][1] - v[0][1]));
    let (xx, yy) = (v[1][2] + v[1][0] - 2.0 * v[1][1], v[2][1] + v[0][1] - 2.0 * v[1][1]);
    let xy = 0.25 * (v[2][2] + v[0][0] - v[2][0] - v[0][2]);
    let determinant = xx * yy - xy * xy;
    let place = [(xy * gy - yy * gx) / determinant, (xy * gx - xx * gy) / determinant];
    (determinant > 0.0 && place.iter().all(|offset| offset.abs() < 1.0)).then_some(place)
}

/// Solves `[[a, b, c], [b, d, e], [c, e, f]] x = -g` by Cramer's rule.
fn solve_symmetric([a, b, c, d, e, f]: [f64; 6], g: [f64; 3]) -> Option<[f64; 3]> {
    let cofactors = [d * f - e * e, c * e - b * f, b * e - c * d];
    let determinant = a * cofactors[0] + b * cofactors[1] + c * cofactors[2];
    if !(determinant.abs() > 1e-12) {
        return None;
    }
    let (df, ef, ff) = (a * f - c * c, b * c - a * e, a * d - b * b);
    let [g0, g1, g2] = g;
    let solution = [
        cofactors[0] * g0 + cofactors[1] * g1 + cofactors[2] * g2,
        cofactors[1] * g0 + df * g1 + ef * g2,
        cofactors[2] * g0 + ef * g1 + ff * g2,
    ];
    Some(solution.map(|v| -v / determinant))
}
