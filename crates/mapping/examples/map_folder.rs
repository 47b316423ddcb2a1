//! Maps a folder of photographs in one go, every pair matched, and writes COLMAP's format: `map_folder PHOTOS OUT [CAMERA]`.
//!
//! For trying the mapper by itself; `terrane run` is the way for users. `CAMERA` is as `PINHOLE:fx,fy,cx,cy`. Submaps go to
//! `OUT/0`, `OUT/1` …, largest first.

use std::error::Error;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use terrane_frontend::cameras::{self, GivenCamera};
use terrane_frontend::metadata::{self, ImageMetadata};
use terrane_frontend::verification::{self, Candidate, View};
use terrane_frontend::{image, matching, sift};
use terrane_geometry::Seed;
use terrane_mapping::{ClusterImage, ClusterInput, MappingOptions, reconstruct};
use terrane_scene::colmap::{self, ModelFiles};
use terrane_scene::{
    CameraId, CameraRecord, ClusterId, Features, ImageFate, ImageId, ImagePair, MatchedPair,
};

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().collect();
    let (Some(photos), Some(out)) = (args.get(1), args.get(2)) else {
        return Err("usage: map_folder PHOTOS OUT [CAMERA]".into());
    };
    let given = match args.get(3) {
        Some(text) => Some(text.parse::<GivenCamera>()?),
        None => None,
    };
    let files = photos_in(Path::new(photos))?;
    let (named, features) = read_all(&files)?;
    let (records, camera_of) = cameras::group(&named, given.as_ref());
    let pairs = match_all(&records, &camera_of, &features);
    let input = cluster(records, camera_of, features, pairs);
    let (outcome, report) = reconstruct(&input, &MappingOptions::default(), Seed(1))?;
    println!("{report:#?}");
    for (image, fate) in &outcome.fates {
        if let ImageFate::LeftOut { reason } = fate {
            println!("{}: {reason}", named[image.index()].0);
        }
    }
    for (at, submap) in outcome.submaps.iter().enumerate() {
        let folder = Path::new(out).join(at.to_string());
        std::fs::create_dir_all(&folder)?;
        let create = |name: &str| File::create(folder.join(name)).map(BufWriter::new);
        let files = ModelFiles {
            cameras: create("cameras.bin")?,
            images: create("images.bin")?,
            points: create("points3D.bin")?,
        };
        colmap::write_binary(&submap.reconstruction, &|image| named[image.index()].0.clone(), files)?;
    }
    Ok(())
}

fn photos_in(folder: &Path) -> Result<Vec<PathBuf>, Box<dyn Error>> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder)? {
        files.push(entry?.path());
    }
    files.retain(|path| path.is_file());
    files.sort();
    Ok(files)
}

/// Names with metadata, and features. One photograph at a time, as decoding is what takes memory.
type Photographs = (Vec<(String, ImageMetadata)>, Vec<Features>);

fn read_all(files: &[PathBuf]) -> Result<Photographs, Box<dyn Error>> {
    let (mut named, mut features) = (Vec::new(), Vec::new());
    for path in files {
        let bytes = std::fs::read(path)?;
        let decoded = image::decode(&bytes, &image::DecodeOptions::default())?;
        features.push(sift::extract(&decoded.luma, decoded.rgb.as_ref(), &sift::SiftOptions::default()));
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        named.push((name, metadata::read(&bytes)?));
    }
    Ok((named, features))
}

fn match_all(records: &[CameraRecord], camera_of: &[CameraId], features: &[Features]) -> Vec<MatchedPair> {
    let count = features.len();
    let ordinals: Vec<(usize, usize)> =
        (0..count).flat_map(|a| (a + 1..count).map(move |b| (a, b))).collect();
    let view =
        |at: usize| View { camera: &records[camera_of[at].index()], keypoints: &features[at].keypoints };
    let verified: Vec<Option<MatchedPair>> = ordinals
        .par_iter()
        .map(|&(a, b)| {
            let matches = matching::match_features(&features[a], &features[b], &Default::default());
            let pair = ImagePair::new(ImageId::from_index(a), ImageId::from_index(b))?;
            let candidate = Candidate { pair, first: view(a), second: view(b), matches: &matches };
            verification::verify(&candidate, &Default::default(), Seed(1)).ok()
        })
        .collect();
    verified.into_iter().flatten().collect()
}

fn cluster(
    records: Vec<CameraRecord>,
    camera_of: Vec<CameraId>,
    features: Vec<Features>,
    pairs: Vec<MatchedPair>,
) -> ClusterInput {
    let images =
        features.into_iter().zip(camera_of).enumerate().map(|(at, (features, camera))| ClusterImage {
            image: ImageId::from_index(at),
            camera,
            keypoints_px: features.keypoints.iter().map(|point| [point.x_px, point.y_px]).collect(),
            colors: features.colors,
            position_prior: None,
        });
    let cameras = records.into_iter().enumerate().map(|(at, record)| (CameraId::from_index(at), record));
    ClusterInput { cluster: ClusterId(0), images: images.collect(), cameras: cameras.collect(), pairs }
}
