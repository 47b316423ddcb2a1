//! Features and matches from a COLMAP database instead of from pixels.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use rayon::prelude::*;
use terrane_frontend::image::{self, DecodedImage};
use terrane_frontend::matching::Match;
use terrane_frontend::pairs::{PairReport, PairSelection};
use terrane_geometry::Camera;
use terrane_scene::colmap::database::{Database, DatabaseCamera, DatabaseImage};
use terrane_scene::{
    CameraId, CameraRecord, Features, FocalSource, ImageId, ImagePair, ImageRecord, ImageTable, Keypoint,
    RejectedImage, SceneError,
};

use super::ExecutionContext;
use super::ingest::Usable;
use super::inputs::{Imported, ImportedImage, read_unchanged};
use crate::PipelineError;
use crate::listing::stamp;

/// Images that one connection looks through before the next is opened.
const IMAGES_AT_ONCE: usize = 64;
/// Colour of what is seen in a photograph that is not there.
const GREY: [u8; 3] = [128; 3];

fn path(context: &ExecutionContext) -> Result<&PathBuf, PipelineError> {
    context.config.import.as_ref().ok_or_else(|| PipelineError::bug("a run without import imports"))
}

/// Opens the run's database.
fn open(context: &ExecutionContext) -> Result<Database, PipelineError> {
    Database::open(path(context)?).map_err(|error| failed(context, error))
}

/// Opens the run's database, which must be the one that the run began with.
fn open_unchanged(context: &ExecutionContext, imported: &Imported) -> Result<Database, PipelineError> {
    let path = path(context)?;
    if stamp(path)? != imported.stamp {
        return Err(PipelineError::invalid_input(format!(
            "{} changed during the run: run again to begin with the new file",
            path.display()
        )));
    }
    open(context)
}

/// The reader's error as ours: the file is at fault, or the disk.
fn failed(context: &ExecutionContext, error: SceneError) -> PipelineError {
    let name = context.config.import.as_ref().map(|path| path.display().to_string()).unwrap_or_default();
    match error.into_source() {
        Ok(source) => match source.downcast::<std::io::Error>() {
            Ok(io) => PipelineError::io(&format!("can't read {name}"), &io),
            Err(other) => PipelineError::storage(format!("can't read {name}: {other}")),
        },
        Err(error) => PipelineError::invalid_input(format!("{name}: {error}")),
    }
}

/// The images that a database knows, with their cameras as it has them, joined with the photographs that are there.
///
/// A photograph that the database does not know is left out with the reason. An image without a photograph stays: it has
/// features, and only lacks colours and whatever the file would say of position and time.
pub(super) fn table(
    context: &ExecutionContext,
    photographs: Vec<Usable>,
    mut rejected: Vec<RejectedImage>,
) -> Result<(ImageTable, Imported), PipelineError> {
    let began = stamp(path(context)?)?;
    let database = open(context)?;
    let cameras = database.cameras().map_err(|error| failed(context, error))?;
    let mut images = database.images().map_err(|error| failed(context, error))?;
    images.sort_by(|a, b| a.name.cmp(&b.name));
    if let Some(list) = &context.config.list {
        let list: BTreeSet<&str> = list.iter().map(|path| path.trim()).collect();
        images.retain(|image| list.contains(image.name.as_str()));
    }
    // A listed photograph that is not there is as good as one that is not listed.
    let known: BTreeSet<&str> = images.iter().map(|image| image.name.as_str()).collect();
    rejected.retain(|file| {
        !known.contains(file.path.as_str()) || context.config.photos.join(&file.path).exists()
    });
    let mut by_path: BTreeMap<String, Usable> =
        photographs.into_iter().map(|photograph| (photograph.path.clone(), photograph)).collect();
    let unreadable: BTreeMap<String, String> =
        rejected.iter().map(|file| (file.path.clone(), file.reason.clone())).collect();
    let mut join = Join::new(context, &cameras);
    let mut ids = Vec::new();
    for image in images {
        let joined = match unreadable.get(&image.name) {
            // Told already.
            Some(_) => continue,
            None => join.image(&image, by_path.remove(&image.name)),
        };
        match joined {
            Ok(()) => ids.push(image.id),
            Err(reason) => rejected.push(RejectedImage { path: image.name, reason }),
        }
    }
    let reason = "the imported database has no image of this name";
    rejected.extend(by_path.into_keys().map(|path| RejectedImage { path, reason: reason.to_owned() }));
    rejected.sort_by(|a, b| a.path.cmp(&b.path));
    let table = ImageTable { cameras: join.cameras, images: join.images, rejected };
    let imported = examine(context, &ids, began)?;
    Ok((table, imported))
}

