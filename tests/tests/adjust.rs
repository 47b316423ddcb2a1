//! `terrane adjust` on problems with known answers, and on those that have none.

use std::path::Path;
use std::process::Output;

use nalgebra::Vector3;
use terrane_geometry::alignment::umeyama;
use terrane_geometry::so3;
use terrane_scene::bal::{self, BalObservation, BalProblem};
use terrane_tests::terrane;

const SIGMA_PX: f64 = 0.5;

type BalCamera = [f64; 9];

/// Numbers that look random, evenly between -1 and 1 (Knuth's multiplier).
struct Shake(u64);

impl Shake {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }

    /// Of unit variance: the sum of twelve even numbers.
    fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.next()).sum::<f64>() / 2.0
    }
}

fn center(camera: &BalCamera) -> Vector3<f64> {
    let rotation = so3::exp(&Vector3::new(camera[0], camera[1], camera[2]));
    -(rotation.inverse() * Vector3::new(camera[3], camera[4], camera[5]))
}

/// Where a camera sees a point, as the format's authors state it.
fn project(camera: &BalCamera, x: [f64; 3]) -> [f64; 2] {
    let rotation = so3::exp(&Vector3::new(camera[0], camera[1], camera[2]));
    let in_cam = rotation * Vector3::from(x) + Vector3::new(camera[3], camera[4], camera[5]);
    let p = -in_cam.xy() / in_cam.z;
    let r2 = p.norm_squared();
    let xy = camera[6] * (1.0 + camera[7] * r2 + camera[8] * r2 * r2) * p;
    [xy.x, xy.y]
}

/// Sixteen tilted cameras 100 m above 300 points that all of them see, with noise; `relief_m` is the height of the ground.
fn truth(relief_m: f64) -> BalProblem {
    let mut shake = Shake(7);
    let mut problem = BalProblem::default();
    for i in 0..16 {
        let (column, row) = (f64::from(i % 4), f64::from(i / 4));
        let at = Vector3::new(20.0 * column - 30.0, 20.0 * row - 30.0, 100.0 + 8.0 * shake.next());
        let tilt = Vector3::new(-at.y / 120.0, at.x / 120.0, 0.0) * -1.0;
        let rotation = so3::exp(&Vector3::new(0.0, 0.0, 1.6 * shake.next())) * so3::exp(&tilt);
        let (r, t) = (so3::log(&rotation), -(rotation * at));
        problem.cameras.push([r.x, r.y, r.z, t.x, t.y, t.z, 1500.0 + 3.0 * shake.next(), -0.05, 0.01]);
    }
    for _ in 0..300 {
        problem.points.push([45.0 * shake.next(), 45.0 * shake.next(), relief_m * shake.next()]);
    }
    for (camera, parameters) in problem.cameras.iter().enumerate() {
        for (point, x) in problem.points.iter().enumerate() {
            let noise = [SIGMA_PX * shake.normal(), SIGMA_PX * shake.normal()];
            let xy = project(parameters, *x);
            problem.observations.push(BalObservation {
                camera: camera as u32,
                point: point as u32,
                xy_px: [(xy[0] + noise[0]) as f32, (xy[1] + noise[1]) as f32],
            });
        }
    }
    problem
}

/// A start that is some metres off.
fn shaken(truth: &BalProblem) -> BalProblem {
    let mut shake = Shake(11);
    let mut problem = truth.clone();
    for camera in &mut problem.cameras {
        (0..3).for_each(|at| camera[at] += 2e-3 * shake.next());
        (3..6).for_each(|at| camera[at] += 0.3 * shake.next());
        (camera[6], camera[7], camera[8]) = (1500.0, 0.0, 0.0);
    }
    problem.points.iter_mut().flatten().for_each(|value| *value += 0.5 * shake.next());
    problem
}

/// The problem without the observations that `keeps(camera, point)` refuses.
fn thinned(problem: &BalProblem, keeps: impl Fn(u32, u32) -> bool) -> BalProblem {
    let mut thin = problem.clone();
    thin.observations.retain(|o| keeps(o.camera, o.point));
    thin
}

fn text_of(problem: &BalProblem) -> String {
    let mut text =
        format!("{} {} {}\n", problem.cameras.len(), problem.points.len(), problem.observations.len());
    for o in &problem.observations {
        text.push_str(&format!("{} {} {} {}\n", o.camera, o.point, o.xy_px[0], o.xy_px[1]));
    }
    for value in problem.cameras.as_flattened().iter().chain(problem.points.as_flattened()) {
        text.push_str(&format!("{value}\n"));
    }
    text
}

