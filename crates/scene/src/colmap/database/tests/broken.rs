//! Databases that are wrong in one way: each is an error that says in which.

use super::*;
use crate::SceneError;

/// Reads everything there is, as an import does.
fn read_all(path: &Path) -> Result<(), SceneError> {
    let database = Database::open(path)?;
    database.cameras()?;
    for image in database.images()? {
        database.keypoints(image.id)?;
        database.descriptors(image.id)?;
    }
    for pair in database.pairs()? {
        database.matches(pair.first, pair.second)?;
    }
    Ok(())
}

#[test]
fn every_fault_is_named() {
    let faults: &[(&str, &[&str])] = &[
        ("DROP TABLE cameras", &["cameras", "missing", "COLMAP"]),
        ("DROP TABLE images", &["images", "missing"]),
        ("DROP TABLE keypoints", &["keypoints", "missing"]),
        ("DROP TABLE keypoints; CREATE VIEW keypoints AS SELECT 1 AS image_id, 1 AS rows, 2 AS cols, zeroblob(8) AS data",
         &["keypoints", "view"]),
        ("DROP TABLE keypoints; CREATE TABLE keypoints(image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER,
          data BLOB GENERATED ALWAYS AS (zeroblob(900000000)))", &["keypoints", "no column data"]),
        ("ALTER TABLE keypoints DROP COLUMN cols", &["keypoints", "no column cols"]),
        ("UPDATE cameras SET params = x'0011223344'", &["camera 1", "5 bytes"]),
        ("UPDATE cameras SET params = NULL", &["camera 1", "4 parameters, 0"]),
        ("UPDATE cameras SET model = 1, params = substr(params, 1, 24)", &["camera 1", "PINHOLE has 4 parameters, 3"]),
        ("UPDATE cameras SET params = zeroblob(32)", &["camera 1", "no camera has"]),
        ("UPDATE cameras SET width = 0", &["camera 1", "size"]),
        ("UPDATE cameras SET height = 99999999999", &["camera 1", "size"]),
        ("UPDATE cameras SET width = 'wide'", &["camera 1", "no integer"]),
        ("DELETE FROM cameras", &["image 1", "camera 1", "not there"]),
        ("UPDATE images SET name = x'ff00' WHERE image_id = 2", &["image 2", "no text"]),
        ("UPDATE images SET name = CAST(x'ff41' AS TEXT) WHERE image_id = 2", &["image 2", "no text"]),
        ("UPDATE keypoints SET rows = 1000 WHERE image_id = 2", &["keypoints of image 2", "1000 x 4", "96 bytes"]),
        ("UPDATE keypoints SET rows = -1 WHERE image_id = 2", &["keypoints of image 2", "-1 x 4"]),
        ("UPDATE keypoints SET rows = 4611686018427387904 WHERE image_id = 2", &["keypoints of image 2", "size"]),
        ("UPDATE keypoints SET cols = 3 WHERE image_id = 2", &["keypoints of image 2", "3 columns"]),
        ("UPDATE keypoints SET cols = 'x' WHERE image_id = 2", &["keypoints of image 2", "no integer"]),
        ("UPDATE keypoints SET data = 'text' WHERE image_id = 2", &["keypoints of image 2", "no blob"]),
        ("UPDATE keypoints SET data = NULL WHERE image_id = 2", &["keypoints of image 2", "0 bytes"]),
        ("UPDATE descriptors SET rows = 7 WHERE image_id = 2", &["descriptors of image 2", "7 x 128"]),
        ("UPDATE descriptors SET data = 7 WHERE image_id = 2", &["descriptors of image 2"]),
        ("UPDATE matches SET cols = 3, rows = 1", &["matches of images 1 and 2", "3 columns"]),
        ("UPDATE matches SET rows = 3", &["matches of images 1 and 2", "3 x 2", "16 bytes"]),
        ("UPDATE matches SET pair_id = 2147483647 * 4 + 4", &["pair", "can't be a pair"]),
        ("UPDATE matches SET pair_id = -5", &["pair -5", "can't be a pair"]),
        ("UPDATE matches SET pair_id = 9223372036854775807", &["can't be a pair"]),
        ("UPDATE matches SET pair_id = 2147483647 + 3", &["names image 3, which is not there"]),
        ("INSERT INTO matches VALUES (2147483647 * 2 + 1, 1, 2, zeroblob(8))", &["images 1 and 2", "twice", "matches"]),
        ("UPDATE two_view_geometries SET data = zeroblob(4)", &["matches of images 2 and 5", "4 bytes"]),
    ];
    for (sql, words) in faults {
        let folder = tempfile::tempdir().unwrap();
        let error = read_all(&changed(folder.path(), sql)).expect_err(sql);
        let message = error.to_string();
        assert!(error.is_corrupt(), "{sql}: {message}");
        for word in *words {
            assert!(message.contains(word), "{sql}: `{word}` is not in `{message}`");
        }
    }
}

