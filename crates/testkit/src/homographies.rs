//! Pictures under known homographies, and how well features follow them.
//!
//! Real photographs are warped, blurred, dimmed and made noisy, so that where each point of the first picture lies in the
//! second is known exactly. The measures are those of Mikolajczyk & Schmid (2005): repeatability and matching score.
//! Every picture, the first included, gets sensor noise of its own, for noise that is warped along would be repeatable
//! texture.

use nalgebra::{Matrix3, Vector3};
use terrane_scene::{Features, Keypoint};

/// One channel of eight bits, row after row.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Picture {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `width * height` values.
    pub pixels: Vec<u8>,
}

impl Picture {
    /// The middle of a picture, at most `width` by `height`.
    pub fn middle(&self, width: usize, height: usize) -> Self {
        let (width, height) = (width.min(self.width), height.min(self.height));
        let (left, top) = ((self.width - width) / 2, (self.height - height) / 2);
        let rows = (top..top + height).map(|y| &self.pixels[y * self.width + left..][..width]);
        Self { width, height, pixels: rows.flatten().copied().collect() }
    }

    /// Bicubic interpolation (Catmull & Rom 1974) at a point whose coordinates are (0.5, 0.5) at the first pixel's centre;
    /// border pixels are repeated.
    fn at(&self, x: f64, y: f64) -> f64 {
        let (x, y) = (x - 0.5, y - 0.5);
        let (column, row) = (x.floor(), y.floor());
        let (across, down) = (catmull_rom(x - column), catmull_rom(y - row));
        let pixel =
            |at: f64, k: usize, len: usize| (at + k as f64 - 1.0).clamp(0.0, len as f64 - 1.0) as usize;
        let columns: [usize; 4] = std::array::from_fn(|k| pixel(column, k, self.width));
        (0..4)
            .map(|j| {
                let line = &self.pixels[pixel(row, j, self.height) * self.width..];
                let sum: f64 = (0..4).map(|k| across[k] * f64::from(line[columns[k]])).sum();
                down[j] * sum
            })
            .sum()
    }
}

fn catmull_rom(t: f64) -> [f64; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [
        0.5 * (-t3 + 2.0 * t2 - t),
        0.5 * (3.0 * t3 - 5.0 * t2 + 2.0),
        0.5 * (-3.0 * t3 + 4.0 * t2 + t),
        0.5 * (t3 - t2),
    ]
}

/// What the second picture is to the first.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Condition {
    /// Its name in tables.
    pub name: &'static str,
    /// Rotation in the plane, degrees.
    pub turn_deg: f64,
    /// How much larger things are in the second picture.
    pub scale: f64,
    /// Tilt of the plane about its vertical axis, degrees, seen with a focal length of the picture's width.
    pub tilt_deg: f64,
    /// Standard deviation of a Gaussian blur, pixels of the second picture.
    pub blur_px: f64,
    /// Standard deviation of the sensor's noise, greys.
    pub noise_greys: f64,
    /// What brightness is multiplied by.
    pub gain: f64,
}

/// Noise of the first picture and, unless a condition says otherwise, of the second, in greys.
pub const SENSOR_NOISE_GREYS: f64 = 1.5;

/// The conditions that detectors are compared under.
pub fn conditions() -> Vec<Condition> {
    let plain = Condition {
        name: "same view",
        turn_deg: 0.0,
        scale: 1.0,
        tilt_deg: 0.0,
        blur_px: 0.0,
        noise_greys: SENSOR_NOISE_GREYS,
        gain: 1.0,
    };
    vec![
        plain,
        Condition { name: "turn 15°", turn_deg: 15.0, ..plain },
        Condition { name: "turn 45°", turn_deg: 45.0, ..plain },
        Condition { name: "turn 100°", turn_deg: 100.0, ..plain },
        Condition { name: "scale 1.4", scale: 1.4, ..plain },
        Condition { name: "scale 0.7", scale: 0.7, ..plain },
        Condition { name: "scale 0.5, turn 30°", scale: 0.5, turn_deg: 30.0, ..plain },
        Condition { name: "blur 1 px", blur_px: 1.0, ..plain },
        Condition { name: "blur 2 px", blur_px: 2.0, ..plain },
        Condition { name: "noise 6 greys", noise_greys: 6.0, ..plain },
        Condition { name: "noise 12 greys", noise_greys: 12.0, ..plain },
        Condition { name: "half the light", gain: 0.5, ..plain },
        Condition { name: "tilt 25°", tilt_deg: 25.0, ..plain },
        Condition { name: "tilt 40°", tilt_deg: 40.0, ..plain },
        Condition { name: "tilt 55°", tilt_deg: 55.0, ..plain },
    ]
}

