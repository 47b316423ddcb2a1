//! Harris corners (Harris & Stephens 1988): places around which the gradients point in many directions.
//!
//! The measure is det M − 0.04 (tr M)², M being the mean of the gradients' outer products (by Sobel, in greys a pixel)
//! under a binomial window of seven by seven pixels. Its unit is the fourth power of greys a pixel.

use crate::image::GrayImage;
use crate::simd::{Path, compiled_twice};

use super::Candidate;
use super::fast::MARGIN;

/// Half of the window, by distance from its middle.
const WINDOW: [f32; 7] = [1.0, 6.0, 15.0, 20.0, 15.0, 6.0, 1.0];
const RADIUS: usize = WINDOW.len() / 2;
/// What sums of products of Sobel's differences are divided by: 8² and the window's sum.
const SCALE: f32 = 1.0 / (64.0 * 4096.0);
/// The measure's weight of the squared trace (Harris & Stephens 1988).
const TRACE_WEIGHT: f32 = 0.04;

#[inline(always)]
fn measure(xx: f32, xy: f32, yy: f32) -> f32 {
    let (xx, xy, yy) = (xx * SCALE, xy * SCALE, yy * SCALE);
    let trace = xx + yy;
    (xx * yy - xy * xy) - TRACE_WEIGHT * (trace * trace)
}

/// Corners whose measure is at least `threshold`, by rows, not exceeded by a neighbour.
pub(super) fn detect(path: Path, image: &GrayImage, threshold: f32) -> Vec<Candidate> {
    let (width, height) = (image.width, image.height);
    let mut found = Vec::new();
    if width <= 2 * MARGIN || height <= 2 * MARGIN {
        return found;
    }
    let mut stream = Stream::new(path, image);
    let mut rows = [vec![0.0; width], vec![0.0; width], vec![0.0; width]];
    for y in MARGIN - 1..height - MARGIN + 1 {
        rows.rotate_left(1);
        stream.measure_row(y, &mut rows[2]);
        if y > MARGIN {
            keep_strongest(&rows, y - 1, threshold, &mut found);
        }
    }
    found
}

/// Replaces the strength of candidates, which are in the order of rows, by the measure at their pixels.
pub(super) fn rate(path: Path, image: &GrayImage, candidates: &mut [Candidate]) {
    let mut stream = Stream::new(path, image);
    let mut row = vec![0.0; image.width];
    for of_row in candidates.chunk_by_mut(|a, b| a.y == b.y) {
        stream.measure_row(of_row[0].y, &mut row);
        of_row.iter_mut().for_each(|candidate| candidate.response = row[candidate.x]);
    }
}

/// Appends the corners of row `y`, the middle one; of equal neighbours the first stays.
fn keep_strongest(rows: &[Vec<f32>; 3], y: usize, threshold: f32, found: &mut Vec<Candidate>) {
    let [above, row, below] = rows;
    for x in MARGIN..row.len() - MARGIN {
        let value = row[x];
        if !(value >= threshold && value > row[x - 1] && value >= row[x + 1]) {
            continue;
        }
        let is_peak = (x - 1..=x + 1).all(|k| value > above[k] && value >= below[k]);
        if is_peak {
            found.push(Candidate { x, y, response: value });
        }
    }
}

/// Products of gradients, row by row, and their sums down the window.
struct Stream<'a> {
    path: Path,
    image: &'a GrayImage,
    /// The last seven rows of the products xx, xy and yy.
    products: Vec<[Vec<f32>; 3]>,
    done: usize,
    sums: [Vec<f32>; 3],
}

impl<'a> Stream<'a> {
    fn new(path: Path, image: &'a GrayImage) -> Self {
        let rows = || std::array::from_fn(|_| vec![0.0; image.width]);
        let products = (0..WINDOW.len()).map(|_| rows()).collect();
        Self { path, image, products, done: MARGIN - 1 - RADIUS, sums: rows() }
    }

    /// The measure along row `y`; rows are asked for in rising order, from `MARGIN - 1` to as far from the other edge.
    fn measure_row(&mut self, y: usize, out: &mut [f32]) {
        let row = |y: usize| &self.image.data[y * self.image.width..(y + 1) * self.image.width];
        self.done = self.done.max(y - RADIUS);
        while self.done <= y + RADIUS {
            let [xx, xy, yy] = &mut self.products[self.done % WINDOW.len()];
            multiply(self.path, [row(self.done - 1), row(self.done), row(self.done + 1)], [xx, xy, yy]);
            self.done += 1;
        }
        for (which, sum) in self.sums.iter_mut().enumerate() {
            let row = |k: usize| self.products[(y + k - RADIUS) % WINDOW.len()][which].as_slice();
            sum_down(self.path, std::array::from_fn(row), sum);
        }
        let [xx, xy, yy] = &self.sums;
        measure_across(self.path, [xx, xy, yy], out);
    }
}

