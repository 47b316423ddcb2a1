//! Maxima of the determinant of an approximate Hessian over place and scale (Bay et al. 2008).
//!
//! Second derivatives are sums of boxes. An octave has four filters, its responses every `step` pixels; the filters that
//! two octaves share are computed once. Maxima among 26 neighbours are placed by a paraboloid (Brown & Lowe 2002).

use std::ops::Range;

use rayon::prelude::*;

use super::integral::Integral;
use crate::simd::{Path, compiled_twice};

/// Filters of an octave.
const LAYERS: usize = 4;
/// The weight of the mixed derivative that makes boxes balance as Gaussians do (Bay et al. 2008), squared.
const MIXED_WEIGHT: f32 = 0.81;

/// A blob in pixels of the photograph; the first pixel's centre is at (0.5, 0.5).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Blob {
    pub x_px: f32,
    pub y_px: f32,
    /// Standard deviation of the Gaussian that the filter stands for.
    pub scale_px: f32,
    /// The determinant at the maximum, in squared greys.
    pub response: f32,
}

/// The side in pixels of filter `layer` of octave `octave`.
fn filter_px(octave: usize, layer: usize) -> usize {
    3 * ((2 << octave) * (layer + 1) + 1)
}

/// Gaussian of a filter: the smallest, of nine pixels, stands for 1.2.
fn scale_of_filter(side_px: f32) -> f32 {
    side_px * (1.2 / 9.0)
}

/// Responses of one filter on a grid.
#[derive(Clone)]
struct Layer {
    columns: usize,
    rows: usize,
    /// Columns and rows at which the filter fits into the image.
    inside: [Range<usize>; 2],
    /// Zero where the filter does not fit.
    responses: Vec<f32>,
}

impl Layer {
    fn row(&self, y: usize) -> &[f32] {
        &self.responses[y * self.columns..(y + 1) * self.columns]
    }

    /// Every second row and column.
    fn halved(&self) -> Self {
        let (columns, rows) = (self.columns.div_ceil(2), self.rows.div_ceil(2));
        let responses =
            (0..rows).flat_map(|y| self.row(2 * y).iter().step_by(2).copied()).collect::<Vec<f32>>();
        let inside = self.inside.clone().map(|inside| inside.start.div_ceil(2)..inside.end.div_ceil(2));
        Self { columns, rows, inside, responses }
    }
}

/// Blobs of all octaves, by octave, scale and rows.
pub(super) fn detect(path: Path, integral: &Integral, num_octaves: usize, threshold: f32) -> Vec<Blob> {
    let mut found = Vec::new();
    let mut layers: Vec<Layer> = Vec::new();
    for octave in 0..num_octaves {
        if integral.width.min(integral.height) < filter_px(octave, 2) {
            break;
        }
        let shared = if octave == 0 { Vec::new() } else { vec![layers[1].halved(), layers[3].halved()] };
        let new = shared.len()..LAYERS;
        layers = shared;
        layers.extend(new.map(|layer| layer_of(path, integral, octave, layer)));
        for middle in 1..LAYERS - 1 {
            let stack = [&layers[middle - 1], &layers[middle], &layers[middle + 1]];
            // The largest filter of the three decides where there are neighbours on every side.
            let [_, rows] = &stack[2].inside;
            let rows: Vec<usize> = (rows.start + 1..rows.end.saturating_sub(1)).collect();
            let of_row = |&y: &usize| maxima(&stack, y, threshold, (octave, middle));
            found.extend(rows.par_iter().map(of_row).collect::<Vec<_>>().concat());
        }
    }
    found
}

