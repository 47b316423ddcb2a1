//! One pose per image as the robust mean over the submaps that have it.

use nalgebra::{UnitQuaternion, Vector3};
use terrane_geometry::{Rigid3, Sim3, so3};
use terrane_scene::{CameraId, ImageId, RegisteredImage};

use crate::SubmapSummary;

/// The images of the members (ascending), each at the mean of its placed poses; where there are three or more, those
/// far from the others have no say.
pub(super) fn fused_images(
    submaps: &[SubmapSummary],
    members: &[u32],
    world_from_submap: &[Sim3],
) -> Vec<RegisteredImage> {
    let mut placed: Vec<(ImageId, u32, CameraId, Rigid3)> = Vec::new();
    for submap in members {
        let world_from_submap = &world_from_submap[*submap as usize];
        for (image, camera, cam_from_submap) in &submaps[*submap as usize].images {
            placed.push((*image, *submap, *camera, world_from_submap.transform_camera(cam_from_submap)));
        }
    }
    placed.sort_by_key(|entry| (entry.0, entry.1));
    placed
        .chunk_by(|a, b| a.0 == b.0)
        .map(|copies| {
            let poses: Vec<Rigid3> = copies.iter().map(|copy| copy.3).collect();
            RegisteredImage { image: copies[0].0, camera: copies[0].2, cam_from_world: mean_pose(&poses) }
        })
        .collect()
}

/// The mean of poses that should be equal: centres and rotations by a few robust reweightings from the medoid.
fn mean_pose(poses: &[Rigid3]) -> Rigid3 {
    let [first, rest @ ..] = poses else { return Rigid3::identity() };
    if rest.is_empty() {
        return *first;
    }
    let total = |pose: &Rigid3| poses.iter().map(|other| (pose.center() - other.center()).norm()).sum::<f64>();
    let medoid = poses.iter().min_by(|a, b| total(a).total_cmp(&total(b))).unwrap_or(first);
    let spread = total(medoid) / poses.len() as f64;
    let weight = |pose: &Rigid3| {
        let distance = (pose.center() - medoid.center()).norm();
        if spread > 0.0 && poses.len() > 2 { 1.0 / (1.0 + (distance / spread).powi(2)) } else { 1.0 }
    };
    let sum: f64 = poses.iter().map(weight).sum();
    let center = poses.iter().map(|pose| weight(pose) * pose.center()).sum::<Vector3<f64>>() / sum;
    let mut rotation: UnitQuaternion<f64> = medoid.rotation;
    for _ in 0..3 {
        let step = poses
            .iter()
            .map(|pose| weight(pose) * so3::log(&(pose.rotation * rotation.inverse())))
            .sum::<Vector3<f64>>()
            / sum;
        rotation = so3::exp(&step) * rotation;
    }
    rotation.renormalize();
    Rigid3::from_rotation_and_center(rotation, &center)
}
