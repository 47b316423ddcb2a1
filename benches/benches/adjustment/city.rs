//! Aerial cities as BAL files, by the recipe of the peers' `make_bal.py`, written without holding everything at once.
//!
//! A block of photographs in strips, 100 m above ground and houses, about 80 % overlap, some oblique; the start is what a
//! merge of submaps leaves: squares moved by a small similarity each, then every camera and point shaken.

use std::f64::consts::{PI, TAU};
use std::io::Write;
use std::path::Path;

use nalgebra::{Rotation3, Vector2, Vector3};
use rand::RngExt;
use terrane_geometry::Seed;

const STEP_M: f64 = 25.0;
const HEIGHT_M: f64 = 100.0;
const FOCAL_PX: f64 = 3000.0;
const HALF_PX: f64 = 2000.0;
const NOISE_PX: f64 = 0.5;
const TRACK_LENGTH: f64 = 6.0;
const MARGIN_M: f64 = 60.0;

/// What a city has.
#[derive(Clone, Copy, Debug)]
pub struct City {
    pub cameras: usize,
    pub points: usize,
    pub observations: usize,
}

impl City {
    /// The cost that the noise predicts: half the variance for each observation that no parameter can take up.
    pub fn predicted_cost(&self) -> f64 {
        let free = 9 * self.cameras + 3 * self.points - 7;
        0.5 * NOISE_PX * NOISE_PX * (2 * self.observations - free) as f64
    }
}

struct Draw(rand_pcg::Pcg64Mcg);

impl Draw {
    fn uniform(&mut self) -> f64 {
        self.0.random_range(0.0..1.0)
    }

    fn normal(&mut self, sigma: f64) -> f64 {
        sigma * (-2.0 * (1.0 - self.uniform()).ln()).sqrt() * (TAU * self.uniform()).cos()
    }

    fn vector(&mut self, sigma: f64) -> Vector3<f64> {
        Vector3::new(self.normal(sigma), self.normal(sigma), self.normal(sigma))
    }
}

struct Camera {
    rotation: Rotation3<f64>,
    center: Vector3<f64>,
    focal_px: f64,
    k: [f64; 2],
    /// Where it looks on the ground.
    aim: Vector2<f64>,
}

impl Camera {
    fn project(&self, x: &Vector3<f64>) -> Option<Vector2<f64>> {
        let p = self.rotation * (x - self.center);
        let (u, v) = (-p.x / p.z, -p.y / p.z);
        let r2 = u * u + v * v;
        let xy = Vector2::new(u, v) * self.focal_px * (1.0 + self.k[0] * r2 + self.k[1] * r2 * r2);
        (p.z < -5.0 && xy.x.abs() < HALF_PX && xy.y.abs() < HALF_PX).then_some(xy)
    }
}

/// Writes a city of so many cameras, each with about `per_camera` observations, displaced in `blocks` × `blocks` squares.
pub fn write(
    path: &Path,
    cameras: usize,
    per_camera: usize,
    blocks: usize,
    seed: u64,
) -> anyhow::Result<City> {
    let mut draw = Draw(Seed(seed).rng());
    let side = (cameras as f64).sqrt().ceil() as usize;
    let views = views(&mut draw, cameras, side);
    let width = side as f64 * STEP_M;
    let footprint = (2.0 * HALF_PX / FOCAL_PX * HEIGHT_M).powi(2);
    let found = (TRACK_LENGTH / (footprint / (STEP_M * STEP_M))).min(1.0);
    let wanted = (per_camera as f64 * (width + 2.0 * MARGIN_M).powi(2) / footprint / found) as usize;
    let reach = HALF_PX / FOCAL_PX * HEIGHT_M * 1.6;
    let grid = Grid::new(&views, reach, width);
    let (mut points, mut observations) = (Vec::new(), Vec::new());
    let mut seen: Vec<(u32, [f32; 2])> = Vec::new();
    for _ in 0..wanted {
        let x = ground(&mut draw, width);
        seen.clear();
        for &camera in grid.near(&x) {
            let view = &views[camera as usize];
            if (view.aim - x.xy()).norm() < reach
                && let Some(xy) = view.project(&x)
                && draw.uniform() < found
            {
                seen.push((
                    camera,
                    [(xy.x + draw.normal(NOISE_PX)) as f32, (xy.y + draw.normal(NOISE_PX)) as f32],
                ));
            }
        }
        if seen.len() >= 2 {
            observations.extend(seen.iter().map(|(camera, xy)| (*camera, points.len() as u32, *xy)));
            points.push(x);
        }
    }
    let city = City { cameras, points: points.len(), observations: observations.len() };
    let mut file = std::io::BufWriter::with_capacity(1 << 20, std::fs::File::create(path)?);
    writeln!(file, "{} {} {}", city.cameras, city.points, city.observations)?;
    for (camera, point, xy) in &observations {
        writeln!(file, "{camera} {point} {:.4} {:.4}", xy[0], xy[1])?;
    }
    drop(observations);
    write_start(&mut draw, &mut file, &views, &points, (width / blocks as f64, blocks))?;
    file.flush()?;
    Ok(city)
}

