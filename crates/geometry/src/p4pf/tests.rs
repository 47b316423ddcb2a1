//! Poses and focal lengths of random scenes, exact, noisy and degenerate.

use super::*;
use crate::small_lm::tests::assert_gradient;
use crate::test_support::{Random, project};

struct Case {
    truth: PoseAndFocal,
    offset_px: [Vector2<f64>; 4],
    x_in_world: [Vector3<f64>; 4],
}

impl Case {
    /// Points 2 to 8 units ahead within the image; with `plane` on a slanted one.
    fn new(random: &mut Random, plane: bool) -> Self {
        let cam_from_world = random.rigid();
        let focal_px = random.uniform(500.0, 3000.0);
        let offset_px =
            [0; 4].map(|_| Vector2::new(random.uniform(-800.0, 800.0), random.uniform(-600.0, 600.0)));
        let slope = random.gaussian2(0.3);
        let x_in_world = offset_px.map(|offset| {
            let xy = offset / focal_px;
            let depth = if plane { 5.0 / (1.0 - slope.dot(&xy)) } else { random.uniform(2.0, 8.0) };
            cam_from_world.inverse().transform_point(&(xy.push(1.0) * depth))
        });
        Self { truth: PoseAndFocal { cam_from_world, focal_px }, offset_px, x_in_world }
    }

    fn noisy(mut self, random: &mut Random, noise_px: f64) -> Self {
        self.offset_px.iter_mut().for_each(|offset| *offset += random.gaussian2(noise_px));
        self
    }

    fn solve(&self) -> SmallVec<[PoseAndFocal; 8]> {
        p4pf(&self.offset_px, &self.x_in_world)
    }

    /// Of the best solution: the relative error of the focal length plus the difference of the poses.
    fn error(&self) -> f64 {
        let distance = |found: &PoseAndFocal| {
            (found.focal_px / self.truth.focal_px - 1.0).abs()
                + found.cam_from_world.local_left(&self.truth.cam_from_world).norm()
        };
        self.solve().iter().map(distance).fold(f64::INFINITY, f64::min)
    }
}

#[test]
fn truth_is_among_the_solutions() {
    let mut random = Random::new("p4pf");
    let (mut good, mut count) = (0, 0);
    for _ in 0..5000 {
        let case = Case::new(&mut random, false);
        let found = case.solve();
        count += found.len();
        good += usize::from(case.error() < 1e-6);
        for solution in &found {
            for (offset, x) in case.offset_px.iter().zip(&case.x_in_world) {
                let seen = project(&solution.cam_from_world.transform_point(x)) * solution.focal_px;
                assert!((seen - offset).norm() < 30.0);
            }
        }
    }
    assert!(good >= 4950, "{good} {count}");
    assert!((4950..10_000).contains(&count), "{count}");
}

#[test]
fn points_on_a_plane_give_the_truth() {
    let mut random = Random::new("p4pf plane");
    let mut good = 0;
    for _ in 0..2000 {
        good += usize::from(Case::new(&mut random, true).error() < 1e-4);
    }
    assert!(good >= 1960, "{good}");
}

#[test]
fn the_error_grows_with_the_noise() {
    let mut random = Random::new("p4pf noise");
    let median = |random: &mut Random, noise_px: f64| {
        let mut errors: Vec<f64> =
            (0..1001).map(|_| Case::new(random, false).noisy(random, noise_px).error()).collect();
        errors.sort_by(f64::total_cmp);
        errors[500]
    };
    let (small, large) = (median(&mut random, 0.01), median(&mut random, 0.1));
    assert!(small > 1e-6 && small < 1e-2, "{small}");
    assert!(large > 5.0 * small && large < 20.0 * small, "{small} {large}");
}

#[test]
fn the_jacobian_is_right() {
    let mut random = Random::new("p4pf jacobian");
    let case = Case::new(&mut random, false).noisy(&mut random, 20.0);
    let scaled = Scaled::new(&case.offset_px, &case.x_in_world).unwrap();
    let pose = case.truth.cam_from_world;
    let shifted = (pose.translation + pose.rotation * scaled.mean) / scaled.spread;
    let state = State { pose: Rigid3::new(pose.rotation, shifted), focal: case.truth.focal_px / scaled.px };
    assert_gradient(&scaled, &state, 1e-5);
}

#[test]
fn degenerate_input_gives_no_nonsense() {
    let mut random = Random::new("p4pf degenerate");
    let case = Case::new(&mut random, false);
    let (pixels, x) = (case.offset_px, case.x_in_world);
    assert!(p4pf(&pixels, &[x[0]; 4]).is_empty());
    assert!(p4pf(&[Vector2::zeros(); 4], &x).is_empty());
    assert!(p4pf(&pixels, &[0.0, 1.0, 2.0, 5.0].map(|s| x[0] + (x[1] - x[0]) * s)).is_empty());
    assert!(p4pf(&[Vector2::repeat(f64::NAN); 4], &x).is_empty());
    assert!(p4pf(&pixels, &[x[0], x[1], x[2], Vector3::repeat(f64::INFINITY)]).is_empty());
    // A plane parallel to the image: any focal length fits.
    let parallel = pixels.map(|p| (p / 1000.0).push(1.0) * 5.0);
    assert!(p4pf(&pixels, &parallel).is_empty());
}