fn layer_of(path: Path, integral: &Integral, octave: usize, layer: usize) -> Layer {
    let step = 1 << octave;
    let (columns, rows) = (integral.width.div_ceil(step), integral.height.div_ceil(step));
    let mut responses = vec![0.0; columns * rows];
    let filter = Filter::new(filter_px(octave, layer), integral.stride());
    let reach = filter.reach;
    let inside = [integral.width, integral.height].map(|side| {
        let first = reach.div_ceil(step);
        first..side.saturating_sub(reach).div_ceil(step).max(first)
    });
    let [inner_columns, inner_rows] = inside.clone();
    responses.par_chunks_mut(columns).enumerate().for_each(|(row, out)| {
        if inner_rows.contains(&row) && !inner_columns.is_empty() {
            let top = row * step - reach;
            let rows = &integral.sums[top * integral.stride()..(top + 2 * reach + 2) * integral.stride()];
            let start = inner_columns.start * step - reach;
            respond(path, &filter, rows, (start, step), &mut out[inner_columns.clone()]);
        }
    });
    Layer { columns, rows, inside, responses }
}

/// The corners of a filter's boxes, as offsets from the top left corner of the square that holds it.
struct Filter {
    /// Half the side, rounded down: pixels needed on each side of the middle.
    reach: usize,
    /// Of each derivative an outer and an inner box: top left, top right, bottom left, bottom right.
    xx: [[usize; 4]; 2],
    yy: [[usize; 4]; 2],
    /// Of the mixed derivative four boxes: upper right, lower left, upper left, lower right.
    xy: [[usize; 4]; 4],
    /// One over the filter's area.
    per_area: f32,
}

impl Filter {
    fn new(side: usize, stride: usize) -> Self {
        let (lobe, reach) = (side / 3, side / 2);
        // Columns and rows from the top left corner; ends are beyond the last pixel.
        let corners = |(x0, x1): (usize, usize), (y0, y1): (usize, usize)| {
            [y0 * stride + x0, y0 * stride + x1, y1 * stride + x0, y1 * stride + x1]
        };
        let long = (reach + 1 - lobe, reach + lobe);
        let (all, inner) = ((0, side), (lobe, 2 * lobe));
        let (before, after) = ((reach - lobe, reach), (reach + 1, reach + 1 + lobe));
        Self {
            reach,
            xx: [corners(all, long), corners(inner, long)],
            yy: [corners(long, all), corners(long, inner)],
            xy: [
                corners(after, before),
                corners(before, after),
                corners(before, before),
                corners(after, after),
            ],
            per_area: 1.0 / (side * side) as f32,
        }
    }
}

/// Responses that are computed together.
const LANES: usize = 8;

compiled_twice!(
    /// Determinants along a row: the filter's top left corner starts at column `start` of the rows and moves by `step`.
    respond = respond_body(filter: &Filter, rows: &[u32], columns: (usize, usize), out: &mut [f32])
);

#[inline(always)]
fn respond_body(filter: &Filter, rows: &[u32], (start, step): (usize, usize), out: &mut [f32]) {
    let count = out.len();
    let mut at = 0;
    if step == 1 {
        while at + LANES <= count {
            out[at..at + LANES].copy_from_slice(&determinants(filter, rows, start + at));
            at += LANES;
        }
    }
    for (k, out) in out.iter_mut().enumerate().skip(at) {
        *out = determinant_at(filter, rows, start + k * step);
    }
}

#[inline(always)]
fn determinants(filter: &Filter, rows: &[u32], at: usize) -> [f32; LANES] {
    let boxed = |corners: &[usize; 4]| -> [i32; LANES] {
        let [a, b, c, d] =
            corners.map(|offset| rows[at + offset..].first_chunk::<LANES>().expect("the filter fits"));
        let mut sums = [0; LANES];
        for lane in 0..LANES {
            let sum = d[lane].wrapping_sub(c[lane]).wrapping_sub(b[lane]).wrapping_add(a[lane]);
            sums[lane] = sum as i32;
        }
        sums
    };
    let (xx, yy) = (filter.xx.each_ref().map(&boxed), filter.yy.each_ref().map(&boxed));
    let xy = filter.xy.each_ref().map(boxed);
    let mut out = [0.0; LANES];
    for k in 0..LANES {
        out[k] = determinant(
            [xx[0][k], xx[1][k]],
            [yy[0][k], yy[1][k]],
            [xy[0][k], xy[1][k], xy[2][k], xy[3][k]],
            filter.per_area,
        );
    }
    out
}

