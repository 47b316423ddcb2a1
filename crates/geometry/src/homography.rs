//! Homographies: from four correspondences, by least squares, refined, and taken apart into rotation, translation and plane.

use nalgebra::{Matrix3, SMatrix, SVector, Vector2, Vector3};
use smallvec::SmallVec;

use crate::Rigid3;
use crate::epipolar::{Normalized, geman_mcclure};
use crate::linear::symmetric_eigen;
use crate::small_lm::{LeastSquares, NormalEquations};

/// Three points whose triangle has twice this area or less, for points of size one, count as collinear.
const MIN_DOUBLE_AREA: f64 = 1e-7;

/// The homography (Frobenius norm one, positive on the points) that takes four points to four others exactly, by projective
/// bases. Give points of size about one.
///
/// `None` when three points on either side are collinear, when the points can't lie on a plane ahead of both cameras (the
/// quadrangle would turn over), or values are not finite.
pub fn homography_from_four(first: &[Vector2<f64>; 4], second: &[Vector2<f64>; 4]) -> Option<Matrix3<f64>> {
    let (from, from_weights) = basis(first)?;
    let (to, to_weights) = basis(second)?;
    let gains = to_weights.component_div(&from_weights);
    // All on the same side of the plane that is mapped to infinity. The fourth point has gain one.
    if !(gains.min() > 0.0) {
        return None;
    }
    let h = (to * Matrix3::from_diagonal(&gains) * from.try_inverse()?).normalize();
    h.iter().all(|value| value.is_finite()).then_some(h)
}

/// Three points as columns, and how much of each makes the fourth.
fn basis(points: &[Vector2<f64>; 4]) -> Option<(Matrix3<f64>, Vector3<f64>)> {
    let p = points.map(|point| point.push(1.0));
    let area = |a: usize, b: usize, c: usize| p[a].dot(&p[b].cross(&p[c]));
    let whole = area(0, 1, 2);
    let parts = Vector3::new(area(3, 1, 2), area(0, 3, 2), area(0, 1, 3));
    let smallest = parts.abs().min().min(whole.abs());
    (smallest > MIN_DOUBLE_AREA).then(|| (Matrix3::from_columns(&[p[0], p[1], p[2]]), parts / whole))
}

/// The homography (Frobenius norm one) that fits four or more correspondences linearly (DLT, Hartley & Zisserman 2004,
/// algorithm 4.2), in the points' own unit.
///
/// `None` for fewer than four points, dependent points, lengths that differ, non-finite values.
pub fn homography_from_points(first: &[Vector2<f64>], second: &[Vector2<f64>]) -> Option<Matrix3<f64>> {
    if first.len() < 4 {
        return None;
    }
    let normalized = Normalized::new(first, second)?;
    let mut sums = SMatrix::<f64, 9, 9>::zeros();
    for (a, b) in normalized.first.iter().zip(&normalized.second) {
        let row_x = SVector::<f64, 9>::from([a.x, a.y, 1.0, 0.0, 0.0, 0.0, -b.x * a.x, -b.x * a.y, -b.x]);
        let row_y = SVector::<f64, 9>::from([0.0, 0.0, 0.0, a.x, a.y, 1.0, -b.y * a.x, -b.y * a.y, -b.y]);
        sums += row_x * row_x.transpose() + row_y * row_y.transpose();
    }
    let (values, vectors) = symmetric_eigen(sums);
    if !(values[1] > 1e-12 * values[8]) || !values[8].is_finite() {
        return None;
    }
    let h = Matrix3::from_row_iterator(vectors.column(0).iter().copied());
    let h = (normalized.second_inverse() * h * normalized.first_transform()).normalize();
    h.iter().all(|value| value.is_finite()).then_some(h)
}

/// Squared distance in the second image between a point and the transfer of its partner; infinite beyond the horizon, for
/// a homography that is positive on its points.
#[inline]
pub fn squared_transfer_error(h: &Matrix3<f64>, first: &Vector2<f64>, second: &Vector2<f64>) -> f64 {
    let w = h.m31 * first.x + h.m32 * first.y + h.m33;
    if !(w > 0.0) {
        return f64::INFINITY;
    }
    let inverse = 1.0 / w;
    let x = (h.m11 * first.x + h.m12 * first.y + h.m13) * inverse - second.x;
    let y = (h.m21 * first.x + h.m22 * first.y + h.m23) * inverse - second.y;
    x * x + y * y
}

/// Transfer errors over a homography, its largest entry held.
pub(crate) struct TransferProblem<'a> {
    pub(crate) first: &'a [Vector2<f64>],
    pub(crate) second: &'a [Vector2<f64>],
    pub(crate) indices: &'a [u32],
    pub(crate) loss_scale: f64,
    /// Column-major index of the entry that is held.
    pub(crate) held: usize,
}

