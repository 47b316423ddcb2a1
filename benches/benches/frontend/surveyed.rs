//! Inliers that surveyed cameras confirm: what agrees with a wrong geometry counts for nobody.

use std::collections::BTreeMap;

use anyhow::Context;
use nalgebra::{Matrix3, Vector2, Vector3};
use terrane_geometry::two_view::squared_sampson_error;

use crate::peer;
use crate::sets::Set;

/// Greatest Sampson error of a right inlier: that of both verifications.
const MAX_ERROR_PX: f64 = 4.0;

/// A point of each of two photographs, in pixels.
pub type Inlier = [Vector2<f64>; 2];

/// Surveyed cameras by the names of their photographs.
pub struct Surveyed {
    cameras: BTreeMap<String, Camera>,
}

struct Camera {
    px_from_camera: Matrix3<f64>,
    world_from_camera: Matrix3<f64>,
    center_in_world: Vector3<f64>,
}

impl Surveyed {
    /// The cameras of a set, from `.camera` files as Strecha et al. (2008) publish them; `None` where nobody has surveyed any.
    ///
    /// # Errors
    /// When a file can't be read.
    pub fn of(set: &Set) -> anyhow::Result<Option<Self>> {
        let folder = set.path().join("../gt_dense_cameras");
        let Ok(entries) = std::fs::read_dir(&folder) else { return Ok(None) };
        let mut cameras = BTreeMap::new();
        for entry in entries.flatten() {
            let name = entry.file_name().to_string_lossy().into_owned();
            let Some(photograph) = name.strip_suffix(".camera") else { continue };
            let text = std::fs::read_to_string(entry.path())?;
            let camera = Camera::parse(&text).with_context(|| format!("{name} is no camera"))?;
            cameras.insert(photograph.to_owned(), camera);
        }
        Ok(Some(Self { cameras }))
    }

    /// How many of a pair's inliers the cameras confirm.
    pub fn num_right(&self, names: [&str; 2], inliers: &[Inlier]) -> usize {
        let [Some(first), Some(second)] = names.map(|name| self.cameras.get(name)) else { return 0 };
        let fundamental = first.fundamental_to(second);
        let is_right =
            |[a, b]: &&Inlier| squared_sampson_error(&fundamental, a, b) < MAX_ERROR_PX * MAX_ERROR_PX;
        inliers.iter().filter(is_right).count()
    }
}

impl Camera {
    /// Intrinsics, distortion, rotation and centre; `None` when a number is missing or the intrinsics have no inverse.
    fn parse(text: &str) -> Option<Self> {
        let values: Vec<f64> = text.split_whitespace().map_while(|word| word.parse().ok()).collect();
        let (intrinsics, rotation, center) = (values.get(0..9)?, values.get(12..21)?, values.get(21..24)?);
        Some(Self {
            px_from_camera: Matrix3::from_row_slice(intrinsics),
            world_from_camera: Matrix3::from_row_slice(rotation),
            center_in_world: Vector3::from_column_slice(center),
        })
    }

    /// `second ᵀ F first = 0` in pixels.
    fn fundamental_to(&self, second: &Self) -> Matrix3<f64> {
        let second_from_world = second.world_from_camera.transpose();
        let rotation = second_from_world * self.world_from_camera;
        let translation = second_from_world * (self.center_in_world - second.center_in_world);
        let inverse = |matrix: &Matrix3<f64>| matrix.try_inverse().unwrap_or_else(Matrix3::zeros);
        inverse(&second.px_from_camera).transpose()
            * translation.cross_matrix()
            * rotation
            * inverse(&self.px_from_camera)
    }
}

/// COLMAP's inliers of a set by the names of both photographs, in their order; `None` when COLMAP did not run.
pub fn colmap_inliers(set: &Set) -> Option<BTreeMap<(String, String), Vec<Inlier>>> {
    let database = peer::work(set, &[]).join("database.db");
    let answer = peer::script("colmap_inliers.py", &[database.display().to_string()])?;
    let pairs = answer.value["pairs"].as_array()?.iter().filter_map(|row| {
        let (a, b) = (row[0].as_str()?.to_owned(), row[1].as_str()?.to_owned());
        let numbers: Vec<f64> = row[2].as_array()?.iter().filter_map(serde_json::Value::as_f64).collect();
        let fours = numbers.as_chunks::<4>().0.iter();
        let inliers = fours.map(|[x, y, u, v]| [Vector2::new(*x, *y), Vector2::new(*u, *v)]);
        Some(if a < b {
            ((a, b), inliers.collect())
        } else {
            ((b, a), inliers.map(|[a, b]| [b, a]).collect())
        })
    });
    Some(pairs.collect())
}
