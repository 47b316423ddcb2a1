//! Priors and marks as weighted residuals of the camera side, with their Jacobians.

use nalgebra::{Matrix3, SMatrix, Vector2, Vector3};
use smallvec::SmallVec;
use terrane_geometry::so3;

use super::layout::{Cameras, Layout, NONE};
use super::priors::Anchor;
use super::projection::project_with_jacobian;
use super::{BundleOptions, BundleProblem};
use crate::Loss;

/// A residual of up to three rows under one loss.
pub(super) struct Term {
    /// Rows that count; the others are zero.
    pub rows: usize,
    /// The residual, in standard deviations.
    pub residual: [f64; 3],
    /// Weight of its square.
    pub weight: f64,
    /// Its cost.
    pub cost: f64,
    /// Jacobians in the blocks that it touches, each block once.
    pub blocks: SmallVec<[TermBlock; 2]>,
}

/// The Jacobian of a term in consecutive unknowns of one block.
pub(super) struct TermBlock {
    /// The block's number in the layout.
    pub block: u32,
    /// First of the unknowns within the block.
    pub local: usize,
    /// One column of three for each unknown.
    pub columns: SmallVec<[[f64; 3]; 6]>,
}

impl TermBlock {
    /// The unknowns among all.
    pub fn range(&self, layout: &Layout) -> std::ops::Range<usize> {
        let first = layout.offsets[self.block as usize] + self.local;
        first..first + self.columns.len()
    }
}

/// The scalar product of two columns.
pub(super) fn dot(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// All terms of a problem at one point of the search, in the order of the problem's lists.
pub(super) fn terms(
    problem: &BundleProblem,
    layout: &Layout,
    cameras: &Cameras,
    options: &BundleOptions,
) -> Vec<Term> {
    let at = Terms { problem, layout, cameras, options };
    let priors = &problem.priors;
    let positions = (0..priors.positions.len()).map(|i| at.position(i));
    let gravities = (0..priors.gravities.len()).map(|i| at.gravity(i));
    let rotations = (0..priors.rotations.len()).map(|i| at.rotation(i));
    let parameters = (0..priors.parameters.len()).filter_map(|i| at.parameter(i));
    let biases = (0..problem.position_biases.len()).filter_map(|i| at.bias(i));
    let landmarks = (0..priors.landmarks.len()).map(|i| at.landmark(i));
    let distances = (0..priors.distances.len()).map(|i| at.distance(i));
    let marks = (0..problem.marks.len()).filter_map(|i| at.mark(i));
    let first = positions.chain(gravities).chain(rotations).chain(parameters);
    first.chain(biases).chain(landmarks).chain(distances).chain(marks).collect()
}

/// The cost of all priors and marks; infinite where a step has taken a landmark out of a camera's view.
pub(super) fn cost(
    problem: &BundleProblem,
    layout: &Layout,
    cameras: &Cameras,
    options: &BundleOptions,
) -> f64 {
    terms(problem, layout, cameras, options).iter().map(|term| term.cost).sum()
}

/// The pairs of different blocks that terms tie together, the smaller first.
pub(super) fn ties(terms: &[Term]) -> Vec<(u32, u32)> {
    let mut pairs = Vec::new();
    for term in terms {
        for (i, a) in term.blocks.iter().enumerate() {
            for b in &term.blocks[..i] {
                pairs.push((a.block.min(b.block), a.block.max(b.block)));
            }
        }
    }
    pairs.sort_unstable();
    pairs.dedup();
    pairs
}

/// What terms are made from.
struct Terms<'a> {
    problem: &'a BundleProblem,
    layout: &'a Layout,
    cameras: &'a Cameras,
    options: &'a BundleOptions,
}

