//! Calibration targets as a camera with known intrinsics sees them.

use nalgebra::{Vector2, Vector3};
use terrane_geometry::{Camera, Rigid3, Seed, so3};

use crate::scene::{normal, uniform};

/// What is printed.
#[derive(Clone, Debug)]
pub struct Pattern {
    size_m: Vector2<f64>,
    kind: Kind,
}

#[derive(Clone, Debug)]
enum Kind {
    Checkerboard { columns: usize, rows: usize, square_m: f64 },
    AprilGrid { columns: usize, rows: usize, tag_m: f64, spacing: f64, codes: Vec<u64> },
}

impl Pattern {
    /// A checkerboard with so many inner corners, the first of them at the origin, x to the right and y down.
    pub fn checkerboard(columns: usize, rows: usize, square_m: f64) -> Self {
        let size_m = Vector2::new((columns - 1) as f64, (rows - 1) as f64) * square_m;
        Self { size_m, kind: Kind::Checkerboard { columns, rows, square_m } }
    }

    /// An AprilGrid as Kalibr prints it (borders of two bits), the lower left corner of tag 0 at the origin, x to the right and y
    /// up. A code's 36 bits are read row by row from the upper left, the first being the highest, one being white.
    pub fn aprilgrid(columns: usize, rows: usize, tag_m: f64, spacing: f64, codes: &[u64]) -> Self {
        let side = |count: usize| tag_m * (count as f64 + spacing * (count - 1) as f64);
        let size_m = Vector2::new(side(columns), side(rows));
        Self { size_m, kind: Kind::AprilGrid { columns, rows, tag_m, spacing, codes: codes.to_vec() } }
    }

    /// Brightness from 0 to 1 at a point, `None` beyond the sheet.
    fn brightness(&self, xy_m: &Vector2<f64>) -> Option<f64> {
        match &self.kind {
            Kind::Checkerboard { columns, rows, square_m } => {
                let (x, y) = (xy_m.x / square_m, xy_m.y / square_m);
                let within =
                    |v: f64, count: usize, margin: f64| v > -margin && v < count as f64 - 1.0 + margin;
                if !within(x, *columns, 1.6) || !within(y, *rows, 1.6) {
                    return None;
                }
                let board = within(x, *columns, 1.0) && within(y, *rows, 1.0);
                Some(f64::from(!board || (x.floor() + y.floor()).rem_euclid(2.0) != 0.0))
            }
            Kind::AprilGrid { columns, rows, tag_m, spacing, codes } => {
                let pitch_m = tag_m * (1.0 + spacing);
                let margin_m = 1.5 * spacing * tag_m;
                let beyond = |v: f64, size: f64| v < -margin_m || v > size + margin_m;
                if beyond(xy_m.x, self.size_m.x) || beyond(xy_m.y, self.size_m.y) {
                    return None;
                }
                let (column, row) = ((xy_m.x / pitch_m).floor(), (xy_m.y / pitch_m).floor());
                let in_tag = (xy_m - Vector2::new(column, row) * pitch_m) / *tag_m;
                let (x_in, y_in) = (in_tag.x < 1.0, in_tag.y < 1.0);
                let known = |v: f64, count: usize| v >= 0.0 && v < count as f64;
                if x_in && y_in && known(column, *columns) && known(row, *rows) {
                    let (x, y) = ((in_tag.x * 10.0) as usize, ((1.0 - in_tag.y) * 10.0) as usize);
                    if !(2..8).contains(&x) || !(2..8).contains(&y) {
                        return Some(0.0);
                    }
                    let code = codes[row as usize * columns + column as usize];
                    return Some((code >> (35 - (6 * (y - 2) + x - 2)) & 1) as f64);
                }
                // Small squares lie where the gaps of columns and rows cross, around the outer tags too.
                let gap = |v: f64, is_in: bool, count: usize| !is_in && v >= -1.0 && v < count as f64;
                Some(f64::from(!(gap(column, x_in, *columns) && gap(row, y_in, *rows))))
            }
        }
    }
}

