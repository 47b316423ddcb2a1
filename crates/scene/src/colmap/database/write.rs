//! Writing a database.

use std::path::Path;

use rusqlite::{Connection, OpenFlags, params};
use terrane_geometry::Camera;

use super::{DatabaseGeometry, blob, pair_id, schema};
use crate::{GpsPrior, Keypoint, SceneError};

/// A database under way. Rows are written as they are given, in one transaction; the same rows in the same order give the
/// same bytes.
#[derive(Debug)]
pub struct DatabaseWriter {
    connection: Connection,
}

impl DatabaseWriter {
    /// Begins a database in a file that is not there yet. When [`DatabaseWriter::finish`] is not reached the file is
    /// no database.
    ///
    /// # Errors
    /// When there is such a file or it can't be made.
    pub fn create(path: &Path) -> Result<Self, SceneError> {
        std::fs::File::options().write(true).create_new(true).open(path)?;
        let flags = OpenFlags::SQLITE_OPEN_READ_WRITE | OpenFlags::SQLITE_OPEN_NO_MUTEX;
        let connection = Connection::open_with_flags(path, flags).map_err(failed)?;
        connection
            .execute_batch("PRAGMA journal_mode = OFF; PRAGMA synchronous = OFF; BEGIN;")
            .and_then(|()| connection.execute_batch(schema::TABLES))
            .map_err(failed)?;
        Ok(Self { connection })
    }

    /// Writes a camera, and the rig that it is alone in.
    ///
    /// # Errors
    /// When the disk is full, or there is a camera of this number.
    pub fn camera(&mut self, id: i64, camera: &Camera, has_prior_focal: bool) -> Result<(), SceneError> {
        let params = blob::bytes_of_doubles(camera.params().iter().copied());
        self.run(
            "INSERT INTO cameras VALUES (?1, ?2, ?3, ?4, ?5, ?6)",
            params![id, camera.model.colmap_id(), camera.width_px, camera.height_px, params, has_prior_focal],
        )?;
        self.run("INSERT INTO rigs VALUES (?1, ?1, ?2)", params![id, schema::CAMERA_SENSOR])
    }

    /// Writes an image, and the frame that it is alone in. Its camera must be there.
    ///
    /// # Errors
    /// When the disk is full, or there is an image of this number or name.
    pub fn image(&mut self, id: i64, name: &str, camera: i64) -> Result<(), SceneError> {
        self.run("INSERT INTO images VALUES (?1, ?2, ?3)", params![id, name, camera])?;
        self.run("INSERT INTO frames VALUES (?1, ?2)", params![id, camera])?;
        self.run("INSERT INTO frame_data VALUES (?1, ?1, ?2, ?3)", params![id, camera, schema::CAMERA_SENSOR])
    }

    /// Writes the position of an image, with a height of zero where none is known, as COLMAP does.
    ///
    /// # Errors
    /// As [`DatabaseWriter::image`].
    pub fn position(&mut self, image: i64, camera: i64, gps: &GpsPrior) -> Result<(), SceneError> {
        let position =
            blob::bytes_of_doubles([gps.latitude_deg, gps.longitude_deg, gps.altitude_m.unwrap_or(0.0)]);
        let unknown = |count| blob::bytes_of_doubles(std::iter::repeat_n(f64::NAN, count));
        self.run(
            "INSERT INTO pose_priors VALUES (?1, ?1, ?2, ?3, ?4, ?5, ?6, ?7)",
            params![image, camera, schema::CAMERA_SENSOR, position, unknown(9), unknown(3), schema::WGS84],
        )
    }

    /// Writes the keypoints of an image.
    ///
    /// # Errors
    /// As [`DatabaseWriter::image`].
    pub fn keypoints(&mut self, image: i64, keypoints: &[Keypoint]) -> Result<(), SceneError> {
        let data = blob::bytes_of_keypoints(keypoints);
        self.run("INSERT INTO keypoints VALUES (?1, ?2, 4, ?3)", params![image, keypoints.len() as i64, data])
    }

