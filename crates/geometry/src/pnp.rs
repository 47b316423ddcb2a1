//! The pose of a camera from any number of points and rays, all of them right.
//!
//! As Terzakis & Lourakis (2020, "SQPnP"): the squared distances of points from their rays are quadratic in the translation,
//! which is eliminated, and leave a quadratic form in the nine entries of the rotation. Its eigenvectors of least value give
//! the rotations from which descent starts, so that the least minimum is found, not just a near one. The descent is
//! Levenberg–Marquardt's over rotations; three points, at which the form says little, give starts by P3P.

use nalgebra::{Matrix3, Rotation3, SMatrix, SVector, UnitQuaternion, Vector3};
use smallvec::SmallVec;

use crate::linear::{proper_svd3, symmetric_eigen};
use crate::p3p::p3p;
use crate::small_lm::{self, LeastSquares, LmOptions, NormalEquations};
use crate::{Rigid3, so3};

/// The pose of least squared distance between points and the lines of their unit rays, least first; other minima follow when
/// their cost is no more than rounding apart. Empty when no pose has a point on average ahead.
///
/// Distances are in the points' unit, so that far points weigh more than by reprojection errors: follow up with
/// [`crate::absolute_pose::refine_absolute_pose`]. Empty, too, for fewer than three points, lengths that differ, points on
/// one line, rays through one point of the image, or values that are not finite. Three points give all solutions of [`p3p`].
pub fn pnp(rays: &[Vector3<f64>], x_in_world: &[Vector3<f64>]) -> SmallVec<[Rigid3; 4]> {
    if rays.len() != x_in_world.len() || rays.len() < 3 {
        return SmallVec::new();
    }
    if let ([a, b, c], [x, y, z]) = (rays, x_in_world) {
        return p3p(&[*a, *b, *c], &[*x, *y, *z]);
    }
    let Some(form) = Form::new(rays, x_in_world) else { return SmallVec::new() };
    let mut found = SmallVec::<[(f64, UnitQuaternion<f64>); 8]>::new();
    let mut least = f64::INFINITY;
    let near = form.starts().into_iter().chain(triple_starts(rays, x_in_world));
    for start in near {
        let (rotation, report) = small_lm::minimize(&form, start, &LM);
        let cost = report.final_cost;
        let new = found.iter().all(|(_, other)| rotation.angle_to(other) > 1e-5);
        if new && cost.is_finite() && form.is_ahead(&rotation) {
            least = least.min(cost);
            found.push((cost, rotation));
        }
    }
    found.retain(|(cost, _)| *cost <= least * 1.0001 + 1e-20 * rays.len() as f64);
    found.sort_by(|a, b| a.0.total_cmp(&b.0));
    found.iter().take(4).map(|(_, rotation)| form.pose(rotation)).collect()
}

const LM: LmOptions = LmOptions {
    max_iterations: 20,
    gradient_tolerance: 1e-15,
    step_tolerance: 1e-9,
    cost_tolerance: 1e-9,
    initial_damping: 1e-4,
};

/// Starts for few points, or those on a plane, where several eigenvalues vanish: the poses of two triples.
fn triple_starts(rays: &[Vector3<f64>], x: &[Vector3<f64>]) -> SmallVec<[UnitQuaternion<f64>; 8]> {
    const FEW: usize = 6;
    let count = rays.len();
    if count > FEW {
        return SmallVec::new();
    }
    let triples = [[0, 1, 2], [count - 1, count - 2, 0]];
    let poses = triples.iter().flat_map(|triple| p3p(&triple.map(|i| rays[i]), &triple.map(|i| x[i])));
    poses.map(|pose| pose.rotation).collect()
}

/// The sum of squared distances as a form in the rotation's entries, row by row: half of `|roots r|²`.
struct Form {
    /// Rows are eigenvectors times the root of their eigenvalue, least first.
    roots: SMatrix<f64, 9, 9>,
    vectors: SMatrix<f64, 9, 9>,
    /// How many eigenvalues vanish.
    nullity: usize,
    /// The best translation, of scaled points, is this times the rotation's entries.
    translation: SMatrix<f64, 3, 9>,
    mean: Vector3<f64>,
    spread: f64,
    /// Sums of rays and of rays times points, for the side on which the points lie.
    ray_sum: Vector3<f64>,
    ray_point_sum: Matrix3<f64>,
}

