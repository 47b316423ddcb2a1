//! One octave of the scale space, streamed row by row through tiles of columns.
//!
//! Six blurred images, five differences of neighbours, extrema in the middle three of these (Lowe 2004). No image of
//! them is held whole: each level lives in a ring of as many rows as the next one's kernel and the search for extrema
//! need, and a tile is so narrow that all its rings stay in the second cache. Tiles overlap by what the kernels reach, so
//! that their number changes nothing. What stays of an octave is the three levels that orientations and descriptors are
//! taken from, of the third only every second pixel, which is the first image of the next octave.

use std::ops::Range;

use rayon::prelude::*;

use super::blur::{Taps, fill_margins};
use super::extrema::{Detector, Extremum, Thresholds};
use super::first::{FirstImage, size_of_first};
use super::isa::Isa;
use super::math::exp;
use super::rows::{BLOCK, MARGIN, from_plane, subtract, to_half_plane, to_plane};
use crate::image::GrayImage;

/// Levels in which extrema are searched, per octave (Lowe 2004).
pub(super) const LEVELS: usize = 3;
/// Blurred images per octave.
const IMAGES: usize = LEVELS + 3;
/// Standard deviation of each octave's first image in its own pixels (Lowe 2004).
pub(super) const BASE_SIGMA: f64 = 1.6;
/// Columns that a tile has at most, overlaps included: its rings take some 450 bytes a column.
pub(super) const TILE_COLUMNS: usize = 1024;

/// Of each level that is kept, every how manieth row and column. The blur of the third is more than three pixels of the
/// octave, so that half of them hold it; with half of the others, some 2 % of the matches across a rotation were lost, for
/// strength and direction of a gradient need twice the samples that brightness does.
const STEPS: [usize; LEVELS] = [1, 1, 2];

/// Columns and rows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Size {
    pub width: usize,
    pub height: usize,
}

impl Size {
    fn every(self, step: usize) -> Self {
        Self { width: self.width.div_ceil(step), height: self.height.div_ceil(step) }
    }
}

/// The standard deviation of level `s` (possibly fractional) of an octave, in its pixels.
pub(super) fn sigma_of_level(s: f64) -> f64 {
    BASE_SIGMA * exp(std::f64::consts::LN_2 * s / LEVELS as f64)
}

/// The last rows of an image that is made row by row. Rows are padded to whole blocks.
pub(super) struct RowRing<T> {
    stride: usize,
    capacity: usize,
    data: Vec<T>,
}

impl<T: Copy + Default> RowRing<T> {
    pub(super) fn new(width: usize, capacity: usize) -> Self {
        let stride = width.next_multiple_of(BLOCK);
        Self { stride, capacity, data: vec![T::default(); stride * capacity] }
    }

    pub(super) fn row(&self, y: usize) -> &[T] {
        let at = (y % self.capacity) * self.stride;
        &self.data[at..at + self.stride]
    }

    pub(super) fn row_mut(&mut self, y: usize) -> &mut [T] {
        let at = (y % self.capacity) * self.stride;
        &mut self.data[at..at + self.stride]
    }
}

/// A level of an octave in fixed point; see [`super::rows`].
pub(super) struct Plane {
    pub size: Size,
    /// Pixels of the octave in one of the plane.
    pub step: usize,
    /// `width * height` values and [`Plane::SLACK`] behind them.
    pub data: Vec<u16>,
}

impl Plane {
    /// Values behind the last row, so that kernels may read whole vectors anywhere.
    pub(super) const SLACK: usize = 64;

    fn new(octave: Size, step: usize) -> Self {
        let size = octave.every(step);
        Self { size, step, data: vec![0; size.width * size.height + Self::SLACK] }
    }

    fn row(&self, y: usize) -> &[u16] {
        &self.data[y * self.size.width..(y + 1) * self.size.width]
    }

    /// The rows of each of some ranges of columns, which follow one another.
    fn columns_mut(&mut self, ranges: &[Range<usize>]) -> Vec<Vec<&mut [u16]>> {
        let mut parts: Vec<Vec<&mut [u16]>> =
            ranges.iter().map(|_| Vec::with_capacity(self.size.height)).collect();
        let pixels = self.size.width * self.size.height;
        for mut row in self.data[..pixels].chunks_exact_mut(self.size.width.max(1)) {
            for (part, range) in parts.iter_mut().zip(ranges) {
                let (mine, rest) = row.split_at_mut(range.len());
                part.push(mine);
                row = rest;
            }
        }
        parts
    }
}

