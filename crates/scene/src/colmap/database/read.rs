//! Reading a database row by row.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Read;
use std::path::Path;

use rusqlite::limits::Limit;
use rusqlite::types::ValueRef;
use rusqlite::{Connection, ErrorCode, OpenFlags, Row};
use terrane_geometry::{Camera, CameraModel};

use super::{DatabaseCamera, DatabaseImage, DatabasePair, DescriptorLayout, MAX_IMAGE_ID, blob, images_of};
use super::{SIFT_DESCRIPTORS, pair_id};
use crate::{Keypoint, SceneError};

/// What every SQLite file begins with.
const MAGIC: &[u8; 16] = b"SQLite format 3\0";

/// Focal lengths and principal points beyond are no camera's, in pixels.
const MAX_PARAM: f64 = 1e9;

/// A database that is open for reading. Rows are read when asked for; what is returned is checked.
#[derive(Debug)]
pub struct Database {
    connection: Connection,
    has_descriptors: bool,
    has_descriptor_kind: bool,
    has_matches: bool,
    /// The table of verified pairs, which was called otherwise before COLMAP 3.
    geometries: Option<&'static str>,
}

impl Database {
    /// Opens a database.
    ///
    /// Nothing is written beside the file, also where it lies in a folder that can't be written, unless the program that
    /// wrote it left a write-ahead log.
    ///
    /// # Errors
    /// When the file can't be read; corrupt when it is no SQLite database or lacks the tables of COLMAP's.
    pub fn open(path: &Path) -> Result<Self, SceneError> {
        let mut magic = [0; 16];
        let file_len = std::fs::metadata(path)?.len();
        let is_database = std::fs::File::open(path)?.read_exact(&mut magic).is_ok() && magic == *MAGIC;
        if !is_database {
            return Err(SceneError::corrupt("this is no SQLite database: give COLMAP's database.db"));
        }
        let connection = connect(path)?;
        // Nothing in the file is longer than the file: what claims to be is a trap.
        let limit = i32::try_from(file_len + log_len(path)).unwrap_or(i32::MAX).clamp(65_536, 1_000_000_000);
        connection
            .set_limit(Limit::SQLITE_LIMIT_LENGTH, limit)
            .map_err(|error| failed("the database", error))?;
        connection
            .execute_batch("PRAGMA trusted_schema = OFF; PRAGMA cell_size_check = ON; PRAGMA mmap_size = 0;")
            .map_err(|error| failed("the database", error))?;
        Self::with(connection)
    }

    fn with(connection: Connection) -> Result<Self, SceneError> {
        let columns = |table: &str, wanted: &[&str]| check_table(&connection, table, wanted);
        for (table, wanted) in [
            ("cameras", &["camera_id", "model", "width", "height", "params", "prior_focal_length"][..]),
            ("images", &["image_id", "name", "camera_id"]),
            ("keypoints", &["image_id", "rows", "cols", "data"]),
        ] {
            if columns(table, wanted)?.is_none() {
                return Err(SceneError::corrupt(format!(
                    "table {table} is missing: this is no database of COLMAP"
                )));
            }
        }
        let descriptors = columns("descriptors", &["image_id", "rows", "cols", "data"])?;
        let matches = columns("matches", &["pair_id", "rows", "cols", "data"])?;
        let mut geometries = None;
        for name in ["two_view_geometries", "inlier_matches"] {
            if geometries.is_none() && columns(name, &["pair_id", "rows", "cols", "data"])?.is_some() {
                geometries = Some(name);
            }
        }
        Ok(Self {
            has_descriptors: descriptors.is_some(),
            has_descriptor_kind: descriptors.is_some_and(|columns| columns.contains("type")),
            has_matches: matches.is_some(),
            geometries,
            connection,
        })
    }

