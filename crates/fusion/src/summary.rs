//! What placing and averaging read of a submap: its cameras and how strongly they hold together, but no points.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use terrane_geometry::Rigid3;
use terrane_scene::{CameraId, ImageId, Reconstruction};

use crate::statistics::median;

/// Two cameras of a submap that share points.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct CameraLink {
    /// Place of one camera in [`SubmapSummary::images`].
    pub first: u32,
    /// Place of the other, higher than `first`.
    pub second: u32,
    /// How many points both see.
    pub shared_points: u32,
}

/// A submap without its points: a few hundred bytes per image.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SubmapSummary {
    /// Image, camera, `cam_from_submap`; ascending by image.
    pub images: Vec<(ImageId, CameraId, Rigid3)>,
    /// Each camera's strongest links, ascending by (first, second).
    pub links: Vec<CameraLink>,
    /// How many points the submap has.
    pub num_points: u64,
    /// Median distance from a camera to the points it sees, in submap units; zero without points.
    pub median_depth: f64,
}

impl SubmapSummary {
    /// The summary of a submap, with at most `max_links` of the strongest links of each camera.
    pub fn of(reconstruction: &Reconstruction, max_links: usize) -> Self {
        let images: Vec<_> = reconstruction
            .images
            .iter()
            .map(|image| (image.image, image.camera, image.cam_from_world))
            .collect();
        let links = strongest_links(images.len(), &pair_counts(reconstruction), max_links);
        Self {
            images,
            links,
            num_points: reconstruction.points.len() as u64,
            median_depth: median_depth(reconstruction),
        }
    }

    /// The pose of an image, if the submap has it.
    pub fn cam_from_submap(&self, image: ImageId) -> Option<&Rigid3> {
        self.images.binary_search_by_key(&image, |entry| entry.0).ok().map(|at| &self.images[at].2)
    }

    /// The camera centres, in the order of `images`.
    pub fn centers(&self) -> impl Iterator<Item = (ImageId, Vector3<f64>)> + '_ {
        self.images.iter().map(|(image, _, cam_from_submap)| (*image, cam_from_submap.center()))
    }
}

/// How many points each pair of cameras shares, ascending by (first, second).
fn pair_counts(reconstruction: &Reconstruction) -> Vec<CameraLink> {
    let num_images = reconstruction.images.len();
    let mut points_of: Vec<Vec<u32>> = vec![Vec::new(); num_images];
    for (at, point) in reconstruction.points.iter().enumerate() {
        for seen in reconstruction.track(point) {
            if let Some(position) = reconstruction.position_of(seen.image) {
                points_of[position].push(at as u32);
            }
        }
    }
    let mut links = Vec::new();
    let mut counts = vec![0u32; num_images];
    for (first, points) in points_of.iter().enumerate() {
        counts.fill(0);
        for point in points {
            for seen in reconstruction.track(&reconstruction.points[*point as usize]) {
                if let Some(second) = reconstruction.position_of(seen.image) {
                    counts[second] += 1;
                }
            }
        }
        for second in first + 1..num_images {
            if counts[second] > 0 {
                links.push(CameraLink {
                    first: first as u32,
                    second: second as u32,
                    shared_points: counts[second],
                });
            }
        }
    }
    links
}

/// The links that are among the strongest of either of their cameras.
fn strongest_links(num_images: usize, all: &[CameraLink], max_links: usize) -> Vec<CameraLink> {
    let mut of_camera: Vec<Vec<u32>> = vec![Vec::new(); num_images];
    for (at, link) in all.iter().enumerate() {
        of_camera[link.first as usize].push(at as u32);
        of_camera[link.second as usize].push(at as u32);
    }
    let mut keep = vec![false; all.len()];
    for links in &mut of_camera {
        links.sort_by(|a, b| {
            let (a_points, b_points) = (all[*a as usize].shared_points, all[*b as usize].shared_points);
            b_points.cmp(&a_points).then(a.cmp(b))
        });
        links.iter().take(max_links).for_each(|at| keep[*at as usize] = true);
    }
    all.iter().zip(keep).filter(|(_, keep)| *keep).map(|(link, _)| *link).collect()
}

fn median_depth(reconstruction: &Reconstruction) -> f64 {
    let mut depths = Vec::with_capacity(reconstruction.observations.len());
    for point in &reconstruction.points {
        for seen in reconstruction.track(point) {
            if let Some(image) = reconstruction.image(seen.image) {
                depths.push((image.cam_from_world.center() - point.x_in_world).norm());
            }
        }
    }
    median(&mut depths).unwrap_or(0.0)
}