/// How a photograph comes out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderOptions {
    /// Standard deviation of a Gaussian blur, pixels.
    pub blur_px: f64,
    /// Standard deviation of noise, greys.
    pub noise_greys: f64,
    /// Loss of light in the picture's corners, 0 to 1.
    pub vignette: f64,
    /// Whether hard-edged clutter surrounds the sheet, instead of grey.
    pub clutter: bool,
    /// Seed of noise and clutter.
    pub seed: u64,
}

impl Default for RenderOptions {
    fn default() -> Self {
        Self { blur_px: 0.0, noise_greys: 0.0, vignette: 0.0, clutter: false, seed: 0 }
    }
}

/// Samples of a pixel, a side.
const SAMPLES: usize = 6;

/// A photograph of a pattern, `width_px * height_px` greys row after row.
pub fn render(
    pattern: &Pattern,
    camera: &Camera,
    cam_from_target: &Rigid3,
    options: &RenderOptions,
) -> Vec<u8> {
    let (width, height) = (camera.width_px as usize, camera.height_px as usize);
    let target_from_cam = cam_from_target.inverse();
    let center = target_from_cam.translation;
    // Rays through the pixels' own corners; between them they are as good as linear.
    let lattice: Vec<Option<Vector2<f64>>> = (0..(width + 1) * (height + 1))
        .map(|i| camera.unproject(&Vector2::new((i % (width + 1)) as f64, (i / (width + 1)) as f64)))
        .collect();
    let mut values = vec![0.0f64; width * height];
    for (i, value) in values.iter_mut().enumerate() {
        let (x, y) = (i % width, i / width);
        let corner = |dx: usize, dy: usize| lattice[(y + dy) * (width + 1) + x + dx];
        let (Some(a), Some(b), Some(c), Some(d)) = (corner(0, 0), corner(1, 0), corner(0, 1), corner(1, 1))
        else {
            continue;
        };
        let around = if options.clutter { clutter(x, y, options.seed) } else { 0.45 };
        for k in 0..SAMPLES * SAMPLES {
            let (u, v) = (
                ((k % SAMPLES) as f64 + 0.5) / SAMPLES as f64,
                ((k / SAMPLES) as f64 + 0.5) / SAMPLES as f64,
            );
            let ray = (a * (1.0 - u) + b * u) * (1.0 - v) + (c * (1.0 - u) + d * u) * v;
            let way = target_from_cam.rotation * ray.push(1.0);
            let length = -center.z / way.z;
            let seen = if length > 0.0 { pattern.brightness(&(center + way * length).xy()) } else { None };
            *value += seen.unwrap_or(around);
        }
        *value /= (SAMPLES * SAMPLES) as f64;
    }
    let mut rng = Seed(options.seed).derive("target").rng();
    let blurred = blur(&values, width, height, options.blur_px);
    let middle = Vector2::new(width as f64, height as f64) / 2.0;
    let grey = |(i, value): (usize, &f64)| {
        let at = Vector2::new((i % width) as f64, (i / width) as f64) + Vector2::repeat(0.5);
        let light = 1.0 - options.vignette * (at - middle).norm_squared() / middle.norm_squared();
        let noise = if options.noise_greys > 0.0 { options.noise_greys * normal(&mut rng) } else { 0.0 };
        (30.0 + 190.0 * value * light + noise).round().clamp(0.0, 255.0) as u8
    };
    blurred.iter().enumerate().map(grey).collect()
}

/// Blocks of three sizes over each other, with hard edges.
fn clutter(x: usize, y: usize, seed: u64) -> f64 {
    let sizes = [61, 23, 11];
    // Bent, for even blocks would be checkerboards themselves.
    let bent = |v: usize, w: usize| {
        (v as f64 + 9.0 * (v as f64 / 13.0).sin() + 6.0 * (w as f64 / 9.0).sin() + 20.0) as usize
    };
    let (x, y) = (bent(x, y), bent(y, x));
    let sum: f64 = sizes
        .iter()
        .map(|size| {
            let hash = Seed(seed).item(&[*size as u64, (x / size) as u64, (y / size) as u64]).0;
            (hash >> 11) as f64 / (1u64 << 53) as f64
        })
        .sum();
    sum / sizes.len() as f64
}

