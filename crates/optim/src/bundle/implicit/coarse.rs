//! The coarse level: one similarity for each cluster, and the intrinsics that poses share.
//!
//! A similarity of a cluster's cameras costs nothing where the points go with them, which makes these the directions in
//! which conjugate gradients alone creep. The coarse system is `Pᵀ S P` with seven columns of `P` for each cluster.

use nalgebra::{Matrix3, SMatrix, Vector3};

use super::super::layout::{Cameras, NONE};
use super::clusters::Clusters;
use super::product::num_rows;
use super::real::{LANES, Real};
use super::state::{Frame, PartState};

/// Unknowns of a similarity: rotation, translation, scale.
pub(super) const SIMILARITY: usize = 7;

/// How the six unknowns of a pose follow its cluster's similarity.
pub(super) type PoseColumns = SMatrix<f64, 6, SIMILARITY>;

/// The middle of the cameras' centres of each cluster.
pub(super) fn middles(cameras: &Cameras, clusters: &Clusters) -> Vec<Vector3<f64>> {
    let mut sums = vec![(Vector3::zeros(), 0.0); clusters.count];
    for (pose, cluster) in clusters.of_pose.iter().enumerate() {
        let sum: &mut (Vector3<f64>, f64) = &mut sums[*cluster as usize];
        sum.0 += cameras.poses[pose].center();
        sum.1 += 1.0;
    }
    sums.into_iter().map(|(sum, n)| sum / f64::max(n, 1.0)).collect()
}

/// A world similarity about `middle` that the points follow: `ω = −R w`, `v = s t_m + (R w) × t_m − R τ`, where `t_m` is
/// the middle in the camera's frame.
pub(super) fn pose_columns(cameras: &Cameras, pose: usize, middle: &Vector3<f64>) -> PoseColumns {
    let rows = &cameras.rotations[pose];
    let rotation = Matrix3::from_fn(|r, c| rows[r][c]);
    let middle_in_cam = cameras.x_in_cam(pose, middle);
    let mut columns = PoseColumns::zeros();
    columns.fixed_view_mut::<3, 3>(0, 0).copy_from(&-rotation);
    columns.fixed_view_mut::<3, 3>(3, 0).copy_from(&(-middle_in_cam.cross_matrix() * rotation));
    columns.fixed_view_mut::<3, 3>(3, 3).copy_from(&-rotation);
    columns.fixed_view_mut::<3, 1>(3, 6).copy_from(&middle_in_cam);
    columns
}

/// The coarse unknowns come in groups: the clusters, then the blocks that no single pose owns.
pub(super) struct CoarseGroups {
    pub num_clusters: usize,
    /// First camera unknown and number of each of these blocks.
    pub shared: Vec<(u32, u32)>,
}

impl CoarseGroups {
    /// Sizes of all groups.
    pub fn dims(&self) -> Vec<usize> {
        let shared = self.shared.iter().map(|(_, n)| *n as usize);
        std::iter::repeat_n(SIMILARITY, self.num_clusters).chain(shared).collect()
    }

    /// Size of a group.
    pub fn dim(&self, group: u32) -> usize {
        let shared = (group as usize).checked_sub(self.num_clusters);
        shared.map_or(SIMILARITY, |at| self.shared[at].1 as usize)
    }

    /// The group of a pose's shared intrinsics.
    pub fn of_shared(&self, first_unknown: u32) -> Option<u32> {
        let at = self.shared.binary_search_by_key(&first_unknown, |(first, _)| *first).ok()?;
        Some((self.num_clusters + at) as u32)
    }

    /// The groups that some poses touch, ascending.
    pub fn of_poses(&self, frame: &Frame<'_>, poses: &[u32]) -> Vec<u32> {
        let mut groups = Vec::new();
        for pose in poses {
            let unknowns = &frame.map.of_pose[*pose as usize];
            if unknowns.pose != NONE {
                groups.push(frame.clusters.of_pose[*pose as usize]);
            }
            if unknowns.intrinsics != NONE {
                groups.extend(self.of_shared(unknowns.intrinsics));
            }
        }
        groups.sort_unstable();
        groups.dedup();
        groups
    }
}

