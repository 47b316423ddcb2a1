//! Approximate neighbours: the nearest of a few cells of the other image.

use terrane_scene::DESCRIPTOR_LEN;

use super::cells::{Cells, Image, Two, near};
use super::distance::Measured;
use super::nearest::Nearest;
use super::sketch::Sketches;
use super::sweep::SweepPath;

/// Cells that each descriptor looks into: 0.993 of the matches of real pairs; 4 find 0.986, 6 find 0.996.
const NUM_PROBES: usize = 5;

/// What is kept of an image, sorted by cell.
pub(super) struct Prepared {
    descriptors: Measured,
    sketches: Sketches,
    cells: Cells,
    order: Vec<u32>,
}

impl Prepared {
    pub(super) fn new(descriptors: &[[u8; DESCRIPTOR_LEN]], path: SweepPath) -> Self {
        let (cells, sketches, order) = Cells::new(Sketches::new(descriptors), path);
        Self { cells, sketches, descriptors: Measured::new(descriptors, &order), order }
    }

    /// In the order of [`Prepared::order`].
    pub(super) fn descriptors(&self) -> &[[u8; DESCRIPTOR_LEN]] {
        self.descriptors.descriptors()
    }

    /// Where each descriptor was among those given.
    pub(super) fn order(&self) -> &[u32] {
        &self.order
    }

    fn image(&self) -> Image<'_> {
        Image { descriptors: &self.descriptors, sketches: &self.sketches, cells: &self.cells }
    }
}

/// Nearest neighbours as far as they were found, in the orders of both images.
pub(super) fn nearest(first: &Prepared, second: &Prepared) -> Nearest {
    let (rows, columns) = near::<NUM_PROBES>(first.image(), second.image());
    Nearest {
        rows: rows.iter().map(Two::neighbour).collect(),
        columns: columns.iter().map(Two::neighbour).collect(),
    }
}
