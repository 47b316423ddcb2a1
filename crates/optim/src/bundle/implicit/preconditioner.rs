//! What is near the inverse of the reduced camera system.

use nalgebra::{SMatrix, SVector};
use smallvec::SmallVec;

use super::super::layout::{Cameras, NONE};
use super::super::terms::{Term, dot};
use super::super::{BundleError, Preconditioner};
use super::coarse::{PoseColumns, SIMILARITY, middles, pose_columns};
use super::known;
use super::state::packed;
use super::system::CameraSystem;
use super::worker::{CameraSide, PartRequest};
use crate::linear::{BlockPattern, BlockSystem, LinearSolver};

/// Small Cholesky factors on the diagonal: of consecutive unknowns, as one or two ranges.
pub(super) struct BlockFactors {
    blocks: Vec<BlockFactor>,
}

struct BlockFactor {
    ranges: [(usize, usize); 2],
    factor: nalgebra::DMatrix<f64>,
}

impl BlockFactors {
    /// Factors of the blocks of free poses with their own intrinsics, where `poses` says so, and of all intrinsics that
    /// poses share. `blocks` are packed, one a pose; `shared` follow the list of the map.
    pub fn new(side: &CameraSide, blocks: &[f64], shared: &[Vec<f64>], poses: bool) -> Self {
        let width = side.map.width();
        let mut factors = Self { blocks: Vec::new() };
        let listed = side.map.of_pose.iter().zip(blocks.chunks_exact(packed(width))).filter(|_| poses);
        for (unknowns, block) in listed.filter(|(unknowns, _)| unknowns.pose != NONE) {
            let own = if unknowns.own { unknowns.num_intrinsics as usize } else { 0 };
            factors.push([(unknowns.pose as usize, 6), (unknowns.intrinsics as usize, own)], block);
        }
        for ((first, n), block) in side.map.shared.iter().zip(shared) {
            factors.push([(*first as usize, *n as usize), (0, 0)], block);
        }
        factors
    }

    fn push(&mut self, ranges: [(usize, usize); 2], block: &[f64]) {
        let n = ranges[0].1 + ranges[1].1;
        let at = |i: usize, j: usize| block[packed(i.max(j)) + i.min(j)];
        let matrix = nalgebra::DMatrix::from_fn(n, n, at);
        let factor = matrix.clone().cholesky().map_or_else(
            // A block that rounding has spoiled: its diagonal.
            || {
                nalgebra::DMatrix::from_diagonal(
                    &matrix.diagonal().map(|d| d.max(f64::MIN_POSITIVE.sqrt()).sqrt()),
                )
            },
            |cholesky| cholesky.unpack(),
        );
        self.blocks.push(BlockFactor { ranges, factor });
    }

    /// Adds the solution of every block to `z`.
    pub fn solve_add(&self, r: &[f64], z: &mut [f64]) {
        for block in &self.blocks {
            let indices = || block.ranges.iter().flat_map(|(first, n)| *first..*first + *n);
            let n = block.factor.nrows();
            let mut x = [0.0; super::blocks::MAX_WIDTH];
            for (x, index) in x.iter_mut().zip(indices()) {
                *x = r[index];
            }
            for i in 0..n {
                let sum: f64 = (0..i).map(|j| block.factor[(i, j)] * x[j]).sum();
                x[i] = (x[i] - sum) / block.factor[(i, i)];
            }
            for i in (0..n).rev() {
                let sum: f64 = (i + 1..n).map(|j| block.factor[(j, i)] * x[j]).sum();
                x[i] = (x[i] - sum) / block.factor[(i, i)];
            }
            for (x, index) in x.iter().zip(indices()) {
                z[index] += x;
            }
        }
    }
}

/// The coarse system and the way to and from it.
pub(super) struct Coarse {
    system: BlockSystem,
    /// The groups that each part touches, ascending.
    touched: Vec<Vec<u32>>,
    columns: Vec<PoseColumns>,
    holds: bool,
}

