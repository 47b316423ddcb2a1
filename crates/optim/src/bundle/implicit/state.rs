//! A part at one point of the search: linearised, its points eliminated.

use nalgebra::Vector3;

use super::super::layout::{Cameras, Layout};
use super::super::linearisation::factorize_normal;
use super::super::projection::{project_with_jacobian, residual_px};
use super::super::{BundleOptions, BundleProblem};
use super::clusters::Clusters;
use super::local::LocalFactor;
use super::part::{CameraMap, Part};
use super::product::{LaneArrays, Scratch, num_rows};
use super::real::{LANES, Real, splat};

/// What all parts are worked on against.
pub(super) struct Frame<'a> {
    pub problem: &'a BundleProblem,
    pub options: &'a BundleOptions,
    pub layout: &'a Layout,
    pub map: &'a CameraMap,
    pub clusters: &'a Clusters,
    pub cameras: &'a Cameras,
}

/// The accepted and the tried points of a part, and its linearisation.
pub(super) struct PartState<T> {
    pub part: Part,
    pub tried: Vec<Vector3<f64>>,
    pub lanes: LaneArrays<T>,
    /// Of each point the normal equations (lower triangle by rows) and the gradient, before damping.
    pub normal: Vec<[f64; 9]>,
    /// `L⁻¹ g` of each point.
    pub reduced: Vec<[f64; 3]>,
    /// The gradient, `6 + stride` for each camera.
    pub gradient: Vec<f64>,
    pub cost: f64,
    pub scratch: Scratch<T>,
    pub local: Option<LocalFactor<T>>,
}

/// Sums over the observations of each camera of a part, `6 + stride` wide; blocks are packed lower triangles by rows.
pub(super) struct CameraSums {
    /// The gradient after elimination.
    pub reduced_gradient: Vec<f64>,
    /// The normal equations, one block a camera.
    pub normal: Vec<f64>,
    /// The diagonal blocks of the reduced system.
    pub reduced: Vec<f64>,
    /// The largest `g² / D` of a point's coordinate.
    pub steepest: f64,
}

/// Values of a packed lower triangle.
pub(super) const fn packed(width: usize) -> usize {
    width * (width + 1) / 2
}

impl<T: Real> PartState<T> {
    pub fn new(part: Part, stride: usize) -> Self {
        let mut state = Self {
            part: Part::default(),
            tried: Vec::new(),
            lanes: LaneArrays::default(),
            normal: Vec::new(),
            reduced: Vec::new(),
            gradient: Vec::new(),
            cost: 0.0,
            scratch: Scratch::default(),
            local: None,
        };
        state.refill(part, stride);
        state
    }

    /// Takes a part in again after [`PartState::release`].
    pub fn refill(&mut self, part: Part, stride: usize) {
        let n = part.points.len();
        self.lanes = lane_arrays(&part, stride);
        self.tried = part.points.clone();
        self.normal = vec![[0.0; 9]; n];
        self.reduced = vec![[0.0; 3]; n];
        self.part = part;
    }

    /// Gives everything back but the cluster's factor.
    pub fn release(&mut self) {
        let local = self.local.take();
        *self = Self { local, ..Self::new(Part::default(), 0) };
    }

    /// Bytes that a part takes when it is held, beside its cluster's factor.
    pub fn held_bytes(part: &Part, stride: usize) -> u64 {
        let lanes = part.num_observations() + LANES / 2 * part.poses.len();
        let observation = num_rows(stride) * size_of::<T>() + 2 * size_of::<T>() + 4;
        let point = 2 * size_of::<Vector3<f64>>() + 9 * 8 + 3 * 8 + 10 * size_of::<T>();
        (lanes * observation + 12 * part.num_observations() + point * part.points.len()) as u64
    }

    /// Residuals and Jacobians of all observations, at the accepted points.
    pub fn linearise(&mut self, frame: &Frame<'_>) {
        let width = frame.map.width();
        let num_cameras = self.part.poses.len();
        self.normal.fill([0.0; 9]);
        self.lanes.rows.fill(splat(T::default()));
        self.cost = 0.0;
        self.gradient.clear();
        self.gradient.resize(width * num_cameras, 0.0);
        for camera in 0..num_cameras {
            let pose = self.part.poses[camera] as usize;
            let rotation = &frame.cameras.rotations[pose];
            self.lanes.rotations[camera] = std::array::from_fn(|i| T::from_f64(rotation[i / 3][i % 3]));
            let gradient = &mut self.gradient[width * camera..width * (camera + 1)];
            let first = self.part.first_observation[camera] as usize;
            let end = self.part.first_observation[camera + 1] as usize;
            for i in first..end {
                let slot = LANES * self.lanes.first_group[camera] as usize + (i - first);
                let point = self.part.point_of[i] as usize;
                let x = &self.part.points[point];
                let rows = &mut self.lanes.rows[num_rows(frame.map.stride) * (slot / LANES)..];
                let normal = &mut self.normal[point];
                let seen = Seen { pose, xy_px: self.part.xy_px[i], lane: slot % LANES };
                self.cost += linearise(frame, &seen, x, rows, normal, gradient);
            }
        }
    }

