//! Random rotations, points and scenes for the tests of this crate, each stream from its own name.

use nalgebra::{Quaternion, UnitQuaternion, Vector2, Vector3};
use rand::Rng;
use rand_pcg::Pcg64Mcg;

use crate::{Camera, CameraModel, Rigid3, Seed};

/// A named stream of random values.
pub(crate) struct Random(Pcg64Mcg);

impl Random {
    pub(crate) fn new(name: &str) -> Self {
        Self(Seed(20).derive(name).rng())
    }

    pub(crate) fn unit(&mut self) -> f64 {
        (self.0.next_u64() >> 11) as f64 / (1u64 << 53) as f64
    }

    pub(crate) fn uniform(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    pub(crate) fn gaussian(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.unit()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.unit()).cos()
    }

    pub(crate) fn gaussian2(&mut self, sigma: f64) -> Vector2<f64> {
        Vector2::new(self.gaussian(), self.gaussian()) * sigma
    }

    pub(crate) fn gaussian3(&mut self, sigma: f64) -> Vector3<f64> {
        Vector3::new(self.gaussian(), self.gaussian(), self.gaussian()) * sigma
    }

    pub(crate) fn direction(&mut self) -> Vector3<f64> {
        self.gaussian3(1.0).normalize()
    }

    pub(crate) fn rotation(&mut self) -> UnitQuaternion<f64> {
        let [w, i, j, k] = [0; 4].map(|_| self.gaussian());
        UnitQuaternion::from_quaternion(Quaternion::new(w, i, j, k))
    }

    pub(crate) fn small_rotation(&mut self, max_angle_rad: f64) -> UnitQuaternion<f64> {
        let angle = self.uniform(0.0, max_angle_rad);
        UnitQuaternion::from_scaled_axis(self.direction() * angle)
    }

    pub(crate) fn rigid(&mut self) -> Rigid3 {
        Rigid3::new(self.rotation(), self.gaussian3(2.0))
    }
}

/// Two views of random points 4 to 10 units ahead, the second a unit length away and turned by up to 0.5 rad.
pub(crate) struct TwoViews {
    pub(crate) second_from_first: Rigid3,
    pub(crate) x_in_first: Vec<Vector3<f64>>,
    pub(crate) first: Vec<Vector2<f64>>,
    pub(crate) second: Vec<Vector2<f64>>,
}

pub(crate) fn project(x: &Vector3<f64>) -> Vector2<f64> {
    x.xy() / x.z
}

/// Noise is in normalized units; with `planar` all points lie on one slanted plane.
pub(crate) fn two_views(random: &mut Random, count: usize, noise: f64, planar: bool) -> TwoViews {
    let rotation = random.small_rotation(0.5);
    let second_from_first = Rigid3::from_rotation_and_center(rotation, &random.direction());
    let slope = random.gaussian2(0.2);
    let mut views = TwoViews { second_from_first, x_in_first: vec![], first: vec![], second: vec![] };
    while views.first.len() < count {
        let (x, y) = (random.uniform(-0.6, 0.6), random.uniform(-0.6, 0.6));
        let depth = if planar { 6.0 / (1.0 - slope.x * x - slope.y * y) } else { random.uniform(4.0, 10.0) };
        let x_in_first = Vector3::new(x, y, 1.0) * depth;
        let x_in_second = second_from_first.transform_point(&x_in_first);
        if x_in_second.z > 0.5 && depth > 0.5 {
            views.x_in_first.push(x_in_first);
            views.first.push(project(&x_in_first) + random.gaussian2(noise));
            views.second.push(project(&x_in_second) + random.gaussian2(noise));
        }
    }
    views
}

/// A camera with two radial coefficients, 1600×1200, as a drone's.
pub(crate) fn radial_camera() -> Camera {
    Camera::new(CameraModel::Radial, 1600, 1200, &[1300.0, 805.0, 590.0, -0.08, 0.02]).unwrap()
}

/// World points, their pixels and the pose that took them.
pub(crate) struct Resection {
    pub(crate) cam_from_world: Rigid3,
    pub(crate) x_in_world: Vec<Vector3<f64>>,
    pub(crate) xy_px: Vec<Vector2<f64>>,
}

/// Random points in front of a camera of random pose, with noise in pixels.
pub(crate) fn resection(random: &mut Random, camera: &Camera, count: usize, noise_px: f64) -> Resection {
    let cam_from_world = random.rigid();
    let world_from_cam = cam_from_world.inverse();
    let mut scene = Resection { cam_from_world, x_in_world: vec![], xy_px: vec![] };
    for _ in 0..count {
        let pixel = Vector2::new(
            random.uniform(0.0, f64::from(camera.width_px)),
            random.uniform(0.0, f64::from(camera.height_px)),
        );
        let ray = camera.unproject(&pixel).unwrap().push(1.0);
        scene.x_in_world.push(world_from_cam.transform_point(&(ray * random.uniform(3.0, 12.0))));
        scene.xy_px.push(pixel + random.gaussian2(noise_px));
    }
    scene
}
