//! Extrema of the differences of Gaussians, refined to fractions of a pixel (Lowe 2004, Brown & Lowe 2002).

use super::isa::Isa;
use super::octave::{LEVELS, RowRing, Size, sigma_of_level};
use super::rows::{mark_extrema, neighborhood};

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

/// Thresholds of the search, and its buffers.
pub(super) struct Detector {
    contrast: f64,
    edge_bound: f64,
    largest: Vec<Vec<f32>>,
    smallest: Vec<Vec<f32>>,
    scratch: Vec<f32>,
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

/// How often a place may move to a neighbour before it is given up.
const MAX_MOVES: usize = 5;

impl Detector {
    /// Rows before and after the searched one that must be there: refinement moves at most two and looks one further.
    pub(super) const REACH: usize = 3;

    /// `contrast` in greys; `edge` is the largest ratio of principal curvatures.
    pub(super) fn new(contrast: f64, edge: f64) -> Self {
        let empty = || vec![Vec::new(); LEVELS + 2];
        Self {
            contrast,
            edge_bound: (edge + 1.0) * (edge + 1.0) / edge,
            largest: empty(),
            smallest: empty(),
            scratch: Vec::new(),
            marks: Vec::new(),
        }
    }

    /// Appends what is found in row `y`, an inner row, of the middle differences: by level, then by column.
    pub(super) fn search_row(
        &mut self,
        isa: Isa,
        differences: &[RowRing],
        size: Size,
        y: usize,
        found: &mut Vec<Extremum>,
    ) {
        self.fit_buffers(size.width);
        for (s, ring) in differences.iter().enumerate() {
            let rows = [ring.row(y - 1), ring.row(y), ring.row(y + 1)];
            neighborhood(isa, rows, &mut self.scratch, &mut self.largest[s], &mut self.smallest[s]);
        }
        // A little below the threshold: interpolation raises the value.
        let threshold = (0.8 * self.contrast) as f32;
        for s in 1..=LEVELS {
            let bounds = [s - 1, s, s + 1].map(|s| (self.largest[s].as_slice(), self.smallest[s].as_slice()));
            mark_extrema(isa, differences[s].row(y), bounds, threshold, &mut self.marks);
            for x in marked(&self.marks, size.width) {
                let cell = Cell { x, y, s };
                if is_extremum(differences, cell) {
                    found.extend(self.refine(differences, size, cell));
                }
            }
        }
    }

    fn fit_buffers(&mut self, width: usize) {
        if self.marks.len() != width {
            self.largest.iter_mut().chain(&mut self.smallest).for_each(|row| row.resize(width, 0.0));
            self.scratch.resize(2 * width, 0.0);
            self.marks.resize(width, 0);
        }
    }

    fn refine(&self, differences: &[RowRing], size: Size, start: Cell) -> Option<Extremum> {
        let mut cell = start;
        let mut values = neighborhood_of(differences, cell);
        let mut fit = fit(&values)?;
        for _ in 0..MAX_MOVES {
            let next = neighbor(cell, &fit.offset, size, start.y);
            if next == cell {
                break;
            }
            cell = next;
            values = neighborhood_of(differences, cell);
            fit = self::fit(&values)?;
        }
        let is_near = fit.offset.iter().all(|o| o.abs() < 1.0);
        if !is_near || fit.value.abs() < self.contrast || !(0.0..self.edge_bound).contains(&fit.edge_ratio) {
            return None;
        }
        let [dx, dy, ds] = fit.offset;
        let [dx, dy] = unbiased_place(&values, ds).unwrap_or([dx, dy]);
        let s = cell.s as f64 + ds;
        Some(Extremum {
            x: (cell.x as f64 + dx) as f32,
            y: (cell.y as f64 + dy) as f32,
            sigma: sigma_of_level(s) as f32,
            level: (s.round() as i64).clamp(1, LEVELS as i64) as u8,
            response: fit.value.abs() as f32,
        })
    }
}

/// Columns that are marked, but the first and the last.
fn marked(marks: &[u8], width: usize) -> impl Iterator<Item = usize> + '_ {
    let blocks = marks.chunks(8).enumerate().filter(|(_, block)| block.iter().fold(0, |a, b| a | b) != 0);
    blocks
        .flat_map(|(index, block)| {
            block.iter().enumerate().filter(|(_, m)| **m != 0).map(move |(k, _)| 8 * index + k)
        })
        .filter(move |&x| x >= 1 && x + 1 < width)
}

/// Beyond all of its 26 neighbours. Of level neighbours the first one is the extremum, so that a blob midway between
/// pixels is found once.
fn is_extremum(differences: &[RowRing], cell: Cell) -> bool {
    let values = neighborhood_of(differences, cell);
    let values = values.as_flattened().as_flattened();
    let sign = values[13].signum();
    let value = sign * values[13];
    values[..13].iter().all(|v| value > sign * v) && values[14..].iter().all(|v| value >= sign * v)
}

/// The neighbour that the extremum of a fit lies in, as far as it can be reached.
fn neighbor(cell: Cell, offset: &[f64; 3], size: Size, start_y: usize) -> Cell {
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
    let reach = Detector::REACH - 1;
    let (low_y, high_y) = (start_y.saturating_sub(reach).max(1), (start_y + reach).min(size.height - 2));
    Cell {
        x: moved(cell.x, offset[0], 1, size.width - 2),
        y: moved(cell.y, offset[1], low_y, high_y),
        s: moved(cell.s, offset[2], 1, LEVELS),
    }
}

/// A cell and its 26 neighbours, by level, row and column.
type Neighborhood = [[[f64; 3]; 3]; 3];

fn neighborhood_of(differences: &[RowRing], Cell { x, y, s }: Cell) -> Neighborhood {
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
