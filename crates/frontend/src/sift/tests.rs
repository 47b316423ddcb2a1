//! Features of images with known answers: blobs at known places, textures under known transforms.

use terrane_scene::{Features, Keypoint};
use terrane_testkit::homographies::{Condition, Picture, conditions, score};

use super::*;
use crate::matching::{MatchOptions, match_features};

/// A sum of Gaussian blobs on grey, which can be drawn exactly at any place, scale and rotation.
struct Scene {
    background: f64,
    blobs: Vec<[f64; 4]>, // x, y, sigma, height
}

impl Scene {
    fn random(count: usize, side: f64, seed: u64) -> Self {
        let mut state = seed;
        let mut uniform = move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as f64 / f64::from(1_u32 << 31)
        };
        let blobs = (0..count).map(|_| {
            let (x, y, height) = (uniform() * side, uniform() * side, (uniform() - 0.5) * 120.0);
            [x, y, 1.2 * 8.0_f64.powf(uniform() * uniform()), height]
        });
        Self { background: 128.0, blobs: blobs.collect() }
    }

    /// Draws what `image_from_scene` (rotation and scale as a complex number, then a shift) makes of the scene.
    fn draw(&self, width: usize, height: usize, rotation: (f64, f64), shift: (f64, f64)) -> GrayImage {
        let scale = rotation.0.hypot(rotation.1);
        let mut values = vec![self.background; width * height];
        for &[x, y, sigma, top] in &self.blobs {
            let (cx, cy) = transformed((x, y), rotation, shift);
            let sigma = sigma * scale;
            let rows =
                ((cy - 5.0 * sigma).max(0.0) as usize)..((cy + 5.0 * sigma).max(0.0) as usize).min(height);
            for row in rows {
                let columns =
                    ((cx - 5.0 * sigma).max(0.0) as usize)..((cx + 5.0 * sigma).max(0.0) as usize).min(width);
                for column in columns {
                    let (dx, dy) = (column as f64 + 0.5 - cx, row as f64 + 0.5 - cy);
                    values[row * width + column] +=
                        top * (-(dx * dx + dy * dy) / (2.0 * sigma * sigma)).exp();
                }
            }
        }
        let data = values.into_iter().map(|v| v.round().clamp(0.0, 255.0) as u8).collect();
        GrayImage { width, height, data }
    }
}

fn transformed((x, y): (f64, f64), (c, s): (f64, f64), (dx, dy): (f64, f64)) -> (f64, f64) {
    (c * x - s * y + dx, s * x + c * y + dy)
}

fn options(first_octave: FirstOctave) -> SiftOptions {
    SiftOptions { first_octave, ..SiftOptions::default() }
}

#[test]
fn blobs_are_found_where_they_are_in_every_octave() {
    let cases = [
        // The finest blobs are as small as pixels: their samples are no blob any more.
        (FirstOctave::Doubled, 1.3, 0.015),
        (FirstOctave::Doubled, 1.6, 0.006),
        (FirstOctave::Doubled, 2.3, 0.0),
        (FirstOctave::Original, 2.3, 0.0),
        (FirstOctave::Original, 3.1, 0.0),
        (FirstOctave::Original, 4.6, 0.0),
        (FirstOctave::Original, 6.0, 0.0),
        (FirstOctave::Original, 9.3, 0.0),
        (FirstOctave::Doubled, 9.3, 0.0),
    ];
    for (first_octave, sigma, finest) in cases {
        let bound = f64::max(0.005, finest);
        for (x, y) in [(80.5, 77.0), (80.13, 76.84), (79.71, 77.36), (81.0, 78.25), (82.6, 79.9)] {
            let scene = Scene { background: 30.0, blobs: vec![[x, y, sigma, 200.0]] };
            let image = scene.draw(161, 150, (1.0, 0.0), (0.0, 0.0));
            let features = extract(&image, None, &options(first_octave));
            let strongest = features.keypoints.first().expect("a blob is a feature");
            let error = (f64::from(strongest.x_px) - x).hypot(f64::from(strongest.y_px) - y);
            assert!(error < bound, "{first_octave:?} sigma {sigma}: {error} px away from ({x}, {y})");
            let ratio = f64::from(strongest.scale_px) / sigma;
            assert!(
                (0.75..1.05).contains(&ratio),
                "{first_octave:?} sigma {sigma}: scale {}",
                strongest.scale_px
            );
        }
    }
}