#[test]
fn keypoints_without_a_place_are_refused() {
    for value in [f32::NAN, f32::INFINITY] {
        let folder = tempfile::tempdir().unwrap();
        let path = sample(folder.path(), "a.db");
        let mut data = blob::bytes_of_keypoints(&keypoints(6));
        data[36..40].copy_from_slice(&value.to_le_bytes());
        let sql = "UPDATE keypoints SET data = ?1 WHERE image_id = 2";
        Connection::open(&path).unwrap().execute(sql, [data]).unwrap();
        let message = read_all(&path).unwrap_err().to_string();
        assert!(message.contains("keypoints of image 2: number 2 is not finite"), "{message}");
    }
}

#[test]
fn two_images_of_one_name_are_refused_also_where_the_file_allows_them() {
    let folder = tempfile::tempdir().unwrap();
    let sql = "CREATE TABLE copy (image_id INTEGER PRIMARY KEY, name TEXT, camera_id INTEGER);
               INSERT INTO copy SELECT image_id, 'same.jpg', camera_id FROM images; DROP TABLE images;
               ALTER TABLE copy RENAME TO images;";
    let message = read_all(&changed(folder.path(), sql)).unwrap_err().to_string();
    assert!(message.contains("images 1 and 2 have the same name, same.jpg"), "{message}");
}

#[test]
fn a_model_that_terrane_does_not_have_is_told_of_its_camera_alone() {
    let folder = tempfile::tempdir().unwrap();
    let path = changed(folder.path(), "UPDATE cameras SET model = 99, params = zeroblob(64)");
    read_all(&path).unwrap();
    let cameras = Database::open(&path).unwrap().cameras().unwrap();
    let reason = cameras[0].camera.clone().unwrap_err();
    assert!(reason.contains("model number 99") && reason.contains("OPENCV"), "{reason}");
}

#[test]
fn what_is_no_database_is_said_to_be_none() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("photo.db");
    for bytes in [&b""[..], b"short", b"SQLite format 2\0 and more", &[0xff; 5000]] {
        std::fs::write(&path, bytes).unwrap();
        let error = Database::open(&path).unwrap_err();
        assert!(error.is_corrupt() && error.to_string().contains("no SQLite database"), "{error}");
    }
    assert!(!Database::open(&folder.path().join("absent.db")).unwrap_err().is_corrupt());
    assert!(Database::open(folder.path()).is_err());
}

#[test]
fn a_file_that_ends_early_is_damaged() {
    let folder = tempfile::tempdir().unwrap();
    let path = sample(folder.path(), "a.db");
    let whole = std::fs::read(&path).unwrap();
    let mut refused = 0;
    for keep in (16..whole.len()).step_by(997) {
        std::fs::write(&path, &whole[..keep]).unwrap();
        refused += usize::from(read_all(&path).is_err());
    }
    let tried = (16..whole.len()).step_by(997).count();
    assert!(refused * 10 >= tried * 7, "{refused} of {tried}");
}

#[test]
fn an_interrupted_write_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let path = sample(folder.path(), "a.db");
    std::fs::write(folder.path().join("a.db-journal"), "half a journal").unwrap();
    let message = Database::open(&path).unwrap_err().to_string();
    assert!(message.contains("interrupted"), "{message}");
}