impl Condition {
    /// Columns and rows of the second picture.
    pub fn size(&self, width: usize, height: usize) -> (usize, usize) {
        let scaled = |len: usize| ((len as f64 * self.scale).round() as usize).max(1);
        (scaled(width), scaled(height))
    }

    /// Maps points of a first picture of a size to the second, middle to middle. Both in pixels.
    pub fn second_from_first(&self, width: usize, height: usize) -> Matrix3<f64> {
        let (w, h) = (width as f64, height as f64);
        let to_middle = Matrix3::new(1.0, 0.0, -0.5 * w, 0.0, 1.0, -0.5 * h, 0.0, 0.0, 1.0);
        let (turn_sin, turn_cos) = self.turn_deg.to_radians().sin_cos();
        let turn = Matrix3::new(turn_cos, -turn_sin, 0.0, turn_sin, turn_cos, 0.0, 0.0, 0.0, 1.0);
        let (tilt_sin, tilt_cos) = self.tilt_deg.to_radians().sin_cos();
        let tilt = Matrix3::new(tilt_cos, 0.0, 0.0, 0.0, 1.0, 0.0, tilt_sin / w, 0.0, 1.0);
        let s = self.scale;
        let (out_width, out_height) = self.size(width, height);
        let back =
            Matrix3::new(s, 0.0, 0.5 * out_width as f64, 0.0, s, 0.5 * out_height as f64, 0.0, 0.0, 1.0);
        back * tilt * turn * to_middle
    }

    /// The second picture. `seed` is that of its noise.
    pub fn render(&self, first: &Picture, seed: u64) -> Picture {
        let (width, height) = self.size(first.width, first.height);
        let Some(first_from_second) = self.second_from_first(first.width, first.height).try_inverse() else {
            return Picture { width, height, pixels: vec![0; width * height] };
        };
        let values = warped(first, &first_from_second, (width, height));
        let values = blurred(&values, (width, height), self.blur_px);
        let mut noise = Noise(seed);
        let pixels = values.iter().map(|v| self.gain * v + self.noise_greys * noise.next());
        Picture { width, height, pixels: pixels.map(|v| v.round().clamp(0.0, 255.0) as u8).collect() }
    }
}

/// Each pixel is the mean of as many samples as it covers pixels of the first picture, along both of its axes.
fn warped(first: &Picture, first_from_second: &Matrix3<f64>, (width, height): (usize, usize)) -> Vec<f64> {
    let mut values = Vec::with_capacity(width * height);
    for y in 0..height {
        for x in 0..width {
            let (x, y) = (x as f64 + 0.5, y as f64 + 0.5);
            let center = project(first_from_second, x, y);
            let steps = [(1.0, 0.0), (0.0, 1.0)].map(|(dx, dy)| {
                let next = project(first_from_second, x + dx, y + dy);
                ((next.0 - center.0).hypot(next.1 - center.1) - 0.05).ceil().clamp(1.0, 8.0) as usize
            });
            let mut sum = 0.0;
            for i in 0..steps[0] {
                for j in 0..steps[1] {
                    let offset = |k: usize, n: usize| (k as f64 + 0.5) / n as f64 - 0.5;
                    let at = project(first_from_second, x + offset(i, steps[0]), y + offset(j, steps[1]));
                    sum += first.at(at.0, at.1);
                }
            }
            values.push(sum / (steps[0] * steps[1]) as f64);
        }
    }
    values
}

fn project(homography: &Matrix3<f64>, x: f64, y: f64) -> (f64, f64) {
    let mapped = homography * Vector3::new(x, y, 1.0);
    (mapped.x / mapped.z, mapped.y / mapped.z)
}