#[test]
fn octave_minus_one_finds_blobs_that_octave_zero_is_too_coarse_for() {
    let scene = Scene { background: 30.0, blobs: vec![[40.3, 40.8, 1.3, 200.0]] };
    let image = scene.draw(80, 80, (1.0, 0.0), (0.0, 0.0));
    let near = |features: &Features| {
        features.keypoints.iter().filter(|k| (k.x_px - 40.3).hypot(k.y_px - 40.8) < 0.05).count()
    };
    assert!(near(&extract(&image, None, &options(FirstOctave::Doubled))) >= 1);
    assert_eq!(near(&extract(&image, None, &options(FirstOctave::Original))), 0);
}

#[test]
fn octave_minus_one_is_added_where_octave_zero_gives_too_little() {
    let image = Scene::random(900, 333.0, 5).draw(333, 197, (1.0, 0.0), (0.0, 0.0));
    let blobs = |first_octave, max_features| {
        let options = SiftOptions { max_features, upright: true, ..options(first_octave) };
        extract(&image, None, &options)
    };
    let (coarse, fine) = (blobs(FirstOctave::Original, 8192), blobs(FirstOctave::Doubled, 8192));
    assert!(coarse.len() > 100 && fine.len() > coarse.len(), "{} {}", coarse.len(), fine.len());
    let is_fine = |features: &Features| features.keypoints.iter().filter(|k| k.scale_px < 1.4).count();
    let (enough, short) = (blobs(FirstOctave::Auto, 50), blobs(FirstOctave::Auto, 8192));
    assert_eq!(enough, blobs(FirstOctave::Original, 50));
    assert!(is_fine(&coarse) == 0 && is_fine(&short) == is_fine(&fine) && is_fine(&fine) > 10);
    // Octave 0 differs in its last bits: it comes from the photograph, not from octave −1.
    assert!(short.len().abs_diff(fine.len()) * 50 < fine.len(), "{} {}", short.len(), fine.len());
}

#[test]
fn scalar_and_vector_paths_and_any_tiles_agree_bit_for_bit() {
    let image = Scene::random(900, 333.0, 5).draw(333, 197, (1.0, 0.0), (0.0, 0.0));
    for first_octave in [FirstOctave::Doubled, FirstOctave::Original] {
        let plain = extract_with(
            Paths { isa: Isa::BASELINE, tile_columns: 1 << 20 },
            &image,
            None,
            None,
            &options(first_octave),
        );
        assert!(plain.len() > 100);
        for isa in Isa::available() {
            for tile_columns in [1, 260, TILE_COLUMNS] {
                let features =
                    extract_with(Paths { isa, tile_columns }, &image, None, None, &options(first_octave));
                assert_eq!(plain, features, "{isa:?} {tile_columns}");
            }
        }
    }
}

#[test]
fn features_do_not_depend_on_the_number_of_threads() {
    let image = Scene::random(500, 200.0, 9).draw(200, 200, (1.0, 0.0), (0.0, 0.0));
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| extract(&image, None, &SiftOptions::default()))
    };
    assert_eq!(run(1), run(3));
}

/// Where a point of the first image lies in the second, and how much larger things are there.
type Map<'a> = (&'a dyn Fn(f64, f64) -> (f64, f64), f64);

