//! A small textured town that is rendered into geo-tagged photographs with known truth.
//!
//! Terrain, streets and houses are made from a seed. Photographs are taken along flight lines, with a lens that
//! distorts, a sensor that has noise and a receiver that is off by some metres. Nothing is read from outside.

mod exif;
mod mesh;
mod raster;
mod texture;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use terrane_geometry::geodesy::{EnuFrame, Geodetic};
use terrane_geometry::{Camera, CameraModel, Rigid3, Seed};
use terrane_scene::{CameraId, ImageId, Reconstruction, RegisteredImage};

use crate::scene::{look, normal};
use mesh::Mesh;

/// What to build and how to fly. Lengths are metres.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TownOptions {
    /// Flight lines.
    pub rows: usize,
    /// Photographs along a line.
    pub columns: usize,
    /// Distance between photographs along a line.
    pub spacing_m: f64,
    /// Distance between lines.
    pub row_spacing_m: f64,
    /// Flying height above the mean terrain.
    pub height_m: f64,
    /// Width of a photograph.
    pub width_px: u32,
    /// Height of a photograph.
    pub height_px: u32,
    /// Focal length in pixels.
    pub focal_px: f64,
    /// First radial distortion coefficient of the lens.
    pub distortion: f64,
    /// Standard deviation of the receiver per horizontal axis; twice that in height.
    pub gps_sigma_m: f64,
    /// Detail of the ground's texture, per metre; walls and roofs have a little more.
    pub texels_per_m: f64,
    /// Standard deviation of the sensor's noise in grey levels.
    pub noise_levels: f64,
    /// Everything random comes from here.
    pub seed: Seed,
}

impl Default for TownOptions {
    fn default() -> Self {
        Self {
            rows: 8,
            columns: 8,
            spacing_m: 18.0,
            row_spacing_m: 22.0,
            height_m: 75.0,
            width_px: 1200,
            height_px: 900,
            focal_px: 1000.0,
            distortion: -0.04,
            gps_sigma_m: 1.0,
            texels_per_m: 12.0,
            noise_levels: 1.5,
            seed: Seed(2026),
        }
    }
}

/// One photograph.
#[derive(Clone, Debug)]
pub struct Photograph {
    /// File name.
    pub name: String,
    /// The file: JPEG with EXIF.
    pub jpeg: Vec<u8>,
    /// True pose in the town's frame: east, north, up from [`Town::origin`].
    pub cam_from_enu: Rigid3,
}

/// The town, ready to be photographed.
pub struct Town {
    options: TownOptions,
    mesh: Mesh,
    frame: EnuFrame,
}

impl Town {
    /// Builds the town: by default a second or two, and about 100 MiB of textures.
    pub fn new(options: &TownOptions) -> Self {
        let extent = Vector3::new(
            (options.columns.max(1) - 1) as f64 * options.spacing_m,
            (options.rows.max(1) - 1) as f64 * options.row_spacing_m,
            options.height_m,
        );
        let mesh = Mesh::town(&extent, options.texels_per_m, options.seed.derive("town"));
        Self { options: options.clone(), mesh, frame: EnuFrame::new(Self::origin()) }
    }

    /// Where the town's frame begins, on WGS 84.
    pub fn origin() -> Geodetic {
        Geodetic {
            latitude_rad: 47.05_f64.to_radians(),
            longitude_rad: 8.31_f64.to_radians(),
            height_m: 480.0,
        }
    }

    /// How many photographs there are.
    pub fn num_photographs(&self) -> usize {
        self.options.rows * self.options.columns
    }

    /// The true camera.
    pub fn camera(&self) -> Camera {
        let options = &self.options;
        let mut camera = Camera::centered(
            CameraModel::SimpleRadial,
            options.width_px,
            options.height_px,
            options.focal_px,
        );
        camera.params_mut()[3] = options.distortion;
        camera
    }

    /// The true pose of a photograph: lines are flown back and forth, every second one leaning to a side.
    pub fn cam_from_enu(&self, index: usize) -> Rigid3 {
        let options = &self.options;
        let rng = &mut options.seed.derive("flight").item(&[index as u64]).rng();
        let (row, column) = (index / options.columns, index % options.columns);
        let eastward = row % 2 == 0;
        let along = if eastward { column } else { options.columns - 1 - column };
        let mut center = Vector3::new(
            along as f64 * options.spacing_m,
            row as f64 * options.row_spacing_m,
            options.height_m,
        );
        center += Vector3::new(normal(rng), normal(rng), normal(rng)) * (0.015 * options.height_m);
        let heading = if eastward { Vector3::x() } else { -Vector3::x() };
        let lean = if column % 2 == 0 { 0.12 } else { -0.18 };
        let forward = Vector3::new(0.03 * normal(rng), lean + 0.03 * normal(rng), -1.0);
        look(center, forward, heading)
    }

    /// File name of a photograph.
    pub fn name(&self, index: usize) -> String {
        format!("town_{index:04}.jpg")
    }

    /// Takes a photograph: about a tenth of a CPU-second per megapixel.
    pub fn photograph(&self, index: usize) -> Photograph {
        let cam_from_enu = self.cam_from_enu(index);
        let camera = self.camera();
        let seed = self.options.seed.derive("sensor").item(&[index as u64]);
        let pixels = raster::render(&self.mesh, &camera, &cam_from_enu, self.options.noise_levels, seed);
        let rng = &mut self.options.seed.derive("receiver").item(&[index as u64]).rng();
        let sigma = Vector3::new(1.0, 1.0, 2.0) * self.options.gps_sigma_m;
        let error = Vector3::new(normal(rng), normal(rng), normal(rng)).component_mul(&sigma);
        let position = self.frame.geodetic_from_enu(&(cam_from_enu.center() + error));
        let jpeg = exif::jpeg(&pixels, &camera, &position, index);
        Photograph { name: self.name(index), jpeg, cam_from_enu }
    }

    /// The true poses and camera, without points.
    pub fn truth(&self) -> Reconstruction {
        let images = (0..self.num_photographs())
            .map(|index| RegisteredImage {
                image: ImageId::from_index(index),
                camera: CameraId(0),
                cam_from_world: self.cam_from_enu(index),
            })
            .collect();
        Reconstruction { cameras: vec![(CameraId(0), self.camera())], images, ..Default::default() }
    }
}

#[cfg(test)]
mod tests;
