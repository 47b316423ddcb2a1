//! The block of one cluster of cameras: built from its part's points, factorised, solved with.

use super::super::layout::NONE;
use super::blocks::widest;
use super::cholesky::Lower;
use super::part::CameraMap;
use super::real::{LANES, Real, by_stride, fused};
use super::state::{Frame, PartState, packed};

/// One camera of a cluster.
#[derive(Clone, Copy)]
struct Owned {
    pose: u32,
    /// Its place among the part's cameras, or [`NONE`] when it sees none of the part's points.
    camera: u32,
    /// First row of its block.
    offset: u32,
    /// Rows of the pose, none when it is held.
    pose_rows: u32,
    /// Rows of its own intrinsics.
    intrinsics_rows: u32,
}

impl Owned {
    /// For each row of its block, the unknown among the `6 + stride` of a camera.
    fn rows(&self) -> impl Iterator<Item = usize> + use<> {
        let (pose, intrinsics) = (self.pose_rows as usize, self.intrinsics_rows as usize);
        (0..pose).chain(6..6 + intrinsics)
    }

    fn num_rows(&self) -> usize {
        (self.pose_rows + self.intrinsics_rows) as usize
    }
}

/// The Cholesky factor of a cluster's block.
///
/// The block holds the diagonal of the whole reduced system, and beside it what the part's own points say of each two
/// cameras of the cluster: no larger than the truth, and so positive definite.
pub(super) struct LocalFactor<T> {
    owned: Vec<Owned>,
    /// Columns of the lower triangle, one after another.
    columns: Vec<T>,
    /// The inverse of the diagonal.
    inverse: Vec<T>,
    work: Vec<T>,
}

impl<T: Real> LocalFactor<T> {
    /// Solves for the cluster's cameras: reads `right`, the vector of all unknowns, and returns the local solution.
    pub fn solve(&mut self, map: &CameraMap, right: &[f64]) -> Vec<f64> {
        let Self { owned, columns, inverse, work } = self;
        work.clear();
        for index in indices(owned, map) {
            work.push(T::from_f64(right[index]));
        }
        widest(
            #[inline(always)]
            || substitute(columns, inverse, work),
        );
        work.iter().map(|v| v.to_f64()).collect()
    }
}

fn indices<'a>(owned: &'a [Owned], map: &'a CameraMap) -> impl Iterator<Item = usize> + 'a {
    owned.iter().flat_map(|camera| {
        let unknowns = &map.of_pose[camera.pose as usize];
        camera.rows().map(move |row| match row {
            0..6 => unknowns.pose as usize + row,
            _ => unknowns.intrinsics as usize + row - 6,
        })
    })
}

/// For each row of a cluster's block its unknown.
pub(super) fn cluster_indices(map: &CameraMap, members: &[u32]) -> Vec<u32> {
    indices(&owned_cameras(map, members, &[]), map).map(|index| index as u32).collect()
}

/// The free cameras of a cluster, ascending.
fn owned_cameras(map: &CameraMap, members: &[u32], poses: &[u32]) -> Vec<Owned> {
    let mut owned = Vec::new();
    let mut offset = 0;
    for pose in members.iter().copied() {
        let unknowns = &map.of_pose[pose as usize];
        let camera = Owned {
            pose,
            camera: poses.binary_search(&pose).map_or(NONE, |at| at as u32),
            offset,
            pose_rows: if unknowns.pose == NONE { 0 } else { 6 },
            intrinsics_rows: if unknowns.own { unknowns.num_intrinsics } else { 0 },
        };
        if camera.num_rows() > 0 {
            offset += camera.num_rows() as u32;
            owned.push(camera);
        }
    }
    owned
}

impl<T: Real> PartState<T> {
    /// Builds and factorises the block of cluster `cluster`; `diagonal` holds the packed diagonal block of every pose.
    pub fn factorize_local(&mut self, frame: &Frame<'_>, cluster: usize, diagonal: &[f64]) {
        let owned = owned_cameras(frame.map, &frame.clusters.members[cluster], &self.part.poses);
        let n = owned.last().map_or(0, |last| last.offset as usize + last.num_rows());
        let mut matrix = Lower::zeros(n);
        add_diagonal(&mut matrix, &owned, frame.map.width(), diagonal);
        self.subtract_pairs(&mut matrix, &owned, frame.map.stride);
        let mut held = matrix.factorize();
        if !held {
            // Rounding has the last word only where the cluster hardly holds together: its cameras one by one then.
            matrix = Lower::zeros(n);
            add_diagonal(&mut matrix, &owned, frame.map.width(), diagonal);
            held = matrix.factorize();
        }
        let mut factor = self.local.take().unwrap_or_else(|| LocalFactor {
            owned: Vec::new(),
            columns: Vec::new(),
            inverse: Vec::new(),
            work: Vec::new(),
        });
        factor.owned = owned;
        factor.columns.clear();
        factor.inverse.clear();
        // All factors of a holder together are most of its memory: no room to grow.
        factor.columns.reserve_exact(n * n.saturating_sub(1) / 2);
        factor.inverse.reserve_exact(n);
        for column in 0..n {
            let values = matrix.column(column);
            if held {
                factor.inverse.push(T::from_f64(1.0 / values[0]));
                factor.columns.extend(values[1..].iter().map(|v| T::from_f64(*v)));
            } else {
                factor.inverse.push(T::from_f64(1.0));
                factor.columns.extend(std::iter::repeat_n(T::default(), n - column - 1));
            }
        }
        self.local = Some(factor);
    }

    /// Takes `Z_i Z_jᵀ` of each two of the cluster's cameras that see one of the part's points.
    fn subtract_pairs(&self, matrix: &mut Lower, owned: &[Owned], stride: usize) {
        by_stride!(stride, K, WIDTH => self.subtract_pairs_of::<K, WIDTH>(matrix, owned));
    }

