//! Databases that are written and read back, and those of other programs and versions.

mod broken;
mod fuzz;

use std::path::{Path, PathBuf};

use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use rusqlite::Connection;
use terrane_geometry::{Camera, CameraModel, Rigid3};

use super::*;
use crate::{DESCRIPTOR_LEN, GpsPrior, Keypoint};

fn keypoint(number: usize) -> Keypoint {
    let number = number as f32;
    Keypoint { x_px: number + 0.25, y_px: 2.0 * number, scale_px: 1.5, orientation_rad: -0.5 }
}

fn keypoints(count: usize) -> Vec<Keypoint> {
    (0..count).map(keypoint).collect()
}

fn descriptors(count: usize) -> Vec<u8> {
    (0..count * DESCRIPTOR_LEN).map(|at| (at % 251) as u8).collect()
}

fn camera() -> Camera {
    Camera::new(CameraModel::SimpleRadial, 640, 480, &[500.0, 320.0, 240.0, -0.01]).unwrap()
}

const GPS: GpsPrior = GpsPrior {
    latitude_deg: 47.5,
    longitude_deg: -8.25,
    altitude_m: Some(400.0),
    sigma_horizontal_m: 2.0,
    sigma_vertical_m: 5.0,
};

/// Three images of one camera, two pairs, in a file of its own.
fn sample(folder: &Path, name: &str) -> PathBuf {
    let path = folder.join(name);
    let mut writer = DatabaseWriter::create(&path).unwrap();
    writer.camera(1, &camera(), true).unwrap();
    for (id, name) in [(1, "a.jpg"), (2, "b/c.jpg"), (5, "d ä.png")] {
        writer.image(id, name, 1).unwrap();
        writer.keypoints(id, &keypoints(4 + id as usize)).unwrap();
        let count = 4 + id as usize;
        writer.descriptors(id, SIFT_DESCRIPTORS, count, &descriptors(count)).unwrap();
    }
    writer.position(2, 1, &GPS).unwrap();
    writer.matches(1, 2, &[[0, 1], [4, 5]]).unwrap();
    let pose = Rigid3::new(UnitQuaternion::from_euler_angles(0.1, 0.2, 0.3), Vector3::x());
    let geometry = DatabaseGeometry {
        config: config_of(PairKind::Calibrated),
        matches: &[[0, 1]],
        fundamental: Some(Matrix3::new(1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0)),
        essential: None,
        homography: None,
        second_from_first: Some(pose),
    };
    writer.geometry(1, 2, &geometry).unwrap();
    let alone = DatabaseGeometry { config: 4, matches: &[[3, 0], [1, 7], [2, 2]], ..geometry };
    writer.geometry(2, 5, &alone).unwrap();
    writer.finish().unwrap();
    path
}

/// A sample after these statements.
fn changed(folder: &Path, sql: &str) -> PathBuf {
    let path = sample(folder, "changed.db");
    let connection = Connection::open(&path).unwrap();
    connection.execute_batch("PRAGMA foreign_keys = OFF;").unwrap();
    connection.execute_batch(sql).unwrap();
    path
}