/// Images under way.
struct Join<'a> {
    context: &'a ExecutionContext,
    of_database: BTreeMap<i64, &'a DatabaseCamera>,
    ids: BTreeMap<i64, CameraId>,
    cameras: Vec<CameraRecord>,
    images: Vec<ImageRecord>,
}

impl<'a> Join<'a> {
    fn new(context: &'a ExecutionContext, cameras: &'a [DatabaseCamera]) -> Self {
        let of_database = cameras.iter().map(|camera| (camera.id, camera)).collect();
        Self { context, of_database, ids: BTreeMap::new(), cameras: Vec::new(), images: Vec::new() }
    }

    /// Adds an image, or says why it can't be used.
    fn image(&mut self, image: &DatabaseImage, photograph: Option<Usable>) -> Result<(), String> {
        let found = self.of_database.get(&image.camera).copied();
        let found = found.ok_or_else(|| format!("camera {} is not in the database", image.camera))?;
        let camera = found.camera.clone()?;
        let metadata = photograph.as_ref().map(|photograph| &photograph.metadata);
        if let Some(metadata) =
            metadata.filter(|m| (m.width_px, m.height_px) != (camera.width_px, camera.height_px))
        {
            return Err(format!(
                "the photograph has {} x {} pixels and its camera in the database {} x {}: give the photographs \
                 that the features were computed on",
                metadata.width_px, metadata.height_px, camera.width_px, camera.height_px
            ));
        }
        let id = match self.ids.get(&image.camera) {
            Some(id) => *id,
            None => {
                let id = CameraId::from_index(self.cameras.len());
                self.cameras.push(self.camera(found, camera)?);
                self.ids.insert(image.camera, id);
                id
            }
        };
        self.images.push(ImageRecord {
            path: image.name.clone(),
            camera: id,
            width_px: camera.width_px,
            height_px: camera.height_px,
            orientation: metadata.map(|metadata| metadata.orientation).unwrap_or_default(),
            gps: metadata.and_then(|metadata| metadata.gps),
            flight: metadata.and_then(|metadata| metadata.flight),
            captured_s: metadata.and_then(|metadata| metadata.captured_s),
            content_hash: photograph.map(|photograph| photograph.content_hash).unwrap_or_default(),
        });
        Ok(())
    }

    fn camera(&self, found: &DatabaseCamera, camera: Camera) -> Result<CameraRecord, String> {
        let name = format!("camera {} of the imported database", found.id);
        if let Some(given) = &self.context.config.camera {
            let camera =
                given.camera(camera.width_px, camera.height_px).map_err(|error| error.to_string())?;
            return Ok(CameraRecord { camera, focal_source: FocalSource::Given, name });
        }
        let focal_source = if found.has_prior_focal { FocalSource::Exif } else { FocalSource::Guess };
        Ok(CameraRecord { camera, focal_source, name })
    }
}