/// Of features of `first` that `second` shows: how many are found again, how many of the ratio-test matches there
/// are, and how many of these are right.
fn compare(first: &Features, second: &Features, (to_second, scale): Map<'_>, side: f64) -> [usize; 4] {
    let (mut shown, mut repeated, mut matched, mut right) = (0, 0, 0, 0);
    for (k, keypoint) in first.keypoints.iter().enumerate() {
        let (x, y) = to_second(f64::from(keypoint.x_px), f64::from(keypoint.y_px));
        // What is finer than the second image's first level can't be found there.
        if scale * f64::from(keypoint.scale_px) < 2.0 {
            continue;
        }
        if !(20.0..side - 20.0).contains(&x) || !(20.0..side - 20.0).contains(&y) {
            continue;
        }
        let distance = |other: &Keypoint| (f64::from(other.x_px) - x).hypot(f64::from(other.y_px) - y);
        shown += 1;
        repeated += usize::from(second.keypoints.iter().any(|other| distance(other) < 1.5));
        let mut nearest = [(u32::MAX, 0), (u32::MAX, 0)];
        for other in 0..second.len() {
            let pairs = first.descriptor(k).iter().zip(second.descriptor(other));
            let squared = pairs.map(|(a, b)| u32::from(a.abs_diff(*b)).pow(2)).sum();
            if squared < nearest[0].0 {
                nearest = [(squared, other), nearest[0]];
            } else if squared < nearest[1].0 {
                nearest[1] = (squared, other);
            }
        }
        if f64::from(nearest[0].0) < 0.64 * f64::from(nearest[1].0) {
            matched += 1;
            right += usize::from(distance(&second.keypoints[nearest[0].1]) < 1.5);
        }
    }
    [shown, repeated, matched, right]
}

#[test]
fn features_survive_rotation_and_scale() {
    let scene = Scene::random(900, 260.0, 77);
    let side = 260.0;
    let first = extract(&scene.draw(260, 260, (1.0, 0.0), (0.0, 0.0)), None, &options(FirstOctave::Original));
    for (angle, scale) in [(0.0_f64, 1.0_f64), (0.5, 1.0), (2.3, 1.0), (-1.1, 1.3), (0.3, 0.8)] {
        let rotation = (scale * angle.cos(), scale * angle.sin());
        let center = transformed((130.0, 130.0), rotation, (0.0, 0.0));
        let shift = (130.37 - center.0, 129.81 - center.1);
        let second = extract(&scene.draw(260, 260, rotation, shift), None, &options(FirstOctave::Original));
        let counts = compare(&first, &second, (&|x, y| transformed((x, y), rotation, shift), scale), side);
        let [shown, repeated, matched, right] = counts.map(|c| c as f64);
        assert!(shown > 100.0, "{counts:?}");
        assert!(repeated > 0.7 * shown, "{angle} {scale}: {counts:?}");
        assert!(matched > 0.45 * shown, "{angle} {scale}: {counts:?}");
        assert!(right > 0.95 * matched, "{angle} {scale}: {counts:?}");
    }
}

#[test]
fn orientation_turns_with_the_image() {
    let scene = Scene::random(300, 160.0, 3);
    let first = extract(&scene.draw(160, 160, (1.0, 0.0), (0.0, 0.0)), None, &options(FirstOctave::Original));
    let angle = 0.7_f64;
    let (rotation, center) =
        ((angle.cos(), angle.sin()), transformed((80.0, 80.0), (angle.cos(), angle.sin()), (0.0, 0.0)));
    let shift = (80.0 - center.0, 80.0 - center.1);
    let second = extract(&scene.draw(160, 160, rotation, shift), None, &options(FirstOctave::Original));
    let mut errors = Vec::new();
    for a in &first.keypoints {
        let (x, y) = transformed((f64::from(a.x_px), f64::from(a.y_px)), rotation, shift);
        let near =
            second.keypoints.iter().filter(|b| (f64::from(b.x_px) - x).hypot(f64::from(b.y_px) - y) < 0.5);
        let turns = near.map(|b| {
            let turn = (f64::from(b.orientation_rad - a.orientation_rad) - angle) / std::f64::consts::TAU;
            (turn - turn.round()).abs() * 360.0
        });
        errors.extend(turns.reduce(f64::min));
    }
    errors.sort_by(f64::total_cmp);
    assert!(errors.len() > 50, "{} of {}", errors.len(), first.len());
    assert!(errors[errors.len() / 2] < 1.0, "median {} degrees", errors[errors.len() / 2]);
}

