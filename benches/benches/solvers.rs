//! The solvers of geometry on random problems without noise: time, solutions, how often the truth is among them, and how near.
//!
//! As the table of PoseLib's README (Larsson 2020). The truth counts as found within 1e-6: the length of the difference of two poses
//! (radians and units of the scene, whose points lie 3 to 12 units ahead), of two matrices of norm one, or of two points, plus the
//! relative error of a focal length. One thread. `-- --count N` sets the number of problems.

use std::hint::black_box;
use std::time::Instant;

use nalgebra::{Matrix3, UnitQuaternion, Vector2, Vector3};
use terrane_geometry::calibration::{PlanarView, calibrate};
use terrane_geometry::essential::{essential_from_eight, essential_from_five};
use terrane_geometry::fundamental::{fundamental_from_eight, fundamental_from_seven};
use terrane_geometry::p2p::p2p_upright;
use terrane_geometry::p3p::p3p;
use terrane_geometry::p4pf::p4pf;
use terrane_geometry::pnp::pnp;
use terrane_geometry::resection::resect;
use terrane_geometry::triangulation::triangulate_pair;
use terrane_geometry::two_view::essential_from_pose;
use terrane_geometry::{Camera, CameraModel, Rigid3, Seed, so3};

const FOUND_WITHIN: f64 = 1e-6;

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let asked = arguments.iter().position(|argument| argument == "--count");
    let count = asked.and_then(|at| arguments.get(at + 1)?.parse().ok()).unwrap_or(10_000);
    println!("| solver | µs a call | solutions a call | truth found % | 99th percentile of the error |");
    println!("|---|---|---|---|---|");
    absolute(count);
    relative(count);
    slower((count / 50).max(1));
}

/// Uniform numbers by hashing a counter.
struct Random(Seed, u64);

impl Random {
    fn new(name: &str) -> Self {
        Self(Seed(4).derive(name), 0)
    }

    fn unit(&mut self) -> f64 {
        self.1 += 1;
        (self.0.item(&[self.1]).0 >> 11) as f64 / (1u64 << 53) as f64
    }

    fn uniform(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    fn vector(&mut self, size: f64) -> Vector3<f64> {
        Vector3::from_fn(|_, _| self.uniform(-size, size))
    }

    fn pose(&mut self) -> Rigid3 {
        Rigid3::new(so3::exp(&self.vector(1.8)), self.vector(3.0))
    }

    fn on_image(&mut self) -> Vector2<f64> {
        Vector2::new(self.uniform(-0.6, 0.6), self.uniform(-0.6, 0.6))
    }
}

/// A camera with points ahead, or two of them.
struct Problem {
    cam_from_world: Rigid3,
    x_in_world: Vec<Vector3<f64>>,
    xy: Vec<Vector2<f64>>,
    rays: Vec<Vector3<f64>>,
    focal_px: f64,
}

impl Problem {
    fn new(random: &mut Random, count: usize) -> Self {
        let cam_from_world = random.pose();
        let xy: Vec<_> = (0..count).map(|_| random.on_image()).collect();
        let world_from_cam = cam_from_world.inverse();
        let x = |xy: &Vector2<f64>, depth: f64| world_from_cam.transform_point(&(xy.push(1.0) * depth));
        let x_in_world = xy.iter().map(|xy| x(xy, random.uniform(3.0, 12.0))).collect();
        let rays = xy.iter().map(|xy| xy.push(1.0).normalize()).collect();
        Self { cam_from_world, x_in_world, xy, rays, focal_px: random.uniform(500.0, 3000.0) }
    }

    fn error(&self, pose: &Rigid3) -> f64 {
        pose.local_left(&self.cam_from_world).norm()
    }

