//! All octaves of a photograph.

use super::extrema::{Extremum, Thresholds};
use super::gradient::Place;
use super::isa::Isa;
use super::octave::{self, Base, LEVELS, Octave};
use super::options::{FirstOctave, SiftOptions};
use crate::image::GrayImage;

/// The shortest side of an octave, in its pixels.
const MIN_SIDE: usize = 12;

/// Octaves, finest first, each of half the resolution of the one before.
pub(super) struct ScaleSpace {
    octaves: Vec<Octave>,
    /// Pixels of the photograph in one of the first octave.
    first_step_px: f32,
}

/// How octaves are computed; none of it changes what is found.
#[derive(Clone, Copy)]
pub(super) struct Paths {
    pub isa: Isa,
    pub tile_columns: usize,
}

/// A blob's octave and where it is in that.
#[derive(Clone, Copy)]
pub(super) struct Blob {
    pub octave: usize,
    pub extremum: Extremum,
}

impl ScaleSpace {
    /// From octave −1 where the options say so, else from octave 0 on.
    pub(super) fn new(paths: Paths, luma: &GrayImage, options: &SiftOptions) -> Self {
        let doubled = options.first_octave == FirstOctave::Doubled;
        let mut space = Self { octaves: Vec::new(), first_step_px: if doubled { 0.5 } else { 1.0 } };
        if luma.data.len() != luma.width * luma.height || luma.data.is_empty() {
            return space;
        }
        for _ in 0..options.num_octaves {
            let base = match space.octaves.last() {
                None => Base::Photo { photo: luma, doubled },
                Some(octave) => Base::Kept(&octave.levels[LEVELS - 1]),
            };
            let Some(octave) = run(paths, base, options) else { break };
            space.octaves.push(octave);
        }
        space
    }

    /// Puts octave −1 before an octave 0.
    pub(super) fn add_doubled(&mut self, paths: Paths, luma: &GrayImage, options: &SiftOptions) {
        debug_assert_eq!(self.first_step_px, 1.0);
        if let Some(octave) = run(paths, Base::Photo { photo: luma, doubled: true }, options) {
            self.octaves.insert(0, octave);
            self.first_step_px = 0.5;
        }
    }

    /// Whether the photograph is too small for a single octave.
    pub(super) fn is_empty(&self) -> bool {
        self.octaves.is_empty()
    }

    /// All blobs, octave by octave.
    pub(super) fn blobs(&self) -> Vec<Blob> {
        let octaves = self.octaves.iter().enumerate();
        octaves
            .flat_map(|(octave, found)| found.extrema.iter().map(move |&extremum| Blob { octave, extremum }))
            .collect()
    }

    /// Pixels of the photograph in one of an octave. Pixel i of an octave lies at pixel i * `step` of the photograph, whose
    /// centre has the coordinate i * `step` + 0.5.
    pub(super) fn step_px(&self, octave: usize) -> f32 {
        self.first_step_px * (1_u32 << octave) as f32
    }

    /// Where a blob's surroundings are.
    pub(super) fn place(&self, blob: &Blob) -> Place<'_> {
        let Extremum { x, y, sigma, level, .. } = blob.extremum;
        let plane = &self.octaves[blob.octave].levels[usize::from(level) - 1];
        let scale = 1.0 / plane.step as f32;
        Place { plane, x: scale * x, y: scale * y, sigma: scale * sigma }
    }
}

/// An octave, unless it is too small.
fn run(paths: Paths, base: Base<'_>, options: &SiftOptions) -> Option<Octave> {
    let thresholds = Thresholds::new(255.0 * options.contrast_threshold, options.edge_threshold);
    let size = base.size();
    (size.width.min(size.height) >= MIN_SIDE)
        .then(|| octave::run(paths.isa, base, &thresholds, paths.tile_columns))
}
