//! The pose of a camera that knows which way is down, from two points and the rays that see them.
//!
//! With gravity known only the heading is left of the rotation (Kukelova, Bujnak & Pajdla 2010). Depths are found before the
//! heading: the points' difference in height is linear in them, their horizontal distance quadratic.

use nalgebra::{Rotation3, UnitQuaternion, Vector3};
use smallvec::SmallVec;

use crate::Rigid3;
use crate::linear::tangent_basis;

/// Every `cam_from_world` (at most two) under which the unit `rays` in the camera's frame see the points, with the
/// direction `down_in_world` of the world at `down_in_cam` in the camera's frame, both of any length above zero.
///
/// None when the points or rays are coincident, the points lie on one vertical line, both rays are level, or a value is
/// not finite.
pub fn p2p_upright(
    rays: &[Vector3<f64>; 2],
    x_in_world: &[Vector3<f64>; 2],
    down_in_cam: &Vector3<f64>,
    down_in_world: &Vector3<f64>,
) -> SmallVec<[Rigid3; 2]> {
    let mut poses = SmallVec::new();
    let (Some(level_from_cam), Some(level_from_world)) = (level(down_in_cam), level(down_in_world)) else {
        return poses;
    };
    let y = rays.map(|ray| level_from_cam * ray);
    let x = x_in_world.map(|x| level_from_world * x);
    let between = x[1] - x[0];
    let horizontal = between.xy();
    // The heading needs a horizontal distance to be seen in.
    if !(horizontal.norm() > 1e-9 * between.norm() && y[0].cross(&y[1]).norm() > 1e-9) {
        return poses;
    }
    for [near, far] in depths(&y, &between) {
        let seen = (y[1] * far - y[0] * near).xy();
        let heading_sine = horizontal.x * seen.y - horizontal.y * seen.x;
        let heading_cosine = horizontal.dot(&seen);
        let Some(heading) = about_down(heading_cosine, heading_sine) else { continue };
        let rotation = level_from_cam.inverse() * heading * level_from_world;
        let seen_mean = (rays[0] * near + rays[1] * far) / 2.0;
        let pose = Rigid3::new(rotation, seen_mean - rotation * ((x_in_world[0] + x_in_world[1]) / 2.0));
        if pose.translation.iter().all(|value| value.is_finite()) {
            poses.push(pose);
        }
    }
    poses
}

/// The rotation into a frame of which z points down.
fn level(down: &Vector3<f64>) -> Option<UnitQuaternion<f64>> {
    let z = down.try_normalize(0.0).filter(|z| z.iter().all(|value| value.is_finite()))?;
    let (x, _) = tangent_basis(&z);
    let rows = nalgebra::Matrix3::from_rows(&[x.transpose(), z.cross(&x).transpose(), z.transpose()]);
    Some(UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rows)))
}

/// The turn about z with this cosine and sine, up to a common factor.
fn about_down(cosine: f64, sine: f64) -> Option<UnitQuaternion<f64>> {
    let length = cosine.hypot(sine);
    let (c, s) = (cosine / length, sine / length);
    (length > 0.0 && length.is_finite()).then(|| {
        let turn = nalgebra::Matrix3::new(c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0);
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(turn))
    })
}

