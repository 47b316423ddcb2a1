//! Corners where two dark and two bright sectors meet: found by the Hessian, proven on a ring, placed to fractions of a pixel.
//!
//! The determinant of the Hessian is negative at such a saddle (Chen & Zhang 2005). Samples on a ring around it change
//! side four times, opposite to each other, as in ChESS (Bennett & Lasenby 2014). The place is where all gradients around
//! it are orthogonal to the direction towards it (Förstner & Gülch 1987).

use std::f64::consts::{PI, TAU};

use nalgebra::{Matrix2, Vector2};
use rayon::prelude::*;

use super::gray::FloatImage;

/// A corner of four sectors.
#[derive(Clone, Debug)]
pub(super) struct Saddle {
    pub xy_px: Vector2<f64>,
    /// Directions of the four edges that meet, ascending within [0, 2π), from x towards y.
    pub rays_rad: [f64; 4],
    /// Whether the sector between the first and the second ray is bright.
    pub first_is_bright: bool,
    /// Difference between bright and dark, in greys.
    pub contrast: f64,
}

impl Saddle {
    /// Whether the sector between ray `k` and the next is bright.
    pub fn is_bright(&self, k: usize) -> bool {
        self.first_is_bright == k.is_multiple_of(2)
    }
}

/// Negated determinants of the Hessian below this, in squared greys per pixel to the fourth, are noise: a contrast of about ten
/// greys.
const MIN_RESPONSE: f32 = 1.0;

/// Fewest greys between bright and dark sectors.
const MIN_CONTRAST: f64 = 12.0;

/// Radii of the rings that are tried, in pixels: below half the narrowest square that is found.
const RING_RADII_PX: [f64; 3] = [5.0, 3.5, 2.5];

/// Most saddles of a picture: linking takes the square of it. The strongest are kept.
const MAX_SADDLES: usize = 4000;

/// A picture at one resolution, as saddles are looked for in it.
pub(super) struct Level {
    /// Smoothed by one pixel.
    pub fine: FloatImage,
    /// Smoothed by about one and a half.
    coarse: FloatImage,
}

impl Level {
    pub fn new(image: &FloatImage) -> Self {
        let fine = image.smoothed();
        let coarse = fine.smoothed();
        Self { fine, coarse }
    }

    /// All saddles, in the order of their rows.
    pub fn saddles(&self) -> Vec<Saddle> {
        let (width, height) = (self.coarse.width, self.coarse.height);
        if width < 16 || height < 16 {
            return Vec::new();
        }
        let mut response = vec![0.0f32; width * height];
        response.par_chunks_mut(width).enumerate().for_each(|(y, out)| {
            if y == 0 || y + 1 >= height {
                return;
            }
            for x in 1..width - 1 {
                let (xx, xy, yy) = hessian(&self.coarse, x, y);
                out[x] = xy * xy - xx * yy;
            }
        });
        let rows: Vec<Vec<(f32, Saddle)>> =
            (3..height - 3).into_par_iter().map(|y| self.saddles_of_row(&response, y)).collect();
        let mut found: Vec<(f32, Saddle)> = rows.into_iter().flatten().collect();
        if found.len() > MAX_SADDLES {
            found.sort_by(|a, b| b.0.total_cmp(&a.0));
            found.truncate(MAX_SADDLES);
        }
        found.into_iter().map(|(_, saddle)| saddle).collect()
    }

    fn saddles_of_row(&self, response: &[f32], y: usize) -> Vec<(f32, Saddle)> {
        let width = self.coarse.width;
        let mut found = Vec::new();
        for x in 3..width - 3 {
            let value = response[y * width + x];
            if value < MIN_RESPONSE {
                continue;
            }
            // Of equal neighbours the first is taken.
            let is_peak = (y - 2..=y + 2).all(|v| {
                (x - 2..=x + 2).all(|u| {
                    let other = response[v * width + u];
                    (v, u) == (y, x) || other < value || (other == value && (v, u) > (y, x))
                })
            });
            if is_peak && let Some(saddle) = self.saddle_near(&Vector2::new(x as f64 + 0.5, y as f64 + 0.5)) {
                found.push((value, saddle));
            }
        }
        found
    }

    /// The saddle at a point or within a pixel or two of it.
    pub fn saddle_near(&self, xy_px: &Vector2<f64>) -> Option<Saddle> {
        let center = self.stationary_point(xy_px)?;
        RING_RADII_PX.iter().find_map(|&radius_px| self.on_ring(&center, radius_px))
    }

    /// Where the gradient vanishes, by one step of Newton's method.
    fn stationary_point(&self, xy_px: &Vector2<f64>) -> Option<Vector2<f64>> {
        if !self.coarse.holds(xy_px, 3.0) {
            return None;
        }
        let (x, y) = (xy_px.x as usize, xy_px.y as usize);
        let (xx, xy, yy) = hessian(&self.coarse, x, y);
        let gradient = gradient(&self.coarse, x, y);
        let hessian = Matrix2::new(xx, xy, xy, yy).map(f64::from);
        let step = hessian.try_inverse()? * -gradient;
        let at = Vector2::new(x as f64 + 0.5, y as f64 + 0.5);
        (hessian.determinant() < 0.0 && step.norm() < 2.0).then(|| at + step)
    }

