//! Which unknowns the reduced camera system has, and the cameras at one point of the search.

use nalgebra::{Matrix3, Vector3, Vector6};
use terrane_geometry::camera::MAX_PARAMS;
use terrane_geometry::{Camera, Rigid3};

use super::BundleProblem;
use super::problem::camera_is_sane;

/// No unknown: held.
pub(super) const NONE: u32 = u32::MAX;

/// The unknowns: six of each free pose, then the refined parameters of each of the intrinsics.
pub(super) struct Layout {
    /// For each pose its number among the free ones, or [`NONE`].
    pub pose_variable: Vec<u32>,
    /// Pose of each pose variable.
    pub poses: Vec<u32>,
    /// For each of the intrinsics its number among the refined ones, or [`NONE`].
    pub intrinsics_variable: Vec<u32>,
    /// Intrinsics of each intrinsics variable.
    pub intrinsics: Vec<u32>,
    /// Indices of the refined parameters of each intrinsics variable.
    pub params: Vec<Vec<usize>>,
    /// For each pose, the variable of its intrinsics, or [`NONE`].
    pub intrinsics_variable_of_pose: Vec<u32>,
    /// Room for the parameters of one intrinsics variable in every array: the largest number, rounded up.
    pub stride: usize,
}

impl Layout {
    /// The unknowns of a problem: what is free and `observed` (poses) or has a prior.
    pub fn new(problem: &BundleProblem, observed: &[bool], held: Option<u32>) -> Self {
        let mut constrained = observed.to_vec();
        for prior in &problem.position_priors {
            constrained[prior.pose as usize] = true;
        }
        let (mut pose_variable, mut poses) = (vec![NONE; problem.poses.len()], Vec::new());
        for pose in 0..problem.poses.len() {
            if !problem.fixed_poses[pose] && constrained[pose] && held != Some(pose as u32) {
                pose_variable[pose] = poses.len() as u32;
                poses.push(pose as u32);
            }
        }
        let mut used = vec![false; problem.intrinsics.len()];
        for (pose, &intrinsics) in problem.intrinsics_of_pose.iter().enumerate() {
            used[intrinsics as usize] |= observed[pose];
        }
        let (mut intrinsics_variable, mut intrinsics) = (vec![NONE; problem.intrinsics.len()], Vec::new());
        let mut params = Vec::new();
        for (i, camera) in problem.intrinsics.iter().enumerate() {
            let refined = problem.refine[i].params(camera);
            if used[i] && !refined.is_empty() {
                intrinsics_variable[i] = intrinsics.len() as u32;
                intrinsics.push(i as u32);
                params.push(refined);
            }
        }
        let most = params.iter().map(Vec::len).max().unwrap_or(0);
        let stride = STRIDES.into_iter().find(|stride| *stride >= most).unwrap_or(MAX_PARAMS);
        let intrinsics_variable_of_pose =
            problem.intrinsics_of_pose.iter().map(|i| intrinsics_variable[*i as usize]).collect();
        Self {
            pose_variable,
            poses,
            intrinsics_variable,
            intrinsics,
            params,
            intrinsics_variable_of_pose,
            stride,
        }
    }

    /// Number of scalar unknowns.
    pub fn num_unknowns(&self) -> usize {
        6 * self.poses.len() + self.params.iter().map(Vec::len).sum::<usize>()
    }

    /// Sizes of all blocks, poses first.
    pub fn dims(&self) -> Vec<usize> {
        self.poses.iter().map(|_| 6).chain(self.params.iter().map(Vec::len)).collect()
    }
}

/// The strides for which kernels are compiled with fixed sizes.
pub(super) const STRIDES: [usize; 9] = [0, 1, 2, 3, 4, 6, 8, 12, MAX_PARAMS];

/// Poses and intrinsics at one point of the search, ready for projecting.
#[derive(Clone)]
pub(super) struct Cameras {
    pub poses: Vec<Rigid3>,
    pub intrinsics: Vec<Camera>,
    /// `cam_from_world` rotation of each pose, as rows.
    pub rotations: Vec<[[f64; 3]; 3]>,
    /// Translation of each pose.
    pub translations: Vec<[f64; 3]>,
}

impl Cameras {
    pub fn new(poses: Vec<Rigid3>, intrinsics: Vec<Camera>) -> Self {
        let rotations = poses.iter().map(|pose| rows(&pose.rotation_matrix())).collect();
        let translations = poses.iter().map(|pose| pose.translation.into()).collect();
        Self { poses, intrinsics, rotations, translations }
    }

    /// The cameras after a step of the reduced system, or `None` where intrinsics lose their meaning.
    pub fn stepped(&self, layout: &Layout, step: &[f64]) -> Option<Self> {
        let mut next = self.clone();
        for (variable, &pose) in layout.poses.iter().enumerate() {
            let delta = Vector6::from_column_slice(&step[6 * variable..6 * variable + 6]);
            let moved = self.poses[pose as usize].retract_left(&delta);
            next.rotations[pose as usize] = rows(&moved.rotation_matrix());
            next.translations[pose as usize] = moved.translation.into();
            next.poses[pose as usize] = moved;
        }
        let mut at = 6 * layout.poses.len();
        for (params, &intrinsics) in layout.params.iter().zip(&layout.intrinsics) {
            let camera = &mut next.intrinsics[intrinsics as usize];
            for &param in params {
                camera.params_mut()[param] += step[at];
                at += 1;
            }
            if !camera_is_sane(camera) {
                return None;
            }
        }
        Some(next)
    }

    /// A point of the world in a camera's frame.
    #[inline(always)]
    pub fn x_in_cam(&self, pose: usize, x: &Vector3<f64>) -> Vector3<f64> {
        let (r, t) = (&self.rotations[pose], &self.translations[pose]);
        Vector3::new(
            r[0][0] * x.x + r[0][1] * x.y + r[0][2] * x.z + t[0],
            r[1][0] * x.x + r[1][1] * x.y + r[1][2] * x.z + t[1],
            r[2][0] * x.x + r[2][1] * x.y + r[2][2] * x.z + t[2],
        )
    }

    /// Squared norm of what [`Cameras::stepped`] changes, translations and parameters.
    pub fn squared_norm(&self, layout: &Layout) -> f64 {
        let poses: f64 =
            layout.poses.iter().map(|pose| self.poses[*pose as usize].translation.norm_squared()).sum();
        let params = layout.params.iter().zip(&layout.intrinsics).flat_map(|(params, intrinsics)| {
            let camera = &self.intrinsics[*intrinsics as usize];
            params.iter().map(|param| camera.params()[*param].powi(2))
        });
        poses + layout.poses.len() as f64 + params.sum::<f64>()
    }
}

fn rows(matrix: &Matrix3<f64>) -> [[f64; 3]; 3] {
    [0, 1, 2].map(|r| [matrix[(r, 0)], matrix[(r, 1)], matrix[(r, 2)]])
}
