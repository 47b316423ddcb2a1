//! What essential and fundamental matrices share: Sampson's error, its refinement, and normalisation of points.

use nalgebra::{Matrix3, Quaternion, SVector, UnitQuaternion, Vector2, Vector3};

use crate::linear::{proper_svd3, tangent_basis};
use crate::small_lm::{LeastSquares, NormalEquations};
use crate::{Rigid3, so3};

/// Squared Sampson error (Sampson 1982) of a correspondence under `second ᵀ M first = 0`, in the points' squared unit.
///
/// To first order the squared distance by which both points must move together to agree.
#[inline]
pub fn squared_sampson_error(m: &Matrix3<f64>, first: &Vector2<f64>, second: &Vector2<f64>) -> f64 {
    let a0 = m.m11 * first.x + m.m12 * first.y + m.m13;
    let a1 = m.m21 * first.x + m.m22 * first.y + m.m23;
    let a2 = m.m31 * first.x + m.m32 * first.y + m.m33;
    let b0 = m.m11 * second.x + m.m21 * second.y + m.m31;
    let b1 = m.m12 * second.x + m.m22 * second.y + m.m32;
    let c = second.x * a0 + second.y * a1 + a2;
    c * c / (a0 * a0 + a1 * a1 + b0 * b0 + b1 * b1)
}

/// Points moved to their mean and scaled; `normalized = scale * (point - mean)`.
pub(crate) struct Normalized {
    pub(crate) first: Vec<Vector2<f64>>,
    pub(crate) second: Vec<Vector2<f64>>,
    pub(crate) scale: f64,
    first_mean: Vector2<f64>,
    second_mean: Vector2<f64>,
}

impl Normalized {
    /// As Hartley (1997), but with one scale for both sides, so that errors scale alike everywhere.
    ///
    /// `None` when lengths differ, there are no points, or nothing but one finite point.
    pub(crate) fn new(first: &[Vector2<f64>], second: &[Vector2<f64>]) -> Option<Self> {
        let finite = |p: &Vector2<f64>| p.x.is_finite() && p.y.is_finite();
        let all: Vec<usize> =
            (0..first.len().min(second.len())).filter(|&i| finite(&first[i]) && finite(&second[i])).collect();
        if first.len() != second.len() || all.is_empty() {
            return None;
        }
        let count = all.len() as f64;
        let first_mean = all.iter().map(|&i| first[i]).sum::<Vector2<f64>>() / count;
        let second_mean = all.iter().map(|&i| second[i]).sum::<Vector2<f64>>() / count;
        let spread: f64 =
            all.iter().map(|&i| (first[i] - first_mean).norm() + (second[i] - second_mean).norm()).sum();
        let scale = 2.0 * std::f64::consts::SQRT_2 * count / spread;
        if !(scale.is_finite() && scale > 0.0) {
            return None;
        }
        let move_all = |points: &[Vector2<f64>], mean: Vector2<f64>| {
            points.iter().map(|point| (point - mean) * scale).collect::<Vec<_>>()
        };
        let (moved_first, moved_second) = (move_all(first, first_mean), move_all(second, second_mean));
        Some(Self { first: moved_first, second: moved_second, scale, first_mean, second_mean })
    }

    pub(crate) fn first_transform(&self) -> Matrix3<f64> {
        transform(self.scale, &self.first_mean)
    }

    pub(crate) fn second_transform(&self) -> Matrix3<f64> {
        transform(self.scale, &self.second_mean)
    }

    /// The first side's transform backwards.
    pub(crate) fn first_inverse(&self) -> Matrix3<f64> {
        inverse_transform(self.scale, &self.first_mean)
    }

    /// The second side's transform backwards.
    pub(crate) fn second_inverse(&self) -> Matrix3<f64> {
        inverse_transform(self.scale, &self.second_mean)
    }
}

fn inverse_transform(scale: f64, mean: &Vector2<f64>) -> Matrix3<f64> {
    Matrix3::new(1.0 / scale, 0.0, mean.x, 0.0, 1.0 / scale, mean.y, 0.0, 0.0, 1.0)
}

fn transform(scale: f64, mean: &Vector2<f64>) -> Matrix3<f64> {
    Matrix3::new(scale, 0.0, -scale * mean.x, 0.0, scale, -scale * mean.y, 0.0, 0.0, 1.0)
}