fn blur(values: &[f64], width: usize, height: usize, sigma_px: f64) -> Vec<f64> {
    if !(sigma_px > 0.0) {
        return values.to_vec();
    }
    let radius = (3.0 * sigma_px).ceil() as isize;
    let weights: Vec<f64> =
        (-radius..=radius).map(|d| (-0.5 * (d as f64 / sigma_px).powi(2)).exp()).collect();
    let total: f64 = weights.iter().sum();
    let pass = |from: &[f64], across: bool| -> Vec<f64> {
        let at = |i: usize, d: isize| {
            let (x, y) = (i % width, i / width);
            let moved = |v: usize, count: usize| v.saturating_add_signed(d).min(count - 1);
            if across { from[y * width + moved(x, width)] } else { from[moved(y, height) * width + x] }
        };
        let sum = |i: usize| (-radius..=radius).zip(&weights).map(|(d, w)| w * at(i, d)).sum::<f64>() / total;
        (0..from.len()).map(sum).collect()
    };
    pass(&pass(values, true), false)
}

/// The same as a grey JPEG file.
pub fn photograph(
    pattern: &Pattern,
    camera: &Camera,
    cam_from_target: &Rigid3,
    options: &RenderOptions,
) -> Vec<u8> {
    let (mut file, mut pixels) = (Vec::new(), render(pattern, camera, cam_from_target, options));
    let side = |length: u32| length.min(u32::from(u16::MAX)) as u16;
    let (width, height) = (side(camera.width_px), side(camera.height_px));
    pixels.resize(usize::from(width) * usize::from(height), 0);
    let encoder = jpeg_encoder::Encoder::new(&mut file, 95);
    // Into memory, of a size that fits, encoding can't fail.
    let _ = encoder.encode(&pixels, width, height, jpeg_encoder::ColorType::Luma);
    file
}

/// A pose that shows all of a pattern, tilted by up to `tilt_rad` about both axes, turned and shifted at random.
///
/// # Panics
/// When the camera can't see the pattern whole from any such pose.
pub fn random_pose(pattern: &Pattern, camera: &Camera, tilt_rad: f64, index: u64) -> Rigid3 {
    let mut rng = Seed(index).derive("pose").rng();
    let upright = match pattern.kind {
        Kind::Checkerboard { .. } => so3::exp(&Vector3::zeros()),
        Kind::AprilGrid { .. } => so3::exp(&Vector3::new(std::f64::consts::PI, 0.0, 0.0)),
    };
    let middle = (0.5 * pattern.size_m).push(0.0);
    let size_m = pattern.size_m.norm();
    for _ in 0..10_000 {
        let tilt =
            Vector3::new(uniform(&mut rng, -tilt_rad, tilt_rad), uniform(&mut rng, -tilt_rad, tilt_rad), 0.0);
        let turn = Vector3::z() * uniform(&mut rng, -0.8, 0.8);
        let rotation = so3::exp(&tilt) * so3::exp(&turn) * upright;
        let distance_m = size_m * uniform(&mut rng, 1.1, 2.0);
        let shift =
            Vector3::new(uniform(&mut rng, -0.4, 0.4), uniform(&mut rng, -0.3, 0.3), 1.0) * distance_m;
        let pose = Rigid3::new(rotation, shift - rotation * middle);
        let margin = 0.04 * size_m;
        let seen = (0..40).all(|i| {
            // Around the outline, where distortion bends the sides.
            let t = f64::from(i % 10) / 9.0;
            let on = match i / 10 {
                0 => Vector2::new(t, 0.0),
                1 => Vector2::new(t, 1.0),
                2 => Vector2::new(0.0, t),
                _ => Vector2::new(1.0, t),
            };
            let outer = pattern.size_m + Vector2::repeat(4.0 * margin);
            let xy = on.component_mul(&outer) - Vector2::repeat(2.0 * margin);
            camera.project(&pose.transform_point(&xy.push(0.0))).is_some_and(|px| {
                px.x > 8.0
                    && px.y > 8.0
                    && px.x < f64::from(camera.width_px) - 8.0
                    && px.y < f64::from(camera.height_px) - 8.0
            })
        });
        if seen {
            return pose;
        }
    }
    panic!("the camera can't see the pattern whole")
}
