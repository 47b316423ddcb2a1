//! Residuals of edges and priors, with Jacobians in perturbations `(ω, v, λ)` on the left of `world_from_node`.

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};
use terrane_geometry::{Sim3, so3};

use super::{PositionPrior, Sim3Edge};

type Matrix7 = SMatrix<f64, 7, 7>;

/// The `(ω, v, λ)` by which the solution differs from an edge.
pub(super) fn edge_residual(edge: &Sim3Edge, world_from_node: &[Sim3]) -> SVector<f64, 7> {
    let predicted = world_from_node[edge.to as usize].inverse() * world_from_node[edge.from as usize];
    predicted.local_left(&edge.to_from_from)
}

/// The derivative of [`edge_residual`] in the perturbation of `from`; that of `to` is its negative.
pub(super) fn edge_jacobian(
    edge: &Sim3Edge,
    world_from_node: &[Sim3],
    residual: &SVector<f64, 7>,
) -> Matrix7 {
    let to_from_world = world_from_node[edge.to as usize].inverse();
    let omega = residual.fixed_rows::<3>(0).into_owned();
    let translation = residual.fixed_rows::<3>(3).into_owned();
    // A small ξ on the left of the difference: rotation by the inverse left Jacobian, the rest as points move.
    let mut by_step = Matrix7::identity();
    by_step.fixed_view_mut::<3, 3>(0, 0).copy_from(&inverse_left_jacobian(&omega));
    by_step.fixed_view_mut::<3, 3>(3, 0).copy_from(&(-so3::skew(&translation)));
    by_step.fixed_view_mut::<3, 1>(3, 6).copy_from(&translation);
    by_step * adjoint(&to_from_world)
}

/// `Ad(S)`: `S exp(δ) S⁻¹ = exp(Ad(S) δ)` to first order.
fn adjoint(b_from_a: &Sim3) -> Matrix7 {
    let rotation = b_from_a.rotation.to_rotation_matrix().into_inner();
    let t = b_from_a.translation;
    let mut adjoint = Matrix7::zeros();
    adjoint.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotation);
    adjoint.fixed_view_mut::<3, 3>(3, 0).copy_from(&(so3::skew(&t) * rotation));
    adjoint.fixed_view_mut::<3, 3>(3, 3).copy_from(&(rotation * b_from_a.scale));
    adjoint.fixed_view_mut::<3, 1>(3, 6).copy_from(&(-t));
    adjoint[(6, 6)] = 1.0;
    adjoint
}

/// Inverse of the left Jacobian of SO(3) (Barfoot 2017, eq. 7.76b).
fn inverse_left_jacobian(omega: &Vector3<f64>) -> Matrix3<f64> {
    let angle_squared = omega.norm_squared();
    let skew = so3::skew(omega);
    let square = if angle_squared < 1e-8 {
        1.0 / 12.0 + angle_squared / 720.0
    } else {
        let angle = angle_squared.sqrt();
        (1.0 - 0.5 * angle / (0.5 * angle).tan()) / angle_squared
    };
    Matrix3::identity() - skew * 0.5 + skew * skew * square
}

/// A prior's residual in standard deviations.
pub(super) fn prior_residual(prior: &PositionPrior, world_from_node: &[Sim3]) -> Vector3<f64> {
    let x_in_world = world_from_node[prior.node as usize].transform_point(&prior.x_in_node);
    (x_in_world - prior.x_in_world).component_div(&prior.sigma_m)
}

/// The derivative of [`prior_residual`] in the perturbation of its node.
pub(super) fn prior_jacobian(prior: &PositionPrior, world_from_node: &[Sim3]) -> SMatrix<f64, 3, 7> {
    let x_in_world = world_from_node[prior.node as usize].transform_point(&prior.x_in_node);
    let mut jacobian = SMatrix::<f64, 3, 7>::zeros();
    jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(&(-so3::skew(&x_in_world)));
    jacobian.fixed_view_mut::<3, 3>(0, 3).copy_from(&Matrix3::identity());
    jacobian.fixed_view_mut::<3, 1>(0, 6).copy_from(&x_in_world);
    for axis in 0..3 {
        jacobian.row_mut(axis).unscale_mut(prior.sigma_m[axis]);
    }
    jacobian
}
