//! Synthetic submaps with known truth, for the tests of this crate.

use nalgebra::{UnitQuaternion, Vector3};
use terrane_geometry::{Seed, Sim3, so3};
use terrane_scene::{ImageId, Observation, Reconstruction};
use terrane_testkit::scene::{Layout, SceneOptions, SyntheticScene};

/// Uniform numbers of a seeded stream.
pub(crate) struct Draws(Seed, u64);

impl Draws {
    pub(crate) fn new(seed: u64) -> Self {
        Self(Seed(seed), 0)
    }

    /// Uniform within ±1.
    pub(crate) fn signed(&mut self) -> f64 {
        self.1 += 1;
        let bits = self.0.item(&[self.1]).0 >> 11;
        bits as f64 / (1u64 << 52) as f64 - 1.0
    }

    /// About a standard normal: the sum of uniforms, with unit variance.
    pub(crate) fn normal(&mut self) -> f64 {
        (0..6).map(|_| self.signed()).sum::<f64>() / 2.0f64.sqrt()
    }

    pub(crate) fn vector(&mut self) -> Vector3<f64> {
        Vector3::new(self.normal(), self.normal(), self.normal())
    }

    /// A similarity with any rotation, a scale between 1/e and e, and a translation of tens of units.
    pub(crate) fn similarity(&mut self) -> Sim3 {
        let turn = UnitQuaternion::from_scaled_axis(self.vector().normalize() * (2.9 * self.signed()));
        Sim3::new(self.signed().exp(), turn, 30.0 * self.vector())
    }
}

/// An aerial block in rows over rolling terrain, in metres.
pub(crate) fn block(num_images: usize, num_points: usize) -> SyntheticScene {
    SyntheticScene::new(&SceneOptions {
        layout: Layout::Nadir { height_m: 60.0, spacing_m: 12.0, row_spacing_m: 16.0, relief_m: 8.0 },
        num_images,
        num_points,
        min_matches: 15,
        ..Default::default()
    })
}

/// The errors that a submap is given, in metres and radians of the world.
#[derive(Clone, Copy)]
pub(crate) struct Noise {
    pub(crate) point_m: f64,
    pub(crate) center_m: f64,
    pub(crate) rotation_rad: f64,
}

pub(crate) const EXACT: Noise = Noise { point_m: 0.0, center_m: 0.0, rotation_rad: 0.0 };
pub(crate) const USUAL: Noise = Noise { point_m: 0.05, center_m: 0.05, rotation_rad: 0.0005 };

/// The part of the truth that these images see, with errors, in another frame.
pub(crate) fn submap(
    truth: &Reconstruction,
    images: &[ImageId],
    submap_from_world: &Sim3,
    noise: Noise,
    seed: u64,
) -> Reconstruction {
    let mut draws = Draws::new(seed);
    let mut part = Reconstruction { cameras: truth.cameras.clone(), ..Default::default() };
    for image in &truth.images {
        if images.contains(&image.image) {
            let mut moved = *image;
            let center = image.cam_from_world.center() + noise.center_m * draws.vector();
            let turn = so3::exp(&(noise.rotation_rad * draws.vector()));
            let rotation = turn * image.cam_from_world.rotation;
            moved.cam_from_world = terrane_geometry::Rigid3::from_rotation_and_center(rotation, &center);
            part.images.push(moved);
        }
    }
    for point in &truth.points {
        let track: Vec<Observation> =
            truth.track(point).iter().filter(|seen| images.contains(&seen.image)).copied().collect();
        if track.len() >= 2 {
            part.push_point(point.x_in_world + noise.point_m * draws.vector(), point.color, &track);
        }
    }
    part.transform(submap_from_world);
    part
}

pub(crate) fn ids(range: std::ops::Range<u32>) -> Vec<ImageId> {
    range.map(ImageId).collect()
}
