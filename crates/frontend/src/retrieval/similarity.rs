//! Nearest neighbours among global descriptors without comparing all with all.
//!
//! An inverted file (Sivic & Zisserman 2003; Jégou et al. 2011): descriptors are grouped into about √n cells by spherical
//! k-means, and an image is compared with those of the cells whose centres are most like it. Up to some thousand images
//! that is all of them. The work for n images grows as n √n, memory by a few bytes an image.

use rand::RngExt;
use rayon::prelude::*;
use terrane_geometry::Seed;

use super::compact::CompactDescriptors;
use super::dot::DotKernel;

/// An image that looks like another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Similar {
    /// Its place in the list of descriptors.
    pub index: u32,
    /// Cosine of the angle between the two descriptors: 1 for equal images, about 0 for strangers.
    pub similarity: f32,
    /// Local features that agree on one place for both images, with a share of those by way of common neighbours; see
    /// [`super::refine`]. 0 without evidence.
    pub votes: u32,
}

/// An image is compared with at least this many others, and
const LEAST_COMPARED: usize = 2048;
/// with at least this many times the square root of their number.
const COMPARED_PER_ROOT: f64 = 24.0;
/// Descriptors that a cell's centre is learnt from.
const TRAINING_PER_CELL: usize = 48;
const TRAINING_ROUNDS: usize = 8;
/// Queries of one task.
const CHUNK: usize = 64;

/// For each image that `wanted` names its `count` most similar others, best first; of equals the lower index first. The
/// others' lists are empty, and so are those of images without a descriptor, which are nobody's neighbours.
pub fn nearest(
    descriptors: &CompactDescriptors,
    wanted: impl Fn(usize) -> bool + Sync,
    count: usize,
    seed: Seed,
) -> Vec<Vec<Similar>> {
    let usable: Vec<u32> =
        (0..descriptors.len() as u32).filter(|&at| descriptors.inverse_length(at as usize) > 0.0).collect();
    let budget = LEAST_COMPARED.max((COMPARED_PER_ROOT * (usable.len() as f64).sqrt()) as usize);
    let cells = Cells::new(descriptors, &usable, budget, seed);
    let rows: Vec<u32> = usable.into_iter().filter(|&row| wanted(row as usize)).collect();
    let of_chunk = |chunk: &[u32]| -> Vec<Vec<Similar>> {
        chunk.iter().map(|&row| cells.nearest(descriptors, row, count, budget)).collect()
    };
    let found: Vec<Vec<Vec<Similar>>> = rows.par_chunks(CHUNK).map(of_chunk).collect();
    let mut neighbours = vec![Vec::new(); descriptors.len()];
    for (row, list) in rows.into_iter().zip(found.into_iter().flatten()) {
        neighbours[row as usize] = list;
    }
    neighbours
}

/// Descriptors by cell.
struct Cells {
    centers: CompactDescriptors,
    /// Where the members of each cell begin in `members`; one more at the end.
    starts: Vec<usize>,
    /// Cell after cell, ascending within each.
    members: Vec<u32>,
    /// Descriptors in the order of `members`.
    values: Vec<i8>,
    inverse_lengths: Vec<f32>,
    kernel: DotKernel,
}

impl Cells {
    fn new(descriptors: &CompactDescriptors, usable: &[u32], budget: usize, seed: Seed) -> Self {
        let kernel = DotKernel::fastest();
        let num_cells = if usable.len() <= budget { 1 } else { (usable.len() as f64).sqrt() as usize };
        let centers = train(descriptors, usable, num_cells, kernel, seed);
        let cell_of = assign(descriptors, usable, &centers, kernel);
        let mut keyed: Vec<(u32, u32)> = cell_of.into_iter().zip(usable.iter().copied()).collect();
        keyed.sort_unstable();
        let starts = (0..=centers.len() as u32).map(|cell| keyed.partition_point(|entry| entry.0 < cell));
        let starts = starts.collect();
        let members: Vec<u32> = keyed.into_iter().map(|entry| entry.1).collect();
        let mut values = Vec::with_capacity(members.len() * descriptors.stride());
        members.iter().for_each(|&member| values.extend_from_slice(descriptors.get(member as usize)));
        let inverse_lengths = members.iter().map(|&m| descriptors.inverse_length(m as usize)).collect();
        Self { centers, starts, members, values, inverse_lengths, kernel }
    }

