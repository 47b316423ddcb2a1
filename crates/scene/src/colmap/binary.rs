//! Entries as COLMAP's binary files hold them, little-endian.

use std::io::Write;

use terrane_geometry::Camera;

use super::{ImageEntry, ModelFiles, PointEntry, Sink};
use crate::CameraId;

pub(super) struct Binary<W>(pub ModelFiles<W>);

impl<W: Write> Sink for Binary<W> {
    fn begin(&mut self, num_cameras: u64, num_images: u64, num_points: u64) -> std::io::Result<()> {
        self.0.cameras.write_all(&num_cameras.to_le_bytes())?;
        self.0.images.write_all(&num_images.to_le_bytes())?;
        self.0.points.write_all(&num_points.to_le_bytes())
    }

    fn camera(&mut self, id: CameraId, camera: &Camera) -> std::io::Result<()> {
        let out = &mut self.0.cameras;
        out.write_all(&(id.0 + 1).to_le_bytes())?;
        out.write_all(&camera.model.colmap_id().to_le_bytes())?;
        out.write_all(&u64::from(camera.width_px).to_le_bytes())?;
        out.write_all(&u64::from(camera.height_px).to_le_bytes())?;
        numbers(out, camera.params())
    }

    fn image(&mut self, entry: &ImageEntry<'_>) -> std::io::Result<()> {
        let out = &mut self.0.images;
        out.write_all(&(entry.image.0 + 1).to_le_bytes())?;
        let rotation = &entry.cam_from_world.rotation;
        numbers(out, &[rotation.w, rotation.i, rotation.j, rotation.k])?;
        numbers(out, entry.cam_from_world.translation.as_slice())?;
        out.write_all(&(entry.camera.0 + 1).to_le_bytes())?;
        out.write_all(entry.name.as_bytes())?;
        out.write_all(&[0])?;
        out.write_all(&(entry.points.len() as u64).to_le_bytes())?;
        for point in entry.points {
            numbers(out, &point.xy_px)?;
            out.write_all(&point.point.to_le_bytes())?;
        }
        Ok(())
    }

    fn point(&mut self, entry: &PointEntry<'_>) -> std::io::Result<()> {
        let out = &mut self.0.points;
        out.write_all(&entry.point.to_le_bytes())?;
        numbers(out, entry.x_in_world.as_slice())?;
        out.write_all(&entry.color)?;
        numbers(out, &[entry.error_px])?;
        out.write_all(&(entry.track.len() as u64).to_le_bytes())?;
        for (image, rank) in entry.track {
            out.write_all(&(image.0 + 1).to_le_bytes())?;
            out.write_all(&rank.to_le_bytes())?;
        }
        Ok(())
    }

    fn finish(&mut self) -> std::io::Result<()> {
        self.0.cameras.flush()?;
        self.0.images.flush()?;
        self.0.points.flush()
    }
}

fn numbers(out: &mut impl Write, values: &[f64]) -> std::io::Result<()> {
    values.iter().try_for_each(|value| out.write_all(&value.to_le_bytes()))
}
