//! The laws of a manifold as one check, run for every type (after Ceres' manifold tests): at random, at identity, for tiny
//! steps, near half a turn, and for scales from tiny to huge.

use nalgebra::{Matrix3, SMatrix, SVector, UnitQuaternion, Vector3};

use crate::test_support::Random;
use crate::{Rigid3, Sim3, so3};

/// A transform of space with a perturbation on the left of `N` unknowns, rotation first.
trait Manifold<const N: usize>: Copy {
    fn identity() -> Self;
    fn compose(self, b_from_a: Self) -> Self;
    fn inverse(&self) -> Self;
    fn retract(&self, delta: &SVector<f64, N>) -> Self;
    fn local(&self, from: &Self) -> SVector<f64, N>;
    fn apply(&self, x: &Vector3<f64>) -> Vector3<f64>;
    /// The derivative of `apply` in the perturbation at zero, in terms of the result.
    fn jacobian(x_in_b: &Vector3<f64>) -> SMatrix<f64, 3, N>;
}

impl Manifold<3> for UnitQuaternion<f64> {
    fn identity() -> Self {
        UnitQuaternion::identity()
    }
    fn compose(self, b_from_a: Self) -> Self {
        self * b_from_a
    }
    fn inverse(&self) -> Self {
        UnitQuaternion::inverse(self)
    }
    fn retract(&self, delta: &SVector<f64, 3>) -> Self {
        so3::exp(delta) * self
    }
    fn local(&self, from: &Self) -> SVector<f64, 3> {
        so3::log(&(self * from.inverse()))
    }
    fn apply(&self, x: &Vector3<f64>) -> Vector3<f64> {
        self * x
    }
    fn jacobian(x_in_b: &Vector3<f64>) -> Matrix3<f64> {
        -so3::skew(x_in_b)
    }
}

impl Manifold<6> for Rigid3 {
    fn identity() -> Self {
        Rigid3::identity()
    }
    fn compose(self, b_from_a: Self) -> Self {
        self * b_from_a
    }
    fn inverse(&self) -> Self {
        Rigid3::inverse(self)
    }
    fn retract(&self, delta: &SVector<f64, 6>) -> Self {
        self.retract_left(delta)
    }
    fn local(&self, from: &Self) -> SVector<f64, 6> {
        self.local_left(from)
    }
    fn apply(&self, x: &Vector3<f64>) -> Vector3<f64> {
        self.transform_point(x)
    }
    fn jacobian(x_in_b: &Vector3<f64>) -> SMatrix<f64, 3, 6> {
        let mut jacobian = SMatrix::<f64, 3, 6>::zeros();
        jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(&-so3::skew(x_in_b));
        jacobian.fixed_view_mut::<3, 3>(0, 3).copy_from(&Matrix3::identity());
        jacobian
    }
}

impl Manifold<7> for Sim3 {
    fn identity() -> Self {
        Sim3::identity()
    }
    fn compose(self, b_from_a: Self) -> Self {
        self * b_from_a
    }
    fn inverse(&self) -> Self {
        Sim3::inverse(self)
    }
    fn retract(&self, delta: &SVector<f64, 7>) -> Self {
        self.retract_left(delta)
    }
    fn local(&self, from: &Self) -> SVector<f64, 7> {
        self.local_left(from)
    }
    fn apply(&self, x: &Vector3<f64>) -> Vector3<f64> {
        self.transform_point(x)
    }
    fn jacobian(x_in_b: &Vector3<f64>) -> SMatrix<f64, 3, 7> {
        let mut jacobian = SMatrix::<f64, 3, 7>::zeros();
        jacobian.fixed_view_mut::<3, 6>(0, 0).copy_from(&Rigid3::jacobian(x_in_b));
        jacobian.set_column(6, x_in_b);
        jacobian
    }
}

/// Steps of every size, the rotation below half a turn.
fn steps<const N: usize>(random: &mut Random) -> Vec<SVector<f64, N>> {
    let mut steps = vec![SVector::zeros()];
    for angle in [1e-14, 1e-9, 1e-4, 0.3, 2.0, std::f64::consts::PI - 1e-6] {
        let mut step = SVector::<f64, N>::from_fn(|_, _| random.gaussian() * angle.min(1.0));
        let omega = random.direction() * angle;
        (0..3).for_each(|i| step[i] = omega[i]);
        steps.push(step);
    }
    steps
}

fn assert_near<const N: usize>(a: &SVector<f64, N>, b: &SVector<f64, N>, tolerance: f64) {
    assert!((a - b).norm() < tolerance * (1.0 + b.norm()), "{a} {b}");
}

