//! What is known of cameras beforehand, as rows of the system.

use nalgebra::Vector3;
use smallvec::SmallVec;

use super::super::BundleOptions;
use super::super::layout::{Cameras, NONE};
use super::worker::CameraSide;

/// One weighted residual of consecutive unknowns.
pub(super) struct PriorRow {
    /// First unknown.
    pub first: usize,
    pub jacobian: SmallVec<[f64; 6]>,
    pub residual: f64,
    pub weight: f64,
    /// The pose whose block it touches, or none for intrinsics that poses share.
    pub pose: Option<u32>,
    /// First of its unknowns among the `6 + stride` of a camera.
    pub local: usize,
}

/// The rows of all priors where the cameras are.
pub(super) fn prior_rows(side: &CameraSide, cameras: &Cameras, options: &BundleOptions) -> Vec<PriorRow> {
    let mut rows = Vec::new();
    for prior in &side.problem.position_priors {
        let unknowns = &side.map.of_pose[prior.pose as usize];
        if unknowns.pose == NONE {
            continue;
        }
        let center = cameras.poses[prior.pose as usize].center();
        let residual = (center - prior.center_in_world).component_div(&prior.sigma_m);
        let (_, weight) =
            options.prior_loss.evaluate(residual.norm_squared(), options.prior_loss_scale_sigma);
        let rotation = &cameras.rotations[prior.pose as usize];
        for axis in 0..3 {
            // With (ω, v) on the left of cam_from_world the centre moves by −Rᵀ v.
            let along = Vector3::from_fn(|c, _| -rotation[c][axis] / prior.sigma_m[axis]);
            rows.push(PriorRow {
                first: unknowns.pose as usize + 3,
                jacobian: along.iter().copied().collect(),
                residual: residual[axis],
                weight,
                pose: Some(prior.pose),
                local: 3,
            });
        }
    }
    let mut pose_of_own = vec![None; side.problem.intrinsics.len()];
    for (pose, unknowns) in side.map.of_pose.iter().enumerate().filter(|(_, unknowns)| unknowns.own) {
        debug_assert!(unknowns.intrinsics != NONE);
        pose_of_own[side.problem.intrinsics_of_pose[pose] as usize] = Some(pose as u32);
    }
    for prior in &side.problem.focal_priors {
        let variable = side.layout.intrinsics_variable[prior.intrinsics as usize];
        if variable == NONE {
            continue;
        }
        let camera = &cameras.intrinsics[prior.intrinsics as usize];
        let user = side.problem.intrinsics_of_pose.iter().position(|i| *i == prior.intrinsics);
        let Some(first) = user.map(|pose| side.map.of_pose[pose].intrinsics as usize) else { continue };
        let refined = &side.layout.params[variable as usize];
        for (a, &param) in refined.iter().enumerate().filter(|(_, p)| **p < camera.model.num_focal()) {
            rows.push(PriorRow {
                first: first + a,
                jacobian: [1.0 / prior.sigma_px].into_iter().collect(),
                residual: (camera.params()[param] - prior.focal_px) / prior.sigma_px,
                weight: 1.0,
                pose: pose_of_own[prior.intrinsics as usize],
                local: 6 + a,
            });
        }
    }
    rows
}
