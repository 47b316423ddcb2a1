//! One octave of the scale space, streamed row by row.
//!
//! Six blurred images, five differences of neighbours, extrema in the middle three of these (Lowe 2004). No image of
//! them is held whole: each level lives in a ring of as many rows as the next one's kernel and the search for extrema
//! need. What stays is the three levels that orientations and descriptors are taken from, in 16-bit fixed point, and
//! the first image of the next octave. Rows pass all levels while they are in the cache.

use super::blur::{Blur, Taps};
use super::extrema::{Detector, Extremum};
use super::first::FirstImage;
use super::isa::Isa;
use super::math::exp;
use super::rows::{BLOCK, MARGIN, subtract, to_fixed};

/// Levels in which extrema are searched, per octave (Lowe 2004).
pub(super) const LEVELS: usize = 3;
/// Blurred images per octave.
const IMAGES: usize = LEVELS + 3;
/// Standard deviation of each octave's first image in its own pixels (Lowe 2004).
pub(super) const BASE_SIGMA: f64 = 1.6;

/// Columns and rows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Size {
    pub width: usize,
    pub height: usize,
}

/// The standard deviation of level `s` (possibly fractional) of an octave, in its pixels.
pub(super) fn sigma_of_level(s: f64) -> f64 {
    BASE_SIGMA * exp(std::f64::consts::LN_2 * s / LEVELS as f64)
}

/// The last rows of an image that is made row by row. Rows are padded to whole blocks.
pub(super) struct RowRing {
    stride: usize,
    capacity: usize,
    data: Vec<f32>,
}

impl RowRing {
    pub(super) fn new(width: usize, capacity: usize) -> Self {
        let stride = width.next_multiple_of(BLOCK);
        Self { stride, capacity, data: vec![0.0; stride * capacity] }
    }

    pub(super) fn row(&self, y: usize) -> &[f32] {
        let at = (y % self.capacity) * self.stride;
        &self.data[at..at + self.stride]
    }

    pub(super) fn row_mut(&mut self, y: usize) -> &mut [f32] {
        let at = (y % self.capacity) * self.stride;
        &mut self.data[at..at + self.stride]
    }
}

/// A whole image in 16-bit fixed point (8 fractional bits). [`FixedPlane::SLACK`] values after the last row may be read.
pub(super) struct FixedPlane {
    pub size: Size,
    pub stride: usize,
    pub data: Vec<u16>,
}

impl FixedPlane {
    /// Values behind the last row, so that kernels may read whole blocks anywhere.
    pub(super) const SLACK: usize = 2 * BLOCK;

    fn new(size: Size) -> Self {
        let stride = size.width.next_multiple_of(BLOCK);
        Self { size, stride, data: vec![0; stride * size.height + Self::SLACK] }
    }

    fn row_mut(&mut self, y: usize) -> &mut [u16] {
        &mut self.data[y * self.stride..(y + 1) * self.stride]
    }
}

/// The first image of an octave.
pub(super) enum Base<'a> {
    /// Made from the photograph.
    First(Box<FirstImage<'a>>),
    /// Every second pixel of the octave before, rows of `size.width` values.
    Halved(Size, Vec<f32>),
}

impl Base<'_> {
    pub(super) fn size(&self) -> Size {
        match self {
            Self::First(image) => image.size(),
            Self::Halved(size, _) => *size,
        }
    }

    fn row(&mut self, isa: Isa, y: usize, out: &mut [f32]) {
        match self {
            Self::First(image) => image.row(isa, y, out),
            Self::Halved(size, data) => {
                out[..size.width].copy_from_slice(&data[y * size.width..(y + 1) * size.width])
            }
        }
    }
}

/// What is kept of an octave.
pub(super) struct Octave {
    /// Images of levels 1 to [`LEVELS`].
    pub levels: Vec<FixedPlane>,
    /// What was found in it.
    pub extrema: Vec<Extremum>,
}

/// Runs an octave. Returns it and the first image of the next one.
pub(super) fn run(isa: Isa, mut base: Base<'_>, detector: &mut Detector) -> (Octave, Base<'static>) {
    let size = base.size();
    let half = Size { width: size.width.div_ceil(2), height: size.height.div_ceil(2) };
    let mut stream = Stream::new(isa, size);
    let mut levels: Vec<FixedPlane> = (0..LEVELS).map(|_| FixedPlane::new(size)).collect();
    let mut halved = Vec::with_capacity(half.width * half.height);
    let mut extrema = Vec::new();
    for step in 0..size.height + stream.delays[IMAGES - 1] + Detector::REACH {
        if step < size.height {
            base.row(isa, step, stream.images[0].row_mut(step));
        }
        for s in 1..IMAGES {
            let Some(y) = step.checked_sub(stream.delays[s]).filter(|&y| y < size.height) else { continue };
            stream.make_row(s, y);
            if (1..=LEVELS).contains(&s) {
                to_fixed(isa, stream.images[s].row(y), levels[s - 1].row_mut(y));
            }
            if s == LEVELS && y % 2 == 0 {
                halved.extend(stream.images[s].row(y)[..size.width].iter().step_by(2));
            }
        }
        let searched = step.checked_sub(stream.delays[IMAGES - 1] + Detector::REACH);
        if let Some(y) = searched.filter(|&y| y >= 1 && y + 1 < size.height) {
            detector.search_row(isa, &stream.differences, size, y, &mut extrema);
        }
    }
    (Octave { levels, extrema }, Base::Halved(half, halved))
}

/// The rings of an octave and how they are filled.
struct Stream {
    isa: Isa,
    size: Size,
    blurs: Vec<Blur>,
    /// By how many rows each image trails the first.
    delays: [usize; IMAGES],
    images: Vec<RowRing>,
    differences: Vec<RowRing>,
    padded: Vec<f32>,
}

impl Stream {
    fn new(isa: Isa, size: Size) -> Self {
        let blurs: Vec<Blur> = (1..IMAGES)
            .map(|s| {
                let (from, to) = (sigma_of_level(s as f64 - 1.0), sigma_of_level(s as f64));
                Blur::new(Taps::gaussian((to * to - from * from).sqrt(), false))
            })
            .collect();
        let mut delays = [0; IMAGES];
        for s in 1..IMAGES {
            delays[s] = delays[s - 1] + blurs[s - 1].taps.radius();
        }
        let last = delays[IMAGES - 1];
        let images = (0..IMAGES)
            .map(|s| RowRing::new(size.width, blurs.get(s).map_or(1, |blur| 2 * blur.taps.radius() + 1)))
            .collect();
        let differences = (0..IMAGES - 1)
            .map(|s| RowRing::new(size.width, last - delays[s + 1] + 2 * Detector::REACH + 1))
            .collect();
        let padded = vec![0.0; size.width.next_multiple_of(BLOCK) + 2 * MARGIN];
        Self { isa, size, blurs, delays, images, differences, padded }
    }

    /// Makes row `y` of image `s` from the image before, and of the difference of the two.
    fn make_row(&mut self, s: usize, y: usize) {
        let (before, after) = self.images.split_at_mut(s);
        let (before, after) = (&before[s - 1], &mut after[0]);
        let last_row = self.size.height as isize - 1;
        let row = |y: isize| before.row(y.clamp(0, last_row) as usize);
        self.blurs[s - 1].row(self.isa, (y, self.size.width), row, (&mut self.padded, after.row_mut(y)));
        subtract(self.isa, after.row(y), before.row(y), self.differences[s - 1].row_mut(y));
    }
}
