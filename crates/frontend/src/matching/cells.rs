//! One image's descriptors in cells around some of them, to find near ones of another image quickly: an inverted file
//! (Sivic & Zisserman 2003). What it finds is not always the nearest, but bounds how far the nearest are.

use terrane_scene::DESCRIPTOR_LEN;

use super::kernel::{MatchKernel, PackedColumns, PackedRows};
use super::nearest::{Best, Nearest};

type Descriptor = [u8; DESCRIPTOR_LEN];

/// Descriptors of a cell, on average.
const CELL_SIZE: usize = 64;

pub(super) struct Cells {
    kernel: MatchKernel,
    leaders: PackedColumns,
    num_leaders: usize,
    cells: Vec<Cell>,
    len: usize,
}

struct Cell {
    members: Vec<u32>,
    columns: PackedColumns,
}

impl Cells {
    /// Leaders are descriptors at equal steps; each descriptor goes to the nearest leader.
    pub(super) fn new(kernel: MatchKernel, descriptors: &[Descriptor], rows: &PackedRows) -> Self {
        let num_leaders = descriptors.len().div_ceil(CELL_SIZE);
        let mut leaders: Vec<Descriptor> =
            (0..num_leaders).map(|at| descriptors[at * descriptors.len() / num_leaders]).collect();
        leaders.sort_unstable();
        leaders.dedup();
        let num_leaders = leaders.len();
        let leaders = kernel.pack_columns(&leaders);
        let members = grouped(&kernel.nearest_packed(rows, &leaders), num_leaders);
        let cell = |members: Vec<u32>| Cell {
            columns: kernel.pack_columns(&gathered(descriptors, &members)),
            members,
        };
        let cells = members.into_iter().map(cell).collect();
        Self { kernel, leaders, num_leaders, cells, len: descriptors.len() }
    }

    /// For each descriptor of another image its nearest of the cell that it would go to, and for each of these its
    /// nearest of those that came.
    pub(super) fn nearest(&self, descriptors: &[Descriptor], rows: &PackedRows) -> Nearest {
        let arrivals = grouped(&self.kernel.nearest_packed(rows, &self.leaders), self.num_leaders);
        let nobody = |len: usize| Best::new(len).neighbours(&(0..len as u32).collect::<Vec<_>>(), &[]);
        let mut nearest = Nearest { rows: nobody(descriptors.len()), columns: nobody(self.len) };
        for (cell, arrivals) in self.cells.iter().zip(&arrivals) {
            if arrivals.is_empty() {
                continue;
            }
            let rows = self.kernel.pack_rows(&gathered(descriptors, arrivals));
            let found = self.kernel.nearest_packed(&rows, &cell.columns);
            for (&row, mut neighbour) in arrivals.iter().zip(found.rows) {
                neighbour.index = neighbour.index.map(|at| cell.members[at as usize]);
                nearest.rows[row as usize] = neighbour;
            }
            for (&column, mut neighbour) in cell.members.iter().zip(found.columns) {
                neighbour.index = neighbour.index.map(|at| arrivals[at as usize]);
                nearest.columns[column as usize] = neighbour;
            }
        }
        nearest
    }
}

/// Which descriptors go to each leader.
fn grouped(nearest: &Nearest, num_leaders: usize) -> Vec<Vec<u32>> {
    let mut groups = vec![Vec::new(); num_leaders];
    for (at, neighbour) in nearest.rows.iter().enumerate() {
        // Between two leaders the first cell is as good as any.
        let leader = neighbour.index.unwrap_or(0) as usize;
        if let Some(group) = groups.get_mut(leader) {
            group.push(at as u32);
        }
    }
    groups
}

fn gathered(descriptors: &[Descriptor], at: &[u32]) -> Vec<Descriptor> {
    at.iter().map(|&at| descriptors[at as usize]).collect()
}