#[test]
fn what_is_written_is_read_back() {
    let folder = tempfile::tempdir().unwrap();
    let database = Database::open(&sample(folder.path(), "a.db")).unwrap();
    let cameras = database.cameras().unwrap();
    assert_eq!(cameras, [DatabaseCamera { id: 1, camera: Ok(camera()), has_prior_focal: true }]);
    let images = database.images().unwrap();
    let names: Vec<_> = images.iter().map(|image| (image.id, image.name.as_str(), image.camera)).collect();
    assert_eq!(names, [(1, "a.jpg", 1), (2, "b/c.jpg", 1), (5, "d ä.png", 1)]);
    assert_eq!(database.keypoints(5).unwrap(), Some(keypoints(9)));
    assert_eq!(database.keypoints(3).unwrap(), None);
    let layout = DescriptorLayout { rows: 6, row_bytes: DESCRIPTOR_LEN, kind: SIFT_DESCRIPTORS };
    assert_eq!(database.descriptor_layout(2).unwrap(), Some(layout));
    assert!(layout.is_sift());
    assert_eq!(database.descriptors(2).unwrap(), descriptors(6));
    assert_eq!(database.descriptors(3).unwrap(), Vec::<u8>::new());
    let pair = |first, second, num_matches| DatabasePair { first, second, num_matches };
    assert_eq!(database.pairs().unwrap(), [pair(1, 2, 2), pair(2, 5, 3)]);
    assert_eq!(database.matches(1, 2).unwrap(), [[0, 1], [4, 5]]);
    assert_eq!(database.matches(2, 1).unwrap(), [[1, 0], [5, 4]]);
    assert_eq!(database.matches(2, 5).unwrap(), [[3, 0], [1, 7], [2, 2]]);
    assert!(database.matches(1, 5).unwrap().is_empty());
    assert!(database.matches(1, 1).is_err());
    let connection = Connection::open(folder.path().join("a.db")).unwrap();
    let matrix: Vec<u8> =
        connection.query_row("SELECT F FROM two_view_geometries LIMIT 1", [], |row| row.get(0)).unwrap();
    let written: Vec<f64> =
        matrix.as_chunks::<8>().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect();
    assert_eq!(written, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]);
}

#[test]
fn the_same_rows_give_the_same_bytes_and_nothing_is_left_beside_them() {
    let folder = tempfile::tempdir().unwrap();
    let bytes = ["a.db", "b.db"].map(|name| std::fs::read(sample(folder.path(), name)).unwrap());
    assert!(bytes[0] == bytes[1] && !bytes[0].is_empty());
    Database::open(&folder.path().join("a.db")).unwrap().pairs().unwrap();
    let mut names: Vec<_> =
        std::fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    names.sort();
    assert_eq!(names, ["a.db", "b.db"]);
    assert!(DatabaseWriter::create(&folder.path().join("a.db")).is_err());
    assert_eq!(std::fs::read(folder.path().join("a.db")).unwrap(), bytes[0]);
}

#[test]
fn keypoints_have_two_four_or_six_columns() {
    let row = |values: &[f32]| values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
    let read = |cols: usize, values: &[f32]| blob::keypoints("k", (1, cols), &row(values)).unwrap()[0];
    let place = |k: Keypoint| (k.x_px, k.y_px);
    let plain = read(2, &[3.5, 4.5]);
    assert_eq!((place(plain), plain.scale_px, plain.orientation_rad), ((3.5, 4.5), 1.0, 0.0));
    let oriented = read(4, &[3.5, 4.5, 2.0, -1.0]);
    assert_eq!((oriented.scale_px, oriented.orientation_rad), (2.0, -1.0));
    for turn in [-3.0_f32, -1.6, -0.4, 0.0, 0.3, 1.5, 2.5, 3.1] {
        let (sin, cos) = turn.sin_cos();
        let affine = read(6, &[3.5, 4.5, 2.0 * cos, -2.0 * sin, 2.0 * sin, 2.0 * cos]);
        assert!((affine.scale_px - 2.0).abs() < 1e-5, "{turn}: {affine:?}");
        assert!((affine.orientation_rad - turn).abs() < 1e-5, "{turn}: {affine:?}");
    }
    assert!(blob::keypoints("k", (0, 0), &[]).unwrap().is_empty());
}

#[test]
fn angles_are_those_of_the_library() {
    for k in 0..20_000 {
        let (y, x) = (f64::from(k - 10_000) * 0.37, f64::from((k * 7919) % 20_001 - 10_000));
        if x != 0.0 || y != 0.0 {
            assert!((blob::angle(y, x) - y.atan2(x)).abs() < 1e-9, "{y}, {x}");
        }
    }
    assert_eq!(blob::angle(0.0, 0.0), 0.0);
    assert!(blob::angle(f64::INFINITY, 1.0).is_nan() && blob::angle(1.0, f64::NAN).is_nan());
}

