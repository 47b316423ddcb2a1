//! The oracle: squared distances by their definition, one pair of descriptors after another.

use terrane_scene::DESCRIPTOR_LEN;

use super::nearest::{Best, Nearest};

/// Nearest neighbours in both directions.
pub(super) fn nearest(first: &[[u8; DESCRIPTOR_LEN]], second: &[[u8; DESCRIPTOR_LEN]]) -> Nearest {
    let mut rows = Best::new(first.len());
    let mut columns = Best::new(second.len());
    for (row, a) in first.iter().enumerate() {
        for (column, b) in second.iter().enumerate() {
            let score = -distance_squared(a, b);
            rows.offer(row, column, score);
            columns.offer(column, row, score);
        }
    }
    let identity = |len: usize| (0..len as u32).collect::<Vec<_>>();
    let (first, second) = (identity(first.len()), identity(second.len()));
    Nearest { rows: rows.neighbours(&first, &second), columns: columns.neighbours(&second, &first) }
}

/// Squared Euclidean distance between bytes.
pub(super) fn distance_squared(a: &[u8; DESCRIPTOR_LEN], b: &[u8; DESCRIPTOR_LEN]) -> i32 {
    let mut sum = 0;
    for k in 0..DESCRIPTOR_LEN {
        let difference = i32::from(a[k]) - i32::from(b[k]);
        sum += difference * difference;
    }
    sum
}
