//! Rotated BRIEF: 256 comparisons of brightness between places of a patch that turns with the corner.
//!
//! The pattern is drawn once and for all from an isotropic normal distribution (Calonder et al. 2010, their pattern II)
//! by a fixed generator; it is not learned from photographs. It turns with the centroid of brightness (Rosin 1999) as in
//! ORB (Rublee et al. 2011), by the angle itself instead of by steps of twelve degrees.

use std::sync::OnceLock;

use terrane_scene::BINARY_DESCRIPTOR_LEN;

use crate::image::GrayImage;
use crate::sift::shared::BlurredImage;
use crate::simd::{Path, compiled_twice};

/// Comparisons: bits of a descriptor.
const PAIRS: usize = 8 * BINARY_DESCRIPTOR_LEN;
/// Radius of the patch in pixels.
const RADIUS: i32 = 15;
/// Pixels that must lie on every side of a corner: the patch, and one for rounding.
pub(super) const MARGIN: usize = RADIUS as usize + 2;
/// Places compared with one another lie at least this far apart, in pixels: nearer ones are nearly always alike.
const MIN_SEPARATION_PX: i32 = 5;

/// Both ends of each comparison in pixels from the middle: first ends, then second ones.
struct Pattern {
    x: [f32; 2 * PAIRS],
    y: [f32; 2 * PAIRS],
}

fn pattern() -> &'static Pattern {
    static PATTERN: OnceLock<Pattern> = OnceLock::new();
    PATTERN.get_or_init(draw_pattern)
}

