//! Repeatability and matching score under known homographies, side by side with a peer's features of the same pictures:
//! `repeatability --pictures DIR [--first-octave -1] [--max N] [--spread S] [--octaves N] [--contrast C] [--affine] [--peer DIR]
//! PHOTO...`.
//!
//! Pictures that are not in `--pictures` yet are rendered into it. `benches/peers/sift_colmap.py` reads them and writes the
//! folder that `--peer` names.

#[path = "peer/mod.rs"]
mod peer;

use std::path::{Path, PathBuf};

use terrane_frontend::image::{self, GrayImage};
use terrane_frontend::matching::{MatchOptions, match_features};
use terrane_frontend::sift::{FirstOctave, SiftOptions, extract};
use terrane_scene::Features;
use terrane_testkit::homographies::{Condition, Picture, Score, conditions, num_places, score};

/// The middle of a photograph that pictures are rendered from.
const MIDDLE_PX: (usize, usize) = (1200, 900);

fn main() {
    let mut options = SiftOptions { max_features: 3000, ..SiftOptions::default() };
    let (mut pictures, mut peer_dir, mut photos) = (PathBuf::from("."), None, Vec::new());
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        let mut value = || arguments.next().unwrap_or_else(|| panic!("{argument} needs a value"));
        match argument.as_str() {
            "--affine" => options.affine = true,
            "--pictures" => pictures = PathBuf::from(value()),
            "--peer" => peer_dir = Some(PathBuf::from(value())),
            "--max" => options.max_features = value().parse().expect("a number"),
            "--spread" => options.spread = value().parse().expect("a number"),
            "--contrast" => options.contrast_threshold = value().parse().expect("a number"),
            "--octaves" => options.num_octaves = value().parse().expect("a number"),
            "--first-octave" if value() == "-1" => options.first_octave = FirstOctave::Doubled,
            "--first-octave" => options.first_octave = FirstOctave::Original,
            _ => photos.push(PathBuf::from(argument)),
        }
    }
    let conditions = conditions();
    let mut totals = vec![[Total::default(); 2]; conditions.len()];
    for photo in &photos {
        let all = render(photo, &conditions, &pictures);
        let size = (all[0].1.width, all[0].1.height);
        let theirs: Option<Vec<Features>> = peer_dir
            .as_ref()
            .map(|dir: &PathBuf| all.iter().map(|(name, _)| peer::read(&dir.join(name))).collect());
        // As many blobs a picture as the peer kept.
        let budget =
            |k: usize| theirs.as_ref().map_or(options.max_features, |theirs| num_places(&theirs[k]) as u32);
        let ours: Vec<Features> = all
            .iter()
            .enumerate()
            .map(|(k, (_, picture))| {
                extract(picture, None, &SiftOptions { max_features: budget(k).max(1), ..options.clone() })
            })
            .collect();
        for (k, condition) in conditions.iter().enumerate() {
            let map = condition.second_from_first(size.0, size.1);
            let second_size = (all[k].1.width, all[k].1.height);
            // The first row compares two pictures of different noise.
            let first = if k == 0 { all.len() - 1 } else { 0 };
            for (side, features) in [Some(&ours), theirs.as_ref()].into_iter().enumerate() {
                let Some(features) = features else { continue };
                let (a, b) = (&features[first], &features[k]);
                let matches: Vec<(u32, u32)> = match_features(a, b, &MatchOptions::default())
                    .iter()
                    .map(|m| (m.first, m.second))
                    .collect();
                totals[k][side].add(&score((a, size), (b, second_size), &matches, &map));
            }
        }
    }
    print(&conditions, &totals);
}

/// All pictures of a photograph by condition, then a second one of the first.
fn render(photo: &Path, conditions: &[Condition], dir: &Path) -> Vec<(String, GrayImage)> {
    std::fs::create_dir_all(dir).expect("a folder");
    let path = photo.to_string_lossy();
    let stem: String = path.chars().map(|c| if c.is_alphanumeric() { c } else { '_' }).collect();
    let stem = &stem[stem.len().saturating_sub(40)..];
    let decoded = std::cell::OnceCell::new();
    let original = || {
        decoded.get_or_init(|| {
            let bytes = std::fs::read(photo).expect("readable");
            let luma = image::decode(&bytes, &image::DecodeOptions::default()).expect("an image").luma;
            Picture { width: luma.width, height: luma.height, pixels: luma.data }
                .middle(MIDDLE_PX.0, MIDDLE_PX.1)
        })
    };
    let again = conditions.iter().chain(std::iter::once(&conditions[0])).enumerate();
    again
        .map(|(k, condition)| {
            let name = format!("{stem}-{k:02}.png");
            let file = dir.join(&name);
            if !file.exists() {
                write_png(&file, &condition.render(original(), 1 + k as u64));
            }
            let bytes = std::fs::read(&file).expect("readable");
            (name, image::decode(&bytes, &image::DecodeOptions::default()).expect("an image").luma)
        })
        .collect()
}

fn write_png(file: &Path, picture: &Picture) {
    let out = std::fs::File::create(file).expect("writable");
    let mut encoder = png::Encoder::new(out, picture.width as u32, picture.height as u32);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.write_header().and_then(|mut w| w.write_image_data(&picture.pixels)).expect("writable");
}

/// Means over photographs.
#[derive(Clone, Copy, Default)]
struct Total {
    count: f64,
    shown: f64,
    repeatability: f64,
    matching_score: f64,
    precision: f64,
    correct: f64,
    error_px: f64,
}

impl Total {
    fn add(&mut self, score: &Score) {
        self.count += 1.0;
        self.shown += score.shown as f64;
        self.repeatability += score.repeatability();
        self.matching_score += score.matching_score();
        self.precision += score.precision();
        self.correct += score.correct as f64;
        self.error_px += score.median_error_px;
    }
}

fn print(conditions: &[Condition], totals: &[[Total; 2]]) {
    println!(
        "| condition | features shown | repeatability % | matching score % | right matches | precision % | error px |"
    );
    println!("|---|---|---|---|---|---|---|");
    let mut worse = 0;
    for (condition, sides) in conditions.iter().zip(totals) {
        let both = |value: &dyn Fn(&Total) -> f64, digits: usize| {
            let cells = sides.iter().filter(|side| side.count > 0.0);
            cells.map(|side| format!("{:.digits$}", value(side) / side.count)).collect::<Vec<_>>().join(" / ")
        };
        let columns = [
            both(&|t| t.shown, 0),
            both(&|t| 100.0 * t.repeatability, 2),
            both(&|t| 100.0 * t.matching_score, 2),
            both(&|t| t.correct, 0),
            both(&|t| 100.0 * t.precision, 1),
            both(&|t| t.error_px, 3),
        ];
        let [ours, theirs] = sides;
        let is_worse = theirs.count > 0.0
            && (ours.repeatability < theirs.repeatability || ours.matching_score < theirs.matching_score);
        worse += usize::from(is_worse);
        println!(
            "| {}{} | {} |",
            condition.name,
            if is_worse { " (worse)" } else { "" },
            columns.join(" | ")
        );
    }
    println!("\nours / the peer's; {worse} of {} rows worse", conditions.len());
}
