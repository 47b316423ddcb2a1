//! Verified inliers of pairs of real photographs, side by side with a peer's features of the same files:
//! `inliers [--first-octave -1] [--max N] [--reach N] [--focal PX] --peer DIR PHOTO...`.
//!
//! Each photograph is paired with the `--reach` that follow it. Both sides' features go through the same matching and
//! verification, so that the features alone differ.

#[path = "peer/mod.rs"]
mod peer;

use std::path::PathBuf;

use terrane_frontend::matching::{MatchOptions, match_features};
use terrane_frontend::sift::{FirstOctave, SiftOptions, extract};
use terrane_frontend::verification::{Candidate, VerificationOptions, View, verify};
use terrane_frontend::{cameras, image, metadata};
use terrane_geometry::{Camera, CameraModel, Seed};
use terrane_scene::{CameraRecord, Features, FocalSource, ImageId, ImagePair};

fn main() {
    let mut options = SiftOptions::default();
    let (mut peer_dir, mut reach, mut focal, mut photos) = (None, 2, None, Vec::new());
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        let mut value = || arguments.next().unwrap_or_else(|| panic!("{argument} needs a value"));
        match argument.as_str() {
            "--peer" => peer_dir = Some(PathBuf::from(value())),
            "--max" => options.max_features = value().parse().expect("a number"),
            "--spread" => options.spread = value().parse().expect("a number"),
            "--reach" => reach = value().parse().expect("a number"),
            "--focal" => focal = Some(value().parse::<f64>().expect("a number")),
            "--first-octave" if value() == "-1" => options.first_octave = FirstOctave::Doubled,
            "--first-octave" => options.first_octave = FirstOctave::Original,
            _ => photos.push(PathBuf::from(argument)),
        }
    }
    let peer_dir = peer_dir.expect("--peer DIR");
    let mut images: Vec<(CameraRecord, [Features; 2])> = Vec::new();
    for photo in &photos {
        let bytes = std::fs::read(photo).expect("readable");
        let decoded = image::decode(&bytes, &image::DecodeOptions::default()).expect("an image");
        let focal_px = focal
            .unwrap_or_else(|| cameras::estimate_focal(&metadata::read(&bytes).expect("an image")).focal_px);
        let (width, height) = (decoded.luma.width as u32, decoded.luma.height as u32);
        let camera = Camera::centered(CameraModel::SimpleRadial, width, height, focal_px);
        let source = if focal.is_some() { FocalSource::Given } else { FocalSource::Exif };
        let theirs = peer::read(&peer_dir.join(photo.file_name().expect("a file")));
        let ours = extract(&decoded.luma, None, &options);
        let record = CameraRecord { camera, focal_source: source, name: String::new() };
        images.push((record, [ours, theirs]));
    }
    let mut ratios = Vec::new();
    let mut sums = [0; 2];
    for a in 0..images.len() {
        for b in a + 1..images.len().min(a + 1 + reach) {
            let found = [0, 1].map(|side| verified(&images, (a, b), side));
            println!("{a} {b}: matches and inliers {:?}, the peer's {:?}", found[0], found[1]);
            sums = [sums[0] + found[0].1, sums[1] + found[1].1];
            if found[1].1 > 0 {
                ratios.push(found[0].1 as f64 / found[1].1 as f64);
            }
        }
    }
    ratios.sort_by(f64::total_cmp);
    let median = ratios.get(ratios.len() / 2).copied().unwrap_or(f64::NAN);
    let counts = [0, 1].map(|side| images.iter().map(|(_, f)| f[side].len()).sum::<usize>() / images.len());
    println!(
        "inliers {sums:?}, median ratio {median:.3} over {} pairs; features an image {counts:?}",
        ratios.len()
    );
}

/// Matches of a pair and verified inliers.
fn verified(images: &[(CameraRecord, [Features; 2])], (a, b): (usize, usize), side: usize) -> (usize, usize) {
    let ((first_camera, first), (second_camera, second)) = (&images[a], &images[b]);
    let matches = match_features(&first[side], &second[side], &MatchOptions::default());
    let candidate = Candidate {
        pair: ImagePair::new(ImageId::from_index(a), ImageId::from_index(b)).expect("two images"),
        first: View { camera: first_camera, keypoints: &first[side].keypoints },
        second: View { camera: second_camera, keypoints: &second[side].keypoints },
        matches: &matches,
    };
    let inliers =
        verify(&candidate, &VerificationOptions::default(), Seed(1)).map_or(0, |pair| pair.matches.len());
    (matches.len(), inliers)
}
