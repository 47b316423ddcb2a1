//! COLMAP's sparse models, binary and text.
//!
//! Ids: image and camera ids are ours plus one, points are numbered from one in the order of the shards. The 2D points of
//! an image are its observed features in the order of their indices: features that see nothing are not written.
//! Names are paths relative to the photographs' folder. Formats as documented by COLMAP 3.x ("Output Format"); rigs and
//! frames, which COLMAP 4 writes besides, may be absent.

mod binary;
#[cfg(feature = "sqlite")]
pub mod database;
mod layout;
mod read;
mod text;

use std::io::Write;

use nalgebra::Vector3;
use terrane_geometry::{Camera, Rigid3};

use crate::{CameraId, ImageId, Model, SceneError};

pub use read::{ColmapModel, read_binary};

/// The three files of a model.
pub struct ModelFiles<W> {
    /// `cameras.bin` or `cameras.txt`.
    pub cameras: W,
    /// `images.bin` or `images.txt`.
    pub images: W,
    /// `points3D.bin` or `points3D.txt`.
    pub points: W,
}

/// The 2D points of images that are gathered at a time; beyond it the shards are read again. 32 bytes each.
const GATHERED_OBSERVATIONS: u64 = 4_000_000;

/// Writes a model in COLMAP's binary format. Beside one shard and the points of some images, 4 bytes an observation are in
/// memory.
///
/// # Errors
/// When a shard can't be read or a file can't be written.
pub fn write_binary<W: Write>(
    model: &dyn Model,
    name_of: &dyn Fn(ImageId) -> String,
    files: ModelFiles<W>,
) -> Result<(), SceneError> {
    let mut sink = binary::Binary(files);
    write(model, name_of, &mut sink, GATHERED_OBSERVATIONS)
}

/// Writes a model in COLMAP's text format, with the memory of [`write_binary`].
///
/// # Errors
/// As [`write_binary`].
pub fn write_text<W: Write>(
    model: &dyn Model,
    name_of: &dyn Fn(ImageId) -> String,
    files: ModelFiles<W>,
) -> Result<(), SceneError> {
    let mut sink = text::Text(files);
    write(model, name_of, &mut sink, GATHERED_OBSERVATIONS)
}

/// An image point and the point that it sees, numbered from one.
struct Point2 {
    xy_px: [f64; 2],
    point: u64,
}

/// An image as COLMAP's files hold it.
struct ImageEntry<'a> {
    image: ImageId,
    camera: CameraId,
    cam_from_world: &'a Rigid3,
    name: &'a str,
    points: &'a [Point2],
}

/// A point as COLMAP's files hold it.
struct PointEntry<'a> {
    point: u64,
    x_in_world: &'a Vector3<f64>,
    color: [u8; 3],
    error_px: f64,
    /// Image, and place among the 2D points of that image.
    track: &'a [(ImageId, u32)],
}

/// Where entries go.
trait Sink {
    fn begin(&mut self, num_cameras: u64, num_images: u64, num_points: u64) -> std::io::Result<()>;
    fn camera(&mut self, id: CameraId, camera: &Camera) -> std::io::Result<()>;
    fn image(&mut self, entry: &ImageEntry<'_>) -> std::io::Result<()>;
    fn point(&mut self, entry: &PointEntry<'_>) -> std::io::Result<()>;
    fn finish(&mut self) -> std::io::Result<()>;
}

fn write(
    model: &dyn Model,
    name_of: &dyn Fn(ImageId) -> String,
    sink: &mut dyn Sink,
    gathered_observations: u64,
) -> Result<(), SceneError> {
    let layout = layout::Layout::of(model)?;
    sink.begin(model.cameras().len() as u64, model.images().len() as u64, layout.num_points)?;
    for (id, camera) in model.cameras() {
        sink.camera(*id, camera)?;
    }
    let mut ranks = layout.empty_ranks();
    for images in layout.batches(gathered_observations) {
        let gathered = layout.gather(model, images.clone(), &mut ranks)?;
        for (at, points) in images.zip(gathered) {
            let image = &model.images()[at];
            let name = name_of(image.image);
            let cam_from_world = &image.cam_from_world;
            sink.image(&ImageEntry {
                image: image.image,
                camera: image.camera,
                cam_from_world,
                name: &name,
                points: &points,
            })?;
        }
    }
    write_points(model, sink, &ranks)?;
    Ok(sink.finish()?)
}

fn write_points(model: &dyn Model, sink: &mut dyn Sink, ranks: &[Vec<u32>]) -> Result<(), SceneError> {
    let mut point = 0;
    let mut track = Vec::new();
    for (shard_index, ranks) in ranks.iter().enumerate() {
        let shard = model.shard(shard_index)?;
        let mut at = 0;
        for scene_point in &shard.points {
            point += 1;
            track.clear();
            let mut sum_px = 0.0;
            for observation in shard.track(scene_point) {
                track.push((observation.image, ranks[at]));
                at += 1;
                let projected = model.view(observation.image).and_then(|(pose, camera)| {
                    camera.project(&pose.cam_from_world.transform_point(&scene_point.x_in_world))
                });
                sum_px += projected.map_or(0.0, |xy_px| (xy_px - observation.xy_px()).norm());
            }
            let error_px = if track.is_empty() { -1.0 } else { sum_px / track.len() as f64 };
            let (x_in_world, color) = (&scene_point.x_in_world, scene_point.color);
            sink.point(&PointEntry { point, x_in_world, color, error_px, track: &track })?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