    /// Four changes of side around a point, opposite to each other.
    fn on_ring(&self, center: &Vector2<f64>, radius_px: f64) -> Option<Saddle> {
        const COUNT: usize = 40;
        if !self.fine.holds(center, radius_px + 0.5) {
            return None;
        }
        let angle = |i: f64| TAU * i / COUNT as f64;
        let values: [f64; COUNT] = std::array::from_fn(|i| {
            let (sine, cosine) = angle(i as f64).sin_cos();
            self.fine.sample(&(center + radius_px * Vector2::new(cosine, sine)))
        });
        let (low, high) = values.iter().fold((f64::MAX, f64::MIN), |(l, h), &v| (l.min(v), h.max(v)));
        if high - low < MIN_CONTRAST {
            return None;
        }
        let middle = 0.5 * (low + high);
        let mut changes = Vec::with_capacity(4);
        for i in 0..COUNT {
            let (here, next) = (values[i] - middle, values[(i + 1) % COUNT] - middle);
            if (here < 0.0) != (next < 0.0) {
                changes.push((i, angle(i as f64 + here / (here - next)) % TAU));
                if changes.len() > 4 {
                    return None;
                }
            }
        }
        let rays: [(usize, f64); 4] = changes.try_into().ok()?;
        let mut rays_rad = rays.map(|(_, angle)| angle);
        let straight = |a: f64, b: f64| (b - a - PI).abs() < 0.5;
        let narrow = (0..4).any(|k| (rays_rad[(k + 1) % 4] - rays_rad[k]).rem_euclid(TAU) < 0.35);
        if narrow || !straight(rays_rad[0], rays_rad[2]) || !straight(rays_rad[1], rays_rad[3]) {
            return None;
        }
        // The mean of each sector, between its rays.
        let means: [f64; 4] = std::array::from_fn(|k| {
            let (from, to) = (rays[k].0 + 1, rays[(k + 1) % 4].0 + if k == 3 { COUNT } else { 0 });
            let sum: f64 = (from..=to).map(|i| values[i % COUNT]).sum();
            sum / (to + 1 - from) as f64
        });
        let first_is_bright = means[0] > middle;
        let (even, odd) = ([means[0], means[2]], [means[1], means[3]]);
        let (bright, dark) = if first_is_bright { (even, odd) } else { (odd, even) };
        let contrast = bright[0].min(bright[1]) - dark[0].max(dark[1]);
        if contrast < 0.35 * (high - low) {
            return None;
        }
        // Both ends of an edge tell its direction.
        for k in 0..2 {
            let off = rays_rad[k + 2] - rays_rad[k] - PI;
            rays_rad[k] += 0.5 * off;
            rays_rad[k + 2] -= 0.5 * off;
        }
        Some(Saddle { xy_px: *center, rays_rad, first_is_bright, contrast })
    }
}

#[inline]
fn hessian(image: &FloatImage, x: usize, y: usize) -> (f32, f32, f32) {
    let xx = image.at(x + 1, y) - 2.0 * image.at(x, y) + image.at(x - 1, y);
    let yy = image.at(x, y + 1) - 2.0 * image.at(x, y) + image.at(x, y - 1);
    let xy =
        image.at(x + 1, y + 1) - image.at(x - 1, y + 1) - image.at(x + 1, y - 1) + image.at(x - 1, y - 1);
    (xx, 0.25 * xy, yy)
}

#[inline]
fn gradient(image: &FloatImage, x: usize, y: usize) -> Vector2<f64> {
    let across = image.at(x + 1, y) - image.at(x - 1, y);
    let down = image.at(x, y + 1) - image.at(x, y - 1);
    Vector2::new(f64::from(across), f64::from(down)) * 0.5
}

/// The point to which the gradients within `radius_px` are orthogonal, from a point near it; `None` when it runs away by more
/// than `radius_px` or the window leaves the image.
///
/// The window follows the point, so that noise, which is the same all around, does not pull it.
pub(super) fn refined(image: &FloatImage, start: &Vector2<f64>, radius_px: f64) -> Option<Vector2<f64>> {
    const MAX_STEPS: usize = 30;
    let mut at = *start;
    for _ in 0..MAX_STEPS {
        if !image.holds(&at, radius_px + 2.0) {
            return None;
        }
        let (mut sum, mut right) = (Matrix2::zeros(), Vector2::zeros());
        let range = |c: f64| (c - radius_px - 0.5).floor() as usize..=(c + radius_px - 0.5).ceil() as usize;
        for y in range(at.y) {
            for x in range(at.x) {
                let offset = Vector2::new(x as f64 + 0.5, y as f64 + 0.5) - at;
                let share = offset.norm_squared() / (radius_px * radius_px);
                if share >= 1.0 {
                    continue;
                }
                // Smooth to nothing at the rim, so that no pixel enters with a jump.
                let weight = (1.0 - share) * (1.0 - share);
                let g = gradient(image, x, y);
                let outer = weight * g * g.transpose();
                sum += outer;
                right += outer * offset;
            }
        }
        let step = sum.try_inverse()? * right;
        at += step;
        if !((at - start).norm() <= radius_px) {
            return None;
        }
        if step.norm() < 1e-4 {
            break;
        }
    }
    Some(at)
}
