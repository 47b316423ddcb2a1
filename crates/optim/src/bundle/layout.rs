//! Which unknowns the reduced camera system has, and the cameras at one point of the search.

use nalgebra::{Matrix3, Vector3, Vector6};
use terrane_geometry::camera::MAX_PARAMS;
use terrane_geometry::{Camera, Rigid3};

use super::priors::Mark;
use super::problem::camera_is_sane;
use super::projection::project;
use super::{AdjustedCameras, BehindCamera, BundleProblem};

/// No unknown: held.
pub(super) const NONE: u32 = u32::MAX;

/// The unknowns in blocks: six of each free pose, then the refined parameters of each of the intrinsics, then three of
/// each position bias, then three of each landmark.
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
    /// For each pose whether it sees any point or landmark.
    pub seen: Vec<bool>,
    /// For each position bias its block, or [`NONE`].
    pub bias_block: Vec<u32>,
    /// For each landmark its block, or [`NONE`].
    pub landmark_block: Vec<u32>,
    /// For each mark whether it takes part: whether its landmark starts in view.
    pub live_marks: Vec<bool>,
    /// First unknown of each block, then their number.
    pub offsets: Vec<usize>,
    /// Room for the parameters of one intrinsics variable in every array: the largest number, rounded up.
    pub stride: usize,
}

impl Layout {
    /// The unknowns of a problem: what is free and `observed` (poses) or has a mark or a measured position.
    pub fn new(problem: &BundleProblem, observed: &[bool], held: Option<u32>, behind: BehindCamera) -> Self {
        let live_marks = live_marks(problem, behind);
        let marks = || problem.marks.iter().zip(&live_marks).filter(|(_, live)| **live).map(|(mark, _)| mark);
        let mut seen = observed.to_vec();
        marks().for_each(|mark| seen[mark.pose as usize] = true);
        let mut constrained = seen.clone();
        for prior in &problem.priors.positions {
            constrained[prior.pose as usize] = true;
        }
        let free = |pose: usize| !problem.fixed_poses[pose] && constrained[pose] && held != Some(pose as u32);
        let (pose_variable, poses) = numbered(problem.poses.len(), free);
        let mut used = vec![false; problem.intrinsics.len()];
        for (pose, &intrinsics) in problem.intrinsics_of_pose.iter().enumerate() {
            used[intrinsics as usize] |= seen[pose];
        }
        let refined = |i: usize| problem.refine[i].params(&problem.intrinsics[i]);
        let (intrinsics_variable, intrinsics) =
            numbered(problem.intrinsics.len(), |i| used[i] && !refined(i).is_empty());
        let params: Vec<Vec<usize>> = intrinsics.iter().map(|i| refined(*i as usize)).collect();
        let most = params.iter().map(Vec::len).max().unwrap_or(0);
        let stride = STRIDES.into_iter().find(|stride| *stride >= most).unwrap_or(MAX_PARAMS);
        let intrinsics_variable_of_pose =
            problem.intrinsics_of_pose.iter().map(|i| intrinsics_variable[*i as usize]).collect();
        let mut layout = Self {
            pose_variable,
            poses,
            intrinsics_variable,
            intrinsics,
            params,
            intrinsics_variable_of_pose,
            seen,
            bias_block: Vec::new(),
            landmark_block: Vec::new(),
            offsets: Vec::new(),
            stride,
            live_marks: Vec::new(),
        };
        let first = (layout.poses.len() + layout.intrinsics.len()) as u32;
        let after = layout.add_biases(problem, first);
        layout.add_landmarks(problem, marks(), after);
        layout.live_marks = live_marks;
        layout.offsets = vec![0];
        for dim in layout.dims() {
            layout.offsets.push(layout.offsets[layout.offsets.len() - 1] + dim);
        }
        layout
    }

    /// Gives blocks from `first` on to the biases that a measured position has; the number after them.
    fn add_biases(&mut self, problem: &BundleProblem, first: u32) -> u32 {
        let mut has_position = vec![false; problem.position_biases.len()];
        problem.priors.positions.iter().filter_map(|p| p.bias).for_each(|b| has_position[b as usize] = true);
        let (numbers, biases) = numbered(has_position.len(), |bias| has_position[bias]);
        self.bias_block = shifted(numbers, first);
        first + biases.len() as u32
    }

    /// Gives blocks from `first` on to the landmarks that are free and that a surveyed position or two marks hold.
    fn add_landmarks<'a>(
        &mut self,
        problem: &BundleProblem,
        marks: impl Iterator<Item = &'a Mark>,
        first: u32,
    ) {
        let mut holds = vec![0; problem.landmarks.len()];
        marks.for_each(|mark| holds[mark.landmark as usize] += 1);
        problem.priors.landmarks.iter().for_each(|prior| holds[prior.landmark as usize] += 2);
        let free = |landmark: usize| holds[landmark] >= 2 && !problem.landmarks[landmark].fixed;
        self.landmark_block = shifted(numbered(holds.len(), free).0, first);
    }

    /// Number of scalar unknowns.
    pub fn num_unknowns(&self) -> usize {
        self.offsets.last().copied().unwrap_or(0)
    }

    /// Sizes of all blocks.
    pub fn dims(&self) -> Vec<usize> {
        let params = self.params.iter().map(Vec::len);
        self.poses.iter().map(|_| 6).chain(params).chain(self.kept_blocks().map(|_| 3)).collect()
    }

    /// The blocks of biases and landmarks, ascending.
    pub fn kept_blocks(&self) -> impl Iterator<Item = u32> + '_ {
        self.bias_block.iter().chain(&self.landmark_block).copied().filter(|block| *block != NONE)
    }
}