#[test]
fn databases_of_older_versions_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let sql = "DROP TABLE matches; ALTER TABLE two_view_geometries RENAME TO inlier_matches;
               ALTER TABLE descriptors DROP COLUMN type; DROP TABLE rigs; DROP TABLE frames;";
    let database = Database::open(&changed(folder.path(), sql)).unwrap();
    assert_eq!(database.pairs().unwrap().len(), 2);
    assert_eq!(database.matches(1, 2).unwrap(), [[0, 1]]);
    assert!(database.descriptor_layout(1).unwrap().unwrap().is_sift());
    let other = tempfile::tempdir().unwrap();
    let sql = "DROP TABLE descriptors; DROP TABLE two_view_geometries; DROP TABLE matches;";
    let bare = Database::open(&changed(other.path(), sql)).unwrap();
    assert!(bare.pairs().unwrap().is_empty() && bare.matches(1, 2).unwrap().is_empty());
    assert_eq!(bare.descriptor_layout(1).unwrap(), None);
    assert!(bare.descriptors(1).unwrap().is_empty());
}

#[test]
fn pairs_that_other_programs_number_the_other_way_are_turned() {
    let folder = tempfile::tempdir().unwrap();
    let turned = 2 * MAX_IMAGE_ID + 1;
    let sql = format!("UPDATE matches SET pair_id = {turned}; DELETE FROM two_view_geometries;");
    let database = Database::open(&changed(folder.path(), &sql)).unwrap();
    assert_eq!(database.pairs().unwrap(), [DatabasePair { first: 1, second: 2, num_matches: 2 }]);
    assert_eq!(database.matches(1, 2).unwrap(), [[1, 0], [5, 4]]);
    assert_eq!(database.matches(2, 1).unwrap(), [[0, 1], [4, 5]]);
}

#[test]
fn learned_descriptors_are_told_from_sifts() {
    let folder = tempfile::tempdir().unwrap();
    for (sql, row_bytes, kind) in [
        ("UPDATE descriptors SET type = 1", 128, 1),
        ("UPDATE descriptors SET cols = 512, data = zeroblob(rows * 512)", 512, 0),
        ("UPDATE descriptors SET cols = 256, data = zeroblob(rows * 256 * 4)", 1024, 0),
    ] {
        let _ = std::fs::remove_file(folder.path().join("changed.db"));
        let database = Database::open(&changed(folder.path(), sql)).unwrap();
        let layout = database.descriptor_layout(2).unwrap().unwrap();
        assert_eq!(layout, DescriptorLayout { rows: 6, row_bytes, kind }, "{sql}");
        assert!(!layout.is_sift());
        assert_eq!(database.descriptors(2).unwrap().len(), 6 * row_bytes);
    }
}

#[test]
fn an_unfinished_log_is_read_where_it_can_be() {
    let folder = tempfile::tempdir().unwrap();
    let path = sample(folder.path(), "a.db");
    let writing = Connection::open(&path).unwrap();
    writing
        .execute_batch("PRAGMA journal_mode = WAL; UPDATE images SET name = 'new.jpg' WHERE image_id = 1")
        .unwrap();
    let names: Vec<_> =
        Database::open(&path).unwrap().images().unwrap().into_iter().map(|image| image.name).collect();
    assert!(names.contains(&"new.jpg".to_owned()), "{names:?}");
}

#[test]
fn every_kind_of_pair_has_colmaps_number() {
    use PairKind::*;
    let configs = [Calibrated, Uncalibrated, Planar, Panoramic, Watermark].map(config_of);
    assert_eq!(configs, [2, 3, 4, 5, 7]);
    assert_eq!(pair_id(7, 3).unwrap(), 3 * MAX_IMAGE_ID + 7);
    for (a, b) in [(1, 1), (-1, 2), (0, MAX_IMAGE_ID)] {
        assert!(pair_id(a, b).is_err(), "{a} {b}");
    }
}