fn write(problem: &BalProblem, path: &Path) {
    std::fs::write(path, text_of(problem)).expect("written");
}

fn adjust(input: &Path, out: &Path, flags: &[&str]) -> Output {
    let mut command = terrane();
    command.args(["--json", "adjust"]).arg(input).arg("-o").arg(out).args(flags);
    command.output().expect("terrane runs")
}

/// Adjusts a problem; the exit code, what was told, and what was written.
fn adjusted(problem: &BalProblem, flags: &[&str]) -> (i32, serde_json::Value, BalProblem) {
    let folder = tempfile::tempdir().expect("a folder");
    let (input, out) = (folder.path().join("in.txt"), folder.path().join("out.txt"));
    write(problem, &input);
    let output = adjust(&input, &out, flags);
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let told = text.lines().next().and_then(|line| serde_json::from_str(line).ok());
    let told = told.unwrap_or_else(|| panic!("{text}\n{}", String::from_utf8_lossy(&output.stderr)));
    let written =
        bal::read(std::io::BufReader::new(std::fs::File::open(out).expect("a result"))).expect("BAL");
    (output.status.code().unwrap_or(-1), told, written)
}

#[test]
fn truth_is_found_down_to_the_noise() {
    let truth = truth(12.0);
    let start = shaken(&truth);
    let (code, told, found) = adjusted(&start, &["--threads", "2"]);
    assert_eq!(code, 0, "{told}");
    assert_eq!(found.observations, start.observations);
    let free = 9 * found.cameras.len() + 3 * found.points.len() - 7;
    let expected = 0.5 * SIGMA_PX * SIGMA_PX * (2 * found.observations.len() - free) as f64;
    let cost = told["report"]["final_cost"].as_f64().unwrap();
    assert!((0.93..1.07).contains(&(cost / expected)), "cost {cost}, {expected} expected");
    // As the written file has it, in the format's own terms.
    let square = |o: &BalObservation| {
        let seen = project(&found.cameras[o.camera as usize], found.points[o.point as usize]);
        0.5 * ((seen[0] - f64::from(o.xy_px[0])).powi(2) + (seen[1] - f64::from(o.xy_px[1])).powi(2))
    };
    let written_cost: f64 = found.observations.iter().map(square).sum();
    assert!((written_cost / cost - 1.0).abs() < 1e-6, "{written_cost} {cost}");
    let (a, b): (Vec<_>, Vec<_>) =
        found.cameras.iter().zip(&truth.cameras).map(|(a, b)| (center(a), center(b))).unzip();
    let truth_from_found = umeyama(&a, &b, None).expect("not on a line");
    let off_m = a.iter().zip(&b).map(|(a, b)| (truth_from_found.transform_point(a) - b).norm_squared());
    let rmse_m = (off_m.sum::<f64>() / a.len() as f64).sqrt();
    assert!((1e-4..0.25).contains(&rmse_m), "{rmse_m} m");
}

#[test]
fn threads_workers_and_memory_do_not_change_a_byte() {
    let start = shaken(&truth(12.0));
    let implicit = |flags: &[&str]| adjusted(&start, &[&["--solver", "implicit"], flags].concat()).2;
    let one = implicit(&["--threads", "1"]);
    for flags in [&["--threads", "2"][..], &["--memory", "1KiB"], &["--workers", "1"], &["--workers", "2"]] {
        assert!(implicit(flags) == one, "{flags:?}");
    }
    let explicit =
        ["1", "2"].map(|threads| adjusted(&start, &["--solver", "explicit", "--threads", threads]).2);
    assert_eq!(explicit[0], explicit[1]);
}

#[test]
fn every_way_finds_the_same_minimum() {
    let start = shaken(&truth(12.0));
    let cost = |flags: &[&str]| {
        let (code, told, _) = adjusted(&start, &[&["--cost-tolerance", "1e-12"], flags].concat());
        assert_eq!(code, 0, "{flags:?}: {told}");
        told["report"]["final_cost"].as_f64().unwrap()
    };
    let explicit = cost(&["--solver", "explicit"]);
    for flags in [
        &["--solver", "implicit"][..],
        &["--solver", "implicit", "--precision", "double"],
        &["--solver", "implicit", "--preconditioner", "power-series"],
        &["--solver", "implicit", "--preconditioner", "block-jacobi"],
        &["--memory", "1KiB"],
        &["--workers", "2"],
    ] {
        let difference = (cost(flags) / explicit - 1.0).abs();
        assert!(difference < 1e-8, "{flags:?}: {difference:e}");
    }
}