    fn xy_px<const N: usize>(&self) -> [Vector2<f64>; N] {
        std::array::from_fn(|i| self.xy[i] * self.focal_px)
    }
}

/// Times a solver over problems made beforehand and prints its row; the solver gives solutions, the judge their errors.
fn row<P, S>(name: &str, problems: &[P], solve: impl Fn(&P) -> Vec<S>, judge: impl Fn(&P, &S) -> f64) {
    let start = Instant::now();
    let found: Vec<Vec<S>> = problems.iter().map(|problem| black_box(solve(black_box(problem)))).collect();
    let micros = start.elapsed().as_secs_f64() * 1e6 / problems.len() as f64;
    let solutions: usize = found.iter().map(Vec::len).sum();
    let nearest = |(problem, found): (&P, &Vec<S>)| {
        found.iter().map(|solution| judge(problem, solution)).fold(f64::INFINITY, f64::min)
    };
    let mut errors: Vec<f64> = problems.iter().zip(&found).map(nearest).collect();
    errors.sort_by(f64::total_cmp);
    let good = errors.iter().filter(|error| **error < FOUND_WITHIN).count();
    println!(
        "| {name} | {micros:.2} | {:.2} | {:.2} | {:.1e} |",
        solutions as f64 / problems.len() as f64,
        100.0 * good as f64 / problems.len() as f64,
        errors[errors.len() * 99 / 100],
    );
}

fn problems(name: &str, count: usize, points: usize) -> Vec<Problem> {
    let mut random = Random::new(name);
    (0..count).map(|_| Problem::new(&mut random, points)).collect()
}

fn absolute(count: usize) {
    let down = Vector3::new(0.0, 0.0, -1.0);
    row(
        "P2P, upright",
        &problems("p2p", count, 2),
        |p| {
            let (rays, x) = ([p.rays[0], p.rays[1]], [p.x_in_world[0], p.x_in_world[1]]);
            p2p_upright(&rays, &x, &(p.cam_from_world.rotation * down), &down).to_vec()
        },
        |p, pose| p.error(pose),
    );
    row(
        "P3P",
        &problems("p3p", count, 3),
        |p| p3p(&std::array::from_fn(|i| p.rays[i]), &std::array::from_fn(|i| p.x_in_world[i])).to_vec(),
        |p, pose| p.error(pose),
    );
    row(
        "P4Pf",
        &problems("p4pf", count, 4),
        |p| p4pf(&p.xy_px(), &std::array::from_fn(|i| p.x_in_world[i])).to_vec(),
        |p, found| p.error(&found.cam_from_world) + (found.focal_px / p.focal_px - 1.0).abs(),
    );
    for points in [4, 6, 10, 100] {
        let name = format!("PnP, {points} points");
        let solve = |p: &Problem| pnp(&p.rays, &p.x_in_world).to_vec();
        row(&name, &problems(&name, count / 4 + 1, points), solve, |p, pose| p.error(pose));
    }
    for points in [6, 20] {
        let name = format!("resection, {points} points");
        let solve = |p: &Problem| resect(&p.x_in_world, &p.xy).into_iter().collect();
        row(&name, &problems(&name, count / 4 + 1, points), solve, |p, found| {
            p.error(&found.cam_from_world) + (found.px_from_normalized - Matrix3::identity()).norm()
        });
    }
}

/// Two views of the same points, the second a unit length away.
struct Pair {
    second_from_first: Rigid3,
    essential: Matrix3<f64>,
    x_in_first: Vec<Vector3<f64>>,
    first: Vec<Vector2<f64>>,
    second: Vec<Vector2<f64>>,
}

fn pairs(name: &str, count: usize, points: usize) -> Vec<Pair> {
    let mut random = Random::new(name);
    let mut pair = || {
        let rotation: UnitQuaternion<f64> = so3::exp(&random.vector(0.3));
        let center = random.vector(1.0).normalize();
        let second_from_first = Rigid3::from_rotation_and_center(rotation, &center);
        let first: Vec<_> = (0..points).map(|_| random.on_image()).collect();
        let x_in_first: Vec<_> = first.iter().map(|xy| xy.push(1.0) * random.uniform(4.0, 12.0)).collect();
        let project = |x: &Vector3<f64>| {
            let seen = second_from_first.transform_point(x);
            seen.xy() / seen.z
        };
        let second = x_in_first.iter().map(project).collect();
        let essential = essential_from_pose(&second_from_first).normalize();
        Pair { second_from_first, essential, x_in_first, first, second }
    };
    (0..count).map(|_| pair()).collect()
}

fn relative(count: usize) {
    let judge =
        |p: &Pair, found: &Matrix3<f64>| (found - p.essential).norm().min((found + p.essential).norm());
    let five = |p: &Pair| {
        essential_from_five(&std::array::from_fn(|i| p.first[i]), &std::array::from_fn(|i| p.second[i]))
            .to_vec()
    };
    row("essential, 5 points", &pairs("five", count, 5), five, judge);
    let eight = |p: &Pair| essential_from_eight(&p.first, &p.second).into_iter().collect();
    row("essential, 8 points", &pairs("eight", count, 8), eight, judge);
    let seven = |p: &Pair| {
        fundamental_from_seven(&std::array::from_fn(|i| p.first[i]), &std::array::from_fn(|i| p.second[i]))
            .to_vec()
    };
    row("fundamental, 7 points", &pairs("seven", count, 7), seven, judge);
    let general = |p: &Pair| fundamental_from_eight(&p.first, &p.second).into_iter().collect();
    row("fundamental, 8 points", &pairs("fundamental", count, 8), general, judge);
    let point =
        |p: &Pair| triangulate_pair(&p.second_from_first, &p.first[0], &p.second[0]).into_iter().collect();
    row("optimal point of two views", &pairs("point", count, 1), point, |p, x| (x - p.x_in_first[0]).norm());
}

/// Pixels of a target of 9 × 7 points in six views.
struct Target {
    pixels: Vec<Vec<Vector2<f64>>>,
}

fn slower(count: usize) {
    let target: Vec<Vector2<f64>> =
        (0..63).map(|i| Vector2::new(f64::from(i % 9) - 4.0, f64::from(i / 9) - 3.0) * 0.1).collect();
    let truth = [1300.0, 805.0, 590.0, -0.08, 0.02];
    let Some(camera) = Camera::new(CameraModel::Radial, 1600, 1200, &truth) else { return };
    let mut random = Random::new("calibrate");
    let mut view = || {
        let tilt = Vector3::new(random.uniform(-0.6, 0.6), random.uniform(-0.6, 0.6), 0.0);
        let shift =
            Vector3::new(random.uniform(-0.2, 0.2), random.uniform(-0.2, 0.2), random.uniform(1.1, 1.6));
        let pose = Rigid3::new(so3::exp(&tilt), shift);
        target.iter().filter_map(|xy| camera.project(&pose.transform_point(&xy.push(0.0)))).collect()
    };
    let problems: Vec<Target> =
        (0..count).map(|_| Target { pixels: (0..6).map(|_| view()).collect() }).collect();
    let solve = |problem: &Target| {
        let views: Vec<_> =
            problem.pixels.iter().map(|xy_px| PlanarView { xy_on_target: &target, xy_px }).collect();
        calibrate(&views, CameraModel::Radial, (1600, 1200)).into_iter().collect()
    };
    row("calibration, 6 views of 63 points", &problems, solve, |_, found| {
        let off = found.camera.params().iter().zip(&truth);
        off.map(|(a, b)| (a - b).abs() / (1.0 + b.abs())).fold(0.0, f64::max)
    });
}