impl LeastSquares<8> for TransferProblem<'_> {
    type State = Matrix3<f64>;

    fn cost(&self, h: &Matrix3<f64>) -> f64 {
        let of_datum = |&i: &u32| {
            geman_mcclure(
                squared_transfer_error(h, &self.first[i as usize], &self.second[i as usize]),
                self.loss_scale,
            )
            .0
        };
        self.indices.iter().map(of_datum).sum()
    }

    fn linearize(&self, h: &Matrix3<f64>, into: &mut NormalEquations<8>) {
        for &i in self.indices {
            let first = self.first[i as usize].push(1.0);
            let mapped = h * first;
            let inverse = 1.0 / mapped.z;
            let transferred = mapped.xy() * inverse;
            let residual = transferred - self.second[i as usize];
            let weight = geman_mcclure(residual.norm_squared(), self.loss_scale).1;
            for axis in 0..2 {
                let mut full = [0.0; 9];
                for k in 0..3 {
                    full[3 * k + axis] = first[k] * inverse;
                    full[3 * k + 2] = -first[k] * inverse * transferred[axis];
                }
                let row = std::array::from_fn(|k| full[k + usize::from(k >= self.held)]);
                into.add(weight, residual[axis], &row);
            }
        }
    }

    fn retract(&self, h: &Matrix3<f64>, step: &SVector<f64, 8>) -> Matrix3<f64> {
        let mut moved = *h;
        for k in 0..8 {
            moved[k + usize::from(k >= self.held)] += step[k];
        }
        moved
    }
}

/// A way to explain a homography between calibrated views.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlanePose {
    /// The relative pose; the unit of length is the plane's distance from the first camera.
    pub second_from_first: Rigid3,
    /// The plane's unit normal in the first camera's frame; points on it satisfy `normal · x = 1` in that unit.
    pub normal_in_first: Vector3<f64>,
}

/// The up to four explanations `H ∝ R + t nᵀ` of a homography on the plane z = 1 (Ma, Soatto, Košecká & Sastry 2004,
/// section 5.3.3), in pairs that differ in the signs of t and n.
///
/// Empty for a pure rotation (see [`distance_from_rotation`]), a singular or non-finite matrix. The matrix must be positive
/// on its points.
pub fn decompose_homography(h: &Matrix3<f64>) -> SmallVec<[PlanePose; 4]> {
    let mut poses = SmallVec::new();
    let (values, vectors) = symmetric_eigen(h.transpose() * h);
    let middle = values[1].sqrt();
    if !(middle > 1e-9 * values[2].sqrt() && middle.is_finite()) {
        return poses;
    }
    let h = h * (h.determinant().signum() / middle);
    let (largest, smallest) = (values[2] / values[1], values[0] / values[1]);
    let spread = largest - smallest;
    if !(spread > 1e-10) {
        return poses;
    }
    let [v1, v2, v3] = [2, 1, 0].map(|k| vectors.column(k).into_owned());
    let along = ((1.0 - smallest).max(0.0) / spread).sqrt();
    let across = ((largest - 1.0).max(0.0) / spread).sqrt();
    for sign in [1.0, -1.0] {
        let u = v1 * along + v3 * (sign * across);
        let normal = v2.cross(&u);
        let from = Matrix3::from_columns(&[v2, u, normal]);
        let (hv, hu) = (h * v2, h * u);
        let to = Matrix3::from_columns(&[hv, hu, hv.cross(&hu)]);
        let matrix = to * from.transpose();
        let translation = (h - matrix) * normal;
        let rotation = nalgebra::UnitQuaternion::from_rotation_matrix(
            &nalgebra::Rotation3::from_matrix_unchecked(matrix),
        );
        for side in [1.0, -1.0] {
            let second_from_first = Rigid3::new(rotation, translation * side);
            poses.push(PlanePose { second_from_first, normal_in_first: normal * side });
        }
    }
    poses.retain(|pose| {
        let t = pose.second_from_first.translation;
        t.iter().all(|value| value.is_finite()) && pose.second_from_first.rotation.coords.norm().is_finite()
    });
    poses
}