impl Coarse {
    /// Analyses which groups touch.
    pub fn new(side: &CameraSide, touched: Vec<Vec<u32>>, terms: &[Term]) -> Result<Self, BundleError> {
        let dims = side.coarse.dims();
        let mut above = vec![Vec::new(); dims.len()];
        let mut bring_together = |groups: &[u32]| {
            for (at, column) in groups.iter().enumerate() {
                above[*column as usize].extend_from_slice(&groups[..at]);
            }
        };
        touched.iter().for_each(|groups| bring_together(groups));
        terms.iter().for_each(|term| bring_together(&known::groups(side, term)));
        // A pose without observations still ties its cluster to its intrinsics: both lie on the diagonal.
        let system = BlockSystem::new(BlockPattern::new(&dims, above), LinearSolver::Simplicial)?;
        Ok(Self { system, touched, columns: Vec::new(), holds: false })
    }

    /// How many numbers the matrix of each part has.
    pub fn part_lengths(&self, side: &CameraSide) -> impl Iterator<Item = usize> {
        let dims = side.coarse.dims();
        self.touched
            .iter()
            .map(move |groups| groups.iter().map(|group| dims[*group as usize]).sum::<usize>().pow(2))
    }

    /// Adds the parts' matrices, and what damping, priors and marks add on the camera side.
    pub fn assemble(
        &mut self,
        side: &CameraSide,
        cameras: &Cameras,
        parts: &[Vec<f64>],
        (damping, terms): (&[f64], &[Term]),
    ) {
        self.system.clear();
        let dims = side.coarse.dims();
        for (groups, matrix) in self.touched.iter().zip(parts) {
            add_part(&mut self.system, &dims, groups, matrix);
        }
        let middles = middles(cameras, &side.clusters);
        self.columns = (0..side.map.of_pose.len())
            .map(|pose| pose_columns(cameras, pose, &middles[side.clusters.of_pose[pose] as usize]))
            .collect();
        for (pose, unknowns) in side.map.of_pose.iter().enumerate().filter(|(_, u)| u.pose != NONE) {
            let p = &self.columns[pose];
            let damping = SVector::<f64, 6>::from_fn(|i, _| damping[unknowns.pose as usize + i]);
            let block: SMatrix<f64, SIMILARITY, SIMILARITY> =
                p.transpose() * SMatrix::from_diagonal(&damping) * p;
            let cluster = side.clusters.of_pose[pose] as usize;
            self.system.add(cluster, cluster, block.as_slice(), SIMILARITY);
        }
        for (at, (first, n)) in side.coarse.shared.iter().enumerate() {
            for a in 0..*n as usize {
                self.system.add_to_diagonal(side.coarse.num_clusters + at, a, damping[*first as usize + a]);
            }
        }
        terms.iter().for_each(|term| self.add_term(side, term));
        // A cluster of held cameras has no columns: its unknowns stay zero.
        for (group, dim) in dims.iter().enumerate() {
            for component in 0..*dim {
                if self.system.diagonal(group, component) <= 0.0 {
                    self.system.add_to_diagonal(group, component, 1.0);
                }
            }
        }
        self.holds = self.system.factorize();
    }

    fn add_term(&mut self, side: &CameraSide, term: &Term) {
        let coarse = known::coarse(side, &self.columns, term);
        for (at, column) in coarse.iter().enumerate() {
            for row in &coarse[..=at] {
                let products = column
                    .columns
                    .iter()
                    .flat_map(|right| row.columns.iter().map(move |left| term.weight * dot(left, right)));
                let block: SmallVec<[f64; 64]> = products.collect();
                self.system.add(row.group as usize, column.group as usize, &block, row.columns.len());
            }
        }
    }

