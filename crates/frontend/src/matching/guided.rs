//! Matches along epipolar lines, or near transferred points, once the geometry of a pair is known.
//!
//! Each feature is compared only with those of the other image that the geometry allows. They are found by strips: across the
//! image in the direction of the line, each divided into cells, so that a line meets a few cells of every strip.
//! The ratio test is among the allowed ones, with a runner-up assumed at the greatest distance: fewer candidates make a
//! near runner-up less likely, and its absence must not count as proof.

use nalgebra::{Matrix3, Vector2};
use terrane_scene::DESCRIPTOR_LEN;

use super::{Match, MatchOptions};

/// Strips along each axis, and cells across each.
const STRIPS: usize = 80;

/// How much farther than the error a candidate may lie from the line: where the other image shows the scene larger, Sampson's
/// error is less than the distance.
const MAX_STRETCH: f64 = 3.0;

/// One image's features, of equal number.
#[derive(Clone, Copy, Debug)]
pub struct GuidedSide<'a> {
    /// Where they are, in the unit of the geometry; those that are not finite match nothing.
    pub positions: &'a [Vector2<f64>],
    /// [`DESCRIPTOR_LEN`] bytes each.
    pub descriptors: &'a [u8],
}

/// What is known of the pair.
#[derive(Clone, Copy, Debug)]
pub enum Guide {
    /// `second ᵀ M first = 0`: an essential or a fundamental matrix. The error is Sampson's.
    Epipolar(Matrix3<f64>),
    /// `second ∝ H first`, positive on its points: of a plane or a turn. The error is that of the transfer to the second.
    Homography(Matrix3<f64>),
}

/// Matches within `max_error` (in the unit of the positions) of the geometry, ascending in `first`. One thread; deterministic.
pub fn match_guided(
    first: &GuidedSide<'_>,
    second: &GuidedSide<'_>,
    guide: &Guide,
    max_error: f64,
    options: &MatchOptions,
) -> Vec<Match> {
    let first_descriptors = first.descriptors.as_chunks::<DESCRIPTOR_LEN>().0;
    let second_descriptors = second.descriptors.as_chunks::<DESCRIPTOR_LEN>().0;
    let num_first = first.positions.len().min(first_descriptors.len());
    let num_second = second.positions.len().min(second_descriptors.len());
    let Some(index) = Index::new(&second.positions[..num_second]) else { return Vec::new() };
    let widened: Vec<Wide> = second_descriptors[..num_second].iter().map(wide).collect();
    let norms: Vec<f32> = widened.iter().map(norm).collect();
    let search = Search::new(guide, second.positions, max_error);
    let mut rows = vec![Nearest::NONE; num_first];
    let mut columns = vec![Nearest::NONE; num_second];
    let mut candidates = Vec::new();
    for row in 0..num_first {
        candidates.clear();
        search.candidates(&index, &first.positions[row], &mut candidates);
        if candidates.is_empty() {
            continue;
        }
        let descriptor = wide(&first_descriptors[row]);
        let own_norm = norm(&descriptor);
        for &column in &candidates {
            let at = column as usize;
            let product = dot(&descriptor, &widened[at]) as f32;
            // The squared distance of the descriptors scaled to length one.
            let squared = 2.0 - 2.0 * product / (own_norm * norms[at]);
            rows[row].offer(column, squared);
            columns[at].offer(row as u32, squared);
        }
    }
    agreed(&rows, &columns, options)
}

/// Those that pass the tests.
fn agreed(rows: &[Nearest], columns: &[Nearest], options: &MatchOptions) -> Vec<Match> {
    let farthest = (options.max_distance * options.max_distance) as f32;
    let max_squared_ratio = (options.max_ratio * options.max_ratio) as f32;
    let mut matches = Vec::new();
    for (row, nearest) in rows.iter().enumerate() {
        let Some(squared_ratio) = nearest.squared_ratio(farthest) else { continue };
        let mut worse = squared_ratio;
        if options.mutual {
            let back = &columns[nearest.index as usize];
            let Some(back_ratio) = back.squared_ratio(farthest) else { continue };
            if back.index != row as u32 {
                continue;
            }
            worse = worse.max(back_ratio);
        }
        if worse <= max_squared_ratio {
            matches.push(Match { first: row as u32, second: nearest.index, ratio: worse.sqrt() });
        }
    }
    matches
}