    /// Writes the descriptors of an image: `rows` of equal length, and COLMAP's number of their kind.
    ///
    /// # Errors
    /// As [`DatabaseWriter::image`]; invalid when the bytes are not that many equal rows.
    pub fn descriptors(&mut self, image: i64, kind: i64, rows: usize, data: &[u8]) -> Result<(), SceneError> {
        if !data.len().is_multiple_of(rows.max(1)) {
            return Err(SceneError::invalid(format!("descriptors of image {image} are of unequal length")));
        }
        let cols = data.len() / rows.max(1);
        self.run(
            "INSERT INTO descriptors VALUES (?1, ?2, ?3, ?4, ?5)",
            params![image, kind, rows as i64, cols as i64, data],
        )
    }

    /// Writes the raw matches of two images, the lower number first.
    ///
    /// # Errors
    /// As [`DatabaseWriter::image`]; invalid when the numbers don't ascend.
    pub fn matches(&mut self, first: i64, second: i64, matches: &[[u32; 2]]) -> Result<(), SceneError> {
        let id = ascending_pair(first, second)?;
        let data = blob::bytes_of_matches(matches);
        self.run("INSERT INTO matches VALUES (?1, ?2, 2, ?3)", params![id, matches.len() as i64, data])
    }

    /// Writes the two-view geometry of two images, the lower number first.
    ///
    /// # Errors
    /// As [`DatabaseWriter::matches`].
    pub fn geometry(
        &mut self,
        first: i64,
        second: i64,
        geometry: &DatabaseGeometry<'_>,
    ) -> Result<(), SceneError> {
        let id = ascending_pair(first, second)?;
        let data = blob::bytes_of_matches(geometry.matches);
        let [f, e, h] = [&geometry.fundamental, &geometry.essential, &geometry.homography]
            .map(|matrix| matrix.as_ref().map(blob::bytes_of_matrix));
        let pose = geometry.second_from_first.as_ref();
        let rotation = pose.map(|pose| {
            let q = pose.rotation.quaternion();
            blob::bytes_of_doubles([q.w, q.i, q.j, q.k])
        });
        let translation = pose.map(|pose| blob::bytes_of_doubles(pose.translation.iter().copied()));
        self.run(
            "INSERT INTO two_view_geometries VALUES (?1, ?2, 2, ?3, ?4, ?5, ?6, ?7, ?8, ?9, NULL, NULL)",
            params![id, geometry.matches.len() as i64, data, geometry.config, f, e, h, rotation, translation],
        )
    }

    /// Ends the transaction and closes the file.
    ///
    /// # Errors
    /// When the disk is full.
    pub fn finish(self) -> Result<(), SceneError> {
        self.connection.execute_batch("COMMIT;").map_err(failed)?;
        self.connection.close().map_err(|(_, error)| failed(error))
    }

    fn run(&mut self, sql: &str, values: impl rusqlite::Params) -> Result<(), SceneError> {
        let inserted = self.connection.execute(sql, values).map_err(failed)?;
        debug_assert_eq!(inserted, 1);
        Ok(())
    }
}

fn ascending_pair(first: i64, second: i64) -> Result<i64, SceneError> {
    match first < second {
        true => pair_id(first, second),
        false => Err(SceneError::invalid(format!("images {first} and {second} of a pair must ascend"))),
    }
}

/// SQLite's error as ours; a full disk as the error of the operating system that it is.
fn failed(error: rusqlite::Error) -> SceneError {
    match error.sqlite_error_code() {
        Some(rusqlite::ErrorCode::DiskFull) => {
            SceneError::source_failed("the database", std::io::Error::from(std::io::ErrorKind::StorageFull))
        }
        _ => SceneError::source_failed("the database can't be written", error),
    }
}