fn check_laws<const N: usize, T: Manifold<N>>(elements: &[T], random: &mut Random) {
    for x in elements {
        let point = random.gaussian3(2.0);
        let size = 1.0 + x.apply(&point).norm();
        let zero = SVector::<f64, N>::zeros();
        assert!((x.retract(&zero).apply(&point) - x.apply(&point)).norm() < 1e-13 * size);
        assert_near(&x.local(x), &zero, 1e-10);
        let back = x.inverse().compose(*x).apply(&point);
        assert!((back - point).norm() < 1e-9 * (1.0 + point.norm()), "{back} {point}");
        assert!((x.compose(T::identity()).apply(&point) - x.apply(&point)).norm() < 1e-13 * size);
        for step in steps(random) {
            let moved = x.retract(&step);
            assert_near(&moved.local(x), &step, 1e-7);
            let again = x.retract(&moved.local(x));
            assert!((again.apply(&point) - moved.apply(&point)).norm() < 1e-7 * size);
        }
        for y in elements {
            let chained = x.compose(*y).apply(&point);
            assert!((chained - x.apply(&y.apply(&point))).norm() < 1e-12 * (1.0 + chained.norm()));
        }
        check_jacobian(x, &point);
    }
}

fn check_jacobian<const N: usize, T: Manifold<N>>(x: &T, point: &Vector3<f64>) {
    let analytic = T::jacobian(&x.apply(point));
    let h = 1e-6;
    for i in 0..N {
        let at = |value: f64| {
            let mut step = SVector::<f64, N>::zeros();
            step[i] = value;
            x.retract(&step).apply(point)
        };
        let numeric = (at(h) - at(-h)) / (2.0 * h);
        let size = 1.0 + x.apply(point).norm();
        assert!((numeric - analytic.column(i)).norm() < 1e-7 * size, "{i} {numeric} {analytic}");
    }
}

/// Identity, quarter and half turns about an axis, and random ones.
fn rotations(random: &mut Random) -> Vec<UnitQuaternion<f64>> {
    let axis = random.direction();
    let mut all = vec![UnitQuaternion::identity()];
    for angle in [1e-12, std::f64::consts::FRAC_PI_2, std::f64::consts::PI - 1e-9, std::f64::consts::PI] {
        all.push(so3::exp(&(axis * angle)));
    }
    all.extend((0..10).map(|_| random.rotation()));
    all
}

#[test]
fn so3_obeys_the_laws() {
    let mut random = Random::new("so3 laws");
    let all = rotations(&mut random);
    check_laws::<3, _>(&all, &mut random);
    for rotation in &all {
        let log = so3::log(rotation);
        assert!(log.norm() <= std::f64::consts::PI + 1e-12);
        assert!(so3::angle_between(&so3::exp(&log), rotation) < 1e-7);
        assert!((so3::angle_between(rotation, &UnitQuaternion::identity()) - log.norm()).abs() < 1e-7);
    }
    let (v, w) = (random.gaussian3(1.0), random.gaussian3(1.0));
    assert!((so3::skew(&v) * w - v.cross(&w)).norm() < 1e-14);
}

#[test]
fn rigid3_obeys_the_laws() {
    let mut random = Random::new("rigid laws");
    let all: Vec<_> =
        rotations(&mut random).into_iter().map(|r| Rigid3::new(r, random.gaussian3(5.0))).collect();
    check_laws::<6, _>(&all, &mut random);
    for pose in &all {
        assert!(pose.transform_point(&pose.center()).norm() < 1e-12);
        let again = Rigid3::from_rotation_and_center(pose.rotation, &pose.center());
        assert!((again.translation - pose.translation).norm() < 1e-12);
        let x = random.gaussian3(3.0);
        assert!((pose.matrix3x4() * x.push(1.0) - pose.transform_point(&x)).norm() < 1e-12);
    }
}

#[test]
fn sim3_obeys_the_laws() {
    let mut random = Random::new("sim laws");
    let scales = [1e-4, 0.1, 1.0, 7.0, 1e3];
    let all: Vec<_> = rotations(&mut random)
        .into_iter()
        .enumerate()
        .map(|(i, rotation)| Sim3::new(scales[i % 5], rotation, random.gaussian3(5.0)))
        .collect();
    check_laws::<7, _>(&all, &mut random);
    for b_from_a in &all {
        // A camera sees the same image of the moved point from its moved place.
        let (cam_from_a, x_in_a) = (random.rigid(), random.gaussian3(3.0));
        let cam_from_b = b_from_a.transform_camera(&cam_from_a);
        let seen = cam_from_b.transform_point(&b_from_a.transform_point(&x_in_a)) / b_from_a.scale;
        assert!((seen - cam_from_a.transform_point(&x_in_a)).norm() < 1e-9);
    }
}

#[test]
fn left_jacobian_inverse_is_the_slope_of_the_logarithm() {
    for length in [0.0, 1e-6, 9e-3, 1.1e-2, 0.5, 2.0, 3.0] {
        let omega = Vector3::new(0.6, -0.48, 0.64) * length;
        let jacobian = so3::left_jacobian_inverse(&omega);
        for axis in 0..3 {
            let step = Vector3::ith(axis, 1e-6);
            let log = |delta: &Vector3<f64>| so3::log(&(so3::exp(delta) * so3::exp(&omega)));
            let slope = (log(&step) - log(&-step)) / 2e-6;
            assert!((slope - jacobian.column(axis)).norm() < 1e-7, "{length} {axis}");
        }
    }
}