/// The nearest of the allowed, by squared distance, and the distance of the second nearest.
#[derive(Clone, Copy)]
struct Nearest {
    index: u32,
    squared: f32,
    second_squared: f32,
}

impl Nearest {
    const NONE: Self = Self { index: u32::MAX, squared: f32::INFINITY, second_squared: f32::INFINITY };

    #[inline]
    fn offer(&mut self, index: u32, squared: f32) {
        if squared < self.squared {
            *self = Self { index, squared, second_squared: self.squared };
        } else if squared < self.second_squared {
            self.second_squared = squared;
        }
    }

    /// `None` without a neighbour, or for a tie, which is never a match.
    fn squared_ratio(&self, farthest: f32) -> Option<f32> {
        let second = self.second_squared.min(farthest);
        (self.index != u32::MAX && self.squared < second).then(|| (self.squared / second).max(0.0))
    }
}

/// A descriptor as it is multiplied: two products at a time are one instruction on every processor of the baseline.
type Wide = [i16; DESCRIPTOR_LEN];

fn wide(descriptor: &[u8; DESCRIPTOR_LEN]) -> Wide {
    descriptor.map(i16::from)
}

/// Length of a descriptor.
fn norm(descriptor: &Wide) -> f32 {
    (dot(descriptor, descriptor) as f32).sqrt()
}

/// Below 2²⁴, thus exact as a float.
#[inline]
fn dot(a: &Wide, b: &Wide) -> i32 {
    let chunks = a.as_chunks::<8>().0.iter().zip(b.as_chunks::<8>().0);
    // Integers: every order of sums gives the same.
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{__m128i, _mm_add_epi32, _mm_madd_epi16};
        let add = |sum, (x, y): (&[i16; 8], &[i16; 8])| {
            // SAFETY: every processor of this architecture has SSE2, which is all that these need.
            unsafe { _mm_add_epi32(sum, _mm_madd_epi16(bytemuck::cast(*x), bytemuck::cast(*y))) }
        };
        let sums: __m128i = chunks.fold(bytemuck::Zeroable::zeroed(), add);
        bytemuck::cast::<__m128i, [i32; 4]>(sums).iter().sum()
    }
    #[cfg(not(target_arch = "x86_64"))]
    chunks.map(|(x, y)| (0..8).map(|k| i32::from(x[k]) * i32::from(y[k])).sum::<i32>()).sum()
}

/// The features of an image by strips of x, and by strips of y.
struct Index {
    along: [Strips; 2],
}

struct Strips {
    /// Least coordinates, along the axis and across it.
    origin: [f64; 2],
    /// Width of a strip, and of a cell across it.
    width: [f64; 2],
    /// Where each cell begins in the entries, strip by strip.
    starts: Vec<u32>,
    /// Position and feature, cell by cell.
    entries: Vec<(Vector2<f64>, u32)>,
}

impl Index {
    /// `None` without any finite position.
    fn new(positions: &[Vector2<f64>]) -> Option<Self> {
        Some(Self { along: [Strips::new(positions, 0)?, Strips::new(positions, 1)?] })
    }
}