/// Positive depths along the two rays, given how the points lie to each other, z down.
fn depths(y: &[Vector3<f64>; 2], between: &Vector3<f64>) -> SmallVec<[[f64; 2]; 2]> {
    let mut all = SmallVec::new();
    // Height: far y1.z - near y0.z = between.z, a line in the plane of (near, far).
    let (a, b) = (-y[0].z, y[1].z);
    let squared = a * a + b * b;
    if !(squared > 1e-18) {
        return all;
    }
    let foot = [between.z * a / squared, between.z * b / squared];
    let length = squared.sqrt();
    let along = [-b / length, a / length];
    // Along it the horizontal distance is |p + s q|.
    let p = y[1].xy() * foot[1] - y[0].xy() * foot[0];
    let q = y[1].xy() * along[1] - y[0].xy() * along[0];
    let (qq, pq) = (q.norm_squared(), p.dot(&q));
    let excess = p.norm_squared() - between.xy().norm_squared();
    let discriminant = pq * pq - qq * excess;
    let scale = pq * pq + (qq * excess).abs();
    // A little below zero it is a double root that rounding parted.
    if !(qq > 0.0 && discriminant >= -1e-14 * scale) {
        return all;
    }
    let root = discriminant.max(0.0).sqrt();
    let larger = -(pq + root.copysign(pq));
    let mut offsets = SmallVec::<[f64; 2]>::from_slice(&[larger / qq]);
    if root > 0.0 {
        offsets.push(if larger == 0.0 { root / qq } else { excess / larger });
    }
    for s in offsets {
        let pair = [foot[0] + s * along[0], foot[1] + s * along[1]];
        if pair.iter().all(|depth| *depth > 0.0 && depth.is_finite()) {
            all.push(pair);
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::Random;

    struct Case {
        truth: Rigid3,
        rays: [Vector3<f64>; 2],
        x_in_world: [Vector3<f64>; 2],
        down_in_cam: Vector3<f64>,
        down_in_world: Vector3<f64>,
    }

    impl Case {
        fn new(random: &mut Random) -> Self {
            let truth = random.rigid();
            let down_in_world = random.direction() * random.uniform(0.1, 10.0);
            let in_cam = [0; 2].map(|_| Vector3::new(0.0, 0.0, 6.0) + random.gaussian3(1.0));
            Self {
                truth,
                rays: in_cam.map(|x| x.normalize()),
                x_in_world: in_cam.map(|x| truth.inverse().transform_point(&x)),
                down_in_cam: truth.rotation * down_in_world,
                down_in_world,
            }
        }

        fn solve(&self) -> SmallVec<[Rigid3; 2]> {
            p2p_upright(&self.rays, &self.x_in_world, &self.down_in_cam, &self.down_in_world)
        }

        fn error(&self) -> f64 {
            self.solve().iter().map(|pose| pose.local_left(&self.truth).norm()).fold(f64::INFINITY, f64::min)
        }
    }

    #[test]
    fn truth_is_among_the_poses() {
        let mut random = Random::new("p2p");
        let (mut good, mut count) = (0, 0);
        for _ in 0..20_000 {
            let case = Case::new(&mut random);
            let poses = case.solve();
            good += usize::from(case.error() < 1e-6);
            count += poses.len();
            for pose in &poses {
                let tilt = (pose.rotation * case.down_in_world - case.down_in_cam).norm();
                assert!(tilt < 1e-10 * case.down_in_world.norm());
                for (ray, x) in case.rays.iter().zip(&case.x_in_world) {
                    assert!(pose.transform_point(x).normalize().dot(ray) > 1.0 - 1e-9);
                }
            }
        }
        assert!(good >= 19_980, "{good}");
        assert!(count > 20_000 && count <= 40_000, "{count}");
    }

    #[test]
    fn the_error_grows_with_that_of_gravity() {
        let mut random = Random::new("p2p gravity");
        let median = |random: &mut Random, angle_rad: f64| {
            let mut errors: Vec<f64> = (0..2001)
                .map(|_| {
                    let mut case = Case::new(random);
                    let axis = case.down_in_cam.cross(&random.direction()).normalize();
                    case.down_in_cam = crate::so3::exp(&(axis * angle_rad)) * case.down_in_cam;
                    case.error()
                })
                .collect();
            errors.sort_by(f64::total_cmp);
            errors[1000]
        };
        let (small, large) = (median(&mut random, 1e-4), median(&mut random, 1e-3));
        assert!(small > 1e-5 && small < 1e-2, "{small}");
        assert!(large > 5.0 * small && large < 20.0 * small, "{small} {large}");
    }

    #[test]
    fn degenerate_input_gives_none() {
        let mut random = Random::new("p2p degenerate");
        let case = Case::new(&mut random);
        let (rays, x, cam, world) = (&case.rays, &case.x_in_world, &case.down_in_cam, &case.down_in_world);
        assert!(!case.solve().is_empty());
        assert!(p2p_upright(rays, &[x[0]; 2], cam, world).is_empty());
        assert!(p2p_upright(rays, &[x[0], x[0] + world], cam, world).is_empty());
        assert!(p2p_upright(&[rays[0]; 2], x, cam, world).is_empty());
        assert!(p2p_upright(rays, x, &Vector3::zeros(), world).is_empty());
        assert!(p2p_upright(rays, x, cam, &Vector3::repeat(f64::NAN)).is_empty());
        assert!(p2p_upright(&[Vector3::repeat(f64::NAN); 2], x, cam, world).is_empty());
        assert!(p2p_upright(rays, &[x[0], Vector3::repeat(f64::INFINITY)], cam, world).is_empty());
        let level = [Vector3::x(), Vector3::y()];
        assert!(p2p_upright(&level, x, &Vector3::z(), world).is_empty());
    }
}
