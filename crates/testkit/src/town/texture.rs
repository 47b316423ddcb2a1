//! Surfaces that look like something: unique at every place, with detail at every scale, and a pyramid to sample from.

use rayon::prelude::*;
use terrane_geometry::Seed;

/// What a surface is made of.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Material {
    /// Meadows, bushes, and a grid of streets.
    Ground,
    /// Rows of tiles with vents and skylights.
    Roof,
    /// Plaster with windows.
    Wall,
}

/// Distance between the middles of two streets in metres.
pub(super) const BLOCK_M: f64 = 44.0;
/// Half the width of a street in metres.
pub(super) const HALF_STREET_M: f64 = 4.0;

/// An image pyramid over a rectangle of `width_m` × `height_m`; rows start at v = 0.
pub(super) struct Texture {
    pub width_m: f64,
    pub height_m: f64,
    levels: Vec<Level>,
}

struct Level {
    width: usize,
    height: usize,
    rgb: Vec<[u8; 3]>,
}

impl Texture {
    /// Paints a surface at `texels_per_m`; `origin_m` is where its corner lies in the material's own plane.
    pub fn paint(
        material: Material,
        origin_m: [f64; 2],
        size_m: [f64; 2],
        texels_per_m: f64,
        seed: Seed,
    ) -> Self {
        let width = ((size_m[0] * texels_per_m).ceil() as usize).max(2);
        let height = ((size_m[1] * texels_per_m).ceil() as usize).max(2);
        let rows: Vec<Vec<[u8; 3]>> = (0..height)
            .into_par_iter()
            .map(|row| {
                let v = origin_m[1] + (row as f64 + 0.5) * size_m[1] / height as f64;
                (0..width)
                    .map(|column| {
                        let u = origin_m[0] + (column as f64 + 0.5) * size_m[0] / width as f64;
                        color(material, u, v, seed)
                    })
                    .collect()
            })
            .collect();
        let mut levels = vec![Level { width, height, rgb: rows.concat() }];
        while let Some(level) = levels.last().and_then(halve) {
            levels.push(level);
        }
        Self { width_m: size_m[0], height_m: size_m[1], levels }
    }

    /// Colour at (u, v) metres where a pixel covers `footprint_m` metres: trilinear.
    pub fn sample(&self, u: f64, v: f64, footprint_m: f64) -> [f32; 3] {
        let texel_m = self.width_m / self.levels[0].width as f64;
        let lod = (footprint_m / texel_m).max(1.0).log2().min((self.levels.len() - 1) as f64);
        let lower = lod.floor() as usize;
        let fine = self.levels[lower].sample(u / self.width_m, v / self.height_m);
        if lower + 1 == self.levels.len() {
            return fine;
        }
        let coarse = self.levels[lower + 1].sample(u / self.width_m, v / self.height_m);
        let share = (lod - lower as f64) as f32;
        std::array::from_fn(|c| fine[c] + share * (coarse[c] - fine[c]))
    }
}

impl Level {
    fn sample(&self, s: f64, t: f64) -> [f32; 3] {
        let x = (s * self.width as f64 - 0.5).clamp(0.0, (self.width - 1) as f64);
        let y = (t * self.height as f64 - 0.5).clamp(0.0, (self.height - 1) as f64);
        let (x0, y0) = (x as usize, y as usize);
        let (x1, y1) = ((x0 + 1).min(self.width - 1), (y0 + 1).min(self.height - 1));
        let (fx, fy) = ((x - x0 as f64) as f32, (y - y0 as f64) as f32);
        let texel = |x: usize, y: usize| self.rgb[y * self.width + x];
        let (a, b, c, d) = (texel(x0, y0), texel(x1, y0), texel(x0, y1), texel(x1, y1));
        std::array::from_fn(|i| {
            let top = f32::from(a[i]) + fx * (f32::from(b[i]) - f32::from(a[i]));
            let bottom = f32::from(c[i]) + fx * (f32::from(d[i]) - f32::from(c[i]));
            top + fy * (bottom - top)
        })
    }
}

/// The level of half the size, each texel the mean of four; `None` when it would be a line.
fn halve(level: &Level) -> Option<Level> {
    let (width, height) = (level.width / 2, level.height / 2);
    if width < 2 || height < 2 {
        return None;
    }
    let mut rgb = Vec::with_capacity(width * height);
    for row in 0..height {
        for column in 0..width {
            let at = |dx: usize, dy: usize| level.rgb[(2 * row + dy) * level.width + 2 * column + dx];
            let four = [at(0, 0), at(1, 0), at(0, 1), at(1, 1)];
            rgb.push(std::array::from_fn(|c| {
                ((four.iter().map(|texel| u32::from(texel[c])).sum::<u32>() + 2) / 4) as u8
            }));
        }
    }
    Some(Level { width, height, rgb })
}

/// A uniform number in [0, 1) for a lattice point: an integer hash in the manner of Wang (2007).
fn lattice(x: i64, y: i64, seed: u64) -> f64 {
    let mut h = (x as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15)
        ^ (y as u64).wrapping_mul(0xC2B2_AE3D_27D4_EB4F)
        ^ seed;
    h ^= h >> 29;
    h = h.wrapping_mul(0xBF58_476D_1CE4_E5B9);
    h ^= h >> 32;
    h = h.wrapping_mul(0x94D0_49BB_1331_11EB);
    h ^= h >> 29;
    (h >> 11) as f64 / (1u64 << 53) as f64
}