#[test]
fn images_without_features_are_no_error() {
    for (width, height) in [(1, 1), (1, 50), (3, 3), (11, 400), (12, 12), (13, 13), (64, 64)] {
        let flat = GrayImage { width, height, data: vec![77; width * height] };
        for first_octave in [FirstOctave::Auto, FirstOctave::Doubled, FirstOctave::Original] {
            assert!(extract(&flat, None, &options(first_octave)).is_empty(), "{width} x {height}");
        }
    }
    let nothing = GrayImage { width: 0, height: 0, data: Vec::new() };
    for first_octave in [FirstOctave::Auto, FirstOctave::Doubled, FirstOctave::Original] {
        assert!(extract(&nothing, None, &options(first_octave)).is_empty());
    }
}

#[test]
fn the_limit_holds_and_a_prefix_is_the_strongest() {
    let image = Scene::random(1500, 300.0, 21).draw(300, 300, (1.0, 0.0), (0.0, 0.0));
    let all = extract(&image, None, &SiftOptions::default());
    let few = extract(&image, None, &SiftOptions { max_features: 200, ..SiftOptions::default() });
    assert!(all.len() > 400);
    // 200 blobs, some of them with a second orientation.
    assert!((200..=300).contains(&few.len()), "{}", few.len());
    let mut places: Vec<_> = few.keypoints.iter().map(|k| (k.x_px.to_bits(), k.y_px.to_bits())).collect();
    places.sort_unstable();
    places.dedup();
    assert_eq!(places.len(), 200);
    let upright = SiftOptions { max_features: 200, upright: true, ..SiftOptions::default() };
    assert_eq!(extract(&image, None, &upright).len(), 200);
    let again = extract(&image, None, &SiftOptions { max_features: 200, ..SiftOptions::default() });
    assert_eq!(few, again);
    // The strongest of all is the first of the few.
    assert_eq!(few.keypoints[0], all.keypoints[0]);
}

#[test]
fn selection_spreads_and_keeps_the_strongest() {
    // 900 strong places in one corner, 100 weak ones elsewhere.
    let place = |k: usize| match k {
        0..900 => Ranked { x_px: (k % 30) as f32, y_px: (k / 30) as f32 },
        _ => Ranked { x_px: 40.0 + 59.0 * ((k % 10) as f32 / 10.0), y_px: 40.0 + (k as f32 - 900.0) * 0.6 },
    };
    let places: Vec<Ranked> = (0..1000).map(place).collect();
    let strongest = select(&places, 300, 0.0, (100, 100));
    assert_eq!(strongest, (0..300).collect::<Vec<_>>());
    let spread = select(&places, 300, 1.0, (100, 100));
    assert_eq!(spread.len(), 300);
    assert!(spread.iter().filter(|&&k| k >= 900).count() > 50);
    assert!(spread.is_sorted());
}

#[test]
fn a_blob_is_one_place() {
    let place = |x_px: f32, scale_px: f32, octave: usize| Placed {
        x_px,
        y_px: 40.0,
        scale_px,
        octave,
        step_px: (1 << octave) as f32,
    };
    let places = [
        place(40.0, 4.1, 1),
        // The same blob from the octave before, and a neighbour in another cell.
        place(41.9, 4.0, 0),
        place(38.1, 4.3, 1),
        // Farther, coarser and finer ones.
        place(42.2, 4.0, 1),
        place(40.0, 5.2, 1),
        place(40.0, 3.2, 0),
    ];
    assert_eq!(first_at_places(&places), [true, false, false, true, true, true]);
    let image = Scene::random(900, 260.0, 4).draw(260, 260, (1.0, 0.0), (0.0, 0.0));
    let features = extract(&image, None, &SiftOptions { max_orientations: 1, ..SiftOptions::default() });
    for (k, a) in features.keypoints.iter().enumerate() {
        for b in &features.keypoints[..k] {
            let is_near = (a.x_px - b.x_px).hypot(a.y_px - b.y_px) < 0.45 * a.scale_px;
            assert!(!is_near || (a.scale_px / b.scale_px).ln().abs() > 0.2, "{a:?} {b:?}");
        }
    }
}

