//! Cameras, poses, points and tracks as columns.

use bytemuck::{Pod, Zeroable};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use terrane_geometry::camera::MAX_PARAMS;
use terrane_geometry::{Camera, CameraModel, Rigid3};

use super::{Archive, ArchiveWriter, Kind, Packing, Source, Tag};
use crate::{CameraId, ImageId, Observation, Reconstruction, RegisteredImage, SceneError, ScenePoint};

const CAMERAS: Tag = Tag(*b"CAMS");
const IMAGES: Tag = Tag(*b"IMGS");
const POINTS: Tag = Tag(*b"PNTS");
const OBSERVATIONS: Tag = Tag(*b"OBSV");

#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct CameraRow {
    id: u32,
    model: i32,
    width_px: u32,
    height_px: u32,
    params: [f64; MAX_PARAMS],
}

#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct ImageRow {
    image: u32,
    camera: u32,
    wxyz: [f64; 4],
    translation: [f64; 3],
}

#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct PointRow {
    x_in_world: [f64; 3],
    color: [u8; 3],
    zero: u8,
    num_observations: u32,
}

/// A rotation as numbers, w first.
pub(super) fn wxyz_from_quaternion(rotation: &UnitQuaternion<f64>) -> [f64; 4] {
    [rotation.w, rotation.i, rotation.j, rotation.k]
}

/// The rotation of numbers that [`wxyz_from_quaternion`] gave, bit for bit.
pub(super) fn quaternion_from_wxyz([w, x, y, z]: [f64; 4]) -> Result<UnitQuaternion<f64>, SceneError> {
    let quaternion = Quaternion::new(w, x, y, z);
    if (quaternion.norm() - 1.0).abs() < 1e-6 {
        Ok(UnitQuaternion::new_unchecked(quaternion))
    } else {
        Err(SceneError::corrupt("a rotation is no unit quaternion"))
    }
}

/// Adds a reconstruction to an artefact, under the item given.
///
/// # Errors
/// As [`ArchiveWriter::column`].
pub fn write_reconstruction(
    archive: &mut ArchiveWriter,
    item: u32,
    reconstruction: &Reconstruction,
) -> Result<(), SceneError> {
    let cameras: Vec<CameraRow> = reconstruction.cameras.iter().map(camera_row).collect();
    let images: Vec<ImageRow> = reconstruction.images.iter().map(image_row).collect();
    let points: Vec<PointRow> = reconstruction.points.iter().map(point_row).collect();
    archive.column(CAMERAS, item, &cameras, Packing::Raw)?;
    archive.column(IMAGES, item, &images, Packing::Raw)?;
    archive.column(POINTS, item, &points, Packing::Zstd)?;
    let in_order = reconstruction.points.iter().try_fold(0u64, |at, point| {
        (point.first_observation == at).then_some(at + u64::from(point.num_observations))
    });
    if in_order == Some(reconstruction.observations.len() as u64) {
        archive.column(OBSERVATIONS, item, &reconstruction.observations, Packing::Zstd)
    } else {
        let tracks = reconstruction.points.iter().flat_map(|point| reconstruction.track(point));
        archive.column(OBSERVATIONS, item, &tracks.copied().collect::<Vec<_>>(), Packing::Zstd)
    }
}

/// Reads the reconstruction under an item of an artefact.
///
/// # Errors
/// Corrupt when its sections are absent, do not hold or do not fit each other.
pub fn read_reconstruction<S: Source>(archive: &Archive<S>, item: u32) -> Result<Reconstruction, SceneError> {
    let cameras = archive.column::<CameraRow>(CAMERAS, item)?;
    let images = archive.column::<ImageRow>(IMAGES, item)?;
    let rows = archive.column::<PointRow>(POINTS, item)?;
    let observations = archive.column::<Observation>(OBSERVATIONS, item)?;
    let mut points = Vec::with_capacity(rows.len());
    let mut first_observation = 0u64;
    for row in &rows {
        points.push(ScenePoint {
            x_in_world: Vector3::from(row.x_in_world),
            color: row.color,
            first_observation,
            num_observations: row.num_observations,
        });
        first_observation += u64::from(row.num_observations);
    }
    if first_observation != observations.len() as u64 {
        return Err(SceneError::corrupt("tracks and observations do not fit each other"));
    }
    Ok(Reconstruction {
        cameras: cameras.iter().map(camera_from_row).collect::<Result<_, _>>()?,
        images: images.iter().map(image_from_row).collect::<Result<_, _>>()?,
        points,
        observations,
    })
}

/// The bytes of an artefact that is one reconstruction.
///
/// # Errors
/// As [`write_reconstruction`].
pub fn encode_reconstruction(reconstruction: &Reconstruction) -> Result<Vec<u8>, SceneError> {
    let mut archive = ArchiveWriter::new(Kind::Reconstruction);
    write_reconstruction(&mut archive, 0, reconstruction)?;
    Ok(archive.finish())
}

/// The reconstruction of an artefact that is one.
///
/// # Errors
/// As [`Archive::open`] and [`read_reconstruction`].
pub fn decode_reconstruction(source: impl Source) -> Result<Reconstruction, SceneError> {
    read_reconstruction(&Archive::open(source, Kind::Reconstruction)?, 0)
}

fn camera_row((id, camera): &(CameraId, Camera)) -> CameraRow {
    let mut params = [0.0; MAX_PARAMS];
    params[..camera.params().len()].copy_from_slice(camera.params());
    CameraRow {
        id: id.0,
        model: camera.model.colmap_id(),
        width_px: camera.width_px,
        height_px: camera.height_px,
        params,
    }
}

fn camera_from_row(row: &CameraRow) -> Result<(CameraId, Camera), SceneError> {
    let bad = || SceneError::corrupt(format!("camera {} is of an unknown model {}", row.id, row.model));
    let model = CameraModel::from_colmap_id(row.model).ok_or_else(bad)?;
    let params = row.params.get(..model.num_params()).ok_or_else(bad)?;
    let camera = Camera::new(model, row.width_px, row.height_px, params).ok_or_else(bad)?;
    Ok((CameraId(row.id), camera))
}

fn image_row(image: &RegisteredImage) -> ImageRow {
    ImageRow {
        image: image.image.0,
        camera: image.camera.0,
        wxyz: wxyz_from_quaternion(&image.cam_from_world.rotation),
        translation: image.cam_from_world.translation.into(),
    }
}

fn image_from_row(row: &ImageRow) -> Result<RegisteredImage, SceneError> {
    Ok(RegisteredImage {
        image: ImageId(row.image),
        camera: CameraId(row.camera),
        cam_from_world: Rigid3::new(quaternion_from_wxyz(row.wxyz)?, Vector3::from(row.translation)),
    })
}

fn point_row(point: &ScenePoint) -> PointRow {
    PointRow {
        x_in_world: point.x_in_world.into(),
        color: point.color,
        zero: 0,
        num_observations: point.num_observations,
    }
}