/// The first image of an octave.
#[derive(Clone, Copy)]
pub(super) enum Base<'a> {
    /// Made from the photograph, at twice its resolution or at its own.
    Photo { photo: &'a GrayImage, doubled: bool },
    /// Kept from the octave before.
    Kept(&'a Plane),
}

impl<'a> Base<'a> {
    pub(super) fn size(&self) -> Size {
        match self {
            Self::Photo { photo, doubled } => size_of_first(photo, *doubled),
            Self::Kept(plane) => plane.size,
        }
    }

    fn rows(&self, columns: &Range<usize>) -> BaseRows<'a> {
        match *self {
            Self::Photo { photo, doubled } => {
                BaseRows::Photo(Box::new(FirstImage::new(photo, doubled, columns)))
            }
            Self::Kept(plane) => BaseRows::Kept(plane, columns.clone()),
        }
    }
}

/// Some columns of an octave's first image.
enum BaseRows<'a> {
    Photo(Box<FirstImage<'a>>),
    Kept(&'a Plane, Range<usize>),
}

impl BaseRows<'_> {
    fn row(&mut self, isa: Isa, y: usize, out: &mut [i16]) {
        match self {
            Self::Photo(image) => image.row(isa, y, out),
            Self::Kept(plane, columns) => {
                from_plane(isa, &plane.row(y)[columns.clone()], out);
            }
        }
    }
}

/// What is kept of an octave.
pub(super) struct Octave {
    /// Images 1 to [`LEVELS`].
    pub levels: Vec<Plane>,
    /// What was found in it.
    pub extrema: Vec<Extremum>,
}

/// Runs an octave in tiles of at most `tile_columns` columns, in parallel where threads are idle.
pub(super) fn run(isa: Isa, base: Base<'_>, thresholds: &Thresholds, tile_columns: usize) -> Octave {
    let size = base.size();
    let blurs = blurs();
    let tiles = tiles(size.width, tile_columns, overlap(&blurs));
    let mut levels: Vec<Plane> = STEPS.iter().map(|&step| Plane::new(size, step)).collect();
    let mut kept: Vec<Vec<Vec<&mut [u16]>>> = tiles.iter().map(|_| Vec::with_capacity(LEVELS)).collect();
    for level in &mut levels {
        let step = level.step;
        let parts: Vec<Range<usize>> =
            tiles.iter().map(|tile| tile.core.start / step..tile.core.end.div_ceil(step)).collect();
        for (kept, part) in kept.iter_mut().zip(level.columns_mut(&parts)) {
            kept.push(part);
        }
    }
    let found: Vec<Vec<Extremum>> = tiles
        .par_iter()
        .zip(kept)
        .map(|(tile, mut kept)| Stream::new(isa, size.height, tile, &blurs).run(base, thresholds, &mut kept))
        .collect();
    Octave { levels, extrema: found.concat() }
}

/// A vertical strip of an octave.
struct Tile {
    /// What is computed.
    columns: Range<usize>,
    /// What is kept of it. Starts at an even column.
    core: Range<usize>,
}

/// What makes each image of the one before.
fn blurs() -> Vec<Taps> {
    (1..IMAGES).map(|s| Taps::increment(sigma_of_level(s as f64 - 1.0), sigma_of_level(s as f64))).collect()
}

/// Columns by which a tile reaches over its neighbours: the sum of the kernels' radii and what the search looks at. Even,
/// as tiles start at even columns.
fn overlap(blurs: &[Taps]) -> usize {
    (blurs.iter().map(Taps::radius).sum::<usize>() + Detector::REACH).next_multiple_of(2)
}

/// Cuts a width into tiles whose cores follow one another.
fn tiles(width: usize, tile_columns: usize, overlap: usize) -> Vec<Tile> {
    let core = tile_columns.saturating_sub(2 * overlap).max(2 * BLOCK);
    let count = if width <= core + overlap { 1 } else { width.div_ceil(core) };
    let core = width.div_ceil(count).next_multiple_of(2);
    (0..count)
        .map(|k| (k * core).min(width)..((k + 1) * core).min(width))
        .filter(|core| !core.is_empty())
        .map(|core| Tile {
            columns: core.start.saturating_sub(overlap)..(core.end + overlap).min(width),
            core,
        })
        .collect()
}