    /// Every camera, by number.
    ///
    /// # Errors
    /// Corrupt when a row makes no sense.
    pub fn cameras(&self) -> Result<Vec<DatabaseCamera>, SceneError> {
        let sql =
            "SELECT camera_id, model, width, height, params, prior_focal_length FROM cameras ORDER BY rowid";
        let mut cameras = Vec::new();
        self.ascending("cameras", sql, |id, row| {
            let what = format!("camera {id}");
            let size = [integer(row, 2, &what)?, integer(row, 3, &what)?];
            let params = blob::doubles(&format!("{what}: params"), bytes(row, 4, &what)?)?;
            let camera = camera(&what, integer(row, 1, &what)?, size, &params)?;
            cameras.push(DatabaseCamera { id, camera, has_prior_focal: integer(row, 5, &what)? != 0 });
            Ok(())
        })?;
        Ok(cameras)
    }

    /// Every image, by number.
    ///
    /// # Errors
    /// Corrupt when a row makes no sense, two images have one name, or a camera is missing.
    pub fn images(&self) -> Result<Vec<DatabaseImage>, SceneError> {
        let cameras: BTreeSet<i64> = self.cameras()?.iter().map(|camera| camera.id).collect();
        let sql = "SELECT image_id, name, camera_id FROM images ORDER BY rowid";
        let mut images = Vec::new();
        let mut names = BTreeMap::new();
        self.ascending("images", sql, |id, row| {
            let what = format!("image {id}");
            let name = text(row, 1, &what)?;
            let camera = integer(row, 2, &what)?;
            if !(0..MAX_IMAGE_ID).contains(&id) {
                return Err(SceneError::corrupt(format!("{what}: the number is out of range")));
            }
            if !cameras.contains(&camera) {
                return Err(SceneError::corrupt(format!(
                    "{what} ({name}) has camera {camera}, which is not there"
                )));
            }
            if let Some(other) = names.insert(name.clone(), id) {
                return Err(SceneError::corrupt(format!(
                    "images {other} and {id} have the same name, {name}"
                )));
            }
            images.push(DatabaseImage { id, name, camera });
            Ok(())
        })?;
        Ok(images)
    }

    /// The keypoints of an image, or `None` when there are none of it.
    ///
    /// # Errors
    /// Corrupt when they are not what the row states, or not finite.
    pub fn keypoints(&self, image: i64) -> Result<Option<Vec<Keypoint>>, SceneError> {
        let what = format!("keypoints of image {image}");
        self.one("SELECT rows, cols, data FROM keypoints WHERE image_id = ?1", image, &what, |row| {
            let size = blob::table_size(&what, integer(row, 0, &what)?, integer(row, 1, &what)?)?;
            blob::keypoints(&what, size, bytes(row, 2, &what)?)
        })
    }

    /// What is known of the descriptors of an image without reading them, or `None` when there are none of it.
    ///
    /// # Errors
    /// Corrupt when the row makes no sense.
    pub fn descriptor_layout(&self, image: i64) -> Result<Option<DescriptorLayout>, SceneError> {
        if !self.has_descriptors {
            return Ok(None);
        }
        let what = format!("descriptors of image {image}");
        let kind = if self.has_descriptor_kind { "type" } else { "0" };
        let sql = format!("SELECT rows, cols, length(data), {kind} FROM descriptors WHERE image_id = ?1");
        self.one(&sql, image, &what, |row| {
            let size = blob::table_size(&what, integer(row, 0, &what)?, integer(row, 1, &what)?)?;
            let num_bytes = match row.get_ref(2) {
                Ok(ValueRef::Null) => 0,
                _ => usize::try_from(integer(row, 2, &what)?).unwrap_or(usize::MAX),
            };
            let row_bytes = blob::descriptor_bytes(&what, size, num_bytes)?;
            // Versions that knew one kind only say nothing, or "undefined" below zero.
            let kind = integer(row, 3, &what)?.max(SIFT_DESCRIPTORS);
            Ok(DescriptorLayout { rows: size.0, row_bytes, kind })
        })
    }

