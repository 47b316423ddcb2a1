//! Scenes for tests: overlapping rectangles and blobs, drawn under any similarity.

use crate::image::GrayImage;

struct Rectangle {
    x: f64,
    y: f64,
    half_width: f64,
    half_height: f64,
    cosine: f64,
    sine: f64,
    grey: f64,
}

/// Rectangles, later ones over earlier ones, in a square from (0, 0) to (side, side).
pub(crate) struct Scene {
    rectangles: Vec<Rectangle>,
}

/// A rotation with scale as a complex number, then a shift.
#[derive(Clone, Copy)]
pub(crate) struct Similarity {
    rotation: (f64, f64),
    shift: (f64, f64),
}

impl Similarity {
    /// Turns by an angle and scales about the middle of a square, and shifts by fractions of a pixel.
    pub(crate) fn about_middle(side: f64, angle_rad: f64, scale: f64) -> Self {
        let rotation = (scale * angle_rad.cos(), scale * angle_rad.sin());
        let turned = Self { rotation, shift: (0.0, 0.0) }.apply((0.5 * side, 0.5 * side));
        let shift = if scale == 1.0 && angle_rad == 0.0 { (0.0, 0.0) } else { (0.37, -0.19) };
        Self { rotation, shift: (0.5 * side - turned.0 + shift.0, 0.5 * side - turned.1 + shift.1) }
    }

    pub(crate) fn apply(&self, (x, y): (f64, f64)) -> (f64, f64) {
        let (c, s) = self.rotation;
        (c * x - s * y + self.shift.0, s * x + c * y + self.shift.1)
    }

    fn invert(&self, (x, y): (f64, f64)) -> (f64, f64) {
        let (c, s) = self.rotation;
        let (x, y, squared) = (x - self.shift.0, y - self.shift.1, c * c + s * s);
        ((c * x + s * y) / squared, (c * y - s * x) / squared)
    }
}

impl Scene {
    /// `count` rectangles in a square of that side.
    pub(crate) fn random(count: usize, side: f64, seed: u64) -> Self {
        let mut state = seed;
        let mut uniform = move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as f64 / f64::from(1_u32 << 31)
        };
        let rectangles = (0..count).map(|_| {
            let angle = 3.0 * uniform();
            let size = 3.0 * 8.0_f64.powf(uniform() * uniform());
            Rectangle {
                x: side * uniform(),
                y: side * uniform(),
                half_width: size * (0.5 + uniform()),
                half_height: size * (0.5 + uniform()),
                cosine: angle.cos(),
                sine: angle.sin(),
                grey: 30.0 + 190.0 * uniform(),
            }
        });
        let mut rectangles: Vec<Rectangle> = rectangles.collect();
        rectangles.sort_by(|a, b| (b.half_width * b.half_height).total_cmp(&(a.half_width * a.half_height)));
        Self { rectangles }
    }

    fn grey_at(&self, (x, y): (f64, f64)) -> f64 {
        let covers = |r: &&Rectangle| {
            let (dx, dy) = (x - r.x, y - r.y);
            (r.cosine * dx + r.sine * dy).abs() < r.half_width
                && (r.cosine * dy - r.sine * dx).abs() < r.half_height
        };
        self.rectangles.iter().rev().find(covers).map_or(120.0, |rectangle| rectangle.grey)
    }

    /// What a camera sees: the mean over each pixel, then a blur of `blur_px` pixels.
    pub(crate) fn draw(&self, side: usize, image_from_scene: &Similarity, blur_px: f64) -> GrayImage {
        const SAMPLES: usize = 3;
        let mut values = vec![0.0; side * side];
        for (at, value) in values.iter_mut().enumerate() {
            for sample in 0..SAMPLES * SAMPLES {
                let offset = |k: usize| (k as f64 + 0.5) / SAMPLES as f64;
                let x = (at % side) as f64 + offset(sample % SAMPLES);
                let y = (at / side) as f64 + offset(sample / SAMPLES);
                *value += self.grey_at(image_from_scene.invert((x, y))) / (SAMPLES * SAMPLES) as f64;
            }
        }
        let values = blurred(&values, side, blur_px.max(0.5));
        let data = values.into_iter().map(|value| value.round().clamp(0.0, 255.0) as u8).collect();
        GrayImage { width: side, height: side, data }
    }
}

fn blurred(values: &[f64], side: usize, sigma_px: f64) -> Vec<f64> {
    let radius = (4.0 * sigma_px).ceil() as isize;
    let weights: Vec<f64> =
        (-radius..=radius).map(|k| (-0.5 * (k as f64 / sigma_px).powi(2)).exp()).collect();
    let sum: f64 = weights.iter().sum();
    let along = |values: &[f64], across: bool| -> Vec<f64> {
        let at = |k: usize| {
            let (x, y) = ((k % side) as isize, (k / side) as isize);
            let inside = |v: isize| v.clamp(0, side as isize - 1) as usize;
            let value = |d: isize| match across {
                true => values[y as usize * side + inside(x + d)],
                false => values[inside(y + d) * side + x as usize],
            };
            (-radius..=radius).zip(&weights).map(|(d, weight)| weight * value(d)).sum::<f64>() / sum
        };
        (0..side * side).map(at).collect()
    };
    along(&along(values, true), false)
}
