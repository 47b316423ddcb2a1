//! A finished run's features and matches as a COLMAP database, so that its mappers and tools can work on them.

use std::path::{Path, PathBuf};

use nalgebra::{Matrix3, Vector2};
use serde::Deserialize;
use terrane_geometry::two_view::{essential_from_pose, estimate_homography};
use terrane_geometry::{Camera, RansacOptions, Seed, fundamental::fundamental_from_eight};
use terrane_scene::codec::Kind;
use terrane_scene::colmap::database::{DatabaseGeometry, DatabaseWriter, SIFT_DESCRIPTORS, config_of};
use terrane_scene::{
    CameraRecord, FocalSource, ImageId, ImageTable, Keypoint, MatchedPair, PairKind, SceneError,
};

use crate::execute::read;
use crate::task::FinishedRun;
use crate::{ArtefactKey, PipelineError, Store};

/// How much a database holds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DatabaseFigures {
    /// Images.
    pub images: u64,
    /// Keypoints of all images.
    pub keypoints: u64,
    /// Verified pairs.
    pub pairs: u64,
    /// Matches of all pairs.
    pub matches: u64,
}

/// `run.json`, as far as it is needed.
#[derive(Deserialize)]
struct RunFile {
    result: ArtefactKey,
}

/// Writes the database of the finished run whose result lies in `out` and whose artefacts lie in `store`.
///
/// Cameras are those that the run began with: the database stands before mapping. Matches, raw ones and inliers, are the
/// verified ones, as no others are kept. Image and camera ids are terrane's plus one. One image and one block of pairs
/// are in memory at a time. The file is made beside its place and then renamed into it; the same run gives the same bytes.
///
/// # Errors
/// Invalid input when `out` holds no finished run; a missing artefact when the store was cleared; storage errors.
pub fn write_database(out: &Path, store: &Store, target: &Path) -> Result<DatabaseFigures, PipelineError> {
    let run = finished_run(out, store)?;
    let table = read::table(store, &run.table)?.table;
    let unfinished = unfinished(target);
    match std::fs::remove_file(&unfinished) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => return Err(io(&unfinished, &error)),
        _ => {}
    }
    let written = write(store, &run, &table, &unfinished);
    let done = written.and_then(|figures| {
        std::fs::rename(&unfinished, target).map_err(|error| io(target, &error)).map(|()| figures)
    });
    if done.is_err() {
        let _ = std::fs::remove_file(&unfinished);
    }
    done
}

fn finished_run(out: &Path, store: &Store) -> Result<FinishedRun, PipelineError> {
    let path = out.join("run.json");
    let text = std::fs::read_to_string(&path).map_err(|error| {
        PipelineError::invalid_input(format!(
            "{}: {error}; give the folder of a finished run",
            path.display()
        ))
    })?;
    let file: RunFile = serde_json::from_str(&text).map_err(|error| {
        PipelineError::invalid_input(format!("{}: {error}: run again with this terrane", path.display()))
    })?;
    if store.head(&file.result.path())?.is_none() {
        return Err(PipelineError::invalid_input(format!(
            "the artefacts of {} are not in {} any more: run again, with the same options",
            out.display(),
            store.place()
        )));
    }
    read::record(store, &file.result, Kind::Record, read::FINISHED)
}

fn unfinished(target: &Path) -> PathBuf {
    let mut name = target.as_os_str().to_owned();
    name.push(".unfinished");
    name.into()
}

fn io(path: &Path, error: &std::io::Error) -> PipelineError {
    PipelineError::io(&format!("{} can't be written", path.display()), error)
}

/// The writer's error as ours.
fn failed(path: &Path) -> impl Fn(SceneError) -> PipelineError {
    move |error| match error.into_source() {
        Ok(source) => match source.downcast::<std::io::Error>() {
            Ok(error) => io(path, &error),
            Err(other) => PipelineError::storage(format!("{} can't be written: {other}", path.display())),
        },
        Err(error) => PipelineError::bug(format!("{} can't be written: {error}", path.display())),
    }
}