fn views(draw: &mut Draw, cameras: usize, side: usize) -> Vec<Camera> {
    let euler = |a: f64, b: f64, c: f64| {
        let about_z = |angle| Rotation3::from_axis_angle(&Vector3::z_axis(), angle);
        about_z(c) * Rotation3::from_axis_angle(&Vector3::x_axis(), b) * about_z(a)
    };
    (0..cameras)
        .map(|at| {
            let grid = Vector3::new((at % side) as f64 * STEP_M, (at / side) as f64 * STEP_M, HEIGHT_M);
            let center = grid + draw.vector(2.0);
            let steep = if draw.uniform() < 0.2 { 35.0 } else { 4.0 };
            let tilt = steep * draw.normal(1.0).clamp(-1.2, 1.2) * PI / 180.0;
            let rotation = euler(TAU * draw.uniform(), tilt, TAU * draw.uniform());
            let m = rotation.matrix();
            let aim = center.xy() - Vector2::new(m[(2, 0)], m[(2, 1)]) * HEIGHT_M / m[(2, 2)].max(0.3);
            let mut about = |value: f64| value * (1.0 + draw.normal(1e-3));
            Camera { rotation, center, focal_px: about(FOCAL_PX), k: [about(-0.05), about(0.01)], aim }
        })
        .collect()
}

fn ground(draw: &mut Draw, width: f64) -> Vector3<f64> {
    let mut place = || draw.uniform() * (width + 2.0 * MARGIN_M) - MARGIN_M;
    let (x, y) = (place(), place());
    let cell = |v: f64| (v / 40.0).floor() as i64;
    let built = (cell(x) * 7919 + cell(y) * 104_729).rem_euclid(5);
    let storeys = if built < 3 { 0.0 } else { (built - 2) as f64 * 14.0 };
    Vector3::new(x, y, storeys + draw.normal(0.4))
}

/// Cameras by the cells of the ground that they may see.
struct Grid {
    cell: f64,
    across: usize,
    cells: Vec<Vec<u32>>,
}

impl Grid {
    fn new(views: &[Camera], reach: f64, width: f64) -> Self {
        let cell = reach / 2.0;
        let across = ((width + 2.0 * MARGIN_M) / cell).ceil() as usize + 1;
        let mut grid = Self { cell, across, cells: vec![Vec::new(); across * across] };
        for (index, view) in views.iter().enumerate() {
            let clamp = |v: f64| (((v + MARGIN_M) / cell).floor().max(0.0) as usize).min(across - 1);
            for row in clamp(view.aim.y - reach)..=clamp(view.aim.y + reach) {
                for column in clamp(view.aim.x - reach)..=clamp(view.aim.x + reach) {
                    grid.cells[row * across + column].push(index as u32);
                }
            }
        }
        grid
    }

    fn near(&self, x: &Vector3<f64>) -> &[u32] {
        let at = |v: f64| (((v + MARGIN_M) / self.cell).floor().max(0.0) as usize).min(self.across - 1);
        &self.cells[at(x.y) * self.across + at(x.x)]
    }
}

/// Cameras and points where a solver begins.
fn write_start(
    draw: &mut Draw,
    file: &mut impl Write,
    views: &[Camera],
    points: &[Vector3<f64>],
    (size, blocks): (f64, usize),
) -> anyhow::Result<()> {
    let of = |v: f64| ((v / size).floor().max(0.0) as usize).min(blocks - 1);
    let cell = |x: &Vector3<f64>| of(x.x) * blocks + of(x.y);
    let mut middles = vec![(Vector3::zeros(), 0.0); blocks * blocks];
    for view in views {
        let middle: &mut (Vector3<f64>, f64) = &mut middles[cell(&view.center)];
        *middle = (middle.0 + view.center, middle.1 + 1.0);
    }
    let moves: Vec<_> = middles
        .iter()
        .map(|(sum, n)| {
            let turn = Rotation3::new(draw.vector(2e-3));
            (sum / f64::max(*n, 1.0), 1.0 + draw.normal(2e-3), turn, draw.vector(0.5))
        })
        .collect();
    let moved = |x: &Vector3<f64>| {
        let (middle, scale, turn, shift) = &moves[cell(x)];
        turn * (x - middle) * *scale + middle + shift
    };
    for view in views {
        let turn = &moves[cell(&view.center)].2;
        let rotation = Rotation3::new(draw.vector(1e-3)) * view.rotation * turn.inverse();
        let center = moved(&view.center) + draw.vector(0.1);
        let (r, t) = (rotation.scaled_axis(), -(rotation * center));
        for value in [r.x, r.y, r.z, t.x, t.y, t.z, FOCAL_PX, 0.0, 0.0] {
            writeln!(file, "{value:.10}")?;
        }
    }
    for point in points {
        let x = moved(point) + draw.vector(0.2);
        writeln!(file, "{:.6}\n{:.6}\n{:.6}", x.x, x.y, x.z)?;
    }
    Ok(())
}