    fn subtract_pairs_of<const K: usize, const W: usize>(&self, matrix: &mut Lower, owned: &[Owned]) {
        // Of each observation three columns of `Z`, one after another.
        let (mut seen, mut values) = (Vec::<(u32, u32)>::new(), Vec::<[f64; W]>::new());
        for (at, camera) in owned.iter().enumerate().filter(|(_, camera)| camera.camera != NONE) {
            let index = camera.camera as usize;
            let rows: smallvec::SmallVec<[usize; 24]> = camera.rows().collect();
            for group in self.lanes.first_group[index] as usize..self.lanes.first_group[index + 1] as usize {
                let z = widest(
                    #[inline(always)]
                    || self.lanes.group_z::<K, W>(index, group),
                );
                for (l, point) in self.lanes.points[group].iter().enumerate() {
                    if *point < self.part.first_fixed_point {
                        seen.push((*point, at as u32));
                        for c in 0..3 {
                            let mut column = [0.0; W];
                            rows.iter().enumerate().for_each(|(i, row)| column[i] = z[*row][c][l].to_f64());
                            values.push(column);
                        }
                    }
                }
            }
        }
        for run in by_point(&seen, self.part.points.len()) {
            for (at, first) in run.iter().enumerate() {
                let a = &owned[seen[*first as usize].1 as usize];
                let za = &values[3 * *first as usize..][..3];
                for second in &run[at + 1..] {
                    let b = &owned[seen[*second as usize].1 as usize];
                    let zb = &values[3 * *second as usize..][..3];
                    let place = (b.offset as usize, a.offset as usize);
                    if a.offset == b.offset {
                        continue;
                    }
                    let stride = matrix.stride;
                    let target = &mut matrix.values[stride * place.1 + place.0..];
                    widest(
                        #[inline(always)]
                        || {
                            if b.num_rows() == W {
                                // The usual case, with a constant to unroll by.
                                subtract_block::<W>(target, stride, (zb, W), (za, a.num_rows()));
                            } else {
                                subtract_block::<W>(target, stride, (zb, b.num_rows()), (za, a.num_rows()));
                            }
                        },
                    );
                }
            }
        }
    }
}

/// The indices of `seen` by point, those of one point ascending.
fn by_point(seen: &[(u32, u32)], num_points: usize) -> impl Iterator<Item = Vec<u32>> {
    let mut start = vec![0u32; num_points + 1];
    seen.iter().for_each(|(point, _)| start[*point as usize + 1] += 1);
    for point in 0..num_points {
        start[point + 1] += start[point];
    }
    let mut next = start.clone();
    let mut order = vec![0u32; seen.len()];
    for (index, (point, _)) in seen.iter().enumerate() {
        order[next[*point as usize] as usize] = index as u32;
        next[*point as usize] += 1;
    }
    (0..num_points).map(move |point| order[start[point] as usize..start[point + 1] as usize].to_vec())
}

/// `matrix −= Z_rows Z_columnsᵀ`, column-major with columns `n` apart; of each `Z` as many rows as its camera has.
#[inline(always)]
fn subtract_block<const W: usize>(
    matrix: &mut [f64],
    n: usize,
    (z_rows, num_rows): (&[[f64; W]], usize),
    (z_columns, num_columns): (&[[f64; W]], usize),
) {
    for c in 0..num_columns {
        let [c0, c1, c2] = [z_columns[0][c], z_columns[1][c], z_columns[2][c]];
        let target = &mut matrix[n * c..n * c + num_rows];
        for (i, value) in target.iter_mut().enumerate() {
            *value =
                (-z_rows[0][i]).mul_add(c0, (-z_rows[1][i]).mul_add(c1, (-z_rows[2][i]).mul_add(c2, *value)));
        }
    }
}

fn add_diagonal(matrix: &mut Lower, owned: &[Owned], width: usize, diagonal: &[f64]) {
    for camera in owned {
        let block =
            &diagonal[packed(width) * camera.pose as usize..packed(width) * (camera.pose as usize + 1)];
        for (i, a) in camera.rows().enumerate() {
            for (j, b) in camera.rows().enumerate().take(i + 1) {
                let (row, column) = (camera.offset as usize + i, camera.offset as usize + j);
                matrix.values[matrix.stride * column + row] = block[packed(a) + b];
            }
        }
    }
}

/// `x = L⁻ᵀ L⁻¹ x`.
#[inline(always)]
fn substitute<T: Real>(columns: &[T], inverse: &[T], x: &mut [T]) {
    let n = inverse.len();
    let mut rest = columns;
    for column in 0..n {
        let (values, after) = rest.split_at(n - column - 1);
        rest = after;
        let value = x[column] * inverse[column];
        x[column] = value;
        let negative = T::default() - value;
        for (x, factor) in x[column + 1..].iter_mut().zip(values) {
            *x = factor.mul_add(negative, *x);
        }
    }
    let mut rest = columns;
    for column in (0..n).rev() {
        let (before, values) = rest.split_at(rest.len() - (n - column - 1));
        rest = before;
        let value = dot(values, &x[column + 1..]);
        x[column] = (x[column] - value) * inverse[column];
    }
}

/// Dot product by lanes, always in the same order.
#[inline(always)]
fn dot<T: Real>(a: &[T], b: &[T]) -> T {
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    let mut sums = [T::default(); LANES];
    for (a, b) in a.iter().zip(b) {
        sums = fused(a, b, &sums);
    }
    let mut total = T::default();
    for value in sums {
        total += value;
    }
    for (a, b) in a_rest.iter().zip(b_rest) {
        total = a.mul_add(*b, total);
    }
    total
}