/// Numbers those that are chosen: the number of each or [`NONE`], and each number's owner.
fn numbered(count: usize, chosen: impl Fn(usize) -> bool) -> (Vec<u32>, Vec<u32>) {
    let (mut numbers, mut owners) = (vec![NONE; count], Vec::new());
    for i in (0..count).filter(|i| chosen(*i)) {
        numbers[i] = owners.len() as u32;
        owners.push(i as u32);
    }
    (numbers, owners)
}

fn shifted(numbers: Vec<u32>, first: u32) -> Vec<u32> {
    numbers.into_iter().map(|number| if number == NONE { NONE } else { first + number }).collect()
}

/// For each mark whether its landmark starts where the camera can show it.
fn live_marks(problem: &BundleProblem, behind: BehindCamera) -> Vec<bool> {
    let live = problem.marks.iter().map(|mark| {
        let camera = &problem.intrinsics[problem.intrinsics_of_pose[mark.pose as usize] as usize];
        let x = &problem.landmarks[mark.landmark as usize].x_in_world;
        project(camera, &problem.poses[mark.pose as usize].transform_point(x), behind).is_some()
    });
    live.collect()
}

/// The strides for which kernels are compiled with fixed sizes.
pub(super) const STRIDES: [usize; 9] = [0, 1, 2, 3, 4, 6, 8, 12, MAX_PARAMS];

/// Poses, intrinsics, biases and landmarks at one point of the search, ready for projecting.
#[derive(Clone)]
pub(super) struct Cameras {
    pub poses: Vec<Rigid3>,
    pub intrinsics: Vec<Camera>,
    /// `cam_from_world` rotation of each pose, as rows.
    pub rotations: Vec<[[f64; 3]; 3]>,
    /// Translation of each pose.
    pub translations: Vec<[f64; 3]>,
    /// Each position bias.
    pub biases_m: Vec<Vector3<f64>>,
    /// Each landmark in the world.
    pub landmarks: Vec<Vector3<f64>>,
}

impl Cameras {
    /// The cameras where a problem starts.
    pub fn of(problem: &BundleProblem) -> Self {
        Self::from(AdjustedCameras::of(problem))
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
        let kept = |block: u32| {
            let at = (block != NONE).then(|| layout.offsets[block as usize])?;
            Some(Vector3::from_column_slice(&step[at..at + 3]))
        };
        for (bias, block) in next.biases_m.iter_mut().zip(&layout.bias_block) {
            *bias += kept(*block).unwrap_or_default();
        }
        for (landmark, block) in next.landmarks.iter_mut().zip(&layout.landmark_block) {
            *landmark += kept(*block).unwrap_or_default();
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

    /// Squared norm of what [`Cameras::stepped`] changes, rotations left out.
    pub fn squared_norm(&self, layout: &Layout) -> f64 {
        let poses: f64 =
            layout.poses.iter().map(|pose| self.poses[*pose as usize].translation.norm_squared()).sum();
        let params = layout.params.iter().zip(&layout.intrinsics).flat_map(|(params, intrinsics)| {
            let camera = &self.intrinsics[*intrinsics as usize];
            params.iter().map(|param| camera.params()[*param].powi(2))
        });
        let kept = self.biases_m.iter().zip(&layout.bias_block);
        let kept = kept.chain(self.landmarks.iter().zip(&layout.landmark_block));
        let kept = kept.filter(|(_, block)| **block != NONE).map(|(x, _)| x.norm_squared());
        poses + layout.poses.len() as f64 + params.sum::<f64>() + kept.sum::<f64>()
    }
}

impl From<AdjustedCameras> for Cameras {
    fn from(cameras: AdjustedCameras) -> Self {
        let AdjustedCameras { poses, intrinsics, biases_m, landmarks } = cameras;
        let rotations = poses.iter().map(|pose| rows(&pose.rotation_matrix())).collect();
        let translations = poses.iter().map(|pose| pose.translation.into()).collect();
        Self { poses, intrinsics, rotations, translations, biases_m, landmarks }
    }
}

impl From<Cameras> for AdjustedCameras {
    fn from(cameras: Cameras) -> Self {
        let Cameras { poses, intrinsics, biases_m, landmarks, .. } = cameras;
        Self { poses, intrinsics, biases_m, landmarks }
    }
}

fn rows(matrix: &Matrix3<f64>) -> [[f64; 3]; 3] {
    [0, 1, 2].map(|r| [matrix[(r, 0)], matrix[(r, 1)], matrix[(r, 2)]])
}