impl Form {
    fn new(rays: &[Vector3<f64>], x_in_world: &[Vector3<f64>]) -> Option<Self> {
        let count = rays.len() as f64;
        let mean = x_in_world.iter().sum::<Vector3<f64>>() / count;
        let spread = (x_in_world.iter().map(|x| (x - mean).norm_squared()).sum::<f64>() / count).sqrt();
        if !(spread > 0.0 && spread.is_finite()) {
            return None;
        }
        let (mut q_sum, mut q_points) = (Matrix3::zeros(), SMatrix::<f64, 3, 9>::zeros());
        let mut form = SMatrix::<f64, 9, 9>::zeros();
        let (mut ray_sum, mut ray_point_sum) = (Vector3::zeros(), Matrix3::zeros());
        let mut scatter = Matrix3::zeros();
        for (ray, x) in rays.iter().zip(x_in_world) {
            let x = (x - mean) / spread;
            let q = Matrix3::identity() - ray * ray.transpose();
            let outer = x * x.transpose();
            q_sum += q;
            scatter += outer;
            ray_sum += ray;
            ray_point_sum += ray * x.transpose();
            for i in 0..3 {
                for j in 0..3 {
                    let mut block = form.fixed_view_mut::<3, 3>(3 * i, 3 * j);
                    block += outer * q[(i, j)];
                    let mut row = q_points.fixed_view_mut::<1, 3>(i, 3 * j);
                    row += x.transpose() * q[(i, j)];
                }
            }
        }
        let (spreads, _) = symmetric_eigen(scatter);
        let (bends, _) = symmetric_eigen(q_sum);
        // Points on a line turn about it freely; rays that are all one don't tell the distance.
        if !(spreads[1] > 1e-14 * spreads[2] && bends[0] > 1e-14 * bends[2] && bends[2].is_finite()) {
            return None;
        }
        let translation = -(q_sum.try_inverse()? * q_points);
        form += q_points.transpose() * translation;
        let (values, vectors) = symmetric_eigen(0.5 * (form + form.transpose()));
        if !values.iter().all(|value| value.is_finite()) {
            return None;
        }
        let roots = SMatrix::from_fn(|i, j| values[i].max(0.0).sqrt() * vectors[(j, i)]);
        let nullity = values.iter().filter(|value| **value < 1e-9 * values[8]).count().max(1);
        Some(Self { roots, vectors, nullity, translation, mean, spread, ray_sum, ray_point_sum })
    }

    /// Rotations near the eigenvectors that may hold the minimum, of both signs.
    fn starts(&self) -> SmallVec<[UnitQuaternion<f64>; 16]> {
        let mut starts = SmallVec::new();
        // Two more than vanish: noise lifts them.
        for k in 0..(self.nullity + 2).min(9) {
            let vector: [f64; 9] = std::array::from_fn(|i| self.vectors[(i, k)]);
            let matrix = Matrix3::from_row_slice(&vector);
            for sign in [1.0, -1.0] {
                let Some((u, _, v)) = proper_svd3(&(matrix * sign)) else { continue };
                let rotation = Rotation3::from_matrix_unchecked(u * v.transpose());
                starts.push(UnitQuaternion::from_rotation_matrix(&rotation));
            }
        }
        starts
    }

    fn shift(&self, rotation: &UnitQuaternion<f64>) -> Vector3<f64> {
        self.translation * entries(&rotation.to_rotation_matrix().into_inner())
    }

    /// Whether the points lie ahead on average: lines don't know which end the camera looks along.
    fn is_ahead(&self, rotation: &UnitQuaternion<f64>) -> bool {
        let matrix = rotation.to_rotation_matrix().into_inner();
        let along = matrix.component_mul(&self.ray_point_sum).sum() + self.ray_sum.dot(&self.shift(rotation));
        along > 0.0
    }

    fn pose(&self, rotation: &UnitQuaternion<f64>) -> Rigid3 {
        Rigid3::new(*rotation, self.shift(rotation) * self.spread - rotation * self.mean)
    }
}

/// The entries of a matrix, row by row.
fn entries(m: &Matrix3<f64>) -> SVector<f64, 9> {
    SVector::from_fn(|i, _| m[(i / 3, i % 3)])
}

impl LeastSquares<3> for Form {
    type State = UnitQuaternion<f64>;

    fn cost(&self, rotation: &UnitQuaternion<f64>) -> f64 {
        0.5 * (self.roots * entries(&rotation.to_rotation_matrix().into_inner())).norm_squared()
    }

    fn linearize(&self, rotation: &UnitQuaternion<f64>, into: &mut NormalEquations<3>) {
        let matrix = rotation.to_rotation_matrix().into_inner();
        let residual = self.roots * entries(&matrix);
        let turned = [Vector3::x(), Vector3::y(), Vector3::z()]
            .map(|axis| self.roots * entries(&(so3::skew(&axis) * matrix)));
        for k in 0..9 {
            into.add(1.0, residual[k], &turned.map(|column| column[k]));
        }
    }

    fn retract(&self, rotation: &UnitQuaternion<f64>, step: &Vector3<f64>) -> UnitQuaternion<f64> {
        let mut next = so3::exp(step) * rotation;
        next.renormalize();
        next
    }
}

#[cfg(test)]
mod tests;
