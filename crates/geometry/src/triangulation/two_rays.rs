//! The best point from two views, in closed steps.
//!
//! As Lindstrom (2010): both image points move along the normals of their epipolar lines until they satisfy the epipolar
//! constraint, by the least squared movement after a few rounds. Rays that meet then give the point.

use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};

use crate::Rigid3;
use crate::epipolar::essential_from_pose;

/// The pair of points nearest to a pair on the planes z = 1 that satisfies `second ᵀ E first = 0` exactly.
///
/// `None` when a point is at its epipole, where no direction is better than another, or the pair is too far from any that
/// satisfies the constraint, or values are not finite.
pub fn corrected_pair(
    essential: &Matrix3<f64>,
    first: &Vector2<f64>,
    second: &Vector2<f64>,
) -> Option<(Vector2<f64>, Vector2<f64>)> {
    const ROUNDS: usize = 5;
    let e = essential;
    let block: Matrix2<f64> = e.fixed_view::<2, 2>(0, 0).into_owned();
    let violation = |a: &Vector2<f64>, b: &Vector2<f64>| b.push(1.0).dot(&(e * a.push(1.0)));
    let start = violation(first, second);
    let (mut a, mut b) = (*first, *second);
    for _ in 0..ROUNDS {
        // Normals of the epipolar lines through where the points are now.
        let normal_b: Vector2<f64> = (e * a.push(1.0)).xy();
        let normal_a: Vector2<f64> = (e.transpose() * b.push(1.0)).xy();
        // Steps λ n from the given points: a quadratic in λ, of which the smaller root is wanted.
        let quadratic = normal_b.dot(&(block * normal_a));
        let linear = normal_a.dot(&(e.transpose() * second.push(1.0)).xy())
            + normal_b.dot(&(e * first.push(1.0)).xy());
        let half = 0.5 * linear;
        let discriminant = half * half - quadratic * start;
        let lambda = start / (half + discriminant.sqrt().copysign(half));
        if !lambda.is_finite() {
            return None;
        }
        let next = (first - normal_a * lambda, second - normal_b * lambda);
        let moved = (next.0 - a).norm_squared() + (next.1 - b).norm_squared();
        (a, b) = next;
        if moved < 1e-30 {
            break;
        }
    }
    let finite = a.iter().chain(b.iter()).all(|value| value.is_finite());
    let holds = violation(&a, &b).abs() <= 1e-9 * (start.abs() + e.norm());
    (finite && holds).then_some((a, b))
}