#[inline(always)]
fn determinant_at(filter: &Filter, rows: &[u32], at: usize) -> f32 {
    let boxed = |corners: &[usize; 4]| -> i32 {
        let [a, b, c, d] = corners.map(|offset| rows[at + offset]);
        d.wrapping_sub(c).wrapping_sub(b).wrapping_add(a) as i32
    };
    let (xx, yy) = (filter.xx.each_ref().map(&boxed), filter.yy.each_ref().map(&boxed));
    determinant(xx, yy, filter.xy.each_ref().map(boxed), filter.per_area)
}

#[inline(always)]
fn determinant(xx: [i32; 2], yy: [i32; 2], xy: [i32; 4], per_area: f32) -> f32 {
    let xx = (xx[0] - 3 * xx[1]) as f32 * per_area;
    let yy = (yy[0] - 3 * yy[1]) as f32 * per_area;
    let xy = (xy[0] + xy[1] - xy[2] - xy[3]) as f32 * per_area;
    xx * yy - MIXED_WEIGHT * (xy * xy)
}

/// The maxima of the middle layer's row `y`.
fn maxima(stack: &[&Layer; 3], y: usize, threshold: f32, (octave, middle): (usize, usize)) -> Vec<Blob> {
    let row = stack[1].row(y);
    let [columns, _] = &stack[2].inside;
    let candidates = (columns.start + 1..columns.end.saturating_sub(1)).filter(|&x| {
        let value = row[x];
        value >= threshold && value > row[x - 1] && value >= row[x + 1]
    });
    candidates.filter_map(|x| blob_at(stack, (x, y), (octave, middle))).collect()
}

fn blob_at(stack: &[&Layer; 3], (x, y): (usize, usize), (octave, middle): (usize, usize)) -> Option<Blob> {
    let values: [[[f32; 3]; 3]; 3] = std::array::from_fn(|s| {
        std::array::from_fn(|dy| std::array::from_fn(|dx| stack[s].row(y + dy - 1)[x + dx - 1]))
    });
    let all = values.as_flattened().as_flattened();
    // Of equal neighbours the first one is the maximum.
    let is_maximum =
        all[..13].iter().all(|other| all[13] > *other) && all[14..].iter().all(|other| all[13] >= *other);
    if !is_maximum {
        return None;
    }
    let (offset, response) = vertex(&values)?;
    let step = (1 << octave) as f32;
    let side = filter_px(octave, middle) as f32;
    let spacing = (filter_px(octave, middle + 1) - filter_px(octave, middle)) as f32;
    Some(Blob {
        x_px: (x as f32 + offset[0]) * step + 0.5,
        y_px: (y as f32 + offset[1]) * step + 0.5,
        scale_px: scale_of_filter(side + offset[2] * spacing),
        response,
    })
}