fn blurred(values: &[f64], (width, height): (usize, usize), sigma_px: f64) -> Vec<f64> {
    if sigma_px <= 0.0 {
        return values.to_vec();
    }
    let radius = (4.0 * sigma_px).ceil() as isize;
    let weights: Vec<f64> =
        (-radius..=radius).map(|k| (-0.5 * (k as f64 / sigma_px).powi(2)).exp()).collect();
    let sum: f64 = weights.iter().sum();
    let along = |values: &[f64], step: (isize, isize)| -> Vec<f64> {
        let at = |x: isize, y: isize| {
            values[y.clamp(0, height as isize - 1) as usize * width + x.clamp(0, width as isize - 1) as usize]
        };
        (0..(width * height) as isize)
            .map(|k| {
                let (x, y) = (k % width as isize, k / width as isize);
                let taps = weights.iter().zip(-radius..);
                taps.map(|(w, d)| w * at(x + d * step.0, y + d * step.1)).sum::<f64>() / sum
            })
            .collect()
    };
    along(&along(values, (1, 0)), (0, 1))
}

/// Normal deviates: sums of twelve uniform ones (splitmix64: Steele et al. 2014).
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> f64 {
        (0..6).map(|_| self.two_uniform()).sum::<f64>() - 6.0
    }

    fn two_uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^= z >> 31;
        ((z >> 32) as f64 + (z & 0xffff_ffff) as f64) / 4_294_967_296.0
    }
}

/// Greatest distance of a feature from where it should be, pixels of the coarser of both pictures.
const TOLERANCE_PX: f64 = 2.0;
/// Greatest ratio of a feature's scale to what it should be.
const SCALE_RATIO: f64 = 1.5;
/// Features nearer to a border of the other picture than this are not counted.
const BORDER_PX: f64 = 16.0;

/// How features followed a homography.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Score {
    /// Places of features in the part that both pictures show; the smaller count of the two. Features at one place and of
    /// one scale are one: a blob with two orientations or found in two octaves gives one observation.
    pub shown: usize,
    /// Of these, those that were found in both, at the same place and scale, one to one.
    pub repeated: usize,
    /// Matches within that part, of right ones one a place.
    pub matched: usize,
    /// Of these, those that are at the right place.
    pub correct: usize,
    /// Median distance of a right match from its place in pixels.
    pub median_error_px: f64,
}

impl Score {
    /// Share of features that were found again.
    pub fn repeatability(&self) -> f64 {
        self.repeated as f64 / self.shown.max(1) as f64
    }

    /// Share of features that were matched rightly.
    pub fn matching_score(&self) -> f64 {
        self.correct as f64 / self.shown.max(1) as f64
    }

    /// Share of matches that are right.
    pub fn precision(&self) -> f64 {
        self.correct as f64 / self.matched.max(1) as f64
    }
}

/// Scores the features and matches (indices into `first` and `second`) of two pictures of the given sizes.
pub fn score(
    (first, first_size): (&Features, (usize, usize)),
    (second, second_size): (&Features, (usize, usize)),
    matches: &[(u32, u32)],
    second_from_first: &Matrix3<f64>,
) -> Score {
    let Some(first_from_second) = second_from_first.try_inverse() else { return Score::default() };
    let first_places = Places::new(first, second_from_first, second_size);
    let second_places = Places::new(second, &first_from_second, first_size);
    let shown = first_places.count().min(second_places.count());
    let mut errors_px = Vec::new();
    let mut matched = 0;
    let mut used = std::collections::BTreeSet::new();
    for &(a, b) in matches {
        let Some(mapped) = first_places.mapped[a as usize] else { continue };
        let (first_place, second_place) = (first_places.place[a as usize], second_places.place[b as usize]);
        let error_px = mapped.distance_px(&second.keypoints[b as usize]);
        if error_px > TOLERANCE_PX {
            matched += 1;
        } else if used.insert((false, first_place)) && used.insert((true, second_place)) {
            matched += 1;
            errors_px.push(error_px);
        }
    }
    errors_px.sort_by(f64::total_cmp);
    Score {
        shown,
        repeated: repeated(&first_places, &second_places, second),
        matched,
        correct: errors_px.len(),
        median_error_px: errors_px.get(errors_px.len() / 2).copied().unwrap_or(0.0),
    }
}