/// The loss `r² / (1 + r²/c²) / 2` (Geman & McClure 1987) of a squared residual, as (cost, weight of the residual).
///
/// Like the truncated error by which models are compared it levels off, so that outliers within the threshold pull little; and
/// it takes no logarithm, whose bits would depend on the processor.
#[inline]
pub(crate) fn geman_mcclure(squared: f64, scale: f64) -> (f64, f64) {
    let inverse = 1.0 / (1.0 + squared / (scale * scale));
    (0.5 * squared * inverse, inverse * inverse)
}

/// The rotation `exp(ω)` to first order, exactly a rotation (Cayley 1846): for steps, without sine and cosine.
fn small_turn(omega: &Vector3<f64>) -> UnitQuaternion<f64> {
    UnitQuaternion::from_quaternion(Quaternion::from_parts(1.0, omega * 0.5))
}

/// Correspondences whose Sampson errors are minimised under the loss of Geman and McClure.
pub(crate) struct Correspondences<'a> {
    pub(crate) first: &'a [Vector2<f64>],
    pub(crate) second: &'a [Vector2<f64>],
    pub(crate) indices: &'a [u32],
    pub(crate) loss_scale: f64,
}

impl Correspondences<'_> {
    fn cost_of(&self, m: &Matrix3<f64>) -> f64 {
        let of_datum = |&i: &u32| {
            let squared = squared_sampson_error(m, &self.first[i as usize], &self.second[i as usize]);
            geman_mcclure(squared, self.loss_scale).0
        };
        self.indices.iter().map(of_datum).sum()
    }

    /// Adds every residual, given the derivatives of the matrix in the unknowns.
    fn add_residuals<const N: usize>(
        &self,
        m: &Matrix3<f64>,
        d_m: &[Matrix3<f64>; N],
        into: &mut NormalEquations<N>,
    ) {
        for &i in self.indices {
            let (first, second) = (self.first[i as usize].push(1.0), self.second[i as usize].push(1.0));
            let (a, b) = (m * first, m.tr_mul(&second));
            let squared = a.x * a.x + a.y * a.y + b.x * b.x + b.y * b.y;
            let value = second.dot(&a);
            let inverse = 1.0 / squared.sqrt();
            let residual = value * inverse;
            if !residual.is_finite() {
                continue;
            }
            // dr = (dc - r/n (a·da + b·db)) / n with da = dM first, db = dMᵀ second, dc = second ᵀ dM first:
            // one outer product, as (second - r/n a) firstᵀ - r/n second bᵀ, first two components of a and b only.
            let ratio = residual * inverse;
            let left = second - ratio * Vector3::new(a.x, a.y, 0.0);
            let right = ratio * Vector3::new(b.x, b.y, 0.0);
            let d_residual = (left * first.transpose() - second * right.transpose()) * inverse;
            let row: [f64; N] = std::array::from_fn(|k| d_residual.dot(&d_m[k]));
            into.add(geman_mcclure(residual * residual, self.loss_scale).1, residual, &row);
        }
    }
}

/// `[t]ₓ R` of a relative pose, unit translation assumed.
pub fn essential_from_pose(second_from_first: &Rigid3) -> Matrix3<f64> {
    so3::skew(&second_from_first.translation) * second_from_first.rotation_matrix()
}

/// Sampson errors over a relative pose; unknowns: rotation on the left, translation in its tangent plane.
pub(crate) struct PoseProblem<'a>(pub(crate) Correspondences<'a>);

impl LeastSquares<5> for PoseProblem<'_> {
    type State = Rigid3;

    fn cost(&self, pose: &Rigid3) -> f64 {
        self.0.cost_of(&essential_from_pose(pose))
    }

    fn linearize(&self, pose: &Rigid3, into: &mut NormalEquations<5>) {
        let rotation = pose.rotation_matrix();
        let cross = so3::skew(&pose.translation);
        let (u, v) = tangent_basis(&pose.translation);
        let turned = |axis: Vector3<f64>| cross * so3::skew(&axis) * rotation;
        let d_m = [
            turned(Vector3::x()),
            turned(Vector3::y()),
            turned(Vector3::z()),
            so3::skew(&u) * rotation,
            so3::skew(&v) * rotation,
        ];
        self.0.add_residuals(&essential_from_pose(pose), &d_m, into);
    }

    fn retract(&self, pose: &Rigid3, step: &SVector<f64, 5>) -> Rigid3 {
        let (u, v) = tangent_basis(&pose.translation);
        let mut rotation = small_turn(&step.fixed_rows::<3>(0).into_owned()) * pose.rotation;
        rotation.renormalize();
        Rigid3::new(rotation, (pose.translation + u * step[3] + v * step[4]).normalize())
    }
}

