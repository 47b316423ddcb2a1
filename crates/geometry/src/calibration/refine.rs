//! Intrinsics and poses of least squared reprojection error, by Levenberg–Marquardt with the poses eliminated.

use nalgebra::{Matrix6, SMatrix, SVector, Vector6};

use super::{Calibration, CalibrationError, PlanarView};
use crate::camera::MAX_PARAMS;
use crate::linear::solve_positive_definite;
use crate::{Camera, Rigid3};

type Intrinsics = SMatrix<f64, MAX_PARAMS, MAX_PARAMS>;

/// What is estimated.
#[derive(Clone, Debug)]
pub(super) struct State {
    pub(super) camera: Camera,
    pub(super) cam_from_target: Vec<Rigid3>,
}

/// Half the sum of squared reprojection errors, in pixels; infinite when a point is not ahead or beyond the distortion's domain.
pub(super) fn cost(views: &[PlanarView<'_>], state: &State) -> f64 {
    let mut cost = 0.0;
    for (view, pose) in views.iter().zip(&state.cam_from_target) {
        for (xy, pixel) in view.xy_on_target.iter().zip(view.xy_px) {
            match state.camera.project(&pose.transform_point(&xy.push(0.0))) {
                Some(seen) => cost += 0.5 * (seen - pixel).norm_squared(),
                None => return f64::INFINITY,
            }
        }
    }
    cost
}

/// Normal equations: those of the intrinsics, of each pose, and what ties them.
struct Equations {
    intrinsics: Intrinsics,
    intrinsics_gradient: SVector<f64, MAX_PARAMS>,
    poses: Vec<(Matrix6<f64>, Vector6<f64>, SMatrix<f64, MAX_PARAMS, 6>)>,
}

impl Equations {
    fn new(views: &[PlanarView<'_>], state: &State) -> Self {
        let mut all = Self {
            intrinsics: Intrinsics::zeros(),
            intrinsics_gradient: SVector::zeros(),
            poses: Vec::with_capacity(views.len()),
        };
        for (view, pose) in views.iter().zip(&state.cam_from_target) {
            let (mut block, mut gradient, mut tie) = (Matrix6::zeros(), Vector6::zeros(), SMatrix::zeros());
            for (xy, pixel) in view.xy_on_target.iter().zip(view.xy_px) {
                let x_in_cam = pose.transform_point(&xy.push(0.0));
                let Some(seen) = state.camera.project_with_jacobian(&x_in_cam) else { continue };
                let mut d_pose = SMatrix::<f64, 2, 6>::zeros();
                d_pose.fixed_columns_mut::<3>(0).copy_from(&(-seen.d_point * crate::so3::skew(&x_in_cam)));
                d_pose.fixed_columns_mut::<3>(3).copy_from(&seen.d_point);
                let residual = seen.xy_px - pixel;
                block += d_pose.transpose() * d_pose;
                gradient += d_pose.transpose() * residual;
                tie += seen.d_params.transpose() * d_pose;
                all.intrinsics += seen.d_params.transpose() * seen.d_params;
                all.intrinsics_gradient += seen.d_params.transpose() * residual;
            }
            all.poses.push((block, gradient, tie));
        }
        // Parameters that the model lacks stay where they are.
        for unused in state.camera.model.num_params()..MAX_PARAMS {
            all.intrinsics[(unused, unused)] = 1.0;
        }
        all
    }

    /// The equations of the intrinsics with the poses eliminated, and the inverses of the poses' blocks.
    fn reduced(&self, damping: f64) -> Option<(Intrinsics, SVector<f64, MAX_PARAMS>, Vec<Matrix6<f64>>)> {
        let (mut matrix, mut gradient) = (self.intrinsics, self.intrinsics_gradient);
        for i in 0..MAX_PARAMS {
            matrix[(i, i)] *= 1.0 + damping;
        }
        let mut inverses = Vec::with_capacity(self.poses.len());
        for (block, pose_gradient, tie) in &self.poses {
            let mut damped = *block;
            for i in 0..6 {
                damped[(i, i)] *= 1.0 + damping;
            }
            let inverse = inverse(&damped)?;
            matrix -= tie * inverse * tie.transpose();
            gradient -= tie * (inverse * pose_gradient);
            inverses.push(inverse);
        }
        Some((matrix, gradient, inverses))
    }

    /// The state after a damped step; `None` when the equations can't be solved.
    fn stepped(&self, state: &State, damping: f64) -> Option<State> {
        let (matrix, gradient, inverses) = self.reduced(damping)?;
        let step = solve_positive_definite(&matrix, &-gradient)?;
        let mut next = state.clone();
        next.camera.params_mut().iter_mut().zip(step.iter()).for_each(|(value, change)| *value += change);
        for (k, (_, pose_gradient, tie)) in self.poses.iter().enumerate() {
            let pose_step = -(inverses[k] * (pose_gradient + tie.transpose() * step));
            next.cam_from_target[k] = state.cam_from_target[k].retract_left(&pose_step);
        }
        Some(next)
    }
}

/// The inverse of a symmetric positive definite matrix.
fn inverse<const N: usize>(matrix: &SMatrix<f64, N, N>) -> Option<SMatrix<f64, N, N>> {
    let mut inverse = SMatrix::<f64, N, N>::zeros();
    for i in 0..N {
        let mut unit = SVector::<f64, N>::zeros();
        unit[i] = 1.0;
        inverse.set_column(i, &solve_positive_definite(matrix, &unit)?);
    }
    Some(0.5 * (inverse + inverse.transpose()))
}

/// Descends from a start as far as it goes, then takes the covariances.
pub(super) fn refined(views: &[PlanarView<'_>], start: State) -> Result<Calibration, CalibrationError> {
    const MAX_STEPS: usize = 100;
    const MAX_DAMPING: f64 = 1e10;
    let mut least = cost(views, &start);
    let mut state = start;
    let mut damping = 1e-4;
    let mut equations = Equations::new(views, &state);
    for _ in 0..MAX_STEPS {
        let next = equations.stepped(&state, damping);
        let next_cost = next.as_ref().map_or(f64::INFINITY, |next| cost(views, next));
        let Some(next) = next.filter(|_| next_cost < least) else {
            damping *= 10.0;
            if damping > MAX_DAMPING {
                break;
            }
            continue;
        };
        let done = least - next_cost <= 1e-12 * least;
        (state, least) = (next, next_cost);
        damping = (damping * 0.1_f64).max(1e-14);
        equations = Equations::new(views, &state);
        if done {
            break;
        }
    }
    with_covariance(views, state, least, &equations)
}

fn with_covariance(
    views: &[PlanarView<'_>],
    state: State,
    cost: f64,
    equations: &Equations,
) -> Result<Calibration, CalibrationError> {
    let num_params = state.camera.model.num_params();
    let num_points: usize = views.iter().map(|view| view.xy_px.len()).sum();
    let freedom = (2 * num_points).saturating_sub(num_params + 6 * views.len());
    if freedom == 0 {
        return Err(CalibrationError::Undetermined);
    }
    if !(state.camera.focal_px().min() > 0.0 && cost.is_finite()) {
        return Err(CalibrationError::NoCamera);
    }
    let variance = 2.0 * cost / freedom as f64;
    let (matrix, _, inverses) = equations.reduced(0.0).ok_or(CalibrationError::Undetermined)?;
    let mut params = inverse(&matrix).ok_or(CalibrationError::Undetermined)?;
    for unused in num_params..MAX_PARAMS {
        params[(unused, unused)] = 0.0;
    }
    let pose_covariances = equations.poses.iter().zip(&inverses).map(|((_, _, tie), inverse)| {
        let through = inverse * tie.transpose();
        (inverse + through * params * through.transpose()) * variance
    });
    Ok(Calibration {
        camera: state.camera,
        rms_px: (2.0 * cost / num_points as f64).sqrt(),
        pose_covariances: pose_covariances.collect(),
        params_covariance: params * variance,
        cam_from_target: state.cam_from_target,
    })
}
