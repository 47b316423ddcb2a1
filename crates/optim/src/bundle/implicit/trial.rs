//! A part after a step: points by back-substitution, and the cost where they lead.

use nalgebra::Vector3;

use super::super::layout::Cameras;
use super::super::projection::{project, residual_px};
use super::super::step::Tried;
use super::real::Real;
use super::state::{Frame, PartState};

/// A point's step is halved so often, at most, to keep the point in front of its cameras.
const MAX_HALVINGS: u32 = 3;

impl<T: Real> PartState<T> {
    /// Tries the step of the cameras (`6 + stride` values for each of the part's) that leads to `next`.
    pub fn try_step(&mut self, frame: &Frame<'_>, damping: f64, step: &[f64], next: &Cameras) -> Tried {
        let mut tried = Tried::default();
        let mut steps = vec![Vector3::zeros(); self.part.points.len()];
        // What the cameras' step asks of the points: `J_pᵀ J_c δ`.
        self.lanes.forward_only(frame.map.stride, step, &mut self.scratch);
        for (point, step) in steps.iter_mut().enumerate().take(self.part.first_fixed_point as usize) {
            let asked = self.scratch.asked_of(point);
            *step = self.point_step(point, &asked, damping, &mut tried);
        }
        for (point, x) in self.part.points.iter().enumerate() {
            self.tried[point] = x + steps[point];
            tried.norm_squared += x.norm_squared();
        }
        let mut lost = Vec::new();
        for (camera, pose) in self.part.poses.iter().enumerate() {
            let observations = self.part.first_observation[camera] as usize
                ..self.part.first_observation[camera + 1] as usize;
            for i in observations {
                let point = self.part.point_of[i];
                match cost(frame, next, *pose as usize, &self.tried[point as usize], self.part.xy_px[i]) {
                    Some(cost) => tried.cost += cost,
                    None => lost.push(point),
                }
            }
        }
        if !lost.is_empty() {
            lost.sort_unstable();
            lost.dedup();
            self.shorten(frame, next, &steps, &lost, &mut tried);
        }
        tried
    }

    /// `δp = −L⁻ᵀ (L⁻¹ g + L⁻¹ w)`, and what it adds to the model.
    fn point_step(&self, point: usize, asked: &[f64; 3], damping: f64, tried: &mut Tried) -> Vector3<f64> {
        let i = self.lanes.inverse[point].map(|v| v.to_f64());
        let (normal, [r0, r1, r2]) = (&self.normal[point], self.reduced[point]);
        let held = self.lanes.inverse[point] == [T::default(); 6];
        let diagonal = if held { [0.0; 3] } else { [normal[0], normal[2], normal[5]] };
        let right = [
            r0 + i[0] * asked[0],
            r1 + i[1] * asked[0] + i[2] * asked[1],
            r2 + i[3] * asked[0] + i[4] * asked[1] + i[5] * asked[2],
        ];
        let delta = Vector3::new(
            -(i[0] * right[0] + i[1] * right[1] + i[3] * right[2]),
            -(i[2] * right[1] + i[4] * right[2]),
            -(i[5] * right[2]),
        );
        let reduced = [r0, r1, r2];
        for c in 0..3 {
            let damped = damping * diagonal[c] * delta[c] * delta[c];
            tried.model_reduction += 0.5 * (damped + reduced[c] * right[c]);
        }
        tried.step_squared += delta.norm_squared();
        delta
    }

    /// Shortens the steps of points that leave the view of a camera, and corrects the cost.
    fn shorten(
        &mut self,
        frame: &Frame<'_>,
        next: &Cameras,
        steps: &[Vector3<f64>],
        lost: &[u32],
        tried: &mut Tried,
    ) {
        let mut seen: Vec<Vec<(u32, [f32; 2])>> = vec![Vec::new(); lost.len()];
        for (camera, pose) in self.part.poses.iter().enumerate() {
            for i in self.part.first_observation[camera]..self.part.first_observation[camera + 1] {
                if let Ok(at) = lost.binary_search(&self.part.point_of[i as usize]) {
                    seen[at].push((*pose, self.part.xy_px[i as usize]));
                }
            }
        }
        for (point, seen) in lost.iter().map(|point| *point as usize).zip(&seen) {
            // What was counted of this point before it was known to be lost.
            let counted = seen
                .iter()
                .filter_map(|(pose, xy)| cost(frame, next, *pose as usize, &self.tried[point], *xy));
            tried.cost -= counted.sum::<f64>();
            let whole = |x: &Vector3<f64>| {
                seen.iter().map(|(pose, xy)| cost(frame, next, *pose as usize, x, *xy)).sum::<Option<f64>>()
            };
            let start = self.part.points[point];
            let lengths =
                (1..=MAX_HALVINGS + 1).map(|i| if i > MAX_HALVINGS { 0.0 } else { 0.5f64.powi(i as i32) });
            let found =
                lengths.map(|length| start + steps[point] * length).find_map(|x| Some((x, whole(&x)?)));
            let (x, cost) = found.unwrap_or((start, f64::INFINITY));
            self.tried[point] = x;
            tried.cost += cost;
        }
    }
}

/// The cost of one observation, or `None` where it can't be projected.
#[inline(always)]
fn cost(frame: &Frame<'_>, cameras: &Cameras, pose: usize, x: &Vector3<f64>, xy_px: [f32; 2]) -> Option<f64> {
    let camera = &cameras.intrinsics[frame.problem.intrinsics_of_pose[pose] as usize];
    let xy = project(camera, &cameras.x_in_cam(pose, x), frame.options.behind_camera)?;
    let [dx, dy] = residual_px(camera, &xy, xy_px);
    let cost = 0.5 * frame.options.loss.evaluate(dx * dx + dy * dy, frame.options.loss_scale_px).0;
    cost.is_finite().then_some(cost)
}