impl Strips {
    fn new(positions: &[Vector2<f64>], axis: usize) -> Option<Self> {
        let is_finite = |point: &Vector2<f64>| point.x.is_finite() && point.y.is_finite();
        let finite = || positions.iter().filter(|point| is_finite(point));
        let (mut origin, mut width) = ([0.0; 2], [0.0; 2]);
        for (k, axis) in [axis, 1 - axis].into_iter().enumerate() {
            origin[k] = finite().map(|point| point[axis]).reduce(f64::min)?;
            let end = finite().map(|point| point[axis]).reduce(f64::max)?;
            width[k] = ((end - origin[k]) / STRIPS as f64).max(f64::MIN_POSITIVE);
        }
        let mut strips = Self { origin, width, starts: vec![0; STRIPS * STRIPS + 1], entries: Vec::new() };
        let cell = |point: &Vector2<f64>| {
            let (along, across) = (strips.place(0, point[axis]), strips.place(1, point[1 - axis]));
            along * STRIPS + across
        };
        let mut order: Vec<(usize, u32)> = (0..positions.len())
            .filter(|&i| is_finite(&positions[i]))
            .map(|i| (cell(&positions[i]), i as u32))
            .collect();
        order.sort_unstable();
        for (cell, _) in &order {
            strips.starts[cell + 1] += 1;
        }
        for cell in 0..STRIPS * STRIPS {
            strips.starts[cell + 1] += strips.starts[cell];
        }
        strips.entries = order.into_iter().map(|(_, i)| (positions[i as usize], i)).collect();
        Some(strips)
    }

    /// The strip, or the cell across, of a coordinate; those outside are in the outermost.
    fn place(&self, side: usize, at: f64) -> usize {
        // The cast saturates.
        (((at - self.origin[side]) / self.width[side]) as usize).min(STRIPS - 1)
    }

    /// Entries of the cells of a strip that reach from one coordinate across to another.
    fn range(&self, strip: usize, low: f64, high: f64) -> &[(Vector2<f64>, u32)] {
        let end = self.origin[1] + STRIPS as f64 * self.width[1];
        if !(high >= self.origin[1] && low <= end) {
            return &[];
        }
        let (from, to) = (strip * STRIPS + self.place(1, low), strip * STRIPS + self.place(1, high));
        &self.entries[self.starts[from] as usize..self.starts[to + 1] as usize]
    }

    /// Where a strip begins.
    fn begin(&self, strip: usize) -> f64 {
        self.origin[0] + strip as f64 * self.width[0]
    }
}

/// Knows which features of the second image the geometry allows for one of the first.
struct Search {
    guide: Guide,
    max_error: f64,
    /// Squared length of the normal of each second feature's line in the first image; of epipolar geometry only.
    normals: Vec<f64>,
    /// A length that few of those normals exceed.
    long_normal: f64,
}

impl Search {
    fn new(guide: &Guide, second: &[Vector2<f64>], max_error: f64) -> Self {
        let normals: Vec<f64> = match guide {
            Guide::Epipolar(m) => second
                .iter()
                .map(|p| {
                    let (x, y) = (m.m11 * p.x + m.m21 * p.y + m.m31, m.m12 * p.x + m.m22 * p.y + m.m32);
                    x * x + y * y
                })
                .collect(),
            Guide::Homography(_) => Vec::new(),
        };
        let mut sorted: Vec<f64> = normals.iter().copied().filter(|value| value.is_finite()).collect();
        let place = sorted.len() * 19 / 20;
        let long =
            if sorted.is_empty() { 0.0 } else { *sorted.select_nth_unstable_by(place, f64::total_cmp).1 };
        Self { guide: *guide, max_error, normals, long_normal: long.sqrt() }
    }

    fn candidates(&self, index: &Index, point: &Vector2<f64>, found: &mut Vec<u32>) {
        match &self.guide {
            Guide::Epipolar(matrix) => self.along_line(index, &(matrix * point.push(1.0)).into(), found),
            Guide::Homography(matrix) => {
                let mapped = matrix * point.push(1.0);
                if mapped.z > 0.0 {
                    self.around(index, &(mapped.xy() / mapped.z), found);
                }
            }
        }
    }

    fn around(&self, index: &Index, center: &Vector2<f64>, found: &mut Vec<u32>) {
        let (strips, reach) = (&index.along[0], self.max_error);
        for k in strips.place(0, center.x - reach)..=strips.place(0, center.x + reach) {
            let near = strips.range(k, center.y - reach, center.y + reach);
            let is_near = |entry: &&(Vector2<f64>, u32)| (entry.0 - center).norm_squared() < reach * reach;
            found.extend(near.iter().filter(is_near).map(|(_, feature)| feature));
        }
    }

