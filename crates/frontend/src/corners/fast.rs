//! FAST corners (Rosten & Drummond 2006): nine neighbours in a row, of sixteen on a circle, are all brighter or all
//! darker than the middle.

use crate::image::GrayImage;
use crate::simd::{Path, compiled_twice};

use super::Candidate;

/// The circle of radius three, clockwise from the top: column and row.
const CIRCLE: [(isize, isize); 16] = [
    (0, -3),
    (1, -3),
    (2, -2),
    (3, -1),
    (3, 0),
    (3, 1),
    (2, 2),
    (1, 3),
    (0, 3),
    (-1, 3),
    (-2, 2),
    (-3, 1),
    (-3, 0),
    (-3, -1),
    (-2, -2),
    (-1, -3),
];
/// Neighbours in a row that make a corner.
const ARC: u8 = 9;
/// Pixels that are tested at once.
const LANES: usize = 32;

/// Rows and columns at the image's edge in which no corner is looked for; blocks may reach over a row's end by less
/// than that many rows.
pub(super) const MARGIN: usize = 8;

/// Corners that differ from their circle by more than `threshold` greys, by rows, not exceeded by a neighbour. Their
/// strength is the greatest threshold that they would pass, plus one.
pub(super) fn detect(path: Path, image: &GrayImage, threshold: u8) -> Vec<Candidate> {
    let (width, height) = (image.width, image.height);
    let mut found = Vec::new();
    if width < 2 * MARGIN + LANES || height <= 2 * MARGIN {
        return found;
    }
    // Scores of the row before, of this one and of the next; zero where there is no corner.
    let mut scores = [vec![0_u8; width], vec![0_u8; width], vec![0_u8; width]];
    let mut marks = vec![0_u8; width];
    for y in MARGIN..height - MARGIN + 1 {
        scores.rotate_left(1);
        scores[2].fill(0);
        if y < height - MARGIN {
            mark_corners(path, image, y, threshold, &mut marks);
            for x in marked(&marks[MARGIN..width - MARGIN]).map(|x| x + MARGIN) {
                scores[2][x] = score(image, y * width + x);
            }
        }
        keep_strongest(&scores, y - 1, &mut found);
    }
    found
}

/// Appends the corners of row `y`, the middle one, that no neighbour exceeds; of equals the first stays.
fn keep_strongest(scores: &[Vec<u8>; 3], y: usize, found: &mut Vec<Candidate>) {
    let [above, row, below] = scores;
    for x in marked(row) {
        let value = row[x];
        let before = above[x - 1].max(above[x]).max(above[x + 1]).max(row[x - 1]);
        let after = below[x - 1].max(below[x]).max(below[x + 1]).max(row[x + 1]);
        if value > before && value >= after {
            found.push(Candidate { x, y, response: f32::from(value) });
        }
    }
}

/// Places that are not zero.
fn marked(marks: &[u8]) -> impl Iterator<Item = usize> + '_ {
    let blocks = marks.chunks(LANES).enumerate().filter(|(_, block)| block.iter().fold(0, |a, b| a | b) != 0);
    blocks.flat_map(|(index, block)| {
        block.iter().enumerate().filter(|(_, mark)| **mark != 0).map(move |(k, _)| LANES * index + k)
    })
}

compiled_twice!(
    /// Marks the corners of a row, which lies at least [`MARGIN`] rows inside; what is marked in the margins and behind
    /// the row's end means nothing.
    mark_corners = mark_corners_body(image: &GrayImage, y: usize, threshold: u8, marks: &mut [u8])
);

#[inline(always)]
fn mark_corners_body(image: &GrayImage, y: usize, threshold: u8, marks: &mut [u8]) {
    let width = image.width;
    let offsets = CIRCLE.map(|(dx, dy)| dy * width as isize + dx);
    let mut x = MARGIN;
    while x < width - MARGIN {
        // The last block is moved back so that it ends with the row.
        let at = x.min(width - LANES);
        let block = |offset: isize| lanes(&image.data, (y * width + at).wrapping_add_signed(offset));
        let center = block(0);
        let (mut high, mut low) = ([0_u8; LANES], [0_u8; LANES]);
        for lane in 0..LANES {
            high[lane] = center[lane].saturating_add(threshold);
            low[lane] = center[lane].saturating_sub(threshold);
        }
        let (mut brighter, mut darker) = ([[0_u8; LANES]; 16], [[0_u8; LANES]; 16]);
        let mut any = 0_u8;
        // Of nine in a row at least two are among those at the four compass points, one on each axis.
        for k in [0, 4, 8, 12] {
            compare(block(offsets[k]), &high, &low, &mut brighter[k], &mut darker[k]);
        }
        for lane in 0..LANES {
            let both = |m: &[[u8; LANES]; 16]| (m[0][lane] | m[8][lane]) & (m[4][lane] | m[12][lane]);
            any |= both(&brighter) | both(&darker);
        }
        let marks: &mut [u8] = &mut marks[at..at + LANES];
        if any == 0 {
            marks.fill(0);
        } else {
            for k in (0..16).filter(|k| k % 4 != 0) {
                compare(block(offsets[k]), &high, &low, &mut brighter[k], &mut darker[k]);
            }
            let (bright, dark) = (longest_run(&brighter), longest_run(&darker));
            for lane in 0..LANES {
                marks[lane] = u8::from(bright[lane].max(dark[lane]) >= ARC);
            }
        }
        x = at + LANES;
    }
}

