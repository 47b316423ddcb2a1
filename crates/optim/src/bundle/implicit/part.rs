//! The unit of work: the points of one cluster of cameras, with all observations of them.

use nalgebra::Vector3;

use super::super::layout::{Layout, NONE};
use super::super::{BundleError, BundleProblem};

/// Points that mostly one cluster of cameras sees, and all their observations, by pose.
///
/// There is one part for each cluster, with the cluster's index. A part is what is streamed and distributed: whoever
/// holds it needs nothing else but the cameras.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Part {
    /// The poses that see any of the points, ascending.
    pub poses: Vec<u32>,
    /// First observation of each of these poses, then their number.
    pub first_observation: Vec<u32>,
    /// For each observation, by pose and then by point, the point's index within the part.
    pub point_of: Vec<u32>,
    /// Where it was seen, in pixels.
    pub xy_px: Vec<[f32; 2]>,
    /// Points in the world's frame.
    pub points: Vec<Vector3<f64>>,
    /// The points from this one on are held.
    pub first_fixed_point: u32,
}

impl Part {
    /// Number of observations.
    pub fn num_observations(&self) -> usize {
        self.point_of.len()
    }

    /// Checks order, indices and finiteness; `index` names the part in messages.
    ///
    /// # Errors
    /// When the part could not have come from a valid problem with so many poses.
    pub fn validate(&self, index: usize, num_poses: usize) -> Result<(), BundleError> {
        let fail = |what: &str| Err(BundleError::invalid(format!("part {index}: {what}")));
        let n = self.point_of.len();
        if self.xy_px.len() != n || self.first_observation.len() != self.poses.len() + 1 {
            return fail("its arrays differ in length");
        }
        let ends = (self.first_observation.first().copied(), self.first_observation.last().copied());
        if ends != (Some(0), u32::try_from(n).ok()) || !self.first_observation.is_sorted() {
            return fail("its observations are not in order");
        }
        if !self.poses.is_sorted_by(|a, b| a < b)
            || self.poses.last().is_some_and(|p| *p as usize >= num_poses)
        {
            return fail("its poses are not in order or do not exist");
        }
        if self.point_of.iter().any(|p| *p as usize >= self.points.len()) {
            return fail("an observation names a point that is not there");
        }
        let finite = self.points.iter().all(|x| x.iter().all(|v| v.is_finite()))
            && self.xy_px.iter().all(|xy| xy[0].is_finite() && xy[1].is_finite());
        if finite { Ok(()) } else { fail("a point or an observation is not finite") }
    }
}

/// Where the unknowns of a pose and of its intrinsics lie in the vector of all camera unknowns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct CameraUnknowns {
    /// First of the six unknowns of the pose, or [`NONE`].
    pub pose: u32,
    /// First unknown of the intrinsics, or [`NONE`].
    pub intrinsics: u32,
    /// Number of unknowns of the intrinsics.
    pub num_intrinsics: u32,
    /// Whether no other pose has these intrinsics.
    pub own: bool,
}

/// Whose a block of unknowns is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum BlockOwner {
    /// The pose's.
    Pose(u32),
    /// The intrinsics of that pose alone.
    OwnIntrinsics(u32),
    /// No single pose's: the number in [`CameraMap::shared`].
    Nobody(u32),
}

/// The unknowns of every pose.
pub(super) struct CameraMap {
    pub of_pose: Vec<CameraUnknowns>,
    /// Room for the parameters of intrinsics in every array.
    pub stride: usize,
    /// All unknowns.
    pub num_unknowns: usize,
    /// First unknown and number of each of the blocks that no single pose owns, ascending: intrinsics that poses share,
    /// position biases, landmarks.
    pub shared: Vec<(u32, u32)>,
    /// For each block of the layout, whose it is.
    pub owners: Vec<BlockOwner>,
}

impl CameraMap {
    pub fn new(problem: &BundleProblem, layout: &Layout) -> Self {
        let free = layout.poses.len();
        let mut uses = vec![0u32; layout.intrinsics.len()];
        for (pose, variable) in layout.intrinsics_variable_of_pose.iter().enumerate() {
            if *variable != NONE && layout.seen[pose] {
                uses[*variable as usize] += 1;
            }
        }
        let of_pose = (0..problem.poses.len()).map(|pose| {
            let (variable, intrinsics) =
                (layout.pose_variable[pose], layout.intrinsics_variable_of_pose[pose]);
            let refined = intrinsics != NONE;
            CameraUnknowns {
                pose: if variable == NONE { NONE } else { 6 * variable },
                intrinsics: if refined { layout.offsets[free + intrinsics as usize] as u32 } else { NONE },
                num_intrinsics: if refined { layout.params[intrinsics as usize].len() as u32 } else { 0 },
                own: refined && variable != NONE && layout.seen[pose] && uses[intrinsics as usize] == 1,
            }
        });
        let of_pose: Vec<CameraUnknowns> = of_pose.collect();
        let mut owners = vec![BlockOwner::Nobody(0); layout.offsets.len() - 1];
        for (pose, unknowns) in of_pose.iter().enumerate() {
            if unknowns.pose != NONE {
                owners[layout.pose_variable[pose] as usize] = BlockOwner::Pose(pose as u32);
            }
            if unknowns.own {
                let variable = layout.intrinsics_variable_of_pose[pose] as usize;
                owners[free + variable] = BlockOwner::OwnIntrinsics(pose as u32);
            }
        }
        let mut shared = Vec::new();
        for (block, owner) in owners.iter_mut().enumerate() {
            if let BlockOwner::Nobody(at) = owner {
                *at = shared.len() as u32;
                let (first, end) = (layout.offsets[block] as u32, layout.offsets[block + 1] as u32);
                shared.push((first, end - first));
            }
        }
        Self { of_pose, stride: layout.stride, num_unknowns: layout.num_unknowns(), shared, owners }
    }

    /// Width of the unknowns of one camera in local vectors.
    pub fn width(&self) -> usize {
        6 + self.stride
    }

    /// Copies the unknowns of a pose from `all` to a local vector; held ones become zero.
    #[inline]
    pub fn gather(&self, pose: u32, all: &[f64], local: &mut [f64]) {
        let unknowns = &self.of_pose[pose as usize];
        local.fill(0.0);
        if unknowns.pose != NONE {
            local[..6].copy_from_slice(&all[unknowns.pose as usize..unknowns.pose as usize + 6]);
        }
        let (first, n) = (unknowns.intrinsics as usize, unknowns.num_intrinsics as usize);
        if n > 0 {
            local[6..6 + n].copy_from_slice(&all[first..first + n]);
        }
    }

    /// Adds a local vector to the unknowns of a pose; held ones are dropped.
    #[inline]
    pub fn scatter(&self, pose: u32, local: &[f64], all: &mut [f64]) {
        let unknowns = &self.of_pose[pose as usize];
        if unknowns.pose != NONE {
            let target = &mut all[unknowns.pose as usize..unknowns.pose as usize + 6];
            target.iter_mut().zip(local).for_each(|(sum, add)| *sum += add);
        }
        let (first, n) = (unknowns.intrinsics as usize, unknowns.num_intrinsics as usize);
        if n > 0 {
            all[first..first + n].iter_mut().zip(&local[6..]).for_each(|(sum, add)| *sum += add);
        }
    }
}
