//! What priors and marks add on the camera side: to gradients, products, blocks, and the coarse level.

use smallvec::SmallVec;

use super::super::terms::{Term, dot};
use super::coarse::{PoseColumns, SIMILARITY};
use super::part::BlockOwner;
use super::state::packed;
use super::worker::CameraSide;

/// Adds weight · J (Jᵀ x) of every term.
pub(super) fn add_product(side: &CameraSide, terms: &[Term], x: &[f64], y: &mut [f64]) {
    for term in terms {
        let mut image = [0.0; 3];
        for block in &term.blocks {
            for (column, x) in block.columns.iter().zip(&x[block.range(&side.layout)]) {
                (0..3).for_each(|row| image[row] += column[row] * x);
            }
        }
        let image = image.map(|v| term.weight * v);
        for block in &term.blocks {
            for (column, y) in block.columns.iter().zip(&mut y[block.range(&side.layout)]) {
                *y += dot(column, &image);
            }
        }
    }
}

/// Calls `visit` with every unknown that a term touches: its weighted slope and its part of the diagonal.
pub(super) fn for_each_unknown(side: &CameraSide, terms: &[Term], mut visit: impl FnMut(usize, f64, f64)) {
    for term in terms {
        for block in &term.blocks {
            for (column, unknown) in block.columns.iter().zip(block.range(&side.layout)) {
                visit(unknown, term.weight * dot(column, &term.residual), term.weight * dot(column, column));
            }
        }
    }
}

/// Adds products of Jacobians to the packed blocks of poses with their own intrinsics.
pub(super) fn add_to_pose_blocks(side: &CameraSide, terms: &[Term], blocks: &mut [f64]) {
    let size = packed(side.map.width());
    let place = |block: u32, local: usize| match side.map.owners[block as usize] {
        BlockOwner::Pose(pose) => Some((pose as usize, local)),
        BlockOwner::OwnIntrinsics(pose) => Some((pose as usize, 6 + local)),
        BlockOwner::Nobody(_) => None,
    };
    for term in terms {
        for a in &term.blocks {
            let Some((pose, row)) = place(a.block, a.local) else { continue };
            for b in &term.blocks {
                let Some((_, column)) = place(b.block, b.local).filter(|(of, _)| *of == pose) else {
                    continue;
                };
                for (i, left) in a.columns.iter().enumerate() {
                    for (j, right) in b.columns.iter().enumerate().filter(|(j, _)| column + j <= row + i) {
                        blocks[size * pose + packed(row + i) + column + j] += term.weight * dot(left, right);
                    }
                }
            }
        }
    }
}

/// Adds the same to the packed blocks that no pose owns.
pub(super) fn add_to_shared_blocks(side: &CameraSide, terms: &[Term], shared: &mut [Vec<f64>]) {
    for term in terms {
        for block in &term.blocks {
            let BlockOwner::Nobody(at) = side.map.owners[block.block as usize] else { continue };
            for (i, left) in block.columns.iter().enumerate() {
                for (j, right) in block.columns[..=i].iter().enumerate() {
                    let place = packed(block.local + i) + block.local + j;
                    shared[at as usize][place] += term.weight * dot(left, right);
                }
            }
        }
    }
}

/// A term's Jacobian in one group of coarse unknowns.
pub(super) struct CoarseTerm {
    pub group: u32,
    pub columns: SmallVec<[[f64; 3]; SIMILARITY]>,
}

/// The coarse groups that a term touches, ascending.
pub(super) fn groups(side: &CameraSide, term: &Term) -> Vec<u32> {
    let mut groups: Vec<u32> = term.blocks.iter().filter_map(|block| group(side, block.block)).collect();
    groups.sort_unstable();
    groups.dedup();
    groups
}

/// A term in coarse unknowns, groups ascending; `of_pose` has how each pose follows its cluster.
pub(super) fn coarse(side: &CameraSide, of_pose: &[PoseColumns], term: &Term) -> Vec<CoarseTerm> {
    let mut coarse: Vec<CoarseTerm> = groups(side, term)
        .into_iter()
        .map(|group| {
            let width = side.coarse.dim(group);
            CoarseTerm { group, columns: SmallVec::from_elem([0.0; 3], width) }
        })
        .collect();
    for block in &term.blocks {
        let Some(group) = group(side, block.block) else { continue };
        let Some(target) = coarse.iter_mut().find(|target| target.group == group) else { continue };
        match side.map.owners[block.block as usize] {
            BlockOwner::Pose(pose) => {
                let follows = &of_pose[pose as usize];
                for (i, column) in block.columns.iter().enumerate() {
                    for (c, target) in target.columns.iter_mut().enumerate() {
                        (0..3).for_each(|row| target[row] += column[row] * follows[(block.local + i, c)]);
                    }
                }
            }
            _ => {
                let targets = target.columns.iter_mut().skip(block.local);
                for (column, target) in block.columns.iter().zip(targets) {
                    (0..3).for_each(|row| target[row] += column[row]);
                }
            }
        }
    }
    coarse
}

/// The coarse group of a block; a pose's own intrinsics have none.
fn group(side: &CameraSide, block: u32) -> Option<u32> {
    match side.map.owners[block as usize] {
        BlockOwner::Pose(pose) => Some(side.clusters.of_pose[pose as usize]),
        BlockOwner::OwnIntrinsics(_) => None,
        BlockOwner::Nobody(at) => Some(side.coarse.num_clusters as u32 + at),
    }
}
