//! The two least distances of each descriptor.

use super::{Nearest, Neighbour};

/// Above every distance.
const NOTHING: u16 = u16::MAX;

/// Least and second least distance of each descriptor, and where the least one is.
pub(super) struct Best {
    first: Vec<u16>,
    pub(super) second: Vec<u16>,
    at: Vec<u32>,
}

impl Best {
    pub(super) fn new(count: usize) -> Self {
        Self { first: vec![NOTHING; count], second: vec![NOTHING; count], at: vec![0; count] }
    }

    /// Takes the distance between descriptor `index` and one of the others into account. The order of offers does not
    /// matter: where two are equally near, neither is the nearest.
    #[inline(always)]
    pub(super) fn offer(&mut self, index: usize, other: usize, distance: u16) {
        if distance < self.first[index] {
            self.second[index] = self.first[index];
            self.first[index] = distance;
            self.at[index] = other as u32;
        } else if distance < self.second[index] {
            self.second[index] = distance;
        }
    }

    pub(super) fn neighbours(&self) -> Vec<Neighbour> {
        let distance = |value: u16| if value == NOTHING { u32::MAX } else { u32::from(value) };
        let neighbour = |index: usize| Neighbour {
            index: (self.first[index] < self.second[index]).then_some(self.at[index]),
            distance_squared: distance(self.first[index]),
            second_squared: distance(self.second[index]),
        };
        (0..self.first.len()).map(neighbour).collect()
    }
}

/// Both directions.
pub(super) struct State {
    pub(super) rows: Best,
    pub(super) columns: Best,
}

impl State {
    pub(super) fn new(num_rows: usize, num_columns: usize) -> Self {
        Self { rows: Best::new(num_rows), columns: Best::new(num_columns) }
    }

    #[inline]
    pub(super) fn offer(&mut self, row: usize, column: usize, distance: u16) {
        self.rows.offer(row, column, distance);
        self.columns.offer(column, row, distance);
    }

    pub(super) fn nearest(&self) -> Nearest {
        Nearest { rows: self.rows.neighbours(), columns: self.columns.neighbours() }
    }
}
