//! COLMAP's binary models as reconstructions.

use std::collections::BTreeMap;
use std::io::{BufRead, Read};

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use terrane_geometry::{Camera, CameraModel, Rigid3};

use super::ModelFiles;
use crate::{CameraId, ImageId, Observation, Reconstruction, RegisteredImage, SceneError};

/// A model and the names of its images.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ColmapModel {
    /// Cameras, poses, points. An observation's feature is its place among the 2D points of its image.
    pub reconstruction: Reconstruction,
    /// Names by image, ascending.
    pub names: Vec<(ImageId, String)>,
}

impl ColmapModel {
    /// The name of an image.
    pub fn name(&self, image: ImageId) -> Option<&str> {
        self.names.binary_search_by_key(&image, |entry| entry.0).ok().map(|at| self.names[at].1.as_str())
    }
}

/// Reads `cameras.bin`, `images.bin` and `points3D.bin`. Ids become ours: COLMAP's less one.
///
/// # Errors
/// Corrupt when the files are cut off or contradict each other, unsupported when a camera model is one that terrane does
/// not have.
pub fn read_binary<R: BufRead>(files: ModelFiles<R>) -> Result<ColmapModel, SceneError> {
    let cameras = read_cameras(files.cameras)?;
    let (images, names, xy_of) = read_images(files.images)?;
    let mut reconstruction = Reconstruction { cameras, images, ..Default::default() };
    if let Some(image) =
        reconstruction.images.iter().find(|image| reconstruction.camera(image.camera).is_none())
    {
        return Err(SceneError::corrupt(format!(
            "image {} has a camera that is not there",
            image.image.0 + 1
        )));
    }
    read_points(files.points, &xy_of, &mut reconstruction)?;
    Ok(ColmapModel { reconstruction, names })
}

fn read_cameras(mut file: impl Read) -> Result<Vec<(CameraId, Camera)>, SceneError> {
    let mut cameras = BTreeMap::new();
    for _ in 0..u64_of(&mut file)? {
        let id = id_of(&mut file)?;
        let number = i32::from_le_bytes(bytes(&mut file)?);
        let model = CameraModel::from_colmap_id(number).ok_or_else(|| {
            SceneError::unsupported(format!("camera model {number} of COLMAP is not supported"))
        })?;
        let (width_px, height_px) = (size_of_image(&mut file)?, size_of_image(&mut file)?);
        let params = (0..model.num_params()).map(|_| f64_of(&mut file)).collect::<Result<Vec<_>, _>>()?;
        let camera = Camera::new(model, width_px, height_px, &params)
            .ok_or_else(|| SceneError::corrupt("a camera has a wrong number of parameters"))?;
        cameras.insert(CameraId(id), camera);
    }
    Ok(cameras.into_iter().collect())
}

type ImagePoints = BTreeMap<ImageId, Vec<[f32; 2]>>;

fn read_images(
    mut file: impl BufRead,
) -> Result<(Vec<RegisteredImage>, Vec<(ImageId, String)>, ImagePoints), SceneError> {
    let mut images = BTreeMap::new();
    let mut names = BTreeMap::new();
    let mut xy_of = ImagePoints::new();
    for _ in 0..u64_of(&mut file)? {
        let image = ImageId(id_of(&mut file)?);
        let mut q = [0.0; 4];
        for value in &mut q {
            *value = f64_of(&mut file)?;
        }
        let translation = Vector3::new(f64_of(&mut file)?, f64_of(&mut file)?, f64_of(&mut file)?);
        let quaternion = Quaternion::new(q[0], q[1], q[2], q[3]);
        let is_unit = (quaternion.norm() - 1.0).abs() < 1e-3;
        if !is_unit {
            return Err(SceneError::corrupt(format!(
                "the rotation of image {} is no unit quaternion",
                image.0 + 1
            )));
        }
        // Kept bit for bit when it is one already, as everything that terrane wrote.
        let exact = (quaternion.norm() - 1.0).abs() < 1e-12;
        let rotation = if exact {
            UnitQuaternion::new_unchecked(quaternion)
        } else {
            UnitQuaternion::new_normalize(quaternion)
        };
        let camera = CameraId(id_of(&mut file)?);
        let mut name = Vec::new();
        file.by_ref().take(1 << 16).read_until(0, &mut name)?;
        if name.pop() != Some(0) {
            return Err(SceneError::corrupt("the name of an image does not end"));
        }
        let mut points = Vec::new();
        for _ in 0..u64_of(&mut file)? {
            points.push([f64_of(&mut file)? as f32, f64_of(&mut file)? as f32]);
            u64_of(&mut file)?;
        }
        images.insert(
            image,
            RegisteredImage { image, camera, cam_from_world: Rigid3::new(rotation, translation) },
        );
        names.insert(image, String::from_utf8_lossy(&name).into_owned());
        xy_of.insert(image, points);
    }
    Ok((images.into_values().collect(), names.into_iter().collect(), xy_of))
}

fn read_points(
    mut file: impl Read,
    xy_of: &ImagePoints,
    into: &mut Reconstruction,
) -> Result<(), SceneError> {
    for _ in 0..u64_of(&mut file)? {
        u64_of(&mut file)?;
        let x_in_world = Vector3::new(f64_of(&mut file)?, f64_of(&mut file)?, f64_of(&mut file)?);
        let color: [u8; 3] = bytes(&mut file)?;
        f64_of(&mut file)?;
        let mut track = Vec::new();
        for _ in 0..u64_of(&mut file)? {
            let image = ImageId(id_of(&mut file)?);
            let feature = u32::from_le_bytes(bytes(&mut file)?);
            let [x_px, y_px] =
                *xy_of.get(&image).and_then(|points| points.get(feature as usize)).ok_or_else(|| {
                    SceneError::corrupt(format!(
                        "a point is seen at place {feature} of image {}, which is not there",
                        image.0 + 1
                    ))
                })?;
            track.push(Observation { image, feature, x_px, y_px });
        }
        track.sort_by_key(|observation| (observation.image, observation.feature));
        into.push_point(x_in_world, color, &track);
    }
    Ok(())
}

fn bytes<const N: usize>(file: &mut impl Read) -> Result<[u8; N], SceneError> {
    let mut bytes = [0; N];
    match file.read_exact(&mut bytes) {
        Err(error) if error.kind() == std::io::ErrorKind::UnexpectedEof => {
            Err(SceneError::corrupt("the file of a COLMAP model is cut off"))
        }
        result => Ok(result.map(|()| bytes)?),
    }
}

fn u64_of(file: &mut impl Read) -> Result<u64, SceneError> {
    Ok(u64::from_le_bytes(bytes(file)?))
}

fn f64_of(file: &mut impl Read) -> Result<f64, SceneError> {
    Ok(f64::from_le_bytes(bytes(file)?))
}

fn id_of(file: &mut impl Read) -> Result<u32, SceneError> {
    u32::from_le_bytes(bytes(file)?)
        .checked_sub(1)
        .ok_or_else(|| SceneError::unsupported("ids of a COLMAP model that start at 0 are not supported"))
}

fn size_of_image(file: &mut impl Read) -> Result<u32, SceneError> {
    u32::try_from(u64_of(file)?).map_err(|_| SceneError::corrupt("an image size is beyond reason"))
}