    /// `line` is `a x + b y + c = 0`.
    fn along_line(&self, index: &Index, line: &[f64; 3], found: &mut Vec<u32>) {
        let [a, b, c] = *line;
        let squared = a * a + b * b;
        if !(squared > 0.0 && squared.is_finite() && c.is_finite()) {
            return;
        }
        let normal = squared.sqrt();
        let stretch = (1.0 + (self.long_normal / normal).powi(2)).sqrt().min(MAX_STRETCH);
        // Along the axis in which the line advances faster.
        let axis = usize::from(a.abs() > b.abs());
        let (slow, fast) = if axis == 0 { (b, a) } else { (a, b) };
        let reach = self.max_error * stretch * normal / slow.abs();
        let other = |at: f64| -(fast * at + c) / slow;
        let strips = &index.along[axis];
        let limit = self.max_error * self.max_error;
        for k in 0..STRIPS {
            let (p, q) = (other(strips.begin(k)), other(strips.begin(k + 1)));
            for (point, feature) in strips.range(k, p.min(q) - reach, p.max(q) + reach) {
                let value = a * point.x + b * point.y + c;
                if value * value < limit * (squared + self.normals[*feature as usize]) {
                    found.push(*feature);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;
    use rand::RngExt;
    use terrane_geometry::two_view::squared_sampson_error;
    use terrane_geometry::{Rigid3, Seed, so3};

    struct Scene {
        first: Vec<Vector2<f64>>,
        second: Vec<Vector2<f64>>,
        descriptors: [Vec<u8>; 2],
        essential: Matrix3<f64>,
    }

    /// Points seen by both cameras, with one of `kinds` descriptors each and some noise on it; and strangers in the second.
    fn scene(count: usize, kinds: u8, center: Vector3<f64>, seed: u64) -> Scene {
        let mut rng = Seed(seed).rng();
        let second_from_first =
            Rigid3::from_rotation_and_center(so3::exp(&Vector3::new(0.02, -0.1, 0.05)), &center);
        let essential = so3::skew(&second_from_first.translation) * second_from_first.rotation_matrix();
        let mut scene = Scene { first: vec![], second: vec![], descriptors: [vec![], vec![]], essential };
        let prototypes: Vec<[u8; DESCRIPTOR_LEN]> =
            (0..kinds).map(|_| std::array::from_fn(|_| rng.random_range(0..120))).collect();
        for i in 0..2 * count {
            let x = Vector3::new(rng.random_range(-0.6..0.6), rng.random_range(-0.45..0.45), 1.0)
                * rng.random_range(4.0..12.0);
            let seen = second_from_first.transform_point(&x);
            let prototype = prototypes[rng.random_range(0..prototypes.len())];
            let mut noisy = || prototype.map(|value| value + rng.random_range(0..8));
            let (one, other) = (noisy(), noisy());
            if i < count {
                scene.first.push(x.xy() / x.z);
                scene.descriptors[0].extend(one);
            }
            scene.second.push(seen.xy() / seen.z);
            scene.descriptors[1].extend(other);
        }
        scene
    }

    impl Scene {
        fn sides(&self) -> [GuidedSide<'_>; 2] {
            [
                GuidedSide { positions: &self.first, descriptors: &self.descriptors[0] },
                GuidedSide { positions: &self.second, descriptors: &self.descriptors[1] },
            ]
        }
    }

    #[test]
    fn the_index_finds_what_a_full_search_finds() {
        for (center, seed) in [(Vector3::new(1.0, 0.1, 0.0), 1), (Vector3::new(0.1, 1.0, 0.2), 2)] {
            let scene = scene(300, 20, center, seed);
            let index = Index::new(&scene.second).expect("positions");
            let search = Search::new(&Guide::Epipolar(scene.essential), &scene.second, 3e-3);
            let (mut found, mut missed, mut total) = (Vec::new(), 0, 0);
            for point in &scene.first {
                found.clear();
                search.candidates(&index, point, &mut found);
                found.sort_unstable();
                let truth: Vec<u32> = (0..scene.second.len() as u32)
                    .filter(|&j| {
                        squared_sampson_error(&scene.essential, point, &scene.second[j as usize]) < 9e-6
                    })
                    .collect();
                assert!(found.iter().all(|j| truth.contains(j)) && found.is_sorted());
                missed += truth.len() - found.len();
                total += truth.len();
            }
            assert!(total > 600 && missed * 500 < total, "{missed} of {total}");
        }
    }

    #[test]
    fn repeated_descriptors_are_told_apart_by_the_geometry() {
        for center in [Vector3::new(1.0, 0.1, 0.0), Vector3::new(0.05, 0.02, 1.0)] {
            let scene = scene(400, 12, center, 3);
            let [first, second] = scene.sides();
            let guide = Guide::Epipolar(scene.essential);
            let options = MatchOptions::default();
            let found = match_guided(&first, &second, &guide, 2e-3, &options);
            let right = found.iter().filter(|found| found.first == found.second).count();
            assert!((250..400).contains(&right), "{right} of {}", found.len());
            assert!(found.len() - right < 20, "{right} of {}", found.len());
            assert!(found.is_sorted_by_key(|found| found.first));
            // Among all, hardly any of so few kinds stands out.
            let anywhere = match_guided(&first, &second, &guide, 10.0, &options);
            assert!(anywhere.len() < 40, "{}", anywhere.len());
            assert_eq!(found, match_guided(&first, &second, &guide, 2e-3, &options));
        }
    }

    #[test]
    fn products_are_exact() {
        let ramp: [u8; DESCRIPTOR_LEN] = std::array::from_fn(|k| (2 * k) as u8);
        for (a, b) in
            [([255; DESCRIPTOR_LEN], [255; DESCRIPTOR_LEN]), (ramp, [7; DESCRIPTOR_LEN]), (ramp, ramp)]
        {
            let truth: i32 = a.iter().zip(&b).map(|(&x, &y)| i32::from(x) * i32::from(y)).sum();
            assert_eq!(dot(&wide(&a), &wide(&b)), truth);
        }
    }

    #[test]
    fn a_homography_guides_to_a_place() {
        let mut scene = scene(300, 3, Vector3::new(1.0, 0.0, 0.0), 4);
        let turn = so3::exp(&Vector3::new(0.05, 0.2, 0.1)).to_rotation_matrix().into_inner();
        for (a, b) in scene.first.iter().zip(&mut scene.second) {
            let seen = turn * a.push(1.0);
            *b = seen.xy() / seen.z;
        }
        let [first, second] = scene.sides();
        let options = MatchOptions::default();
        let found = match_guided(&first, &second, &Guide::Homography(turn), 2e-3, &options);
        let right = found.iter().filter(|found| found.first == found.second).count();
        assert!(right >= 280 && found.len() - right < 10, "{right} of {}", found.len());
    }

    #[test]
    fn broken_input_matches_nothing_and_does_not_panic() {
        let scene = scene(50, 5, Vector3::new(1.0, 0.0, 0.0), 5);
        let [first, second] = scene.sides();
        let options = MatchOptions::default();
        let none = GuidedSide { positions: &[], descriptors: &[] };
        let nan = vec![Vector2::repeat(f64::NAN); 50];
        let broken = GuidedSide { positions: &nan, ..first };
        let one = vec![Vector2::new(0.1, 0.1); 100];
        let stacked = GuidedSide { positions: &one, ..second };
        let zeros = vec![0; second.descriptors.len()];
        let blank = GuidedSide { descriptors: &zeros, ..second };
        for matrix in [scene.essential, Matrix3::zeros(), Matrix3::repeat(f64::NAN), Matrix3::identity()] {
            for guide in [Guide::Epipolar(matrix), Guide::Homography(matrix)] {
                for (a, b) in
                    [(none, second), (first, none), (broken, second), (first, broken), (first, blank)]
                {
                    assert!(match_guided(&a, &b, &guide, 1e-3, &options).is_empty());
                }
                match_guided(&first, &stacked, &guide, 1e-3, &options);
                match_guided(&first, &second, &guide, f64::INFINITY, &options);
            }
        }
    }
}