#[test]
fn too_few_iterations_fall_short_and_leave_the_best() {
    let start = shaken(&truth(12.0));
    let (code, told, _) = adjusted(&start, &["--max-iterations", "1", "--cost-tolerance", "1e-12"]);
    let report = &told["report"];
    assert_eq!((code, &report["termination"]), (1, &"max_iterations".into()));
    assert!(report["final_cost"].as_f64() < report["initial_cost"].as_f64(), "{told}");
}

#[test]
fn what_is_not_held_is_named_and_stays_finite() {
    let start = shaken(&truth(12.0));
    for solver in ["explicit", "implicit"] {
        let flags = ["--solver", solver];
        // Camera 15 sees nothing; point 0 is seen once.
        let thin = thinned(&start, |camera, point| camera < 15 && (point > 0 || camera == 3));
        let (code, told, found) = adjusted(&thin, &flags);
        assert_eq!(code, 0, "{told}");
        let report = &told["report"];
        assert_eq!(
            (&report["unconstrained_poses"], &report["seen_once"]),
            (&[15].into(), &1.into()),
            "{told}"
        );
        assert_eq!(found.points[0], thin.points[0]);
        for (a, b) in found.cameras[15].iter().zip(thin.cameras[15]) {
            assert!((a - b).abs() < 1e-12, "{a} {b}");
        }
        // Two halves with nothing in common.
        let halves = thinned(&start, |camera, point| (camera < 8) == (point < 150));
        let (code, told, found) = adjusted(&halves, &flags);
        let report = &told["report"];
        assert_eq!(code, 0, "{told}");
        assert!(report["final_cost"].as_f64() < report["initial_cost"].as_f64());
        assert!(found.cameras.as_flattened().iter().all(|value| value.is_finite()));
        // A ground without relief, and nothing at all.
        let (code, told, found) = adjusted(&shaken(&truth(0.0)), &flags);
        assert!(code == 0 || (code == 1 && told["report"]["termination"] == "max_iterations"), "{told}");
        assert!(found.points.as_flattened().iter().all(|value| value.is_finite()));
        let (code, told, _) = adjusted(&thinned(&start, |_, _| false), &flags);
        assert_eq!((code, &told["report"]["termination"]), (1, &"nothing_to_adjust".into()));
    }
}

#[test]
fn broken_files_are_refused_with_the_place() {
    let folder = tempfile::tempdir().expect("a folder");
    let (input, out) = (folder.path().join("in.txt"), folder.path().join("out.txt"));
    let good = text_of(&thinned(&truth(12.0), |camera, _| camera < 2));
    let lines: Vec<&str> = good.lines().collect();
    let with = |at: usize, line: &str| {
        let mut changed = lines.clone();
        changed[at] = line;
        changed.join("\n")
    };
    for (text, says) in [
        (good[..good.len() / 2].to_owned(), "cut short"),
        (with(3, "0 2 nan 1"), "line 4: `nan`"),
        (with(3, "16 2 0 1"), "16 can't be the camera"),
        (with(3, "0 300 0 1"), "300 can't be the point"),
        (with(0, "16 4000000000 600"), "cut short"),
        // The focal length of camera 0.
        (with(1 + 600 + 6, "-1500"), "must be positive"),
    ] {
        std::fs::write(&input, text).expect("written");
        let output = adjust(&input, &out, &[]);
        let told = String::from_utf8_lossy(&output.stdout).into_owned();
        assert_eq!(output.status.code(), Some(2), "{says}: {told}");
        assert!(told.contains(says) && !out.exists(), "{says} is missing in: {told}");
    }
    std::fs::write(&input, &good).expect("written");
    assert_eq!(adjust(&input, &out, &["--loss-scale-px", "0"]).status.code(), Some(2));
    assert_eq!(adjust(&input, &out, &["--loss", "cubic"]).status.code(), Some(2));
    assert_eq!(adjust(&folder.path().join("absent.txt"), &out, &[]).status.code(), Some(2));
}