/// The point, in the first camera's frame, that minimises the squared error of both views on their planes z = 1.
///
/// `None` when the rays are parallel, the point is not ahead of both cameras, or for what [`corrected_pair`] refuses.
pub fn triangulate_pair(
    second_from_first: &Rigid3,
    first: &Vector2<f64>,
    second: &Vector2<f64>,
) -> Option<Vector3<f64>> {
    let essential = essential_from_pose(second_from_first);
    let (a, b) = corrected_pair(&essential, first, second)?;
    // `depth_b b = depth_a R a + t`, crossed with b.
    let (turned, b) = (second_from_first.rotation * a.push(1.0), b.push(1.0));
    let normal = b.cross(&turned);
    let from_baseline = second_from_first.translation.cross(&b);
    let squared = normal.norm_squared();
    if !(squared > 1e-24 * turned.norm_squared() * b.norm_squared()) {
        return None;
    }
    let depth = normal.dot(&from_baseline) / squared;
    let x = a.push(1.0) * depth;
    let ahead = depth > 0.0 && second_from_first.transform_point(&x).z > 0.0;
    (ahead && depth.is_finite()).then_some(x)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::small_lm::{self, LeastSquares, LmOptions, NormalEquations};
    use crate::test_support::{Random, project, two_views};

    /// Both image errors over the point.
    struct Brute(Rigid3, [Vector2<f64>; 2]);

    impl LeastSquares<3> for Brute {
        type State = Vector3<f64>;

        fn cost(&self, x: &Vector3<f64>) -> f64 {
            let seen = [project(x), project(&self.0.transform_point(x))];
            0.5 * ((seen[0] - self.1[0]).norm_squared() + (seen[1] - self.1[1]).norm_squared())
        }

        fn linearize(&self, x: &Vector3<f64>, into: &mut NormalEquations<3>) {
            let rotation = self.0.rotation_matrix();
            let views = [(*x, Matrix3::identity()), (self.0.transform_point(x), rotation)];
            for ((seen, turn), xy) in views.iter().zip(&self.1) {
                let residual = project(seen) - xy;
                let d = nalgebra::Matrix2x3::new(1.0, 0.0, -seen.x / seen.z, 0.0, 1.0, -seen.y / seen.z)
                    / seen.z
                    * turn;
                for k in 0..2 {
                    into.add(1.0, residual[k], &[d[(k, 0)], d[(k, 1)], d[(k, 2)]]);
                }
            }
        }

        fn retract(&self, x: &Vector3<f64>, step: &Vector3<f64>) -> Vector3<f64> {
            x + step
        }
    }

    #[test]
    fn exact_pairs_give_the_truth() {
        let mut random = Random::new("pair");
        let mut good = 0;
        for _ in 0..500 {
            let views = two_views(&mut random, 10, 0.0, false);
            for i in 0..10 {
                let found = triangulate_pair(&views.second_from_first, &views.first[i], &views.second[i]);
                good += usize::from(found.is_some_and(|x| (x - views.x_in_first[i]).norm() < 1e-8));
            }
        }
        assert!(good >= 4950, "{good}");
    }

    #[test]
    fn no_search_finds_a_better_point() {
        let mut random = Random::new("pair noise");
        let (mut compared, mut improved) = (0, 0);
        for _ in 0..200 {
            let views = two_views(&mut random, 10, 3e-3, false);
            for i in 0..10 {
                let (first, second) = (views.first[i], views.second[i]);
                let Some(x) = triangulate_pair(&views.second_from_first, &first, &second) else { continue };
                let brute = Brute(views.second_from_first, [first, second]);
                let options = LmOptions { max_iterations: 100, cost_tolerance: 1e-14, ..Default::default() };
                let best = brute.cost(&x);
                for start in [x, views.x_in_first[i]] {
                    let (_, report) = small_lm::minimize(&brute, start, &options);
                    compared += 1;
                    improved += usize::from(report.final_cost < best * (1.0 - 1e-6) - 1e-20);
                }
            }
        }
        assert!(compared > 3000, "{compared}");
        assert!(improved <= compared / 500, "{improved} of {compared}");
    }

    #[test]
    fn degenerate_pairs_give_none() {
        let mut random = Random::new("pair degenerate");
        let views = two_views(&mut random, 1, 0.0, false);
        let (pose, first, second) = (views.second_from_first, views.first[0], views.second[0]);
        assert!(triangulate_pair(&pose, &Vector2::repeat(f64::NAN), &second).is_none());
        assert!(triangulate_pair(&pose, &first, &Vector2::repeat(f64::INFINITY)).is_none());
        let still = Rigid3::new(pose.rotation, Vector3::zeros());
        assert!(triangulate_pair(&still, &first, &second).is_none());
        // Both at the epipole of a camera that moves ahead.
        let ahead = Rigid3::new(Default::default(), Vector3::z());
        assert!(triangulate_pair(&ahead, &Vector2::zeros(), &Vector2::zeros()).is_none());
        // Behind: parallax of the wrong sign.
        let aside = Rigid3::new(Default::default(), -Vector3::x());
        assert!(triangulate_pair(&aside, &Vector2::zeros(), &Vector2::new(0.1, 0.0)).is_none());
        assert!(triangulate_pair(&aside, &Vector2::zeros(), &Vector2::new(-0.1, 0.0)).is_some());
    }
}