compiled_twice!(
    /// Products of Sobel's differences along the middle row, but for its ends.
    multiply = multiply_body(rows: [&[u8]; 3], out: [&mut [f32]; 3])
);
compiled_twice!(sum_down = sum_down_body(rows: [&[f32]; WINDOW.len()], out: &mut [f32]));
compiled_twice!(
    /// The measure from sums down the window; nothing at the row's ends.
    measure_across = measure_across_body(sums: [&[f32]; 3], out: &mut [f32])
);

#[inline(always)]
fn multiply_body(rows: [&[u8]; 3], out: [&mut [f32]; 3]) {
    let inner = rows[0].len() - 2;
    let [above, row, below] = rows.map(|row| &row[..inner + 2]);
    let [xx, xy, yy] = out.map(|out| &mut out[1..=inner]);
    for x in 0..inner {
        let value = |row: &[u8], x: usize| i32::from(row[x]);
        let dx = value(above, x + 2) - value(above, x)
            + 2 * (value(row, x + 2) - value(row, x))
            + value(below, x + 2)
            - value(below, x);
        let dy = value(below, x) - value(above, x)
            + 2 * (value(below, x + 1) - value(above, x + 1))
            + value(below, x + 2)
            - value(above, x + 2);
        xx[x] = (dx * dx) as f32;
        xy[x] = (dx * dy) as f32;
        yy[x] = (dy * dy) as f32;
    }
}

#[inline(always)]
fn sum_down_body(rows: [&[f32]; WINDOW.len()], out: &mut [f32]) {
    let rows = rows.map(|row| &row[..out.len()]);
    for x in 0..out.len() {
        let mut sum = 0.0;
        for k in 0..WINDOW.len() {
            sum += rows[k][x] * WINDOW[k];
        }
        out[x] = sum;
    }
}

#[inline(always)]
fn measure_across_body(sums: [&[f32]; 3], out: &mut [f32]) {
    let inner = out.len() - 2 * RADIUS;
    let [xx, xy, yy] = sums.map(|row| &row[..inner + 2 * RADIUS]);
    let out = &mut out[RADIUS..RADIUS + inner];
    for x in 0..inner {
        let mut sums = [0.0_f32; 3];
        for k in 0..WINDOW.len() {
            sums[0] += xx[x + k] * WINDOW[k];
            sums[1] += xy[x + k] * WINDOW[k];
            sums[2] += yy[x + k] * WINDOW[k];
        }
        out[x] = measure(sums[0], sums[1], sums[2]);
    }
}

/// Side of the patch of gradients that a three by three patch of measures needs.
const PATCH: usize = 2 + WINDOW.len();

/// The measure at a pixel and its eight neighbours; the pixel lies at least five inside.
fn measures(image: &GrayImage, x: usize, y: usize) -> [[f32; 3]; 3] {
    let value = |x: usize, y: usize| i32::from(image.data[y * image.width + x]);
    let mut down = [[[0.0_f32; 3]; PATCH]; 3];
    for row in 0..PATCH {
        let y = y + row - PATCH / 2;
        for column in 0..PATCH {
            let x = x + column - PATCH / 2;
            let dx = value(x + 1, y - 1) - value(x - 1, y - 1)
                + 2 * (value(x + 1, y) - value(x - 1, y))
                + value(x + 1, y + 1)
                - value(x - 1, y + 1);
            let dy = value(x - 1, y + 1) - value(x - 1, y - 1)
                + 2 * (value(x, y + 1) - value(x, y - 1))
                + value(x + 1, y + 1)
                - value(x + 1, y - 1);
            let products = [(dx * dx) as f32, (dx * dy) as f32, (dy * dy) as f32];
            for (start, down) in down.iter_mut().enumerate() {
                if let Some(weight) = row.checked_sub(start).and_then(|k| WINDOW.get(k)) {
                    (0..3).for_each(|k| down[column][k] += products[k] * weight);
                }
            }
        }
    }
    down.map(|row| {
        std::array::from_fn(|start| {
            let sum = |which: usize| {
                (0..WINDOW.len()).map(|k| row[start + k][which] * WINDOW[k]).fold(0.0_f32, |a, b| a + b)
            };
            measure(sum(0), sum(1), sum(2))
        })
    })
}