fn draw_pattern() -> Pattern {
    // SplitMix64 (Steele et al. 2014).
    let mut state = 0x7465_7272_616e_6501_u64;
    let mut bits = move || {
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (state ^ (state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    };
    // The sum of eight bytes is nearly normal, and exact; its standard deviation of 418 becomes 6.2 pixels, a fifth of
    // the patch's width.
    let mut coordinate = move || {
        let sum: i64 = bits().to_le_bytes().iter().map(|&byte| 2 * i64::from(byte) - 255).sum();
        ((sum * 62) as f64 / 4180.0).round() as i32
    };
    let mut place = move || loop {
        let (x, y) = (coordinate(), coordinate());
        if x * x + y * y <= RADIUS * RADIUS {
            return (x, y);
        }
    };
    let mut pattern = Pattern { x: [0.0; 2 * PAIRS], y: [0.0; 2 * PAIRS] };
    let mut count = 0;
    while count < PAIRS {
        let (a, b) = (place(), place());
        if (a.0 - b.0).pow(2) + (a.1 - b.1).pow(2) >= MIN_SEPARATION_PX * MIN_SEPARATION_PX {
            (pattern.x[count], pattern.y[count]) = (a.0 as f32, a.1 as f32);
            (pattern.x[PAIRS + count], pattern.y[PAIRS + count]) = (b.0 as f32, b.1 as f32);
            count += 1;
        }
    }
    pattern
}

/// Half the widths of the rows of the patch's disc, from the middle row on.
const HALF_WIDTHS: [usize; RADIUS as usize + 1] =
    [15, 15, 15, 15, 14, 14, 14, 13, 13, 12, 11, 10, 9, 8, 6, 3];

/// The direction from a corner to the centroid of brightness around it (Rosin 1999), of length one; along x where the
/// patch is symmetric. The corner lies at least [`MARGIN`] inside.
pub(super) fn direction(image: &GrayImage, x: usize, y: usize) -> (f32, f32) {
    let (mut along_x, mut along_y) = (0_i32, 0_i32);
    for (dy, &half) in HALF_WIDTHS.iter().enumerate() {
        let row = |y: usize| {
            let at = y * image.width + x;
            &image.data[at - half..=at + half]
        };
        let (below, above) = (row(y + dy), row(y - dy));
        let (mut sums, mut moments) = (0_i32, 0_i32);
        for (k, (&b, &a)) in below.iter().zip(above).enumerate() {
            let (b, a) = (i32::from(b), i32::from(a));
            sums += b - a;
            moments += (k as i32 - half as i32) * (b + a);
        }
        // The middle row is both.
        along_x += if dy == 0 { moments / 2 } else { moments };
        along_y += dy as i32 * sums;
    }
    let (along_x, along_y) = (f64::from(along_x), f64::from(along_y));
    let length = (along_x * along_x + along_y * along_y).sqrt();
    if length > 0.0 { ((along_x / length) as f32, (along_y / length) as f32) } else { (1.0, 0.0) }
}

/// The descriptor of a corner at least [`MARGIN`] inside, in a blurred image: bit k tells whether the first place of
/// comparison k is darker than the second.
pub(super) fn describe(
    path: Path,
    image: &BlurredImage,
    (x, y): (usize, usize),
    direction: (f32, f32),
) -> [u8; BINARY_DESCRIPTOR_LEN] {
    let mut offsets = [0_i32; 2 * PAIRS];
    turn(path, pattern(), direction, image.stride() as i32, &mut offsets);
    let middle = y * image.stride() + x;
    let values = image.values();
    let mut ends = [0_u16; 2 * PAIRS];
    for (value, &offset) in ends.iter_mut().zip(&offsets) {
        *value = values[middle.wrapping_add_signed(offset as isize)];
    }
    let (first, second) = ends.split_at(PAIRS);
    let mut bits = [0; BINARY_DESCRIPTOR_LEN];
    for (k, byte) in bits.iter_mut().enumerate() {
        for bit in 0..8 {
            *byte |= u8::from(first[8 * k + bit] < second[8 * k + bit]) << bit;
        }
    }
    bits
}

compiled_twice!(
    /// Where the turned pattern lies, as offsets in an image of that stride.
    turn = turn_body(pattern: &Pattern, direction: (f32, f32), stride: i32, offsets: &mut [i32; 2 * PAIRS])
);

#[inline(always)]
fn turn_body(pattern: &Pattern, (cosine, sine): (f32, f32), stride: i32, offsets: &mut [i32; 2 * PAIRS]) {
    /// Adding it rounds to an integer, which then stands in the low bits.
    const MAGIC: f32 = 12_582_912.0;
    let whole = |value: f32| (value + MAGIC).to_bits().wrapping_sub(MAGIC.to_bits()) as i32;
    for k in 0..2 * PAIRS {
        let (x, y) = (pattern.x[k], pattern.y[k]);
        let column = whole(cosine * x - sine * y);
        let row = whole(sine * x + cosine * y);
        offsets[k] = row.wrapping_mul(stride).wrapping_add(column);
    }
}

#[cfg(test)]
mod tests {
    use super::super::pyramid::blur;
    use super::*;

    #[test]
    fn the_pattern_fills_its_patch_evenly() {
        let pattern = pattern();
        let mean = |values: &[f32]| values.iter().sum::<f32>() / values.len() as f32;
        let spread = |values: &[f32]| mean(&values.iter().map(|v| v * v).collect::<Vec<_>>()).sqrt();
        for axis in [&pattern.x, &pattern.y] {
            assert!(mean(axis).abs() < 1.0, "{}", mean(axis));
            assert!((4.5..7.5).contains(&spread(axis)), "{}", spread(axis));
        }
        assert!((0..2 * PAIRS).all(|k| pattern.x[k].hypot(pattern.y[k]) <= 15.0));
    }

    #[test]
    fn half_widths_are_those_of_a_disc() {
        for (dy, &half) in HALF_WIDTHS.iter().enumerate() {
            let truth = (15.4_f64.powi(2) - (dy as f64).powi(2)).sqrt();
            assert!((half as f64 - truth).abs() < 1.0, "{dy}");
        }
    }

    #[test]
    fn paths_agree_and_the_direction_points_to_the_light() {
        let value = |at: usize| (((at * 7919) % 251) / 2 + if at % 64 > 40 { 120 } else { 0 }) as u8;
        let image = GrayImage { width: 64, height: 64, data: (0..4096).map(value).collect() };
        let (cosine, sine) = direction(&image, 32, 30);
        assert!(cosine > 0.95 && sine.abs() < 0.3, "{cosine} {sine}");
        let blurred = blur(Path::detect(), &image);
        for turn in [(1.0, 0.0), (0.6, 0.8), (-0.8, 0.6), (0.0, -1.0)] {
            let plain = describe(Path::BASELINE, &blurred, (32, 30), turn);
            assert_eq!(plain, describe(Path::detect(), &blurred, (32, 30), turn));
            let ones: u32 = plain.iter().map(|byte| byte.count_ones()).sum();
            assert!((60..200).contains(&ones), "{ones}");
        }
        assert_eq!(direction(&GrayImage { width: 64, height: 64, data: vec![9; 4096] }, 20, 20), (1.0, 0.0));
    }
}