    /// Eliminates the points with this damping; the largest `g² / D` of a point's coordinate.
    pub fn eliminate(&mut self, damping: f64) -> f64 {
        let mut steepest = 0.0f64;
        for (point, normal) in self.normal.iter().enumerate() {
            let free = point < self.part.first_fixed_point as usize;
            let (terms, slope) = if free {
                let [v @ .., _, _, _] = normal;
                let v: &[f64; 6] = v;
                factorize_normal(v, &[normal[6], normal[7], normal[8]], damping)
            } else {
                Default::default()
            };
            self.lanes.inverse[point] = terms.inverse.map(T::from_f64);
            self.reduced[point] = terms.reduced;
            steepest = steepest.max(slope);
        }
        steepest
    }

    /// What remains of the cameras' blocks and gradients after [`PartState::eliminate`].
    pub fn camera_sums(&self, stride: usize, steepest: f64) -> CameraSums {
        let normal = self.lanes.normal_blocks(stride);
        let (mut reduced, mut reduced_gradient) = (normal.clone(), self.gradient.clone());
        self.lanes.eliminate(stride, &self.reduced, &mut reduced, &mut reduced_gradient);
        CameraSums { reduced_gradient, normal, reduced, steepest }
    }
}

/// The lanes of a part, without values.
fn lane_arrays<T: Real>(part: &Part, stride: usize) -> LaneArrays<T> {
    let none = part.points.len() as u32;
    let cameras = part.first_observation.windows(2);
    let groups = cameras.map(|w| ((w[1] - w[0]) as usize).div_ceil(LANES)).sum();
    let (mut first_group, mut points) = (vec![0u32], Vec::with_capacity(groups));
    for window in part.first_observation.windows(2) {
        for chunk in part.point_of[window[0] as usize..window[1] as usize].chunks(LANES) {
            let mut lanes = [none; LANES];
            lanes[..chunk.len()].copy_from_slice(chunk);
            points.push(lanes);
        }
        first_group.push(points.len() as u32);
    }
    LaneArrays {
        rows: vec![splat(T::default()); num_rows(stride) * points.len()],
        rotations: vec![[T::default(); 9]; part.poses.len()],
        inverse: vec![[T::default(); 6]; part.points.len() + 1],
        first_group,
        points,
    }
}

/// One observation and where it goes.
struct Seen {
    pose: usize,
    xy_px: [f32; 2],
    lane: usize,
}

/// Linearises one observation; its cost. One that can't be projected weighs nothing.
#[inline(always)]
fn linearise<T: Real>(
    frame: &Frame<'_>,
    seen: &Seen,
    x: &Vector3<f64>,
    rows: &mut [[T; LANES]],
    normal: &mut [f64; 9],
    gradient: &mut [f64],
) -> f64 {
    let camera = &frame.cameras.intrinsics[frame.problem.intrinsics_of_pose[seen.pose] as usize];
    let x_in_cam = frame.cameras.x_in_cam(seen.pose, x);
    let Some(projection) = project_with_jacobian(camera, &x_in_cam, frame.options.behind_camera) else {
        return 0.0;
    };
    let residual = residual_px(camera, &projection.xy_px, seen.xy_px);
    let squared = residual[0] * residual[0] + residual[1] * residual[1];
    let (rho, weight) = frame.options.loss.evaluate(squared, frame.options.loss_scale_px);
    let root = weight.sqrt();
    let residual = residual.map(|r| root * r);
    let lane = seen.lane;
    let rotation = &frame.cameras.rotations[seen.pose];
    let mut point = [[0.0; 3]; 2];
    let mut force = [0.0; 3];
    for c in 0..3 {
        rows[c][lane] = T::from_f64(x_in_cam[c]);
        for row in 0..2 {
            let d = root * projection.d_point[(row, c)];
            let kept = T::from_f64(d);
            rows[3 + 3 * row + c][lane] = kept;
            force[c] += d * residual[row];
            // The normal equations are those of the Jacobians that products use, so that S stays semidefinite.
            (0..3).for_each(|a| point[row][a] += kept.to_f64() * rotation[c][a]);
        }
    }
    for row in 0..2 {
        let j = &point[row];
        let products = [j[0] * j[0], j[1] * j[0], j[1] * j[1], j[2] * j[0], j[2] * j[1], j[2] * j[2]];
        (0..6).for_each(|i| normal[i] += products[i]);
    }
    for a in 0..3 {
        // The gradient is exact: what is rounded is only the way to its zero.
        normal[6 + a] += force[0] * rotation[0][a] + force[1] * rotation[1][a] + force[2] * rotation[2][a];
        let (b, c) = ((a + 1) % 3, (a + 2) % 3);
        gradient[a] += x_in_cam[b] * force[c] - x_in_cam[c] * force[b];
        gradient[3 + a] += force[a];
    }
    let variable = frame.layout.intrinsics_variable_of_pose[seen.pose];
    if variable != super::super::layout::NONE {
        let stride = frame.map.stride;
        for (a, &param) in frame.layout.params[variable as usize].iter().enumerate() {
            let d = [0, 1].map(|row| root * projection.d_params[(row, param)]);
            rows[9 + a][lane] = T::from_f64(d[0]);
            rows[9 + stride + a][lane] = T::from_f64(d[1]);
            gradient[6 + a] += d[0] * residual[0] + d[1] * residual[1];
        }
    }
    0.5 * rho
}