/// Smooth noise in [0, 1] whose grain is `size` metres (Perlin 1985's lattice, with values).
fn noise(u: f64, v: f64, size: f64, seed: u64) -> f64 {
    let (x, y) = (u / size, v / size);
    let (x0, y0) = (x.floor(), y.floor());
    let smooth = |t: f64| t * t * (3.0 - 2.0 * t);
    let (fx, fy) = (smooth(x - x0), smooth(y - y0));
    let (i, j) = (x0 as i64, y0 as i64);
    let top = lattice(i, j, seed) * (1.0 - fx) + lattice(i + 1, j, seed) * fx;
    let bottom = lattice(i, j + 1, seed) * (1.0 - fx) + lattice(i + 1, j + 1, seed) * fx;
    top * (1.0 - fy) + bottom * fy
}

/// A sum of noises, finer and weaker; about zero, within ±1.
fn fractal(u: f64, v: f64, seed: u64) -> f64 {
    let mut sum = 0.0;
    for (octave, size) in [9.0, 3.7, 1.6, 0.7, 0.32, 0.16].into_iter().enumerate() {
        sum += 0.8_f64.powi(octave as i32) * (noise(u, v, size, seed ^ octave as u64) - 0.5);
    }
    sum * 0.55
}

/// Dots of random size, place and darkness, at most one to a cell; zero outside.
fn dots(u: f64, v: f64, cell: f64, seed: u64) -> f64 {
    let (i, j) = ((u / cell).floor() as i64, (v / cell).floor() as i64);
    if lattice(i, j, seed) > 0.55 {
        return 0.0;
    }
    let center = |k: i64, salt: u64| (k as f64 + 0.3 + 0.4 * lattice(i, j, seed ^ salt)) * cell;
    let radius = cell * (0.08 + 0.2 * lattice(i, j, seed ^ 3));
    let distance = (u - center(i, 1)).hypot(v - center(j, 2));
    let inside = (1.5 * (1.0 - distance / radius)).clamp(0.0, 1.0);
    inside * (2.0 * lattice(i, j, seed ^ 4) - 1.0)
}

fn shade(base: [f64; 3], change: f64) -> [u8; 3] {
    base.map(|channel| (channel * (1.0 + change)).clamp(4.0, 250.0) as u8)
}

fn color(material: Material, u: f64, v: f64, seed: Seed) -> [u8; 3] {
    let salt = seed.0;
    let detail = fractal(u, v, salt);
    match material {
        Material::Ground => ground(u, v, detail, salt),
        Material::Roof => {
            let row = (v / 0.33).floor();
            let tile = lattice((u / 0.25 + 0.5 * (row % 2.0)).floor() as i64, row as i64, salt ^ 11) - 0.5;
            let vent = dots(u, v, 2.3, salt ^ 12);
            let red = 0.6 + 0.4 * lattice(0, 0, salt ^ 13);
            shade([190.0 * red, 105.0, 80.0 + 40.0 * (1.0 - red)], 0.5 * detail + 0.25 * tile + 0.8 * vent)
        }
        Material::Wall => wall(u, v, detail, salt),
    }
}

fn ground(u: f64, v: f64, detail: f64, salt: u64) -> [u8; 3] {
    let to_street = |w: f64| (w.rem_euclid(BLOCK_M) - BLOCK_M / 2.0).abs();
    let (du, dv) = (to_street(u), to_street(v));
    let distance = du.min(dv);
    if distance < HALF_STREET_M {
        let along = if du < dv { v } else { u };
        let dash = distance < 0.12 && along.rem_euclid(4.0) < 1.7;
        let patch = if lattice((u / 2.1).floor() as i64, (v / 3.3).floor() as i64, salt ^ 5) < 0.16 {
            -0.25
        } else {
            0.0
        };
        let base = if dash { [215.0; 3] } else { [105.0, 105.0, 110.0] };
        return shade(base, 0.45 * detail + patch + 0.5 * dots(u, v, 1.9, salt ^ 6));
    }
    if distance < HALF_STREET_M + 1.2 {
        let slab = lattice((u / 0.6).floor() as i64, (v / 0.6).floor() as i64, salt ^ 7) - 0.5;
        return shade([165.0, 160.0, 150.0], 0.3 * detail + 0.3 * slab);
    }
    let dry = noise(u, v, 14.0, salt ^ 8);
    let bush = dots(u, v, 3.1, salt ^ 9) + 0.7 * dots(u + 7.7, v - 3.1, 1.1, salt ^ 10);
    shade([80.0 + 60.0 * dry, 125.0, 65.0], 0.9 * detail + 0.6 * bush)
}

fn wall(u: f64, v: f64, detail: f64, salt: u64) -> [u8; 3] {
    let tint = lattice(1, 0, salt ^ 14);
    let (column, floor) = ((u / 2.4).floor(), (v / 2.8).floor());
    let (x, y) = (u / 2.4 - column, v / 2.8 - floor);
    if (0.3..0.7).contains(&x) && (0.35..0.8).contains(&y) {
        let glass = lattice(column as i64, floor as i64, salt ^ 15);
        let frame = if (x - 0.5).abs() < 0.02 { 0.8 } else { 0.0 };
        return shade([60.0 + 70.0 * glass, 75.0 + 60.0 * glass, 90.0 + 60.0 * glass], 0.3 * detail + frame);
    }
    shade([200.0, 180.0 + 30.0 * tint, 150.0 + 60.0 * tint], 0.45 * detail + 0.3 * dots(u, v, 1.3, salt ^ 16))
}
