//! Exact nearest neighbours among global descriptors.

use rayon::prelude::*;

/// An image that looks like another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Similar {
    /// Its place in the list of descriptors.
    pub index: u32,
    /// Dot product of the two descriptors: 1 for equal images, about 0 for strangers.
    pub similarity: f32,
}

/// Rows that share one reading of every other descriptor.
const BLOCK: usize = 8;
/// Sums that a dot product is kept in, so that its order of additions is fixed and fits vector registers.
const LANES: usize = 8;

/// For each descriptor its `count` most similar others, best first; of equals the lower index first.
///
/// Descriptors are compared as they are (those of [`super::Vocabulary::encode`] have length one). An empty one, one of
/// another length than the first that is not empty, or one that is not finite has no neighbours and is nobody's.
pub fn nearest(descriptors: &[Vec<f32>], count: usize) -> Vec<Vec<Similar>> {
    let len = descriptors.iter().map(Vec::len).find(|&len| len > 0).unwrap_or(0);
    let usable =
        |values: &[f32]| len > 0 && values.len() == len && values.iter().all(|value| value.is_finite());
    let rows: Vec<usize> = (0..descriptors.len()).filter(|&at| usable(&descriptors[at])).collect();
    let of_block = |block: &[usize]| -> Vec<(usize, Vec<Similar>)> {
        let mut lists: Vec<Vec<Similar>> = vec![Vec::with_capacity(rows.len()); block.len()];
        for &other in &rows {
            for (list, &row) in lists.iter_mut().zip(block) {
                if row != other {
                    let similarity = dot(&descriptors[row], &descriptors[other]);
                    list.push(Similar { index: other as u32, similarity });
                }
            }
        }
        for list in &mut lists {
            keep_best(list, count);
        }
        block.iter().copied().zip(lists).collect()
    };
    let found: Vec<_> = rows.par_chunks(BLOCK).map(of_block).collect();
    let mut neighbours = vec![Vec::new(); descriptors.len()];
    for (row, list) in found.into_iter().flatten() {
        neighbours[row] = list;
    }
    neighbours
}

fn keep_best(list: &mut Vec<Similar>, count: usize) {
    let by_rank =
        |a: &Similar, b: &Similar| b.similarity.total_cmp(&a.similarity).then(a.index.cmp(&b.index));
    if count == 0 {
        list.clear();
    } else if list.len() > count {
        list.select_nth_unstable_by(count - 1, by_rank);
        list.truncate(count);
    }
    list.sort_unstable_by(by_rank);
    list.shrink_to_fit();
}

/// Dot product in [`LANES`] sums, added up at the end.
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let (a_chunks, a_rest) = a.as_chunks::<LANES>();
    let (b_chunks, b_rest) = b.as_chunks::<LANES>();
    let mut sums = [0.0f32; LANES];
    for (a, b) in a_chunks.iter().zip(b_chunks) {
        (0..LANES).for_each(|k| sums[k] += a[k] * b[k]);
    }
    let rest: f32 = a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum();
    sums.iter().sum::<f32>() + rest
}