/// The measure at a pixel, which lies at least five inside.
#[cfg(test)]
fn measure_at(image: &GrayImage, x: usize, y: usize) -> f32 {
    measures(image, x, y)[1][1]
}

/// How far a refined place may be from the pixel that it started from, in pixels along each axis.
const MAX_STEPS: usize = 2;

/// The peak of the measure near a pixel at least [`MARGIN`] inside, in fractions of pixels.
///
/// A paraboloid through the square roots of the measure and of its neighbours' (Brown & Lowe 2002 do so with blobs).
/// Where there is no peak nearby the pixel itself is the answer.
pub(super) fn refine(image: &GrayImage, x: usize, y: usize) -> (f32, f32) {
    let (mut at_x, mut at_y) = (x, y);
    for _ in 0..=MAX_STEPS {
        let values = measures(image, at_x, at_y);
        let (mut best, mut step) = (values[1][1], (1, 1));
        for row in 0..3 {
            for column in 0..3 {
                if values[row][column] > best {
                    (best, step) = (values[row][column], (column, row));
                }
            }
        }
        if step == (1, 1) {
            let (dx, dy) = peak(&values.map(|row| row.map(|v| v.max(0.0).sqrt()))).unwrap_or((0.0, 0.0));
            return (at_x as f32 + dx, at_y as f32 + dy);
        }
        (at_x, at_y) = (at_x + step.0 - 1, at_y + step.1 - 1);
        if at_x.abs_diff(x) > MAX_STEPS || at_y.abs_diff(y) > MAX_STEPS {
            break;
        }
    }
    (x as f32, y as f32)
}

/// Where the paraboloid through nine values has its top, from the middle; `None` when it has none within the patch.
fn peak(v: &[[f32; 3]; 3]) -> Option<(f32, f32)> {
    let (gx, gy) = (0.5 * (v[1][2] - v[1][0]), 0.5 * (v[2][1] - v[0][1]));
    let (xx, yy) = (v[1][2] + v[1][0] - 2.0 * v[1][1], v[2][1] + v[0][1] - 2.0 * v[1][1]);
    let xy = 0.25 * (v[2][2] + v[0][0] - v[2][0] - v[0][2]);
    let determinant = xx * yy - xy * xy;
    let (dx, dy) = ((xy * gy - yy * gx) / determinant, (xy * gx - xx * gy) / determinant);
    (determinant > 0.0 && xx < 0.0 && dx.abs() <= 1.0 && dy.abs() <= 1.0).then_some((dx, dy))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn smooth(width: usize, height: usize) -> GrayImage {
        let value = |at: usize| {
            let (x, y) = ((at % width) as f64, (at / width) as f64);
            (128.0 + 60.0 * (x / 3.1).sin() * (y / 2.7).cos() + 40.0 * ((x + y) / 11.0).sin()) as u8
        };
        GrayImage { width, height, data: (0..width * height).map(value).collect() }
    }

    #[test]
    fn the_map_is_the_measure_at_each_pixel_on_every_path() {
        let image = smooth(77, 45);
        let plain = detect(Path::BASELINE, &image, 1.0);
        assert!(plain.len() > 20);
        assert_eq!(plain, detect(Path::detect(), &image, 1.0));
        for corner in plain {
            assert_eq!(corner.response, measure_at(&image, corner.x, corner.y));
        }
        let mut some: Vec<Candidate> =
            [(9, 8), (30, 8), (12, 21), (60, 36)].map(|(x, y)| Candidate { x, y, response: 0.0 }).to_vec();
        rate(Path::detect(), &image, &mut some);
        for rated in some {
            assert_eq!(rated.response, measure_at(&image, rated.x, rated.y));
        }
    }

    #[test]
    fn edges_and_flats_are_no_corners() {
        let mut image = GrayImage { width: 60, height: 50, data: vec![20; 3000] };
        assert!(detect(Path::detect(), &image, 1e-3).is_empty());
        for row in image.data.chunks_mut(60) {
            row[30..].fill(220);
        }
        assert!(detect(Path::detect(), &image, 1e-3).is_empty());
        image.data[25 * 60..].fill(20);
        let found = detect(Path::detect(), &image, 1.0);
        assert_eq!(found.len(), 1, "{found:?}");
        assert!(found[0].x.abs_diff(30) <= 2 && found[0].y.abs_diff(24) <= 2, "{found:?}");
        assert!(refine(&image, found[0].x, found[0].y).0 > 28.0);
    }
}