fn write(
    store: &Store,
    run: &FinishedRun,
    table: &ImageTable,
    path: &Path,
) -> Result<DatabaseFigures, PipelineError> {
    let failed = failed(path);
    let mut writer = DatabaseWriter::create(path).map_err(&failed)?;
    let mut figures = DatabaseFigures::default();
    for (at, record) in table.cameras.iter().enumerate() {
        let is_known = record.focal_source != FocalSource::Guess;
        writer.camera(at as i64 + 1, &record.camera, is_known).map_err(&failed)?;
    }
    for image in table.ids() {
        let (record, id) = (table.image(image), number(image));
        let camera = i64::from(record.camera.0) + 1;
        writer.image(id, &record.path, camera).map_err(&failed)?;
        if let Some(gps) = &record.gps {
            writer.position(id, camera, gps).map_err(&failed)?;
        }
        let features = read::features(store, &run.features, image)?;
        writer.keypoints(id, &features.keypoints).map_err(&failed)?;
        if !features.descriptors.is_empty() {
            let count = features.len();
            writer.descriptors(id, SIFT_DESCRIPTORS, count, &features.descriptors).map_err(&failed)?;
        }
        figures.images += 1;
        figures.keypoints += features.len() as u64;
    }
    for key in &run.matches {
        let pairs = read::matches(store, key, |_| true)?;
        let mut keypoints = std::collections::BTreeMap::new();
        for image in pairs.iter().flat_map(|pair| [pair.summary.pair.first(), pair.summary.pair.second()]) {
            if let std::collections::btree_map::Entry::Vacant(vacant) = keypoints.entry(image) {
                vacant.insert(read::keypoints(store, &run.features, image)?.0);
            }
        }
        for pair in &pairs {
            let images = [pair.summary.pair.first(), pair.summary.pair.second()];
            let [first, second] = images.map(number);
            let keypoints = images.map(|image| keypoints.get(&image).map_or(&[][..], Vec::as_slice));
            let cameras = images.map(|image| table.camera_of(image));
            writer.matches(first, second, &pair.matches).map_err(&failed)?;
            writer.geometry(first, second, &geometry(pair, &cameras, keypoints)).map_err(&failed)?;
            figures.pairs += 1;
            figures.matches += pair.matches.len() as u64;
        }
    }
    writer.finish().map_err(&failed)?;
    Ok(figures)
}

fn number(image: ImageId) -> i64 {
    i64::from(image.0) + 1
}

/// Sampling of homographies, of which nearly all matches are inliers.
const HOMOGRAPHY: RansacOptions = RansacOptions {
    max_iterations: 200,
    min_iterations: 30,
    confidence: 0.999,
    order: terrane_geometry::ransac::SampleOrder::Uniform,
};
/// Greatest transfer error of such an inlier in pixels, as in verification.
const HOMOGRAPHY_ERROR_PX: f64 = 4.0;

/// A verified pair with the matrices that it stands for.
///
/// A pose, and the epipolar matrices that follow from it, only where intrinsics are trusted and the matches agree with them:
/// COLMAP's global mapper takes a pose that is there for good, and one that rests on a guess bends the result.
/// Elsewhere the fundamental matrix of the matches; a homography where they lie on one.
fn geometry<'a>(
    pair: &'a MatchedPair,
    cameras: &[&CameraRecord; 2],
    keypoints: [&[Keypoint]; 2],
) -> DatabaseGeometry<'a> {
    let kind = pair.summary.kind;
    let is_trusted = cameras.iter().all(|record| record.focal_source != FocalSource::Guess);
    let pose = pair.summary.second_from_first.filter(|_| is_trusted && kind != PairKind::Uncalibrated);
    let [first, second] = cameras.map(|record| intrinsic_matrix(&record.camera));
    let inverses = (first.try_inverse(), second.try_inverse());
    let essential = pose
        .as_ref()
        .filter(|_| matches!(kind, PairKind::Calibrated | PairKind::Planar))
        .map(|pose| essential_from_pose(pose).normalize());
    let points = |side: usize| -> Vec<Vector2<f64>> {
        let place = |index: &[u32; 2]| keypoints[side].get(index[side] as usize);
        let as_point = |k: &Keypoint| Vector2::new(f64::from(k.x_px), f64::from(k.y_px));
        pair.matches.iter().filter_map(place).map(as_point).collect()
    };
    let fundamental = match (essential, inverses) {
        (Some(essential), (Some(first), Some(second))) => Some(second.transpose() * essential * first),
        _ if kind.has_baseline() => fundamental_from_eight(&points(0), &points(1)),
        _ => None,
    };
    let homography = match (kind, &pose, inverses.0) {
        (PairKind::Planar, ..) => {
            let seed = Seed(0).derive("homography");
            estimate_homography(&points(0), &points(1), HOMOGRAPHY_ERROR_PX, &HOMOGRAPHY, seed)
                .map(|found| found.model)
        }
        (PairKind::Panoramic, Some(pose), Some(first)) => Some(second * pose.rotation_matrix() * first),
        _ => None,
    };
    DatabaseGeometry {
        config: config_of(kind),
        matches: &pair.matches,
        fundamental,
        essential,
        homography,
        second_from_first: pose,
    }
}

/// The matrix that takes points of the plane z = 1 to pixels, without distortion.
fn intrinsic_matrix(camera: &Camera) -> Matrix3<f64> {
    let (focal, center) = (camera.focal_px(), camera.principal_point_px());
    Matrix3::new(focal.x, 0.0, center.x, 0.0, focal.y, center.y, 0.0, 0.0, 1.0)
}