    /// The bytes of an image's descriptors, row after row; empty when there are none of it.
    ///
    /// # Errors
    /// Corrupt when they are not what the row states.
    pub fn descriptors(&self, image: i64) -> Result<Vec<u8>, SceneError> {
        let Some(layout) = self.descriptor_layout(image)? else { return Ok(Vec::new()) };
        let what = format!("descriptors of image {image}");
        let sql = "SELECT data FROM descriptors WHERE image_id = ?1";
        let data = self.one(sql, image, &what, |row| Ok(bytes(row, 0, &what)?.to_vec()))?.unwrap_or_default();
        if layout.rows.checked_mul(layout.row_bytes) != Some(data.len()) {
            return Err(SceneError::corrupt(format!("{what} are not what their row states")));
        }
        Ok(data)
    }

    /// Every pair of images that has matches, ascending. Raw matches count; a pair without them counts by the inliers of
    /// its two-view geometry.
    ///
    /// # Errors
    /// Corrupt when a pair names an image and itself, an image that is not there, or stands there twice.
    pub fn pairs(&self) -> Result<Vec<DatabasePair>, SceneError> {
        let images: Vec<i64> = self.images()?.into_iter().map(|image| image.id).collect();
        let mut pairs = match self.has_matches {
            true => self.pairs_of_table("matches", &images)?,
            false => Vec::new(),
        };
        if let Some(table) = self.geometries {
            let of = |pair: &DatabasePair| (pair.first, pair.second);
            let mut others = self.pairs_of_table(table, &images)?;
            others.retain(|other| pairs.binary_search_by_key(&of(other), of).is_err());
            pairs.append(&mut others);
            pairs.sort_unstable();
        }
        Ok(pairs)
    }

    /// The pairs of a table that have rows, ascending.
    fn pairs_of_table(&self, table: &str, images: &[i64]) -> Result<Vec<DatabasePair>, SceneError> {
        let sql = format!("SELECT pair_id, rows FROM {table} ORDER BY rowid");
        let mut pairs = Vec::new();
        self.ascending(table, &sql, |id, row| {
            let what = format!("pair {id} of {table}");
            let Some((a, b)) = images_of(id) else {
                return Err(SceneError::corrupt(format!("{what} can't be a pair of images")));
            };
            for image in [a, b] {
                if images.binary_search(&image).is_err() {
                    return Err(SceneError::corrupt(format!(
                        "{what} names image {image}, which is not there"
                    )));
                }
            }
            let num_matches = blob::table_size(&what, integer(row, 1, &what)?, 2)?.0;
            pairs.push(DatabasePair { first: a.min(b), second: a.max(b), num_matches });
            Ok(())
        })?;
        pairs.sort_unstable();
        let is_twice = |two: &&[DatabasePair]| (two[0].first, two[0].second) == (two[1].first, two[1].second);
        if let Some(two) = pairs.windows(2).find(is_twice) {
            return Err(SceneError::corrupt(format!(
                "images {} and {} are twice a pair of {table}",
                two[0].first, two[0].second
            )));
        }
        pairs.retain(|pair| pair.num_matches > 0);
        Ok(pairs)
    }

    /// The matches of two images: feature of the first named, feature of the second. Raw ones where there are any, else
    /// the inliers of their two-view geometry, else none. Whether there are such features is the caller's to check.
    ///
    /// # Errors
    /// Corrupt when they are not what the row states; invalid when these can't be a pair.
    pub fn matches(&self, a: i64, b: i64) -> Result<Vec<[u32; 2]>, SceneError> {
        let canonical = pair_id(a, b)?;
        let turned = a.max(b) * MAX_IMAGE_ID + a.min(b);
        let tables = [self.has_matches.then_some("matches"), self.geometries];
        for table in tables.into_iter().flatten() {
            for (id, is_turned) in [(canonical, a > b), (turned, a < b)] {
                let what = format!("matches of images {a} and {b}");
                let sql = format!("SELECT rows, cols, data FROM {table} WHERE pair_id = ?1");
                let found = self.one(&sql, id, &what, |row| {
                    let size = blob::table_size(&what, integer(row, 0, &what)?, integer(row, 1, &what)?)?;
                    blob::matches(&what, size, bytes(row, 2, &what)?)
                })?;
                if let Some(mut matches) = found.filter(|matches| !matches.is_empty()) {
                    if is_turned {
                        matches.iter_mut().for_each(|pair| pair.reverse());
                    }
                    return Ok(matches);
                }
            }
        }
        Ok(Vec::new())
    }

