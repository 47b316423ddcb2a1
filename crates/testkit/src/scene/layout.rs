//! Where cameras and points are.

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use rand::Rng;
use terrane_geometry::{Rigid3, Seed};

use super::SceneOptions;

/// The shape of a scene. The world is east, north, up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Layout {
    /// Cameras on a circle that look at a cloud of points in its middle.
    Orbit {
        /// Radius of the circle; the cloud is a third of it.
        radius_m: f64,
    },
    /// Cameras in rows over terrain, looking down with a small tilt.
    Nadir {
        /// Height above the terrain.
        height_m: f64,
        /// Distance between neighbours in a row.
        spacing_m: f64,
        /// Distance between rows.
        row_spacing_m: f64,
        /// Half the range of the terrain's height; zero is a plane.
        relief_m: f64,
    },
    /// Cameras along a street that look half forward, facades on both sides.
    Street {
        /// Distance between neighbours.
        spacing_m: f64,
        /// Half the width of the street.
        half_width_m: f64,
    },
    /// Cameras at one place that turn: nothing has depth.
    Panorama {
        /// Turn between neighbours.
        step_rad: f64,
    },
}

/// A uniform number in [low, high).
pub(crate) fn uniform(rng: &mut impl Rng, low: f64, high: f64) -> f64 {
    let unit = (rng.next_u64() >> 11) as f64 / (1u64 << 53) as f64;
    low + (high - low) * unit
}

/// A standard normal number (Box & Muller 1958).
pub(crate) fn normal(rng: &mut impl Rng) -> f64 {
    let radius = (-2.0 * uniform(rng, f64::MIN_POSITIVE, 1.0).ln()).sqrt();
    radius * (std::f64::consts::TAU * uniform(rng, 0.0, 1.0)).cos()
}

/// A camera at `center` that looks along `forward` with `up` up in the image.
pub(crate) fn look(center: Vector3<f64>, forward: Vector3<f64>, up: Vector3<f64>) -> Rigid3 {
    let z = forward.normalize();
    let x = z.cross(&up).normalize();
    let y = z.cross(&x);
    let matrix = Matrix3::from_rows(&[x.transpose(), y.transpose(), z.transpose()]);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(matrix));
    Rigid3::from_rotation_and_center(rotation, &center)
}

fn jitter(rng: &mut impl Rng, sigma: f64) -> Vector3<f64> {
    Vector3::new(normal(rng), normal(rng), normal(rng)) * sigma
}

/// How many cameras a row of a nadir block has: as many as make the block about square.
fn row_length(num_images: usize, spacing_m: f64, row_spacing_m: f64) -> usize {
    ((num_images as f64 * row_spacing_m / spacing_m).sqrt().ceil() as usize).max(1)
}

/// `cam_from_world` of every photograph.
pub(super) fn poses(options: &SceneOptions) -> Vec<Rigid3> {
    (0..options.num_images)
        .map(|index| pose(options, index, &mut options.seed.derive("pose").item(&[index as u64])))
        .collect()
}

fn pose(options: &SceneOptions, index: usize, seed: &mut Seed) -> Rigid3 {
    let rng = &mut seed.rng();
    let up = Vector3::z();
    match options.layout {
        Layout::Orbit { radius_m } => {
            let angle = std::f64::consts::TAU * index as f64 / options.num_images as f64;
            let center =
                Vector3::new(angle.cos(), angle.sin(), 0.25) * radius_m + jitter(rng, 0.02 * radius_m);
            look(center, jitter(rng, 0.03 * radius_m) - center, up)
        }
        Layout::Nadir { height_m, spacing_m, row_spacing_m, .. } => {
            let row_length = row_length(options.num_images, spacing_m, row_spacing_m);
            let (row, column) = (index / row_length, index % row_length);
            // Flown back and forth.
            let eastward = row % 2 == 0;
            let column = if eastward { column } else { row_length - 1 - column };
            let center = Vector3::new(column as f64 * spacing_m, row as f64 * row_spacing_m, height_m)
                + jitter(rng, 0.02 * height_m);
            let heading = if eastward { Vector3::x() } else { -Vector3::x() };
            look(center, -Vector3::z() + jitter(rng, 0.03), heading)
        }
        Layout::Street { spacing_m, half_width_m } => {
            let center = Vector3::new(index as f64 * spacing_m, 0.0, 1.7) + jitter(rng, 0.05 * half_width_m);
            let side = if index.is_multiple_of(2) { 0.6 } else { -0.6 };
            look(center, Vector3::new(1.0, side, 0.1) + jitter(rng, 0.02), up)
        }
        Layout::Panorama { step_rad } => {
            let angle = index as f64 * step_rad;
            look(Vector3::zeros(), Vector3::new(angle.cos(), angle.sin(), 0.0), up)
        }
    }
}

/// Every point of the scene.
pub(super) fn points(options: &SceneOptions) -> Vec<Vector3<f64>> {
    let rng = &mut options.seed.derive("points").rng();
    (0..options.num_points).map(|_| point(options, rng)).collect()
}

fn point(options: &SceneOptions, rng: &mut impl Rng) -> Vector3<f64> {
    match options.layout {
        Layout::Orbit { radius_m } => {
            let half = radius_m / 3.0;
            Vector3::new(uniform(rng, -half, half), uniform(rng, -half, half), uniform(rng, -half, half))
        }
        Layout::Nadir { height_m, spacing_m, row_spacing_m, relief_m } => {
            let row_length = row_length(options.num_images, spacing_m, row_spacing_m);
            let num_rows = options.num_images.div_ceil(row_length);
            let margin = 0.6 * height_m;
            let x = uniform(rng, -margin, (row_length - 1) as f64 * spacing_m + margin);
            let y = uniform(rng, -margin, (num_rows - 1) as f64 * row_spacing_m + margin);
            let hill = (x / (0.7 * height_m)).sin() * (y / (0.5 * height_m)).cos();
            Vector3::new(x, y, relief_m * (0.6 * hill + 0.4 * uniform(rng, -1.0, 1.0)))
        }
        Layout::Street { spacing_m, half_width_m } => {
            let length = options.num_images as f64 * spacing_m;
            let x = uniform(rng, -spacing_m, length + 6.0 * half_width_m);
            let side = if uniform(rng, 0.0, 1.0) < 0.5 { 1.0 } else { -1.0 };
            let depth = uniform(rng, 1.0, 1.4);
            Vector3::new(x, side * half_width_m * depth, uniform(rng, 0.0, 1.5 * half_width_m))
        }
        Layout::Panorama { .. } => {
            let angle = uniform(rng, 0.0, std::f64::consts::TAU);
            let distance = uniform(rng, 5.0, 20.0);
            Vector3::new(angle.cos() * distance, angle.sin() * distance, uniform(rng, -4.0, 4.0))
        }
    }
}