/// How far a homography on the plane z = 1 is from a pure rotation: the largest over the smallest singular value, less one.
pub fn distance_from_rotation(h: &Matrix3<f64>) -> f64 {
    let (values, _) = symmetric_eigen(h.transpose() * h);
    (values[2] / values[0].max(0.0)).sqrt() - 1.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::small_lm::tests::assert_gradient;
    use crate::test_support::{Random, two_views};

    fn transfer(h: &Matrix3<f64>, x: &Vector2<f64>) -> Vector2<f64> {
        let y = h * x.push(1.0);
        y.xy() / y.z
    }

    fn four(points: &[Vector2<f64>]) -> [Vector2<f64>; 4] {
        [points[0], points[1], points[2], points[3]]
    }

    #[test]
    fn four_points_determine_all_others_of_the_plane() {
        let mut random = Random::new("four points");
        let mut good = 0;
        for _ in 0..1000 {
            let views = two_views(&mut random, 30, 0.0, true);
            let Some(h) = homography_from_four(&four(&views.first), &four(&views.second)) else { continue };
            let dlt = homography_from_points(&views.first, &views.second).unwrap();
            let worst = |h: &Matrix3<f64>| {
                (0..30)
                    .map(|i| squared_transfer_error(h, &views.first[i], &views.second[i]))
                    .fold(0.0, f64::max)
            };
            good += usize::from(worst(&h) < 1e-14 && worst(&(dlt * dlt.m33.signum())) < 1e-18);
        }
        assert!(good >= 990, "{good}");
    }

    #[test]
    fn gradient_matches_differences() {
        let mut random = Random::new("transfer");
        let views = two_views(&mut random, 30, 0.01, true);
        let indices: Vec<u32> = (0..30).collect();
        let h = homography_from_points(&views.first, &views.second).unwrap();
        let h = h * h.m33.signum() + Matrix3::repeat(1e-3);
        let (first, second) = (&views.first, &views.second);
        let problem = TransferProblem { first, second, indices: &indices, loss_scale: 0.05, held: 8 };
        assert_gradient(&problem, &h, 1e-4);
    }

    #[test]
    fn decomposition_holds_the_truth_and_rebuilds_the_matrix() {
        let mut random = Random::new("decompose");
        for _ in 0..500 {
            let rotation = random.small_rotation(0.8);
            let t = random.direction() * random.uniform(0.05, 0.5);
            let normal = (Vector3::z() + random.gaussian3(0.2)).normalize();
            let h = (rotation.to_rotation_matrix().into_inner() + t * normal.transpose())
                * random.uniform(0.2, 4.0);
            let poses = decompose_homography(&h);
            assert_eq!(poses.len(), 4);
            let mut nearest = f64::INFINITY;
            for pose in &poses {
                let rebuilt = pose.second_from_first.rotation_matrix()
                    + pose.second_from_first.translation * pose.normal_in_first.transpose();
                assert!((rebuilt.normalize() - h.normalize()).norm() < 1e-7);
                let off = (pose.second_from_first.translation - t).norm()
                    + pose.second_from_first.rotation.angle_to(&rotation);
                nearest = nearest.min(off);
            }
            assert!(nearest < 1e-6, "{nearest}");
        }
    }

    #[test]
    fn rotations_have_no_baseline() {
        let mut random = Random::new("pure rotation");
        let rotation = random.small_rotation(0.5).to_rotation_matrix().into_inner() * 3.0;
        assert!(decompose_homography(&rotation).is_empty());
        assert!(distance_from_rotation(&rotation) < 1e-9);
        let moved = rotation + Vector3::x() * Vector3::z().transpose();
        assert!(distance_from_rotation(&moved) > 0.1);
    }

    #[test]
    fn degenerate_input_gives_none() {
        let square = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)].map(|(x, y)| Vector2::new(x, y));
        let line = [0.0, 1.0, 2.0, 3.0].map(|x| Vector2::new(x, x));
        let three_on_line = [square[0], square[1], Vector2::new(2.0, 0.0), square[3]];
        let crossed = [square[0], square[2], square[1], square[3]];
        let nan = [Vector2::repeat(f64::NAN); 4];
        for bad in [line, three_on_line, [square[0]; 4], nan, crossed] {
            assert!(homography_from_four(&square, &bad).is_none(), "{bad:?}");
            assert!(homography_from_four(&bad, &square).is_none(), "{bad:?}");
        }
        assert!(homography_from_points(&square[..3], &square[..3]).is_none());
        assert!(homography_from_points(&line, &square).is_none());
        assert!(homography_from_points(&nan, &square).is_none());
        assert!(homography_from_points(&square, &square[..3]).is_none());
        assert!(decompose_homography(&Matrix3::repeat(f64::NAN)).is_empty());
        assert!(decompose_homography(&Matrix3::zeros()).is_empty());
        let identity = homography_from_four(&square, &square).unwrap();
        assert!((transfer(&identity, &Vector2::new(0.3, 0.4)) - Vector2::new(0.3, 0.4)).norm() < 1e-12);
    }
}
