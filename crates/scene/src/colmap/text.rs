//! Entries as COLMAP's text files hold them. Numbers are the shortest that read back as the same double.

use std::io::Write;

use terrane_geometry::Camera;

use super::{ImageEntry, ModelFiles, PointEntry, Sink};
use crate::CameraId;

pub(super) struct Text<W>(pub ModelFiles<W>);

impl<W: Write> Sink for Text<W> {
    fn begin(&mut self, num_cameras: u64, num_images: u64, num_points: u64) -> std::io::Result<()> {
        writeln!(self.0.cameras, "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n# {num_cameras} cameras")?;
        writeln!(
            self.0.images,
            "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n# {num_images} images"
        )?;
        writeln!(
            self.0.points,
            "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n# {num_points} points"
        )
    }

    fn camera(&mut self, id: CameraId, camera: &Camera) -> std::io::Result<()> {
        let out = &mut self.0.cameras;
        write!(out, "{} {} {} {}", id.0 + 1, camera.model.name(), camera.width_px, camera.height_px)?;
        camera.params().iter().try_for_each(|value| write!(out, " {value}"))?;
        writeln!(out)
    }

    fn image(&mut self, entry: &ImageEntry<'_>) -> std::io::Result<()> {
        let out = &mut self.0.images;
        let (q, t) = (&entry.cam_from_world.rotation, &entry.cam_from_world.translation);
        write!(out, "{} {} {} {} {} {} {} {}", entry.image.0 + 1, q.w, q.i, q.j, q.k, t.x, t.y, t.z)?;
        writeln!(out, " {} {}", entry.camera.0 + 1, entry.name)?;
        for (at, point) in entry.points.iter().enumerate() {
            let space = if at == 0 { "" } else { " " };
            write!(out, "{space}{} {} {}", point.xy_px[0], point.xy_px[1], point.point)?;
        }
        writeln!(out)
    }

    fn point(&mut self, entry: &PointEntry<'_>) -> std::io::Result<()> {
        let out = &mut self.0.points;
        let (x, [r, g, b]) = (entry.x_in_world, entry.color);
        write!(out, "{} {} {} {} {r} {g} {b} {}", entry.point, x.x, x.y, x.z, entry.error_px)?;
        entry.track.iter().try_for_each(|(image, rank)| write!(out, " {} {rank}", image.0 + 1))?;
        writeln!(out)
    }

    fn finish(&mut self) -> std::io::Result<()> {
        self.0.cameras.flush()?;
        self.0.images.flush()?;
        self.0.points.flush()
    }
}