#[test]
fn colors_come_from_the_keypoint_s_pixel() {
    let scene = Scene { background: 30.0, blobs: vec![[40.2, 30.7, 2.5, 200.0]] };
    let luma = scene.draw(80, 64, (1.0, 0.0), (0.0, 0.0));
    let mut rgb = RgbImage { width: 80, height: 64, data: vec![0; 3 * 80 * 64] };
    rgb.data[3 * (30 * 80 + 40)..][..3].copy_from_slice(&[9, 8, 7]);
    let features = extract(&luma, Some(&rgb), &SiftOptions::default());
    assert_eq!(features.colors[0], [9, 8, 7]);
    assert_eq!(extract(&luma, None, &SiftOptions::default()).colors[0], [luma.data[30 * 80 + 40]; 3]);
}

#[test]
fn descriptors_have_the_length_of_unit_vectors() {
    let image = Scene::random(400, 150.0, 2).draw(150, 150, (1.0, 0.0), (0.0, 0.0));
    let features = extract(&image, None, &SiftOptions::default());
    for k in 0..features.len() {
        let length = features.descriptor(k).iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
        assert!((490.0..=520.0).contains(&length), "{length}");
    }
}

#[test]
fn options_name_every_field_that_is_wrong() {
    assert!(SiftOptions::default().validate().is_ok());
    let wrong =
        SiftOptions { max_features: 0, spread: 2.0, edge_threshold: f64::NAN, ..SiftOptions::default() };
    let error = wrong.validate().unwrap_err();
    assert!(error.is_invalid_option());
    for name in ["max_features", "spread", "edge_threshold"] {
        assert!(error.to_string().contains(name), "{error}");
    }
}

/// A picture with texture of all scales.
fn cloth() -> Picture {
    let (width, height) = (640, 480);
    let scene = Scene::random(2500, 640.0, 11).draw(width, height, (1.0, 0.0), (0.0, 0.0));
    Picture { width, height, pixels: scene.data }
}

fn condition(name: &str) -> Condition {
    conditions().into_iter().find(|condition| condition.name == name).expect("a condition")
}

fn luma(picture: &Picture) -> GrayImage {
    GrayImage { width: picture.width, height: picture.height, data: picture.pixels.clone() }
}

/// How many of some matches of `first` and what a condition makes of it are right.
fn num_right(
    condition: &Condition,
    (first, features): (&Picture, &Features),
    (second, others): (&Picture, &Features),
    matches: &[(u32, u32)],
) -> usize {
    let map = condition.second_from_first(first.width, first.height);
    let size = |picture: &Picture| (picture.width, picture.height);
    score((features, size(first)), (others, size(second)), matches, &map).correct
}

/// Right matches of a picture and what a condition makes of it.
fn right_matches(condition: &Condition, options: &SiftOptions) -> usize {
    let first = cloth();
    let second = condition.render(&first, 5);
    let features = [&first, &second].map(|picture| extract(&luma(picture), None, options));
    let matches: Vec<(u32, u32)> = match_features(&features[0], &features[1], &MatchOptions::default())
        .iter()
        .map(|m| (m.first, m.second))
        .collect();
    num_right(condition, (&first, &features[0]), (&second, &features[1]), &matches)
}