/// The rings of a tile and how they are filled.
struct Stream<'a> {
    isa: Isa,
    height: usize,
    tile: &'a Tile,
    blurs: &'a [Taps],
    /// By how many rows each image trails the first.
    delays: [usize; IMAGES],
    images: Vec<RowRing<i16>>,
    differences: Vec<RowRing<i16>>,
    padded: Vec<i16>,
}

impl<'a> Stream<'a> {
    fn new(isa: Isa, height: usize, tile: &'a Tile, blurs: &'a [Taps]) -> Self {
        let mut delays = [0; IMAGES];
        for s in 1..IMAGES {
            delays[s] = delays[s - 1] + blurs[s - 1].radius();
        }
        let last = delays[IMAGES - 1];
        let width = tile.columns.len();
        let images = (0..IMAGES)
            .map(|s| RowRing::new(width, blurs.get(s).map_or(1, |blur| 2 * blur.radius() + 1)))
            .collect();
        let differences = (0..IMAGES - 1)
            .map(|s| RowRing::new(width, last - delays[s + 1] + 2 * Detector::REACH + 1))
            .collect();
        let padded = vec![0; width.next_multiple_of(BLOCK) + 2 * MARGIN];
        Self { isa, height, tile, blurs, delays, images, differences, padded }
    }

    /// Writes the core of levels 1 to [`LEVELS`] to `kept`; returns the extrema.
    fn run(mut self, base: Base<'_>, thresholds: &Thresholds, kept: &mut [Vec<&mut [u16]>]) -> Vec<Extremum> {
        let Tile { columns, core } = self.tile;
        let inside = core.start - columns.start..core.end - columns.start;
        let mut base = base.rows(columns);
        let mut detector = Detector::new(thresholds, columns.start, self.height, columns.len());
        let mut extrema = Vec::new();
        let last_delay = self.delays[IMAGES - 1];
        for step in 0..self.height + last_delay + Detector::REACH {
            if step < self.height {
                base.row(self.isa, step, self.images[0].row_mut(step));
            }
            for s in 1..IMAGES {
                let Some(y) = step.checked_sub(self.delays[s]).filter(|&y| y < self.height) else { continue };
                self.make_row(s, y);
                if (1..=LEVELS).contains(&s) {
                    self.keep_row(s, y, &inside, &mut kept[s - 1]);
                }
            }
            let searched = step.checked_sub(last_delay + Detector::REACH);
            if let Some(y) = searched.filter(|&y| y >= 1 && y + 1 < self.height) {
                detector.search_row(self.isa, &self.differences, y, &inside, &mut extrema);
            }
        }
        extrema
    }

    /// Writes `columns` of row `y` of level `s` to its plane, as far as the plane has them.
    fn keep_row(&self, s: usize, y: usize, columns: &Range<usize>, kept: &mut [&mut [u16]]) {
        let step = STEPS[s - 1];
        if !y.is_multiple_of(step) {
            return;
        }
        let row = &self.images[s].row(y)[columns.start..columns.end.next_multiple_of(step)];
        match step {
            1 => to_plane(self.isa, row, kept[y]),
            _ => to_half_plane(self.isa, row, kept[y / step]),
        }
    }

    /// Makes row `y` of image `s` from the image before, and of the difference of the two.
    fn make_row(&mut self, s: usize, y: usize) {
        let (before, after) = self.images.split_at_mut(s);
        let (before, after) = (&before[s - 1], after[0].row_mut(y));
        let blur = &self.blurs[s - 1];
        let last_row = self.height as isize - 1;
        let row = |y: isize| before.row(y.clamp(0, last_row) as usize);
        blur.blur_rows(self.isa, y, row, &mut self.padded[MARGIN..MARGIN + after.len()]);
        fill_margins(&mut self.padded, self.tile.columns.len());
        blur.blur_columns(self.isa, &self.padded, after);
        subtract(self.isa, after, before.row(y), self.differences[s - 1].row_mut(y));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cores_follow_one_another_and_start_at_even_columns() {
        for width in [1, 2, 63, 175, 176, 177, 500, 928, 1024, 1025, 4001, 6144] {
            for tile_columns in [1, 256, 1024] {
                let tiles = tiles(width, tile_columns, overlap(&blurs()));
                assert_eq!((tiles[0].core.start, tiles[tiles.len() - 1].core.end), (0, width));
                assert!(tiles.windows(2).all(|pair| pair[0].core.end == pair[1].core.start));
                assert!(tiles.iter().all(|tile| tile.core.start % 2 == 0));
            }
        }
    }
}