/// A matrix of rank two as `U diag(1, σ, 0) Vᵀ` (Bartoli & Sturm 2004).
#[derive(Clone, Copy, Debug)]
pub(crate) struct RankTwo {
    u: Matrix3<f64>,
    v: Matrix3<f64>,
    sigma: f64,
}

impl RankTwo {
    /// The nearest of rank two, up to scale; `None` when the rank is lower.
    pub(crate) fn nearest(m: &Matrix3<f64>) -> Option<Self> {
        let (u, s, v) = proper_svd3(m)?;
        Some(Self { u, v, sigma: s.y / s.x })
    }

    pub(crate) fn matrix(&self) -> Matrix3<f64> {
        self.u * Matrix3::from_diagonal(&Vector3::new(1.0, self.sigma, 0.0)) * self.v.transpose()
    }
}

/// Sampson errors over a matrix of rank two; unknowns: rotations on the right of U and V, and σ.
pub(crate) struct RankTwoProblem<'a>(pub(crate) Correspondences<'a>);

impl LeastSquares<7> for RankTwoProblem<'_> {
    type State = RankTwo;

    fn cost(&self, state: &RankTwo) -> f64 {
        self.0.cost_of(&state.matrix())
    }

    fn linearize(&self, state: &RankTwo, into: &mut NormalEquations<7>) {
        let RankTwo { u, v, sigma } = state;
        let diagonal = Matrix3::from_diagonal(&Vector3::new(1.0, *sigma, 0.0));
        let axes = [Vector3::x(), Vector3::y(), Vector3::z()].map(|axis| so3::skew(&axis));
        let d_m = [
            u * axes[0] * diagonal * v.transpose(),
            u * axes[1] * diagonal * v.transpose(),
            u * axes[2] * diagonal * v.transpose(),
            u * diagonal * axes[0].transpose() * v.transpose(),
            u * diagonal * axes[1].transpose() * v.transpose(),
            u * diagonal * axes[2].transpose() * v.transpose(),
            u.column(1) * v.column(1).transpose(),
        ];
        self.0.add_residuals(&state.matrix(), &d_m, into);
    }

    fn retract(&self, state: &RankTwo, step: &SVector<f64, 7>) -> RankTwo {
        let turn = |start: usize| {
            let omega = Vector3::new(step[start], step[start + 1], step[start + 2]);
            small_turn(&omega).to_rotation_matrix().into_inner()
        };
        RankTwo { u: state.u * turn(0), v: state.v * turn(3), sigma: state.sigma + step[6] }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::small_lm::tests::assert_gradient;
    use crate::test_support::{Random, two_views};

    #[test]
    fn gradients_match_differences() {
        let mut random = Random::new("sampson");
        for _ in 0..20 {
            let views = two_views(&mut random, 40, 0.01, false);
            let indices: Vec<u32> = (0..40).collect();
            let data = || Correspondences {
                first: &views.first,
                second: &views.second,
                indices: &indices,
                loss_scale: 0.02,
            };
            let turn = random.small_rotation(0.02);
            let near =
                Rigid3::new(turn * views.second_from_first.rotation, views.second_from_first.translation);
            let near = Rigid3::new(near.rotation, near.translation.normalize());
            assert_gradient(&PoseProblem(data()), &near, 1e-4);
            let rank_two = RankTwo::nearest(&essential_from_pose(&near)).unwrap();
            assert_gradient(&RankTwoProblem(data()), &rank_two, 1e-4);
        }
    }

    #[test]
    fn sampson_is_the_distance_for_small_errors() {
        let mut random = Random::new("sampson size");
        let views = two_views(&mut random, 500, 1e-3, false);
        let e = essential_from_pose(&views.second_from_first);
        let sum: f64 = (0..500).map(|i| squared_sampson_error(&e, &views.first[i], &views.second[i])).sum();
        // One constraint per correspondence: one degree of freedom of noise.
        let sigma = (sum / 500.0).sqrt();
        assert!(sigma > 0.9e-3 && sigma < 1.1e-3, "{sigma}");
    }
}