/// A feature of one picture as it should be in the other.
#[derive(Clone, Copy)]
struct Mapped {
    x_px: f64,
    y_px: f64,
    scale_px: f64,
    /// How much larger things are in the other picture.
    scale: f64,
}

impl Mapped {
    fn distance_px(&self, keypoint: &Keypoint) -> f64 {
        (f64::from(keypoint.x_px) - self.x_px).hypot(f64::from(keypoint.y_px) - self.y_px)
            / self.scale.max(1.0)
    }
}

/// Where a picture's features should be in the other; `None` outside of it.
struct Places {
    mapped: Vec<Option<Mapped>>,
    /// The first feature that stands at the same place and has the same scale.
    place: Vec<usize>,
}

impl Places {
    fn new(features: &Features, map: &Matrix3<f64>, (width, height): (usize, usize)) -> Self {
        let inside = |at: f64, len: usize| (BORDER_PX..len as f64 - BORDER_PX).contains(&at);
        let mapped = features.keypoints.iter().map(|keypoint| {
            let (x, y) = (f64::from(keypoint.x_px), f64::from(keypoint.y_px));
            let (x_px, y_px) = project(map, x, y);
            let (right, below) = (project(map, x + 0.5, y), project(map, x, y + 0.5));
            let area =
                4.0 * ((right.0 - x_px) * (below.1 - y_px) - (right.1 - y_px) * (below.0 - x_px)).abs();
            let scale = area.sqrt();
            let is_inside = inside(x_px, width) && inside(y_px, height);
            is_inside.then(|| Mapped { x_px, y_px, scale_px: scale * f64::from(keypoint.scale_px), scale })
        });
        let mapped = mapped.collect();
        Self { mapped, place: first_at_place(&features.keypoints) }
    }

    fn count(&self) -> usize {
        self.places().count()
    }

    fn places(&self) -> impl Iterator<Item = (usize, &Mapped)> {
        let all = self.mapped.iter().enumerate().filter(|(k, _)| self.place[*k] == *k);
        all.filter_map(|(k, mapped)| Some((k, mapped.as_ref()?)))
    }
}

/// Places that were found in both pictures, nearest first and each once.
fn repeated(first: &Places, second: &Places, second_features: &Features) -> usize {
    const CELL_PX: f64 = 8.0;
    let cell = |x: f64, y: f64| ((y / CELL_PX).floor() as i64, (x / CELL_PX).floor() as i64);
    let mut grid: std::collections::BTreeMap<(i64, i64), Vec<usize>> = std::collections::BTreeMap::new();
    for (k, _) in second.places() {
        let keypoint = &second_features.keypoints[k];
        grid.entry(cell(f64::from(keypoint.x_px), f64::from(keypoint.y_px))).or_default().push(k);
    }
    let mut candidates = Vec::new();
    for (k, mapped) in first.places() {
        let (row, column) = cell(mapped.x_px, mapped.y_px);
        let around = (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (row + dy, column + dx)));
        for &other in around.filter_map(|cell| grid.get(&cell)).flatten() {
            let keypoint = &second_features.keypoints[other];
            let distance_px = mapped.distance_px(keypoint);
            let ratio = mapped.scale_px / f64::from(keypoint.scale_px);
            if distance_px <= TOLERANCE_PX && (1.0 / SCALE_RATIO..=SCALE_RATIO).contains(&ratio) {
                candidates.push((distance_px, k, other));
            }
        }
    }
    candidates.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)).then(a.2.cmp(&b.2)));
    let (mut used_first, mut used_second) =
        (vec![false; first.mapped.len()], vec![false; second.mapped.len()]);
    let mut count = 0;
    for (_, a, b) in candidates {
        if !used_first[a] && !used_second[b] {
            (used_first[a], used_second[b]) = (true, true);
            count += 1;
        }
    }
    count
}

/// How many places features stand at; see [`Score::shown`].
pub fn num_places(features: &Features) -> usize {
    first_at_place(&features.keypoints).iter().enumerate().filter(|(k, first)| k == *first).count()
}