    /// The most similar of at least `budget` members of the cells most like a row, and of at most twice as many.
    fn nearest(
        &self,
        descriptors: &CompactDescriptors,
        row: u32,
        count: usize,
        budget: usize,
    ) -> Vec<Similar> {
        let query = descriptors.get(row as usize);
        let inverse_length = descriptors.inverse_length(row as usize);
        let mut list = Vec::new();
        let mut dots = Vec::new();
        for cell in self.by_likeness(query) {
            if list.len() >= budget {
                break;
            }
            let places = self.window(cell, row, budget);
            dots.clear();
            let stride = descriptors.stride();
            self.kernel.dots(query, &self.values[places.start * stride..places.end * stride], &mut dots);
            for (place, &dot) in places.zip(&dots) {
                let index = self.members[place];
                if index != row {
                    let similarity = dot as f32 * inverse_length * self.inverse_lengths[place];
                    list.push(Similar { index, similarity, votes: 0 });
                }
            }
        }
        keep_best(&mut list, count);
        list
    }

    /// Cells, those most like the query first.
    fn by_likeness(&self, query: &[i8]) -> Vec<usize> {
        let mut dots = Vec::with_capacity(self.centers.len());
        self.kernel.dots(query, self.centers.values(), &mut dots);
        let mut order: Vec<usize> = (0..self.centers.len()).collect();
        let likeness =
            |cell: usize| dots.get(cell).map_or(0.0, |&dot| dot as f32 * self.centers.inverse_length(cell));
        order.sort_by(|&a, &b| likeness(b).total_cmp(&likeness(a)).then(a.cmp(&b)));
        order
    }

    /// The places of a cell's members; of a cell beyond the budget (a thousand equal images) those next in the table.
    fn window(&self, cell: usize, row: u32, budget: usize) -> std::ops::Range<usize> {
        let (start, end) = (self.starts[cell], self.starts[cell + 1]);
        if end - start <= budget {
            return start..end;
        }
        let middle = start + self.members[start..end].partition_point(|&member| member < row);
        let first = middle.saturating_sub(budget / 2).clamp(start, end - budget);
        first..first + budget
    }
}

/// Centres of spherical k-means (Dhillon & Modha 2001), learnt from a part of the descriptors.
fn train(
    descriptors: &CompactDescriptors,
    usable: &[u32],
    num_cells: usize,
    kernel: DotKernel,
    seed: Seed,
) -> CompactDescriptors {
    let mut rng = seed.derive("cells").rng();
    let mut sample: Vec<u32> = usable.to_vec();
    let wanted = (num_cells * TRAINING_PER_CELL).min(sample.len());
    for at in 0..wanted {
        let other = rng.random_range(at..sample.len());
        sample.swap(at, other);
    }
    sample.truncate(wanted);
    let mut centers = CompactDescriptors::new(descriptors.stride());
    sample.iter().take(num_cells).for_each(|&at| centers.push_bytes(descriptors.get(at as usize)));
    for _ in 0..TRAINING_ROUNDS * usize::from(num_cells > 1) {
        let cell_of = assign(descriptors, &sample, &centers, kernel);
        let mut sums = vec![vec![0.0_f64; descriptors.stride()]; centers.len()];
        for (&at, &cell) in sample.iter().zip(&cell_of) {
            let inverse_length = f64::from(descriptors.inverse_length(at as usize));
            let sum = &mut sums[cell as usize];
            sum.iter_mut()
                .zip(descriptors.get(at as usize))
                .for_each(|(sum, &value)| *sum += f64::from(value) * inverse_length);
        }
        let mut moved = CompactDescriptors::new(descriptors.stride());
        for (cell, sum) in sums.iter().enumerate() {
            if sum.iter().any(|&value| value != 0.0) {
                moved.push(&sum.iter().map(|&value| value as f32).collect::<Vec<_>>());
            } else {
                moved.push_bytes(centers.get(cell));
            }
        }
        if moved == centers {
            break;
        }
        centers = moved;
    }
    centers
}

/// The cell most like each of the images; of equals the first.
fn assign(
    descriptors: &CompactDescriptors,
    images: &[u32],
    centers: &CompactDescriptors,
    kernel: DotKernel,
) -> Vec<u32> {
    let cell_of = |&image: &u32| -> u32 {
        let mut dots = Vec::with_capacity(centers.len());
        kernel.dots(descriptors.get(image as usize), centers.values(), &mut dots);
        let mut best = (f32::NEG_INFINITY, 0);
        for (cell, &dot) in dots.iter().enumerate() {
            let likeness = dot as f32 * centers.inverse_length(cell);
            if likeness > best.0 {
                best = (likeness, cell as u32);
            }
        }
        best.1
    };
    images
        .par_chunks(CHUNK)
        .map(|chunk| chunk.iter().map(cell_of).collect::<Vec<_>>())
        .collect::<Vec<_>>()
        .concat()
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