/// Where a camera's columns lie in the dense coarse matrix of a part.
struct CameraPlace {
    similarity: Option<(usize, PoseColumns)>,
    shared: Option<(usize, usize)>,
}

/// One observation in coarse unknowns: up to two ranges of columns, each with an x and a y row.
#[derive(Clone, Copy)]
struct CoarseRow {
    start: usize,
    len: usize,
    rows: [[f64; MAX_GROUP]; 2],
}

const MAX_GROUP: usize = terrane_geometry::camera::MAX_PARAMS;

impl<T: Real> PartState<T> {
    /// What the part's points add to `Pᵀ S P`, dense over the groups that they touch: a lower triangle, column-major.
    ///
    /// Points whose cameras all belong to one cluster follow it for free, but for the damping of points, which is left out.
    pub fn coarse_matrix(
        &self,
        frame: &Frame<'_>,
        groups: &CoarseGroups,
        middles: &[Vector3<f64>],
    ) -> Vec<f64> {
        let touched = groups.of_poses(frame, &self.part.poses);
        let dims = groups.dims();
        let mut offsets = Vec::with_capacity(touched.len());
        let mut n = 0;
        for group in &touched {
            offsets.push(n);
            n += dims[*group as usize];
        }
        let place = |group: u32| touched.binary_search(&group).ok().map(|at| offsets[at]);
        let places: Vec<CameraPlace> = self
            .part
            .poses
            .iter()
            .map(|pose| {
                let unknowns = &frame.map.of_pose[*pose as usize];
                let cluster = frame.clusters.of_pose[*pose as usize];
                let similarity = (unknowns.pose != NONE)
                    .then(|| place(cluster))
                    .flatten()
                    .map(|at| (at, pose_columns(frame.cameras, *pose as usize, &middles[cluster as usize])));
                let shared =
                    (unknowns.intrinsics != NONE).then(|| groups.of_shared(unknowns.intrinsics)).flatten();
                let shared = shared.and_then(place).map(|at| (at, unknowns.num_intrinsics as usize));
                CameraPlace { similarity, shared }
            })
            .collect();
        let mut matrix = vec![0.0; n * n];
        let lists = self.observations_of_points(&places);
        for (point, list) in lists {
            self.add_point(&mut matrix, n, point, &list, &places, frame.map.stride);
        }
        matrix
    }

    /// Camera and slot of the observations of each point that more than one group sees.
    fn observations_of_points(&self, places: &[CameraPlace]) -> Vec<(u32, Vec<(u32, u32)>)> {
        let anything_shared = places.iter().any(|place| place.shared.is_some());
        let mut first_seen = vec![u32::MAX; self.part.points.len()];
        let mut crosses = vec![anything_shared; self.part.points.len()];
        let group_of =
            |place: &CameraPlace| place.similarity.as_ref().map_or(u32::MAX - 1, |(at, _)| *at as u32);
        self.for_each_slot(|camera, _, point| {
            let group = group_of(&places[camera]);
            let first = &mut first_seen[point];
            if *first == u32::MAX {
                *first = group;
            }
            crosses[point] |= *first != group || point >= self.part.first_fixed_point as usize;
        });
        let mut lists: Vec<Vec<(u32, u32)>> = vec![Vec::new(); self.part.points.len()];
        self.for_each_slot(|camera, slot, point| {
            if crosses[point] {
                lists[point].push((camera as u32, slot as u32));
            }
        });
        let numbered = lists.into_iter().enumerate().filter(|(_, list)| !list.is_empty());
        numbered.map(|(point, list)| (point as u32, list)).collect()
    }

    /// Camera, slot and point of every observation.
    fn for_each_slot(&self, mut visit: impl FnMut(usize, usize, usize)) {
        for camera in 0..self.part.poses.len() {
            let first = self.part.first_observation[camera] as usize;
            let end = self.part.first_observation[camera + 1] as usize;
            for i in first..end {
                let slot = LANES * self.lanes.first_group[camera] as usize + (i - first);
                visit(camera, slot, self.part.point_of[i] as usize);
            }
        }
    }