/// Where the paraboloid through 27 values has its top, in cells from the middle, and its height; `None` when it has none
/// within a cell.
fn vertex(values: &[[[f32; 3]; 3]; 3]) -> Option<([f32; 3], f32)> {
    let at = |dx: usize, dy: usize, ds: usize| f64::from(values[ds][dy][dx]);
    let center = at(1, 1, 1);
    let g = [
        0.5 * (at(2, 1, 1) - at(0, 1, 1)),
        0.5 * (at(1, 2, 1) - at(1, 0, 1)),
        0.5 * (at(1, 1, 2) - at(1, 1, 0)),
    ];
    let a = at(2, 1, 1) + at(0, 1, 1) - 2.0 * center;
    let d = at(1, 2, 1) + at(1, 0, 1) - 2.0 * center;
    let f = at(1, 1, 2) + at(1, 1, 0) - 2.0 * center;
    let b = 0.25 * (at(2, 2, 1) + at(0, 0, 1) - at(0, 2, 1) - at(2, 0, 1));
    let c = 0.25 * (at(2, 1, 2) + at(0, 1, 0) - at(0, 1, 2) - at(2, 1, 0));
    let e = 0.25 * (at(1, 2, 2) + at(1, 0, 0) - at(1, 0, 2) - at(1, 2, 0));
    // Cramer's rule on [[a, b, c], [b, d, e], [c, e, f]] x = -g.
    let cofactors = [d * f - e * e, c * e - b * f, b * e - c * d];
    let determinant = a * cofactors[0] + b * cofactors[1] + c * cofactors[2];
    let (df, ef, ff) = (a * f - c * c, b * c - a * e, a * d - b * b);
    let x = [
        -(cofactors[0] * g[0] + cofactors[1] * g[1] + cofactors[2] * g[2]) / determinant,
        -(cofactors[1] * g[0] + df * g[1] + ef * g[2]) / determinant,
        -(cofactors[2] * g[0] + ef * g[1] + ff * g[2]) / determinant,
    ];
    let height = center + 0.5 * (g[0] * x[0] + g[1] * x[1] + g[2] * x[2]);
    x.iter().all(|offset| offset.abs() < 1.0).then(|| (x.map(|offset| offset as f32), height as f32))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::GrayImage;

    #[test]
    fn filters_have_the_sides_of_the_paper() {
        let sides = |octave: usize| [0, 1, 2, 3].map(|layer| filter_px(octave, layer));
        assert_eq!(
            [sides(0), sides(1), sides(2), sides(3)],
            [[9, 15, 21, 27], [15, 27, 39, 51], [27, 51, 75, 99], [51, 99, 147, 195]]
        );
    }

    fn blob(x: f64, y: f64, sigma: f64) -> GrayImage {
        let (width, height) = (150, 131);
        let value = |at: usize| {
            let (dx, dy) = ((at % width) as f64 + 0.5 - x, (at / width) as f64 + 0.5 - y);
            (30.0 + 200.0 * (-(dx * dx + dy * dy) / (2.0 * sigma * sigma)).exp()).round() as u8
        };
        GrayImage { width, height, data: (0..width * height).map(value).collect() }
    }

    #[test]
    fn blobs_are_found_where_they_are() {
        // Finer blobs than about 2.3 pixels are beyond the smallest filter that has neighbours on both sides.
        for (sigma, bound) in [(2.5, 0.1), (3.0, 0.1), (5.0, 0.2), (8.0, 0.5)] {
            for (x, y) in [(70.5, 66.5), (70.2, 66.9), (71.0, 66.0)] {
                let integral = Integral::new(&blob(x, y, sigma));
                let mut found = detect(Path::detect(), &integral, 4, 1.0);
                found.sort_by(|a, b| b.response.total_cmp(&a.response));
                let best = found.first().expect("a blob is a maximum");
                let error = (f64::from(best.x_px) - x).hypot(f64::from(best.y_px) - y);
                assert!(error < bound, "sigma {sigma}: {error} px away from ({x}, {y})");
                let ratio = f64::from(best.scale_px) / sigma;
                assert!((0.7..1.3).contains(&ratio), "sigma {sigma}: scale {}", best.scale_px);
            }
        }
    }

    #[test]
    fn paths_agree_and_shared_layers_are_the_same() {
        let mut image = blob(60.0, 50.0, 4.0);
        image.data.iter_mut().enumerate().for_each(|(at, v)| *v = v.wrapping_add(((at * 31) % 57) as u8));
        let integral = Integral::new(&image);
        let plain = detect(Path::BASELINE, &integral, 4, 0.5);
        assert!(plain.len() > 20, "{}", plain.len());
        assert_eq!(plain, detect(Path::detect(), &integral, 4, 0.5));
        let shared = layer_of(Path::detect(), &integral, 0, 3).halved();
        assert_eq!(shared.responses, layer_of(Path::BASELINE, &integral, 1, 1).responses);
    }
}