impl Terms<'_> {
    /// The centre and its bias against the measurement.
    fn position(&self, index: usize) -> Term {
        let prior = &self.problem.priors.positions[index];
        let center = self.cameras.poses[prior.pose as usize].center();
        let bias = prior.bias.map_or_else(Vector3::zeros, |bias| self.cameras.biases_m[bias as usize]);
        let residual = (center + bias - prior.center_in_world).component_div(&prior.sigma_m);
        let scale = Matrix3::from_diagonal(&prior.sigma_m.map(|sigma| 1.0 / sigma));
        let mut term = self.measured(residual);
        self.touch_center(&mut term, prior.pose, &scale);
        if let Some(bias) = prior.bias {
            term.touch(self.layout.bias_block[bias as usize], 0, &scale);
        }
        term
    }

    fn bias(&self, index: usize) -> Option<Term> {
        let block = self.layout.bias_block[index];
        let sigma = &self.problem.position_biases[index].sigma_m;
        let mut term = Term::new(self.cameras.biases_m[index].component_div(sigma), Loss::Squared, 1.0);
        term.touch(block, 0, &Matrix3::from_diagonal(&sigma.map(|sigma| 1.0 / sigma)));
        (block != NONE).then_some(term)
    }

    /// The difference of two unit vectors: as long as the angle between them, near enough, and smooth everywhere.
    fn gravity(&self, index: usize) -> Term {
        let prior = &self.problem.priors.gravities[index];
        let down = self.cameras.poses[prior.pose as usize].rotation * prior.down_in_world;
        let mut term = self.measured((down - prior.down_in_cam) / prior.sigma_rad);
        term.touch(self.layout.pose_variable[prior.pose as usize], 0, &(-so3::skew(&down) / prior.sigma_rad));
        term
    }

    fn rotation(&self, index: usize) -> Term {
        let prior = &self.problem.priors.rotations[index];
        let rotation = self.cameras.poses[prior.pose as usize].rotation;
        let turn = so3::log(&(rotation * prior.cam_from_world.inverse()));
        let scale = Matrix3::from_diagonal(&prior.sigma_rad.map(|sigma| 1.0 / sigma));
        let mut term = self.measured(scale * turn);
        let columns = scale * so3::left_jacobian_inverse(&turn);
        term.touch(self.layout.pose_variable[prior.pose as usize], 0, &columns);
        term
    }

    fn parameter(&self, index: usize) -> Option<Term> {
        let prior = &self.problem.priors.parameters[index];
        let variable = self.layout.intrinsics_variable[prior.intrinsics as usize];
        if variable == NONE {
            return None;
        }
        let local =
            self.layout.params[variable as usize].iter().position(|param| *param == prior.param as usize)?;
        let value = self.cameras.intrinsics[prior.intrinsics as usize].params()[prior.param as usize];
        let residual = Vector3::new((value - prior.value) / prior.sigma, 0.0, 0.0);
        let mut term = Term::new(residual, Loss::Squared, 1.0);
        let block = self.layout.poses.len() as u32 + variable;
        term.touch(block, local, &Vector3::new(1.0 / prior.sigma, 0.0, 0.0));
        term.rows = 1;
        Some(term)
    }

    fn landmark(&self, index: usize) -> Term {
        let prior = &self.problem.priors.landmarks[index];
        let x = self.cameras.landmarks[prior.landmark as usize];
        let mut term = self.measured((x - prior.x_in_world).component_div(&prior.sigma_m));
        let scale = Matrix3::from_diagonal(&prior.sigma_m.map(|sigma| 1.0 / sigma));
        term.touch(self.layout.landmark_block[prior.landmark as usize], 0, &scale);
        term
    }

    fn distance(&self, index: usize) -> Term {
        let prior = &self.problem.priors.distances[index];
        let place = |anchor: Anchor| match anchor {
            Anchor::Pose(pose) => self.cameras.poses[pose as usize].center(),
            Anchor::Landmark(landmark) => self.cameras.landmarks[landmark as usize],
        };
        let between = place(prior.to) - place(prior.from);
        let length = between.norm();
        // Where both ends coincide any direction leads apart.
        let direction = between.try_normalize(0.0).unwrap_or_else(Vector3::x);
        let mut term = self.measured(Vector3::new((length - prior.length_m) / prior.sigma_m, 0.0, 0.0));
        for (anchor, sign) in [(prior.from, -1.0), (prior.to, 1.0)] {
            let mut slope = Matrix3::zeros();
            slope.set_row(0, &(direction.transpose() * (sign / prior.sigma_m)));
            match anchor {
                Anchor::Pose(pose) => self.touch_center(&mut term, pose, &slope),
                Anchor::Landmark(landmark) => {
                    term.touch(self.layout.landmark_block[landmark as usize], 0, &slope);
                }
            }
        }
        term.rows = 1;
        term
    }

    fn mark(&self, index: usize) -> Option<Term> {
        let mark = &self.problem.marks[index];
        if !self.layout.live_marks[index] {
            return None;
        }
        let pose = mark.pose as usize;
        let camera = &self.cameras.intrinsics[self.problem.intrinsics_of_pose[pose] as usize];
        let x_in_cam = self.cameras.x_in_cam(pose, &self.cameras.landmarks[mark.landmark as usize]);
        let Some(projection) = project_with_jacobian(camera, &x_in_cam, self.options.behind_camera) else {
            let mut lost = Term::new(Vector3::zeros(), Loss::Squared, 1.0);
            lost.cost = f64::INFINITY;
            return Some(lost);
        };
        let residual = camera.residual_px(&projection.xy_px, &Vector2::from(mark.xy_px)) / mark.sigma_px;
        let scale_sigma = self.options.loss_scale_px / mark.sigma_px;
        let mut term = Term::new(residual.push(0.0), self.options.loss, scale_sigma);
        let d_point: SMatrix<f64, 2, 3> = projection.d_point / mark.sigma_px;
        let mut d_pose = SMatrix::<f64, 2, 6>::zeros();
        d_pose.fixed_view_mut::<2, 3>(0, 0).copy_from(&(-d_point * so3::skew(&x_in_cam)));
        d_pose.fixed_view_mut::<2, 3>(0, 3).copy_from(&d_point);
        term.touch_plane(self.layout.pose_variable[pose], d_pose.column_iter().map(|c| [c[0], c[1]]));
        let variable = self.layout.intrinsics_variable_of_pose[pose];
        if variable != NONE {
            let columns = self.layout.params[variable as usize]
                .iter()
                .map(|param| [0, 1].map(|row| projection.d_params[(row, *param)] / mark.sigma_px));
            term.touch_plane(self.layout.poses.len() as u32 + variable, columns);
        }
        let d_landmark = d_point * self.cameras.poses[pose].rotation.to_rotation_matrix();
        let block = self.layout.landmark_block[mark.landmark as usize];
        term.touch_plane(block, d_landmark.column_iter().map(|c| [c[0], c[1]]));
        term.rows = 2;
        Some(term)
    }

    /// A measurement under the loss of priors.
    fn measured(&self, residual: Vector3<f64>) -> Term {
        Term::new(residual, self.options.prior_loss, self.options.prior_loss_scale_sigma)
    }

    /// With (ω, v) on the left of `cam_from_world` the centre moves by −Rᵀ v.
    fn touch_center(&self, term: &mut Term, pose: u32, slope: &Matrix3<f64>) {
        let rotation = self.cameras.poses[pose as usize].rotation.to_rotation_matrix();
        term.touch(self.layout.pose_variable[pose as usize], 3, &(-slope * rotation.matrix().transpose()));
    }
}

impl Term {
    fn new(residual: Vector3<f64>, loss: Loss, scale: f64) -> Self {
        let (rho, weight) = loss.evaluate(residual.norm_squared(), scale);
        Self { rows: 3, residual: residual.into(), weight, cost: 0.5 * rho, blocks: SmallVec::new() }
    }

    /// Adds the Jacobian in a block, unless that is held.
    fn touch<const N: usize>(&mut self, block: u32, local: usize, jacobian: &SMatrix<f64, 3, N>) {
        if block != NONE {
            let columns = jacobian.column_iter().map(|column| [column[0], column[1], column[2]]).collect();
            self.blocks.push(TermBlock { block, local, columns });
        }
    }

    /// The same for a residual in the image.
    fn touch_plane(&mut self, block: u32, columns: impl Iterator<Item = [f64; 2]>) {
        if block != NONE {
            let columns = columns.map(|[x, y]| [x, y, 0.0]).collect();
            self.blocks.push(TermBlock { block, local: 0, columns });
        }
    }
}