    /// Adds one point: `Σ AᵀA − F Fᵀ` with `F = Σ Aᵀ J_p L⁻ᵀ`.
    fn add_point(
        &self,
        matrix: &mut [f64],
        n: usize,
        point: u32,
        list: &[(u32, u32)],
        places: &[CameraPlace],
        stride: usize,
    ) {
        let inverse = self.lanes.inverse[point as usize].map(|v| v.to_f64());
        let mut columns: Vec<(usize, [f64; 3])> = Vec::new();
        for &(camera, slot) in list {
            let (rows, point_rows) =
                self.coarse_rows(camera as usize, slot as usize, &places[camera as usize], stride);
            let scaled = point_rows.map(|j| {
                [
                    j[0] * inverse[0],
                    j[0] * inverse[1] + j[1] * inverse[2],
                    j[0] * inverse[3] + j[1] * inverse[4] + j[2] * inverse[5],
                ]
            });
            for (at, a) in rows.iter().enumerate() {
                for b in &rows[..=at] {
                    add_product(matrix, n, a, b);
                }
                for i in 0..a.len {
                    let f =
                        std::array::from_fn(|c| a.rows[0][i] * scaled[0][c] + a.rows[1][i] * scaled[1][c]);
                    match columns.iter_mut().find(|(column, _)| *column == a.start + i) {
                        Some((_, sum)) => (0..3).for_each(|c| sum[c] += f[c]),
                        None => columns.push((a.start + i, f)),
                    }
                }
            }
        }
        for (a, fa) in &columns {
            for (b, fb) in &columns {
                if a >= b {
                    matrix[n * b + a] -= fa[0] * fb[0] + fa[1] * fb[1] + fa[2] * fb[2];
                }
            }
        }
    }

    /// Jacobian of one observation in the coarse unknowns that it touches, ascending, and in the point.
    fn coarse_rows(
        &self,
        camera: usize,
        slot: usize,
        place: &CameraPlace,
        stride: usize,
    ) -> (smallvec::SmallVec<[CoarseRow; 2]>, [[f64; 3]; 2]) {
        let (group, lane) = (slot / LANES, slot % LANES);
        let rows = &self.lanes.rows[num_rows(stride) * group..num_rows(stride) * (group + 1)];
        let value = |row: usize| rows[row][lane].to_f64();
        let x = Vector3::new(value(0), value(1), value(2));
        let d = [0, 1].map(|row| Vector3::new(value(3 + 3 * row), value(4 + 3 * row), value(5 + 3 * row)));
        let rotation = self.lanes.rotations[camera].map(|v| v.to_f64());
        let point = d.map(|d| {
            std::array::from_fn(|c| d.x * rotation[c] + d.y * rotation[3 + c] + d.z * rotation[6 + c])
        });
        let mut result = smallvec::SmallVec::new();
        if let Some((start, columns)) = &place.similarity {
            let mut row = CoarseRow { start: *start, len: SIMILARITY, rows: [[0.0; MAX_GROUP]; 2] };
            for c in 0..SIMILARITY {
                let turn = Vector3::new(columns[(0, c)], columns[(1, c)], columns[(2, c)]);
                let shift = Vector3::new(columns[(3, c)], columns[(4, c)], columns[(5, c)]);
                let motion = turn.cross(&x) + shift;
                (0..2).for_each(|r| row.rows[r][c] = d[r].dot(&motion));
            }
            result.push(row);
        }
        if let Some((start, len)) = place.shared {
            let mut row = CoarseRow { start, len, rows: [[0.0; MAX_GROUP]; 2] };
            for a in 0..len {
                row.rows[0][a] = value(9 + a);
                row.rows[1][a] = value(9 + stride + a);
            }
            result.push(row);
        }
        (result, point)
    }
}

/// `matrix += AᵀB` for `a` at or after `b`.
fn add_product(matrix: &mut [f64], n: usize, a: &CoarseRow, b: &CoarseRow) {
    for j in 0..b.len {
        for i in 0..a.len {
            if a.start + i >= b.start + j {
                matrix[n * (b.start + j) + a.start + i] +=
                    a.rows[0][i] * b.rows[0][j] + a.rows[1][i] * b.rows[1][j];
            }
        }
    }
}