#[test]
fn affine_shapes_keep_matches_of_a_plane_far_aslant_and_most_of_one_seen_from_the_front() {
    let round = options(FirstOctave::Original);
    let affine = SiftOptions { affine: true, ..round.clone() };
    let (aslant, front) = (condition("tilt 55°"), condition("turn 45°"));
    let (with, without) = (right_matches(&aslant, &affine), right_matches(&aslant, &round));
    assert!(10 * with > 11 * without, "{with} {without}");
    let (with, without) = (right_matches(&front, &affine), right_matches(&front, &round));
    assert!(10 * with > 8 * without && without > 200, "{with} {without}");
}

/// Descriptors before and after rounding, with their keypoints.
fn rounded_and_not(picture: &Picture, options: &SiftOptions) -> (Features, [Vec<Vec<f32>>; 2]) {
    let luma = luma(picture);
    let isa = Isa::detect();
    let space = ScaleSpace::new(Paths { isa, tile_columns: TILE_COLUMNS }, &luma, options);
    let seen = seen(&space, strongest(&space, &luma, None, options), options);
    let oriented = orient(isa, &space, &seen, &luma, options);
    let features = extract(&luma, None, options);
    assert_eq!(oriented.len(), features.len());
    let exact = oriented
        .iter()
        .map(|(seen, angle_rad)| descriptor::root_sift(isa, &space.place(&seen.blob), *angle_rad).to_vec());
    let rounded = features.descriptors.as_chunks::<DESCRIPTOR_LEN>().0;
    let rounded = rounded.iter().map(|d| d.iter().map(|v| f32::from(*v) / 512.0).collect());
    let both = [exact.collect(), rounded.collect()];
    (features, both)
}

/// Pairs that are each other's nearest and clearly nearer than the next.
fn matches_of(first: &[Vec<f32>], second: &[Vec<f32>]) -> Vec<(u32, u32)> {
    let two_nearest = |of: &[f32], among: &[Vec<f32>]| {
        let mut best = [(f32::INFINITY, 0); 2];
        for (k, other) in among.iter().enumerate() {
            let squared: f32 = of.iter().zip(other).map(|(a, b)| (a - b) * (a - b)).sum();
            if squared < best[0].0 {
                best = [(squared, k), best[0]];
            } else if squared < best[1].0 {
                best[1] = (squared, k);
            }
        }
        best
    };
    let back: Vec<usize> = second.iter().map(|d| two_nearest(d, first)[0].1).collect();
    let found = first.iter().enumerate().filter_map(|(k, d)| {
        let [(nearest, at), (next, _)] = two_nearest(d, second);
        (nearest < 0.64 * next && back[at] == k).then_some((k as u32, at as u32))
    });
    found.collect()
}

#[test]
fn eight_bits_cost_less_than_one_match_in_two_hundred() {
    let options = SiftOptions { max_features: 500, ..options(FirstOctave::Original) };
    let first = cloth();
    let (features, descriptors) = rounded_and_not(&first, &options);
    let (mut exact, mut rounded, mut both) = (0, 0, 0);
    for name in ["turn 45°", "scale 0.7", "noise 12 greys", "tilt 25°"] {
        let condition = condition(name);
        let second = condition.render(&first, 3);
        let (other, theirs) = rounded_and_not(&second, &options);
        let right =
            |matches: &[(u32, u32)]| num_right(&condition, (&first, &features), (&second, &other), matches);
        let [by_exact, by_rounded] = [0, 1].map(|k| matches_of(&descriptors[k], &theirs[k]));
        exact += right(&by_exact);
        rounded += right(&by_rounded);
        let kept: Vec<(u32, u32)> = by_exact.into_iter().filter(|m| by_rounded.contains(m)).collect();
        both += right(&kept);
    }
    assert!(exact > 1000, "{exact}");
    // Neither fewer in all, nor others.
    assert!(200 * rounded > 199 * exact && 100 * both > 99 * exact, "{exact} {rounded} {both}");
}