/// Of each keypoint the first one that is within a pixel and of nearly the same scale, itself if there is none before.
fn first_at_place(keypoints: &[Keypoint]) -> Vec<usize> {
    const SAME_PX: f32 = 1.0;
    const SAME_SCALE: f32 = 1.2;
    let cell = |k: &Keypoint| ((k.y_px / SAME_PX).floor() as i64, (k.x_px / SAME_PX).floor() as i64);
    let mut grid: std::collections::BTreeMap<(i64, i64), Vec<usize>> = std::collections::BTreeMap::new();
    let mut place = Vec::with_capacity(keypoints.len());
    for (index, keypoint) in keypoints.iter().enumerate() {
        let (row, column) = cell(keypoint);
        let around = (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (row + dy, column + dx)));
        let is_same = |other: &&usize| {
            let other = &keypoints[**other];
            let ratio = other.scale_px / keypoint.scale_px;
            (other.x_px - keypoint.x_px).hypot(other.y_px - keypoint.y_px) < SAME_PX
                && (1.0 / SAME_SCALE..SAME_SCALE).contains(&ratio)
        };
        let first = around.filter_map(|cell| grid.get(&cell)).flatten().filter(is_same).min().copied();
        place.push(first.unwrap_or(index));
        if first.is_none() {
            grid.entry((row, column)).or_default().push(index);
        }
    }
    place
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture() -> Picture {
        let (width, height) = (120, 90);
        let value = |k: usize| {
            let (x, y) = ((k % width) as f64 + 0.5, (k / width) as f64 + 0.5);
            (128.0 + 60.0 * (0.21 * x).sin() * (0.17 * y + 0.05 * x).cos()).round() as u8
        };
        Picture { width, height, pixels: (0..width * height).map(value).collect() }
    }

    #[test]
    fn pictures_show_what_the_map_says() {
        let first = picture();
        for condition in conditions().iter().filter(|c| c.blur_px == 0.0 && c.gain == 1.0) {
            let quiet = Condition { noise_greys: 0.0, ..*condition };
            let second = quiet.render(&first, 1);
            let map = quiet.second_from_first(first.width, first.height);
            let mut worst = 0.0_f64;
            for (x, y) in [(60.0, 45.0), (50.0, 40.0), (70.0, 52.0), (45.0, 50.0)] {
                let (u, v) = project(&map, x, y);
                worst = worst.max((first.at(x, y) - second.at(u, v)).abs());
            }
            // A pixel of half the scale is the mean over two.
            assert!(worst < 5.0, "{}: {worst}", condition.name);
        }
    }

    #[test]
    fn noise_has_its_deviation() {
        let mut noise = Noise(3);
        let values: Vec<f64> = (0..20_000).map(|_| noise.next()).collect();
        let mean = values.iter().sum::<f64>() / 20_000.0;
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 20_000.0;
        assert!(mean.abs() < 0.03 && (0.97..1.03).contains(&variance), "{mean} {variance}");
    }

    #[test]
    fn perfect_features_score_one() {
        let keypoint = |k: usize| Keypoint {
            x_px: 20.3 + 9.0 * (k % 9) as f32,
            y_px: 20.9 + 9.0 * (k / 9) as f32,
            scale_px: 2.0,
            orientation_rad: 0.0,
        };
        let first = Features { keypoints: (0..45).map(keypoint).collect(), ..Features::default() };
        let map = Matrix3::new(1.0, 0.0, 2.0, 0.0, 1.0, -1.0, 0.0, 0.0, 1.0);
        let mut second = first.clone();
        for keypoint in &mut second.keypoints {
            (keypoint.x_px, keypoint.y_px) = (keypoint.x_px + 2.0, keypoint.y_px - 1.0);
        }
        let size = (120, 90);
        let matches: Vec<(u32, u32)> = (0..45).map(|k| (k, k)).collect();
        let perfect = score((&first, size), (&second, size), &matches, &map);
        assert_eq!((perfect.shown, perfect.repeated, perfect.matched, perfect.correct), (45, 45, 45, 45));
        let wrong: Vec<(u32, u32)> = (0..45).map(|k| (k, 44 - k)).collect();
        let wrong = score((&first, size), (&second, size), &wrong, &map);
        assert_eq!((wrong.matched, wrong.correct), (45, 1));
    }
}