#[inline(always)]
fn lanes(data: &[u8], at: usize) -> &[u8; LANES] {
    data[at..].first_chunk().expect("blocks end at least a margin before the image does")
}

#[inline(always)]
fn compare(
    values: &[u8; LANES],
    high: &[u8; LANES],
    low: &[u8; LANES],
    brighter: &mut [u8; LANES],
    darker: &mut [u8; LANES],
) {
    for lane in 0..LANES {
        brighter[lane] = if values[lane] > high[lane] { 0xff } else { 0 };
        darker[lane] = if values[lane] < low[lane] { 0xff } else { 0 };
    }
}

/// The longest run of marks around the circle, counted up to 24.
#[inline(always)]
fn longest_run(marks: &[[u8; LANES]; 16]) -> [u8; LANES] {
    let (mut run, mut longest) = ([0_u8; LANES], [0_u8; LANES]);
    for k in 0..16 + usize::from(ARC) - 1 {
        let marks = &marks[k % 16];
        for lane in 0..LANES {
            run[lane] = run[lane].wrapping_add(1) & marks[lane];
            longest[lane] = longest[lane].max(run[lane]);
        }
    }
    longest
}

/// The greatest difference by which nine in a row are all brighter or all darker than the pixel at `at`.
fn score(image: &GrayImage, at: usize) -> u8 {
    let center = i16::from(image.data[at]);
    let difference = |(dx, dy): (isize, isize)| {
        i16::from(image.data[at.wrapping_add_signed(dy * image.width as isize + dx)]) - center
    };
    let differences = CIRCLE.map(difference);
    greatest_of_least(differences).max(greatest_of_least(differences.map(|d| -d))).clamp(0, 255) as u8
}

/// Over all runs of nine around the circle, the greatest of their least values.
fn greatest_of_least(values: [i16; 16]) -> i16 {
    let joined = |values: &[i16; 16], step: usize| -> [i16; 16] {
        std::array::from_fn(|k| values[k].min(values[(k + step) % 16]))
    };
    let eight = joined(&joined(&joined(&values, 1), 2), 4);
    (0..16).map(|k| eight[k].min(values[(k + 8) % 16])).max().unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(width: usize, height: usize, mut state: u64) -> GrayImage {
        let mut byte = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 56) as u8
        };
        GrayImage { width, height, data: (0..width * height).map(|_| byte()).collect() }
    }

    /// The definition, pixel by pixel.
    fn is_corner(image: &GrayImage, x: usize, y: usize, threshold: i32) -> bool {
        let at = y * image.width + x;
        let sign = |k: usize| {
            let (dx, dy) = CIRCLE[k % 16];
            let value = image.data[at.wrapping_add_signed(dy * image.width as isize + dx)];
            let difference = i32::from(value) - i32::from(image.data[at]);
            if difference.abs() > threshold { difference.signum() } else { 0 }
        };
        (0..16).any(|start| sign(start) != 0 && (start..start + 9).all(|k| sign(k) == sign(start)))
    }

    #[test]
    fn the_segment_test_is_that_of_the_definition_on_every_path() {
        for (seed, threshold) in [(1, 5), (2, 40), (3, 90), (4, 0), (5, 254)] {
            let mut image = noise(101, 40, seed);
            // Coarser structures, which have longer arcs.
            for at in 0..image.data.len() {
                if (at / 7) % 3 == 0 {
                    image.data[at] = if (at / 800) % 2 == 0 { 240 } else { 10 };
                }
            }
            for path in [Path::BASELINE, Path::detect()] {
                let mut marks = vec![0; 101];
                for y in MARGIN..40 - MARGIN {
                    mark_corners(path, &image, y, threshold, &mut marks);
                    for x in MARGIN..101 - MARGIN {
                        let truth = is_corner(&image, x, y, i32::from(threshold));
                        assert_eq!(marks[x] != 0, truth, "{x} {y}");
                        let strength = i32::from(score(&image, y * 101 + x));
                        assert_eq!(truth, strength > i32::from(threshold), "{x} {y} {strength}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_square_has_four_corners() {
        let mut image = GrayImage { width: 64, height: 64, data: vec![50; 64 * 64] };
        for y in 24..40 {
            image.data[y * 64 + 20..y * 64 + 44].fill(200);
        }
        let found = detect(Path::detect(), &image, 20);
        let near = |x: usize, y: usize| {
            // Pixels along an edge near a corner may differ from their circles as much as its own does.
            found.iter().any(|corner| corner.x.abs_diff(x) <= 2 && corner.y.abs_diff(y) <= 2)
        };
        assert!(near(20, 24) && near(43, 24) && near(20, 39) && near(43, 39), "{found:?}");
        assert!(found.len() <= 8, "{found:?}");
        assert!(detect(Path::detect(), &image, 151).is_empty());
    }
}