    /// Adds `P (Pᵀ S P)⁻¹ Pᵀ r` to `z`.
    pub fn solve_add(&mut self, side: &CameraSide, r: &[f64], z: &mut [f64]) {
        if !self.holds {
            return;
        }
        let num_clusters = side.coarse.num_clusters;
        let mut right = vec![0.0; self.system.pattern().num_unknowns()];
        let free = || side.map.of_pose.iter().enumerate().filter(|(_, unknowns)| unknowns.pose != NONE);
        for (pose, unknowns) in free() {
            let part = SVector::<f64, 6>::from_column_slice(&r[unknowns.pose as usize..][..6]);
            let sum = self.columns[pose].transpose() * part;
            let offset = SIMILARITY * side.clusters.of_pose[pose] as usize;
            right[offset..offset + SIMILARITY].iter_mut().zip(sum.iter()).for_each(|(r, s)| *r += s);
        }
        for (at, (first, n)) in side.coarse.shared.iter().enumerate() {
            let offset = self.system.pattern().offset(num_clusters + at);
            right[offset..offset + *n as usize].copy_from_slice(&r[*first as usize..][..*n as usize]);
        }
        self.system.solve_in_place(&mut right);
        for (pose, unknowns) in free() {
            let offset = SIMILARITY * side.clusters.of_pose[pose] as usize;
            let step = self.columns[pose]
                * SVector::<f64, SIMILARITY>::from_column_slice(&right[offset..][..SIMILARITY]);
            z[unknowns.pose as usize..][..6].iter_mut().zip(step.iter()).for_each(|(z, s)| *z += s);
        }
        for (at, (first, n)) in side.coarse.shared.iter().enumerate() {
            let offset = self.system.pattern().offset(num_clusters + at);
            (0..*n as usize).for_each(|a| z[*first as usize + a] += right[offset + a]);
        }
    }
}

/// Adds the dense lower triangle of a part.
fn add_part(system: &mut BlockSystem, dims: &[usize], groups: &[u32], matrix: &[f64]) {
    let n: usize = groups.iter().map(|group| dims[*group as usize]).sum();
    let mut column_offset = 0;
    for (at, column) in groups.iter().enumerate() {
        let columns = dims[*column as usize];
        let mut row_offset = column_offset;
        for row in &groups[at..] {
            let rows = dims[*row as usize];
            // The system keeps its upper triangle: the transposed block.
            let mut block = vec![0.0; rows * columns];
            for r in 0..rows {
                for c in 0..columns {
                    let (low, high) =
                        ((row_offset + r).max(column_offset + c), (row_offset + r).min(column_offset + c));
                    block[columns * r + c] = matrix[n * high + low];
                }
            }
            system.add(*column as usize, *row as usize, &block, columns);
            row_offset += rows;
        }
        column_offset += columns;
    }
}

/// The preconditioner of one linearisation and damping.
pub(super) struct Inverse {
    pub kind: Preconditioner,
    pub factors: BlockFactors,
    pub coarse: Option<Coarse>,
    /// For each cluster the unknowns of its block.
    pub cluster_indices: Vec<Vec<u32>>,
}

/// Terms of the power series: the largest number that paid in measurements.
const POWER_TERMS: usize = 10;

impl Inverse {
    /// `M⁻¹ r`.
    pub fn apply(&mut self, system: &mut CameraSystem<'_>, r: &[f64]) -> Result<Vec<f64>, BundleError> {
        let mut z = vec![0.0; r.len()];
        match self.kind {
            Preconditioner::BlockJacobi => self.factors.solve_add(r, &mut z),
            Preconditioner::PowerSeries => {
                self.factors.solve_add(r, &mut z);
                for _ in 0..POWER_TERMS {
                    // z ← z + B⁻¹ (r − S z), with B the cameras' normal equations.
                    let image = system.product(&z)?;
                    let rest: Vec<f64> = r.iter().zip(&image).map(|(r, s)| r - s).collect();
                    self.factors.solve_add(&rest, &mut z);
                }
            }
            Preconditioner::ClusterBlocks | Preconditioner::TwoLevel | Preconditioner::Auto => {
                self.factors.solve_add(r, &mut z);
                let answers = system.ask(&PartRequest::Solve(r.to_vec()))?;
                for (indices, answer) in self.cluster_indices.iter().zip(&answers) {
                    indices.iter().zip(answer).for_each(|(index, value)| z[*index as usize] += value);
                }
                if let Some(coarse) = &mut self.coarse {
                    coarse.solve_add(system.side, r, &mut z);
                }
            }
        }
        Ok(z)
    }
}
