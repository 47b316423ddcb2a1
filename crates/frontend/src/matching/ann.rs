//! Approximate neighbours: those of one cell in each direction.

use terrane_scene::DESCRIPTOR_LEN;

use super::cells::Cells;
use super::kernel::{MatchKernel, PackedRows};
use super::nearest::Nearest;

/// What is kept of an image.
pub(super) struct Prepared {
    descriptors: Vec<[u8; DESCRIPTOR_LEN]>,
    rows: PackedRows,
    cells: Cells,
}

impl Prepared {
    pub(super) fn new(kernel: MatchKernel, descriptors: Vec<[u8; DESCRIPTOR_LEN]>) -> Self {
        let rows = kernel.pack_rows(&descriptors);
        let cells = Cells::new(kernel, &descriptors, &rows);
        Self { descriptors, rows, cells }
    }

    pub(super) fn descriptors(&self) -> &[[u8; DESCRIPTOR_LEN]] {
        &self.descriptors
    }
}

/// Nearest neighbours as far as they were found.
pub(super) fn nearest(first: &Prepared, second: &Prepared) -> Nearest {
    second.cells.nearest(&first.descriptors, &first.rows)
}