/// Looks through everything that the run will read: broken rows end it now and not hours later. Ids are those of the
/// images of the table, in its order.
fn examine(context: &ExecutionContext, ids: &[i64], began: String) -> Result<Imported, PipelineError> {
    let failed = |error| failed(context, error);
    let database = open(context)?;
    let known: BTreeMap<i64, usize> = ids.iter().enumerate().map(|(at, id)| (*id, at)).collect();
    let mut pairs = database.pairs().map_err(failed)?;
    pairs.retain(|pair| known.contains_key(&pair.first) && known.contains_key(&pair.second));
    let matched = !pairs.is_empty();
    let mut images = Vec::with_capacity(ids.len());
    let mut num_keypoints = Vec::with_capacity(ids.len());
    for ids in ids.chunks(IMAGES_AT_ONCE) {
        context.cancel.check()?;
        for id in ids {
            let keypoints = database.keypoints(*id).map_err(failed)?.unwrap_or_default();
            let mut hasher = blake3::Hasher::new();
            for k in &keypoints {
                [k.x_px, k.y_px, k.scale_px, k.orientation_rad].iter().for_each(|value| {
                    hasher.update(&value.to_le_bytes());
                });
            }
            if !matched {
                hasher.update(&descriptors(context, &database, *id, keypoints.len())?);
            }
            num_keypoints.push(keypoints.len());
            images.push(ImportedImage { id: *id, digest: crate::key::hex(hasher.finalize().as_bytes()) });
        }
    }
    let mut hasher = blake3::Hasher::new();
    for pair in &pairs {
        context.cancel.check()?;
        let matches = database.matches(pair.first, pair.second).map_err(failed)?;
        let counts = [pair.first, pair.second].map(|id| known.get(&id).map_or(0, |at| num_keypoints[*at]));
        let outside = matches.iter().find(|m| m[0] as usize >= counts[0] || m[1] as usize >= counts[1]);
        if let Some([a, b]) = outside {
            return Err(PipelineError::invalid_input(format!(
                "{}: images {} and {} have {} and {} keypoints, and a match of keypoints {a} and {b}",
                path(context)?.display(),
                pair.first,
                pair.second,
                counts[0],
                counts[1]
            )));
        }
        hasher.update(&pair.first.to_le_bytes());
        hasher.update(&pair.second.to_le_bytes());
        for index in matches.iter().flatten() {
            hasher.update(&index.to_le_bytes());
        }
    }
    let matches_digest = matched.then(|| crate::key::hex(hasher.finalize().as_bytes()));
    Ok(Imported { stamp: began, images, matches_digest, num_pairs: pairs.len() as u64 })
}

/// The descriptors of an image that terrane is to match, which must be of SIFT's shape and as many as keypoints.
fn descriptors(
    context: &ExecutionContext,
    database: &Database,
    image: i64,
    num_keypoints: usize,
) -> Result<Vec<u8>, PipelineError> {
    let failed = |error| failed(context, error);
    let wrong = |what: String| {
        let name = context.config.import.as_ref().map(|path| path.display().to_string()).unwrap_or_default();
        Err(PipelineError::invalid_input(format!(
            "{name} has no matches, and {what}: match its features with the program that made them, or give a \
             database with SIFT's descriptors"
        )))
    };
    let Some(layout) = database.descriptor_layout(image).map_err(failed)? else {
        return match num_keypoints {
            0 => Ok(Vec::new()),
            _ => wrong(format!("image {image} has no descriptors")),
        };
    };
    if layout.rows > 0 && !layout.is_sift() {
        let (bytes, kind) = (layout.row_bytes, layout.kind);
        return wrong(format!("descriptors of image {image} are of {bytes} bytes and kind {kind}"));
    }
    if layout.rows != num_keypoints {
        return wrong(format!("image {image} has {num_keypoints} keypoints and {} descriptors", layout.rows));
    }
    database.descriptors(image).map_err(failed)
}