    /// Calls `take` with every row of a table. Its first column is the key, which must ascend: a damaged tree of pages may
    /// lead to one row again and again.
    fn ascending(
        &self,
        table: &str,
        sql: &str,
        mut take: impl FnMut(i64, &Row<'_>) -> Result<(), SceneError>,
    ) -> Result<(), SceneError> {
        let mut statement = self.connection.prepare(sql).map_err(|error| failed(table, error))?;
        let mut rows = statement.query([]).map_err(|error| failed(table, error))?;
        let mut last = None;
        while let Some(row) = rows.next().map_err(|error| failed(table, error))? {
            let id = integer(row, 0, table)?;
            if last.is_some_and(|last| id <= last) {
                return Err(SceneError::corrupt(format!(
                    "table {table} is damaged: row {id} is out of order"
                )));
            }
            last = Some(id);
            take(id, row)?;
        }
        Ok(())
    }

    /// What `read` makes of the one row that a query with one parameter finds.
    fn one<T>(
        &self,
        sql: &str,
        id: i64,
        what: &str,
        read: impl FnOnce(&Row<'_>) -> Result<T, SceneError>,
    ) -> Result<Option<T>, SceneError> {
        let mut statement = self.connection.prepare(sql).map_err(|error| failed(what, error))?;
        let mut rows = statement.query([id]).map_err(|error| failed(what, error))?;
        match rows.next().map_err(|error| failed(what, error))? {
            Some(row) => read(row).map(Some),
            None => Ok(None),
        }
    }
}

/// Opens the file as one that nobody changes, so that SQLite makes no files beside it; with a log there it has to.
fn connect(path: &Path) -> Result<Connection, SceneError> {
    let journal = sidecar(path, "-journal");
    if std::fs::metadata(&journal).is_ok_and(|meta| meta.len() > 0) {
        return Err(SceneError::corrupt(format!(
            "{} shows that a program was interrupted while it wrote: open the database with COLMAP once",
            journal.display()
        )));
    }
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let opened = if log_len(path) > 0 {
        Connection::open_with_flags(path, flags)
    } else {
        let mut uri = String::from("file:");
        for byte in path.as_os_str().as_encoded_bytes() {
            match byte {
                b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'/' | b'.' | b'-' | b'_' => {
                    uri.push(char::from(*byte))
                }
                _ => uri.push_str(&format!("%{byte:02X}")),
            }
        }
        uri.push_str("?immutable=1");
        Connection::open_with_flags(uri, flags | OpenFlags::SQLITE_OPEN_URI)
    };
    opened.map_err(|error| failed("the database", error))
}

/// Bytes of the write-ahead log beside a database.
fn log_len(path: &Path) -> u64 {
    std::fs::metadata(sidecar(path, "-wal")).map_or(0, |meta| meta.len())
}

fn sidecar(path: &Path, suffix: &str) -> std::path::PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(suffix);
    name.into()
}

/// The columns of a table, or `None` when there is no such table.
fn check_table(
    connection: &Connection,
    table: &str,
    wanted: &[&str],
) -> Result<Option<BTreeSet<String>>, SceneError> {
    let read = || -> Result<Option<(i64, BTreeSet<String>)>, rusqlite::Error> {
        let mut statement = connection.prepare("SELECT rootpage FROM sqlite_master WHERE name = ?1")?;
        let mut rows = statement.query([table])?;
        let Some(row) = rows.next()? else { return Ok(None) };
        let root: i64 = row.get(0)?;
        // Hidden columns are computed ones; they are no data of a file.
        let mut statement = connection.prepare("SELECT name FROM pragma_table_xinfo(?1) WHERE hidden = 0")?;
        let names = statement.query_map([table], |row| row.get(0))?.collect::<Result<_, _>>()?;
        Ok(Some((root, names)))
    };
    let Some((root, names)) = read().map_err(|error| failed("the database", error))? else { return Ok(None) };
    if root <= 0 {
        return Err(SceneError::corrupt(format!(
            "{table} is a view or a virtual table: COLMAP's is a table"
        )));
    }
    match wanted.iter().find(|column| !names.contains(**column)) {
        Some(column) => Err(SceneError::corrupt(format!("table {table} has no column {column}"))),
        None => Ok(Some(names)),
    }
}

/// A camera, or why terrane can't use it.
fn camera(
    what: &str,
    model: i64,
    size: [i64; 2],
    params: &[f64],
) -> Result<Result<Camera, String>, SceneError> {
    let known = i32::try_from(model).ok().and_then(CameraModel::from_colmap_id);
    let Some(model) = known else {
        return Ok(Err(format!(
            "its camera has COLMAP's model number {model}, which terrane does not have: it has {}",
            CameraModel::names()
        )));
    };
    let size = size.map(|length| u32::try_from(length).ok().filter(|length| *length > 0));
    let [Some(width_px), Some(height_px)] = size else {
        return Err(SceneError::corrupt(format!("{what} has no size")));
    };
    let camera = Camera::new(model, width_px, height_px, params).ok_or_else(|| {
        SceneError::corrupt(format!(
            "{what}: {} has {} parameters, {} are there",
            model.name(),
            model.num_params(),
            params.len()
        ))
    })?;
    let is_usable = params.iter().all(|value| value.abs() < MAX_PARAM) && camera.focal_px().min() > 0.0;
    if !is_usable {
        return Err(SceneError::corrupt(format!("{what} has parameters that no camera has: {params:?}")));
    }
    Ok(Ok(camera))
}

fn integer(row: &Row<'_>, column: usize, what: &str) -> Result<i64, SceneError> {
    match row.get_ref(column) {
        Ok(ValueRef::Integer(value)) => Ok(value),
        Ok(other) => Err(SceneError::corrupt(format!(
            "{what}: column {column} is {} and no integer",
            other.data_type()
        ))),
        Err(error) => Err(failed(what, error)),
    }
}

fn bytes<'a>(row: &'a Row<'_>, column: usize, what: &str) -> Result<&'a [u8], SceneError> {
    match row.get_ref(column) {
        Ok(ValueRef::Blob(bytes)) => Ok(bytes),
        Ok(ValueRef::Null) => Ok(&[]),
        Ok(other) => {
            Err(SceneError::corrupt(format!("{what}: column {column} is {} and no blob", other.data_type())))
        }
        Err(error) => Err(failed(what, error)),
    }
}

fn text(row: &Row<'_>, column: usize, what: &str) -> Result<String, SceneError> {
    let not_text = || SceneError::corrupt(format!("{what}: column {column} is no text"));
    match row.get_ref(column) {
        Ok(ValueRef::Text(bytes)) => String::from_utf8(bytes.to_vec()).map_err(|_| not_text()),
        Ok(_) => Err(not_text()),
        Err(error) => Err(failed(what, error)),
    }
}

/// SQLite's error as ours: the file's, the machine's, or another program's.
fn failed(what: &str, error: rusqlite::Error) -> SceneError {
    let code = error.sqlite_error_code();
    match code {
        Some(
            ErrorCode::SystemIoFailure
            | ErrorCode::CannotOpen
            | ErrorCode::PermissionDenied
            | ErrorCode::ReadOnly
            | ErrorCode::OutOfMemory,
        ) => SceneError::source_failed(what, error),
        Some(ErrorCode::DatabaseBusy | ErrorCode::DatabaseLocked) => SceneError::invalid(format!(
            "{what}: another program is writing the database: wait for it to end"
        )),
        _ => SceneError::corrupt(format!("{what} can't be read: {error}: the database is damaged")),
    }
}