/// The features of images, in order; colours from the photographs that are there.
pub(super) fn features(
    context: &ExecutionContext,
    table: &ImageTable,
    imported: &Imported,
    images: &[ImageId],
) -> Result<Vec<Result<Features, String>>, PipelineError> {
    let database = open_unchanged(context, imported)?;
    let mut found = Vec::with_capacity(images.len());
    for image in images {
        let entry = imported.images.get(image.index());
        let id = entry.ok_or_else(|| PipelineError::bug(format!("image {image} is not imported")))?.id;
        let keypoints = database.keypoints(id).map_err(|error| failed(context, error))?;
        let Some(keypoints) = keypoints.filter(|keypoints| !keypoints.is_empty()) else {
            found.push(Err("the imported database has no keypoints of it".to_owned()));
            continue;
        };
        let descriptors = match imported.matches_digest {
            Some(_) => Vec::new(),
            None => descriptors(context, &database, id, keypoints.len())?,
        };
        found.push(Ok(Features { keypoints, descriptors, ..Features::default() }));
    }
    found
        .into_par_iter()
        .zip(images)
        .map(|(outcome, image)| {
            let Ok(mut features) = outcome else { return Ok(outcome) };
            let photograph = photograph(context, table.image(*image))?;
            features.colors = features.keypoints.iter().map(|k| color_at(photograph.as_ref(), k)).collect();
            Ok(Ok(features))
        })
        .collect()
}

/// The pixels of an image; `None` without a photograph, or when it can't be decoded: features there are all the same.
fn photograph(
    context: &ExecutionContext,
    record: &ImageRecord,
) -> Result<Option<DecodedImage>, PipelineError> {
    if record.content_hash.is_empty() {
        return Ok(None);
    }
    let bytes = read_unchanged(&context.config.photos.join(&record.path), &record.content_hash)?;
    Ok(image::decode(&bytes, &context.config.features.decode).ok())
}

fn color_at(photograph: Option<&DecodedImage>, keypoint: &Keypoint) -> [u8; 3] {
    let Some(DecodedImage { luma, rgb }) = photograph else { return GREY };
    let pixel = |at: f32, len: usize| (at.max(0.0) as usize).min(len.saturating_sub(1));
    let at = pixel(keypoint.y_px, luma.height) * luma.width + pixel(keypoint.x_px, luma.width);
    let colour = rgb.as_ref().and_then(|rgb| rgb.data.get(3 * at..)?.first_chunk::<3>().copied());
    colour.or_else(|| luma.data.get(at).map(|grey| [*grey; 3])).unwrap_or(GREY)
}

/// The pairs that have matches.
pub(super) fn pairs(
    context: &ExecutionContext,
    table: &ImageTable,
    imported: &Imported,
) -> Result<PairSelection, PipelineError> {
    let database = open_unchanged(context, imported)?;
    let ids = imported.images.iter().enumerate();
    let image_of: BTreeMap<i64, ImageId> =
        ids.map(|(at, image)| (image.id, ImageId::from_index(at))).collect();
    let found = database.pairs().map_err(|error| failed(context, error))?;
    let mut pairs: Vec<ImagePair> = found
        .iter()
        .filter_map(|pair| ImagePair::new(*image_of.get(&pair.first)?, *image_of.get(&pair.second)?))
        .collect();
    pairs.sort_unstable();
    let mut is_paired = vec![false; table.images.len()];
    for image in pairs.iter().flat_map(|pair| [pair.first(), pair.second()]) {
        is_paired[image.index()] = true;
    }
    let report = PairReport {
        num_images: table.images.len() as u32,
        num_pairs: pairs.len() as u64,
        from_list: pairs.len() as u64,
        images_without_pair: table.ids().filter(|image| !is_paired[image.index()]).collect(),
        ..Default::default()
    };
    Ok(PairSelection { pairs, report })
}

/// The matches of pairs, in order. All are as good as any other: databases say nothing of their quality.
pub(super) fn matches(
    context: &ExecutionContext,
    imported: &Imported,
    pairs: &[ImagePair],
) -> Result<Vec<Vec<Match>>, PipelineError> {
    let database = open_unchanged(context, imported)?;
    let id_of = |image: ImageId| {
        let entry = imported.images.get(image.index());
        entry
            .map(|image| image.id)
            .ok_or_else(|| PipelineError::bug(format!("image {image} is not imported")))
    };
    let as_match = |[first, second]: [u32; 2]| Match { first, second, ratio: 0.0 };
    pairs
        .iter()
        .map(|pair| {
            let found = database.matches(id_of(pair.first())?, id_of(pair.second())?);
            Ok(found.map_err(|error| failed(context, error))?.into_iter().map(as_match).collect())
        })
        .collect()
}
